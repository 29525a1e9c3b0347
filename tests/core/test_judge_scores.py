"""Scores of the judge: right for the truth, whatever the counts, the pose and the place."""

from __future__ import annotations

import math

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.learning.judging.consistency import expected_deviance, relative_deviance
from mphdrr.core.learning.judging.rods import rod_contrasts


@pytest.mark.parametrize("mean", [0.003, 0.1, 1.0, 7.0, 49.0, 51.0, 400.0])
def test_true_means_have_a_deviance_of_1_at_any_counts(mean):
    counts = np.random.default_rng(1).poisson(mean, 400_000)
    assert relative_deviance(counts, np.full(counts.shape, mean)) == pytest.approx(1, abs=0.02)


def test_wrong_means_deviate_more_and_fitted_ones_less():
    rng = np.random.default_rng(2)
    means = rng.uniform(0.05, 3, 100_000)
    counts = rng.poisson(means)
    assert relative_deviance(counts, 1.5 * means) > 1.02
    assert relative_deviance(counts, 0.9 * means + 0.1 * counts) < 1
    assert np.isfinite(relative_deviance([3.0, 0.0], [0.0, 0.0]))


def test_the_expected_deviance_has_its_limits():
    few = 1e-6
    assert expected_deviance(few) == pytest.approx(-2 * few * math.log(few), rel=0.01)
    assert expected_deviance(1e4) == pytest.approx(1, abs=1e-4)
    assert expected_deviance(49.9) == pytest.approx(expected_deviance(50.1), abs=1e-4)


def test_rods_of_the_truth_have_all_of_their_contrast_and_empty_places_none():
    phantom = mph.DerenzoPhantom(
        36.0, (11.0, 10.0, 9.0, 8.0, 7.0, 6.0), 30.0, activity=80.0, cylinder_radius=40.0, background=20.0
    )
    pose = mph.random_pose(4, box=4)
    truth = phantom.voxelize(mph.Grid.centered((120,) * 3, 0.8), pose)
    np.testing.assert_allclose(rod_contrasts(truth, phantom, pose, phantom.rods()), 1, atol=0.12)
    half = mph.Volume(0.5 * truth.array + 3, truth.grid, "activity")
    np.testing.assert_allclose(rod_contrasts(half, phantom, pose, phantom.rods()), 0.5, atol=0.06)
    water = mph.DerenzoPhantom(36.0, (11.0, 0, 0, 0, 0, 0), 30.0, activity=20.0, cylinder_radius=40.0, background=20.0)
    empty = water.voxelize(truth.grid, pose)
    np.testing.assert_allclose(rod_contrasts(empty, phantom, pose, phantom.rods()), 0, atol=0.01)


@pytest.mark.parametrize("look", ["solids", "lumps"])
def test_mixtures_follow_from_their_seed_and_stay_in_their_ball(look):
    grid = mph.Grid.centered((24, 24, 24), 5.0)
    one, again, other = (
        mph.MixturePhantom(seed=seed, number=30, radius=40, look=look).voxelize(grid).array for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)
    distance = np.linalg.norm(np.moveaxis(np.indices(grid.shape), 0, -1) * 5.0 + grid.affine[:3, 3], axis=-1)
    assert one.any() and not one[distance > 40 + 5].any()
