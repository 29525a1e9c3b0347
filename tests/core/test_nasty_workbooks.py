"""Workbooks that are easily misread: each is read correctly, refused or warned about; none is silently wrong.

The files are made by hand, by openpyxl, XlsxWriter and LibreOffice. The short run reads a sample of each catalogue, the
long run reads all. MPHDRR_TEST_EXAMPLES=2000 makes more random ones than the default.
"""

from __future__ import annotations

import os
import warnings
from dataclasses import replace

import numpy as np
import openpyxl
import pytest

import mphdrr.core as mph

from .nasty import books, by_libreoffice, headings, layouts, maps, real, rows, units, values
from .nasty.case import differences, fault, read, sample, write
from .nasty.scanners import ONE_SHEET_COLUMNS, SYMBOLS, one_sheet, one_sheet_map, users, users_map
from .nasty.sheets import by_hand
from .workbooks import by_design

try:
    from hypothesis import HealthCheck, given, settings

    from .nasty.random_books import map_of, recipes, written
except ImportError:  # the property test skips
    settings = None

# The same ones every time, unless more are requested.
EXAMPLES, SAME = int(os.environ.get("MPHDRR_TEST_EXAMPLES", "60")), "MPHDRR_TEST_EXAMPLES" not in os.environ
CATALOGUES = [
    real.CASES,
    units.CASES,
    headings.CASES,
    values.CASES,
    rows.CASES,
    books.CASES,
    layouts.CASES,
    by_libreoffice.CASES,
]
CASES = {f"{c.topic}: {name}": case for c in CATALOGUES for name, case in c.cases.items()}


def test_there_are_300_workbooks_of_all_kinds():
    assert len(CASES) >= 300
    assert all(len(catalogue.cases) >= 10 for catalogue in CATALOGUES)


@pytest.mark.parametrize("name", sample(CASES, 6))
def test_workbook_is_read_right_or_refused_with_its_cell(name: str, tmp_path):
    case = CASES[name]
    path = write(case, tmp_path)
    assert not (found := fault(case, path)), found


@pytest.mark.parametrize("name", sample(maps.CASES.cases, 3))
def test_column_map_is_obeyed_or_refused(name: str, tmp_path):
    case = maps.CASES.cases[name]
    path = write(case, tmp_path)
    assert not (found := fault(case, path, mapped=True)), found


DRAFTED = [name for name in CASES if name.startswith(("layouts", "LibreOffice"))][::3]


@pytest.mark.filterwarnings("ignore::mphdrr.core.errors.InputWarning")
@pytest.mark.parametrize("name", sample(DRAFTED, 4))
def test_draft_of_a_map_without_questions_reads_what_is_read_without_it(name: str, tmp_path):
    path = write(CASES[name], tmp_path)
    try:
        draft = mph.draft_column_map(path)
    except mph.InputError:
        assert read(path).system is None
        return
    draft.write(tmp_path / "draft.toml")
    without = read(path)
    if draft.questions:
        return
    drafted = read(path, (tmp_path / "draft.toml").read_text(encoding="utf-8"))
    assert (drafted.system is None) == (without.system is None), drafted.refusal or without.refusal
    if drafted.system is not None:
        assert not (wrong := differences(drafted.system, without.system)), wrong


if settings is None:

    def test_random_workbook_is_read_right_or_refused_or_warned_of():
        pytest.skip("hypothesis is not installed")

