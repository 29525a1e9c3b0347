"""A new column is one row of the table: the workbook, its copies, column maps and the commands follow."""

from __future__ import annotations

import json
import warnings

import numpy as np
import openpyxl
import pytest

import mphdrr.core as mph
from mphdrr.core.cli import main
from mphdrr.core.geometry.columns import Column

from .test_workbook import saved
from .workbooks import edited, plain

pytestmark = pytest.mark.filterwarnings("error")

COLUMNS = {
    "text": Column("maker", kind="text", headings=("maker", "maker of module"), blank="", help="who made it"),
    "length": Column("gap", kind="length", headings=("gap", "air gap"), hints="gap", blank=0.5, plausible=(0.1, 9),
                     help="gap: air behind the hole"),
    "choice": Column("coat", kind="choice", headings=("coat", "coat of plate"), place="Main!V", blank="none",
                     choices=("none", "Gold", "Lead"), help="coat of the plate"),
}  # fmt: skip
VALUES = {"text": ("Anna", "B & C", ""), "length": (0.75, 1.25, 0.5), "choice": ("Gold", "none", "Lead")}
SHEETS = {"text": "Coordinates", "length": "Coordinates", "choice": "Main"}


@pytest.fixture(params=COLUMNS)
def kind(request, monkeypatch):
    column = COLUMNS[request.param]
    field = f"{column.name}_of_module"
    column = Column(**{**vars(column), "field": field})
    monkeypatch.setattr(mph.PinholeSystem, "columns", mph.PinholeSystem.columns.with_columns(column))
    return request.param


def test_a_column_added_at_run_time_is_in_workbooks_maps_and_commands(kind, workbook, tmp_path, capsys):
    column, values = mph.PinholeSystem.columns[COLUMNS[kind].name], np.array(VALUES[kind])
    plainly = mph.read_system(workbook)[:3]
    assert column.is_default(plainly).all()
    system = plainly.replace(**{column.field: values})

    # A new workbook, and the one of a system without such values.
    mph.write_system(plainly, tmp_path / "without.xlsx")
    written = mph.write_system(system, tmp_path / "new.xlsx")
    back = mph.read_system(written.path)
    np.testing.assert_array_equal(column.values(back), values)
    (cells,) = [cells for cells in back.source.cells if cells.quantity == column.name]
    sheets = [openpyxl.load_workbook(tmp_path / f"{name}.xlsx")[SHEETS[kind]] for name in ("new", "without")]
    assert [sheets[0][f"{cells.column}{row}"].value for row in (1, 2)] == list(column.headings)
    assert sheets[1][f"{cells.column}3"].value is None

    # An edited copy: only its cell changes; and a copy of one that lacks the column.
    other = system.replace(**{column.field: values[[1, 1, 2]]})
    copied = mph.write_system(other, tmp_path / "copy.xlsx", template=written.path)
    assert copied.changed == (f"{SHEETS[kind]}!{cells.column}3",)
    np.testing.assert_array_equal(column.values(mph.read_system(copied.path)), values[[1, 1, 2]])
    grown = mph.write_system(system, tmp_path / "grown.xlsx", template=tmp_path / "without.xlsx")
    np.testing.assert_array_equal(column.values(mph.read_system(grown.path)), values)

    # Column maps.
    draft = mph.draft_column_map(written.path)
    assert not draft.questions
    columns = mph.ColumnMap.from_toml(draft.columns.to_toml())
    np.testing.assert_array_equal(column.values(mph.read_system(written.path, columns)), values)
    short = mph.draft_column_map(tmp_path / "without.xlsx").columns
    mapped = mph.write_system(system, tmp_path / "mapped.xlsx", tmp_path / "without.xlsx", short)
    np.testing.assert_array_equal(column.values(mph.read_system(mapped.path, mapped.columns)), values)

    # Commands.
    option = f"--{column.field.replace('_', '-')}"
    out, given = str(tmp_path / "set.xlsx"), str(values[0])
    given = given.lower() if kind == "choice" else given
    assert main(["geometry", "set", str(written.path), "--modules", "3", option, given, "-o", out]) == 0
    assert main(["geometry", "show", out, "--json"]) == 0
    shown = json.loads(capsys.readouterr().out.partition("\n")[2])["modules"]
    assert [row[column.name] for row in shown] == values[[0, 1, 0]].tolist()
    assert main(["geometry", "show", out]) == 0
    assert column.name in capsys.readouterr().out.splitlines()[0]
    assert main(["geometry", "show", str(tmp_path / "without.xlsx")]) == 0
    assert column.name not in capsys.readouterr().out


