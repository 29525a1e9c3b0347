"""Laws of priors: derivatives, what counts as an edge, voxel sizes, anatomy."""

from itertools import product

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import refused

KINDS = [mph.Quadratic, mph.RelativeDifference, mph.TotalVariation]
SHAPE, SPACING = (4, 5, 6), (1.0, 2.0, 1.5)


@pytest.fixture
def grid():
    return mph.Grid.centered(SHAPE, SPACING)


@pytest.fixture
def anatomy(grid, rng):
    return mph.Volume(rng.integers(0, 3, SHAPE), grid, "mu")


def derivative(function, x, h=1e-5):
    found = np.zeros_like(x)
    for index in np.ndindex(x.shape):
        step = np.zeros_like(x)
        step[index] = h
        found[index] = (function(x + step, index) - function(x - step, index)) / (2 * h)
    return found


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("neighbors", "with_anatomy", "masked"), [(6, True, False), (26, False, False), (6, True, True), (26, True, True)]
)
def test_gradient_and_curvature_are_those_of_the_value(grid, anatomy, rng, kind, neighbors, with_anatomy, masked):
    """Inside any mask, too: what is outside has no effect."""
    inside = rng.random(SHAPE) < (0.6 if masked else 2)
    penalty = kind(0.7, neighbors=neighbors, anatomy=anatomy if with_anatomy else None)
    penalty = penalty.on(grid, inside) if masked else penalty.on(grid)
    x = np.where(inside, rng.uniform(0, 5, SHAPE), 1e3)
    gradient, curvature = penalty.gradient(x), penalty.curvature(x)
    np.testing.assert_allclose(gradient, derivative(lambda y, i: penalty.value(y), x), rtol=1e-6, atol=1e-7)
    second = derivative(lambda y, i: penalty.gradient(y)[i], x)
    assert gradient[inside].any() and not gradient[~inside].any()
    if kind is mph.TotalVariation:
        assert (curvature >= second - 1e-6).all()
    else:
        np.testing.assert_allclose(curvature, second, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("neighbors", "with_anatomy"), [(6, False), (26, True)])
def test_a_penalty_inside_a_box_is_that_of_a_grid_that_ends_there(rng, kind, neighbors, with_anatomy):
    """Value, gradient and curvature, also where slabs of planes meet."""
    shape, box = (9, 70, 80), (slice(2, 8), slice(3, 60), slice(1, 77))
    grid, part = mph.Grid.centered(shape, SPACING), mph.Grid.centered((6, 57, 76), SPACING)
    segments, x = rng.integers(0, 3, shape), rng.uniform(0, 5, shape)
    inside = np.zeros(shape, bool)
    inside[box] = True
    own, other = (
        kind(0.7, neighbors=neighbors, anatomy=mph.Volume(values, place, "mu") if with_anatomy else None)
        for values, place in ((segments, grid), (segments[box], part))
    )
    masked, small = own.on(grid, inside), other.on(part)
    assert masked.value(x) == pytest.approx(small.value(x[box]), rel=1e-6)
    for of_masked, of_small in ((masked.gradient, small.gradient), (masked.curvature, small.curvature)):
        np.testing.assert_allclose(of_masked(x)[box], of_small(x[box]), rtol=1e-6, atol=1e-6)
        assert not of_masked(x)[~inside].any()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("neighbors", [6, 26])