else:

    @settings(max_examples=EXAMPLES, derandomize=SAME, deadline=None, suppress_health_check=list(HealthCheck))
    @given(recipes)
    def test_random_workbook_is_read_right_or_refused_or_warned_of(tmp_path_factory, recipe):
        path = tmp_path_factory.mktemp("w") / "scanner.xlsx"
        draft = written(recipe, path)
        outcome = read(path)
        for message in (outcome.refusal, *outcome.warnings):
            assert "\n" not in message
            assert not message or "scanner.xlsx" in message
        if draft.plain:
            assert outcome.system is not None, f"plainly right, but {outcome.refusal}"
            assert not outcome.warnings
        if outcome.system is not None and not outcome.warnings:
            assert draft.truth is not None, "read without a word, though nobody can tell what it means"
            assert not (wrong := differences(outcome.system, draft.truth, draft.numbered)), wrong
        columns = map_of(draft)
        if outcome.system is None and columns is not None:
            mapped = read(path, columns)
            assert mapped.system is not None, f"refused with a map too: {mapped.refusal}"
            assert not (wrong := differences(mapped.system, draft.truth, draft.numbered)), wrong

    @settings(
        max_examples=max(EXAMPLES // 3, 1), derandomize=SAME, deadline=None, suppress_health_check=list(HealthCheck)
    )
    @given(recipes)
    def test_random_workbook_is_written_back_in_its_own_units(tmp_path_factory, recipe):
        folder = tmp_path_factory.mktemp("w")
        path = folder / "scanner.xlsx"
        columns = map_of(written(recipe, path))
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
                assert "\n" not in str(error)
                return
        back = read(folder / "written.xlsx", columns)
        assert back.system is not None, back.refusal
        assert not (wrong := differences(back.system, system)), wrong


# Written back in the file's own units


def moved(system: mph.PinholeSystem) -> mph.PinholeSystem:
    """The system with its last pinhole elsewhere and its first one wider."""
    centers = system.centers.copy()
    centers[-1] += [3.0, -4.5, 1.25]
    diameter = system.pinhole_diameter.copy()
    diameter[0] += 0.3
    return by_design(replace(system, centers=centers, pinhole_diameter=diameter))


def _in(unit: str, form: str = "{} (%s)") -> dict[str, str]:
    return {name: (form % unit).format(SYMBOLS[name]) for name in ONE_SHEET_COLUMNS}


MIXED = {"x1": "cm", "z1": "m", "d": "um", "Ld": "in", "l": "cm"}
BACK = {
    **{
        f"headings in {unit}": (lambda unit=unit: one_sheet(headings=_in(unit), unit=unit), None)
        for unit in ("m", "um")
    },
    "headings in units of their own": (
        lambda: one_sheet(headings={q: f"{SYMBOLS[q]} ({u})" for q, u in MIXED.items()}, unit=MIXED),
        None,
    ),
    "a map in inches": (lambda: one_sheet(headings=dict.fromkeys(SYMBOLS, "?"), unit="in"), one_sheet_map("in")),
    "a map in units of their own": (
        lambda: one_sheet(headings=dict.fromkeys(SYMBOLS, "?"), unit=MIXED),
        one_sheet_map(MIXED),
    ),
    "a map of a part of the rows": (one_sheet, one_sheet_map(first=3, last=5)),
    "a map without numbers": (one_sheet, one_sheet_map(number=None)),
    "a map in order": (users, users_map(dimensions={"rows": "in order", "number": None})),
    "the users' workbook": (users, None),
    **{
        name: (CASES[f"units: {name}"].make, CASES[f"units: {name}"].columns)
        for name in (
            *("users' workbook in cm", "users' workbook, Main in cm", "'cm' merged over the coordinates"),
            *('number format 0.000" cm"', "units row below: inch", "Units: | cm"),
        )
    },
}


@pytest.mark.parametrize("name", sample(BACK, 3))
def test_changed_system_comes_back_from_its_template(name, tmp_path):
    make, columns = BACK[name]
    path = tmp_path / "scanner.xlsx"
    by_hand(make(), path)
    before = read(path)
    if before.system is None or columns is None or name.startswith("a map"):
        before = read(path, columns)
    else:
        columns = None
    assert before.system is not None, before.refusal
    system = moved(before.system)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mph.write_system(system, tmp_path / "written.xlsx", template=path)
    back = read(tmp_path / "written.xlsx", columns)
    assert back.system is not None, back.refusal
    assert not back.warnings
    assert not (wrong := differences(back.system, system)), wrong
    # Unchanged numbers are stored as they were, changed ones in the file's own unit.
    x1 = before.system.source.cell("x1", int(system.numbers[-1]))
    old, new = (
        openpyxl.load_workbook(file, data_only=True)[x1[0]][x1[1]].value for file in (path, back.system.source.path)
    )
    assert new / old == pytest.approx(system.centers[-1, 0] / before.system.centers[-1, 0], rel=1e-12)
    np.testing.assert_array_equal(back.system.centers[:-1], before.system.centers[:-1])
