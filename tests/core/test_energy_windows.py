"""Scatter from energy windows: the estimate's laws, and files with frames of several windows."""

import math

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.physics.energy_window import peak_shares

from . import dicom_files
from .conftest import refused
from .test_measured_counts import write_hdr

EDGES = ((120.0, 126.0), (126.0, 154.0), (154.0, 160.0))
WIDTHS = (6.0, 28.0, 6.0)
ORDER = {"counts.frames": "none*12, 101-112, none*12", "counts.lower_frames": "101-112, none*24",
         "counts.upper_frames": "none*24, 101-112"}  # fmt: skip


def continuum(shape, rng, falls_to=None):
    """Return counts in the windows of a continuum that is linear in energy, another one in each pixel."""
    height, slope = rng.uniform(2, 9, shape), rng.uniform(-0.03, 0.0, shape)
    if falls_to is not None:
        slope = -height / (falls_to - 140.0)
    return [(high - low) * (height + slope * ((low + high) / 2 - 140.0)) for low, high in EDGES]


def test_triple_windows_find_a_linear_continuum_exactly(rng):
    lower, scatter, upper = continuum((3, 4, 5), rng)
    peak = scatter + rng.uniform(0, 100, scatter.shape)
    found, variance = mph.energy_window_scatter(lower, peak, upper, WIDTHS)
    np.testing.assert_allclose(found, scatter, rtol=1e-12)
    np.testing.assert_allclose(variance, (28 / 12) ** 2 * (lower + upper), rtol=1e-12)


def test_double_windows_let_the_continuum_fall_to_nothing_at_the_missing_side(rng):
    """The upper window's middle, as far from the peak's as the lower's, has no scatter: a triangle."""
    lower, scatter, _ = continuum((3, 4, 5), rng, falls_to=157.0)
    found, _ = mph.energy_window_scatter(lower, scatter, None, (6.0, 28.0, None))
    np.testing.assert_allclose(found, scatter, rtol=1e-12)
    same, _ = mph.energy_window_scatter(lower, scatter, None, (28.0, 28.0, None))
    np.testing.assert_allclose(same, lower / 2)
    mirrored, _ = mph.energy_window_scatter(None, scatter, lower, (None, 28.0, 6.0))
    np.testing.assert_array_equal(mirrored, found)


@pytest.mark.parametrize("fwhm", [None, 3.0])
def test_the_variance_is_that_of_draws(rng, fwhm):
    means = continuum((1, 9, 8), rng)
    draws = [rng.poisson(mean, (1000, *mean.shape[1:])) for mean in means]
    found, stated = mph.energy_window_scatter(*draws, WIDTHS, fwhm)
    spread = np.var(found, axis=0, ddof=1)
    assert stated.mean() == pytest.approx(spread.mean(), rel=0.05)
    for part in (np.s_[:2], np.s_[:, -2:], np.s_[3:6]):  # at the edges, too
        assert stated.mean(axis=0)[part].mean() == pytest.approx(spread[part].mean(), rel=0.05)
    expected, _ = mph.energy_window_scatter(*means, WIDTHS, fwhm)
    np.testing.assert_allclose(found.mean(axis=0), expected[0], atol=6 * np.sqrt(stated.mean() / 1000))


def test_smoothing_leaves_what_is_even_and_knows_the_pixels_efficiencies(rng):
    """Even scatter on pixels of any efficiency is found exactly, whatever dead and hot ones hold."""
    even = np.full((2, 7, 9), 5.0)
    estimate, variance = mph.energy_window_scatter(even, even, even, WIDTHS, 4.0)
    np.testing.assert_allclose(estimate, 5 * 28 / 6, rtol=1e-12)
    assert (variance < mph.energy_window_scatter(even, even, even, WIDTHS)[1] / 4).all()
    efficiency = rng.uniform(0.5, 1.5, (2, 7, 9))
    lower = 5 * efficiency
    bad = rng.random(lower.shape) < 0.2
    efficiency[bad], lower[bad] = 0, rng.choice([0, 1e4], bad.sum())
    found, variance = mph.energy_window_scatter(lower, lower, lower, WIDTHS, 3.0, efficiency)
    np.testing.assert_allclose(found, efficiency * 5 * 28 / 6, rtol=1e-12)
    assert not variance[bad].any() and variance[~bad].all()
    none, _ = mph.energy_window_scatter(lower, lower, lower, WIDTHS, 3.0, np.zeros(lower.shape))
    assert not none.any()
    draws = rng.poisson(np.where(bad, 0, lower)[0], (2000, *lower.shape[1:]))
    draws, stated = mph.energy_window_scatter(draws, draws, None, WIDTHS, 3.0, efficiency[0])
    assert stated.mean() == pytest.approx(np.var(draws, axis=0, ddof=1).mean(), rel=0.05)


