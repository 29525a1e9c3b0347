"""Scatter in runs and event sets: what is added, kept, shown and written."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.events import EventMaker

from .conftest import refused
from .small_events import TEXT, WORKBOOK, small_recipe, with_phantoms

GIVEN = {
    "system.file": str(WORKBOOK), "system.modules": "1-3", "detector.rows": 8, "detector.columns": 8,
    "phantom.kind": "derenzo", "phantom.cylinder_radius": 50.0, "phantom.cylinder_height": 60.0, "phantom.mu": 0.0153,
    "phantom.voxels": (16,), "phantom.spacing": (8.0,), "model.kind": "emission", "model.isotope": "Tc-99m",
    "model.energy_fwhm": 0.1, "model.time": 60.0, "model.background": 0.5, "attenuation.of_phantom": True,
}  # fmt: skip
SCATTER = {"scatter.model": "body", "scatter.precision": 0.05, "scatter.seed": 7}


def run_of(**changes):
    """Return the only run of the recipe with changes, whose keys have __ for the dot; None takes an entry out."""
    values = GIVEN | SCATTER | {key.replace("__", "."): value for key, value in changes.items()}
    (run,) = mph.run_recipe(mph.Recipe({key: value for key, value in values.items() if value is not None}))
    return run


@pytest.fixture(scope="module")
def run():
    return run_of()


def test_a_run_has_the_counts_without_scatter_and_the_scatter_of_its_body(run):
    without = run_of(scatter__model="none", scatter__precision=None, scatter__seed=None)
    assert without.scatter is None
    np.testing.assert_allclose(run.projections, without.projections + run.scatter, rtol=1e-6)
    model = mph.projector_of_run(run, run.volume.grid).model
    found = mph.scatter_images(run.volume, model.mu, run.views, model, precision=0.05, seed=7)
    np.testing.assert_array_equal(run.scatter, found.images[0])
    assert 0.05 < run.scatter.sum() / (run.projections.sum() - 0.5 * run.projections.size) < 0.5
    np.testing.assert_array_equal(run.background, without.background)  # which scatter is no part of


def test_noise_and_dead_time_see_the_sum(run):
    drawn = run_of(noise__seed=3)
    np.testing.assert_array_equal(drawn.projections, mph.sample_counts(run.projections, 3))
    slow = run_of(model__dead_time=1e5)  # µs
    shares = slow.projections.sum(axis=(1, 2)) / run.projections.sum(axis=(1, 2))
    assert (shares < 0.9).all()
    np.testing.assert_allclose(slow.scatter, run.scatter * shares[:, None, None], rtol=1e-4)


@pytest.mark.parametrize("ending", [".h5", ".npz"])
def test_files_hold_the_scatter(run, tmp_path, ending):
    mph.write_run(run, tmp_path / f"run{ending}")
    again = mph.read_run(tmp_path / f"run{ending}")
    np.testing.assert_array_equal(again.scatter, run.scatter)
    assert again.recipe["scatter.precision"] == 0.05
    for name in ("primary", "scatter"):
        part = again.of_photons(name)
        np.testing.assert_allclose(
            part.projections, run.scatter if name == "scatter" else run.projections - run.scatter, rtol=1e-6
        )
        refused(lambda part=part: part.of_photons("scatter"), "the run holds no scatter")
    assert again.of_photons("all") is again


def test_the_command_line_simulates_scatter_and_shows_it(tmp_path, command):
    options = tuple(f"--set=phantom.{name}={value}" for name, value in
                    (("cylinder_radius", 50), ("cylinder_height", 60), ("mu", 0.0153)))  # fmt: skip
    counts = ("--emission", "--isotope", "Tc-99m", "--energy-fwhm", 0.1, "--phantom-mu", "--size", 8, 8)
    scatter = ("--scatter", "body", "--scatter-precision", 0.05, "--scatter-seed", 7, "--voxels", 16, "--spacing", 8)
    file = tmp_path / "run.h5"
    command(
        "project", WORKBOOK, "--modules", "1-3", "--phantom-kind", "derenzo", *options, *counts, *scatter, "-o", file
    )
    command("export", file, "--photons", "scatter", "-o", tmp_path / "scatter.npz")
    run = mph.read_run(file)
    np.testing.assert_array_equal(mph.read_run(tmp_path / "scatter.npz").projections, run.scatter)


def test_frames_have_their_own_scatter():
    values = GIVEN | SCATTER | {"frames.times": (60.0, 60.0), "frames.starts": (0.0, 0.0)}
    del values["model.time"]
    frames = list(mph.run_recipe(mph.Recipe(values)))
    assert [frame.recipe["scatter.seed"] for frame in frames] == [7, 8]
    assert not np.array_equal(frames[0].scatter, frames[1].scatter)


def test_what_scatter_takes_is_asked_for():
    refused(lambda: run_of(model__energy_fwhm=None), "scatter.model", "model.energy_fwhm")
    refused(lambda: run_of(model__isotope=None, model__energy_fwhm=None), "model.isotope and model.energy_fwhm")
    refused(lambda: run_of(attenuation__of_phantom=False), "no attenuation")
    refused(lambda: mph.Recipe({"scatter.model": "body"}), "model.kind")
    refused(lambda: run_of(scatter__precision=0.0), "scatter.precision")
    refused(lambda: run_of(scatter__model="water"), "none", "body")


def test_each_event_has_its_own_scatter_however_often_it_is_made(tmp_path):
    body = '[[phantoms]]\nkind = "derenzo"\ncylinder_radius = 45\ncylinder_height = 60\nmu = 0.0153\n'
    text = with_phantoms(body, TEXT).replace('[models.lines]\nkind = "transmission"\n', "")
    with_scatter = text.replace(
        "background = 0.25",
        'background = 0.25\nisotope = "Tc-99m"\nenergy_fwhm = 0.1\nattenuation = "phantom"\n'
        'scatter.model = "body"\nscatter.precision = 0.1',
    )
    recipe = small_recipe(tmp_path, with_scatter)
    first, second = (EventMaker(recipe).make(number) for number in (0, 1))
    np.testing.assert_array_equal(EventMaker(recipe).make(1).images["emission"], second.images["emission"])
    without = with_scatter[: with_scatter.index("scatter.model")] + with_scatter[with_scatter.index("[radon]") - 1 :]
    plain = [EventMaker(small_recipe(tmp_path / "plain", without)).make(n).images["emission"] for n in (0, 1)]
    scatter = [made.images["emission"] - image for made, image in zip((first, second), plain, strict=True)]
    assert all(0.02 < part.sum() / image.sum() < 0.5 for part, image in zip(scatter, plain, strict=True))
    np.testing.assert_array_equal(plain[0], plain[1])  # nothing else differs
    assert not np.array_equal(*scatter)
    event = mph.events.make(recipe, tmp_path / "set", 1)[0]
    changes = {"reconstruction.voxels": [8], "reconstruction.iterations": 1, "reconstruction.subsets": 1}
    drawn = event.run("emission", noise_seed=1)
    with pytest.warns(mph.InputWarning, match="some of the counts are scatter that nothing corrects"):
        mph.reconstruct_run(drawn, drawn.recipe.updated(changes))
    wrong = with_scatter.replace('scatter.model = "body"\nscatter.precision = 0.1', 'scatter = "body"')
    refused(lambda: small_recipe(tmp_path / "wrong", wrong), "scatter", 'scatter.model = "body"')


def test_scatter_that_nothing_corrects_is_said(run):
    recipe = run.recipe.updated({"reconstruction.voxels": [8], "reconstruction.spacing": 16.0,
                                 "reconstruction.iterations": 2, "reconstruction.subsets": 1})  # fmt: skip
    with pytest.warns(mph.InputWarning, match=r"\d+% of the counts are scatter that nothing corrects"):
        mph.reconstruct_run(run, recipe)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        mph.reconstruct_run(run, recipe.updated({"reconstruction.scatter": "body"}))
    assert not any("nothing corrects" in str(warning.message) for warning in said)
