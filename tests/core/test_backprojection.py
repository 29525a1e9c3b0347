"""Back-projections: sum, geometric mean and minimum over views, the number of views, depth distributions, the findings."""

import tracemalloc

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.perspective import places

from .conftest import assert_progress, general_grid, refused, voxel_centers

WAYS = ("sum", "product", "minimum")


def odd_views(parallel: bool = False) -> mph.Views:
    """Return views: upright; turned, mirrored, leaning and off its axis; one that sees half; one that stands in the grid."""
    u, v, k = mph.euler_pose(0.2, 1.1, -0.4)[:3, :3].T
    sources = np.array([[0, -200, 10], -150 * k, [180, 30, 20], [2.0, 3.0, -1.5]])
    middles = np.array([[0, 300, -15], 250 * k + 9 * u - 14 * v, [-200, -60, 80], [2.0, 160.0, 31.0]])
    u_steps = np.array([[6.0, 0, 0], 5.1 * u + 0.7 * v + 0.3 * k, [0.4, 4.0, 0], [0, 0.5, 7.0]])
    v_steps = np.array([[0, 0, 5.0], -6.2 * v + 0.4 * u, [0, 0.3, -3.0], [9.0, 0, 0]])
    size = 0.5 if parallel else 1.0
    return mph.Views(sources, middles, size * u_steps, size * v_steps, (23, 26), parallel)


