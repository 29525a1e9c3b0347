"""Laws of the scores of reconstructions: analytic profiles, invariances, identities."""

from __future__ import annotations

import functools
import warnings

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.ndimage import gaussian_filter
from scipy.special import i0e

import mphdrr.core as mph
from mphdrr.core.reconstruction.scores.derenzo import LIGHTS, VISIBLE_CHANCE

from .conftest import refused

RODS = (6.0, 5.0, 4.0, 3.5, 3.0, 0.0)
DISTANCES = np.concatenate([np.linspace(0, 15, 301), [100]])  # mm
PHANTOM = mph.DerenzoPhantom(30.0, RODS, 20.0, activity=100.0)


def uniform(value: float, grid: mph.Grid) -> mph.Volume:
    return mph.Volume(np.full(grid.shape, value), grid)


@functools.cache
def blurred_disc(radius: float, sigma: float) -> np.ndarray:
    """Return a disc of 1 after a Gaussian blur, at DISTANCES from its centre: the integral of Rice's distribution."""

    def density(r: float, d: float) -> float:
        return r / sigma**2 * np.exp(-((r - d) ** 2) / (2 * sigma**2)) * i0e(r * d / sigma**2)

    return np.array([quad(density, 0, radius, args=(d,))[0] for d in DISTANCES])


def blurred_rods(points: np.ndarray, sigma: float) -> np.ndarray:
    """Return PHANTOM's rods, endless and blurred, at points (..., 2)."""
    total = np.zeros(points.shape[:-1])
    for _, x, y, w in PHANTOM.rods():
        total += np.interp(np.hypot(points[..., 0] - x, points[..., 1] - y), DISTANCES, blurred_disc(w / 2, sigma))
    return PHANTOM.activity * total


@pytest.fixture(scope="module")
def truth() -> mph.Volume:
    return PHANTOM.voxelize(mph.Grid.centered((120, 120, 20), (0.5, 0.5, 1.2)))


def test_the_truth_is_resolved_and_has_all_its_contrast(truth):
    score = mph.derenzo_score(truth, PHANTOM)
    assert len(score) == 6 and [sector.rod_diameter for sector in score] == list(RODS)
    assert score.resolved[:5].tolist() == [1] * 5
    assert score.valley_to_peak[:5] == pytest.approx(0.0, abs=1e-3)
    assert score.contrast_recovery[:5] == pytest.approx(1.0, abs=5e-3)
    assert np.isnan(score[5].valley_to_peak) and score[5].note == "no rods"
    rods = PHANTOM.rods()
    for number, sector in enumerate(score):
        mine = rods[rods[:, 0] == number, 1:3]
        apart = np.linalg.norm(mine[:, None] - mine, axis=2)
        assert len(sector.profiles) == np.count_nonzero(np.isclose(apart, 2 * sector.rod_diameter)) / 2
        for profile in sector.profiles:
            for end in profile.points[[0, -1]]:
                assert np.linalg.norm(mine - end[:2], axis=1).min() < 1e-9 and end[2] == 0


def test_a_uniform_volume_resolves_nothing():
    score = mph.derenzo_score(uniform(3.0, mph.Grid.centered((64, 64, 24), 1.0)), PHANTOM)
    assert score.resolved[:5].tolist() == [0] * 5
    assert score.valley_to_peak[:5] == pytest.approx(1.0)
    assert score.contrast_recovery[:5] == pytest.approx(0.0, abs=1e-6)


NARROW = mph.DerenzoPhantom(30.0, (3.5, 6.0, 3.5, 4.5, 3.0, 3.5, 5.0, 3.5, 2.5, 3.5), 16.0, activity=100.0, sectors=10)
WIDE = mph.DerenzoPhantom(26.0, (6.5, 6.0, 5.0, 4.0, 3.5, 3.0), 16.0, activity=100.0)


def smoothed(rng: np.random.Generator, grid: mph.Grid, fwhm: float) -> np.ndarray:
    """Return Gaussian noise of mean 0 and deviation 1, smoothed to a width in mm."""
    noise = gaussian_filter(rng.standard_normal(grid.shape), fwhm / 2.355 / grid.spacing)
    return noise / noise.std()


