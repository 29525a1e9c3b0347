"""Feldkamp's algorithm: values on full circles, arcs and misaligned orbits given in the matrices."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import mphdrr.core as mph

from .conftest import refused
from .odd_views import moved_views

RADIUS, DISTANCE = 300.0, 500.0
GRID = mph.Grid.centered((32, 32, 32), 3.0)
BALL, MU = 30.0, 0.02  # mm, 1/mm
EDGE = float(np.arctan(40 * 2.5 / DISTANCE))  # half the angle of the fan
FULL = np.arange(120) * 2 * np.pi / 120
DEGREE = np.pi / 180


def orbit(angles, u_shift=0.0, v_shift=0.0, roll=0.0, tilt=0.0, out=0.0, shape=(64, 80), pitch=2.5):
    """Return views of sources on a circle, detectors moved (mm) and turned (rad), sources lifted by `out` mm to and fro."""
    a = np.asarray(angles, dtype=float)
    towards, along = np.array([[np.cos(a), np.sin(a), 0 * a], [-np.sin(a), np.cos(a), 0 * a]]).transpose(0, 2, 1)
    up = np.array([0.0, 0.0, 1.0])
    u, v = np.cos(roll) * along + np.sin(roll) * up, np.cos(roll) * up - np.sin(roll) * along
    centers = (RADIUS - DISTANCE) * towards + u_shift * u + v_shift * v
    sources = RADIUS * towards + out * np.sin(5 * a)[:, None] * up
    return mph.Views(sources, centers, pitch * (np.cos(tilt) * u + np.sin(tilt) * towards), pitch * v, shape)


def ball_images(views, center=(0.0, 0.0, 0.0)):
    """Return exact line integrals of a ball."""
    images = []
    for m in range(len(views)):
        starts, ends = views.rays(m)
        direction = (ends - starts) / np.linalg.norm(ends - starts, axis=1)[:, None]
        miss = np.linalg.norm(np.cross(center - starts, direction), axis=1)
        images.append(2 * MU * np.sqrt(np.clip(BALL**2 - miss**2, 0, None)))
    return np.reshape(images, (len(views), *views.shape))


def center_of(volume):
    return float(volume.array[13:19, 13:19, 13:19].mean()) / MU


def root_mean_square(values):
    return np.sqrt(np.mean(values**2))


PLACES = np.indices(GRID.shape) * 3.0 - 46.5
FROM_CENTER = np.linalg.norm(PLACES, axis=0)


def test_a_ball_on_a_full_circle_is_right_within_two_percent():
    views = orbit(FULL)
    volume = mph.fdk(ball_images(views), views, GRID)
    assert volume.quantity == "mu"
    assert center_of(volume) == pytest.approx(1, abs=0.01)
    values = volume.array / MU
    assert np.abs(values[(FROM_CENTER < 24) & (np.abs(PLACES[2]) < 3)] - 1).mean() < 0.02
    assert abs(values[FROM_CENTER > 36].mean()) < 0.01


@pytest.mark.long
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "angles",
    [
        np.random.default_rng(0).permutation(-FULL + 0.4),
        np.sort(np.random.default_rng(1).random(200)) * 2 * np.pi,
        np.arange(200) * 4 * np.pi / 200,  # two turns
        np.arange(100) * (np.pi + 2 * EDGE + 0.05) / 100,  # half a circle and the fan
        2.0 - np.arange(100) * (np.pi + 2 * EDGE + 0.05) / 100,
        np.arange(120) * 300 * DEGREE / 120,
    ],
)
def test_any_circle_and_any_arc_that_is_long_enough(angles, center=(12.0, -15.0, 4.0)):
    array, reference = (mph.fdk(ball_images(v, center), v, GRID).array for v in (orbit(angles), orbit(FULL)))
    i, j, k = np.rint((np.array(center) + 46.5) / 3).astype(int)
    assert array[i - 2 : i + 3, j - 2 : j + 3, k - 2 : k + 3].mean() / MU == pytest.approx(1, abs=0.02)
    assert np.abs(array - reference).mean() < 0.02 * MU


@pytest.mark.long
@pytest.mark.parametrize(
    "misaligned",
    [
        {"u_shift": 1.0}, {"v_shift": 1.0}, {"roll": 0.5 * DEGREE}, {"tilt": 0.5 * DEGREE}, {"out": 1.0},
        {"u_shift": 1.0, "v_shift": 1.0, "roll": 0.5 * DEGREE, "tilt": 0.5 * DEGREE, "out": 1.0},
        {"u_shift": 25.0}, {"tilt": 20 * DEGREE}, {"roll": 5 * DEGREE},
    ],
)  # fmt: skip
def test_misalignment_given_in_the_matrices_costs_less_than_two_percent(misaligned):
    straight, crooked = (
        (mph.fdk(ball_images(views), views, GRID).array / MU - (FROM_CENTER < BALL))[:, :, 14:18]
        for views in (orbit(FULL), orbit(FULL, **misaligned))
    )
    assert np.abs(crooked[FROM_CENTER[:, :, 14:18] < BALL - 4]).max() < 0.02
    assert root_mean_square(crooked) < root_mean_square(straight) + 0.005


def test_misalignment_that_the_matrices_do_not_know_costs_more():
    crooked = orbit(FULL, u_shift=5.0)
    images = ball_images(crooked)
    arrays = (mph.fdk(images, views, GRID).array for views in (crooked, orbit(FULL)))
    known, unknown = (root_mean_square(array / MU - (FROM_CENTER < BALL)) for array in arrays)
    assert unknown > 1.2 * known


def test_the_circle_may_lie_in_any_plane_and_rows_may_be_columns():
    views = orbit(FULL)
    images = ball_images(views, (10.0, 5.0, 3.0))
    straight = mph.fdk(images, views, GRID).array
    pose = mph.euler_pose(0.4, 0.8, -0.3, (5, 6, 7))
    turned = mph.fdk(images, moved_views(views, pose), mph.Grid(GRID.shape, pose @ GRID.affine)).array
    np.testing.assert_allclose(turned, straight, atol=1e-3 * MU)
    points = (views.sources, views.detector_centers)
    exchanged = mph.Views(*points, views.v_steps, views.u_steps, views.shape[::-1])
    mirrored = mph.Views(*points, -views.u_steps, views.v_steps, views.shape)
    for same, seen in ((images.swapaxes(1, 2), exchanged), (images[:, :, ::-1], mirrored)):
        np.testing.assert_allclose(mph.fdk(same, seen, GRID).array, straight, atol=1e-4 * MU)


def test_an_arc_that_is_too_short_is_said_and_loses_values():
    views = orbit(np.arange(60) * 120 * DEGREE / 60)
    with pytest.warns(mph.InputWarning, match=r"fdk: the arc is 8\d degrees too short"):
        volume = mph.fdk(ball_images(views), views, GRID)
    assert center_of(volume) == pytest.approx(120 / 180, abs=0.05)


@pytest.mark.parametrize("shift", [45.0, -60.0])
def test_images_cut_off_at_an_edge_are_said(shift):
    """Such as those of a displaced detector, whose values are far from the truth."""
    views = orbit(FULL, u_shift=shift, shape=(48, 56))
    with pytest.warns(
        mph.InputWarning, match=r"fdk: the images fall only to \d+% of their largest value at their edge"
    ):
        volume = mph.fdk(ball_images(views), views, GRID)
    assert abs(center_of(volume) - 1) > 0.1
    whole = orbit(FULL, u_shift=shift, shape=(48, 112))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert center_of(mph.fdk(ball_images(whole), whole, GRID)) == pytest.approx(1, abs=0.01)


@pytest.mark.filterwarnings("error")
def test_turns_that_repeat_are_no_gaps():
    turn = np.arange(15) * 24 * DEGREE
    many, once = (mph.fdk(ball_images(v), v, GRID).array for v in (orbit(np.tile(turn, 4)), orbit(turn)))
    np.testing.assert_allclose(many, once, atol=1e-4 * MU)


def test_it_inverts_the_projector():
    blocks = np.kron(np.random.default_rng(3).random((4, 4, 4)), np.ones((5, 5, 5)))
    blocks = np.pad(blocks, 6).astype(np.float32)
    grid = mph.Grid.centered(blocks.shape, 3.0)
    views = orbit(np.arange(180) * 2 * np.pi / 180, pitch=2.0, shape=(90, 110))
    error = mph.fdk(mph.Projector(grid, views)(blocks), views, grid).array - blocks
    assert root_mean_square(error[:, :, 14:18]) < 0.25 * root_mean_square(blocks[:, :, 14:18])


def test_wrong_input_is_named():
    views = orbit(FULL[::20])
    images = np.zeros((6, 64, 80))
    line = replace(views, sources=views.sources + np.arange(6)[:, None] * [0, 0, 80.0])
    broken = images.copy()
    broken[0, 0, 0] = np.inf
    for arguments, words in (
        ((images[:, :3], views, GRID), ["fdk: images: expected shape 6 x 64 x 80"]),
        ((broken, views, GRID), ["fdk: images: inf is not a finite number"]),
        ((images, mph.parallel_views(FULL[::20], (64, 80), 1.0), GRID), ["fdk: expected views from sources"]),
        ((images, line, GRID), ["fdk: view ", ": its source is ", " mm off the circle"]),
        ((images, views[np.zeros(6, int)], GRID), ["fdk: expected sources on a circle around the object, got all"]),
        ((images, orbit(FULL[::20], roll=0.8), GRID), ["fdk: view ", ": its rows are tilted"]),
        ((images[:2], views[:2], GRID), ["fdk: expected three views or more, got 2"]),
        ((images, views, GRID, "none"), ["window 'none': expected one of"]),
    ):
        refused(lambda arguments=arguments: mph.fdk(*arguments), *words)
