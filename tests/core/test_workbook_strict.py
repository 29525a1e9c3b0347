"""What is not understood with certainty is refused, naming the cell; everything else is read correctly, in any unit."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import openpyxl
import pytest
from openpyxl.utils import get_column_letter
from openpyxl.worksheet.worksheet import Worksheet

import mphdrr.core as mph
from mphdrr.core.errors import InputError, InputWarning
from mphdrr.core.geometry.pinhole_columns import PINHOLE_COLUMNS
from mphdrr.core.workbook.headings import Heading, get_vocabulary

from .nasty.layouts import CENTERS, PLAIN, Draft, laid_out, scanner
from .nasty.sheets import Book, Formula, Sheet, by_hand
from .test_workbook import _typed as typed
from .test_workbook import _unnumbered, assert_plain, read_edited
from .workbooks import DIMENSIONS, by_design

pytestmark = pytest.mark.filterwarnings("error")

parse_heading = get_vocabulary(PINHOLE_COLUMNS).parse_heading


BESIDE = [
    "principal ray z axis",
    "x tilt of the plate",
    "position of the cable (mm)",
    "coordinate system",
    "diameter of the screw",
    "bore of the flange",
    "r of the bearing",
    "width of the gap, cm",
    "thickness of shielding",
    "height above the floor",
    "depth of the groove",
    "azimuth of the cable",
    "azimuth, measured",
    "elevation (deg)",
    "b value",
]


@pytest.mark.parametrize("with_length", [True, False])
@pytest.mark.parametrize(
    "titles", [BESIDE[:1], BESIDE, ["sensitivity", "y axis", "z axis"]], ids=["one", "many", "axes"]
)
def test_exact_headings_are_read_whatever_stands_beside_them(titles, with_length, tmp_path):
    """One warning names all columns that are not understood, also those that say nothing of the scanner's."""

    def edit(main: Worksheet, coordinates: Worksheet) -> None:
        typed(main, coordinates)
        if not with_length:
            coordinates["G1"] = coordinates["G2"] = None
        for sheet in (main, coordinates):
            for i, title in enumerate(titles):
                sheet.cell(2, 20 + i).value = title
                for row in range(3, 7):
                    sheet.cell(row, 20 + i).value = 0.25 * row + i

    with pytest.warns(InputWarning) as caught:
        assert_plain(read_edited(tmp_path, edit))
    (said,) = (str(warning.message) for warning in caught)
    assert said.startswith("scanner.xlsx: ") and "\n" not in said
    assert ("no column is headed l, so the collimator length is the design formula's" in said) == (not with_length)
    for i, title in enumerate(titles):
        for sheet in ("Main", "Coordinates"):
            assert f"{sheet}!{get_column_letter(20 + i)}2 {title!r}" in said


@pytest.mark.parametrize(
    ("cell", "title"),
    [
        *(("Coordinates!T2", title) for title in ("x1 nominal", "y1 (CMM)", "z", "x (cm)", "pinhole x", "effective length")),
        *(("Main!T2", title) for title in ("half diameter of pinhole", "roi radius*", "inner side of crystal", "thickness")),
    ],
)  # fmt: skip
@pytest.mark.parametrize("with_length", [True, False])
def test_a_heading_that_may_be_mistaken_for_an_exact_one_is_refused(cell, title, with_length, tmp_path):
    sheet, at = cell.split("!")

    def edit(main: Worksheet, coordinates: Worksheet) -> None:
        typed(main, coordinates)
        if not with_length:
            coordinates["G1"] = coordinates["G2"] = None
        table = {"Main": main, "Coordinates": coordinates}[sheet]
        table[at] = title
        for row in range(3, 7):
            table[f"T{row}"] = 51.0 + row

    with pytest.raises(InputError, match=f"{cell} is headed .*, which is not understood and may mean"):
        read_edited(tmp_path, edit)


# Units


@pytest.mark.parametrize("form", ["{} ({})", "{} [{}]", "{}, {}", "{}/{}", "{} / {}", "{} in {}", "{} (in {})"])
@pytest.mark.parametrize("unit", ["mm", "cm", "m", "in", "μm", "CM", "inches", "centimetres"])
def test_units_are_understood_in_every_form(form, unit):
    named = {"CM": "cm", "inches": "in", "centimetres": "cm", "μm": "µm"}
    for name in ("x1", "Ld", "R", "l"):
        assert parse_heading(form.format(name, unit)) == Heading(name, named.get(unit, unit))
    assert parse_heading(form.format("pinhole azimuth", unit)) is None


