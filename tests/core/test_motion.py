"""Motions found from X rays, against closed forms of a moved body and the scatter of draws of noise."""

import numpy as np
import pytest

import mphdrr.core as mph
from benchmarks.motion import MOTIONS, VIEWS, errors, reference, transmissions


def check(volume, photons, motion, n_draws, tolerance):
    """Compare errors with the stated standard deviations: without noise, on the mean of draws, and their scatter."""
    exact, draws, variances = errors(volume, VIEWS[::2], photons, motion, n_draws)
    stated = np.sqrt(variances.mean(0))
    assert np.abs(exact / stated).max() < 0.3
    assert np.abs((draws.mean(0) - exact) / stated).max() < 3 / np.sqrt(n_draws)  # noise adds no bias
    scatter = np.mean(((draws - draws.mean(0)) / stated) ** 2, 0) * n_draws / (n_draws - 1)
    for part in (slice(3), slice(3, 6)):  # shift, turn
        assert np.sqrt(scatter[part].mean()) == pytest.approx(1, abs=tolerance)


@pytest.mark.parametrize("motion", MOTIONS)
def test_errors_are_those_that_are_stated(motion):
    check(reference(48, 3.0, 4), 100, motion, 25, 0.3)  # 25 draws know a scatter to 0.1 to 0.2


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_bias_is_small_with_1000_photons(motion):
    exact, _, variances = errors(reference(48, 3.0), VIEWS, 1000, motion, 3)
    assert np.abs(exact / np.sqrt(variances.mean(0))).max() < 0.3


def test_a_finder_that_is_kept_is_as_exact_as_a_new_one():
    """The second motion is less than a voxel from the first, where the derivatives of the first would bias it."""
    finder = mph.MotionFinder(reference(48, 3.0, 4), VIEWS[::2], 1000)
    rng = np.random.default_rng(0)
    for truth in ((0.0,) * 6, (1.5, -2.0, 1.0, 0.02, 0.01, -0.03)):
        image = transmissions(VIEWS[::2], truth[:3], truth[3:])
        exact, drawn = (finder(np.log(1000 / x)) for x in (1000 * image, rng.poisson(1000 * image)))
    error = np.array([*exact.shift, *exact.rotation]) - truth
    assert np.abs(error / np.sqrt(np.diag(drawn.covariance))).max() < 0.3


@pytest.mark.parametrize(("n", "spacing", "n_poses"), [(48, 3.0, 3), pytest.param(72, 2.0, 8, marks=pytest.mark.long)])
def test_errors_by_voxels_are_stated_when_noise_is_small(n, spacing, n_poses):
    volume, rng = reference(n, spacing, 4), np.random.default_rng(5)
    motions = rng.uniform(-1, 1, (n_poses, 6)) * np.repeat([4, 0.04], 3)  # mm, rad
    images = [transmissions(VIEWS[::2], truth[:3], truth[3:]) for truth in motions]
    for photons in (1e4, 1e6):
        squares = np.zeros((n_poses, 6))
        for i, truth in enumerate(motions):
            counts = rng.poisson(photons * images[i])
            motion = mph.find_motion(volume, np.log(photons / counts), VIEWS[::2], photons)
            squares[i] = ([*motion.shift, *motion.rotation] - truth) ** 2 / np.diag(motion.covariance)
        for part in (slice(3), slice(3, 6)):  # shift, turn
            assert 0.3 < np.sqrt(squares[:, part].mean()) < 1.3


@pytest.mark.long
@pytest.mark.parametrize("motion", MOTIONS)
def test_standard_deviations_are_right_to_15_per_cent(motion):
    check(reference(72, 2.0), 200, motion, 120, 0.15)
