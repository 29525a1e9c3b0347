"""SIRT, CGLS and TV: falling objectives, known solutions, resuming, and what they are given."""

import functools
import re
import warnings

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import mphdrr.core as mph
from mphdrr.core.reconstruction.tv import _gradient, _gradient_adjoint, total_variation

from .conftest import refused

GRID = mph.Grid.centered((7, 6, 5), (2.0, 2.0, 3.0))
VIEWS = mph.parallel_views(np.arange(12) * np.pi / 12, (10, 14), 1.5, elevation=np.tile([0.0, 0.5], 6))
A = mph.Projector(GRID, VIEWS)
RNG = np.random.default_rng(0)
TRUTH = np.zeros(GRID.shape, np.float32)
TRUTH[2:5, 1:5, 1:4] = 1.0
TRUTH[3, 3, 2] = 3.0
IMAGES = A(TRUTH)
NOISY = IMAGES + RNG.normal(0, 0.5, IMAGES.shape).astype(np.float32)


def matrix():
    """Return `A` as a dense matrix."""
    unit = np.eye(GRID.n_voxels, dtype=np.float32).reshape(-1, *GRID.shape)
    return np.stack([A(x).ravel() for x in unit], axis=1).astype(float)


ALGORITHMS = {"sirt": mph.sirt, "cgls": mph.cgls, "tv": functools.partial(mph.tv, weight=0.5)}


@pytest.mark.parametrize("nonnegative", [True, False])
@pytest.mark.parametrize("relaxation", [1.0, 1.9])
def test_sirts_objective_never_rises_and_is_what_it_says(nonnegative, relaxation):
    result = mph.sirt(A, NOISY, 60, relaxation, nonnegative)
    assert len(result.objective) == result.iterations == 60
    assert (np.diff(result.objective) <= 1e-6 * result.objective[:-1]).all()
    x = result.volume.array
    assert (x.min() >= 0) == nonnegative
    sums = A(np.ones(GRID.shape, np.float32))
    weights = np.divide(1, sums, out=np.zeros_like(sums), where=sums > 0)
    assert result.objective[-1] == pytest.approx(0.5 * np.sum(weights * (NOISY - A(x)) ** 2), rel=1e-4)
    assert result.volume.quantity == "mu"
    assert result.settings["method"] == "SIRT"


def test_sirt_finds_the_truth_of_exact_images():
    result = mph.sirt(A, IMAGES, 400, relaxation=1.9)
    assert np.sqrt(np.mean((result.volume.array - TRUTH) ** 2)) < 0.03


@pytest.mark.long
def test_cgls_reaches_the_solution_of_numpys_lstsq():
    solution = np.linalg.lstsq(matrix(), NOISY.ravel().astype(float), rcond=None)[0].reshape(GRID.shape)
    result = mph.cgls(A, NOISY, 200)
    np.testing.assert_allclose(result.volume.array, solution, atol=1e-3)
    assert (np.diff(result.objective) <= 1e-6 * result.objective[:-1]).all()
    residual = 0.5 * np.sum((A(result.volume.array) - NOISY) ** 2)
    assert result.objective[-1] == pytest.approx(residual, rel=1e-4)


def cgls_of_double_precision(B, images, iterations, mask):
    """Return the volume after each iteration of the textbook's CGLS over the float64 reference."""
    B = mph.Projector(B.grid, B.views, B.model, backend="numpy")
    x, residual = np.zeros(B.shape_in), images.astype(float)
    direction = B.T(residual) * mask
    size, found = np.sum(direction**2), []
    for _ in range(iterations):
        change = B(direction)
        length = size / np.sum(change**2)
        x, residual = x + length * direction, residual - length * change
        gradient = B.T(residual) * mask
        before, size = size, np.sum(gradient**2)
        direction = gradient + size / before * direction
        found.append(x)
    return found


@pytest.mark.long
@pytest.mark.parametrize("case", ["few views", "scanner", "scanner in a mask", "even"])
def test_cgls_keeps_to_double_precision_or_says_where_it_leaves_it(case, scanner):
    rng = np.random.default_rng(7)
    grid = mph.Grid.centered((11, 12, 9), 9.0)
    if case == "few views":
        B = mph.Projector(grid, mph.parallel_views(np.arange(9) * np.pi / 9 + 0.1, (11, 16), 7.0))
    else:
        B = mph.Projector(grid, scanner[::6].views((14, 14)))
    truth = gaussian_filter(rng.random(grid.shape), 1.0).astype(np.float32)
    if case == "even":
        truth += 100
    mask = truth > np.median(truth) if case == "scanner in a mask" else np.ones(grid.shape, bool)
    images = B(truth * mask)
    images += (0.02 * images.std() * rng.standard_normal(images.shape)).astype(np.float32)
    seen = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        mph.cgls(B, images, 30, mask=mask, callback=lambda i, x: seen.append(x) and None)
    expected = cgls_of_double_precision(B, images, 30, mask)
    errors = np.array([np.linalg.norm(a - b) / np.linalg.norm(b) for a, b in zip(seen, expected, strict=True)])
    said = [int(re.search(r"CGLS: from iteration (\d+) on rounding", str(each.message))[1]) for each in caught]
    assert len(said) <= 1, "it is said once"
    kept = said[0] - 1 if said else 30
    assert kept >= 6 and (errors[:kept] < 1e-3).all()
    assert len(said) == (errors.max() > 1e-3) or errors.max() > 1e-4, "and not of what keeps to it"


