"""The study's recipes are understood, and go together: what is judged is trained, on sets that are made."""

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("monai")
pytest.importorskip("lightning")

import mphdrr.core as mph
from mphdrr.core.learning.judging.recipe import read_judge_recipe

FOLDER = Path(__file__).parents[2] / "examples" / "learning"
sys.path.insert(0, str(FOLDER))
import run_study as study  # noqa: E402

TRAININGS = study.trainings(False) + study.trainings(True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    study.scanners(folder)
    return folder


@pytest.mark.parametrize("name", study.EVENTS)
def test_the_recipe_of_each_set_is_understood(folder, name):
    (folder / f"{name}.toml").write_text(study.set_recipe(name), encoding="utf-8")
    recipe = mph.events.read_recipe(folder / f"{name}.toml")
    assert recipe.models["emission"]["model.kind"] == "emission"


@pytest.mark.parametrize("name", [*TRAININGS, "first-0"])
def test_the_recipe_of_each_training_is_understood_and_has_its_seed(folder, name):
    (folder / f"{name}.toml").write_text(study.training_recipe(name), encoding="utf-8")
    recipe = mph.learning.read_recipe(folder / f"{name}.toml")
    assert str(recipe["training.seed"]) == name[-1] and recipe["data.events"] == "sets/train"
    if recipe["network.weights_from"] is not None:
        assert recipe["network.weights_from"] == f"after-osem-half-{name[-1]}.pt"


@pytest.mark.parametrize("name", study.JUDGES)
def test_what_is_judged_is_trained_on_sets_that_are_made(name):
    recipe = read_judge_recipe(FOLDER / f"{name}.toml")
    assert {*recipe.models} <= {*TRAININGS}
    for test in recipe.tests:
        assert test["events"].removeprefix("sets/") in study.EVENTS and {*(test["models"] or ())} <= {*recipe.models}


def test_scanners_differ_as_they_are_said_to(folder):
    scanner, *others = (mph.read_system(folder / f"{n}.xlsx") for n in ("scanner", "moved", "holes", "misaligned"))
    moved, holes, misaligned = others
    np.testing.assert_allclose(np.linalg.norm(moved.centers - scanner.centers, axis=1), 10, atol=1e-9)
    np.testing.assert_allclose(holes.pinhole_diameter, 1.4 * scanner.pinhole_diameter)
    np.testing.assert_allclose(np.linalg.norm(misaligned.centers - scanner.centers, axis=1), 1, atol=1e-9)
    np.testing.assert_allclose(np.degrees(np.linalg.norm(misaligned.tilt, axis=1)), 0.5, atol=1e-9)
