"""BSREM, and one-step-late priors: their optimum, found by others too."""

import warnings
from typing import NamedTuple

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.reconstruction.priors import Penalty

from .conftest import refused

PRIORS = [mph.Quadratic(0.1), mph.RelativeDifference(2.0), mph.TotalVariation(1.0, edge=5.0)]


ANATOMY = mph.Volume(np.ones((2, 2, 2)), mph.Grid.centered(2, 1), "mu")


class Problem(NamedTuple):
    A: mph.Projector
    counts: np.ndarray
    background: float

    def images(self, x):
        return self.A(x).astype(float) + self.background

    def objective(self, x, penalty: Penalty | None = None):
        expected = self.images(x)
        logs = np.log(expected, out=np.zeros_like(expected), where=expected > 0)
        return float((self.counts * logs).sum() - expected.sum()) - (penalty.value(x) if penalty else 0.0)

    def gradient(self, x, penalty: Penalty | None = None):
        expected = self.images(x)
        ratio = np.divide(self.counts, expected, out=np.zeros_like(expected), where=expected > 0)
        gradient = self.A.T((ratio - 1).astype(np.float32))
        return gradient - (penalty.gradient(x) if penalty else 0)


def make(scanner, n, pixels, every):
    """Return noisy counts of a Derenzo phantom around a box of half its activity."""
    system = scanner[::every]
    grid = mph.Grid.centered(n, 96 / n)
    with pytest.warns(mph.InputWarning):
        A = mph.Projector(
            grid,
            system.views((pixels, pixels), detector="real"),
            mph.Emission(system, time=120.0, hole="point", pixel_points=4, intrinsic_fwhm=2.0),
            threads=1,
        )
    truth = 50 * mph.DerenzoPhantom(40, (14, 12, 10, 8, 6, 5), 40).voxelize(grid).array
    truth[n // 3 : n // 2, n // 3 : n // 2, n // 3 : n // 2] += 25
    return Problem(A, mph.sample_counts(A(truth) + 0.3, 3), 0.3)


@pytest.fixture(scope="module")
def small(scanner):
    return make(scanner, 8, 10, 8)


def optimum(problem, penalty, scale, iterations=3000):
    """Return the optimum by L-BFGS-B, an algorithm and a program that have nothing in common with ours."""
    optimize = pytest.importorskip("scipy.optimize")
    shape = problem.A.shape_in

    def negative(z):
        x = (z * scale).reshape(shape).astype(np.float32)
        return -problem.objective(x, penalty), -(problem.gradient(x, penalty).ravel() * scale).astype(float)

    options = {"maxiter": iterations, "maxfun": 2 * iterations, "maxcor": 30, "ftol": 1e-15, "gtol": 1e-7}
    found = optimize.minimize(
        negative, np.ones(scale.size), jac=True, method="L-BFGS-B", bounds=[(0, None)] * scale.size, options=options
    )
    return (found.x * scale).reshape(shape), -found.fun


def compare_with_optimum(problem, prior, subsets, iterations):
    penalty = None if prior is None else prior.on(problem.A.grid)
    found = mph.bsrem(problem.A, problem.counts, iterations, subsets, prior, background=problem.background)
    scale = np.sqrt(np.maximum(found.volume.array.ravel(), 0.1)).astype(float)
    best, best_value = optimum(problem, penalty, scale)
    assert found.objective[-1] == pytest.approx(problem.objective(found.volume.array, penalty), rel=1e-7)
    assert found.objective[-1] >= best_value - 1e-6 * abs(best_value)
    if prior is not None:  # without one many volumes are about as likely
        assert np.linalg.norm(found.volume.array - best) <= 1e-3 * np.linalg.norm(best)
    return found, best


@pytest.mark.long
@pytest.mark.parametrize("prior", PRIORS, ids=lambda prior: type(prior).__name__)
def test_it_ends_at_the_optimum(small, prior):
    found, _ = compare_with_optimum(small, prior, 5, 60)
    assert (np.diff(found.objective[1:]) >= -1e-8 * np.abs(found.objective[2:])).all()


@pytest.mark.long
def test_it_ends_at_the_optimum_of_16_voxels_a_side(scanner):
    problem = make(scanner, 16, 16, 4)
    found, best = compare_with_optimum(problem, mph.RelativeDifference(1.0), 5, 150)
    assert np.linalg.norm(found.volume.array - best) <= 1e-4 * np.linalg.norm(best)


@pytest.mark.long
def test_without_prior_it_is_as_likely_as_mlem_gets(small):
    ours = mph.bsrem(small.A, small.counts, 50, 5, background=small.background)
    mlem = mph.mlem(small.A, small.counts, 250, background=small.background)
    assert ours.objective[-1] >= mlem.objective[-1] - 1e-6 * abs(mlem.objective[-1])


@pytest.mark.long
def test_a_prior_of_no_weight_is_none(small):
    given = (small.A, small.counts, 3, 2)
    plain = mph.bsrem(*given, background=0.3)
    np.testing.assert_array_equal(plain.volume.array, mph.bsrem(*given, mph.Quadratic(0), background=0.3).volume.array)
    plain = mph.osem(*given, background=0.3)
    late = mph.osem(*given, background=0.3, prior=mph.Quadratic(0))
    np.testing.assert_array_equal(plain.volume.array, late.volume.array)


@pytest.mark.parametrize("prior", PRIORS[1:2], ids=lambda prior: type(prior).__name__)
def test_one_step_late_ends_at_the_same_optimum(small, prior):
    """With one subset, where the prior is weak enough for it to end at all."""
    weak = type(prior)(prior.weight / 4)
    best = mph.bsrem(small.A, small.counts, 40, 5, weak, background=0.3)
    late = mph.mlem(small.A, small.counts, 120, 0.3, prior=weak)
    assert late.objective[-1] == pytest.approx(best.objective[-1], rel=1e-4)
    assert np.linalg.norm(late.volume.array - best.volume.array) <= 5e-2 * np.linalg.norm(best.volume.array)


def test_a_prior_that_is_too_strong_stays_positive(small):
    found = mph.osem(small.A, small.counts, 5, 4, mph.Quadratic(1e4), background=0.3).volume.array
    assert np.isfinite(found).all() and (found >= 0).all() and found.any()
    found = mph.bsrem(small.A, small.counts, 5, 4, mph.Quadratic(1e4), background=0.3).volume.array
    assert found.std() < 0.05 * found.mean()


@pytest.fixture(scope="module")
def even(scanner):
    """Return exact counts of 10 everywhere in a mask, a ball off centre, in a grid whose corners no module sees."""
    system = scanner[::8]
    grid = mph.Grid.centered((12, 11, 10), (14.0, 14.0, 30.0))
    with pytest.warns(mph.InputWarning):
        A = mph.Projector(
            grid, system.views((16, 16), "real"), mph.Emission(system, time=3e5, hole="point", pixel_points=4)
        )
    x, y, z = grid.affine[:3, 3, None, None, None] + np.indices(grid.shape) * grid.spacing[:, None, None, None]
    mask = (x - 5) ** 2 + (y + 7) ** 2 + z**2 < 62**2
    return A, mask, A(10.0 * mask)


@pytest.mark.parametrize("prior", [mph.RelativeDifference, mph.TotalVariation])
@pytest.mark.parametrize(("neighbors", "weight"), [pytest.param(6, 50.0, marks=pytest.mark.long), (26, 2.0)])
def test_a_uniform_volume_in_its_mask_stays_so_up_to_its_edge(even, prior, neighbors, weight):
    A, mask, counts = even
    penalty = prior(weight, neighbors=neighbors)
    for method, rounds, least in ((mph.bsrem, 8, 1e-3), (mph.osem, 8, 1e-2), (mph.mlem, 16, 1e-2)):
        more = {} if method is mph.mlem else {"subsets": 2}
        found = method(A, counts, rounds, prior=penalty, mask=mask, **more).volume.array
        assert np.abs(found[mask] / 10 - 1).max() < least and not found[~mask].any(), method.__name__


@pytest.mark.parametrize("method", [mph.osem, mph.mlem])
def test_a_prior_too_strong_for_one_step_late_is_said(even, method):
    A, mask, counts = even
    with pytest.warns(mph.InputWarning, match=r"^prior: too strong for one step late in \d+% of the voxels") as said:
        found = method(A, counts, 20, prior=mph.Quadratic(3e4), mask=mask).volume.array
    assert len(said) == 1 and np.ptp(found[mask]) > 20, "it is indeed not the volume, which is even"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.ptp(method(A, counts, 8, prior=mph.Quadratic(50.0), mask=mask).volume.array[mask]) < 1


@pytest.mark.parametrize("prior", [mph.Quadratic(30.0), mph.RelativeDifference(30.0), mph.TotalVariation(30.0)],
                         ids=lambda prior: type(prior).__name__)  # fmt: skip
def test_voxels_that_no_module_sees_pull_at_none(even, prior):
    A = even[0]
    unseen = A.T(np.ones(A.shape_out, np.float32)) == 0
    assert 0.05 < unseen.mean() < 0.9
    found = mph.bsrem(A, A(np.full(A.shape_in, 10.0)), 10, 2, prior).volume.array
    assert np.abs(found[~unseen] / 10 - 1).max() < 1e-3 and not found[unseen].any()


def test_relaxed_steps_are_shorter_and_zeros_and_masks_are_kept(small):
    start = np.ones(small.A.shape_in)
    start[:3] = 0
    mask = np.ones(small.A.shape_in, bool)
    mask[:, :2] = False
    found = mph.bsrem(small.A, small.counts, 10, 2, PRIORS[0], step_decay=0.5, start=start, mask=mask)
    assert not found.volume.array[:, :2].any() and (found.volume.array[:3, 2:] > 0).any()
    assert found.settings["step_decay"] == 0.5 and found.settings["prior"] == "Quadratic"


def test_no_counts_are_no_activity(small):
    found = mph.bsrem(small.A, np.zeros_like(small.counts), 3, 2, PRIORS[1])
    assert not found.volume.array.any() and np.isfinite(found.objective).all()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"subsets": 11}, "subsets: expected at most the 10 views, got 11"),
        ({"subsets": 0}, "subsets: expected a whole number"),
        ({"prior": 3}, "prior: expected Quadratic, RelativeDifference or TotalVariation, got int"),
        ({"prior": mph.Quadratic}, "prior: expected Quadratic"),
        ({"prior": mph.Quadratic(1, anatomy=ANATOMY)}, "prior: anatomy's grid"),
    ],
)
@pytest.mark.parametrize("method", [mph.osem, mph.bsrem])
def test_what_cannot_be_is_refused(small, method, given, words):
    refused(lambda: method(small.A, small.counts, 1, **given), words)
    refused(lambda: mph.bsrem(small.A, small.counts, 1, step_decay=-1), "step_decay: expected 0 or more")


@pytest.mark.long
@pytest.mark.parametrize("prior", PRIORS, ids=lambda prior: type(prior).__name__)
def test_the_rule_that_the_page_names_leaves_no_voxel_far_from_the_maximum(small, prior):
    """While 1e-6 of the objective may be a few percent of a voxel."""
    given = (small.A, small.counts, 150, 2, prior)
    best = mph.bsrem(*given, background=0.3).volume.array
    mean = best[best > 0.1 * best.max()].mean()
    found = mph.bsrem(*given, background=0.3, stop=mph.StopWhen(change=1e-8))
    assert found.settings["stopped"] == "change" and found.iterations < 100
    assert np.abs(found.volume.array - best).max() < 0.01 * mean
