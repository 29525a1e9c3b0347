"""Laws of SPECT counts: the pinhole's sensitivity, attenuation, aperture, detector, noise."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.errors import InputError

from .conftest import WORKBOOK, general_grid


def _backend(name):
    missing = name != "numpy" and importlib.util.find_spec(name) is None
    return pytest.param(name, marks=pytest.mark.skipif(missing, reason=f"{name} is not installed"))


BACKENDS = [_backend(name) for name in ("numpy", "torch", "numba")]
TOLERANCE = {"numpy": 1e-12, "torch": 1e-5, "numba": 1e-5}


def one_module(**changes):
    """A pinhole at x = 200 mm that looks along -x."""
    lengths = {"pinhole_diameter": 2.0, "collimator_length": 60.0, "detector_side": 50.0, "detector_thickness": 10.0}
    return mph.PinholeSystem(centers=[[200.0, 0.0, 0.0]], roi_radius=60.0, **(lengths | changes))


def sensitivity(system, points):
    """The law of a point source, (M, N): counts per decay at each of the points (N, 3)."""
    towards = points[None] - system.centers[:, None]
    distance = np.linalg.norm(towards, axis=2)
    h = np.einsum("mni,mi->mn", towards, system.principal_rays)
    return system.pinhole_diameter[:, None] ** 2 * (h / distance) ** 3 / (16 * h**2)


def in_ball(rng, radius, n):
    directions = rng.normal(size=(n, 3))
    return directions * (radius * rng.random((n, 1)) ** (1 / 3) / np.linalg.norm(directions, axis=1, keepdims=True))


def turned_grid(shape, spacing, center=(0.0, 0.0, 0.0)):
    """A grid with no plane along any module's rays."""
    affine = mph.euler_pose(0.3, 0.5, 0.2)
    affine[:3, :3] *= spacing
    affine[:3, 3] = center - affine[:3, :3] @ ((np.array(shape) - 1) / 2)
    return mph.Grid(shape, affine)


def assert_adjoint(A, rng):
    x, y = rng.random(A.shape_in), rng.random(A.shape_out)
    Ax, ATy = A(x).astype(float), A.T(y).astype(float)
    assert Ax.any()
    assert abs(np.vdot(Ax, y) - np.vdot(x, ATy)) < np.linalg.norm(Ax) * np.linalg.norm(y) * TOLERANCE[A.backend]


def test_point_source_obeys_pinhole_sensitivity(rng):
    """All 80 modules, 100 places in the ROI, the crystal's own pixels: total counts of a small bright spot.

    A spot is 27 voxels with weights 1-2-1 along each axis (a single voxel's edges would beat with the pixels). The
    total counts of every voxel are the adjoint of an image of ones.
    """
    system = mph.read_system(WORKBOOK)
    grid = turned_grid((27, 27, 27), 6.0)
    places = np.c_[in_ball(rng, system.roi_radius.min() - 6, 100), np.ones(100)]
    steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(27, 3)
    weights = np.prod(0.5 ** (1 + np.abs(steps)), axis=1)
    index = np.rint((places @ grid.index_from_world.T)[:, None, :3]).astype(int) + steps
    voxels = index @ grid.affine[:3, :3].T + grid.affine[:3, 3]
    expected = sensitivity(system, voxels.reshape(-1, 3)).reshape(80, 100, 27) @ weights * grid.voxel_volume
    for m in range(len(system)):
        pitch = system.detector_side[m] / 256  # and more of them around, so that nothing is cut off
        A = mph.Projector(grid, system[m].views((320, 320), "real", pitch=pitch), mph.Emission(system[m]))
        total = A.T(np.ones((1, 320, 320)))[tuple(np.moveaxis(index, -1, 0))] @ weights
        np.testing.assert_allclose(total, expected[m], rtol=0.01)


def test_point_source_obeys_pinhole_sensitivity_to_a_thousandth_with_fine_pixels(rng):
    system = mph.read_system(WORKBOOK)[::27]
    for place in in_ball(rng, 60, 2):
        grid = turned_grid((1, 1, 1), 3.0, place)
        expected = sensitivity(system, place[None])[:, 0] * grid.voxel_volume
        matrices = system.views(shape=(1, 1), detector="real").projection_matrices()
        for m in range(len(system)):
            column, row, factor = matrices[m] @ [*place, 1.0]  # look only at where the voxel's image is
            side = system.detector_side[m]
            views = system[m].views((700, 700), "real", pitch=0.003, offset=np.array([column, row]) / factor * side)
            total = mph.Projector(grid, views, mph.Emission(system[m]))(np.ones((1, 1, 1))).sum(dtype=float)
            np.testing.assert_allclose(total, expected[m], rtol=0.001)


