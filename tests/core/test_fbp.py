"""Filtered backprojection of parallel views: values, windows, angles, and the kernel beside numpy."""

from dataclasses import replace

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.perspective import places
from mphdrr.core.reconstruction.ramp import WINDOWS, ramp_matrix

from .conftest import assert_progress, refused
from .odd_views import moved_views
from .test_fdk import orbit

SIDE = 64.0


def views_of(angles, columns=64, pitch=1.0, rows=3, **options):
    return mph.parallel_views(angles, (rows, columns), pitch, **options)


def disc(n, radius, center=(0.0, 0.0)):
    """Return a disc of 1 on a grid of n x n x 4 voxels of a side of 64 mm, averaged over 4 x 4 points a voxel."""
    grid = mph.Grid.centered((n, n, 4), (SIDE / n, SIDE / n, 1.5))
    points = (np.arange(4 * n) + 0.5) * SIDE / (4 * n) - SIDE / 2
    inside = (points[:, None] - center[0]) ** 2 + (points - center[1]) ** 2 < radius**2
    plane = inside.reshape(n, 4, n, 4).mean(axis=(1, 3))
    return grid, np.repeat(plane[:, :, None], 4, axis=2).astype(np.float32)


def images_of(views, radius=20.0, center=(3.0, -5.0)):
    grid, values = disc(192, radius, center)
    return mph.Projector(grid, views)(values)


def relative_error(found, truth):
    return float(np.sqrt(np.mean((found - truth) ** 2) / np.mean(truth**2)))


GRID = mph.Grid.centered((64, 64, 3), 1.0)
DISC = disc(64, 20.0, (3.0, -5.0))[1][:, :, :3]


@pytest.mark.parametrize(
    "angles",
    [
        np.arange(120) * np.pi / 120,  # half a circle
        np.arange(240) * np.pi / 120,
        0.3 - np.arange(120) * np.pi / 120,
        np.random.default_rng(0).permutation(np.arange(121) * 2 * np.pi / 121),
        np.pi * np.sort(np.random.default_rng(1).random(240)),
        np.pi * np.linspace(0, 1, 160, endpoint=False) ** 1.3,
    ],
)
def test_a_disc_comes_back_from_any_half_or_full_circle_of_angles(angles):
    views = views_of(angles)
    volume = mph.fbp(images_of(views), views, GRID)
    assert volume.quantity == "mu" and volume.grid == GRID
    inner = disc(64, 17.0, (3.0, -5.0))[1][:, :, :3] == 1
    assert volume.array[inner].mean() == pytest.approx(1.0, abs=0.005)
    assert volume.array[disc(64, 23.0, (3.0, -5.0))[1][:, :, :3] == 0].mean() == pytest.approx(0.0, abs=0.005)
    assert relative_error(volume.array, DISC) < 0.13


@pytest.mark.parametrize("window", list(WINDOWS))
def test_windows_keep_the_mean_and_lower_the_noise(window):
    views = views_of(np.arange(90) * np.pi / 90)
    noise = np.random.default_rng(2).standard_normal((90, 3, 64)).astype(np.float32)
    order = ["ramp", "shepp-logan", "cosine", "hamming", "hann"]
    rougher, smooth = (
        mph.fbp(noise, views, GRID, name).array.std() for name in (order[order.index(window) - 1], window)
    )
    assert smooth < rougher or window == "ramp"
    volume = mph.fbp(images_of(views), views, GRID, window)
    assert volume.array[30:36, 24:30].mean() == pytest.approx(1.0, abs=0.01)


def test_the_ramp_is_that_of_kak_and_slaney():
    matrix = ramp_matrix(8, "ramp", 2)
    lag = np.abs(np.arange(12) - 2 - np.arange(8)[:, None])
    with np.errstate(divide="ignore"):
        expected = np.where(lag == 0, 0.25, np.where(lag % 2 == 0, 0.0, -1 / (np.pi * lag) ** 2))
    assert matrix.shape == (8, 12)
    np.testing.assert_allclose(matrix, expected, atol=1e-7)