NOISE = {
    "white": lambda rng, grid: 100 * rng.standard_normal(grid.shape),
    "white around a background": lambda rng, grid: rng.gamma(1.5, 15.0, grid.shape),
    "as wide as thin rods": lambda rng, grid: 60 * smoothed(rng, grid, 3.5),
    "as wide as thick rods": lambda rng, grid: 60 * smoothed(rng, grid, 7.0),
    "around a background": lambda rng, grid: 25 * (1 + 0.7 * smoothed(rng, grid, 4.5)),
    "of OSEM": lambda rng, grid: 25 * np.exp(smoothed(rng, grid, 5.0)),  # in proportion to the activity, correlated
    "of OSEM, with zeros": lambda rng, grid: np.maximum(60 * smoothed(rng, grid, 4.0) + 20, 0),
    "few counts": lambda rng, grid: 500 * gaussian_filter(rng.poisson(0.3, grid.shape) / 1.0, 1.0),
}


def falsely_resolved(kind: str, volumes: int, grid: mph.Grid, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return whether each sector of so many volumes of noise is resolved, and which are of one pair or three."""
    found, small, rng = [], [], np.random.default_rng(seed)
    for i in range(volumes):
        volume = mph.Volume(NOISE[kind](rng, grid), grid)
        for sector in mph.derenzo_score(volume, (NARROW, WIDE)[i % 2]):
            if sector.profiles:
                found.append(sector.resolved)
                small.append(len(sector.profiles) <= 3)
    return np.array(found), np.array(small)


@pytest.mark.parametrize(("kind", "volumes"), [
    *((kind, 25) for kind in list(NOISE)[::4]), *(pytest.param(kind, 200, marks=pytest.mark.long) for kind in NOISE),
])  # fmt: skip
def test_noise_resolves_hardly_any_sector(kind, volumes):
    """One in a thousand may be, by its own chance."""
    resolved, small = falsely_resolved(kind, volumes, mph.Grid.centered((31, 31, 9), 2.0), 4 if volumes > 25 else 3)
    assert len(resolved) > 100 and resolved.mean() <= max(0.004, 1 / len(resolved))
    assert volumes < 200 or resolved[small].mean() <= 0.008


@pytest.mark.parametrize(("flat", "light"), [(0.2, "green"), (0.4, "amber")])
def test_rods_are_resolved_slice_by_slice(flat, light):
    """A part of the rods' middle half shows none; means over all of it still have a valley."""
    rods = PHANTOM.voxelize(mph.Grid.centered((60, 60, 50), (1.0, 1.0, 0.4)))
    array = rods.array.copy()
    array[:, :, 12 : 12 + round(25 * flat)] = PHANTOM.activity / 3
    for sector in mph.derenzo_score(mph.Volume(array, rods.grid), PHANTOM)[:5]:
        assert sector.valley_to_peak < 0.735 and sector.chance < 0.001 and sector.light == light
        assert sector.slices_resolved == pytest.approx(1 - flat, abs=0.06)


def test_pairs_by_themselves_prove_nothing():
    """In noise many pairs are below Rayleigh's limit, in some sectors nearly all, and whole sectors: that resolves none."""
    rng, grid = np.random.default_rng(5), mph.Grid.centered((31, 31, 9), 2.0)
    sectors = []
    for _ in range(30):
        score = mph.derenzo_score(mph.Volume(NOISE["white"](rng, grid), grid), WIDE)
        sectors += [sector for sector in score if sector.profiles]
    many = [sector for sector in sectors if sector.pairs_resolved >= 0.66 and sector.contrast_recovery > 0.1]
    assert len(many) > 10 and np.mean([sector.resolved for sector in many]) < 0.2
    below = np.mean([sector.valley_to_peak < 0.735 for sector in sectors])
    assert below > 0.25 and np.mean([sector.resolved for sector in sectors]) < 0.05


@pytest.mark.parametrize("voxel", [pytest.param(1.0, marks=pytest.mark.long), 1.6])
@pytest.mark.parametrize("phantom", [WIDE, NARROW, mph.DerenzoPhantom(
    30.0, (8.0, 6.0, 5.0, 4.0, 3.5, 3.0), 16.0, 0.0, cylinder_radius=34, cylinder_height=24, background=20)],
    ids=["wide", "narrow", "cold"])  # fmt: skip
def test_without_noise_rayleighs_limit_alone_decides(phantom, voxel):
    truth = phantom.voxelize(mph.Grid.centered(np.ceil(np.array([70, 70, 24]) / voxel).astype(int), voxel))
    seen = set()
    for fwhm in (0.0, 2.0, 4.0, 6.0, 8.0):
        blurred = gaussian_filter(truth.array, fwhm / 2.355 / voxel)
        for sector in mph.derenzo_score(mph.Volume(blurred, truth.grid), phantom):
            if sector.profiles:
                if len(sector.profiles) == 1 and sector.chance > 0.001:
                    continue  # a valley between two rods that differ proves little
                assert sector.resolved == (sector.valley_to_peak < 0.735), (fwhm, sector.rod_diameter)
                light = "green" if sector.resolved else "amber" if sector.chance < VISIBLE_CHANCE else "red"
                assert sector.light == light and sector.words.startswith(f"{LIGHTS[light]}, ")
                seen.add(sector.resolved)
    assert seen == {0.0, 1.0}


def test_the_chance_is_that_of_students_t_of_rods_and_valleys(rng):
    """By scipy, of the profiles' own numbers."""
    stats = pytest.importorskip("scipy.stats")
    grid = mph.Grid.centered((56, 56, 18), 1.0)
    volume = mph.Volume(WIDE.voxelize(grid).array + 150 * smoothed(rng, grid, 4.0), grid)
    chances = []
    for sector in filter(lambda sector: sector.profiles, mph.derenzo_score(volume, WIDE)):
        ends: dict[tuple[float, ...], list[float]] = {}
        for profile in sector.profiles:
            for point, value in zip(profile.points[[0, -1]], profile.values[[0, -1]], strict=True):
                ends.setdefault(tuple(point.round(6)), []).append(value)
        rods, valleys = [np.mean(values) for values in ends.values()], [profile.valley for profile in sector.profiles]
        expected = stats.ttest_ind(rods, valleys, alternative="greater").pvalue
        assert sector.chance == pytest.approx(expected, rel=1e-3, abs=1e-9)
        chances.append(sector.chance)
    assert min(chances) < 0.02 < max(chances)


def test_noise_alone_has_no_valleys_on_average(rng):
    grid = mph.Grid.centered((64, 64, 24), 1.0)
    score = mph.derenzo_score(mph.Volume(rng.gamma(2.0, 5.0, grid.shape), grid), PHANTOM)
    assert score.valley_to_peak[2:5] == pytest.approx(1.0, abs=0.1) and (score.resolved[:5] < 0.3).all()


@pytest.mark.parametrize("sigma", [1.2, 2.0])
def test_blurred_rods_have_the_valleys_of_theory(sigma):
    grid = mph.Grid.centered((160, 160, 14), (0.4, 0.4, 1.0))
    axis = (np.arange(160) - 79.5) * 0.4
    plane = blurred_rods(np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1), sigma)
    score = mph.derenzo_score(mph.Volume(np.repeat(plane[:, :, None], 14, axis=2), grid), PHANTOM)
    for sector in score[:5]:
        peaks, valleys = [], []
        for profile in sector.profiles:
            start, end = profile.points[[0, -1], :2]
            across = np.array([[0, -1], [1, 0]]) @ (end - start) / np.linalg.norm(end - start)
            aside = np.linspace(-0.25, 0.25, 41)[:, None] * sector.rod_diameter * across  # half a diameter
            line = (start, (start + end) / 2, end)
            at_start, between, at_end = (blurred_rods(place + aside, sigma).mean() for place in line)
            peaks.append((at_start + at_end) / 2)
            valleys.append(between)
            assert profile.valley_to_peak == pytest.approx(valleys[-1] / peaks[-1], abs=0.01)
        assert sector.valley_to_peak == pytest.approx(np.mean(valleys) / np.mean(peaks), abs=0.01)
        assert sector.resolved == np.mean(np.array(valleys) / np.array(peaks) < 0.735)
        recovery = (np.mean(peaks) - np.mean(valleys)) / PHANTOM.activity
        assert sector.contrast_recovery == pytest.approx(recovery, abs=0.01)
    assert (np.diff(score.contrast_recovery[:5]) < 0).all()  # the thinner the rods, the more is lost


