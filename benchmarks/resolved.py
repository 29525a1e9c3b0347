"""What the DC-SPECT scanner resolves of a Derenzo phantom, by method: the study of docs/reconstruction.md.

    python -m benchmarks.resolved FOLDER STUDY ...

STUDY: data (first), whole-hole, no-recovery (neither the hole's blur nor the crystal's), seven-rays, fine (voxels half as
large), noise (five draws, whole hole), blur-3 (intrinsic blur of 3 mm), cylinder (200 mm of water). Every study writes its
scores, JSON, and its volume into FOLDER. The data come from 256^3 voxels and rays through many points of the hole, which no
model of the studies uses. One takes a minute or two, fine several.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

import mphdrr.core as mph

SYSTEM = mph.read_system(Path(__file__).parents[1] / "examples/dc-spect-80.xlsx")
PHANTOM = mph.DerenzoPhantom(40, (8, 6, 5, 4, 3, 2), 40, 100)
FIELD = 96.0  # mm
PIXELS = 64
CAMERA: dict[str, Any] = {
    "isotope": "Tc-99m",
    "time": 600.0,
    "aperture_mu": "tungsten",
    "crystal_mu": "NaI",
    "within_crystal": True,
}
TRUE_POINTS = {"aperture_points": 91, "pixel_points": 3}
MODELS: dict[str, dict[str, Any]] = {
    "whole-hole": {},
    "no-recovery": {"blur": 0.0, "hole": "point", "pixel_points": 5},
    "seven-rays": {"aperture_points": 7, "pixel_points": 1},
}
ITERATIONS, SUBSETS, DRAWS = 80, 16, 5
WATER_MU = 0.0154  # 1/mm, of Tc-99m's photons


def grid(n: int) -> mph.Grid:
    """Return `n`^3 voxels over the field; for n = 128, 128 x 128 x 64 over its central part, which holds the rods."""
    return mph.Grid.centered((n, n, 64 if n == 128 else n), FIELD / n)


def projector(n: int, blur: float = 1.0, **model: Any) -> mph.Projector:
    """Return the scanner's projector for `n`^3 voxels."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mph.InputWarning)
        views = SYSTEM.views(shape=(PIXELS, PIXELS))
        return mph.Projector(grid(n), views, mph.Emission(SYSTEM, intrinsic_fwhm=blur, **CAMERA, **model))


def counts(folder: Path, blur: float = 1.0) -> np.ndarray:
    """Return the noise-free counts, from their file where it exists."""
    path = folder / f"counts-{blur:g}.npy"
    if not path.exists():
        np.save(path, projector(256, blur, **TRUE_POINTS)(PHANTOM.voxelize(grid(256))))
    return np.load(path)


def reconstruct(folder: Path, name: str, data: np.ndarray, n: int, iterations: int, **model: Any) -> dict[str, Any]:
    """Reconstruct, score and save; return the scores by iteration."""
    A = projector(n, **model)
    started = time.perf_counter()
    history: dict[int, Any] = {}

    def look(iteration: int, x: np.ndarray) -> None:
        if iteration in (5, 10, 20, 40, iterations):
            history[iteration] = scores(mph.Volume(np.asarray(x), A.grid, "activity"))
            np.save(folder / f"{name}.npy", np.asarray(x, np.float32))
            result = {"name": name, "voxels": n, "scores": history, "seconds": time.perf_counter() - started}
            (folder / f"{name}.json").write_text(json.dumps(result, indent=1))
            print(name, iteration, [(s["diameter"], s["pairs"], s["valley"]) for s in history[iteration]], flush=True)

    mph.osem(A, data, iterations, SUBSETS, callback=look)
    return history