def test_turned_tilted_and_shifted_views_of_other_pixels_give_the_same_volume():
    angles = np.arange(120) * np.pi / 120
    views = views_of(angles)
    images = images_of(views)
    straight = mph.fbp(images, views, GRID).array
    # Everything turned in space together.
    pose = mph.euler_pose(0.4, 0.8, -0.3, (5, 6, 7))
    turned = mph.fbp(images, moved_views(views, pose), mph.Grid(GRID.shape, pose @ GRID.affine)).array
    np.testing.assert_allclose(turned, straight, atol=1e-4)
    # Rows and columns exchanged.
    exchanged = replace(views, u_steps=views.v_steps, v_steps=views.u_steps, shape=views.shape[::-1])
    np.testing.assert_allclose(mph.fbp(images.swapaxes(1, 2), exchanged, GRID).array, straight, atol=1e-5)
    # Finer pixels, and detectors that lean.
    fine = views_of(angles, 128, 0.5, rows=8)
    leaning = replace(fine, u_steps=np.cross([0, 0, 1.0], fine.u_steps) * 0.7 + fine.u_steps)
    for other in (fine, leaning):
        volume = mph.fbp(images_of(other), other, mph.Grid.centered((64, 64, 1), 1.0)).array
        assert relative_error(volume, DISC[:, :, :1]) < 0.13


def test_a_volume_larger_than_the_images_is_empty_beside_the_object():
    views = views_of(np.arange(120) * np.pi / 120, columns=56)
    volume = mph.fbp(images_of(views, 15.0), views, mph.Grid.centered((96, 96, 1), 1.0)).array
    assert np.abs(volume[:20]).max() < 0.05 and abs(volume[:20].mean()) < 2e-3


def test_the_kernel_is_numpys_and_threads_change_nothing(monkeypatch):
    if places._gather_kernel is None:
        pytest.skip("no compiled kernels here")
    views = views_of(np.arange(7) * np.pi / 7)
    images = np.random.default_rng(3).random((7, 3, 64)).astype(np.float32)
    grid = mph.Grid((13, 9, 11), mph.euler_pose(0.3, 0.2, 0.1) @ mph.Grid.centered((13, 9, 11), (4.0, 6.0, 0.4)).affine)
    compiled = mph.fbp(images, views, grid).array
    monkeypatch.setattr(places, "_gather_kernel", None)
    np.testing.assert_allclose(mph.fbp(images, views, grid).array, compiled, atol=1e-4 * np.abs(compiled).max())


def test_derenzo_meets_its_errors():
    """NRMSE: root mean square of the error by that of the truth; data from voxels half as large."""
    phantom = mph.DerenzoPhantom(40, (8, 6, 5, 4, 3, 2), 40)
    grid, fine = mph.Grid.centered((128, 128, 2), 1.0), mph.Grid.centered((256, 256, 4), 0.5)
    with pytest.warns(mph.InputWarning, match="outside the grid"):
        truth, source = phantom.voxelize(grid).array, phantom.voxelize(fine)
    for n, most in ((96, 0.25), (256, 0.16)):
        views = mph.parallel_views(np.arange(n) * np.pi / n, (2, 128), 1.0)
        images = mph.Projector(fine, views)(source)
        assert relative_error(mph.fbp(images, views, grid).array, truth) < most


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("angles", [
    np.linspace(0, 2 * np.pi, 13),
    np.linspace(0, 2 * np.pi, 17) + 0.3,
    np.linspace(0, np.pi, 9),
    np.repeat(np.arange(10) * np.pi / 10, [1, 3, 1, 1, 2, 1, 5, 1, 1, 1]),
    np.tile(np.arange(11) * np.pi / 11, 6),  # six turns
    np.linspace(0, 2 * np.pi, 13) + np.random.default_rng(4).normal(0, 1e-4, 13),  # as measured
], ids=["13", "17", "half a turn", "repeated", "six turns", "nearly equal"])  # fmt: skip
def test_equal_angles_count_once(angles):
    """The sum is the object's, and nothing is said to be missing."""
    views = views_of(angles, columns=96)
    volume = mph.fbp(images_of(views), views, mph.Grid.centered((96, 96, 1), 1.0))
    assert volume.array.sum() == pytest.approx(DISC[:, :, 0].sum(), rel=0.01)


def test_equal_angles_share_alike():
    """So noise falls with the number of turns."""
    noise = np.random.default_rng(5).standard_normal((4, 40, 3, 64))
    deviations = []
    for turns in (1, 4):
        views = views_of(np.tile(np.arange(40) * np.pi / 40, turns))
        deviations.append(mph.fbp(noise[:turns].reshape(-1, 3, 64), views, GRID).array.std())
    assert deviations[1] == pytest.approx(deviations[0] / 2, rel=0.05)


@pytest.mark.parametrize("angles", [np.linspace(0, 2.0, 60), np.repeat(np.linspace(0, 2.0, 30), 3)])
def test_missing_directions_are_said_among_repeated_ones_too(angles):
    views = views_of(angles)
    with pytest.warns(mph.InputWarning, match="65 degrees of the half circle have no view"):
        mph.fbp(images_of(views), views, GRID)


