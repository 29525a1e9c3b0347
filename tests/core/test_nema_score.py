"""Laws of the NEMA score: the truth, blur, noise, and what does not matter."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import mphdrr.core as mph

from .conftest import refused

BODY = mph.NemaBody()
GRID = mph.Grid.centered((158, 122, 21), (2.0, 2.0, 2.0))


@pytest.fixture(scope="module")
def truth() -> mph.Volume:
    with pytest.warns(mph.InputWarning, match="outside the grid"):  # only the planes that count
        return BODY.voxelize(GRID)


def test_the_truth_has_all_its_contrast_but_for_the_edges_of_voxels(truth):
    score = mph.nema_score(truth, BODY)
    assert score.diameter.tolist() == [10, 13, 17, 22, 28, 37] == [sphere.diameter for sphere in score]
    assert (score.contrast_recovery < 100).all() and (np.diff(score.contrast_recovery) > 0).all()
    # A voxel at the edge misses half of it on average: the share 2 x 0.5 x 2 mm / diameter, and less.
    assert (score.contrast_recovery > 100 * (1 - 2 / score.diameter)).all()
    assert score.background_variability == pytest.approx(0, abs=1e-4) and score.lung_residual == 0


def test_a_blur_lowers_contrast_most_in_small_spheres(truth):
    score = mph.nema_score(mph.Volume(gaussian_filter(truth.array, 2.0, mode="nearest"), GRID), BODY)
    assert ((score.contrast_recovery > 0) & (score.contrast_recovery < 100)).all()
    assert (np.diff(score.contrast_recovery) > 0).all()
    assert (score.contrast_recovery < mph.nema_score(truth, BODY).contrast_recovery).all()
    assert 0 < score.lung_residual < 5


def test_a_gaussian_has_the_contrast_of_theory():
    """Of spheres that are Gaussians: the mean over a circle through the middle is known."""
    x, y, z = np.moveaxis(GRID.affine[:3, :3] @ np.indices(GRID.shape).reshape(3, -1) + GRID.affine[:3, 3:], 0, 0)
    values, sigma = np.full(x.shape, BODY.background), 6.0
    centers = [sphere.center for sphere in mph.nema_score(uniform(1.0), BODY)]
    for center in centers:
        away = (x - center[0]) ** 2 + (y - center[1]) ** 2 + (z - center[2]) ** 2
        values += (BODY.sphere_activity - BODY.background) * np.exp(-away / (2 * sigma**2))
    score = mph.nema_score(mph.Volume(values.reshape(GRID.shape), GRID), BODY)
    radius = score.diameter / 2
    expected = 100 * 2 * sigma**2 / radius**2 * (1 - np.exp(-(radius**2) / (2 * sigma**2)))
    assert score.contrast_recovery == pytest.approx(expected, rel=0.02)


def uniform(value: float) -> mph.Volume:
    return mph.Volume(np.full(GRID.shape, value), GRID)


def test_white_noise_has_the_variability_of_its_area(rng):
    noisy = mph.Volume(5.3 + rng.normal(0, 1.0, GRID.shape), GRID)
    score = mph.nema_score(noisy, BODY)
    area = np.pi / 4 * score.diameter**2
    assert score.background_variability == pytest.approx(100 / 5.3 * np.sqrt(4 / area), rel=0.35)
    assert score.contrast_recovery == pytest.approx(0, abs=10)


def test_unit_and_pose_do_not_matter(truth):
    pose = mph.euler_pose(0.3, 0.2, 1.0, (10, 20, -5))
    moved = mph.Volume(7 * truth.array, mph.Grid(GRID.shape, pose @ GRID.affine))
    one, other = mph.nema_score(truth, BODY), mph.nema_score(moved, BODY, pose)
    assert other.contrast_recovery == pytest.approx(one.contrast_recovery, abs=0.1)
    assert other.lung_residual == pytest.approx(one.lung_residual, abs=0.1)
    assert other[5].center == pytest.approx(pose[:3, :3] @ one[5].center + pose[:3, 3])


def test_background_regions_keep_their_distances():
    score = mph.nema_score(uniform(1.0), BODY)
    assert score.background_regions.shape == (60, 3)
    assert sorted(set(score.background_regions[:, 2])) == [-20, -10, 0, 10, 20]
    for sphere in score:
        away = np.linalg.norm((score.background_regions - sphere.center)[:, :2], axis=1)
        assert away.min() >= sphere.diameter / 2 + 15 + 18.5
    x, y = score.background_regions[:12, :2].T
    turn = np.linspace(0, 6.28, 60)
    edge = np.stack([x, y], axis=1)[:, None] + (18.5 + 14.9) * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    inside = BODY.values(np.concatenate([edge.reshape(-1, 2), np.zeros((edge.size // 2, 1))], axis=1))
    assert (inside == BODY.background).all()  # neither beyond the outline nor in the lung insert


def test_cold_spheres_and_no_insert():
    cold = mph.NemaBody(sphere_activity=0.0, lung_diameter=0.0, sphere_diameters=(0, 0, 17, 0, 0, 37))
    with pytest.warns(mph.InputWarning, match="outside the grid"):
        score = mph.nema_score(cold.voxelize(mph.Grid.centered((80, 62, 11), 4.0)), cold)
    assert score.diameter.tolist() == [17, 37] and np.isnan(score.lung_residual)
    assert score.contrast_recovery[1] == pytest.approx(93, abs=5)


@pytest.mark.parametrize(
    ("volume", "phantom", "message"),
    [
        (uniform(1.0), mph.DerenzoPhantom(), "nema_score: expected a NemaBody, got DerenzoPhantom"),
        (uniform(1.0), mph.NemaBody(background=0), "expected spheres in a background of another activity"),
        (uniform(1.0), mph.NemaBody(background=5, sphere_activity=5), "a background of another activity, got 5 kBq"),
        (uniform(0.0), BODY, "expected activity in the background, got a mean of 0"),
        (uniform(1.0), mph.NemaBody(length=89), "a body that reaches from the spheres 20 mm down, got 19"),
        (
            mph.Volume(np.ones((40, 40, 40)), mph.Grid.centered(40, 2.0)),
            BODY,
            "60 of 60 background regions lie outside",
        ),
    ],
)
def test_what_cannot_be_scored_is_refused(volume, phantom, message):
    refused(lambda: mph.nema_score(volume, phantom), message)