def test_no_window_no_width_and_no_counts_are_refused(rng):
    counts = np.ones((2, 3, 3))
    for arguments, words in (
        ((None, counts, None, WIDTHS), ("lower or the upper",)),
        ((counts, counts, counts, (6.0, 28.0)), ("widths", "2")),
        ((counts, counts, counts, (6.0, 28.0, None)), ("width of the upper window",)),
        ((counts[:1], counts, None, WIDTHS), ("lower", "2 x 3 x 3")),
        ((-counts, counts, None, WIDTHS), ("lower", "-1")),
        ((counts[0], counts[0], None, WIDTHS), ("peak", "M, n_v, n_u")),
        ((counts, counts, None, WIDTHS, 0.0), ("fwhm",)),
    ):
        refused(lambda arguments=arguments: mph.energy_window_scatter(*arguments), *words)


def windows_said():
    """Return DICOM's tags of frames of three windows, 12 frames each."""
    from pydicom.dataset import Dataset

    windows = []
    for low, high in EDGES:
        window, span = Dataset(), Dataset()
        span.EnergyWindowLowerLimit, span.EnergyWindowUpperLimit = low, high
        window.EnergyWindowRangeSequence = [span]
        windows.append(window)
    vector = np.repeat([1, 2, 3], 12).tolist()
    return {"EnergyWindowInformationSequence": windows, "EnergyWindowVector": vector, "NumberOfEnergyWindows": 3}


def recipe_of(path, **changes):
    files = list(map(str, path if isinstance(path, list) else [path]))
    settings = {"counts.files": files, "counts.orientation": "back-v", "model.time": 60.0, "model.kind": "emission"}
    return mph.Recipe({**settings, **ORDER, **changes})


@pytest.fixture
def frames(rng):
    """Return frames of the lower, the peak's and the upper window."""
    return np.concatenate([rng.poisson(mean, (12, 6, 6)) for mean in (6.0, 90.0, 3.0)]).astype(np.uint16)


def scatter_of(frames, **more):
    """Return the estimate of frames in the order of their windows, as a run's images lie on the crystals ("back-v")."""
    lower, peak, upper = frames.reshape(3, 12, 6, 6).astype(float)
    return mph.energy_window_scatter(lower, peak, upper, WIDTHS, **more)[0]