def test_only_contrast_recovery_depends_on_the_scale_of_the_values(truth):
    low = mph.Volume(0.25 * truth.array, truth.grid)
    one, other = mph.derenzo_score(truth, PHANTOM), mph.derenzo_score(low, PHANTOM)
    assert other.valley_to_peak == pytest.approx(one.valley_to_peak, rel=1e-5, nan_ok=True)
    assert other.contrast_recovery == pytest.approx(0.25 * one.contrast_recovery, rel=1e-5, nan_ok=True)


def test_phantom_and_grid_may_be_turned_together(truth):
    pose = mph.euler_pose(0.4, 1.1, -0.7, (5, -3, 40))
    moved = mph.Volume(truth.array, mph.Grid(truth.grid.shape, pose @ truth.grid.affine))
    one, other = mph.derenzo_score(truth, PHANTOM), mph.derenzo_score(moved, PHANTOM, pose)
    assert other.valley_to_peak == pytest.approx(one.valley_to_peak, abs=1e-5, nan_ok=True)
    assert other.contrast_recovery == pytest.approx(one.contrast_recovery, abs=1e-5, nan_ok=True)
    assert other[0].profiles[0].points == pytest.approx(one[0].profiles[0].points @ pose[:3, :3].T + pose[:3, 3])


def test_a_turned_phantom_on_a_straight_grid_is_found(truth):
    pose = mph.euler_pose(0.3, 0.5, 0.2, (1, 2, 3))
    volume = PHANTOM.voxelize(mph.Grid.centered(90, 0.8, center=(1, 2, 3)), pose)
    score = mph.derenzo_score(volume, PHANTOM, pose)
    assert score.resolved[:5].tolist() == [1] * 5 and score.contrast_recovery[:4] == pytest.approx(1, abs=0.01)
    straight = mph.derenzo_score(volume, PHANTOM, mph.euler_pose(translation=(1, 2, 3)))
    assert straight.contrast_recovery[0] < 0.9  # the wrong place is no better than it should be