def test_a_row_of_units_counts(tmp_path):
    def edit(main, coordinates):
        typed(main, coordinates)
        coordinates.delete_cols(5, 10)
        for sheet in (main, coordinates):
            sheet.insert_rows(3)
            for column in range(2, sheet.max_column + 1):
                sheet.cell(3, column).value = "[cm]"
                for row in range(4, 8):
                    sheet.cell(row, column).value /= 10

    system = read_edited(tmp_path, edit)
    np.testing.assert_allclose(system.centers, CENTERS, rtol=1e-14)
    np.testing.assert_allclose(system.detector_side, 50, rtol=1e-14)


@pytest.mark.parametrize("factor", [0.1, 1000 / 25.4])
def test_a_scanner_in_units_that_nothing_states_is_warned_of(factor, tmp_path):
    def edit(main, coordinates):
        typed(main, coordinates)
        for sheet in (main, coordinates):
            for column in range(2, min(sheet.max_column, 12) + 1):
                if column != 6 or sheet is main:
                    for row in range(3, 7):
                        sheet.cell(row, column).value *= factor

    with pytest.warns(InputWarning) as caught:
        read_edited(tmp_path, edit)
    unlikely = r"makes b = .* which is unlikely, expected 40 to 2000 mm: are the units right\?"
    assert any(re.search(unlikely, str(w.message)) for w in caught)


# Stored values


BEYOND_US = "XLOOKUP(A6,Z1:Z4,Y1:Y4)"
ASKED = 'fullCalcOnLoad="1"'


def draft_of(formulas: str, centers: np.ndarray = CENTERS) -> Draft:
    """Return the plain workbook whose formulas are stored, with their values or zeros, or typed."""
    return laid_out(replace(PLAIN, formulas=formulas), scanner(centers))


def file_of(book: Book, folder: Path, settings: str = "") -> Path:
    """Write a book with these settings of calculation, and return its path."""
    book.calculation = f"<calcPr {settings}/>"
    by_hand(book, folder / "scanner.xlsx")
    return folder / "scanner.xlsx"


@pytest.mark.parametrize("settings", ["", ASKED])
def test_zeros_stored_for_all_formulas_count_as_not_stored(settings, tmp_path):
    path = file_of(draft_of("zeros").book, tmp_path, settings)
    assert_plain(mph.read_system(path))
    assert_plain(mph.read_system(path, mph.draft_column_map(path).columns))


@pytest.mark.parametrize("settings", ["", ASKED])
@pytest.mark.parametrize("calculated", ["E4", "N3", "of a sheet that nobody reads"])
def test_zeros_beside_a_calculated_formula_are_refused_with_both_numbers(calculated, settings, tmp_path):
    """One formula that stores its result says that the file was calculated: the zeros are then out of date."""
    book = draft_of("zeros").book
    if calculated in ("E4", "N3"):
        book["Coordinates"][calculated] = draft_of("stored").book["Coordinates"][calculated]
    else:
        book.sheets.append(Sheet("Theta", {"A1": Formula("Coordinates!B3*2", 554.0)}))
    with pytest.raises(InputError, match=r"Coordinates!\w+ stores 0, but its formula =.* gives -?\d+\.\d+"):
        mph.read_system(file_of(book, tmp_path, settings))


@pytest.mark.parametrize("formulas", ["stored", "zeros"])
def test_zeros_of_formulas_that_are_zero_are_read_in_either_case(formulas, tmp_path):
    """The ring of a scanner at z = 0, by formula: stored by a program that calculates, and by one that does not."""
    centers = np.array([[277.0, 70.3, 0.0], [155.0, 158.4, 0.0], [-63.1, -245.8, 0.0]])
    book = draft_of(formulas, centers).book
    for row in (3, 4, 5):
        book["Coordinates"][f"D{row}"] = Formula(f"B{row}-B{row}", 0.0)
    np.testing.assert_array_equal(mph.read_system(file_of(book, tmp_path)).centers, centers)


def test_zeros_of_formulas_beyond_us_are_refused_where_nothing_was_calculated(tmp_path):
    book = draft_of("zeros").book
    book["Coordinates"]["D6"] = Formula(BEYOND_US, 0)
    with pytest.raises(InputError, match=r"Coordinates!D6 holds the formula =XLOOKUP.*stores 0.*") as refusal:
        mph.read_system(file_of(book, tmp_path))
    assert "\n" not in str(refusal.value)
    book = draft_of("zeros").book
    for row in range(3, 7):  # a number that is only compared
        book["Coordinates"][f"M{row}"] = Formula(BEYOND_US.replace("A6", f"A{row}"), 0)
    assert_plain(mph.read_system(file_of(book, tmp_path)))


