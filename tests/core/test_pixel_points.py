"""A pixel is an area: the counts of small sources do not depend on their position between the rays."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.errors import InputWarning
from mphdrr.core.models.pixel_points import expected_error, lattice, offsets, points_needed, shadow_edges

from .conftest import dc_spect, refused
from .test_emission import in_ball, one_module, turned_grid

MODULES = dc_spect()[[3, 10, 21, 38, 62]]  # of all rings; two look nearly along an axis


def law(system, grid):
    """Return total counts per module of a volume of ones: the point law over the voxels, 27 points in each."""
    ticks, weights = np.array([-1, 0, 1]) * np.sqrt(0.15), np.array([5, 8, 5]) / 18
    steps = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    share = np.einsum("i,j,k->ijk", weights, weights, weights).ravel()
    voxels = np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1).reshape(-1, 1, 3)
    points = (voxels + steps) @ grid.affine[:3, :3].T + grid.affine[:3, 3]
    counts = mph.sensitivity(system, points.reshape(-1, 3)).reshape(len(voxels), 27, -1)
    return np.einsum("vsm,s->m", counts, share) * grid.voxel_volume


def totals(grid, n, **options):
    hole = "rays" if "aperture_points" in options else "point"
    A = mph.Projector(grid, MODULES.views((n, n), "real"), mph.Emission(MODULES, hole=hole, **options))
    return A(np.ones(grid.shape)).sum(axis=(1, 2), dtype=float)


POINTS = {"aperture_points": 7}


@pytest.mark.parametrize(("n", "shape", "size", "hole"), [
    (64, 1, 0.5, {}), (64, 1, 4.0, {}), (128, 1, 1.0, {}), (512, 1, 0.5, {}), (64, 1, 1.0, POINTS), (128, 1, 0.5, POINTS),
    (256, 1, 1.0, POINTS), (64, (1, 1, 60), 1.0, POINTS), (64, (60, 1, 1), 1.0, {}), (64, (1, 40, 40), 1.0, {}),
])  # fmt: skip
def test_voxels_capillaries_and_sheets_anywhere_count_by_the_point_law(n, shape, size, hole, rng):
    """Parallel and rotated voxels, from a fraction of a pixel to several pixels, through a point or points of the hole."""
    places = in_ball(rng, 35 if shape == 1 else 10, 3 if size < 1 or shape != 1 else 6)
    for grid in [mph.Grid.centered(shape, size, place) for place in places[1:]] + [
        turned_grid((1, 1, 1), size, places[0])
    ]:
        np.testing.assert_allclose(totals(grid, n, **hole), law(MODULES, grid), rtol=0.02)


def test_a_voxel_of_a_large_grid_counts_by_the_point_law(rng):
    """The number of rays depends on the whole grid, not on the filled voxels."""
    grid = mph.Grid.centered(64, 1.5)
    for index in rng.integers(4, 60, (6, 3)):
        volume = np.zeros(grid.shape)
        volume[tuple(index)] = 1
        place = grid.affine[:3, :3] @ index + grid.affine[:3, 3]
        A = mph.Projector(grid, MODULES.views((64, 64), "real"), mph.Emission(MODULES, hole="point"))
        expected = law(MODULES, mph.Grid.centered(1, 1.5, place))
        np.testing.assert_allclose(A(volume).sum(axis=(1, 2), dtype=float), expected, rtol=0.02)
        # The adjoint of ones is the voxel's sensitivity, without gaps.
    ones = np.ones(A.shape_out)
    assert A.T(ones)[tuple(index)] == pytest.approx(law(MODULES, mph.Grid.centered(1, 1.5, place)).sum(), rel=0.02)


@pytest.mark.parametrize(
    "options", [{"pixel_points": 1}, {"pixel_points": 3}, {"pixel_points": 1, "aperture_points": 7}]
)
def test_too_few_points_are_warned_of_with_the_error_that_they_make(options):
    """The error at many positions is at most the warned one; if the tolerance is met, there is no warning."""
    views = MODULES.views((64, 64), "real")
    with pytest.warns(InputWarning, match=r"in module \d+") as caught:
        mph.Projector(mph.Grid.centered(1, 2.0), views, mph.Emission(MODULES, **options))
    assert len(caught) == 1 and "\n" not in str(caught[0].message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mph.Projector(mph.Grid.centered(1, 2.0), views, mph.Emission(MODULES, tolerance=10.0, **options))
        mph.Projector(mph.Grid.centered(1, 2.0), views, mph.Emission(MODULES, hole="rays"))
        mph.Projector(mph.Grid.centered(1, 40.0), views, mph.Emission(MODULES, pixel_points=1))


def test_what_no_number_of_points_can_do_is_said():
    with pytest.warns(InputWarning, match="smaller pixels"):
        mph.Projector(mph.Grid.centered(1, 0.05), MODULES.views((8, 8), "real"), mph.Emission(MODULES, hole="point"))


@pytest.mark.parametrize("hole_points", [1, 5])
def test_expected_error_bounds_the_error_of_a_shadow(hole_points, rng):
    """Errors of the sum of a box's chords over the lattice, for many positions of the box, against its volume."""
    for _ in range(30):
        edges = np.zeros((1, 3, 2))
        edges[0, :2] = np.diag(rng.uniform(0.1, 0.8, 2))  # seen along an axis: the worst case
        n = int(rng.choice([21, 55, 90]))
        bound = expected_error(edges, n, hole_points)
        places = np.concatenate([offsets(n, rng.random(2)) for _ in range(hole_points)])
        size = edges[0].max(axis=0)
        counts = []
        for corner in rng.random((300, 2)):
            counts.append(((places - corner) % 1 < size).all(axis=1).mean() / size.prod())
        assert np.abs(np.array(counts) - 1).max() < 1.25 * bound