def test_what_cgls_says_of_its_way_it_says_once_when_resumed_too():
    with pytest.warns(mph.InputWarning, match="CGLS: from iteration"):
        first = mph.cgls(A, NOISY, 20)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mph.cgls(A, NOISY, 5)
        mph.cgls(A, NOISY, 10, start=first)


def test_cgls_is_much_faster_than_sirt():
    def misfit(x):
        return np.sum((A(x) - IMAGES) ** 2)

    assert misfit(mph.cgls(A, IMAGES, 12).volume.array) < 0.2 * misfit(mph.sirt(A, IMAGES, 12).volume.array)


def test_cgls_stays_where_nothing_is_left_to_do():
    result = mph.cgls(A, np.zeros_like(IMAGES), 5)
    assert not result.volume.array.any() and not result.objective.any()


def test_the_gradients_adjoint_is_exact():
    factors = np.array([1.0, 0.7, 0.4])
    x, p = RNG.random((4, 5, 6)), RNG.random((3, 4, 5, 6))
    assert np.vdot(_gradient(x, factors), p) == pytest.approx(np.vdot(x, _gradient_adjoint(p, factors)), rel=1e-12)


def test_total_variation_of_a_block_is_its_surface():
    grid = mph.Grid.centered((9, 9, 9), 1.0)
    block = np.zeros(grid.shape)
    block[3:6, :, :] = 2.0
    assert total_variation(block, grid) == pytest.approx(2 * 2.0 * 81)
    ramp = np.ones((4, 1, 1)) * np.arange(3)[None, :, None] * np.ones((1, 1, 5))
    assert total_variation(ramp, mph.Grid.centered((4, 3, 5), (1, 2, 1))) == pytest.approx(4 * 2 * 5 / 2)


@pytest.mark.parametrize(("weight", "nonnegative"), [(0.3, True), pytest.param(5.0, False, marks=pytest.mark.long)])
def test_tv_reaches_the_minimum_that_another_solver_finds(weight, nonnegative):
    optimize = pytest.importorskip("scipy.optimize")
    dense, measured = matrix(), NOISY.ravel().astype(float)
    factors = GRID.spacing.min() / GRID.spacing

    def smoothed(x, edge=3e-4):
        residual = dense @ x - measured
        slopes = _gradient(x.reshape(GRID.shape), factors)
        sizes = np.sqrt(np.sum(slopes**2, axis=0) + edge**2)
        gradient = dense.T @ residual + weight * _gradient_adjoint(slopes / sizes, factors).ravel()
        return 0.5 * residual @ residual + weight * np.sum(sizes - edge), gradient

    bounds = [(0, None) if nonnegative else (None, None)] * GRID.n_voxels
    best = optimize.minimize(smoothed, np.zeros(GRID.n_voxels), jac=True, method="L-BFGS-B", bounds=bounds,
                             options={"maxiter": 1000, "maxfun": 1200, "maxcor": 30, "ftol": 1e-13})  # fmt: skip
    result = mph.tv(A, NOISY, weight, 800, nonnegative)
    x = result.volume.array
    least = smoothed(best.x, 0.0 + 1e-12)[0]
    assert result.objective[-1] == pytest.approx(least, rel=1e-3)
    exact = 0.5 * np.sum((A(x) - NOISY) ** 2, dtype=float) + weight * total_variation(x, GRID)
    assert result.objective[-1] == pytest.approx(exact, rel=1e-4)
    assert not nonnegative or x.min() >= 0


@pytest.mark.parametrize("weight", [2.0, 500.0])
def test_tv_does_not_pull_at_the_edge_of_a_mask_or_of_what_is_seen(weight):
    grid = mph.Grid.centered((16, 14, 8), (3.0, 3.0, 6.0))
    x, y, _ = np.indices(grid.shape)
    mask = (x - 7) ** 2 + (y - 6) ** 2 < 30
    images = mph.parallel_views(np.arange(16) * np.pi / 16, (16, 26), 3.0)
    B = mph.Projector(grid, images)
    found = mph.tv(B, B(7.0 * mask), weight, 80, mask=mask).volume.array
    assert np.abs(found[mask] / 7 - 1).max() < 2e-3
    narrow = mph.Projector(grid, mph.parallel_views(np.arange(16) * np.pi / 16, (4, 26), 3.0))  # 12 of 48 mm along z
    seen = narrow.T(np.ones(narrow.shape_out, np.float32)) > 0
    assert 0.2 < seen.mean() < 0.6
    found = mph.tv(narrow, narrow(np.full(grid.shape, 7.0, np.float32)), weight, 80).volume.array
    assert np.abs(found[seen] / 7 - 1).max() < 2e-3 and not found[~seen].any()