def test_cold_rods_have_their_valleys_inside():
    phantom = mph.DerenzoPhantom(30, RODS, 20, 0, cylinder_radius=34, cylinder_height=30, background=7)
    score = mph.derenzo_score(phantom.voxelize(mph.Grid.centered((88, 88, 32), (0.8, 0.8, 1.0))), phantom)
    assert score.valley_to_peak[:5] == pytest.approx(0, abs=0.01)
    assert score.contrast_recovery[:5] == pytest.approx(1, abs=0.01)


def test_rods_of_any_phantom_are_scored(tmp_path):
    """Such as cold ones of a file, that lie somewhere in its water."""
    place, water = {"position": (4, -5, 6), "euler": (0.2, 0.3, 0)}, mph.Cylinder(radius=40, height=50, activity=9)
    rods = mph.DerenzoRods(radius=30, rod_diameters=RODS, height=20, activity=1, **place)
    mph.write_phantom(mph.ShapePhantom([water, rods]), tmp_path / "rods.toml")
    phantom = mph.read_phantom(tmp_path / "rods.toml")
    score = mph.derenzo_score(phantom.voxelize(mph.Grid.centered((85, 85, 55), 1.0)), phantom)
    assert score.valley_to_peak[:2] == pytest.approx(1 / 9, abs=0.01)
    assert score.contrast_recovery[:2] == pytest.approx(1, abs=0.02)


