"""Column maps: a map decides what is read and written, and a draft says what was recognised."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import openpyxl
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import main
from mphdrr.core.errors import InputError

from .nasty.case import read
from .test_workbook import _typed as typed
from .test_workbook import assert_plain, saved
from .workbooks import DIMENSIONS, by_design, plain

pytestmark = pytest.mark.filterwarnings("error")

MAP = """
[[tables]]
sheet = "Coordinates"
header_row = 1
first_row = 3
last_row = 6
number = "A"
[tables.columns]
x1 = { column = "B", unit = "mm" }
y1 = { column = "C", unit = "mm" }
z1 = { column = "D", unit = "mm" }
l = { column = "G", unit = "mm" }

[[tables]]
sheet = "Main"
first_row = 3
last_row = 6
rows = "by number"
number = "A"
[tables.columns]
d = { column = "B", unit = "mm" }
R = { column = "C", unit = "mm" }
Ld = { column = "D", unit = "mm" }
Td = { column = "E", unit = "mm" }
"""


def silent(folder: Path, edit: Callable | None = None) -> Path:
    """Return the plain workbook with typed numbers and headings that the reader does not understand, edited further."""
    book = plain()
    typed(book["Main"], book["Coordinates"])
    for sheet in book.worksheets:
        for row in sheet["A1:Z2"]:
            for cell in row:
                cell.value = None if cell.value is None else f"Größe {cell.coordinate} (Zoll)"
    if edit is not None:
        edit(book["Main"], book["Coordinates"])
    return saved(book, folder)


def test_what_the_map_says_is_read(tmp_path):
    path = silent(tmp_path)
    with pytest.raises(InputError, match=r"no sheet has a column headed x1.*a column map can say what is meant"):
        mph.read_system(path)
    (tmp_path / "map.toml").write_text(MAP)
    columns = mph.ColumnMap.from_toml(MAP)
    for given in (columns, tmp_path / "map.toml", str(tmp_path / "map.toml")):
        system = mph.read_system(path, columns=given)
        assert_plain(system)
        assert system.source.columns == columns
    assert system.source.cell("l", 4) == ("Coordinates", "G6")
    assert pickle.loads(pickle.dumps(system.source)) == system.source


def test_nothing_but_what_the_map_names_is_read(tmp_path):
    def edit(main, coordinates):
        coordinates["E3"] = 1.0  # b, which a map that names it would compare
        main.append([9, "all in cm", "-", None, None])
        coordinates["A9"] = "OLD DESIGN"
        coordinates["B10"] = 1.0

    assert_plain(mph.read_system(silent(tmp_path, edit), columns=mph.ColumnMap.from_toml(MAP)))


def _without(*lines: str) -> str:
    return "\n".join(line for line in MAP.splitlines() if not line.startswith(lines))


_with = MAP.replace
X1 = 'column = "B", unit = "mm"'
BAD_MAPS = {
    "no TOML": ("[[tables", "not TOML"),
    "no tables": ("", r"expected \[\[tables\]\]"),
    "unknown key": (_with("header_row", "heading_row"), "table 1: unknown key 'heading_row', expected"),
    "unknown key at the top": (f"unit = 'mm'\n{MAP}", "unknown key 'unit'"),
    "unknown key of a column": (_with('"B", unit', '"B", units'), "table 1.x1: unknown key 'units'"),
    "unknown quantity": (_with("l =", "length ="), "table 1.length: no such quantity, expected x1, y1"),
    "unknown unit": (_with(X1, 'column = "B", unit = "Zoll"'), "x1: unit 'Zoll', expected mm"),
    "no unit": (_with(X1, 'column = "B", unit = ""'), "table 1.x1: unit '', expected mm"),
    "angle as a length": (_with("l = {", "azimuth = {"), "table 1.azimuth: unit 'mm', expected rad, deg"),
    "no column letters": (_with('column = "B"', 'column = "2"'), "table 1.x1: column '2', expected letters"),
    "no such column": (_with('column = "B"', 'column = "XFE"'), "table 1.x1: column 'XFE'"),
    "overlap": (_with('column = "C"', 'column = "B"', 1), "table 1.y1: column B is table 1.x1 too"),
    "overlap with numbers": (_with('column = "C"', 'column = "A"', 1), "column A is table 1.y1 too"),
    "missing coordinate": (_without("y1"), "table 1 has no column y1"),
    "missing dimension": (_without("Td"), "no table has a column Td"),
    "twice": (MAP + 'l = { column = "H", unit = "mm" }', "table 2.l is in table 1 too, expected it in one table"),
    "no sheet": (_without("sheet"), "table 1: has no sheet"),
    "half a row": (_with("first_row = 3", "first_row = 3.5", 1), "table 1: first_row = 3.5"),
    "column as text": (_with('{ column = "B", unit = "mm" }', '"B"', 1), "table 1"),
    "column by a number": (_with('"B"', "2", 1), "table 1"),
    "no last row": (_without("last_row"), "table 1: has no last_row"),
    "row as text": (_with("first_row = 3", 'first_row = "3"', 1), "table 1: first_row = '3', expected a whole number"),
    "rows the wrong way round": (_with("last_row = 6", "last_row = 2", 1), "table 1: rows 3 to 2"),
    "row 0": (_with("first_row = 3", "first_row = 0", 1), "table 1: rows 0 to 6"),
    "join of the first": (_with('number = "A"', 'number = "A"\nrows = "in order"', 1), "table 1 has rows = 'in order'"),
    "no join": (_without("rows"), "table 2: rows = None, expected 'by number' or"),
    "unknown join": (_with('"by number"', '"somehow"'), "table 2: rows = 'somehow'"),
    "join by no number": (_with('rows = "by number"\nnumber = "A"', 'rows = "by number"'), "without number"),
    "one of several": (_with('"by number"', '"one for all"'), "'one for all' of several rows"),
    "skipped row outside": (_with("last_row = 6", "last_row = 6\nskip_rows = [9]", 1), "skip_rows has 9"),
    "no such sheet in the file": (_with('"Main"', '"Haupt"'), "has no sheet Haupt, which the column map names"),
    "join with unnumbered": (_with('last_row = 6\nnumber = "A"', "last_row = 6", 1), "its first table has no number"),
    "too few rows": (
        _with('rows = "by number"', 'rows = "in order"').replace("6\nrows", "5\nrows"),
        "Main has 3 rows of d",
    ),
    "blank row": (_with("last_row = 6", "last_row = 7"), "Coordinates!A7 is blank, expected a module's number"),
    "heading as a row": (_with("first_row = 3", "first_row = 2"), "Coordinates!A2 holds the text 'Größe A2"),
}


@pytest.mark.parametrize("kind", BAD_MAPS)
def test_a_map_that_cannot_be_followed_is_refused_in_one_line(kind, tmp_path):
    text, expected = BAD_MAPS[kind]
    (tmp_path / "map.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=expected) as refusal:
        mph.read_system(silent(tmp_path), columns=tmp_path / "map.toml")
    assert "\n" not in str(refusal.value)


def _in_cm(main, coordinates):
    coordinates["B1"] = "x1 (cm)"


def _shown_in_cm(main, coordinates):
    coordinates["B3"].number_format = '0.0" cm"'


def _exchanged(one: str, other: str) -> str:
    return MAP.replace(one, "#").replace(other, one).replace("#", other)


CONTRADICTIONS = {
    "headings in cm": (_in_cm, MAP, "Coordinates!B1"),
    "number format in cm": (_shown_in_cm, MAP, "Coordinates!B3"),
    "x1 and y1 exchanged": (
        None,
        MAP.replace("y1 =", "# =").replace("x1 =", "y1 =").replace("# =", "x1 ="),
        "Coordinates!",
    ),
    "d and Td exchanged": (
        None,
        MAP.replace("\nTd =", "\n# =").replace("\nd =", "\nTd =").replace("\n# =", "\nd ="),
        "Main!",
    ),
    "metres": (None, MAP.replace('"mm"', '"m"'), "scanner.xlsx"),
}


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("kind", CONTRADICTIONS)
def test_a_map_that_contradicts_the_sheet_is_doubted(kind, tmp_path):
    edit, text, place = CONTRADICTIONS[kind]
    book = plain()
    typed(book["Main"], book["Coordinates"])
    if edit is not None:
        edit(book["Main"], book["Coordinates"])
    outcome = read(saved(book, tmp_path), text)
    assert any(place in message for message in (outcome.refusal, *outcome.warnings))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"B"', '"b"'),
        ("header_row = 1\n", ""),
        ('number = "A"\n[tables.columns]\nx1', "[tables.columns]\nx1"),
        ("l =", "# l ="),
    ],
)
def test_maps_may_be_written_otherwise(old, new, tmp_path):
    text = MAP.replace(old, new)
    if "number" in old:
        text = text.replace('"by number"\nnumber = "A"', '"in order"')
    path = silent(tmp_path, lambda main, coordinates: setattr(coordinates, "sheet_state", "hidden"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the hidden sheet
        assert_plain(mph.read_system(path, columns=mph.ColumnMap.from_toml(text)))


@pytest.mark.parametrize("cell", ["B4", "D6", "G5"])
@pytest.mark.parametrize("value", [None, "12,5", True])
def test_a_cell_that_the_map_names_and_that_holds_no_number_is_refused(cell, value, tmp_path):
    path = silent(tmp_path, lambda main, coordinates: coordinates.__setitem__(cell, value))
    with pytest.raises(InputError, match=f"Coordinates!{cell} .*, expected (x1|z1|l) of module"):
        mph.read_system(path, columns=mph.ColumnMap.from_toml(MAP))


def test_maps_come_back_from_their_text(rng):
    quantities = ["x1", "y1", "z1", "d", "R", "Ld", "Td", "l", "b", "H", "x2", "range"]
    names = ["Main", 'a "quoted" name', "back\\slash", "Größe 1", "tab\there", "'", "#1"]
    for _ in range(50):
        tables = []
        for i in range(rng.integers(1, 4)):
            first = int(rng.integers(1, 50))
            last = first + int(rng.integers(0, 50))
            tables.append(
                mph.MappedTable(
                    sheet=names[rng.integers(len(names))],
                    first_row=first,
                    last_row=last,
                    columns=tuple(
                        mph.MappedColumn(q, "ABCDEFGH"[rng.integers(8)], ["mm", "µm", "in"][rng.integers(3)])
                        for q in rng.permutation(quantities)[: rng.integers(1, 6)].tolist()
                    ),
                    number=[None, "A", "AB"][rng.integers(3)],
                    rows=[None, "by number", "in order", "one for all"][rng.integers(4)] if i else None,
                    header_row=[None, 2][rng.integers(2)],
                    skip_rows=tuple(range(first + 1, last))[: rng.integers(3)],
                )
            )
        columns = mph.ColumnMap(tuple(tables))
        assert mph.ColumnMap.from_toml(columns.to_toml()) == columns
        assert hash(columns) == hash(mph.ColumnMap.from_toml(columns.to_toml()))


# Writing


def test_a_workbook_is_written_back_by_its_map(tmp_path):
    path = silent(tmp_path)
    system = mph.read_system(path, columns=mph.ColumnMap.from_toml(MAP))
    same = mph.write_system(system, tmp_path / "same.xlsx", path)
    assert same.path.read_bytes() == path.read_bytes()
    assert same.columns == system.source.columns
    thinner = by_design(replace(system, pinhole_diameter=np.array([2.0, 2.1, 2.2, 2.3])))
    written = mph.write_system(thinner, tmp_path / "thinner.xlsx", path)
    assert {"Main!B3", "Main!B4", "Main!B5", "Coordinates!G3"} <= set(written.changed)
    assert {name[:-1] for name in written.changed} == {"Main!B", "Coordinates!G"}
    back = mph.read_system(written.path, columns=written.columns)
    np.testing.assert_array_equal(back.pinhole_diameter, thinner.pinhole_diameter)
    np.testing.assert_allclose(back.collimator_length, thinner.collimator_length, rtol=1e-12)


@pytest.mark.parametrize("order", [[0, 1, 3], [1, 2], [3, 1, 0, 2], [0, 2, 3, 1, 1, 2]])
@pytest.mark.parametrize("shared", [False, True])
def test_the_written_map_has_the_rows_of_the_modules_now(order, shared, tmp_path):
    path = silent(tmp_path)
    text = MAP
    if shared:
        text = text.replace('rows = "by number"\nnumber = "A"', 'rows = "one for all"')
        text = text.replace("last_row = 6\nrows", "last_row = 3\nrows")
    system = mph.read_system(path, columns=mph.ColumnMap.from_toml(text))
    arrays = {name: getattr(system, name)[order] for name in ("centers", "collimator_length", *DIMENSIONS.values())}
    numbers = system.numbers[order].copy()
    for i in range(4, len(order)):
        arrays["centers"][i] = [0.0, 200.0 + i, 30.0]
        numbers[i] = 100 + i
    wanted = by_design(mph.PinholeSystem(**arrays, numbers=numbers, source=system.source))
    written = mph.write_system(wanted, tmp_path / "o.xlsx", path)
    back = mph.read_system(written.path, columns=written.columns)
    np.testing.assert_array_equal(back.numbers, wanted.numbers)
    np.testing.assert_allclose(back.centers, wanted.centers, rtol=1e-12)
    np.testing.assert_allclose(back.collimator_length, wanted.collimator_length, rtol=1e-12)
    again = mph.write_system(back, tmp_path / "again.xlsx", written.path)
    assert again.path.read_bytes() == written.path.read_bytes()


def test_what_one_row_for_all_cannot_hold_is_refused_with_its_cell(tmp_path):
    def first_row_alone(main, coordinates):
        for row in range(4, 7):
            main.cell(row, 2).value = None

    path = silent(tmp_path, first_row_alone)
    text = MAP.replace('rows = "by number"\nnumber = "A"', 'rows = "one for all"')
    text = text.replace("last_row = 6\nrows", "last_row = 3\nrows")
    system = mph.read_system(path, columns=mph.ColumnMap.from_toml(text))
    differing = by_design(replace(system, pinhole_diameter=np.array([2.0, 2.1, 2.2, 2.3])))
    with pytest.raises(mph.InputError, match=r"d = 2.1 mm of module 2 .*: Main!B3 is read for all modules$"):
        mph.write_system(differing, tmp_path / "o.xlsx", path)
    assert not (tmp_path / "o.xlsx").exists()


# Drafts


def test_the_draft_of_the_real_workbook_says_the_same(workbook, tmp_path):
    draft = mph.draft_column_map(workbook)
    draft.write(tmp_path / "map.toml")
    system, back = mph.read_system(workbook), mph.read_system(workbook, columns=tmp_path / "map.toml")
    np.testing.assert_array_equal(back.centers, system.centers)
    np.testing.assert_array_equal(back.collimator_length, system.collimator_length)
    assert draft.questions == ()


def test_a_draft_asks_for_what_was_not_understood(tmp_path):
    book = plain()
    for cell, text in (("B1", None), ("B2", "x1 (dm)"), ("D1", None), ("D2", None)):
        book["Coordinates" if cell[0] == "B" else "Main"][cell] = text
    draft = mph.draft_column_map(saved(book, tmp_path))
    draft.write(tmp_path / "map.toml")
    assert mph.ColumnMap.read(tmp_path / "map.toml") == draft.columns
    for question in (
        "Coordinates!B2 is headed 'x1 (dm)', which is not",
        "no table has a column Ld",
        "table 1.y1, z1, l, x1: unit ''",
        "table 2.d, R, Td: unit ''",
    ):
        assert sum(text.startswith(question) for text in draft.questions) == 1, draft.questions


def test_a_draft_asks_each_thing_once_and_proposes_the_titles_unit(tmp_path):
    book = openpyxl.Workbook()
    book.active.title = "Geometry (cm)"
    for row in (["Hole", "X pos", "Y pos", "Z pos", "Det size"], [1, 10, 0, 1, 5], [2, 0, 10, 2, 5]):
        book.active.append(row)
    draft = mph.draft_column_map(saved(book, tmp_path))
    (table,) = draft.columns.tables
    assert {(c.quantity, c.column, c.unit) for c in table.columns} == {
        ("x1", "B", "cm"), ("y1", "C", "cm"), ("z1", "D", "cm"), ("Ld", "E", "cm"),
    }  # fmt: skip
    assert draft.questions == (
        "guessed by the headings: x1 'X pos', y1 'Y pos', z1 'Z pos', Ld 'Det size'",
        "cm, of the title of sheet Geometry (cm), is proposed for x1, y1, z1, Ld",
        "no table has the columns d, R, Td",
    )


def test_a_draft_of_a_workbook_of_which_nothing_is_understood_can_be_written(tmp_path):
    book = openpyxl.Workbook()
    book.active["A1"] = "hello"
    draft = mph.draft_column_map(saved(book, tmp_path))
    draft.write(tmp_path / "map.toml")
    assert 'sheet = "Sheet"' in (tmp_path / "map.toml").read_text()
    with pytest.raises(InputError, match=r"map\.toml: table 1 has no columns"):
        mph.read_system(tmp_path / "scanner.xlsx", columns=tmp_path / "map.toml")


def test_a_preview_shows_the_cells(workbook):
    preview = mph.preview_workbook(workbook, rows=4, columns=7)
    assert list(preview) == ["Main", "Coordinates"]
    assert preview["Coordinates"][0] == ("", "x1", "y1", "z1", "b", "S", "l")
    assert preview["Coordinates"][2][:2] == ("1", "277.002")
    assert [len(row) for row in preview["Main"]] == [7] * 4


# The command line


def test_commands_take_a_column_map(tmp_path, capsys):
    path, columns = silent(tmp_path), tmp_path / "map.toml"
    columns.write_text(MAP)
    assert main(["geometry", "show", str(path)]) == 1
    assert "a column map can say what is meant" in capsys.readouterr().err
    assert main(["geometry", "show", str(path), "--columns", str(columns)]) == 0
    assert " 277.00    70.30   -70.00" in capsys.readouterr().out
    for action in (
        ["check"],
        ["fit"],
        ["performance"],
        ["export", "-o", str(tmp_path / "s.npz"), "--format", "opencv"],
    ):
        assert main(["geometry", action[0], str(path), *action[1:], "--columns", str(columns)]) == 0, action
    out = tmp_path / "thinner.xlsx"
    assert main(["geometry", "set", str(path), "--columns", str(columns), "--diameter", "2", "-o", str(out)]) == 0
    np.testing.assert_array_equal(mph.read_system(out, columns=columns).pinhole_diameter, [2.0] * 4)
    own = ["--remove", "2", "--write-columns", str(tmp_path / "own.toml"), "-o", str(out)]
    assert main(["geometry", "set", str(path), "--columns", str(columns), *own]) == 0
    np.testing.assert_array_equal(mph.read_system(out, columns=tmp_path / "own.toml").numbers, [1, 3, 4])
    few = ["--backend", "numpy", "--voxels", "8", "--size", "8", "8", "-o", str(tmp_path / "r.npz")]
    assert main(["project", str(path), "--columns", str(columns), *few]) == 0
    capsys.readouterr()
    assert main(["geometry", "show", str(path), "--columns", str(tmp_path / "none.toml")]) == 1
    assert "none.toml: no such file" in capsys.readouterr().err


def test_a_draft_is_written_by_command(tmp_path, workbook, capsys):
    target = tmp_path / "map.toml"
    assert main(["geometry", "show", str(workbook), "--write-columns", str(target)]) == 0
    assert "0 to be settled" in capsys.readouterr().out
    assert main(["geometry", "show", str(workbook), "--columns", str(target), "--modules", "1"]) == 0
    capsys.readouterr()
    assert main(["geometry", "show", str(silent(tmp_path)), "--write-columns", str(target)]) == 0
    assert "to be settled" in capsys.readouterr().err
    assert target.read_text().startswith("# ")
