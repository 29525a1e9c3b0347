"""What a user writes: every step of the pages, with types."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import DataLoader

import mphdrr.core as mph


def simulate(workbook: Path, folder: Path) -> mph.ProjectionRun:
    system: mph.PinholeSystem = mph.read_system(workbook)
    views: mph.Views = system.views(shape=(16, 16), detector="real")
    phantom = mph.DerenzoPhantom(radius=40.0, rod_diameters=(8, 6, 5, 4, 3, 2), height=40.0)
    grid = mph.Grid.centered((24, 24, 24), 4.0)
    volume: mph.Volume = phantom.voxelize(grid, mph.euler_pose(0.1, 0.2, 0.3, (1.0, 2.0, 3.0)))
    A = mph.Projector(grid, views, model=mph.Emission(system, time=600.0, hole="point", pixel_points=1, tolerance=1e6))
    means: NDArray[np.float32] = A(volume)
    back: NDArray[np.float32] = A.T(means)
    counts: NDArray[np.int64] = mph.sample_counts(means, seed=1)
    print(A.shape_in, A.shape_out, back.shape, counts.sum(), [part.backend for part in A.subsets(4)])
    run = mph.project_run(system, volume, shape=(16, 16), detector="real", model=A.model, noise_seed=1)
    mph.write_run(run, folder / "run.h5")
    mph.write_volume(volume, folder / "truth.nii.gz")
    again = mph.read_run(folder / "run.h5")
    assert again.projections.shape == run.projections.shape and again.seed == 1
    return again


def reconstruct(recipe: mph.Recipe, folder: Path) -> mph.Reconstruction:
    (run,) = mph.run_recipe(recipe)
    found: mph.Reconstruction = mph.reconstruct_run(
        run, mph.Recipe({"reconstruction.voxels": 12, "reconstruction.iterations": 2})
    )
    mph.write_reconstruction(found, folder / "state.h5")
    print(found.iterations, found.volume.array.max(), mph.nrmse(found.volume.array, found.volume.array))
    return found


def train(recipe: Path, folder: Path) -> None:
    events = mph.events.make(mph.events.read_recipe(recipe), folder / "set", count=4)
    event: mph.events.Event = events.split("train")[0]
    images: NDArray[np.float32] = event.images("emission", noise_seed=event.noise_seed)
    truth: mph.Volume = event.truth
    print(images.shape, truth.unit, event.radon(8).shape, [row["phantom"] for row in events.index])
    mph.events.export_events(events, folder / "export", "npz", noise="own")
    loader: DataLoader[dict[str, Any]] = DataLoader(
        mph.events.torch_dataset(events, ("truth", "emission"), noise="epoch")
    )
    for item in loader:
        print(sorted(item))


def geometry(workbook: Path) -> dict[str, float]:
    try:
        system = mph.read_system(workbook)
    except mph.InputError as error:
        raise SystemExit(str(error)) from None
    report: mph.GeometryReport = mph.check_geometry(system)
    print(report, mph.MATERIALS["tungsten"], mph.isotope("Tc-99m"))
    performance: mph.ModulePerformance = mph.isocentre_performance(
        system.pinhole_distance, system.pinhole_diameter, system.collimator_length, system.detector_side, 10.0
    )
    return {"mm": float(np.mean(performance.resolution)), "modules": len(system.centers)}
