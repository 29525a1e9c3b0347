"""Each camera predicts the others: one view's image and depths against the projector's images of the other views."""

import functools

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import refused
from .test_backprojection import odd_views

GRID = mph.Grid((34, 33, 32), mph.euler_pose(0.3, 0.4, 0.5) @ mph.Grid.centered((34, 33, 32), 1.5).affine)


def blobs(grid: mph.Grid = GRID) -> mph.Volume:
    """Return a volume of two smooth blobs."""
    x = np.indices(grid.shape).T @ grid.affine[:3, :3].T + grid.affine[:3, 3]
    first, second = (((x - middle) ** 2).sum(axis=-1) for middle in ((4.0, 3.0, -2.0), (-7.0, -3.0, 5.0)))
    return mph.Volume((np.exp(-first / (2 * 6.0**2)) + 0.6 * np.exp(-second / (2 * 5.0**2))).T, grid)


def all_round(parallel: bool = False) -> mph.Views:
    """Return three views of all of the blobs: from the front, odd ones from the sides, with other pixels."""
    u, v, k = mph.euler_pose(0.2, 1.1, -0.4)[:3, :3].T
    size, sources = 0.45 if parallel else 1.0, [[0, -200, 10], -150 * k, [170, 30, 20]]
    middles = [[0, 300, -15], 250 * k + 9 * u - 14 * v, [-200, -40, 0]]
    u_steps = size * np.array([[4.5, 0, 0], 4.1 * u + 0.5 * v + 0.3 * k, [0.4, 3.3, 0]])
    v_steps = size * np.array([[0, 0, 4.0], -4.2 * v + 0.4 * u, [0, 0.3, -3.6]])
    return mph.Views(sources, middles, u_steps, v_steps, (52, 49), parallel)


def grid_of(views: mph.Views, m: int, n_k: int = 48) -> mph.PerspectiveGrid:
    near, far = mph.depth_ranges(views, GRID)
    return mph.PerspectiveGrid(views, m, n_k, near[m], far[m])


@pytest.mark.parametrize("parallel", [False, True])
@pytest.mark.parametrize("m", [0, 1])
def test_with_the_true_depths_every_image_is_predicted(m, parallel):
    views, volume = all_round(parallel), blobs()
    images = mph.Projector(GRID, views)(volume)
    g = grid_of(views, m)
    shares = mph.to_perspective(volume, g) * g.ray_lengths()
    predicted, covered = mph.predict_views(mph.spread_along_rays(images[m], shares, g), g, views)
    errors = mph.prediction_errors(images, predicted, covered)
    # Cells and pixels of some 2 mm blur the blobs, which have a standard deviation of 5 and 6 mm, a little.
    assert np.abs(errors).max() < 0.035 * images.max()
    assert np.abs(errors).sum() < 0.04 * images.sum()
    np.testing.assert_allclose(predicted.sum(axis=(1, 2)), images.sum(axis=(1, 2)), rtol=2e-3)
    assert not images[~covered].any()


def test_with_wrong_depths_other_images_are_not():
    """Equal shares along the ray: the view itself is predicted still."""
    views = all_round()
    images = mph.Projector(GRID, views)(blobs())
    g = grid_of(views, 0)
    density = mph.spread_along_rays(images[0], np.ones(g.shape), g)
    errors = mph.prediction_errors(images, *mph.predict_views(density, g, views))
    first, *others = np.abs(errors).max(axis=(1, 2)) / images.max(axis=(1, 2))
    assert first < 0.035 and min(others) > 0.3


def test_what_is_shared_out_is_the_image_again(rng):
    views = odd_views()
    g = mph.PerspectiveGrid(views, 1, 9, 80, 240)
    images, shares = rng.random((3, 23, 26)), rng.random((3, *g.shape))
    shares[0, 4, 7], images[0, 7, 4] = 0, 0
    density = mph.spread_along_rays(images, shares, g)
    assert density.dtype == np.float32
    np.testing.assert_allclose(g.image(density), images, rtol=1e-5)
    np.testing.assert_allclose(mph.spread_along_rays(images, 7 * shares, g), density, rtol=1e-5)
    expected = images[1, 6, 5] * shares[1, 5, 6] / shares[1, 5, 6].sum()
    np.testing.assert_allclose(density[1, 5, 6] * g.ray_lengths()[5, 6], expected, rtol=1e-5)