@pytest.mark.parametrize("ending", ["dcm", "hdr", "files"])
def test_one_recipe_imports_three_windows_and_reconstructions_expect_their_scatter(system, frames, ending, tmp_path):
    path = tmp_path / f"nm.{ending}"
    if ending == "dcm":
        pytest.importorskip("pydicom")
        dicom_files.write_frames(frames, path, 60_000, **windows_said())
    elif ending == "hdr":
        write_hdr(frames, path)
        said = ["number of energy windows := 3"]
        for number, (low, high) in enumerate(EDGES, 1):
            said += [f"energy window lower level[{number}] := {low}", f"energy window upper level [{number}] := {high}"]
        text = path.read_text().replace("!time per projection (sec) := 600", "!time per projection (sec) := 60")
        path.write_text(text.replace("number of energy windows := 1", "\n".join(said)))
    else:
        path = [tmp_path / f"{k}.npy" for k in range(3)]
        for one, part in zip(path, frames.reshape(3, 12, 6, 6), strict=True):
            np.save(one, part)
    widths = {} if ending != "files" else {"counts.window_widths": WIDTHS}
    (run,) = mph.run_recipe(recipe_of(path, **{"model.background": 0.5, **widths}), system)
    np.testing.assert_array_equal(run.projections, frames[12:24])
    np.testing.assert_allclose(run.background, 0.5 + scatter_of(frames), rtol=1e-6)
    assert run.settings["scatter"]["widths_keV"] == list(WIDTHS)
    mph.write_run(run, tmp_path / "run.h5")
    again = mph.read_run(tmp_path / "run.h5")
    A = mph.projector_of_run(again, mph.Grid.centered(4, 30.0))
    np.testing.assert_allclose(A.background, run.background, rtol=1e-6)
    recipe = mph.Recipe({"reconstruction.method": "mlem", "reconstruction.iterations": 2, "reconstruction.voxels": 4,
                         "reconstruction.spacing": 30.0})  # fmt: skip
    found = mph.reconstruct_run(again, recipe).volume
    bare = mph.Projector(A.grid, A.views, mph.Emission(system, time=60.0))
    expected = mph.mlem(bare, run.projections, 2, background=run.background).volume
    np.testing.assert_allclose(found.array, expected.array, rtol=1e-4)
    more = mph.projector_of_run(again, A.grid, recipe=again.recipe.updated({"model.background": 0.75}))
    np.testing.assert_allclose(more.background, run.background + 0.25, rtol=1e-6)


def test_dead_time_is_that_of_all_windows_and_has_reduced_the_scatter_already(system, frames, tmp_path):
    np.save(tmp_path / "c.npy", frames)
    settings = {"counts.window_widths": WIDTHS, "model.dead_time": 500.0, "model.background": 2.0}
    (run,) = mph.run_recipe(recipe_of(tmp_path / "c.npy", **settings), system)
    mph.write_run(run, tmp_path / "run.h5")
    A = mph.projector_of_run(mph.read_run(tmp_path / "run.h5"), mph.Grid.centered(4, 30.0))
    np.testing.assert_allclose(A.background, run.background, rtol=1e-6)
    busy = 500e-6 * frames.reshape(3, 12, -1).sum(axis=(0, 2), dtype=float) / 60.0
    np.testing.assert_allclose(A.model.efficiency, 1 - busy, rtol=1e-12)
    without = mph.projector_of_run(run, A.grid, recipe=run.recipe.updated({"model.background": 0.0}))
    np.testing.assert_allclose(without.background, scatter_of(frames), rtol=1e-6)
    assert (A.background < without.background + 2.0).all()


def test_scatter_is_smoothed_by_what_the_run_says_of_its_pixels(system, frames):
    efficiency = np.ones((12, 6, 6))
    efficiency[2, 1, 4] = efficiency[7] = 0
    frames[2, 1, 4] = 60_000  # hot below the peak
    arguments = (frames, system, ORDER["counts.frames"], "back-v", 60.0)
    windows = mph.ScatterWindows(ORDER["counts.lower_frames"], None, WIDTHS, 3.0)
    run = mph.counts_run(*arguments, scatter=windows, efficiency=efficiency)
    assert run.background.max() < 4 * frames[:12][efficiency > 0].max()
    upright = mph.counts_run(*arguments, detector="virtual", scatter=windows, efficiency=efficiency[:, ::-1, ::-1])
    np.testing.assert_allclose(upright.background, run.background[:, ::-1, ::-1], rtol=1e-6)


def test_the_script_says_the_same_windows_and_smooths(system, frames, tmp_path):
    arguments = (frames, system, ORDER["counts.frames"], "back-v", 60.0)
    windows = mph.ScatterWindows(ORDER["counts.lower_frames"], None, WIDTHS, 3.0)
    run = mph.counts_run(*arguments, scatter=windows)
    lower, peak, _ = frames.reshape(3, 12, 6, 6)
    np.testing.assert_allclose(run.background, mph.energy_window_scatter(lower, peak, None, WIDTHS, 3.0)[0], rtol=1e-6)
    np.save(tmp_path / "c.npy", frames)
    changes = {"counts.window_widths": WIDTHS, "counts.scatter_fwhm": 3.0, "counts.upper_frames": None}
    (same,) = mph.run_recipe(recipe_of(tmp_path / "c.npy").updated(changes), system)
    np.testing.assert_array_equal(same.background, run.background)
    assert not np.any(mph.counts_run(*arguments).background)


