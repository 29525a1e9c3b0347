"""Laws of the maps: the point sources' law, the projector's adjoint, and the sampling of directions."""

from __future__ import annotations

import math

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import general_grid, refused, voxel_centers
from .test_performance import EDGE

DEGREE = math.radians(1)


def pinholes(directions, radius=250.0):
    """Return modules in these directions from the isocentre, whose fields of view hold all around it."""
    directions = np.asarray(directions, float)
    directions = directions / np.linalg.norm(directions, axis=1)[:, None]
    return mph.PinholeSystem(radius * directions, 2.0, 50.0, 100.0, 10.0, 75.0)


def ring(n, start=0.0):
    """Return n modules evenly around the isocentre, the first at an angle `start`."""
    angles = 2 * np.pi * np.arange(n) / n + start
    return pinholes(np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1))


def test_maps_are_the_values_at_the_voxels_centres(system, rng):
    grid = general_grid(rng, (21, 19, 23))
    grid = mph.Grid(grid.shape, grid.affine * np.array([[12.0], [12.0], [12.0], [1.0]]))
    points = voxel_centers(grid).reshape(-1, 3)
    counts = mph.sensitivity(system, points, **EDGE)
    fwhm = np.nan_to_num(mph.resolution(system, points, intrinsic_fwhm=3.0, **EDGE))
    total = counts.sum(axis=1)
    rms = np.sqrt((counts * fwhm**2).sum(axis=1) / np.where(total == 0, 1, total))
    expected = {
        "sensitivity": (mph.sensitivity_map(system, grid, **EDGE), total),
        "modules": (mph.modules_map(system, grid), mph.seen(system, points).sum(axis=1)),
        "resolution": (mph.resolution_map(system, grid, intrinsic_fwhm=3.0, **EDGE), rms),
    }
    unseen = (total == 0).reshape(grid.shape)
    assert 0 < unseen.mean() < 1
    for quantity, (volume, values) in expected.items():
        assert volume.quantity == quantity
        assert volume.grid == grid
        assert np.allclose(volume.array.ravel(), values, rtol=1e-6)
        assert np.all(volume.array[unseen] == 0)


def test_gap_of_few_pinholes():
    origin = [[0.0, 0.0, 0.0]]
    fine = {"tolerance": 1e-4}
    assert mph.sampling_gaps(pinholes([[1, 2, 3]]), origin)[0] == pytest.approx(math.pi / 2, abs=0.1 * DEGREE)
    assert mph.sampling_gaps(pinholes([[0, 1, 0]]), [[0, 300.0, 0]])[0] == math.pi / 2  # no module sees it
    # Two lines: the worst normal halves the smaller angle between them.
    for angle in (0.4, 1.2, 2.5):
        two = pinholes([[1, 0, 0], [math.cos(angle), math.sin(angle), 0]])
        gap = math.pi / 2 - min(angle, math.pi - angle) / 2
        assert mph.sampling_gaps(two, origin, **fine)[0] == pytest.approx(gap, abs=1e-4)
    # Three at right angles: the cube's diagonal.
    diagonal = math.asin(1 / math.sqrt(3))
    assert mph.sampling_gaps(pinholes(np.eye(3)), origin, **fine)[0] == pytest.approx(diagonal, abs=1e-4)


@pytest.mark.parametrize(("n", "gap"), [(6, math.pi / 6), (7, math.pi / 14), (20, math.pi / 20), (45, math.pi / 90)])
def test_gap_of_a_ring(n, gap):
    """In the ring's plane: the worst planes are perpendicular to it, halfway between two pinholes or their opposites."""
    largest = mph.sampling_gaps(ring(n, 0.2), [[0.0, 0, 0]], tolerance=1e-5)[0]
    assert gap - 1e-5 <= largest + 1e-12 and largest <= gap + 1e-12


def test_gap_above_the_plane_of_a_ring_is_that_of_the_level_plane():
    for z in (10.0, 40.0):
        (gap,) = mph.sampling_gaps(ring(301), [[0.0, 0, z]])
        assert gap == pytest.approx(math.atan(z / 250), abs=0.1 * DEGREE)


def test_pinholes_all_around_leave_no_gap(rng):
    """More pinholes never widen a gap."""
    directions = rng.normal(size=(1500, 3))
    gaps = [mph.sampling_gaps(pinholes(directions[:n]), [[3.0, 2, 1]])[0] for n in (5, 20, 100, 1500)]
    assert np.all(np.diff(gaps) < 0.1 * DEGREE)
    assert gaps[-1] < 1.5 * DEGREE


@pytest.mark.long
def test_gap_is_the_largest_of_all_planes(system, rng):
    """Against a million normals, within the tolerance and their own distance."""
    points = rng.uniform(-60, 60, (3, 3))
    normals = rng.normal(size=(1_000_000, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    for point, gap in zip(points, mph.sampling_gaps(system, points), strict=True):
        towards = (system.centers - point)[mph.seen(system, point[None])[0]]
        towards /= np.linalg.norm(towards, axis=1)[:, None]
        tried = np.arcsin(np.abs(normals @ towards.T).min(axis=1).max())
        assert tried - 0.1 * DEGREE <= gap <= tried + 0.3 * DEGREE


def test_completeness_is_one_less_the_share_of_the_gap(system, rng):
    grid = mph.Grid.centered((5, 6, 4), 60.0)
    volume = mph.completeness_map(system, grid)
    gaps = mph.sampling_gaps(system, voxel_centers(grid).reshape(-1, 3))
    assert np.allclose(volume.array.ravel(), 1 - gaps / (math.pi / 2), atol=0.1 / 90 + 1e-6)
    seen_by = mph.modules_map(system, grid).array
    assert np.all(volume.array[seen_by == 0] == 0)
    assert volume.array.max() > 0.3


def test_a_map_can_be_written_and_read(system, tmp_path):
    volume = mph.modules_map(system, mph.Grid.centered(6, 20.0))
    for name in ("a.nii.gz", "a.npz"):
        mph.write_volume(volume, tmp_path / name)
        back = mph.read_volume(tmp_path / name)
        assert back.quantity == "modules"
        assert back.unit == "1"
        assert np.array_equal(back.array, volume.array)


def test_progress_is_told_and_can_stop(system):
    grid = mph.Grid.centered(36, 5.0)
    told = []
    mph.sensitivity_map(system, grid, progress=lambda done, total: told.append((done, total)))
    assert told == [(i + 1, len(told)) for i in range(len(told))]
    assert len(told) > 2

    def stop(done, total):
        raise mph.Cancelled

    with pytest.raises(mph.Cancelled):
        mph.modules_map(system, grid, progress=stop)


def test_bad_settings_are_refused(system):
    grid = mph.Grid.centered(3, 10.0)
    for call, word in (
        (lambda: mph.sensitivity_map(system, grid, crystal_mu=-1), "crystal_mu"),
        (lambda: mph.completeness_map(system, grid, tolerance=1e-9), "tolerance"),
        (lambda: mph.modules_map(system, mph.Grid.centered(100_000, 1.0)), "memory"),
    ):
        refused(call, word)