def test_the_value_is_the_sum_that_the_docs_say(grid, rng, kind, neighbors):
    """Over neighbours found by their distances, one by one."""
    x = rng.uniform(0, 5, SHAPE)
    prior = kind(0.7, neighbors=neighbors)
    total = 0.0
    steps = [step for step in product((0, 1), (-1, 0, 1), (-1, 0, 1)) if step > (0, 0, 0)]
    for j in np.ndindex(SHAPE):
        squares = 0.0
        for step in steps:
            k = tuple(np.add(j, step))
            if (neighbors == 6 and np.abs(step).sum() > 1) or not all(
                0 <= i < n for i, n in zip(k, SHAPE, strict=True)
            ):
                continue
            w, d = 1 / np.linalg.norm(np.multiply(step, SPACING)), x[j] - x[k]
            squares += (w * d) ** 2
            if kind is mph.Quadratic:
                total += w * d**2 / 2
            elif kind is mph.RelativeDifference:
                total += w * d**2 / (x[j] + x[k] + 2 * abs(d) + prior.edge)
        if kind is mph.TotalVariation:
            total += np.sqrt(squares + prior.edge**2) - prior.edge
    assert prior.on(grid).value(x) == pytest.approx(0.7 * total, rel=1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("neighbors", [6, 26])
def test_edges_of_the_anatomy_cost_nothing(kind, neighbors):
    """A step along x where the anatomy has one, and one where it has none; large enough for several slabs."""
    grid = mph.Grid.centered((12, 70, 80), 2.0)
    step = (np.arange(12) >= 5)[:, None, None] * np.ones(grid.shape)
    anatomy = mph.Volume(step * 7, grid, "mu")
    aware, plain = (kind(1.0, neighbors=neighbors, anatomy=each).on(grid) for each in (anatomy, None))
    x = 1 + 3 * step
    assert aware.value(x) == 0 and not aware.gradient(x).any()
    assert plain.value(x) > 100 and plain.gradient(x).any()
    shifted = np.roll(x, 1, axis=0)
    shifted[0] = x[0]
    assert aware.value(shifted) == pytest.approx(plain.value(shifted))
    noisy, along = np.random.default_rng(1).uniform(1, 2, (2, *grid.shape))
    slope = (aware.value(noisy + 1e-5 * along) - aware.value(noisy - 1e-5 * along)) / 2e-5
    assert float(np.sum(along * aware.gradient(noisy))) == pytest.approx(slope, rel=1e-6)
    single = aware.gradient(np.float32(noisy))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, aware.gradient(noisy), rtol=1e-3, atol=1e-4)


def test_the_most_similar_neighbours_are_chosen(grid, rng):
    """Without ties and with all neighbours as similar, anatomy changes nothing."""
    x = rng.uniform(0, 5, SHAPE)
    anatomy = mph.Volume(rng.uniform(0, 1, SHAPE), grid, "mu")
    plain = mph.Quadratic(1.0).on(grid).value(x)
    assert mph.Quadratic(1.0, anatomy=anatomy, similar=6).on(grid).value(x) == pytest.approx(plain, rel=1e-6)
    fewer = [mph.Quadratic(1.0, anatomy=anatomy, similar=n).on(grid).value(x) for n in range(1, 7)]
    assert (np.diff(fewer) > 0).all()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: mph.Quadratic(-1), "prior: weight: expected 0 or more"),
        (lambda: mph.Quadratic("much"), "prior: weight: expected real numbers"),
        (lambda: mph.Quadratic(np.nan), "prior: weight: nan is not"),
        (lambda: mph.Quadratic(1, neighbors=18), "prior: neighbors 18: expected one of 6, 26"),
        (lambda: mph.Quadratic(1, anatomy=np.ones(SHAPE)), "prior: anatomy: expected a Volume"),
        (lambda: mph.Quadratic(1, similar=3), "prior: similar needs anatomy"),
        (lambda: mph.RelativeDifference(1, gamma=-1), "prior: gamma: expected 0 or more"),
        (lambda: mph.RelativeDifference(1, edge=0), "prior: edge: expected more than 0 kBq/mL"),
        (lambda: mph.TotalVariation(1, edge=-1), "prior: edge: expected more than 0 kBq/mL"),
    ],
)
def test_wrong_numbers_are_refused(make, words):
    refused(make, words)


def test_anatomy_on_another_grid_is_refused(grid, anatomy):
    refused(lambda: mph.Quadratic(1, anatomy=anatomy).on(mph.Grid.centered(SHAPE, 1.0)), "anatomy's grid is not")
    refused(lambda: mph.Quadratic(1, anatomy=anatomy, similar=7), "prior: similar: expected at most the 6")