def test_what_files_contradict_is_refused(system, frames, tmp_path):
    pytest.importorskip("pydicom")
    path = tmp_path / "nm.dcm"
    dicom_files.write_frames(frames, path, 60_000, **windows_said())
    np.save(tmp_path / "c.npy", frames)
    widths, lower, upper = "counts.window_widths", "counts.lower_frames", "counts.upper_frames"

    def imported(file=path, **changes):
        return next(mph.run_recipe(recipe_of(file).updated(changes), system))

    for call, words in (
        (lambda: imported(**{widths: (6, 20, 6)}), ("nm.dcm", "peak window of 28 keV", "20")),
        (lambda: imported(**{upper: ORDER[lower]}), ("upper_frames", "another window")),
        (lambda: imported(**{upper: ORDER[lower], lower: ORDER[upper]}), ("lower_frames", "157 keV", "140 keV")),
        (lambda: imported(**{upper: "1-12"}), ("upper_frames", "frames")),
        (lambda: imported(tmp_path / "c.npy"), ("c.npy", "--window-widths")),
        (lambda: mph.ScatterWindows(), ("lower_frames", "upper_frames")),
        (lambda: mph.Recipe({"model.kind": "emission", "counts.files": ["a"], widths: WIDTHS}), ("window_widths",)),
        (lambda: imported(**{"counts.scatter_tails": True}), ("scatter_tails", "isotope")),
        (lambda: imported(tmp_path / "c.npy", **TAILS, **{widths: WIDTHS}), ("energies", "lower window's")),
    ):
        refused(call, *words)
    assert imported(**{widths: WIDTHS}).background.ndim == 3


@pytest.mark.parametrize("window", ["both", "lower"])
def test_tails_of_the_peak_are_no_scatter(rng, window):
    """Counts are a linear continuum, or one that falls to nothing, and a Gaussian peak: the continuum is found exactly."""
    sigma, shape, n = 0.1 * 140.5 / np.sqrt(8 * np.log(2)), (3, 4, 5), 3 if window == "both" else 2
    missing = [None] * (3 - n)
    edges, widths = [*EDGES[:n], *missing], [*WIDTHS[:n], *missing]
    shares = peak_shares(mph.isotope("Tc-99m"), edges, 0.1)
    for (low, high), share in zip(EDGES[:n], shares, strict=False):
        below_high, below_low = (math.erf((energy - 140.5) / sigma / 2**0.5) for energy in (high, low))
        assert share == pytest.approx((below_high - below_low) / 2, rel=1e-9)
    scatter, photons = continuum(shape, rng, falls_to=157.0 if missing else None), rng.uniform(100, 900, shape)
    means = [part + share * photons for part, share in zip(scatter[:n], shares, strict=False)]
    estimate, _ = mph.energy_window_scatter(*means, *missing, widths, shares=shares)
    np.testing.assert_allclose(estimate, scatter[1], rtol=1e-12)
    draws = [rng.poisson(mean[:1], (1000, 4, 5)) for mean in means]
    estimates, variance = mph.energy_window_scatter(*draws, *missing, widths, shares=shares)
    assert variance.mean() == pytest.approx(np.var(estimates, axis=0, ddof=1).mean(), rel=0.05)


TAILS = {"model.isotope": "Tc-99m", "model.energy_fwhm": 0.1, "counts.scatter_tails": True}


def test_a_recipe_takes_tails_off(system, frames, tmp_path):
    pytest.importorskip("pydicom")
    dicom_files.write_frames(frames, path := tmp_path / "nm.dcm", 60_000, **windows_said())
    (run,) = mph.run_recipe(recipe_of(path, **TAILS), system)
    shares = peak_shares(mph.isotope("Tc-99m"), EDGES, 0.1)
    np.testing.assert_allclose(run.background, scatter_of(frames, shares=shares).clip(min=0), rtol=1e-5, atol=1e-5)
