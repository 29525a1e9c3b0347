"""Volumes on other grids: linear functions and sums are preserved, and nothing moves in the world."""

from __future__ import annotations

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import general_grid, voxel_centers

WORLD = np.array([0.3, -0.2, 0.5])


def ramp(grid: mph.Grid, quantity: str = "mu") -> mph.Volume:
    return mph.Volume(voxel_centers(grid) @ WORLD + 2, grid, quantity)


def mass(volume: mph.Volume) -> float:
    return float(volume.array.sum(dtype=np.float64) * volume.grid.voxel_volume)


def permuted_grid() -> mph.Grid:
    """Return a grid with axes parallel to the world's, in another order, one backwards."""
    affine = np.array([[0, 0, 1.7, -5], [-0.9, 0, 0, 6], [0, 1.3, 0, -4], [0, 0, 0, 1.0]])
    return mph.Grid((11, 7, 6), affine)


@pytest.mark.parametrize("target", ["parallel", "general"])
def test_linear_interpolation_keeps_a_ramp(rng, target):
    source = ramp(mph.Grid.centered((30, 28, 26), (1.0, 1.1, 1.2)))
    grid = permuted_grid() if target == "parallel" else general_grid(rng, (7, 6, 5))
    result = mph.resample(source, grid)
    assert np.allclose(result.array, ramp(grid).array, atol=1e-5)
    assert result.quantity == "mu"


@pytest.mark.parametrize("method", ["linear", "nearest", "mean"])
def test_a_volumes_own_grid_changes_nothing(rng, method):
    grid = general_grid(rng, (5, 6, 7))
    volume = mph.Volume(rng.normal(size=grid.shape), grid, "mu")
    assert np.allclose(mph.resample(volume, grid, method).array, volume.array, atol=1e-6)


@pytest.mark.parametrize("steps", [(2, 3, 1), (1.5, 2.2, 3.7), (0.4, 1.3, 0.9)])
def test_means_keep_the_sum_exactly_on_parallel_axes(rng, steps):
    grid = mph.Grid.centered((12, 13, 14), (1.0, 2.0, 1.5))
    volume = mph.Volume(rng.uniform(size=grid.shape), grid)
    shape = np.ceil(np.array(grid.shape) / steps).astype(int) + 1
    coarse = mph.resample(volume, mph.Grid.centered(shape, grid.spacing * steps, (0.1, -0.2, 0.05)), "mean")
    assert mass(coarse) == pytest.approx(mass(volume), rel=1e-6)


def test_means_keep_the_sum_nearly_on_any_axes(rng):
    grid = mph.Grid.centered((24, 25, 26), 0.5)
    volume = mph.Volume(rng.uniform(size=grid.shape), grid)
    coarse = mph.resample(volume, general_grid(rng, (30, 45, 20)), "mean")
    assert mass(coarse) == pytest.approx(mass(volume), rel=5e-3)


def test_whole_blocks_are_averaged(rng):
    grid = mph.Grid.centered((6, 8, 9), 1.0)
    volume = mph.Volume(rng.normal(size=grid.shape), grid)
    coarse = mph.resample(volume, mph.Grid.centered((3, 4, 3), (2, 2, 3)), "mean")
    assert np.allclose(coarse.array, volume.array.reshape(3, 2, 4, 2, 3, 3).mean(axis=(1, 3, 5)), atol=1e-6)


def test_labels_stay_labels(rng):
    grid = general_grid(rng, (9, 8, 7))
    labels = mph.Volume(rng.integers(0, 5, grid.shape), grid)
    for target in (general_grid(rng, (20, 20, 20)), mph.Grid(grid.shape, grid.affine @ np.diag([0.6, 2.2, 1, 1]))):
        result = mph.resample(labels, target, "nearest")
        index = np.rint(voxel_centers(target) @ grid.index_from_world[:3, :3].T + grid.index_from_world[:3, 3]).astype(
            int
        )
        inside = ((index >= 0) & (index < grid.shape)).all(axis=-1)
        expected = np.where(inside, labels.array[tuple(np.moveaxis(index.clip(0, np.array(grid.shape) - 1), -1, 0))], 0)
        assert np.array_equal(result.array, expected)


@pytest.mark.parametrize("method", ["linear", "nearest", "mean"])
def test_air_lies_beside_ct_numbers(rng, method):
    inner = mph.Volume(np.full((4, 4, 4), 50.0), mph.Grid.centered(4, 1.0), "hu")
    for affine in (np.eye(4), general_grid(rng, (1, 1, 1)).affine):
        grid = mph.Grid((12, 12, 12), affine @ np.array(mph.Grid.centered(12, 1.0).affine))
        values = mph.resample(inner, grid, method).array
        assert values.min() == -1000
        assert values.max() == pytest.approx(50, abs=1e-3)
        assert mph.resample(inner, grid, method, outside=-7).array.min() == -7


def test_resampling_is_cancelled():
    volume = ramp(mph.Grid.centered(4, 1.0))

    def stop(done: int, total: int) -> None:
        raise mph.Cancelled

    with pytest.raises(mph.Cancelled):
        mph.resample(volume, volume.grid, progress=stop)


def test_crop_and_pad_move_nothing(rng):
    grid = general_grid(rng, (7, 8, 9))
    volume = ramp(grid)
    part = mph.crop(volume, (1, 2, 3), (6, 4, 9))
    assert part.grid.shape == (5, 2, 6)
    assert np.allclose(part.array, ramp(part.grid).array, atol=1e-5)
    wide = mph.pad(part, (1, 2, 3), (1, 4, 0), value=-5)
    assert np.allclose(wide.grid.affine, grid.affine)
    assert np.array_equal(wide.array[1:6, 2:4, 3:], part.array)
    assert np.count_nonzero(wide.array == -5) == wide.array.size - part.array.size
    assert mph.pad(mph.Volume(part.array, part.grid, "hu"), 1, 0).array[0, 0, 0] == -1000


