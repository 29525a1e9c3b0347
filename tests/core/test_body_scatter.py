"""Scatter in the body, estimated while counts are reconstructed: bias, resume, recipes, the command, refusals."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.reconstruction import body_scatter
from mphdrr.core.reconstruction.counts import CountLoop

from .conftest import refused

STUDY = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "scatter_correction.py"))
TRUE, BODY, *WINDOWS, NONE = STUDY["WAYS"]


def biases(study, draws, ways):
    """Return the bias of each region by each way, by its activity with the true scatter."""
    found = STUDY["compare"](study, draws, (TRUE, *ways))
    means = {way: values.mean(axis=0) for way, (values, _) in found.items()}
    return {way: means[way] / means[TRUE] - 1 for way in ways}


@pytest.mark.long
def test_regions_of_a_torso_are_as_with_the_true_scatter():
    found = biases(STUDY["Study"](), 2, (BODY, WINDOWS[0], NONE))
    assert (abs(found[BODY]) < 0.02).all(), found
    assert (found[NONE] > 0.15).all() and (abs(found[BODY]) < abs(found[WINDOWS[0]])).all(), found


def test_a_small_torso_is_nearly_as_with_the_true_scatter():
    found = biases(STUDY["Study"](8, 12.0, 10, 0.03), 1, (BODY, NONE))
    assert (abs(found[BODY]) < 0.08).all() and (found[NONE] > 0.1).all(), found


@pytest.fixture(autouse=True)
def coarse(request, monkeypatch):
    """Make estimates quick where their accuracy does not matter."""
    if "long" not in request.keywords:
        monkeypatch.setattr(body_scatter, "_PRECISION", 0.02)


@pytest.fixture(scope="module")
def small():
    """Return the projector of six modules around a cylinder of water, and counts of a hot rod in it with scatter."""
    turn = np.arange(6) * np.pi / 3
    centers = np.stack([200 * np.cos(turn), 200 * np.sin(turn), 0 * turn], axis=1)
    system = mph.PinholeSystem(centers, 16.0, 80.0, 200.0, 9.0, 80.0)
    grid = mph.Grid.centered((10, 10, 6), 20.0)
    x, y, _ = (np.indices(grid.shape) - np.array([4.5, 4.5, 2.5])[:, None, None, None]) * 20.0
    mu = mph.Volume(np.where(x**2 + y**2 < 90**2, 0.0154, 0).astype(np.float32), grid, "mu")
    activity = mph.Volume(np.where(x**2 + y**2 < 50**2, 50, 0).astype(np.float32), grid, "activity")
    views = system.views((10, 10), "real")
    model = mph.Emission(system, isotope="Tc-99m", energy_fwhm=0.1, mu=mu, time=10)
    A = mph.Projector(grid, views, model)
    scatter = mph.scatter_images(activity, mu, views, model, precision=0.01, seed=1).images[0]
    return A, mph.sample_counts(A(activity) + scatter, 3), scatter


METHODS = {"mlem": (mph.mlem, {}), "osem": (mph.osem, {"subsets": 2}), "bsrem": (mph.bsrem, {"subsets": 2})}


@pytest.mark.parametrize("name", METHODS)
def test_every_method_finds_the_scatter_and_a_break_changes_nothing(small, name, tmp_path):
    A, counts, scatter = small
    method, more = METHODS[name]
    whole = method(A, counts, 9, scatter="body", **more)
    assert whole.state["scatter"].sum() == pytest.approx(scatter.sum(), rel=0.2 if name == "mlem" else 0.08)
    assert whole.settings["scatter"] == "body"
    with pytest.warns(mph.InputWarning, match="scatter: it was not estimated yet"):
        first = method(A, counts, 1, scatter="body", **more)
    mph.write_reconstruction(first, tmp_path / "first.h5")
    second = method(A, counts, 2, scatter="body", start=mph.read_reconstruction(tmp_path / "first.h5"), **more)
    mph.write_reconstruction(second, tmp_path / "second.h5")
    third = method(A, counts, 6, scatter="body", start=mph.read_reconstruction(tmp_path / "second.h5"), **more)
    assert third.volume.array.tobytes() == whole.volume.array.tobytes()
    np.testing.assert_array_equal(third.objective, whole.objective)
    assert third.settings == whole.settings
    refused(
        lambda: method(A, counts, 1, start=second, **more), "start: this reconstruction is with scatter body, now none"
    )
    expected = A(whole.volume) + whole.state["scatter"]
    assert whole.objective[-1] == pytest.approx(
        float((counts * np.log(np.maximum(expected, 1e-30)) - expected).sum(dtype=float)), rel=1e-5
    )


def test_the_estimate_does_not_change_when_volumes_no_longer_do(small):
    """The limit is the solution of volume and scatter together: both are those of the other."""
    A, counts, _ = small
    found = mph.mlem(A, counts, 40, scatter="body")
    again = mph.mlem(A, counts, 40, background=found.state["scatter"])
    apart = abs(again.volume.array - found.volume.array).sum() / found.volume.array.sum()
    assert apart < 0.03
    body = mph.scatter_images(found.volume, A.model.mu, A.views, A.model, precision=0.01, seed=5).images[0]
    assert body.sum() == pytest.approx(found.state["scatter"].sum(), rel=0.03)


def test_none_is_what_it_was_to_the_byte_and_words_are_refused(small, monkeypatch):
    A, counts, _ = small
    refused(lambda: mph.osem(A, counts, 1, scatter="tew"), "scatter 'tew': expected one of none, body")
    monkeypatch.setattr(CountLoop, "_estimate_scatter", None)  # nothing of it runs
    first, second = mph.osem(A, counts, 3), mph.osem(A, counts, 3, scatter="none")
    assert first.volume.array.tobytes() == second.volume.array.tobytes()
    assert first.settings == second.settings and "scatter" not in first.settings and not first.state
    refused(lambda: mph.osem(A, counts, 1, scatter="body", start=first), "with scatter none, now body")


def test_what_is_missing_is_refused_before_the_work(small):
    A, counts, _ = small
    for lack, words in (
        ({"mu": None}, "scatter: body needs mu (attenuation.file, --mu), which"),
        ({"energy_fwhm": None}, "scatter: body needs energy_fwhm (--set model.energy_fwhm=0.1), which"),
    ):
        B = mph.Projector(A.grid, A.views, replace(A.model, **lack))
        refused(lambda B=B: mph.osem(B, counts, 1, scatter="body"), words)


def test_images_in_the_background_are_warned_of_and_cancel_is_heard(small):
    A, counts, scatter = small
    with pytest.warns(mph.InputWarning, match="scatter: the background holds images, too"):
        mph.osem(A, counts, 2, 2, scatter="body", background=scatter)
    told = []

    def stop(done, total):
        told.append(done / total)
        if told[-1] > 0.26:  # in the second iteration, whose first half is the estimate
            raise mph.Cancelled

    with pytest.raises(mph.Cancelled) as cancelled:
        mph.osem(A, counts, 4, 2, scatter="body", progress=stop)
    assert told == sorted(told) and told[-1] < 0.375
    assert cancelled.value.reconstruction.iterations == 1 and not cancelled.value.reconstruction.state


def test_lines_apart_have_the_body_of_the_main_line(small):
    A, counts, _ = small
    lines = [mph.attenuation("water", energy) / 0.0154 for energy in (171.3, 245.4)]
    mus = tuple(mph.Volume(A.model.mu.array * np.float32(share), A.grid, "mu") for share in lines)
    model = mph.Emission(A.model.system, isotope="In-111", energy_fwhm=0.1, window=(150, 270), mu=mus, time=10)
    found = mph.osem(mph.Projector(A.grid, A.views, model), counts, 3, 2, scatter="body")
    assert 0 < found.state["scatter"].sum() < counts.sum()


def test_recipe_command_and_python_do_the_same(small, command, tmp_path):
    A, counts, _ = small
    mph.write_volume(A.model.mu, tmp_path / "mu.h5")
    recipe = {
        "model.kind": "emission",
        "model.isotope": "Tc-99m",
        "model.time": 10.0,
        "attenuation.file": [str(tmp_path / "mu.h5")],
    }
    recipe = mph.Recipe({**recipe, "model.energy_fwhm": 0.1})
    run = mph.ProjectionRun(
        counts.astype(np.float32), A.model.system, A.views, unit="counts", settings={"recipe": recipe.tables()}
    )
    mph.write_run(run, tmp_path / "run.h5")
    small = ["--voxels", 10, 10, 6, "--spacing", 20, "--iterations", 3, "--subsets", 2, "--hole", "depth"]
    said = command("reconstruct", tmp_path / "run.h5", *small, "--scatter", "body", "-o", tmp_path / "v.h5")
    expected = mph.osem(A, run.projections, 3, 2, scatter="body")
    np.testing.assert_allclose(mph.read_volume(tmp_path / "v.h5").array, expected.volume.array, rtol=1e-4, atol=1e-4)
    share = expected.state["scatter"].sum() / counts.sum()
    assert f"scatter {share:.1%} of the counts" in said.out
    changes = {"reconstruction.scatter": "body", "reconstruction.voxels": [10, 10, 6], "reconstruction.spacing": 20.0,
               "reconstruction.iterations": 3, "reconstruction.subsets": 2}  # fmt: skip
    by_recipe = mph.reconstruct_run(run, recipe.updated(changes))
    np.testing.assert_allclose(by_recipe.volume.array, expected.volume.array, rtol=1e-4, atol=1e-4)
    assert by_recipe.settings["recipe"]["reconstruction"]["scatter"] == "body"
    bad = command("reconstruct", tmp_path / "run.h5", *small, "--scatter", "body", "--ignore-attenuation", "-o",
                  tmp_path / "w.h5", status=1)  # fmt: skip
    assert "scatter: body needs mu (attenuation.file, --mu)" in bad.err
    bad = command(
        "reconstruct", tmp_path / "run.h5", "--method", "sirt", "--scatter", "body", "-o", tmp_path / "w.h5", status=1
    )
    assert "reconstruction.scatter" in bad.err
