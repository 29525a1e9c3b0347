"""Keys that no recipe knows: refused in every table, with their name."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import deepcopy
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

import mphdrr.core as mph
from mphdrr.core import events, learning
from mphdrr.core.design.calibration_recipe import run_calibration
from mphdrr.core.design.recipe import TEMPLATE as DESIGN
from mphdrr.core.design.recipe import read_design_recipe
from mphdrr.core.events.templates import TEMPLATES, template_text
from mphdrr.core.learning.recipe import template_text as training_text
from mphdrr.core.recipes.toml import parse_toml
from mphdrr.core.runs.recipe import Recipe, read_recipe, write_recipe

from .conftest import FEWER_MODULES as WORKBOOK
from .conftest import refused
from .mutated_recipes import KEY, at, document, tables
from .small_design import TEXT as SMALL_DESIGN

JUDGE = """
version = 1
[grid]
voxels = 8
spacing = 10
[[tests]]
name = "a"
events = "set"
[validation]
events = "set"
[baselines]
stops = [2, 4]
"""
CALIBRATION = """
[runs]
files = ["a.h5"]
[system]
file = "a.xlsx"
[sources]
points = [[0, 0, 0]]
[fit]
collimator_length = true
[priors]
position_sd = 3
"""
SHAPES = '[[shape]]\nkind = "sphere"\nradius = 20\nactivity = 50\n'
WORKBOOK_DESIGN = SMALL_DESIGN[SMALL_DESIGN.index("[[objectives]]") :]
GENERATORS = {
    "polygon": "modules = 1\nsides = 3\napothem = 150\nz = 0\npinhole_diameter = 4\ndetector_side = 50\n"
    "detector_thickness = 8\nroi_radius = 26\n[free]\napothem = [100, 200]\n",
    "workbook": f"file = {str(WORKBOOK)!r}\nby = 'ring'\nradial = 0\n[free]\nradial = [-3, 3]\n",
}


def run_recipe_text(folder: Path) -> str:
    """Return a recipe of runs with entries in most tables."""
    tables = {
        "system.file": str(WORKBOOK), "phantom.kind": "derenzo", "model.kind": "emission", "detector.rows": 4,
        "reconstruction.method": "osem", "compute.backend": "numpy", "noise.seed": 1,
    }  # fmt: skip
    write_recipe(Recipe(tables), folder / "run.toml")
    return (folder / "run.toml").read_text()


def recipes(folder: Path) -> Iterator[tuple[str, str, Callable[[Path], Any]]]:
    """Yield the name, the text and the reader of a recipe of every kind."""
    yield "run", run_recipe_text(folder), read_recipe
    for name in TEMPLATES:
        yield f"events {name}", template_text(name, WORKBOOK), events.read_recipe
    if find_spec("torch"):  # what reads them needs it
        yield "training", training_text("after-osem"), learning.read_recipe
        yield "judge", JUDGE, learning.read_judge_recipe
    yield "design", DESIGN.read_text(), read_design_recipe
    for kind, text in GENERATORS.items():
        yield (
            f"design {kind}",
            f"version = 1\n[generator]\nkind = '{kind}'\n{text}{WORKBOOK_DESIGN}",
            read_design_recipe,
        )
    yield "calibration", CALIBRATION, run_calibration
    yield "phantom", SHAPES, mph.read_phantom


def test_unknown_keys_are_refused_in_every_table_of_every_recipe(tmp_path):
    count, file = 0, tmp_path / "changed.toml"
    for name, text, read in recipes(tmp_path):
        values = parse_toml(text, name)
        for path in tables(values):
            changed = deepcopy(values)
            at(changed, path)[KEY] = 3
            file.write_bytes(document(changed))
            # The keys of splits are names that users choose, with shares that sum to 1.
            refused(lambda read=read: read(file), "sum to 1" if path == ("splits",) else KEY)
            count += 1
    assert count >= (196 if find_spec("torch") else 150)  # docs/troubleshooting.md says so


def test_recipes_without_unknown_keys_are_read(tmp_path):
    for name, text, read in recipes(tmp_path):
        (tmp_path / "same.toml").write_text(text)
        if name != "calibration":  # which needs runs
            read(tmp_path / "same.toml")


@pytest.mark.parametrize("name", ["system", "group"])
def test_arguments_that_follow_from_others_are_no_entries(tmp_path, name):
    file = tmp_path / "design.toml"
    table = f"version = 1\n[generator]\nkind = 'workbook'\n{name} = 1\n{GENERATORS['workbook']}{WORKBOOK_DESIGN}"
    file.write_text(table)
    refused(lambda: read_design_recipe(file), f"generator.{name}: no such entry")
