"""Dead time: the laws of both kinds of counters, runs that obey them, and reconstructions that know it."""

import numpy as np
import pytest
from scipy.special import lambertw

import mphdrr.core as mph
from mphdrr.core.physics.dead_time import live_shares

from .conftest import refused

KINDS = ["non-paralysable", "paralysable"]
ACTIVE = {
    "phantom.text": "[[shape]]\nkind = 'sphere'\nradius = 30\nactivity = 5\n", "phantom.voxels": 8, "phantom.spacing": 10.0,
    "model.kind": "emission", "model.time": 30.0, "detector.plane": "real", "detector.rows": 8, "detector.columns": 8,
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_counters_record_by_the_law_and_back(kind):
    tau, time = 3e-6, 7.0
    rates = np.concatenate([np.geomspace(1e-3, 3.3e5, 400), [0.0, 1 / tau - 1]])
    recorded = mph.dead_time_counts(rates * time, time, tau, kind) / time
    law = rates / (1 + rates * tau) if kind == "non-paralysable" else rates * np.exp(-rates * tau)
    np.testing.assert_allclose(recorded, law, rtol=1e-12)
    back = mph.dead_time_corrected(recorded * time, time, tau, kind) / time
    tolerance = np.where(rates * tau > 0.999, 1e-6, 1e-9)  # the maximum is flat: the square root of the rounding
    assert (np.abs(back - rates) <= tolerance * rates).all()


def test_a_paralysable_rate_is_lamberts_function_of_what_is_recorded():
    recorded = np.linspace(0.001, 0.3678, 200)
    expected = -lambertw(-recorded).real
    np.testing.assert_allclose(mph.dead_time_corrected(recorded, 1.0, 1.0, "paralysable"), expected, rtol=1e-9)
    assert mph.dead_time_corrected(np.exp(-1), 1.0, 1.0, "paralysable") == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_a_module_is_busy_as_a_whole(kind, rng):
    images, times, tau = rng.uniform(1e3, 4e3, (5, 4, 6)), rng.uniform(0.5, 2.0, 5), 2e-6
    recorded = mph.dead_time_counts(images, times, tau, kind)
    totals = mph.dead_time_counts(images.sum((1, 2)), times, tau, kind)
    np.testing.assert_allclose(recorded.sum((1, 2)), totals)
    assert np.ptp(recorded / images, axis=(1, 2)).max() < 1e-12, "all pixels of a module lose the same share"
    np.testing.assert_allclose(mph.dead_time_corrected(recorded, times, tau, kind), images, rtol=1e-9)
    np.testing.assert_allclose(live_shares(recorded, times, tau, kind)[:, 0, 0], totals / images.sum((1, 2)), rtol=1e-9)


def test_what_no_counter_records_is_refused():
    for kind, most in (("non-paralysable", 1e6), ("paralysable", 1e6 / np.e)):
        words = f"at index 1, but a {kind} counter that is busy for 1e-06 s records at most"
        refused(lambda m=most, k=kind: mph.dead_time_corrected([1.0, 1.01 * m], 1.0, 1e-6, k), words)
    for counts, time, tau in (([-1.0], 1.0, 1e-6), ([1.0], 0.0, 1e-6), ([1.0], 1.0, -1e-6), ([1.0, 2.0], [1.0] * 3, 0)):
        refused(lambda arguments=(counts, time, tau): mph.dead_time_counts(*arguments), "dead time: expected")
    words = "kind 'both': expected one of non-paralysable, paralysable"
    refused(lambda: mph.dead_time_counts([1.0], 1.0, 1e-6, "both"), words)


@pytest.mark.parametrize("kind", KINDS)
def test_runs_lose_counts_and_reconstructions_know_it(system, kind, tmp_path):
    """Noise-free, the volume is a fixed point of MLEM, whatever dead time takes; without knowing it, it is not."""
    few = system[:5]
    recipe = mph.Recipe(ACTIVE | {"model.background": 0.5})
    (plain,) = mph.run_recipe(recipe, few)
    rates = plain.projections.sum((1, 2), dtype=float) / 30
    busy = recipe.updated({"model.dead_time": 0.4e6 / rates.max(), "model.dead_time_kind": kind})
    (run,) = mph.run_recipe(busy, few)
    expected = mph.dead_time_counts(plain.projections, 30.0, 0.4 / rates.max(), kind)
    np.testing.assert_allclose(run.projections, expected, rtol=1e-5)
    shares = run.projections.sum((1, 2)) / plain.projections.sum((1, 2))
    np.testing.assert_allclose(run.background, 0.5 * shares, rtol=1e-5)
    mph.write_run(run, tmp_path / "a.h5")
    run = mph.read_run(tmp_path / "a.h5")
    A = mph.projector_of_run(run, run.volume.grid)
    np.testing.assert_allclose(A(run.volume) + A.background, run.projections, rtol=1e-5)
    truth = run.volume.array
    np.testing.assert_allclose(mph.mlem(A, run.projections, 2, start=truth).volume.array, truth, rtol=1e-4)
    unaware = mph.projector_of_run(run, run.volume.grid, recipe=run.recipe.updated({"model.dead_time": None}))
    assert mph.mlem(unaware, run.projections, 2, start=truth).volume.array.sum() < 0.95 * truth.sum()
    measured = mph.counts_run(run.projections, few, few.numbers, "back-v", 30.0, recipe=busy, expected=True)
    B = mph.projector_of_run(measured, run.volume.grid)
    np.testing.assert_allclose(np.ravel(B.model.efficiency), np.ravel(A.model.efficiency), rtol=1e-9)
    np.testing.assert_allclose(measured.background, run.background, rtol=1e-5)


def test_noise_of_a_busy_module_is_that_of_what_it_records(system):
    recipe = mph.Recipe(ACTIVE | {"model.dead_time": 100.0})
    (mean,), (noisy,) = (mph.run_recipe(r, system[:2]) for r in (recipe, recipe.updated({"noise.seed": 3})))
    np.testing.assert_array_equal(noisy.projections, mph.sample_counts(mean.projections, 3))


def test_a_paralysable_module_beyond_its_maximum_is_said(system):
    (plain,) = mph.run_recipe(mph.Recipe(ACTIVE), system[:2])
    rate = plain.projections.sum((1, 2)).max() / 30
    recipe = mph.Recipe(ACTIVE | {"model.dead_time": 1.5e6 / rate, "model.dead_time_kind": "paralysable"})
    with pytest.warns(mph.InputWarning, match="so many photons that more of them would be fewer counts, in module 10"):
        next(mph.run_recipe(recipe, system[:2]))
    settings = ACTIVE | {"model.dead_time_kind": "paralysable"}
    refused(lambda: mph.Recipe(settings), "model.dead_time_kind ", " needs model.dead_time")
