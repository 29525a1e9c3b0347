"""Scores of the judge: right for the truth, whatever the counts, the pose and the place."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.learning.judging import rods
from mphdrr.core.learning.judging.consistency import expected_deviance, relative_deviance
from mphdrr.core.learning.judging.rods import rod_contrasts
from mphdrr.core.learning.judging.scoring import SCORINGS, Case
from mphdrr.core.learning.judging.summary import compare_scores, mean_scores, row_notes
from mphdrr.core.phantoms import painting


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


WATER = {"cylinder_radius": 40.0, "background": 20.0}
DIAMETERS = (11.0, 10.0, 9.0, 8.0, 7.0, 6.0)


def test_rods_of_the_truth_have_all_of_their_contrast_and_empty_places_none():
    phantom, pose = mph.DerenzoPhantom(36.0, DIAMETERS, 30.0, activity=80.0, **WATER), mph.random_pose(4, box=4)
    truth = phantom.voxelize(mph.Grid.centered((120,) * 3, 0.8), pose)
    half = mph.Volume(0.5 * truth.array + 3, truth.grid, "activity")
    water = mph.DerenzoPhantom(36.0, (11.0, 0, 0, 0, 0, 0), 30.0, activity=20.0, **WATER).voxelize(truth.grid, pose)
    for volume, contrast, tolerance in ((truth, 1, 0.12), (half, 0.5, 0.06), (water, 0, 0.01)):
        contrasts = rod_contrasts(volume, phantom, pose, phantom.rods())
        np.testing.assert_allclose(contrasts, contrast, atol=tolerance)


@pytest.mark.long
@pytest.mark.parametrize("look", ["solids", "lumps"])
def test_mixtures_follow_from_their_seed_and_stay_in_their_ball(look, monkeypatch):
    monkeypatch.setattr(painting, "_SAMPLES_OF_OVERLAP", 1 << 13)  # totals to some percent are enough
    grid = mph.Grid.centered((24, 24, 24), 5.0)
    phantoms = (mph.MixturePhantom(seed=seed, number=10, radius=40, look=look) for seed in (1, 1, 2))
    array, same, other = (phantom.voxelize(grid).array for phantom in phantoms)
    np.testing.assert_array_equal(array, same)
    assert not np.array_equal(array, other)
    distance = np.linalg.norm(np.moveaxis(np.indices(grid.shape), 0, -1) * 5.0 + grid.affine[:3, 3], axis=-1)
    assert array.any() and not array[distance > 40 + 5].any()


@pytest.mark.parametrize("diameters", [(11.5, 10.5, 9.5, 8.5, 7.5, 6.5), (7.5, 5.5, 6.5, 11.5, 5.5, 8.5)])
@pytest.mark.parametrize("altered", [1, 2, 4, 6, -1, -2, -4, -6])
def test_the_truth_has_all_of_the_contrast_of_an_added_rod_and_none_of_one_left_out(diameters, altered, monkeypatch):
    """Of the phantom's own values, to rounding; of voxels of 0.8 mm, to their partial volumes."""
    water = WATER if altered in (1, 6, -2, -4) else {}
    phantom = mph.DerenzoPhantom(34.0, diameters, 30.0, activity=80.0, altered=altered, **water)
    pose, expected = mph.random_pose(5, box=4), float(altered < 0)
    site = [phantom.altered_site()]
    place = pose[:3, :3] @ [*site[0][1:3], 0.0] + pose[:3, 3]  # the rod's middle: voxels around it are all that counts
    truth = phantom.voxelize(mph.Grid.centered((36,) * 3, 0.8, place), pose)
    assert rod_contrasts(truth, phantom, pose, site) == pytest.approx(expected, abs=0.12)
    monkeypatch.setattr(rods, "values_at", lambda volume, points: phantom.values(points, pose))
    assert rod_contrasts(truth, phantom, pose, site) == pytest.approx(expected, abs=1e-12)


def scores_of_pairs(altered, factor):
    """Return the scores of volumes that show a share `factor` of every rod, also of one that is left out."""
    phantom = mph.DerenzoPhantom(36.0, DIAMETERS, 30.0, activity=80.0, altered=altered)
    planned = SimpleNamespace(phantom=phantom, activity_factor=1.0)
    event = SimpleNamespace(planned=planned, placement=np.eye(4), number=0, name="derenzo")
    volume = dataclasses.replace(phantom, altered=min(altered, 0)).voxelize(mph.Grid.centered((60,) * 3, 1.6))
    shown = mph.Volume(factor * volume.array, volume.grid, "activity")
    return SCORINGS["pairs"](shown, Case(event, None, volume.grid)) | {"nrmse": 1 - factor, "megabytes": 1.0}


def test_false_rods_are_counted_where_a_rod_is_missing():
    rows, blind = ([scores_of_pairs(altered, factor) for altered in (1, 2, 3, -4)] for factor in (0.9, 0.2))
    means, blind_means = mean_scores(rows), mean_scores(blind)
    assert means["false_rods"].value == 1 and means["sites"] == 4 and means["sensitivity"].value == 1
    assert blind_means["false_rods"].value == 0 and blind_means["sensitivity"].value == 0
    beside = compare_scores(rows, blind, 0)
    assert beside["false_rods_more"] == (1, 1, 1) and beside["ratio"].value == pytest.approx(0.1 / 0.8)
    assert "4 altered sites, fewer than 200" in row_notes(means)
    assert scores_of_pairs(0, 1.0).keys() == {"nrmse", "megabytes"}