def test_a_box_keeps_all_that_is_in_it(rng):
    volume = ramp(general_grid(rng, (9, 10, 11)))
    low, high = np.array([-4.0, -3, -5]), np.array([3.0, 4, 2])
    part = mph.crop_to_box(volume, low, high)
    before, after = voxel_centers(volume.grid).reshape(-1, 3), voxel_centers(part.grid).reshape(-1, 3)
    count = [((points > low) & (points < high)).all(axis=1).sum() for points in (before, after)]
    assert count[0] == count[1] > 10
    exact = mph.crop_to_box(ramp(mph.Grid.centered(10, 1.0)), (-2, -3, 0), (2, 1, 5))
    assert exact.grid.shape == (4, 4, 5)


def test_canonical_axes_are_right_front_head(rng):
    for _ in range(10):
        volume = ramp(general_grid(rng, (4, 5, 6)))
        turned = mph.canonical(volume)
        assert np.allclose(turned.array, ramp(turned.grid).array, atol=1e-5)
        assert np.all(np.diag(turned.grid.affine)[:3] > 0)
        assert sorted(turned.array.ravel()) == sorted(volume.array.ravel())
    volume = ramp(permuted_grid())
    affine = mph.canonical(volume).grid.affine[:3, :3]
    assert np.array_equal(affine, np.diag(np.diag(affine)))


def test_centering_moves_the_middle_only(rng):
    volume = ramp(mph.Grid((4, 5, 6), general_grid(rng, (9, 9, 9)).affine))
    moved = mph.centered(volume, (1, 2, 3))
    assert np.allclose(moved.grid.center, (1, 2, 3))
    assert np.array_equal(moved.grid.affine[:3, :3], volume.grid.affine[:3, :3])
    assert moved.array is volume.array


def test_labels_split_a_volume_into_its_parts(rng):
    grid = general_grid(rng, (5, 6, 7))
    volume = mph.Volume(rng.uniform(size=grid.shape), grid, "mu")
    labels = rng.choice([0, 2, 7], grid.shape)
    for given in (labels, mph.Volume(labels, grid)):
        parts = mph.split_labels(volume, given)
        assert list(parts) == [0, 2, 7]
        assert np.array_equal(sum(part.array for part in parts.values()), volume.array)
        assert np.array_equal(parts[7].array != 0, labels == 7)
    ct = mph.Volume(volume.array, grid, "hu")
    assert np.all(mph.split_labels(ct, labels)[2].array[labels != 2] == -1000)


ONES, GRID = np.ones((2, 2, 2)), mph.Grid.centered(2, 1.0)
VOLUME = mph.Volume(ONES, GRID)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: mph.resample(ONES, GRID), "resample: expected a Volume, got ndarray"),
        (lambda: mph.resample(VOLUME, ONES), "resample: expected a Grid, got ndarray"),
        (lambda: mph.resample(VOLUME, GRID, "cubic"), "method 'cubic': expected linear, nearest or mean"),
        (lambda: mph.resample(VOLUME, mph.Grid.centered(20000, 1.0)), r"needs .* of memory"),
        (lambda: mph.crop(ONES, 0, 1), "crop: expected a Volume"),
        (lambda: mph.crop(VOLUME, 0, (2, 3, 2)), "is no part of 2 x 2 x 2 voxels"),
        (lambda: mph.crop(VOLUME, (1, 1, 1), (1, 2, 2)), "is no part of 2 x 2 x 2 voxels"),
        (lambda: mph.crop(VOLUME, (-1, 0, 0), 1), "is no part of 2 x 2 x 2 voxels"),
        (lambda: mph.crop(VOLUME, (0.5, 0, 0), 1), "whole numbers"),
        (lambda: mph.crop_to_box(ONES, (0, 0, 0), (1, 1, 1)), "crop_to_box: expected a Volume"),
        (lambda: mph.crop_to_box(VOLUME, (900, 900, 900), (901, 901, 901)), "the volume is not in it"),
        (lambda: mph.crop_to_box(VOLUME, (1, 1, 1), (0, 0, 0)), "expected low below high"),
        (lambda: mph.pad(ONES, 1, 1), "pad: expected a Volume"),
        (lambda: mph.pad(VOLUME, -1, 0), "at least 0"),
        (lambda: mph.canonical(ONES), "canonical: expected a Volume"),
        (lambda: mph.centered(ONES), "centered: expected a Volume"),
        (lambda: mph.split_labels(ONES, ONES), "split_labels: expected a Volume"),
        (lambda: mph.split_labels(VOLUME, mph.Volume(ONES, mph.Grid((2, 2, 2), np.eye(4)))), "resample them onto it"),
        (lambda: mph.split_labels(VOLUME, ONES / 2), r"expected whole numbers, got 0\.5"),
        (lambda: mph.split_labels(VOLUME, ONES[1:]), "expected 2 x 2 x 2 whole numbers"),
        (lambda: mph.volume_to_mesh(ONES), "volume_to_mesh: expected a Volume"),
        (lambda: mph.volume_to_mesh(VOLUME, "high"), "level: expected real numbers"),
        (lambda: mph.volume_to_mesh(VOLUME, 0), "expected above 0, the value outside the grid"),
        (lambda: mph.volume_to_mesh(VOLUME, 1e9), "at most"),
        (lambda: mph.write_volume(ONES, "volume.npz"), "write_volume: expected a Volume"),
    ],
)
def test_what_cannot_be_is_said(call, message):
    with pytest.raises(mph.InputError, match=message):
        call()