def test_what_is_written_into_a_workbook_of_zeros_stores_all_values(tmp_path):
    """In every sheet: no zero stays beside calculated numbers, where it would count."""
    book = draft_of("zeros").book
    for row in range(3, 7):
        book["Main"][f"D{row}"] = Formula("2*25", 0)
    book.sheets.append(Sheet("Theta", {"A1": Formula("SUM(Main!D3:D6)+Coordinates!G3", 0)}))
    template = file_of(book, tmp_path)
    system = mph.read_system(template)
    assert mph.write_system(system, tmp_path / "same.xlsx", template).path.read_bytes() == template.read_bytes()
    moved = by_design(replace(system, centers=system.centers * 1.1))
    written = mph.write_system(moved, tmp_path / "moved.xlsx", template)
    back = mph.read_system(written.path)
    np.testing.assert_allclose(back.centers, moved.centers, rtol=1e-12)
    np.testing.assert_allclose(back.collimator_length, moved.collimator_length, rtol=1e-12)
    values = openpyxl.load_workbook(written.path, data_only=True)
    assert [values["Main"][f"D{row}"].value for row in range(3, 7)] == [50] * 4
    assert values["Theta"]["A1"].value == pytest.approx(200 + moved.collimator_length[0], rel=1e-12)
    np.testing.assert_allclose([values["Coordinates"][f"E{r}"].value for r in range(3, 7)], moved.pinhole_distance)


@pytest.mark.parametrize("constant_memory", [False, True])
def test_the_example_written_again_by_xlsxwriter_is_read(constant_memory, workbook, tmp_path):
    """Its formulas, of which XlsxWriter stores 0."""
    xlsxwriter = pytest.importorskip("xlsxwriter")
    path = tmp_path / "scanner.xlsx"
    with xlsxwriter.Workbook(path, {"constant_memory": constant_memory}) as book:
        for sheet in openpyxl.load_workbook(workbook).worksheets:
            worksheet = book.add_worksheet(sheet.title)
            for row in sheet.iter_rows():
                for cell in row:
                    worksheet.write(cell.row - 1, cell.column - 1, cell.value)
    zeros = openpyxl.load_workbook(path, data_only=True)["Coordinates"]
    assert [zeros[at].value for at in ("E3", "G82", "W40")] == [0, 0, 0]
    read, expected = mph.read_system(path), mph.read_system(workbook)
    np.testing.assert_array_equal(read.centers, expected.centers)
    for name in ("collimator_length", *DIMENSIONS.values()):
        np.testing.assert_allclose(getattr(read, name), getattr(expected, name), rtol=1e-12)


def test_a_length_stored_before_its_diameter_changed_is_refused_with_both_numbers(tmp_path):
    book = draft_of("stored").book
    book["Main"]["B4"] = 4.6
    stored = book["Coordinates"]["G4"].stored
    with pytest.raises(InputError, match=rf"Coordinates!G4 stores {stored:.9g}, but its formula .* gives \d+"):
        mph.read_system(file_of(book, tmp_path))


def test_a_number_of_a_formula_beyond_us_is_used_and_warned_of_where_the_file_asks_for_calculation(tmp_path):
    book = draft_of("typed").book
    book["Coordinates"]["D6"] = Formula(BEYOND_US, 0.0)
    with pytest.raises(InputError, match=r"Coordinates!D6 holds the formula =XLOOKUP.*stores 0"):
        mph.read_system(file_of(book, tmp_path, ASKED))
    book["Coordinates"]["D6"] = Formula(BEYOND_US, 12.0)
    with pytest.warns(InputWarning, match=r"Coordinates!D6: the stored value is used, though the file asks"):
        assert mph.read_system(file_of(book, tmp_path, ASKED)).centers[3, 2] == 12
    assert_plain(mph.read_system(file_of(book, tmp_path)))


# The file


def test_a_gap_between_modules_without_numbers_is_warned_of(tmp_path):
    def edit(main, coordinates):
        _unnumbered(main, coordinates)
        main.insert_rows(5, 2)
        coordinates.insert_rows(5, 2)

    with pytest.warns(InputWarning, match="holds no module; the rows below have no numbers"):
        assert_plain(read_edited(tmp_path, edit))