@pytest.mark.parametrize("text", [" NaI", "NaI ", " ", "a\x01b", "a\r\nb", "\ud800", "x" * 40_000])
def test_a_text_that_no_cell_gives_back_is_refused(text, workbook, tmp_path):
    system = mph.read_system(workbook)[:3].replace(crystal_material=["NaI", text, ""])
    for template in (None, workbook):
        with pytest.raises(
            mph.InputError, match=r"module 2: crystal material .*: no cell can hold it, expected at most"
        ):
            mph.write_system(system, tmp_path / "new.xlsx", template)
        assert not (tmp_path / "new.xlsx").exists()


def test_other_texts_are_kept_letter_by_letter(workbook, tmp_path):
    texts = ["NaI", "a\nb", "5", "1e5", '<&">', "µ 😀", "=1+1", "TRUE", "007", "x" * 32_767, ""]
    system = mph.read_system(workbook)[: len(texts)].replace(crystal_material=texts)
    for template in (None, workbook):
        written = mph.write_system(system, tmp_path / "new.xlsx", template)
        assert mph.read_system(written.path).crystal_material.tolist() == texts


BAD = {
    "text": (2.5, "is 2.5, expected maker of module 2, a text"),
    "length": ("much", "holds the text 'much', expected gap of module 2, a number"),
    "choice": ("Tin", "holds the text 'Tin', expected coat of module 2, one of none, Gold, Lead"),
}


def test_a_cell_that_holds_nothing_for_its_column_is_refused(kind, workbook, tmp_path):
    column = mph.PinholeSystem.columns[COLUMNS[kind].name]
    system = mph.read_system(workbook)[:3].replace(**{column.field: np.array(VALUES[kind])})
    mph.write_system(system, tmp_path / "new.xlsx")
    cells = next(c for c in mph.read_system(tmp_path / "new.xlsx").source.cells if c.quantity == column.name)
    value, message = BAD[kind]
    with edited(tmp_path / "new.xlsx") as book:
        book[cells.sheet][f"{cells.column}4"] = value
    with pytest.raises(mph.InputError, match=f"{cells.sheet}!{cells.column}4 {message}"):
        mph.read_system(tmp_path / "new.xlsx")
    with edited(tmp_path / "new.xlsx") as book:
        book[cells.sheet][f"{cells.column}4"] = {"text": 12, "length": None, "choice": "gOLD"}[kind]
    back = mph.read_system(tmp_path / "new.xlsx")
    assert column.values(back)[1] == {"text": "12", "length": 0.5, "choice": "Gold"}[kind]
    same = mph.write_system(back, tmp_path / "same.xlsx", tmp_path / "new.xlsx")
    assert same.changed == ()


# Tilt and material


@pytest.fixture
def real(workbook):
    """Four modules, two of them tilted, three with crystals of their own."""
    system = mph.read_system(workbook)[:4]
    tilt = np.radians([[0, 0, 0], [1.5, -2, 0.25], [0, 0, 3], [0, 0, 0]])
    return system.replace(tilt=tilt, crystal_material=["NaI", "", "CsI", "NaI"])


