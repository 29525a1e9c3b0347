"""Volumes in views' coordinates and back: the projector's images, kept activity, exact adjoints, gradients."""

import functools
from dataclasses import replace

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.perspective import places

from .conftest import assert_progress, refused

GRID = mph.Grid((26, 24, 22), mph.euler_pose(0.3, 0.4, 0.5) @ mph.Grid.centered((26, 24, 22), (1.5, 1.7, 2.0)).affine)
BLOB = (np.random.default_rng(5).random(GRID.shape) + 0.2).astype(np.float32)


def odd_views(parallel=False, coarse=1):
    """Return two views; the second's detector is turned, mirrored, leaning and off its axis, and its pitches differ."""
    u, v, k = mph.euler_pose(0.2, 1.1, -0.4)[:3, :3].T
    sources, middles = [[0, -200, 10], -150 * k], [[0, 300, -15], 250 * k + 9 * u - 14 * v]
    u_steps = coarse * np.array([[4.0, 0, 0], 3.6 * u + 0.5 * v + 0.2 * k])
    v_steps = coarse * np.array([[0, 0, 4.0], -4.4 * v + 0.3 * u])
    return mph.Views(sources, middles, u_steps, v_steps, (66 // coarse, 60 // coarse), parallel)


def grids(views, n_k=24, uniform="k"):
    near, far = mph.depth_ranges(views, GRID)
    return mph.perspective_grids(views, n_k, near - 1, far + 1, uniform)


VOLUME = mph.Volume(BLOB, GRID)
CASES = pytest.mark.parametrize(("parallel", "uniform"), [(p, u) for p in (False, True) for u in ("k", "depth")])
UNEVEN = pytest.mark.filterwarnings("ignore::mphdrr.core.errors.InputWarning")


@CASES
def test_summed_along_its_rays_a_volume_is_its_image(parallel, uniform):
    views = odd_views(parallel)
    images = mph.Projector(GRID, views)(VOLUME)
    assert (images > 0).mean(axis=(1, 2)).min() > 0.04
    for g, image in zip(grids(views, uniform=uniform), images, strict=True):
        np.testing.assert_allclose(g.image(mph.to_perspective(VOLUME, g)), image, atol=2e-5 * image.max())


@CASES
def test_values_are_the_mean_along_the_ray_from_plane_to_plane(parallel, uniform):
    pixels = np.stack(np.meshgrid(np.arange(60.0), np.arange(66.0), indexing="ij"), -1).reshape(-1, 2)
    for g in grids(odd_views(parallel), 5, uniform):
        array = mph.to_perspective(VOLUME, g)
        for plane in range(5):
            ends = [g.to_world(np.c_[pixels, np.full(len(pixels), g.edges[plane + i])]) for i in (0, 1)]
            mean = mph.trace_rays(VOLUME, *ends) / np.linalg.norm(ends[1] - ends[0], axis=1)
            np.testing.assert_allclose(array[..., plane].ravel(), mean, atol=1e-5)


@CASES
@UNEVEN
def test_activity_is_kept(parallel, uniform):
    views = odd_views(parallel)
    total = BLOB.sum(dtype=float) * GRID.voxel_volume
    larger = mph.Grid((40, 40, 40), GRID.affine @ mph.Grid.centered((40, 40, 40), 1.0, (12, 11, 10)).affine)
    for g in grids(views, uniform=uniform):
        inside = mph.to_perspective(VOLUME, g, keep="activity")
        assert inside.sum(dtype=float) == pytest.approx(total, rel=1e-3)
        back = mph.from_perspective(inside, g, larger, keep="activity")
        # A cell's ray may reach out of the grid where its voxels do not.
        assert back.sum(dtype=float) * larger.voxel_volume == pytest.approx(total, rel=1e-3)
    g, _ = grids(views, uniform=uniform)
    near, far = mph.depth_ranges(views, GRID)
    other = mph.PerspectiveGrid(views, 1, 30, near[1] - 9, far[1] + 9)
    moved = mph.camera_to_camera(mph.to_perspective(VOLUME, g, "activity"), g, other, "activity")
    assert moved.sum(dtype=float) == pytest.approx(total, rel=1e-3)


def test_what_lies_outside_is_left_out():
    views = odd_views()
    near, far = mph.depth_ranges(views, GRID)
    half = mph.PerspectiveGrid(views, 0, 20, near[0] - 1, (near[0] + far[0]) / 2)
    activity = mph.to_perspective(mph.Volume(np.ones(GRID.shape), GRID), half, "activity").sum()
    assert activity == pytest.approx(0.5 * GRID.n_voxels * GRID.voxel_volume, rel=0.04)


@pytest.mark.parametrize("spacing", [1.5, 4.0])
def test_both_forms_agree_about_a_smooth_volume(spacing):
    """What lies in a cell is its value times its volume, whether voxels are smaller or larger than cells."""
    n = int(96 / spacing)
    grid = mph.Grid.centered((n, n, n), spacing)
    x = np.stack(np.meshgrid(*[(np.arange(n) - (n - 1) / 2) * spacing] * 3, indexing="ij"))
    volume = mph.Volume(np.exp(-(x**2).sum(axis=0) / (2 * 14.0**2)), grid)
    g = mph.PerspectiveGrid(odd_views(), 0, 48, 130, 270)
    density = mph.to_perspective(volume, g)
    activity = mph.to_perspective(volume, g, keep="activity")
    assert (density * g.cell_volumes()).sum() == pytest.approx(activity.sum(), rel=5e-3)
    # Apart from the steps between voxels, which rays follow and cells smooth.
    assert np.abs(activity / g.cell_volumes() - density).mean() < 0.05 * density.mean()
    back = mph.from_perspective(density, g, grid)
    assert np.abs(back - volume.array).mean() < 0.03 * volume.array.mean()


def maps(views, n_k=40):
    """Return pairs of maps of plain arrays, each with its adjoint and the shapes that they take."""
    near, far = mph.depth_ranges(views, GRID)
    g = mph.PerspectiveGrid(views, 0, 17, near[0] - 3, far[0] - 5, "depth")
    h = mph.PerspectiveGrid(views, 1, n_k, near[1] + 2, far[1] + 9)
    v = GRID.voxel_volume
    for lattice in (g, h):
        there = functools.partial(mph.to_perspective, g=lattice, grid=GRID)
        back = functools.partial(mph.from_perspective, g=lattice, grid=GRID)
        yield there, lambda y, back=back: v * back(y, keep="activity"), GRID.shape, lattice.shape
        yield lambda x, there=there: there(x, keep="activity") / v, back, GRID.shape, lattice.shape
    yield lambda x: mph.camera_to_camera(x, g, h), lambda y: mph.camera_to_camera(y, h, g, "activity"), g.shape, h.shape


@pytest.mark.parametrize("parallel", [False, True])
@UNEVEN
def test_partners_are_adjoint(parallel):
    rng = np.random.default_rng(1)
    for forward, adjoint, shape_in, shape_out in maps(odd_views(parallel)):
        x, y = rng.random((2, *shape_in), dtype=np.float32), rng.random((2, *shape_out), dtype=np.float32)
        one, other = (forward(x).astype(float) * y).sum(), (adjoint(y).astype(float) * x).sum()
        assert one == pytest.approx(other, rel=1e-5)
        assert one != 0


@pytest.mark.parametrize("parallel", [False, True])
@UNEVEN
def test_tensors_and_their_gradients(parallel):
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(2)
    for forward, adjoint, shape_in, shape_out in maps(odd_views(parallel, coarse=3)):
        x = torch.from_numpy(rng.random(shape_in)).requires_grad_()
        y = torch.from_numpy(rng.random(shape_out))
        result = forward(x)
        assert result.dtype == torch.float64
        np.testing.assert_allclose(result.detach().numpy(), forward(x.detach().numpy().astype(np.float32)), atol=1e-4)
        (result * y).sum().backward()
        np.testing.assert_allclose(x.grad.numpy(), adjoint(y).numpy(), atol=1e-12 * float(adjoint(y).max()))


@pytest.mark.long
@UNEVEN
def test_gradcheck():
    torch = pytest.importorskip("torch")
    sources, middles = [[0, -50, 0], [40, 2, 3]], [[0, 50, 0], [-60, 0, 0]]
    views = mph.Views(sources, middles, [[4, 0, 0], [0, 6, 1]], [[0, 0, 5], [0, 1, -6]], (4, 3))
    grid = mph.Grid.centered((3, 4, 2), (3.0, 2.0, 4.0))
    g, h = mph.perspective_grids(views, 3, 20, 80)
    x, y = (torch.rand(*lattice.shape, dtype=torch.float64, requires_grad=True) for lattice in (grid, g))
    for keep in ("density", "activity"):
        assert torch.autograd.gradcheck(lambda x, keep=keep: mph.to_perspective(x, g, keep, grid=grid), x)
        assert torch.autograd.gradcheck(lambda y, keep=keep: mph.from_perspective(y, g, grid, keep), y)
        assert torch.autograd.gradcheck(lambda y, keep=keep: mph.camera_to_camera(y, g, h, keep), y)
    assert torch.autograd.gradcheck(lambda y: g.image(y), y)


@UNEVEN
def test_the_kernels_are_numpys_and_threads_change_nothing(monkeypatch):
    if places._gather_kernel is None:
        pytest.skip("no compiled kernels here")
    rng = np.random.default_rng(3)
    for forward, adjoint, shape_in, shape_out in maps(odd_views(coarse=11), 9):
        x, y = rng.random(shape_in, dtype=np.float32), rng.random(shape_out, dtype=np.float32)
        compiled = forward(x), adjoint(y)
        with monkeypatch.context() as patch:
            patch.setattr(places, "_gather_kernel", None)
            patch.setattr(places, "_scatter_kernel", None)
            for array, expected in zip((forward(x), adjoint(y)), compiled, strict=True):
                np.testing.assert_allclose(array, expected, atol=3e-5 * np.abs(expected).max())
        with monkeypatch.context() as patch:
            patch.setattr(places, "thread_count", lambda threads: 3)
            np.testing.assert_array_equal(forward(x), compiled[0])


def test_a_distant_source_is_a_parallel_view():
    """Farther and farther sources: the array of a view in parallel is the limit."""
    views = odd_views(parallel=True)[:1]
    toward = views.detector_centers - views.sources

    def array(views):
        near, far = mph.depth_ranges(views, GRID)
        return mph.to_perspective(VOLUME, mph.PerspectiveGrid(views, 0, 12, near[0], far[0]))

    distant = (replace(views, sources=views.detector_centers - t * toward, parallel=False) for t in (10, 100, 1000))
    errors = [np.abs(array(v) - array(views)).mean() for v in distant]
    assert errors[0] > 5 * errors[1] > 25 * errors[2]
    assert errors[2] < 2e-3


def test_rays_that_leave_voxels_out_are_said():
    g = mph.PerspectiveGrid(odd_views(), 0, 10, 150, 250)
    fine = mph.Grid.centered((40, 40, 40), 0.5)
    with pytest.warns(mph.InputWarning, match="voxels between them get nothing"):
        mph.from_perspective(np.ones(g.shape), g, fine, keep="activity")


def test_activity_shared_out_unevenly_is_said():
    g = mph.PerspectiveGrid(odd_views(), 0, 40, 180, 220)
    coarse = mph.Grid.centered((3, 3, 3), 20.0)
    with pytest.warns(mph.InputWarning, match="voxels cover up to .* finer voxels"):
        mph.to_perspective(np.ones(coarse.shape), g, "activity", grid=coarse)
    few = mph.PerspectiveGrid(odd_views(coarse=6), 1, 2, 100, 200)
    with pytest.warns(mph.InputWarning, match="cells of the array cover up to .* finer cells"):
        mph.camera_to_camera(np.ones(few.shape), few, g, "activity")


def test_what_is_not_understood_is_refused():
    g, voxels = grids(odd_views())[0], mph.Grid.centered((26, 24, 22), 1)
    for call, words in (
        (lambda: mph.to_perspective(BLOB, g), "expected a Volume, or the grid of the array"),
        (lambda: mph.to_perspective(BLOB, g, grid=mph.Grid.centered((3, 3, 3), 1)), "expected shape"),
        (lambda: mph.to_perspective(mph.Volume(BLOB, GRID, "hu"), g), "convert its CT numbers first"),
        (lambda: mph.to_perspective(VOLUME, g, grid=voxels), "leave `grid` out"),
        (lambda: mph.to_perspective(VOLUME, g, keep="counts"), "keep"),
        (lambda: mph.from_perspective(BLOB, g, GRID), "expected shape"),
        (lambda: mph.from_perspective(np.full(g.shape, np.nan), g, GRID), "finite"),
        (lambda: mph.camera_to_camera(BLOB, g, GRID), "PerspectiveGrid"),
        (lambda: mph.to_perspective(VOLUME, GRID), "PerspectiveGrid"),
    ):
        refused(call, words)


@pytest.mark.parametrize("keep", ["density", "activity"])
def test_work_says_how_far_it_is_and_can_be_stopped(keep):
    g, h = grids(odd_views())
    ones = np.ones(g.shape)
    for call in (
        lambda progress: mph.to_perspective(VOLUME, g, keep, progress=progress),
        lambda progress: mph.from_perspective(ones, g, GRID, keep, progress=progress),
        lambda progress: mph.camera_to_camera(ones, g, h, keep, progress=progress),
    ):
        assert_progress(call)


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_what_is_not_finite_is_not_lost(monkeypatch, compiled, kind):
    """Of two arrays, whose numbers meet in one point each, in both orders."""
    if compiled and places._gather_kernel is None:
        pytest.skip("no compiled kernels here")
    if not compiled:
        monkeypatch.setattr(places, "_gather_kernel", None)
    for how, strange in ((places.LEAST, np.nan), (places.PRODUCT, np.nan), (places.PRODUCT, np.inf)):
        for order in (1, -1):
            points, arrays = np.ones((1, 1, 1), kind), np.array([strange, 3.0][::order], kind).reshape(2, 1, 1, 1)
            matrix = np.zeros((2, 5, 4))
            matrix[:, 3:, 3] = 1
            with np.errstate(invalid="ignore"):
                places.gather(points, np.zeros(1), arrays, matrix, how=how, exponents=np.zeros((1, 1, 1), np.int32))
            assert not np.isfinite(points).any()
