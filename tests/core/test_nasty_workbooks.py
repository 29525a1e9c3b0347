"""Workbooks that are easily misread: each is read correctly, refused or warned about; none is silently wrong.

The files are made by hand, by openpyxl, XlsxWriter and LibreOffice. The short run reads a sample of what the layouts and
decorations can be, the long run reads all. MPHDRR_TEST_EXAMPLES=2000 makes more random ones than the default.
"""

from __future__ import annotations

import os
import shutil
import warnings
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np
import openpyxl
import pytest

import mphdrr.core as mph

from .nasty import by_libreoffice, real
from .nasty.books import DAMAGED, FILES, NAMES, NO_WORKBOOKS, WORDS, users_file
from .nasty.case import differences, fault, read, sample
from .nasty.layouts import map_of
from .nasty.sheets import zipped
from .workbooks import by_design

try:
    from hypothesis import HealthCheck, given, settings

    from .nasty.random_books import BASES, every_recipe, recipes, written
except ImportError:
    pytest.skip("hypothesis is not installed", allow_module_level=True)

# The same ones every time, unless more are requested.
EXAMPLES, SAME = int(os.environ.get("MPHDRR_TEST_EXAMPLES", "60")), "MPHDRR_TEST_EXAMPLES" not in os.environ
RECIPES = list(every_recipe())
GROUPS = {name: list(group) for name, group in groupby(RECIPES, lambda recipe: recipe.group)}
ALL_HEALTH = list(HealthCheck)


@pytest.mark.parametrize("every", [2, pytest.param(1, marks=pytest.mark.long)])
@pytest.mark.parametrize("group", GROUPS)
def test_workbook_is_read_right_or_refused_with_its_cell(group, every, tmp_path):
    path = tmp_path / "scanner.xlsx"
    faults = {r.name: fault(written(r, path), path, placed=r.layout in BASES) for r in GROUPS[group][::every]}
    assert not (wrong := {name: words for name, words in faults.items() if words}), wrong


@settings(max_examples=EXAMPLES, derandomize=SAME, deadline=None, suppress_health_check=ALL_HEALTH)
@given(recipes)
def test_random_workbook_is_read_right_or_refused_or_warned_of(tmp_path_factory, recipe):
    path = tmp_path_factory.mktemp("w") / "scanner.xlsx"
    assert not (wrong := fault(written(recipe, path), path, placed=False)), wrong


@pytest.mark.parametrize("name", sample(list(FILES), 4))
def test_odd_file_is_read_right_or_refused(name, tmp_path):
    (draft, members), (bytes_of, draft.plain) = users_file(), FILES[name]
    (tmp_path / "scanner.xlsx").write_bytes(bytes_of(members))
    assert not (wrong := fault(draft, tmp_path / "scanner.xlsx")), wrong


@pytest.mark.parametrize("name", NAMES)
def test_file_of_any_name_is_read_right_or_refused(name, tmp_path):
    (draft, members), (kind, draft.plain) = users_file(), NAMES[name]
    members["[Content_Types].xml"] = members["[Content_Types].xml"].replace(
        NAMES["größe.XLSX"][0].encode(), kind.encode()
    )
    (tmp_path / name).write_bytes(zipped(members))
    assert not (wrong := fault(draft, tmp_path / name)), wrong


def test_file_that_is_no_workbook_or_damaged_is_refused_by_its_name(tmp_path):
    members, path = users_file()[1], tmp_path / "scanner.xlsx"
    contents = {name: (change(members), WORDS.get(name, "")) for name, change in DAMAGED.items()} | NO_WORKBOOKS
    for name, (content, words) in contents.items():
        path.write_bytes(content)
        assert read(path).system is None, name
        assert words in read(path).refusal, name
    (tmp_path / "folder.xlsx").mkdir()
    (tmp_path / "~$scanner.xlsx").write_bytes(b"\x06Someone" + b" " * 100)
    for name, words in (("none", "no such file"), ("folder", "is a folder, expected an"), ("~$scanner", "lock file")):
        assert words in read(tmp_path / f"{name}.xlsx").refusal