def assert_same(back, system) -> None:
    np.testing.assert_allclose(back.tilt, system.tilt, rtol=1e-12, atol=0)
    np.testing.assert_array_equal(back.crystal_material, system.crystal_material)
    np.testing.assert_array_equal(back.centers, system.centers)
    np.testing.assert_allclose(back.collimator_length, system.collimator_length, rtol=1e-9)


def test_tilt_and_material_are_kept_in_new_workbooks(real, tmp_path):
    written = mph.write_system(real, tmp_path / "new.xlsx")
    assert_same(mph.read_system(written.path), real)  # and no warning of x2, y2, z2
    sheet = openpyxl.load_workbook(written.path)["Coordinates"]
    assert [sheet[f"X{row}"].value for row in range(1, 5)] == [
        "tilt_u",
        "tilt about u (degrees)",
        0,
        pytest.approx(1.5),
    ]
    assert str(sheet["I3"].value).startswith("=") and isinstance(sheet["I4"].value, float)


def test_tilt_and_material_are_added_to_the_users_workbook(real, workbook, tmp_path):
    whole = mph.read_system(workbook)
    tilt, materials = np.zeros((80, 3)), np.full(80, "", "<U3")
    tilt[:4], materials[:4] = real.tilt, real.crystal_material
    system = whole.replace(tilt=tilt, crystal_material=materials)
    with pytest.warns(mph.InputWarning, match="the formula was replaced by the system's number"):
        written = mph.write_system(system, tmp_path / "copy.xlsx", workbook)
    back = mph.read_system(written.path)
    assert_same(back, system)
    assert {c.column for c in back.source.cells if c.quantity.startswith("tilt")} == {"X", "Y", "Z"}
    straight = mph.write_system(whole, tmp_path / "straight.xlsx", written.path)
    assert not mph.read_system(straight.path).tilt.any()
    again = mph.write_system(back, tmp_path / "again.xlsx", written.path)
    assert again.path.read_bytes() == written.path.read_bytes()


@pytest.mark.parametrize("unit", ["degrees", "rad"])
def test_tilt_may_be_in_degrees_or_radians(unit, tmp_path):
    book = plain()
    sheet = book["Coordinates"]
    sheet["P1"], sheet["P4"] = f"tilt_u ({unit})", 0.02
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # x2, y2 and z2 are compared with the tilted module's
        system = mph.read_system(saved(book, tmp_path))
    expected = 0.02 if unit == "rad" else np.radians(0.02)
    np.testing.assert_allclose(system.tilt[:, 0], [0, expected, 0, 0])
    assert not system.tilt[:, 1:].any()


def test_a_formula_that_cannot_be_calculated_is_no_blank(tmp_path):
    book = plain()
    book["Coordinates"]["P1"], book["Coordinates"]["P4"] = "tilt_u", "=FOO(1)"
    with pytest.raises(mph.InputError, match=r"Coordinates!P4 holds the formula =FOO\(1\) without a stored value"):
        mph.read_system(saved(book, tmp_path))


def test_commands_set_and_show_tilt_and_material(workbook, tmp_path, capsys):
    mph.write_system(mph.read_system(workbook)[:3], tmp_path / "three.xlsx")
    out = str(tmp_path / "o.xlsx")
    options = ["--modules", "2", "--tilt", "1", "0", "-0.5", "--crystal-material", "NaI", "-o", out]
    assert main(["geometry", "set", str(tmp_path / "three.xlsx"), *options]) == 0
    capsys.readouterr()
    system = mph.read_system(out)
    np.testing.assert_allclose(np.degrees(system.tilt), [[0, 0, 0], [1, 0, -0.5], [0, 0, 0]], atol=1e-12)
    assert system.crystal_material.tolist() == ["", "NaI", ""]
    assert main(["geometry", "show", out]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[-3:] == ["tilt_u", "tilt_k", "crystal"]
    assert lines[2].split()[-3:] == ["1", "-0.5", "NaI"]
    assert lines[-1].endswith("angles in radians, tilt_u in deg, tilt_k in deg")