def test_what_cannot_be_scored_is_nan_and_says_why(truth):
    coarse = mph.derenzo_score(uniform(1.0, mph.Grid.centered(16, 5.5)), PHANTOM)
    assert [sector.note for sector in coarse][:3] == ["", *["voxels of 5.5 mm are larger than the rods"] * 2]
    assert np.isnan(coarse[2].resolved) and not np.isnan(coarse[0].resolved)
    cut = mph.Volume(truth.array[:, :60], mph.Grid((120, 60, 20), truth.grid.affine))  # the half at -y
    notes = [sector.note for sector in mph.derenzo_score(cut, PHANTOM)]
    assert notes[0] == "" and notes[3] == "the volume covers 0 of 6 rods"
    single = mph.DerenzoPhantom(17.0, (6, 0, 0, 0, 0, 2), 10.0)
    (score, *_) = mph.derenzo_score(uniform(1.0, mph.Grid.centered(36, 1.0)), single)
    assert score.note == "a single rod has no neighbour"
    even = mph.Volume(truth.array, truth.grid, "mu")
    in_water = mph.DerenzoPhantom(30.0, RODS, 20.0, cylinder_radius=30)
    assert mph.derenzo_score(even, in_water)[0].note == "the rods hold the same mu as what is between them"
    empty = mph.derenzo_score(uniform(0.0, truth.grid), PHANTOM)[0]
    assert np.isnan(empty.valley_to_peak) and empty.note == "the peaks are not above 0" and empty.resolved == 0


