"""Intervals of the judge hold what they promise, and agree with closed forms."""

import math

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.learning.judging import statistics
from mphdrr.core.learning.judging.observer import channel_outputs, laguerre_gauss, observe
from mphdrr.core.learning.judging.statistics import area_under_curve, difference_of_means, ratio_of_means, wilson

from .conftest import refused


def coverage(draws, interval, truth):
    """Return the share of draws whose interval holds the truth."""
    return np.mean([estimate.low <= truth <= estimate.high for estimate in (interval(*draw) for draw in draws)])


@pytest.mark.long
def test_paired_intervals_hold_the_truth_about_95_times_of_100(monkeypatch):
    monkeypatch.setattr(statistics, "_RESAMPLES", 400)  # enough for the coverage, and ten times as fast
    rng = np.random.default_rng(1)
    hardness = rng.lognormal(0, 0.5, (300, 50))
    pairs = [(0.8 * h * rng.normal(1, 0.1, 50), h * rng.normal(1, 0.1, 50)) for h in hardness]
    assert 0.9 <= coverage(pairs, ratio_of_means, 0.8) <= 0.99
    shifted = [(rng.normal(2, 1, 50), rng.normal(1.5, 1, 50)) for _ in range(300)]
    assert 0.9 <= coverage(shifted, difference_of_means, 0.5) <= 0.99


def test_a_paired_difference_has_the_width_of_a_normal_mean():
    rng = np.random.default_rng(2)
    others = rng.normal(0, 5, 400)
    interval = difference_of_means(others + rng.normal(1, 1, 400), others)  # what both share does not widen it
    assert interval.high - interval.low == pytest.approx(2 * 1.96 / math.sqrt(400), rel=0.1)


def test_a_constant_ratio_has_no_width_and_the_seed_repeats_all():
    values = np.arange(1.0, 20.0)
    np.testing.assert_allclose(ratio_of_means(0.75 * values, values), 0.75)
    noisy = values + np.random.default_rng(3).normal(size=19)
    assert ratio_of_means(noisy, values, seed=4) == ratio_of_means(noisy, values, seed=4)
    refused(lambda: ratio_of_means([], []), "none")


def test_wilson_agrees_with_its_closed_form_and_is_never_empty():
    # z² / (n + z²), and no less than 0
    np.testing.assert_allclose(wilson(0, 200), [0, 0, 1.96**2 / (200 + 1.96**2)], atol=1e-5)
    np.testing.assert_allclose(wilson(81, 263), [0.3080, 0.2553, 0.3662], atol=1e-4)  # Newcombe 1998, table I
    assert math.isnan(wilson(0, 0).value)


def test_area_of_normal_ratings_is_that_of_their_distance():
    rng = np.random.default_rng(5)
    truth = 0.5 * (1 + math.erf(1.2 / 2))  # Phi(d / sqrt 2)
    draws = [(rng.normal(0, 1, 40), rng.normal(1.2, 1, 60)) for _ in range(300)]
    assert 0.9 <= coverage(draws, area_under_curve, truth) <= 0.995
    assert area_under_curve([0, 1], [0, 1]).value == 0.5
    certain = area_under_curve(range(20), range(30, 50))
    assert certain.value == certain.high == 1 and 0.8 < certain.low < 1


@pytest.mark.parametrize("dimensions", [2, 3])
def test_channels_are_orthogonal(dimensions):
    axis = np.linspace(-44, 44, 89)
    points = np.stack(np.meshgrid(*[axis] * dimensions, indexing="ij"), -1).reshape(-1, dimensions)
    channels = laguerre_gauss(np.linalg.norm(points, axis=1), 20.0, 4, dimensions)
    np.testing.assert_allclose(channels.T @ channels, np.eye(4), atol=1e-6)


@pytest.mark.parametrize("sigma", [0.0, 1.0])
def test_the_observer_reaches_the_ideal_snr_in_gaussian_noise(sigma):
    n, count, rng = 23, 20_000, np.random.default_rng(6)
    axis = np.arange(n) - n // 2
    square = axis[:, None] ** 2 + axis**2
    signal = 0.5 * np.exp(-square / (2 * 3.0**2))
    distance = np.minimum(np.abs(axis[:, None] - axis), n - np.abs(axis[:, None] - axis))
    blur = (np.eye(n) + (0.4 * (distance == 1) if sigma else 0)).astype(np.float32)
    ideal = np.linalg.norm(np.linalg.solve(blur, np.linalg.solve(blur, signal).T))  # s^T K^-1 s = |B^-1 s B^-T|²
    channels = laguerre_gauss(np.sqrt(square.ravel()), 3.0 * math.sqrt(2 * math.pi), 6, 2)
    noise = (blur @ rng.standard_normal((count, n, n), np.float32) @ blur.T for _ in range(2))
    outputs = [(images + s).reshape(count, -1) @ channels for images, s in zip(noise, (0, signal), strict=True)]
    observed = observe(*outputs)
    assert observed.snr == pytest.approx(ideal, rel=0.02)
    assert observed.auc.value == pytest.approx(0.5 * (1 + math.erf(ideal / 2)), abs=0.005)


def test_few_images_do_not_flatter_the_observer():
    rng = np.random.default_rng(7)
    areas = [observe(*rng.normal(size=(2, 30, 5))).auc.value for _ in range(60)]
    assert np.mean(areas) == pytest.approx(0.5, abs=0.04)  # there is no signal
    refused(lambda: observe(np.zeros((2, 5)), np.zeros((2, 5))), "more images")


def test_channels_see_a_blob_where_it_is():
    grid = mph.Grid.centered((24, 24, 24), 2.0)
    points = grid.affine[:3, 3] + 2.0 * np.stack(np.meshgrid(*[np.arange(24)] * 3, indexing="ij"), -1)
    place = np.array([5.0, -3.0, 4.0])
    blob = np.exp(-np.pi * np.sum((points - place) ** 2, axis=-1) / 10.0**2)
    outputs = channel_outputs(mph.Volume(blob.astype(np.float32), grid, "activity"), place, 10.0)
    assert abs(outputs[1:]).max() < 0.1 * outputs[0]
