"""Parallel views: rays that are whole lines, the same in every backend; what cannot hold them says so."""

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.exchange import FORMATS
from mphdrr.core.rays import backends
from mphdrr.core.rays.ray_geometry import view_rays, window

from .conftest import refused
from .odd_views import moved_views

ANGLES = np.array([0.0, 0.3, np.pi / 2, 1.9, np.pi, 4.4])
TURN = mph.euler_pose(0.3, 0.5, 0.2)


def box_chords(views, half_sides):
    """Return lengths (M, n_v, n_u) of the rays' lines within the box around the origin, by slabs."""
    chords = []
    for m in range(len(views)):
        starts, ends = views.rays(m)
        with np.errstate(divide="ignore", invalid="ignore"):
            planes = (np.array([-1.0, 1.0])[:, None, None] * half_sides - starts) / (ends - starts)
        near, far = planes.min(axis=0).max(axis=1), planes.max(axis=0).min(axis=1)
        chords.append(np.clip(far - near, 0, None) * np.linalg.norm(ends - starts, axis=1))
    return np.reshape(chords, (len(views), *views.shape))


def test_a_view_looks_as_a_module_far_away_does():
    views = mph.parallel_views(ANGLES, (5, 7), (2.0, 3.0), elevation=0.2, center=(1, 2, 3))
    across = np.cos(0.2)
    far = 1e9 * np.stack([across * np.cos(ANGLES), across * np.sin(ANGLES), np.full(6, np.sin(0.2))], axis=1)
    directions = views.detector_centers - views.sources
    np.testing.assert_allclose(directions / np.linalg.norm(directions, axis=1)[:, None], -far / 1e9, atol=1e-14)
    system = mph.PinholeSystem(far, *np.outer([1, 50, 80, 5, 40], np.ones(6)))
    u, v, _ = system.frames().transpose(1, 0, 2)
    np.testing.assert_allclose(views.u_steps, 2 * u, atol=1e-12)
    np.testing.assert_allclose(views.v_steps, 3 * v, atol=1e-12)
    level = mph.parallel_views([np.pi / 2], (5, 7), 1.0)
    np.testing.assert_allclose(level.u_steps, [[1, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(level.v_steps, [[0, 0, 1]], atol=1e-15)


def test_projection_matrices_are_affine_and_put_every_point_of_a_ray_on_its_pixel():
    views = mph.parallel_views(ANGLES, (4, 6), (2.0, 3.0), elevation=np.linspace(-1, 1, 6), center=(5, -2, 1))
    matrices = views.projection_matrices()
    assert (matrices[:, 2] == [0, 0, 0, 1]).all()
    pixels = np.stack(np.meshgrid(np.arange(6), np.arange(4)), axis=-1).reshape(-1, 2)
    for m in range(6):
        starts, ends = views.rays(m)
        for share in (-3.0, 0.0, 0.4, 1.0):
            points = starts + share * (ends - starts)
            np.testing.assert_allclose(points @ matrices[m, :2, :3].T + matrices[m, :2, 3], pixels, atol=1e-9)
    np.testing.assert_allclose(matrices[0, :2] @ [5, -2, 1, 1], [2.5, 1.5], atol=1e-12)


@pytest.mark.parametrize("backend", ["numpy", "torch", "cpu", "cuda"])
def test_line_integrals_of_a_box_are_its_chords(backend, monkeypatch):
    monkeypatch.setenv("MPHDRR_CUDA_DEVICE", "cpu")
    try:
        backends.choose(backend)
    except mph.InputError:
        pytest.skip(f"no backend {backend} here")
    grid = mph.Grid((8, 6, 10), TURN @ mph.Grid.centered((8, 6, 10), (2.0, 3.0, 1.5)).affine)
    views = mph.parallel_views(ANGLES, (9, 12), 2.3, elevation=0.1, center=(0.4, 0, 0.3))
    chords = box_chords(moved_views(views, np.linalg.inv(TURN)), np.array([8.0, 9.0, 7.5]))
    images = mph.Projector(grid, views, backend=backend)(np.ones(grid.shape))
    tolerance = 1e-9 if backend == "numpy" else 2e-5
    np.testing.assert_allclose(images, chords, atol=tolerance)
    assert chords.max() > 15


@pytest.mark.parametrize("points", [pytest.param(1, marks=pytest.mark.long), 3])
def test_the_adjoint_subsets_and_backends_agree(points, rng, monkeypatch):
    monkeypatch.setenv("MPHDRR_CUDA_DEVICE", "cpu")
    grid = mph.Grid.centered((11, 9, 8), (1.0, 1.2, 0.9), center=(0.3, 0.2, -0.1))
    views, model = mph.parallel_views(ANGLES, (70, 80), 0.2), mph.Transmission(pixel_points=points)
    x, y = rng.random(grid.shape), rng.random((6, 70, 80))
    A = mph.Projector(grid, views, model, backend="numpy")
    images = A(x)
    assert np.vdot(images, y) == pytest.approx(np.vdot(x, A.T(y)), rel=1e-12)
    for backend in ("cpu", "torch", "cuda"):
        try:
            B = mph.Projector(grid, views, model, backend=backend)
        except mph.InputError:
            continue
        np.testing.assert_allclose(B(x), images, atol=1e-5)
        np.testing.assert_allclose(B.T(y), A.T(y), rtol=1e-5)
    whole = mph.Projector(grid, views, model)
    parts = whole.subsets(3)
    assert [len(part.views) for part in parts] == [2, 2, 2] and all(part.views.parallel for part in parts)
    np.testing.assert_allclose(sum(part.T(part(x)) for part in parts), whole.T(whole(x)), rtol=1e-4)


def test_rays_are_whole_lines_wherever_sources_and_detectors_are_put():
    grid = mph.Grid.centered((16, 16, 16), 1.0)
    views = mph.parallel_views(ANGLES, (10, 12), 1.5)
    x = np.random.default_rng(2).random(grid.shape)
    images = mph.Projector(grid, views, backend="numpy")(x)
    middle = (views.sources + views.detector_centers) / 2
    near = mph.Views(middle + 1e-3 * (views.sources - middle), middle, views.u_steps, views.v_steps, (10, 12), True)
    np.testing.assert_allclose(mph.Projector(grid, near, backend="numpy")(x), images, atol=1e-9)
    for m in range(6):
        traced = mph.trace_rays(x, *views.rays(m), grid=grid, backend="numpy")
        np.testing.assert_allclose(traced.reshape(10, 12), images[m], atol=1e-9)


def test_only_rows_and_columns_that_meet_the_grid_are_traced():
    grid, views = mph.Grid.centered((4, 4, 4), 1.0), mph.parallel_views([0.4], (400, 300), 0.1)
    rows, columns = window([view_rays(views, 0, grid)], grid.corners())
    assert rows.stop - rows.start == 40
    width = 4 * (np.cos(0.4) + np.sin(0.4)) / 0.1
    assert abs(columns.stop - columns.start - width) <= 1


def test_what_needs_a_source_refuses_parallel_views(tmp_path):
    system = mph.PinholeSystem([[100, 0, 0]], *np.array([[1.0], [50], [80], [5], [40]]))
    views, grid = mph.parallel_views([0.0], (4, 4), 1.0), mph.Grid.centered((4, 4, 4), 1.0)
    for model in (mph.Emission(system), mph.InverseSquareSum(system)):
        refused(lambda model=model: mph.Projector(grid, views, model), "parallel views have theirs at infinity")
    volume = mph.Volume(np.ones((4, 4, 4)), grid, "mu")
    refused(lambda: mph.ProjectionRun(np.ones((1, 4, 4)), system, views, volume), "run: ", "parallel")
    for name, format in FORMATS.items():
        path = tmp_path / f"{name}{(format.suffixes or ('',))[0]}"
        refused(lambda path=path, name=name: mph.write_geometry(system, path, name, views=views), "parallel")


def test_wrong_arguments_are_named():
    for name, values, words in (
        ("angles", ([],), "angles: expected one or more"),
        ("angles", ([[0.0]], [np.nan]), "angles"),
        ("shape", ((4,),), "image shape"),
        ("pitch", (0, (1, 2, 3)), "pixel pitch"),
        ("elevation", (2.0,), "elevation: expected from -pi/2"),
        ("elevation", ([0, 0],), "elevation"),
        ("center", ((0, 0),), "center"),
    ):
        for value in values:
            arguments = {"angles": [0.0], "shape": (4, 4), "pitch": 1.0, name: value}
            refused(lambda arguments=arguments: mph.parallel_views(**arguments), words)
    views = ([[0, 0, -1]], [[0, 0, 1]], [[1, 0, 0]], [[0, 1, 0]], (2, 2))
    refused(lambda: mph.Views(*views, parallel="yes"), "parallel: expected True or False")