@pytest.mark.parametrize("backend", BACKENDS)
def test_counts_grow_with_time_and_the_pinholes_area(backend, rng):
    grid = turned_grid((5, 6, 7), 8.0)
    x = rng.random(grid.shape)
    views = one_module().views((8, 9))
    base = mph.Projector(grid, views, mph.Emission(one_module()), backend)(x)
    longer = mph.Projector(grid, views, mph.Emission(one_module(), time=20.0, photons_per_decay=0.5), backend)(x)
    wider = mph.Projector(grid, views, mph.Emission(one_module(pinhole_diameter=6.0)), backend)(x)
    assert base.any()
    np.testing.assert_allclose(longer, 10 * base, rtol=1e-6)
    np.testing.assert_allclose(wider, 9 * base, rtol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_counts_per_solid_angle_follow_the_formula(backend):
    """A slab across the field of view: T d^2 p^2 cos^4(psi) / (16 l^2) times its path length, thickness / cos(psi)."""
    system = one_module()
    grid = mph.Grid.centered((1, 1, 1), (10, 400, 400))
    views = system.views((8, 9), detector="real", pitch=(3.0, 2.0), offset=(4.0, -5.0))
    counts = mph.Projector(grid, views, mph.Emission(system, time=7.0), backend)(np.full((1, 1, 1), 5.0))[0]
    u = (np.arange(9) - 4) * 3.0 + 4.0
    v = (np.arange(8) - 3.5)[:, None] * 2.0 - 5.0
    cosine = 60 / np.sqrt(60**2 + u**2 + v**2)
    np.testing.assert_allclose(counts, 7 * 2**2 * 6 * cosine**3 / (16 * 60**2) * 5 * 10, rtol=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("magnification", [0.7, 2.0, 10.0])
def test_real_and_virtual_detector_count_the_same(backend, magnification, system, rng):
    """Point-inverted, and wherever the virtual detector stands: in front of, inside or behind the volume."""
    grid = general_grid(rng, (9, 8, 7))
    x = rng.random(grid.shape)
    model = mph.Emission(system)
    real = system.views((6, 5), "real", pitch=7.0, offset=(2.0, -3.0))
    virtual = system.views(
        (6, 5), "virtual", magnification, 7.0 * magnification, (-2.0 * magnification, 3.0 * magnification)
    )
    counts = mph.Projector(grid, real, model, backend)(x)
    assert counts.any()
    np.testing.assert_allclose(
        mph.Projector(grid, virtual, model, backend)(x)[:, ::-1, ::-1], counts, rtol=1e-5, atol=1e-5 * counts.max()
    )


@pytest.mark.parametrize("backend", BACKENDS)
def test_adjoint_of_the_ideal_pinhole(backend, system, rng):
    grid = general_grid(rng, (9, 8, 7))
    A = mph.Projector(grid, system[3:6].views((10, 11)), mph.Emission(system[3:6]), backend, threads=2)
    assert_adjoint(A, rng)
    a, b = rng.random(grid.shape), rng.random(grid.shape)
    np.testing.assert_allclose(A(2 * a + 3 * b), 2 * A(a) + 3 * A(b), rtol=1e-5, atol=1e-6 * A(a).max())


def test_views_of_another_system_are_refused(system):
    grid = mph.Grid.centered((4, 4, 4), 1.0)
    views = system.views((4, 4))

    def refused(*words, views=views, **arguments):
        with pytest.raises(InputError) as error:
            mph.Projector(grid, views, mph.Emission(**({"system": system} | arguments)))
        assert all(word in str(error.value) for word in words) and "\n" not in str(error.value)

    refused("12 modules", "4 views", views=system[:4].views((4, 4)))
    refused("view 0", "pinhole", views=system[np.arange(12)[::-1]].views((4, 4)))
    turned = mph.Views(
        views.sources, views.detector_centers, views.u_steps + np.array([0, 0, 1]), views.v_steps, (4, 4)
    )
    refused("perpendicular", views=turned)
    behind = mph.Views(views.sources, 2 * views.sources - views.detector_centers, views.u_steps, views.v_steps, (4, 4))
    refused("in front", views=behind)
    refused("PinholeSystem", system=views)
    refused("time", time=0)
    with pytest.raises(InputError, match="activity"):
        mph.Projector(grid, views, mph.Emission(system))(mph.Volume(np.ones(grid.shape), grid, "hu"))