@pytest.mark.parametrize(
    ("case", "noise"), [("displaced", 0.5), ("narrow", 0.05), ("one side of some views", 0.0), ("background", 0.5)]
)
def test_images_that_do_not_fall_to_0_at_their_edges_are_said(case, noise):
    views = views_of(np.arange(72) * np.pi / 36, rows=8)
    if case == "displaced":
        shift = 24 * views.u_steps  # each detector by 24 columns
        views = replace(views, sources=views.sources + shift, detector_centers=views.detector_centers + shift)
    elif case == "narrow":
        views = views_of(np.arange(72) * np.pi / 36, columns=30, rows=8)
    images = images_of(views, center=(16.0, 0.0) if case == "one side of some views" else (0.0, 0.0))
    images = images + 8.0 * (case == "background")
    images = images + noise * 0.1 * images.max() * np.random.default_rng(6).standard_normal(images.shape)
    said = r"fbp: the images fall only to \d+% of their largest value at their edge"
    with pytest.warns(mph.InputWarning, match=said):
        mph.fbp(images, views, GRID)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("rows", "noise"), [(1, 1.0), (20, 0.1)])
def test_images_that_hold_the_object_are_not_warned_of(rows, noise):
    views = views_of(np.arange(90) * np.pi / 45, columns=44, rows=rows)  # the disc is 40 wide
    images = images_of(views, center=(0.5, -0.5))
    images = images + noise * 0.1 * images.max() * np.random.default_rng(7).standard_normal(images.shape)
    mph.fbp(images, views, GRID)
    mph.fbp(0 * images, views, GRID)


def test_a_reconstruction_is_of_what_its_images_are_of():
    """Images of a `Volume` know its quantity, parts of them and noisy ones, too; those of arrays are of mu."""
    views = views_of(np.arange(40) * np.pi / 40, columns=72)
    A = mph.Projector(GRID, views)
    for quantity in ("activity", "mu"):
        images = A(mph.Volume(DISC, GRID, quantity))
        assert isinstance(images, np.ndarray) and images.dtype == np.float32
        np.testing.assert_array_equal(images, A(DISC))
        noisy = images[::2] * 1.1 + np.random.default_rng(8).normal(0, 0.1, (20, 3, 72))
        assert mph.fbp(images, views, GRID).quantity == mph.fbp(noisy, views[::2], GRID, "hann").quantity == quantity
        assert mph.fbp(images, views, GRID, quantity="hu").quantity == "hu"
        assert isinstance(images.sum(), np.float32) and round(float(images.max()), 3) > 0
    assert mph.fbp(A(DISC), views, GRID).quantity == "mu"
    cone = orbit(np.arange(24) * np.pi / 12, shape=(6, 60))
    images = mph.Projector(GRID, cone)(mph.Volume(DISC, GRID, "activity"))
    assert mph.fdk(images, cone, GRID).quantity == "activity"


def test_progress_counts_views_and_stops():
    views, images = views_of(np.arange(30) * np.pi / 30), np.zeros((30, 3, 64))
    assert_progress(lambda progress: mph.fbp(images, views, GRID, progress=progress))


def test_wrong_input_is_named():
    views = views_of([0.0, 1.0, 2.0])
    images = np.zeros((3, 3, 64))
    broken = images.copy()
    broken[1, 2, 3] = np.nan
    lifted = views_of([0.0, 1.0, 2.0], elevation=[0, 0.2, 0])
    diagonal = replace(views, u_steps=views.u_steps + views.v_steps, v_steps=views.v_steps - views.u_steps)
    for arguments, words in (
        ((images[:2], views, GRID), "fbp: images: expected shape 3 x 3 x 64"),
        ((broken, views, GRID), "fbp: images: nan is not a finite number at index"),
        ((images, replace(views, parallel=False), GRID), "fbp: expected parallel views"),
        ((images, views, GRID, "boxcar"), "window 'boxcar': expected one of ramp, shepp-logan"),
        ((images, lifted, GRID), ": its rays do not lie in the plane"),
        ((images, diagonal, GRID), "fbp: view 0: its rows are tilted by 45 degrees"),
        ((images, "views", GRID), "fbp: views: expected a Views"),
        ((images, views, (64, 64, 3)), "fbp: grid: expected a Grid"),
        ((images[:1], views[:1], GRID), "fbp: expected two views or more"),
    ):
        refused(lambda arguments=arguments: mph.fbp(*arguments), words)
