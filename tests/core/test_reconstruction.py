"""Laws of reconstruction: the likelihood never falls, totals, fixed points, subsets, breaks."""

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.projector.subsets import access_order, balanced_subsets


@pytest.fixture(scope="module")
def problem(scanner):
    system = scanner[::4]
    grid = mph.Grid.centered(16, 5.0)
    A = mph.Projector(grid, system.views((16, 16), detector="real"), mph.Emission(system, time=600.0, pixel_points=4))
    rng = np.random.default_rng(1)
    truth = np.zeros(grid.shape, np.float32)
    truth[4:12, 4:12, 4:12] = rng.uniform(20, 100, (8, 8, 8))
    return A, truth


@pytest.mark.parametrize("background", [0.0, 0.7])
def test_the_likelihood_never_falls_and_totals_are_the_measured(problem, background):
    A, truth = problem
    counts = mph.sample_counts(A(truth) + background, 3)
    totals = []
    found = mph.mlem(A, counts, 12, background, callback=lambda i, x: totals.append(float(A(x).sum(dtype=float))))
    assert (np.diff(found.objective) >= -1e-6 * np.abs(found.objective[1:])).all() and found.iterations == 12
    if not background:
        np.testing.assert_allclose(totals, counts.sum(), rtol=1e-5)


def test_the_truth_is_a_fixed_point(problem):
    A, truth = problem
    found = mph.mlem(A, A(truth) + 0.5, 3, 0.5, start=truth)
    np.testing.assert_allclose(found.volume.array, truth, rtol=1e-5, atol=1e-5 * truth.max())


def test_one_subset_is_mlem_and_a_break_changes_nothing(problem):
    A, truth = problem
    counts = mph.sample_counts(A(truth), 5)
    whole = mph.mlem(A, counts, 4)
    np.testing.assert_array_equal(mph.osem(A, counts, 4, subsets=1).volume.array, whole.volume.array)
    half = mph.mlem(A, counts, 2)
    np.testing.assert_array_equal(mph.mlem(A, counts, 2, start=half.volume).volume.array, whole.volume.array)
    faster = mph.osem(A, counts, 2, subsets=4)
    assert faster.objective[-1] > whole.objective[1]


def test_subsets_say_which_views_they_hold(problem):
    A, truth = problem
    images = A(truth)
    for n in (1, 3):
        parts = A.subsets(n)
        assert sorted(np.concatenate([part.which for part in parts])) == A.which.tolist() == list(range(len(A.views)))
        for part in parts:
            np.testing.assert_allclose(part(truth), images[part.which], rtol=1e-6)
            with pytest.raises(ValueError, match="read-only"):
                part.which[0] = 0
    half = A.subsets(2)[1]  # a part's own parts say which of its views they hold
    np.testing.assert_array_equal([half.which[part.which] for part in half.subsets(1)], [half.which])


@pytest.mark.parametrize("n", [1, 3, 7, 16, 20, 80])
def test_subsets_are_balanced(scanner, n):
    views = scanner.views((2, 2))
    found = balanced_subsets(views, n)
    assert sorted(np.concatenate(found)) == list(range(80)) and sorted(access_order(n)) == list(range(n))
    sizes = [len(each) for each in found]
    assert max(sizes) - min(sizes) <= 1
    rings = np.array([np.bincount(scanner.rings()[each], minlength=4) for each in found])
    assert (rings.max(axis=0) - rings.min(axis=0) <= 2).all()
