"""Motions found from X rays, against closed forms of a moved body and the scatter of draws of noise."""

import numpy as np
import pytest

from benchmarks.motion import MOTIONS, VIEWS, errors, reference


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


@pytest.mark.long
@pytest.mark.parametrize("motion", MOTIONS)
def test_standard_deviations_are_right_to_15_per_cent(motion):
    check(reference(72, 2.0), 200, motion, 120, 0.15)