@pytest.mark.parametrize(("low", "high"), [(-2.0, 2.8), (-14.0, -5.6), (3.0, 25.0)])
def test_where_the_volume_covers_a_part_of_the_rods_that_part_is_scored(low, high):
    """From one diameter on; else the score says how much of their length is covered, and never that rods lie outside."""
    pose = mph.euler_pose(0.4, 1.1, -0.7, (5, -3, 40))
    n = round((high - low) / 0.4)
    place = mph.Grid.centered((120, 120, n), (0.5, 0.5, (high - low) / n), center=(0, 0, (low + high) / 2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mph.InputWarning)  # the phantom reaches beyond
        part = PHANTOM.voxelize(place)
    score = mph.derenzo_score(mph.Volume(part.array, mph.Grid(place.shape, pose @ place.affine)), PHANTOM, pose)
    covered = min(high, 10) - max(low, -10)
    for sector in score[:5]:
        if covered >= sector.rod_diameter - 1e-6:
            assert sector.note == "" and sector.resolved == 1
            assert sector.valley_to_peak == pytest.approx(0.0, abs=1e-3)
            assert sector.contrast_recovery == pytest.approx(1.0, abs=5e-3)
        else:
            assert np.isnan(sector.resolved) and sector.words == f"the volume covers {covered:.3g} of 20 mm"


@pytest.mark.parametrize(("center", "thickness", "said"), [(0, 1, "1"), (9.5, 3, "2"), (30, 2, "0"), (-10, 2, "1")])
def test_a_slab_too_thin_says_what_it_covers(center, thickness, said):
    slab = uniform(1.0, mph.Grid.centered((60, 60, 1), (1.0, 1.0, thickness), center=(0, 0, center)))
    notes = [sector.note for sector in mph.derenzo_score(slab, PHANTOM)[:5]]
    assert notes == [f"the volume covers {said} of 20 mm"] * 5
    thick = uniform(1.0, mph.Grid.centered((60, 60, 1), (1.0, 1.0, 8.0)))  # one voxel along the rods
    assert mph.derenzo_score(thick, PHANTOM)[0].valley_to_peak == pytest.approx(1.0)


def test_the_middle_half_counts_where_it_is_covered():
    """What is beyond, such as the rods' blurred ends, has no effect; where less is covered, that counts."""
    grid = mph.Grid.centered((60, 60, 40), (1.0, 1.0, 0.5))
    array = np.array(PHANTOM.voxelize(grid).array)
    whole = mph.derenzo_score(mph.Volume(array, grid), PHANTOM)
    array[:, :, :9], array[:, :, 31:] = 7.0, 7.0
    spoiled = mph.derenzo_score(mph.Volume(array, grid), PHANTOM)
    assert spoiled.contrast_recovery == pytest.approx(whole.contrast_recovery, nan_ok=True, rel=1e-6)
    upper = mph.Grid.centered((60, 60, 13), (1.0, 1.0, 0.5), center=(0, 0, 6.75))
    cut = mph.derenzo_score(mph.Volume(array[:, :, 27:], upper), PHANTOM)
    # 3.5 to 10 mm is covered. Of the half that is 1.5 mm, less than a diameter: what is spoiled beyond 5.5 mm counts, too.
    assert cut.contrast_recovery[:5] == pytest.approx(2.0 / np.array(RODS[:5]), rel=0.05)


def test_derenzo_score_refuses_what_it_cannot_take(truth):
    refused(lambda: mph.derenzo_score(truth.array, PHANTOM), "derenzo_score: expected a Volume, got ndarray")
    refused(lambda: mph.derenzo_score(truth, mph.NemaBody()), "with Derenzo rods, got a NEMA body phantom without")
    hu = mph.Volume(truth.array, truth.grid, "hu")
    refused(lambda: mph.derenzo_score(hu, PHANTOM), "derenzo_score: expected a volume of activity or mu, got hu")
    refused(lambda: mph.derenzo_score(truth, PHANTOM, np.zeros((4, 4))), "phantom pose")


GRID = mph.Grid.centered((20, 24, 16), 1.0)


@pytest.fixture
def pair(rng) -> tuple[mph.Volume, mph.Volume]:
    """Return blobs with noise, and without, the truth."""
    values = gaussian_filter(rng.random(GRID.shape), 2.0) * 40
    return mph.Volume(values + 0.5 * rng.standard_normal(GRID.shape), GRID), mph.Volume(values, GRID)


def test_errors_are_those_of_the_definitions(pair):
    volume, truth = pair
    assert (mph.nrmse(truth, truth), mph.psnr(truth, truth), mph.nrmse(uniform(0, GRID), truth)) == (0, np.inf, 1)
    error = volume.array.astype(float) - truth.array
    assert mph.nrmse(volume, truth) == pytest.approx(np.linalg.norm(error) / np.linalg.norm(truth.array), rel=1e-6)
    span = np.ptp(truth.array)
    assert mph.psnr(volume, truth) == pytest.approx(10 * np.log10(span**2 / np.mean(error**2)), rel=1e-6)
    assert mph.psnr(volume, truth, data_range=10 * span) == pytest.approx(mph.psnr(volume, truth) + 20)
    mask = truth.array > np.median(truth.array)
    expected = np.linalg.norm(error[mask]) / np.linalg.norm(truth.array[mask])
    assert mph.nrmse(volume.array, truth.array, mask=mask) == pytest.approx(expected, rel=1e-6)


def ssim_by_scipy(x: np.ndarray, y: np.ndarray, span: float) -> float:
    """Return SSIM as scikit-image's structural_similarity with gaussian_weights and without use_sample_covariance."""

    def windowed(values: np.ndarray) -> np.ndarray:
        return gaussian_filter(values, 1.5, truncate=3.5)[(slice(5, -5),) * values.ndim]

    mx, my = windowed(x), windowed(y)
    vx, vy, vxy = windowed(x * x) - mx**2, windowed(y * y) - my**2, windowed(x * y) - mx * my
    c1, c2 = (0.01 * span) ** 2, (0.03 * span) ** 2
    return float(np.mean((2 * mx * my + c1) * (2 * vxy + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))))


def test_ssim_is_that_of_other_programs(pair):
    x, y = (volume.array.astype(float) for volume in pair)
    assert 0.2 < mph.ssim(*pair) < 0.98 and mph.ssim(pair[1], pair[1]) == pytest.approx(1.0, abs=1e-12)
    assert mph.ssim(*pair) == pytest.approx(ssim_by_scipy(x, y, np.ptp(y)), abs=1e-9)
    assert mph.ssim(x, y, data_range=50) == pytest.approx(mph.ssim(y, x, data_range=50), abs=1e-12)
    # A slice has one of two dimensions.
    assert mph.ssim(x[:, :, :1], y[:, :, :1]) == pytest.approx(ssim_by_scipy(x[..., 0], y[..., 0], np.ptp(y[..., 0])))


