"""Measured counts become runs of a scanner, whatever file, order and orientation they come in; a run gives its model."""

from __future__ import annotations

import numpy as np
import pytest

import mphdrr.core as mph

SMALL = {
    "phantom.kind": "nema", "phantom.voxels": 12, "model.kind": "emission", "model.time": 30.0, "model.pixel_points": 2,
    "model.tolerance": 9.0, "detector.rows": 5, "detector.columns": 6, "detector.plane": "real",
}  # fmt: skip


@pytest.fixture
def simulated(system) -> mph.ProjectionRun:
    (run,) = mph.run_recipe(mph.Recipe(SMALL), system)
    return run


@pytest.mark.parametrize(
    "entries",
    [
        {},
        {"attenuation.of_phantom": True, "model.aperture_points": 3},
        {"model.kind": "transmission", "model.time": None},
    ],
)
def test_the_projector_of_a_run_makes_its_images(system, entries):
    (run,) = mph.run_recipe(mph.Recipe(SMALL).updated(entries), system)
    A = mph.projector_of_run(run, run.volume.grid)
    np.testing.assert_array_equal(A(run.volume), run.projections)
    twice = mph.projector_of_run(
        run, run.volume.grid, recipe=run.recipe.updated({"model.kind": "emission", "model.time": 60})
    )
    if "model.kind" not in entries:
        np.testing.assert_allclose(twice(run.volume), 2 * run.projections, rtol=1e-5)


def test_a_run_without_a_recipe_says_so(system, simulated):
    run = mph.project_run(system, simulated.volume, (4, 4), "real")
    with pytest.raises(mph.InputError, match="holds no recipe"):
        mph.projector_of_run(run, run.volume.grid)