def test_covered_are_the_pixels_whose_rays_meet_the_cells(rng):
    views = odd_views()
    g = mph.PerspectiveGrid(views, 0, 20, 190, 230)
    predicted, covered = mph.predict_views(np.ones(g.shape), g, views, 40)
    for m, (image, inside) in enumerate(zip(predicted, covered, strict=True)):
        starts, ends = views.rays(m)
        points = g.from_world(starts + np.linspace(0.001, 1.5, 1500)[:, None, None] * (ends - starts))
        ahead = (points[..., 2] > 0) & (points[..., 2] <= g.edges[0]) & (points[..., 2] >= g.edges[-1])
        meets = (ahead & (points[..., :2] >= -0.5).all(-1) & (points[..., :2] <= [25.5, 22.5]).all(-1)).any(axis=0)
        assert (inside.ravel() == meets).mean() > 0.97
        assert (image[inside] > 0).sum() >= 0.97 * inside.sum()
    assert covered[0].all() and 0.05 < covered[1:3].mean() < 0.95


def test_behind_a_source_nothing_is_predicted():
    views = mph.Views([[0, -100, 0], [0, 300, 0]], [[0, 50, 0], [0, 450, 0]], [[4, 0, 0]] * 2, [[0, 0, 5]] * 2, (6, 7))
    g, steps = mph.PerspectiveGrid(views, 0, 5, 80, 120), []
    predicted, covered = mph.predict_views(np.ones(g.shape), g, views, 3, progress=lambda *step: steps.append(step))
    assert covered[0].all() and not covered[1].any() and not predicted[1].any() and (predicted[0] > 0).all()
    assert steps == [(1, 2), (2, 2)]


def test_tensors_and_their_gradients(rng):
    torch = pytest.importorskip("torch")
    views = all_round()
    image, shares = rng.random((52, 49)), rng.random((2, 49, 52, 6)) + 0.01
    g = grid_of(views, 0, 6)
    x = torch.from_numpy(shares).requires_grad_()
    density = mph.spread_along_rays(torch.from_numpy(image), x, g)
    predicted, covered = mph.predict_views(density, g, views, 8)
    assert predicted.shape == (2, 3, 52, 49) and predicted.dtype == torch.float64 and covered.dtype == torch.bool
    expected, pixels = mph.predict_views(mph.spread_along_rays(image, shares, g), g, views, 8)
    # On the outermost cells' edges float32 and float64 may take different things.
    assert np.isclose(predicted.detach().numpy(), expected, atol=1e-4 * expected.max()).mean() > 0.999
    np.testing.assert_array_equal(covered.numpy(), pixels)
    errors = mph.prediction_errors(np.zeros((3, 52, 49)), predicted, covered)
    torch.testing.assert_close(errors, -predicted * covered)
    (errors**2).sum().backward()
    assert x.grad.abs().amax(dim=(1, 2, 3)).min() > 0


def test_gradcheck():
    torch = pytest.importorskip("torch")
    sources, middles = [[0, -50, 0], [40, 2, 3]], [[0, 50, 0], [-60, 0, 0]]
    views = mph.Views(sources, middles, [[4, 0, 0], [0, 6, 1]], [[0, 0, 5], [0, 1, -6]], (3, 2))
    g = mph.PerspectiveGrid(views, 0, 3, 35, 65)
    inputs = [torch.rand(shape, dtype=torch.float64).add(0.1).requires_grad_() for shape in ((3, 2), (2, 3, 3))]
    assert torch.autograd.gradcheck(lambda *x: mph.predict_views(mph.spread_along_rays(*x, g), g, views, 4)[0], inputs)


def test_what_is_not_understood_is_refused(rng):
    views = odd_views()
    g = mph.PerspectiveGrid(views, 0, 4, 190, 230)
    image, shares = rng.random((23, 26)), rng.random(g.shape)
    empty = shares.copy()
    empty[3, 5] = 0
    predicted, covered = mph.predict_views(shares, g, views, 4)
    for function, arguments, words in (
        (mph.spread_along_rays, (image.T, shares, g), ("image", "23 x 26")),
        (mph.spread_along_rays, (image, shares[..., 0], g), ("depth distribution", "26 x 23 x 4")),
        (mph.spread_along_rays, (image, -shares, g), ("0 or more",)),
        (mph.spread_along_rays, (image, empty, g), ("column 3, row 5",)),
        (mph.spread_along_rays, (image, np.nan * shares, g), ("finite",)),
        (mph.predict_views, (image, g, views), ("expected shape",)),
        (mph.predict_views, (shares, views, views), ("PerspectiveGrid",)),
        (mph.predict_views, (shares, g, views[0:0]), ("one or more views",)),
        (mph.predict_views, (shares, g, views, 0), ("planes",)),
        (mph.prediction_errors, (image, predicted, covered), ("one shape", "23 x 26")),
    ):
        refused(functools.partial(function, *arguments), *words)