def test_points_grow_as_voxels_shrink_and_with_the_distance():
    views = MODULES.views((64, 64), "real")
    needed = [points_needed(shadow_edges(views, 0, mph.Grid.centered(1, s)), 0.02) for s in (8.0, 2.0, 1.0, 0.5)]
    assert needed == sorted(needed) and needed[0] < 10 < 100 < needed[-1]
    far, near = (mph.Grid.centered(1, 1.0, sign * 60 * MODULES.principal_rays[0]) for sign in (1, -1))
    assert expected_error(shadow_edges(views, 0, far), 55) > 1.5 * expected_error(shadow_edges(views, 0, near), 55)


@pytest.mark.parametrize("n", [1, 2, 3, 7, 21, 100, 987])
def test_lattices_fill_pixels_evenly(n):
    points = lattice(n)
    for side in points.T:
        np.testing.assert_allclose(np.sort(side), (np.arange(n) + 0.5) / n - 0.5, atol=1e-12)


def test_points_of_a_pixel_are_those_of_finer_pixels(rng):
    """An image through many points of each pixel is that of four times finer pixels through their middles, binned."""
    system = one_module()
    grid = turned_grid((9, 8, 7), 6.0)
    x = rng.random(grid.shape)
    fine = mph.Projector(grid, system.views((240, 240), pitch=5.0), mph.Transmission())(x)[0]
    area = mph.Projector(grid, system.views((30, 30), pitch=40.0), mph.Transmission(55))(x)[0]
    binned = fine.reshape(30, 8, 30, 8).mean(axis=(1, 3))
    np.testing.assert_allclose(area, binned, atol=0.01 * binned.max())
    centres = mph.Projector(grid, system.views((30, 30), pitch=40.0), mph.Transmission())(x)[0]
    assert np.abs(centres - binned).max() > 2 * np.abs(area - binned).max()


def test_only_pixels_that_can_see_the_volume_are_traced_and_none_is_missed(system, rng):
    """A few filled voxels in a large grid, and a grid around a pinhole: the same as in the reference without a window."""
    grid, around, views = (
        mph.Grid.centered(24, 8.0),
        mph.Grid.centered(6, 30.0, system.centers[0]),
        system.views((20, 24)),
    )
    x = np.zeros(grid.shape)
    x[3:5, 17:20, 11] = rng.random((2, 3))
    for volume, modules in ((mph.Volume(x, grid), range(12)), (mph.Volume(np.ones(around.shape), around), [0])):
        image = mph.Projector(volume.grid, views, mph.Transmission())(volume)
        for m in modules:
            expected = mph.trace_rays(volume, *views.rays(m), "numpy").reshape(views.shape)
            np.testing.assert_allclose(image[m], expected, rtol=2e-5, atol=2e-5 * max(expected.max(), 1))
    for model in (mph.Transmission(), mph.Emission(system, pixel_points=3, tolerance=1e9)):
        A = mph.Projector(grid, views, model)
        assert A(x).any() and not A(np.zeros(grid.shape)).any()


def test_bad_numbers_of_points_are_refused(system):
    for bad in (0, -1, 1.5, True, "many", 10**6):
        for model in (lambda n: mph.Emission(system, pixel_points=n), mph.Transmission):
            refused(lambda model=model, bad=bad: model(bad), "pixel_points")
    for bad in (0, -0.1, np.nan, None):
        refused(lambda bad=bad: mph.Emission(system, tolerance=bad), "tolerance")