@pytest.mark.parametrize("file", by_libreoffice.DRAFTS)
def test_file_of_libreoffice_is_read_right_or_refused_with_its_cell(file, tmp_path):
    path = Path(shutil.copy(by_libreoffice.FOLDER / file, tmp_path / "scanner.xlsx"))
    assert not (wrong := fault(by_libreoffice.DRAFTS[file], path)), wrong


def test_files_of_other_programs_are_refused(tmp_path):
    for file in by_libreoffice.UNREADABLE:
        shutil.copy(by_libreoffice.FOLDER / file, tmp_path / "scanner.xlsx")
        assert read(tmp_path / "scanner.xlsx").refusal, file


@pytest.mark.parametrize("name", sample(list(real.STATES), 4))
def test_real_workbook_is_read_in_every_state_without_a_warning(name, tmp_path):
    path = tmp_path / "scanner.xlsx"
    real.STATES[name](path)
    system, expected = mph.read_system(path), real.truth()
    assert not (wrong := differences(system, expected[: len(system)])), wrong
    assert len(system) == (int(name.split()[0]) if "modules" in name else 80)


@pytest.mark.filterwarnings("ignore::mphdrr.core.errors.InputWarning")
@pytest.mark.parametrize("recipe", sample(RECIPES[::6], 6, [recipe.name for recipe in RECIPES[::6]]))
def test_draft_of_a_map_without_questions_reads_what_is_read_without_it(recipe, tmp_path):
    path = tmp_path / "scanner.xlsx"
    plain = written(recipe, path).plain
    without = read(path)
    try:
        draft = mph.draft_column_map(path)
    except mph.InputError:
        assert without.system is None
        return
    draft.write(tmp_path / "draft.toml")
    assert mph.ColumnMap.read(tmp_path / "draft.toml") == draft.columns
    if draft.questions:
        assert not plain, draft.questions
        return
    drafted = read(path, (tmp_path / "draft.toml").read_text(encoding="utf-8"))
    assert (drafted.system is None) == (without.system is None), drafted.refusal or without.refusal
    if drafted.system is not None:
        assert not (wrong := differences(drafted.system, without.system)), wrong


# Written back in the file's own units


def moved(system: mph.PinholeSystem) -> mph.PinholeSystem:
    """Return the system with its last pinhole elsewhere and its first one wider."""
    centers, diameter = system.centers.copy(), system.pinhole_diameter.copy()
    centers[-1] *= [1.01, 0.98, 1.02]
    diameter[0] *= 1.1
    return by_design(replace(system, centers=centers, pinhole_diameter=diameter))


def assert_written_back(recipe, folder) -> None:
    path = folder / "scanner.xlsx"
    draft = written(recipe, path)
    columns = map_of(draft)
    before = read(path)
    if before.system is None and columns is not None:
        before = read(path, columns)
    else:
        columns = None
    if before.system is None:
        return
    system = moved(before.system)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            mph.write_system(system, folder / "written.xlsx", template=path)
        except mph.InputError as error:
            assert not draft.plain and "\n" not in str(error)
            return
    back = read(folder / "written.xlsx", columns)
    assert back.system is not None, back.refusal
    assert not draft.plain or not back.warnings
    assert not (wrong := differences(back.system, system)), wrong
    np.testing.assert_array_equal(back.system.centers[:-1], before.system.centers[:-1])
    if draft.plain and not draft.layout.formulas:  # changed numbers are in the file's own unit
        sheet, cell = before.system.source.cell("x1", int(before.system.numbers[-1]))
        files = (path, folder / "written.xlsx")
        old, new = (openpyxl.load_workbook(file, data_only=True)[sheet][cell].value for file in files)
        assert new == pytest.approx(old * system.centers[-1, 0] / before.system.centers[-1, 0], rel=1e-12)


@pytest.mark.parametrize("recipe", sample(RECIPES[1::6], 6, [recipe.name for recipe in RECIPES[1::6]]))
def test_workbook_is_written_back_in_its_own_units(recipe, tmp_path):
    assert_written_back(recipe, tmp_path)


@settings(max_examples=max(EXAMPLES // 3, 1), derandomize=SAME, deadline=None, suppress_health_check=ALL_HEALTH)
@given(recipes)
def test_random_workbook_is_written_back_in_its_own_units(tmp_path_factory, recipe):
    assert_written_back(recipe, tmp_path_factory.mktemp("w"))
