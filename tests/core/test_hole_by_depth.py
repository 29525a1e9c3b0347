"""The whole hole, blurred depth by depth: laws, and agreement with points of the hole."""

from __future__ import annotations

import math

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.physics.aperture import disk_points

from .conftest import BACKENDS, WORKBOOK, general_grid, refused
from .test_emission import assert_adjoint, assert_real_is_virtual, sensitivity

SYSTEM = mph.read_system(WORKBOOK)[[0, 47]]


def depth_projector(grid, pixels=64, backend="auto", system=SYSTEM, **changes):
    return mph.Projector(grid, system.views((pixels, pixels)), mph.Emission(system, hole="depth", **changes), backend)


def exact_image(pixels, size, at, m):
    """The image of a cube: all its points through all points of the hole, each in the pixel that it meets."""
    u, v, k = SYSTEM.frames()[m]
    l, d, side = (float(a[m]) for a in (SYSTEM.collimator_length, SYSTEM.pinhole_diameter, SYSTEM.detector_side))
    ticks = (np.arange(6) + 0.5) / 6 - 0.5
    cube = np.stack(np.meshgrid(ticks, ticks, ticks), -1).reshape(-1, 3) * size + at - SYSTEM.centers[m]
    image = np.zeros(pixels**2)
    for i, point in enumerate(cube):
        h, turn = point @ k, np.array([[math.cos(i), -math.sin(i)], [math.sin(i), math.cos(i)]])
        hole = disk_points(4000) @ turn * d / 2
        slopes = (np.array([point @ u, point @ v]) - hole) / h
        column, row = np.floor((l * slopes - hole) * pixels / side + pixels / 2).astype(int).T
        weights = d**2 / (16 * h**2) * (1 + (slopes**2).sum(1)) ** -1.5
        inside = (np.minimum(row, column) >= 0) & (np.maximum(row, column) < pixels)
        image += np.bincount((row * pixels + column)[inside], weights[inside], pixels**2)
    return image.reshape(pixels, pixels) * size**3 / len(cube) / 4000