def cylinder(folder: Path, diameter: float = 200.0, height: float = 60.0, iterations: int = 10) -> dict[str, float]:
    """Return the relative activity at the centre of a uniform cylinder of water, with and without attenuation in the model.

    The modules see 150 mm, so all counts are from within the crystals: the whole cylinder is reconstructed.
    """
    views = SYSTEM.views(shape=(PIXELS, PIXELS))

    def water(n: int, spacing: float) -> tuple[mph.Grid, np.ndarray]:
        shape = (n, n, round(1.2 * height / spacing))
        place = mph.Grid.centered(shape, spacing)
        x, y, z = (np.indices(shape).T * spacing + place.affine[:3, 3]).T
        return place, (np.hypot(x, y) < diameter / 2) & (abs(z) < height / 2)

    fine, filled = water(200, 1.0)
    mu = mph.Volume(filled * WATER_MU, fine, "mu")
    exact = mph.Emission(SYSTEM, mu, intrinsic_fwhm=1.0, aperture_points=19, pixel_points=3, tolerance=2.0, **CAMERA)
    data = mph.Projector(fine, views, exact)(filled * 100.0)
    coarse, _ = water(50, 4.0)
    found = {}
    for name, of_model in (("corrected", mu), ("uncorrected", None)):
        A = mph.Projector(coarse, views, mph.Emission(SYSTEM, of_model, intrinsic_fwhm=1.0, **CAMERA))
        x = mph.osem(A, data, iterations, SUBSETS).volume.array
        distance = np.linalg.norm((np.indices(coarse.shape).T * 4.0 + coarse.affine[:3, 3]).T, axis=0)
        found[name] = float(x[distance < 20].mean() / 100)
        np.save(folder / f"cylinder-{name}.npy", x)
        print("cylinder", name, found[name], flush=True)
    (folder / "cylinder.json").write_text(json.dumps(found))
    return found


def picture(folder: Path, names: list[str], path: Path, tile: int = 260) -> None:
    """Draw the central slices of the truth and of reconstructions in `folder`, side by side, on the truth's grey scale."""
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mph.InputWarning)  # a slice does not contain the phantom
        truth = PHANTOM.voxelize(mph.Grid.centered((256, 256, 1), FIELD / 256)).array[:, :, 0]
    slices = [truth] + [volume[:, :, volume.shape[2] // 2] for volume in (np.load(folder / f"{n}.npy") for n in names)]
    page = Image.new("L", (len(slices) * tile + (len(slices) - 1) * 8, tile), 255)
    for i, values in enumerate(slices):
        grey = np.clip(values.T[::-1] / PHANTOM.activity, 0, 1) ** 0.7 * 255
        page.paste(
            Image.fromarray(grey.astype(np.uint8)).resize((tile, tile), Image.Resampling.BICUBIC), (i * (tile + 8), 0)
        )
    page.save(path, quality=85)


def scores(volume: mph.Volume) -> list[dict[str, float]]:
    """Return the scores of each sector: the fields of `derenzo_score` that the page shows."""
    score = mph.derenzo_score(volume, PHANTOM)
    return [
        {
            "diameter": float(s.rod_diameter),
            "resolved": bool(s.resolved),
            "pairs": round(float(s.pairs_resolved), 3),
            "valley": round(float(s.valley_to_peak), 3),
            "contrast": round(float(s.contrast_recovery), 3),
        }
        for s in score
    ]


def main() -> None:
    """Run the studies asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("studies", nargs="+")
    parser.add_argument("--picture", type=Path, help="draw the studies' results to this file instead")
    parser.add_argument("--iterations", type=int, default=ITERATIONS)
    arguments = parser.parse_args()
    folder, n = arguments.folder, arguments.iterations
    if arguments.picture:
        picture(folder, arguments.studies, arguments.picture)
        return
    folder.mkdir(parents=True, exist_ok=True)
    for study in arguments.studies:
        data = counts(folder, 3.0 if study == "blur-3" else 1.0)
        if study in MODELS:
            reconstruct(folder, study, data, 64, n, **MODELS[study])
        elif study == "blur-3":
            reconstruct(folder, study, data, 64, n, blur=3.0)
        elif study == "fine":
            reconstruct(folder, study, data, 128, n)
        elif study == "noise":
            for draw in range(DRAWS):
                if (folder / f"noise-{draw}.json").exists():
                    continue
                drawn = np.random.default_rng(draw).poisson(data)
                reconstruct(folder, f"noise-{draw}", drawn, 64, n)
        elif study == "cylinder":
            cylinder(folder)
        elif study != "data":
            parser.error(f"no study {study}")


if __name__ == "__main__":
    main()