def test_similarity_and_errors_do_not_depend_on_the_unit(pair):
    volume, truth = (mph.Volume(1000 * x.array, GRID) for x in pair)
    for score in (mph.nrmse, mph.psnr, mph.ssim):
        assert score(volume, truth) == pytest.approx(score(*pair), rel=1e-5)


def test_volumes_on_different_grids_are_not_compared(pair):
    volume, truth = pair
    moved = mph.Volume(truth.array, mph.Grid.centered(GRID.shape, 1.0, center=(0.5, 0, 0)))
    finer = mph.Volume(truth.array, mph.Grid.centered(GRID.shape, 0.5))
    for score in (mph.nrmse, mph.psnr, mph.ssim):
        for other in (moved, finer):
            with pytest.raises(mph.InputError, match=r"different grids; mph\.resample\(truth, volume\.grid"):
                score(volume, other)
        with pytest.raises(mph.InputError, match="volume of activity, truth of mu"):
            score(volume, mph.Volume(truth.array, GRID, "mu"))
        refused(lambda score=score: score(volume, np.ones((3, 3))), "volume of 20 x 24 x 16, truth of 3 x 3 voxels")
    assert mph.nrmse(volume, mph.resample(moved, GRID, "mean")) > mph.nrmse(volume, truth)


def test_contrast_to_noise(rng):
    values = rng.normal(10, 2, GRID.shape)
    inside = np.zeros(GRID.shape, bool)
    inside[8:12, 8:12, 8:12] = True
    values[inside] += 6
    assert mph.contrast_to_noise(mph.Volume(values, GRID), inside, ~inside) == pytest.approx(3, abs=0.5)
    assert mph.contrast_to_noise(-values, inside, ~inside) == -mph.contrast_to_noise(values, inside, ~inside)
    assert mph.contrast_to_noise(inside.astype(float), inside, ~inside) == np.inf
    for wrong in (inside.astype(int), inside[1:], np.zeros(GRID.shape, bool)):
        with pytest.raises(mph.InputError, match="contrast_to_noise: target: expected"):
            mph.contrast_to_noise(values, wrong, ~inside)


def test_bias_and_deviation_make_the_error(pair, rng):
    _, truth = pair
    draws = [mph.Volume(0.9 * truth.array + rng.normal(0, 0.3, GRID.shape), GRID) for _ in range(12)]
    bias, deviation = mph.bias_and_deviation(iter(draws), truth)
    stack = np.stack([draw.array for draw in draws]).astype(float)
    assert np.allclose(bias.array, stack.mean(axis=0) - truth.array, atol=1e-5)
    assert np.allclose(deviation.array, stack.std(axis=0, ddof=1), atol=1e-5)
    squares = np.mean((stack - truth.array) ** 2, axis=0)
    assert np.allclose(bias.array**2 + 11 / 12 * deviation.array**2, squares, atol=1e-4)
    assert deviation.array.mean() == pytest.approx(0.3, rel=0.05) and bias.unit == "kBq/mL"
    refused(lambda: mph.bias_and_deviation(draws[:1], truth), "expected two volumes or more, got 1")
    volumes = [truth, uniform(1, mph.Grid.centered(8, 1))]
    refused(lambda: mph.bias_and_deviation(volumes, truth), "volume 2: volume and truth are on different grids")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda v: mph.nrmse(v, uniform(0, GRID)), "nrmse: the truth is 0 everywhere"),
        (lambda v: mph.psnr(v, uniform(2, GRID)), "psnr: the truth is the same everywhere"),
        (lambda v: mph.ssim(v, v, data_range=-1), "ssim: data_range: expected more than 0"),
        (lambda v: mph.ssim(np.ones((20, 20, 5)), np.ones((20, 20, 5)), 1), "at least 11 voxels along each axis"),
        (lambda v: mph.nrmse(np.full(3, np.nan), np.ones(3)), "nrmse: nan at index 0|nrmse: nan is not a finite"),
        (lambda v: mph.nrmse("volume", v), "nrmse: expected real numbers"),
    ],
)
def test_images_that_cannot_be_scored(pair, wrong, message):
    refused(lambda: wrong(pair[0]), message)
