"""Frames of one scan: their times, the adjoint, a heart gate by gate, and recipes."""

from __future__ import annotations

import math

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import main

from .conftest import FEWER_MODULES as WORKBOOK
from .conftest import voxel_centers

RATE = math.log(2) / mph.isotope("Tc-99m").half_life


@pytest.fixture(scope="module")
def system():
    return mph.read_system(WORKBOOK)[::6]


def projector(system, n=12, spacing=8.0, **model):
    grid = mph.Grid.centered(n, spacing)
    return mph.Projector(grid, system.views((16, 16), magnification=1.0), mph.Emission(system, **model), double=True)


def integrals(activities, starts, times):
    """Return decays between `starts` and `starts` + `times` of activities that are those of the reference time."""
    return activities * (np.exp(-RATE * starts) - np.exp(-RATE * (starts + times))) / RATE


def test_a_dynamic_points_frames_are_their_integrals(system):
    """Eight frames of a point whose activity changes: counts by the integral of the decays in each."""
    A = projector(system, isotope="Tc-99m", time=60.0, start=100.0)
    times = np.array([10.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0, 3600.0])
    frames = mph.FrameProjector(A, times)
    activities = np.array([0.0, 5.0, 80.0, 60.0, 40.0, 30.0, 20.0, 15.0])
    volumes = np.zeros((8, *A.shape_in))
    volumes[:, 5, 6, 7] = activities
    starts = 100.0 + np.cumsum(times) - times
    np.testing.assert_allclose(frames.starts, np.tile(starts[:, None], len(system)))
    one = np.asarray(A(volumes[2]), float) / integrals(80.0, 100.0, 60.0)
    expected = integrals(activities, starts, times)[:, None, None, None] * one
    np.testing.assert_allclose(frames(volumes), expected, rtol=1e-6, atol=1e-9 * expected.max())
    np.testing.assert_allclose(frames.frame(4)(volumes[4]), expected[4], rtol=1e-6, atol=1e-9 * expected.max())


def test_the_adjoint_is_exact_with_times_of_each_module(system, rng):
    A = projector(system, isotope="Tc-99m")
    times, starts = rng.uniform(1, 5, (3, len(system))), rng.uniform(-100, 1e4, (3, len(system)))
    frames = mph.FrameProjector(A, times, starts)
    x, y = rng.random(frames.shape_in), rng.random(frames.shape_out)
    assert np.vdot(frames(x), y) == pytest.approx(np.vdot(x, frames.T(y)), rel=1e-6)
    np.testing.assert_allclose(frames(np.stack([x, 2 * x]))[1], 2 * frames(x))


def test_frames_are_part_of_torchs_graph(system, rng):
    torch = pytest.importorskip("torch", reason="no torch")
    frames = mph.FrameProjector(projector(system), [1.0, 3.0])
    x = torch.tensor(rng.random(frames.shape_in), requires_grad=True)
    y = torch.tensor(rng.random(frames.shape_out))
    (frames(x) * y).sum().backward()
    np.testing.assert_allclose(x.grad, frames.T(y.numpy()), rtol=1e-6)


def test_a_beating_heart_is_reconstructed_gate_by_gate(system):
    """Gates share the time; each by itself gives the volume that its model and counts give."""
    A = projector(system, 16, 12.0, isotope="Tc-99m")
    distances = np.linalg.norm(voxel_centers(A.grid) - [20.0, 10.0, -5.0], axis=-1)
    volumes = np.stack([50.0 * ((radius - 15 < distances) & (distances < radius)) for radius in (45.0, 35.0)])
    gates = mph.FrameProjector(A, [300.0, 300.0], [0.0, 0.0])
    counts = gates(volumes)
    found = [mph.mlem(gates.frame(f), counts[f], 3).volume.array for f in range(2)]
    whole = projector(system, 16, 12.0, isotope="Tc-99m", time=300.0)
    np.testing.assert_allclose(found[1], mph.mlem(whole, counts[1], 3).volume.array, rtol=1e-4)
    assert np.abs(found[0] - found[1]).max() > 0.01 * found[0].max()


def test_a_recipe_makes_a_run_of_each_frame(system, tmp_path):
    mph.write_volume(
        mph.DerenzoPhantom(30, [8, 6, 8, 6, 8, 6], 20).voxelize(mph.Grid.centered(12, 6.0)), tmp_path / "rods.nii.gz"
    )
    recipe = mph.Recipe(
        {
            "system.file": str(WORKBOOK), "system.modules": "1-4", "volume.file": str(tmp_path / "rods.nii.gz"),
            "model.kind": "emission", "model.isotope": "Tc-99m", "model.start": 50.0, "frames.times": [10.0, 3600.0],
            "detector.rows": 12, "detector.columns": 12, "detector.magnification": 1.0,
        }
    )  # fmt: skip
    runs = list(mph.run_recipe(recipe))
    ratio = integrals(1.0, 60.0, 3600.0) / integrals(1.0, 50.0, 10.0)
    np.testing.assert_allclose(runs[1].projections, ratio * runs[0].projections, rtol=1e-5)
    assert [(run.recipe["model.time"], run.recipe["model.start"]) for run in runs] == [(10.0, 50.0), (3600.0, 60.0)]
    again = mph.projector_of_run(runs[1], runs[1].volume.grid)
    np.testing.assert_allclose(again(runs[1].volume), runs[1].projections, rtol=1e-4, atol=1e-4)
    mph.write_recipe(recipe, tmp_path / "scan.toml")
    assert main(["project", str(tmp_path / "scan.toml"), "-o", str(tmp_path / "frame.h5")]) == 0
    np.testing.assert_allclose(mph.read_run(tmp_path / "frame-2.h5").projections, runs[1].projections, rtol=1e-6)


def test_times_beside_those_of_frames_are_refused():
    counts = {"system.file": str(WORKBOOK), "model.kind": "emission", "frames.times": [1.0, 2.0]}
    for key, more in (("model.time", {}), ("model.start", {"frames.starts": [0.0, 1.0]})):
        with pytest.raises(mph.InputError, match=rf"{key}.*frames"):
            mph.Recipe({**counts, key: 60.0, **more})


def test_what_frames_do_not_fit_is_refused(system):
    A = projector(system)
    for times, starts, words in (
        ([], None, "times"), (5.0, None, "times"), ([1.0, -1.0], None, "more than 0"), ([[1.0, 2.0]], None, "times"),
        ([1.0, 2.0], [0.0], r"starts: expected shape \(2"), ([1.0, 2.0], 0.0, "starts"),
    ):  # fmt: skip
        with pytest.raises(mph.InputError, match=words):
            mph.FrameProjector(A, times, starts)
    with pytest.raises(mph.InputError, match="Emission"):
        mph.FrameProjector(mph.Projector(A.grid, A.views), [1.0])
    with pytest.raises(mph.InputError, match=r"frames.starts: expected 2"):
        counts = {"system.file": str(WORKBOOK), "model.kind": "emission", "frames.times": [1, 2], "frames.starts": [0]}
        list(mph.run_recipe(mph.Recipe(counts)))