def test_tv_is_nearer_to_the_truth_than_least_squares_with_few_noisy_views():
    rng = np.random.default_rng(5)
    grid = mph.Grid.centered((24, 24, 3), 1.0)
    truth = np.zeros(grid.shape, np.float32)
    truth[6:18, 8:16] = 1.0
    few = mph.Projector(grid, mph.parallel_views(np.arange(9) * np.pi / 9, (3, 36), 1.0))
    images = few(truth) + rng.normal(0, 0.4, few.shape_out)
    flat = mph.tv(few, images, 1.0, 200).volume.array
    rough = mph.sirt(few, images, 200).volume.array
    assert np.mean((flat - truth) ** 2) < 0.3 * np.mean((rough - truth) ** 2)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_other_images_views_or_masks_cannot_go_on_with_what_is_known_of_the_first(name):
    run = ALGORITHMS[name]
    half = run(A, NOISY, iterations=2)
    fewer = mph.Projector(GRID, A.views[1:])
    mask = np.zeros(GRID.shape, bool)
    mask[1:] = True
    turned = mph.Projector(GRID, A.views[::-1])
    for other, images, more in (
        (A, NOISY + 1, {}), (fewer, NOISY[1:], {}), (A, NOISY, {"mask": mask}), (turned, NOISY[::-1], {})
    ):  # fmt: skip
        call = functools.partial(run, other, images, iterations=1, **more)
        refused(lambda call=call: call(start=half), "start: this reconstruction is of other images, views or mask")
        assert call(start=half.volume).iterations == 1
    assert run(A, NOISY, iterations=1, start=half).iterations == 3


def test_other_arguments_cannot_go_on_with_what_is_known_of_the_first(scanner):
    other_views = mph.Projector(A.grid, A.views[::-1])
    system, grid, blank = scanner[:2], mph.Grid.centered((4, 4, 4), 20.0), np.ones((2, 5, 5), np.float32)
    B, other_model = (
        mph.Projector(grid, system.views((5, 5)), m) for m in (mph.Transmission(), mph.InverseSquareSum(system))
    )
    for method, first, other, said in (
        (mph.sirt, (A, NOISY, 2), (A, NOISY, 1, 1.5), "relaxation 1.0, now 1.5"),
        (mph.sirt, (A, NOISY, 2), (A, NOISY, 1, 1.0, False), "nonnegative True, now False"),
        (mph.tv, (A, NOISY, 0.5, 2), (A, NOISY, 0.7, 1), "weight 0.5, now 0.7"),
        (mph.sirt, (A, NOISY, 2), (other_views, NOISY, 1), "views "),
        (mph.cgls, (A, NOISY, 2), (other_views, NOISY, 1), "views "),
        (mph.tv, (B, blank, 0.5, 2), (other_model, blank, 0.5, 1), "model transmission, now"),
    ):
        call = functools.partial(method, *other, start=method(*first))
        refused(call, f"start: .*{re.escape(said)}.*give its volume")


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_truth_is_a_start_that_is_kept_and_little_change_ends_it(name):
    started = ALGORITHMS[name](A, IMAGES, iterations=2, start=mph.Volume(TRUTH, GRID, "activity"))
    np.testing.assert_allclose(started.volume.array, TRUTH, atol=0.15 if name == "tv" else 1e-3)
    assert started.volume.quantity == "activity"
    stopped = ALGORITHMS[name](A, NOISY, iterations=500, stop=mph.StopWhen(change=1e-3))
    assert stopped.iterations < 500 and stopped.settings["stopped"] == "change"


@pytest.mark.long
@pytest.mark.parametrize("name", ALGORITHMS)
def test_counts_of_pinholes_lose_their_background(name):
    angles = np.arange(8) * np.pi / 4
    places = 60 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    system = mph.PinholeSystem(places, *np.outer([4.0, 40, 60, 5, 20], np.ones(8)))
    grid = mph.Grid.centered(5, 6.0)
    B = mph.Projector(grid, system.views((8, 8), "real"), mph.Emission(system, background=50.0, time=1000.0))
    truth = np.zeros(grid.shape, np.float32)
    truth[1:4, 2:4, 2] = 10.0
    counts = B(truth) + 50.0
    result = ALGORITHMS[name](B, counts, iterations=15)
    assert result.volume.quantity == "activity"
    assert B(truth).mean() > 10
    assert np.abs(B(result.volume.array) + 50.0 - counts).mean() < 0.4 * B(truth).mean()


def test_wrong_numbers_are_named():
    for relaxation in (0, 2, np.nan):
        refused(lambda relaxation=relaxation: mph.sirt(A, IMAGES, relaxation=relaxation), "relaxation")
    for weight in (0, -1, np.inf):
        refused(lambda weight=weight: mph.tv(A, IMAGES, weight), "weight")
    refused(lambda: mph.sirt(A, IMAGES, nonnegative="yes"), "nonnegative: expected a bool")
    for name in ("sirt", "tv"):
        refused(lambda name=name: ALGORITHMS[name](A, IMAGES, start=-TRUTH), "start: expected 0 or more")
    assert mph.cgls(A, IMAGES, 1, start=-TRUTH).volume.array.min() < 0
