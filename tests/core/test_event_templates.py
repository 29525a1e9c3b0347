"""The recipes to begin with: every one can be read and planned, and is written where it is asked for."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.events.templates import TEMPLATES, template_text

from .conftest import WORKBOOK

EVENTS = 12


@pytest.mark.parametrize("name", TEMPLATES)
def test_every_template_reads_and_plans(name, tmp_path):
    (tmp_path / "recipe.toml").write_text(template_text(name, WORKBOOK), encoding="utf-8")
    recipe = mph.events.read_recipe(tmp_path / "recipe.toml")
    planned = [mph.events.plan(recipe, number) for number in range(EVENTS)]
    assert len({event.noise_seed for event in planned}) == EVENTS
    assert {event.split for event in planned} <= {"train", "validation", "test"}
    for event in planned:
        _ = event.phantom  # the drawn settings go together
        if event.phantom is not None and name != "cardiac":  # it stays in the truth, however it is turned
            half = recipe.grid.spacing * recipe.grid.shape / 2
            reach = event.phantom.extent / 2 * event.size
            assert np.all(np.abs(event.position) + reach <= half + 1e-9)


def test_the_derenzo_template_is_the_users_event():
    recipe = mph.events.EventRecipe(template_text("derenzo"))
    assert recipe.grid.shape == (256, 256, 256)
    np.testing.assert_allclose(recipe.grid.spacing, 1.0)
    assert recipe.radon is not None and recipe.radon.counts == (96, 256)
    assert list(recipe.models) == ["emission"] and recipe.models["emission"]["model.hole"] == "auto"
    maker = mph.events.EventMaker(recipe)
    assert (len(maker.system), maker.views.shape) == (80, (256, 256))
    escaped = mph.events.EventRecipe(template_text("derenzo", 'a "b"\\c.xlsx'))  # what TOML escapes, in a path
    assert escaped.system["system.file"] == 'a "b"\\c.xlsx'


def test_the_cardiac_template_has_hearts_with_and_without_defects():
    recipe = mph.events.EventRecipe(template_text("cardiac"))
    severities = {"normal": set(), "defect": set()}
    for number in range(40):
        event = mph.events.plan(recipe, number)
        severities[event.name].add(event.settings.get("defect_severity", 0.0))
    assert len(event.phantoms) == 4  # the mean of the beat
    assert severities["normal"] == {0.0} and min(severities["defect"]) >= 0.3
    assert recipe.models["emission"]["attenuation.of_phantom"]


def test_a_recipe_is_written_once_and_finds_its_workbook(tmp_path, command, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("scanner.xlsx").write_bytes(WORKBOOK.read_bytes())
    command("events", "new", "--like", "mixed", "--system", "scanner.xlsx", "-o", "recipes/mixed.toml")
    recipe = mph.events.read_recipe("recipes/mixed.toml")
    assert recipe.system["system.file"] == "../scanner.xlsx"
    assert len(mph.events.EventMaker(recipe).system) == 80
    before = Path("recipes/mixed.toml").read_bytes()
    command("events", "new", "-o", "recipes/mixed.toml", status=1)  # edited by hand, perhaps
    assert Path("recipes/mixed.toml").read_bytes() == before
    command("events", "new", "--system", "none.xlsx", status=1)
    assert mph.events.EventRecipe(command("events", "new", "--like", "cardiac").out).seed == 1


@pytest.mark.long
def test_the_example_trains_a_network(tmp_path, monkeypatch, capsys):
    pytest.importorskip("torch")
    monkeypatch.setattr(sys, "argv", ["train.py", "--epochs", "3", "-o", str(tmp_path / "weights.pt")])
    runpy.run_path(str(WORKBOOK.with_name("train.py")), run_name="__main__")
    lines = capsys.readouterr().out.splitlines()
    losses = [float(line.split("train ")[1].split(",")[0]) for line in lines if line.startswith("epoch")]
    assert len(losses) == 3 and losses[-1] < losses[0]
    assert (tmp_path / "weights.pt").stat().st_size > 1000