def sampled(array: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return values (N,) at fractional indices (N, axes), linear between elements, and which lie in the outer edges."""
    n = np.array(array.shape)
    within = ((index >= -0.5) & (index <= n - 0.5)).all(axis=1)
    place = np.clip(np.nan_to_num(index), 0, n - 1)
    first, value = np.floor(place), np.zeros(len(index))
    for corner in np.ndindex(*(2,) * array.ndim):
        elements = np.minimum(first.astype(int) + corner, n - 1)
        weights = np.where(corner, place - first, 1 - (place - first))
        value += weights.prod(axis=1) * array[tuple(elements.T)]
    return value, within


def what_views_say(images: np.ndarray, views: mph.Views, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return each view's value (M, N) at world points (N, 3), and whether it sees them."""
    values, seen = [], []
    for image, matrix in zip(images, views.projection_matrices(), strict=True):
        p = np.c_[points, np.ones(len(points))] @ matrix.T
        value, within = sampled(image, p[:, [1, 0]] / p[:, 2:])
        values.append(value)
        seen.append(within & (p[:, 2] > 0))
    return np.array(values), np.array(seen)


def put_together(values: np.ndarray, seen: np.ndarray, how: str) -> np.ndarray:
    if how == "sum":
        return np.where(seen, values, 0).sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        means = np.exp(np.where(seen, np.log(values), 0).sum(axis=0) / seen.sum(axis=0))
    minima = np.where(seen, values, np.inf).min(axis=0)
    return np.where(seen.any(axis=0), minima if how == "minimum" else means, 0)


def centers(grid: mph.Grid | mph.PerspectiveGrid) -> np.ndarray:
    if isinstance(grid, mph.PerspectiveGrid):
        return grid.centers().reshape(-1, 3)
    return voxel_centers(grid).reshape(-1, 3)


def array_of(result: mph.Volume | np.ndarray) -> np.ndarray:
    return np.asarray(result.array if isinstance(result, mph.Volume) else result, np.float64).ravel()


@pytest.fixture
def grid(rng) -> mph.Grid:
    grid = general_grid(rng, (31, 28, 33))
    return mph.Grid(grid.shape, np.diag([2.5, 2.5, 2.5, 1]) @ grid.affine)


def lattices(grid: mph.Grid, views: mph.Views) -> list[mph.Grid | mph.PerspectiveGrid]:
    """Return voxels, the cells of a view, and those of another camera."""
    other = mph.Views([[40, -190, 60]], [[-50, 210, -90]], [[7, 0, 1]], [[0.5, 1, -8]], (19, 21))
    return [grid, mph.PerspectiveGrid(views, 1, 12, 110, 190), mph.PerspectiveGrid(other, 0, 15, 150, 250, "depth")]


@pytest.mark.parametrize("how", WAYS)
@pytest.mark.parametrize(("kernel", "parallel"), [("compiled", False), ("compiled", True), ("numpy", False)])
def test_it_is_what_the_views_say_of_each_place(rng, grid, monkeypatch, kernel, parallel, how):
    if kernel == "numpy":
        monkeypatch.setattr(places, "_gather_kernel", None)
    views, images = odd_views(parallel), rng.random((4, 23, 26)).astype(np.float32)
    for lattice in lattices(grid, views):
        values, seen = what_views_say(images, views, centers(lattice))
        result = array_of(mph.backproject(images, views, lattice, how))
        count = array_of(mph.views_that_see(views, lattice))
        assert set(seen.sum(axis=0).tolist()) >= {1, 2, 3}
        assert lattice is not grid or not seen.any(axis=0).all()
        # On an image's edge float32 and float64 may see different things.
        sure = count == seen.sum(axis=0)
        assert sure.mean() > 0.9995
        np.testing.assert_allclose(result[sure], put_together(values, seen, how)[sure], atol=5e-5)


@pytest.mark.parametrize("how", WAYS)
def test_views_in_any_order_say_the_same_and_factors_stay(rng, grid, how):
    views, images, order = odd_views(), rng.random((4, 23, 26)), [2, 0, 3, 1]
    volume = mph.backproject(images, views, grid, how)
    result = array_of(volume)
    assert volume.quantity == "backprojection"
    ordered = array_of(mph.backproject(images[order], views[order], grid, how))
    larger = array_of(mph.backproject(37.0 * images, views, grid, how))
    for same in (ordered, larger / 37):
        np.testing.assert_allclose(same, result, rtol=2e-6, atol=2e-6)


@pytest.mark.parametrize("value", [1e-37, 1e-6, 1.0, 1e6, 3e36])
def test_eighty_equal_values_are_their_mean(scanner, value):
    """Their product is beyond what floating-point numbers hold."""
    views, grid = scanner.views((8, 8)), mph.Grid.centered((9, 8, 7), 9.0)
    images = np.full((80, 8, 8), value)
    seen = array_of(mph.views_that_see(views, grid))
    assert seen.max() == 80
    for how, expected in (("product", value), ("minimum", value), ("sum", value * seen)):
        np.testing.assert_allclose(array_of(mph.backproject(images, views, grid, how)), expected, rtol=2e-6)


def test_where_one_view_sees_nothing_nothing_is(rng, grid):
    views, images = odd_views(), rng.random((4, 23, 26)) + 0.1
    images[1] = 0
    seen = what_views_say(images, views, centers(grid))[1]
    for how in ("product", "minimum"):
        result = array_of(mph.backproject(images, views, grid, how))
        assert (result[seen[1]] == 0).all() and (result[seen.any(axis=0) & ~seen[1]] > 0).all()
        assert not array_of(mph.backproject(0 * images, views, grid, how)).any()


def test_minimum_geometric_mean_and_mean_are_in_this_order(rng, grid):
    views, images = odd_views(), rng.random((4, 23, 26))
    sums, products, minima = (array_of(mph.backproject(images, views, grid, how)) for how in WAYS)
    means = sums / np.maximum(array_of(mph.views_that_see(views, grid)), 1)
    assert (minima <= products * (1 + 1e-6)).all() and (products <= means * (1 + 1e-6)).all()


def test_a_point_source_lies_where_product_and_minimum_are_largest(system):
    views, grid = system.views((61, 57)), mph.Grid.centered((25, 23, 21), 2.0)
    rows, columns = np.mgrid[:61, :57]
    for voxel in ((12, 11, 10), (7, 15, 13), (18, 6, 4)):
        column, row, depth = (views.projection_matrices() @ grid.affine @ (*voxel, 1.0)).T[..., None, None]
        images = np.exp(-((columns - column / depth) ** 2 + (rows - row / depth) ** 2) / 4)
        for how in ("product", "minimum"):
            volume = mph.backproject(images, views, grid, how)
            assert np.unravel_index(volume.array.argmax(), grid.shape) == voxel


def perspectives(views: mph.Views, n_k: int = 9) -> list[mph.PerspectiveGrid]:
    depths = ((150, 260), (90, 240), (120, 230), (5, 60))
    return [mph.PerspectiveGrid(views, m, n_k + m, *ends, ("k", "depth")[m % 2]) for m, ends in enumerate(depths)]


@pytest.mark.parametrize("how", WAYS)
@pytest.mark.parametrize("parallel", [False, True])
def test_a_depth_distribution_says_where_along_the_ray(rng, grid, parallel, how):
    views, images = odd_views(parallel), rng.random((4, 23, 26))
    pairs = [(g, rng.random(g.shape)) for g in perspectives(views)]
    for lattice in lattices(grid, views):
        values, seen = [], []
        for image, (g, array) in zip(images, pairs, strict=True):
            p = np.c_[centers(lattice), np.ones(len(centers(lattice)))] @ g.index_matrix.T
            value, within = sampled(image.T[..., None] * array, p[:, :3] / p[:, [3, 3, 4]])
            values.append(value)
            seen.append(within & (p[:, 3] > 0) & (p[:, 4] > 0))
        result, same = (
            array_of(mph.backproject(images, views, lattice, how, depth=depth)) for depth in (pairs, pairs.__getitem__)
        )
        assert np.isclose(result, put_together(np.array(values), np.array(seen), how), atol=1e-4).mean() > 0.9995
        np.testing.assert_array_equal(same, result)


@pytest.mark.parametrize("how", WAYS)
def test_the_same_everywhere_along_the_ray_is_no_distribution(rng, how):
    views, images = odd_views()[:3], rng.random((3, 23, 26))
    grid = mph.Grid.centered((20, 21, 22), 2.0)
    near, far = mph.depth_ranges(views, grid)
    pairs = [(g, np.ones(g.shape)) for g in mph.perspective_grids(views, 5, near, far)]
    found, expected = (array_of(mph.backproject(images, views, grid, how, depth=depth)) for depth in (pairs, None))
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_what_is_at_hand_is_memory_enough(scanner):
    """Besides images and result, a product takes less than half of the result's size, and the others nothing."""
    views, grid = scanner[:10].views((40, 40)), mph.Grid.centered((96, 96, 64), 1.5)
    images = np.ones((10, 40, 40), np.float32)
    for how, volumes in (("sum", 1), ("product", 1.5), ("minimum", 1)):
        tracemalloc.start()
        mph.backproject(images, views, grid, how)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < volumes * 4 * grid.n_voxels + 3e5


def test_it_says_how_far_it_is_and_can_be_stopped(rng, grid):
    views, images = odd_views(), rng.random((4, 23, 26))
    pairs = [(g, np.ones(g.shape)) for g in perspectives(views)]
    for depth in (None, pairs):
        assert_progress(lambda p, depth=depth: mph.backproject(images, views, grid, depth=depth, progress=p), 4)
    assert_progress(lambda progress: mph.views_that_see(views, grid, progress), 4)


def test_tensors_are_taken_as_numbers(rng, grid):
    torch = pytest.importorskip("torch")
    views, images = odd_views(), rng.random((4, 23, 26))
    volume, tensors = mph.backproject(images, views, grid, "product"), torch.from_numpy(images)
    np.testing.assert_array_equal(mph.backproject(tensors, views, grid, "product").array, volume.array)
    refused(lambda: mph.backproject(tensors.requires_grad_(), views, grid), "gradients", "from_perspective")


def test_what_is_not_understood_is_refused(rng, grid):
    views, images = odd_views(), rng.random((4, 23, 26))
    negative, broken = images.copy(), images.copy()
    negative[2, 5, 7], broken[1, 2, 3] = -0.5, np.nan
    pairs = [(g, np.ones(g.shape)) for g in perspectives(views)]
    below, swapped = [*pairs[:3], (pairs[3][0], -pairs[3][1])], [pairs[1], pairs[0], *pairs[2:]]
    for arguments, words in (
        ((images, views, grid, "mean"), ("mean", "sum, product, minimum")),
        ((images[:3], views, grid), ("4 x 23 x 26", "3 x 23 x 26")),
        ((broken, views, grid), ("(1, 2, 3)", "finite")),
        ((negative, views, grid, "product"), ("-0.5 at view 2, row 5, column 7",)),
        ((images, views, grid.affine), ("expected a Grid or a PerspectiveGrid",)),
        ((images, grid, grid), ("Views",)),
    ):
        refused(lambda arguments=arguments: mph.backproject(*arguments), *words)
    for depth, words in (
        (np.ones((4, 3)), ("a function or a list", "ndarray")),
        (pairs[:3], ("each of 4 views", "3")),
        ([array for _, array in pairs], ("view 0", "pair")),
        (swapped, ("view 0", "of another")),
        (below, ("view 3", "0 or more", "column 0, row 0, plane 0")),
    ):
        refused(lambda depth=depth: mph.backproject(images, views, grid, depth=depth), *words)
    refused(lambda: mph.views_that_see(views, (3, 3, 3)), "expected a Grid or a PerspectiveGrid")
    for how in ("sum", "minimum"):
        mph.backproject(negative, views, grid, how)


def derenzo_scores(system, pixels, spacing) -> dict[tuple[str, str], mph.DerenzoScore]:
    """Return scores of Derenzo rods, back-projected from images through ideal holes, and through the scanner's."""
    phantom = mph.DerenzoPhantom(40, (8, 6, 5, 4, 3, 2), 40, 100)
    grid, views = mph.Grid.centered((84, 84, 42), 1.0), system.views((pixels, pixels))
    truth = phantom.voxelize(mph.Grid.centered(np.rint(np.array([84, 84, 42]) / spacing), spacing))
    ideal = mph.Emission(system, hole="point", pixel_points=1, tolerance=1e9)
    scores, settings = {}, {"recipe": {"model": {"kind": "emission"}}}
    for hole, model in (("ideal", ideal), ("real", mph.Emission(system))):
        counts = mph.Projector(truth.grid, views, model)(truth)
        images = mph.run_line_integrals(mph.ProjectionRun(counts, system, views, unit="counts", settings=settings))
        for how in WAYS:
            # Scores are of activity; valley by peak asks for no unit.
            activity = mph.Volume(mph.backproject(images, views, grid, how).array, grid)
            scores[hole, how] = mph.derenzo_score(activity, phantom)
    return scores


@pytest.mark.long
def test_what_was_found(scanner):
    """With ideal holes the product shows the rods of 8 and 6 mm; with the scanner's, no form resolves any."""
    scores = derenzo_scores(scanner, 128, 0.5)
    product = scores["ideal", "product"]
    assert product.rod_diameter.tolist() == [8, 6, 5, 4, 3, 2]
    # The largest rods are few: three pairs are amber.
    assert "red" not in [sector.light for sector in product[:3]] and not product.resolved[3:].any()
    assert (product.valley_to_peak[:2] < 0.735).all() and (product.valley_to_peak[3:] > 0.735).all()
    assert (scores["ideal", "sum"].valley_to_peak > product.valley_to_peak).all()
    for how in WAYS:
        assert (scores["real", how].valley_to_peak > 0.735).all(), how
    for how in ("sum", "product"):
        assert not scores["real", how].resolved.any()
