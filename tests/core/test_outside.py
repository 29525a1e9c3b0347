"""Maps, masks, starts and truths that leave out some of the activity are warned of by its share; usual ones are not."""

from __future__ import annotations

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.runs.recipe import recorded_recipe
from mphdrr.core.volumes.resampling import share_outside

from .conftest import general_grid, voxel_centers, warned

GRID = mph.Grid.centered((16, 16, 16), 6.0)
USUAL = {"hole": "point", "pixel_points": 1, "tolerance": 1e9}


def cylinder(grid: mph.Grid, value: float, quantity: str, radius: float = 30.0, half: float = 36.0) -> mph.Volume:
    """Return a cylinder along z around the isocentre, each voxel full or empty."""
    x, y, z = np.moveaxis(voxel_centers(grid), -1, 0)
    return mph.Volume(value * ((x**2 + y**2 < radius**2) & (abs(z) < half)), grid, quantity)


def moved(volume: mph.Volume, *shift: float) -> mph.Volume:
    affine = volume.grid.affine.copy()
    affine[:3, 3] += shift
    return mph.Volume(volume.array, mph.Grid(volume.grid.shape, affine), volume.quantity)


def about(texts: list[str]) -> list[str]:
    """Return the warnings of something outside of something, or of counts that are not seen."""
    return [text for text in texts if " % of " in text]


def test_the_share_is_that_of_the_voxels_centres_outside_the_box(rng):
    for _ in range(10):
        volume = mph.Volume(rng.normal(size=(5, 6, 7)), general_grid(rng, (5, 6, 7)))
        grid = general_grid(rng, (4, 3, 6))
        centre = grid.affine @ [1.5, 1.0, 2.5, 1.0]
        weights = np.linalg.solve(grid.affine[:3, :3], (voxel_centers(volume.grid) - centre[:3]).reshape(-1, 3).T).T
        outside = (np.abs(weights) > np.array([4, 3, 6]) / 2).any(axis=1).reshape(5, 6, 7)
        share = np.abs(volume.array)[outside].sum() / np.abs(volume.array).sum()
        assert share_outside(volume, grid) == pytest.approx(share, rel=1e-5) and 0 < share < 1
    air = mph.Volume(np.full((4, 4, 4), -1000.0), mph.Grid.centered(4, 1.0), "hu")
    assert share_outside(air, moved(air, 900, 0, 0).grid) == 0


@pytest.mark.parametrize(
    ("shift", "share"), [((900, 0, 0), "100"), ((0, 0, 48), "50"), ((0, 0, -16), "8.33"), ((0, 0, 0), None)]
)
def test_activity_outside_the_map_of_mu_is_named_by_its_share(system, shift, share):
    activity, mu = cylinder(GRID, 5, "activity"), cylinder(GRID, 0.015, "mu")
    model = mph.Emission(system, mu=moved(mu, *shift), **USUAL)
    texts = about(warned(lambda: mph.project_run(system, activity, (4, 4), model=model)))
    assert len(texts) == (share is not None)
    assert all(text.startswith(f"{share} % of the activity lies outside the map of mu") for text in texts), texts


@pytest.mark.parametrize("shape", [(10, 10, 12), (15, 15, 15), (40, 40, 40)])
def test_a_map_of_the_body_alone_or_of_more_is_usual(system, shape):
    """The grid of the activity reaches into the air, where there is none; voxels need not lie upon each other."""
    activity, mu = cylinder(GRID, 5, "activity"), cylinder(mph.Grid.centered(shape, 6.1), 0.015, "mu")
    model = mph.Emission(system, mu=mu, **USUAL)
    assert about(warned(lambda: mph.project_run(system, activity, (4, 4), model=model))) == []


def test_a_measured_runs_map_that_lies_elsewhere_is_named(system):
    activity, mu = cylinder(GRID, 50, "activity"), cylinder(GRID, 0.015, "mu")
    recipe = mph.Recipe({
        "model.kind": "emission", "model.time": 600.0, "detector.rows": 8, "detector.columns": 8, "detector.plane": "real",
        "reconstruction.method": "osem", "reconstruction.iterations": 2, "reconstruction.voxels": 16,
        "reconstruction.spacing": 8.0,
    })  # fmt: skip
    model = mph.Emission(system, mu=mu, time=600.0, **USUAL)
    counts = mph.project_run(system, activity, (8, 8), "real", model=model, noise_seed=1).projections
    settings = {"detector": "real", "recipe": recorded_recipe(recipe).tables()}
    run = mph.ProjectionRun(counts, system, system.views((8, 8), "real"), unit="counts", settings=settings)
    assert about(warned(lambda: mph.reconstruct_run(run, recipe, mu=mu))) == []
    (text,) = about(warned(lambda: mph.reconstruct_run(run, recipe, mu=moved(mu, 900, 0, 0))))
    assert text.startswith("100 % of the activity lies outside the map of mu")


@pytest.mark.parametrize("method", [mph.mlem, mph.osem, mph.bsrem])
def test_a_mask_or_start_that_leaves_activity_out_is_named(system, rng, method):
    A = mph.Projector(GRID, system.views((8, 8), "real"), mph.Emission(system, time=3000.0, **USUAL))
    counts = rng.poisson(A(cylinder(GRID, 5, "activity")))
    body, half = cylinder(GRID, 1, "activity").array > 0, np.zeros(GRID.shape, bool)
    half[:, :, :5] = True
    assert about(warned(lambda: method(A, counts, 1, mask=body))) == []
    (text,) = about(warned(lambda: method(A, counts, 1, mask=half)))
    assert text.startswith("mask, start: ") and " % of the counts are in pixels that see no voxel of them" in text
    start = half.astype(np.float32)  # zeros grow in BSREM alone
    assert len(about(warned(lambda: method(A, counts, 1, start=start)))) == (method is not mph.bsrem)
    texts = about(warned(lambda: method(A, counts, 1, start=np.ones(GRID.shape), mask=body)))
    share = 1 - body.mean()
    assert texts == [f"start: {100 * share:.3g} % of its sum lies outside the mask, and is left out"]
    result = method(A, counts, 2, mask=body)
    assert about(warned(lambda: method(A, counts, 1, start=result, mask=body))) == []


def test_a_truth_that_reaches_beyond_the_volume_is_named():
    truth = cylinder(GRID, 5, "activity")
    (text,) = about(warned(lambda: mph.score_volume(cylinder(GRID, 5, "activity"), moved(truth, 0, 0, 48))))
    assert text.startswith("50 % of the activity lies outside the volume, where it is not scored")
    wide = cylinder(mph.Grid.centered((40, 40, 40), 5.0), 5, "activity")
    assert about(warned(lambda: mph.score_volume(truth, wide))) == []


def test_a_density_that_does_not_cover_a_doses_activity_is_named(command, tmp_path):
    mph.write_volume(cylinder(GRID, 5, "activity"), tmp_path / "a.nii")
    x, y, z = np.moveaxis(voxel_centers(GRID), -1, 0)
    ct = mph.Volume(np.where((x**2 + y**2 < 40**2) & (abs(z) < 40), 0.0, -1000.0), GRID, "hu")
    for shift, share in ((0.0, ""), (48.0, "50")):
        mph.write_volume(moved(ct, 0, 0, shift), tmp_path / "ct.nii")
        words = "xray", "dose", tmp_path / "a.nii", "--isotope", "Tc-99m", "--ct", tmp_path / "ct.nii"
        error = command(*words, "-o", tmp_path / f"d{share}.nii").err
        assert (f"{share} % of the activity lies outside the CT, where its density is taken as air's" in error) == bool(
            share
        )