@pytest.mark.parametrize(("size", "at"), [(0.5, (3.1, -2.3, 1.9)), (1.5, (-38.0, 30.5, -20.0)), (4.0, (0.0, 0.0, 0.0))])
def test_voxel_of_any_size_has_the_whole_holes_image(size, at):
    """In the middle of a grid that is as deep as a phantom."""
    shift = np.round(np.array(at) / size) * size
    n = 2 * math.ceil(40 / size) + 1
    grid = mph.Grid.centered((n, n, n), size, np.array(at) - shift)
    x = np.zeros(grid.shape)
    x[tuple((n // 2 + np.round(shift / size)).astype(int))] = 1
    for m, image in enumerate(depth_projector(grid)(x)):
        exact = exact_image(64, size, at, m)
        assert image.min() >= 0
        assert image.sum() == pytest.approx(exact.sum(), rel=1e-3)
        assert np.abs(image - exact).sum() < 0.02 * exact.sum()


def test_blurred_by_the_crystal_it_is_within_one_per_cent(rng):
    grid = mph.Grid.centered((20, 20, 20), 4.0)
    x = rng.random(grid.shape) ** 8
    hole = {"intrinsic_fwhm": 1.0, "crystal_mu": "NaI", "isotope": "Tc-99m", "aperture_mu": "tungsten"}
    blurred = depth_projector(grid, 32, **hole)
    rays = mph.Emission(SYSTEM, aperture_points=61, pixel_points=13, tolerance=0.1, **hole)
    exact = mph.Projector(grid, blurred.views, rays)(x)
    assert np.abs(blurred(x) - exact).sum() < 0.01 * exact.sum()


def test_no_voxel_is_missed():
    """Counts of single small voxels by the law of a point source, wherever they are between the pixels."""
    grid = mph.Grid.centered((40, 40, 40), 0.3)
    system = mph.PinholeSystem(
        centers=[[200.0, 0.0, 0.0]], roi_radius=60.0, pinhole_diameter=2.0, collimator_length=60.0, detector_side=50.0,
        detector_thickness=10.0,
    )  # fmt: skip
    A = depth_projector(grid, 16, system=system)
    middles = grid.affine[:3, :3] @ np.indices(grid.shape).reshape(3, -1) + grid.affine[:3, 3:]
    law = sensitivity(system, middles.T)[0].reshape(grid.shape) * 0.3**3
    np.testing.assert_allclose(A.T(np.ones(A.shape_out)), law, rtol=2e-3)


@pytest.mark.parametrize("backend", [b for b in BACKENDS if b in ("cpu", "numpy")])
def test_adjoint_is_exact_and_backends_agree(backend, rng):
    grid = general_grid(rng, (9, 8, 21))
    A = depth_projector(grid, 12, backend, intrinsic_fwhm=2.0, within_crystal=True)
    assert_adjoint(A, rng)
    x, y = rng.random(A.shape_in), rng.random(A.shape_out)
    reference = depth_projector(grid, 12, "numpy", intrinsic_fwhm=2.0, within_crystal=True)
    for found, expected in ((A(x), reference(x)), (A.T(y), reference.T(y))):
        np.testing.assert_allclose(found, expected, rtol=2e-5, atol=1e-5 * expected.max())


def test_threads_change_nothing(rng):
    grid = mph.Grid.centered((12, 12, 12), 4.0)
    views, model = SYSTEM.views((16, 16)), mph.Emission(SYSTEM, hole="depth")
    one, three = (mph.Projector(grid, views, model, threads=n) for n in (1, 3))
    x, y = rng.random(grid.shape), rng.random(one.shape_out)
    np.testing.assert_array_equal(one(x), three(x))
    np.testing.assert_array_equal(one.T(y), three.T(y))


def test_real_detectors_images_are_inverted(rng):
    assert_real_is_virtual(mph.Emission(SYSTEM, hole="depth"), rng)


def test_tensors_have_gradients(rng):
    torch = pytest.importorskip("torch")
    A = depth_projector(mph.Grid.centered((6, 6, 6), 6.0), 8)
    x = torch.rand(A.shape_in, requires_grad=True)
    y = torch.rand(A.shape_out)
    (A(x) * y).sum().backward()
    torch.testing.assert_close(x.grad, A.T(y))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"hole": "cone"}, "hole: expected 'auto', 'depth', 'rays' or 'point'"),
        ({"hole": "depth", "aperture_points": 7}, "hole 'depth' takes no points"),
        ({"hole": "depth", "edge": "path", "aperture_mu": 3.0}, "hole 'depth' takes no edge 'path'"),
        ({"hole": "depth", "crystal_mu": 0.2, "depth_layers": 2}, "hole 'depth' takes no depth_layers"),
    ],
)
def test_what_it_does_not_take_is_refused(changes, said):
    refused(lambda: mph.Emission(SYSTEM, **changes), said)


@pytest.mark.parametrize("backend", [b for b in BACKENDS if b in ("cpu", "numpy")])
def test_attenuated_it_agrees_with_rays(backend, rng):
    """An active ball, off the middle of a water cylinder on a grid of its own; and the adjoint."""
    n = 20 if backend == "cpu" else 8
    grid = mph.Grid.centered((n, n, n), 60 / n)
    water = mph.Grid.centered((40, 40, 40), 4.0, (1.0, 2.0, 3.0))
    x, y, _ = np.moveaxis(centres(water), -1, 0)
    mu = mph.Volume((np.hypot(x, y) < 60) * 0.0154, water, "mu")
    A = depth_projector(grid, 24, backend, mu=mu)
    assert_adjoint(A, rng)
    if backend == "cpu":
        middle = np.linalg.norm(centres(grid) - (10, 5, 0), axis=-1) < 15
        rays = mph.Emission(SYSTEM, mu, aperture_points=61, pixel_points=13, tolerance=0.2)
        exact = mph.Projector(grid, A.views, rays)(middle.astype(float))
        assert np.abs(A(middle.astype(float)) - exact).sum() < 0.01 * exact.sum()


def centres(grid):
    """World places (n_x, n_y, n_z, 3) of a grid's voxels."""
    return np.moveaxis(np.indices(grid.shape), 0, -1) @ grid.affine[:3, :3].T + grid.affine[:3, 3]


def test_grids_near_the_pinhole_and_other_attenuation_are_refused():
    A = depth_projector(mph.Grid.centered((4, 4, 4), 90.0), 8)
    refused(lambda: A(np.ones(A.shape_in)), "take a smaller grid")
    mu = mph.Volume(np.zeros((4, 4, 4)), mph.Grid.centered((4, 4, 4), 10.0), "mu")
    A = depth_projector(mu.grid, 8, mu=mu)
    refused(lambda: A(np.ones(A.shape_in), mu=mu.array), "that of the model alone")
