"""The workbook reader: what it reads, finds, computes, warns about and refuses."""

from __future__ import annotations

import copy
import datetime
import hashlib
import pickle
import re
import shutil
import tracemalloc
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import openpyxl
import pytest
from openpyxl.utils.cell import coordinate_to_tuple
from openpyxl.workbook import Workbook
from openpyxl.worksheet.worksheet import Worksheet

from mphdrr.core.errors import InputError, InputWarning
from mphdrr.core.geometry.design_formulas import collimator_length
from mphdrr.core.geometry.pinhole_columns import PINHOLE_COLUMNS
from mphdrr.core.workbook import read_system
from mphdrr.core.workbook.agreement import tolerance
from mphdrr.core.workbook.formulas import CellError, FormulaContext, NotComputable, calculate
from mphdrr.core.workbook.headings import get_vocabulary

from . import libreoffice
from .nasty.layouts import CENTERS, PLAIN, SCANNER, laid_out
from .workbooks import DIMENSIONS, content_of, plain, values_of

pytestmark = pytest.mark.filterwarnings("error")


def saved(book: Workbook, folder: Path, name: str = "scanner.xlsx") -> Path:
    path = folder / name
    book.save(path)
    return path


def read_edited(folder: Path, edit: Callable[[Worksheet, Worksheet], object]):
    """Return the system read from the plain workbook after `edit(main, coordinates)`."""
    book = plain()
    edit(book["Main"], book["Coordinates"])
    return read_system(saved(book, folder))


def assert_plain(system) -> None:
    """Compare with the plain workbook's scanner."""
    for name in ("centers", *DIMENSIONS.values()):
        np.testing.assert_array_equal(getattr(system, name), getattr(SCANNER, name))
    np.testing.assert_allclose(system.collimator_length, SCANNER.collimator_length, rtol=1e-12)


# The real workbook


def test_real_workbook_has_its_80_modules(workbook):
    system = read_system(workbook)
    assert len(system) == 80
    np.testing.assert_array_equal(system.numbers, np.arange(1, 81))
    np.testing.assert_array_equal(system.centers[0], [277.002, 70.37124, -70.0363])
    np.testing.assert_array_equal(system.centers[79], [-63.1068, -245.785, 70.4085])
    lengths = system.collimator_length
    np.testing.assert_allclose(lengths[[0, 79]], [89.070206162965, 79.0107205459795], rtol=0, atol=1e-10)
    formula = collimator_length(system.pinhole_distance, 2.3, 50, 75)
    np.testing.assert_allclose(lengths, formula, rtol=0, atol=1e-8)
    for name, expected in zip(DIMENSIONS.values(), (2.3, 75, 50, 10), strict=True):
        np.testing.assert_array_equal(getattr(system, name), expected)


def test_source_names_file_and_cells(workbook):
    source = read_system(workbook).source
    assert source.path == workbook.absolute()
    assert source.sha256 == hashlib.sha256(workbook.read_bytes()).hexdigest()
    assert (source.coordinates_sheet, source.dimensions_sheet) == ("Coordinates", "Main")
    cells = openpyxl.load_workbook(workbook, data_only=True)
    system = read_system(workbook)
    columns = (system.numbers, system.centers[:, 0], system.collimator_length, system.detector_thickness)
    for quantity, values in zip(("number", "x1", "l", "Td"), columns, strict=True):
        for number, value in zip(system.numbers, values, strict=True):
            sheet, cell = source.cell(quantity, int(number))
            assert cells[sheet][cell].value == value
    assert source.cell("Ld", 80) == ("Main", "S82")
    assert pickle.loads(pickle.dumps(source)) == copy.deepcopy(source) == source


def test_reading_leaves_file_untouched_and_open_to_others(workbook, tmp_path):
    path = tmp_path / "scanner.xlsx"
    path.write_bytes(workbook.read_bytes())
    (tmp_path / "~$scanner.xlsx").write_bytes(b"\x06Someone" + b" " * 100)  # Excel has it open
    before = path.stat().st_mtime_ns
    read_system(path)
    assert path.stat().st_mtime_ns == before
    path.rename(tmp_path / "other.xlsx")  # on Windows only without open handles
    assert sorted(p.name for p in tmp_path.iterdir()) == ["other.xlsx", "~$scanner.xlsx"]


# What may differ from file to file


def _typed(main: Worksheet, coordinates: Worksheet) -> None:
    for at, value in laid_out(replace(PLAIN, formulas="typed"), SCANNER).book["Coordinates"].cells.items():
        if str(coordinates[at].value).startswith("="):
            coordinates[at] = value


def _moved_down(main: Worksheet, coordinates: Worksheet) -> None:
    _typed(main, coordinates)
    coordinates.insert_rows(1, 14)
    coordinates["A1"] = "Geometry of the scanner: all about each collimator, its length and the detector behind it"
    coordinates["B3"] = "for the review of 2024"
    main.insert_rows(1, 6)
    main["A1"] = "Scanner A"


def _odd_spelling(main: Worksheet, coordinates: Worksheet) -> None:
    coordinates["B1"], coordinates["C1"], coordinates["D1"] = " X1 ", "Y1 [mm]", "z₁ (mm)"
    coordinates["B2"] = "X  Coordinate value\nat CENTRE of hole"
    coordinates["H1"] = "l+b + Td"
    main["D1"], main["B2"] = "LD [mm]", "Pinhole diameter (mm)"


def _one_sheet(main: Worksheet, coordinates: Worksheet) -> None:
    _typed(main, coordinates)
    for i, row in enumerate(main.iter_rows(min_col=2, values_only=True), start=1):
        for j, value in enumerate(row, start=20):
            coordinates.cell(i, j, value)
    main.parent.remove(main)


def _single_values_in_numbered_rows(main: Worksheet, coordinates: Worksheet) -> None:
    _typed(main, coordinates)
    for row in range(4, 7):
        main.cell(row, 3).value = main.cell(row, 4).value = None


def _sheets_beside(main: Worksheet, coordinates: Worksheet) -> None:
    book = main.parent
    table = book.create_sheet("Design Table", 0)
    table.append(["d", "R", "sensitivity"])
    table.append([4.0, 90.0, 1e-4])
    copied = book.create_sheet("MDSL cloud import", 0)
    copied.append(["x1", "y1", "z1", "l"])
    copied.append([1.0, 2.0, 3.0, 4.0])
    book.create_sheet("Theta", 1)["B2"] = "=1/0"
    chart = book.create_chartsheet("Chart", 0)
    chart.add_chart(openpyxl.chart.BarChart())
    table.sheet_state = "hidden"
    book.active = 2


def _hidden_column_and_format(main: Worksheet, coordinates: Worksheet) -> None:
    coordinates.column_dimensions["C"].hidden = True
    coordinates.row_dimensions[4].hidden = True
    coordinates["B3"].number_format = '0.00 "mm"'
    coordinates.cell(5000, 200).font = openpyxl.styles.Font(bold=True)
    main["G40"].number_format = "0.0"


def _blank_rows_and_notes(main: Worksheet, coordinates: Worksheet) -> None:
    _typed(main, coordinates)
    coordinates.insert_rows(5, 3)
    last = coordinates.max_row
    coordinates.cell(last + 2, 1, "Note: measured in 2021")
    coordinates.cell(last + 3, 2, "centres of the holes, not of the plates")
    coordinates.cell(last + 4, 5, "=SQRT(SUMSQ(B90,C90,D90))")
    main.insert_rows(4, 1)
    main.cell(12, 1, "all in mm")
    main.cell(13, 3, "to be confirmed")


def _units_row(main: Worksheet, coordinates: Worksheet) -> None:
    _typed(main, coordinates)
    for sheet, columns in ((main, range(2, 6)), (coordinates, range(2, 5))):
        sheet.insert_rows(3)
        for column in columns:
            sheet.cell(3, column, "[mm]")


def _computed_inputs(main: Worksheet, coordinates: Worksheet) -> None:
    coordinates["A4"], coordinates["A5"] = "=A3+1", "=A4+1"
    coordinates["B3"], coordinates["C3"], coordinates["D3"] = "=277.0", "=+Main!H1/10*1", "=--'Coordinates'!P33"
    main["H1"], coordinates["P33"] = 703, -70
    coordinates["B4"], coordinates["P50"] = "=$P$50*1", 155.0
    main["B4"], main["C4"], main["E4"] = "=B3", "=SUM(C3:C3)", "=SQRT(main!E3^2)"


def _sums_below(main: Worksheet, coordinates: Worksheet) -> None:
    coordinates["A10"] = "mean"
    for letter in "BCD":
        coordinates[f"{letter}10"] = f"=AVERAGE({letter}3:{letter}6)"
    main["B10"], main["C10"] = "=SUM(B3:B6)", "=MAX(C3:C6)"


def _sums_below_without_numbers(main: Worksheet, coordinates: Worksheet) -> None:
    _sums_below(main, coordinates)
    for sheet in main, coordinates:
        for row in range(1, 11):
            sheet.cell(row, 1).value = None


def _dimensions_in_two_sheets(main: Worksheet, coordinates: Worksheet) -> None:
    _typed(main, coordinates)
    crystal = main.parent.create_sheet("Crystal")
    crystal.append(["Ld", "Td"])
    crystal.append([50, 10])
    main.delete_cols(4, 2)


VARIATIONS = [
    _sums_below,
    _sums_below_without_numbers,
    _dimensions_in_two_sheets,
    _typed,
    _moved_down,
    _odd_spelling,
    _one_sheet,
    _single_values_in_numbered_rows,
    _sheets_beside,
    _hidden_column_and_format,
    _blank_rows_and_notes,
    _units_row,
    _computed_inputs,
]


@pytest.mark.parametrize("edit", VARIATIONS, ids=lambda edit: edit.__name__.strip("_"))
def test_same_scanner_however_laid_out(edit, tmp_path):
    assert_plain(read_edited(tmp_path, edit))


def test_modules_without_coordinates_are_left_out_with_a_warning(tmp_path):
    with pytest.warns(InputWarning, match=r"^scanner.xlsx: Main!A7 has module 9 without coordinates"):
        assert len(read_edited(tmp_path, lambda main, _: main.append([9, 2.3, 75, 50, 10]))) == 4


# Formulas and typed values


def test_typed_collimator_length_is_the_master_and_warned_of(tmp_path):
    with pytest.warns(InputWarning) as caught:
        system = read_edited(tmp_path, _set("Coordinates", "G4", 60.0))
    assert system.collimator_length[1] == 60.0
    assert [str(w.message).split(",")[0] for w in caught] == ["scanner.xlsx: Coordinates!G4 has l = 60 mm"]
    assert "the sheet's is used" in str(caught[0].message)


def test_missing_collimator_length_is_computed(tmp_path):
    for blank in (_set("Coordinates", "G4", None), lambda main, coordinates: coordinates.delete_cols(7)):
        assert_plain(read_edited(tmp_path, lambda *sheets, blank=blank: (_typed(*sheets), blank(*sheets))))


def test_derived_formula_beyond_arithmetic_is_computed_by_ours(tmp_path):
    def edit(main, coordinates):
        coordinates["G3"] = '=IF(A3="","",XLOOKUP(A3,Main!A:A,Main!F:F))'
        coordinates["E4"] = "=Scale*VLOOKUP(1,2,3)"

    assert_plain(read_edited(tmp_path, edit))


@pytest.mark.parametrize(
    ("cell", "quantity"),
    [("E3", "b"), ("H4", "H"), ("I3", "x2"), ("J5", "y2"), ("K6", "z2"), ("L3", "range"), ("M4", "azimuth")],
)
def test_difference_from_the_formulas_is_warned_of(cell, quantity, tmp_path):
    def edit(main, coordinates):
        _typed(main, coordinates)
        coordinates[cell] = coordinates[cell].value + 0.25

    with pytest.warns(InputWarning) as caught:
        system = read_edited(tmp_path, edit)
    assert_plain(system)
    (message,) = (str(w.message) for w in caught)
    numbers = rf"has {quantity} = (\S+) \w+, the formula gives (\S+) \w+ \(the formula's is used\)"
    given, expected = re.fullmatch(rf"scanner\.xlsx: Coordinates!{cell} {numbers}", message).groups()
    assert float(given) - float(expected) == pytest.approx(0.25, abs=1e-5)


def test_tolerance_is_the_rounding_shown():
    assert tolerance(89.0702, 89.07020616, "mm") == pytest.approx(5e-5 + 4e-5, abs=4.5e-5)
    assert tolerance(89.07, 89.07020616, "mm") == pytest.approx(5e-3)
    assert tolerance(89.0, 89.07020616, "mm") == pytest.approx(5e-3)
    assert tolerance(0.12345678901, 0.1234567, "rad") == pytest.approx(1e-6)


def test_many_differences_of_a_column_are_counted(tmp_path, rng):
    centers = np.round(rng.normal(size=(40, 3)) + np.array([200, 0, 0]), 6)
    book = plain(centers)
    for row in range(3, 43):
        book["Coordinates"].cell(row, 5, 100.0)
        for column in range(6, 15):
            book["Coordinates"].cell(row, column).value = None
    with pytest.warns(InputWarning) as caught:
        read_system(saved(book, tmp_path))
    messages = [str(w.message) for w in caught]
    assert len(messages) == 5
    assert messages[-1].endswith("so do 35 more cells of this column)")


def test_azimuth_error_on_the_z_axis_is_no_fault(tmp_path):
    def edit(main, coordinates):
        coordinates["B3"], coordinates["C3"], coordinates["D3"] = 0, 0, 200
        coordinates["F3"] = None

    np.testing.assert_array_equal(read_edited(tmp_path, edit).centers[0], [0, 0, 200])


@pytest.mark.parametrize(
    ("formula", "value"),
    [
        ("=277.002", 277.002),
        ("=-B2", -3.0),
        ("=-2^2", 4.0),
        ("=2^3^2", 64.0),
        ("=2-3-4", -5.0),
        ("=12/3/2*5", 10.0),
        ("=(1+2)*3", 9.0),
        ("=50%", 0.5),
        ("=SQRT(SUMSQ(B2,4))", 5.0),
        ("=SUM(A1:B2)", 6.0),
        ("=ATAN2(0,2)", np.pi / 2),
        ("=COS(RADIANS(60))*2", 1.0),
        ("=DEGREES(PI())", 180.0),
        ("='My sheet'!C3 * 2", 14.0),
        ("=ROUND(-2.345,2)", -2.35),
        ("=IF(0.1+0.2=0.3,1,0)", 1.0),
        ("=IF(0.1*3<=0.3,1,0)", 1.0),
        ("=0.1+0.2-0.3", 0.0),
        ("=ROUNDUP(0.1*3,1)", 0.3),
        ("=1e3+.5", 1000.5),
        ("=Z99+1", 1.0),
        ("=1/0", "#DIV/0!"),
        ("=A9+1", "#REF!"),
        ("=COUNT(A1:B9)", 3.0),
        ("=COUNT(A9)", 0.0),
        ("=COUNTA(A1:B9)", 4.0),
        ("=INDEX(A1:B2,2)", "#REF!"),
        ("=INDEX(A1:B2,2,2)", 3.0),
        ("=INDEX(A1:B1,2)", 2.0),
        ("=INDEX(B1:B2,2)", 3.0),
        ("=IFERROR(INDEX(A1:B2,1),7)", 7.0),
    ],
)
def test_formulas_give_what_a_spreadsheet_shows(formula, value):
    cells = {
        (None, 1, 1): 1.0,
        (None, 1, 2): 2.0,
        (None, 2, 2): 3.0,
        ("My sheet", 3, 3): 7.0,
        (None, 9, 1): CellError("#REF!"),
    }

    def lookup(sheet, row, column):
        return cells.get((sheet, row, column))

    found = calculate(formula, FormulaContext(lookup))
    assert found == (value if isinstance(value, str) else pytest.approx(value, rel=1e-14))


@pytest.mark.skipif(libreoffice.program() is None, reason="LibreOffice is not installed")
@pytest.mark.long
def test_counts_of_errors_are_those_of_libreoffice():
    formulas = [
        *("COUNT(A1:A4)", "COUNTA(A1:A4)", "COUNT(A2)", "COUNTA(A9)", "COUNT(A1:B3)", "COUNTA(A1:A9)"),
        *("IFERROR(INDEX(A1:B3,2),-1)", "INDEX(B1:B3,2)", "INDEX(A1:B1,2)", "INDEX(A1:B3,2,2)"),
        *("IFERROR(INDEX(A1:A3,4),-2)", "AND(B1,TRUE)", "IFERROR(OR(A2,TRUE),-3)"),
    ]
    cells = {"A1": 1.0, "A2": "=1/0", "A3": "x", "A4": '=""', "B1": 10.0, "B2": 20.0, "B3": 30.0}
    book = Workbook()
    for cell, value in [*cells.items(), *((f"D{i}", f"={formula}") for i, formula in enumerate(formulas, start=1))]:
        book.active[cell] = value
    theirs = values_of(libreoffice.recalculated([content_of(book)])[0])
    known = {coordinate_to_tuple(cell): value for cell, value in cells.items()}
    known |= {(2, 1): CellError("#DIV/0!"), (4, 1): ""}
    for i, formula in enumerate(formulas, start=1):
        found = calculate(f"={formula}", FormulaContext(lambda sheet, row, column: known.get((row, column))))
        assert found == theirs[book.active.title, f"D{i}"], formula


@pytest.mark.parametrize(
    "formula", ["=Name", "=FOO(1)", "=[1]S!A1", "=SUM(A:A)", "=(1", "=1+", "=", "=1)", "=}", "=SQRT(1,2)"]
)
def test_formulas_beyond_arithmetic_are_not_computed(formula):
    with pytest.raises(NotComputable):
        calculate(formula, FormulaContext(lambda *_: 1.0))


@pytest.mark.parametrize(
    ("heading", "quantity"),
    [
        ("l", "l"),
        ("Collimator length (mm)", "l"),
        ("length of side of detector crystal", "Ld"),
        ("ROI radius", "R"),
        ("3D slope", None),
        ("S", None),
        ("l+b+Td", "H"),
        ("y position of pinhole", "y1"),
        ("z coordinate value at end of detector", "z2"),
        ("comment", None),
        ("Module length", None),
    ],
)
def test_headings_name_quantities(heading, quantity):
    assert (get_vocabulary(PINHOLE_COLUMNS).parse_heading(heading) or (None,))[0] == quantity


# Refusals


def _set(sheet: str, cell: str, value: object) -> Callable[[Worksheet, Worksheet], None]:
    def edit(main: Worksheet, coordinates: Worksheet) -> None:
        target = {"Main": main, "Coordinates": coordinates}[sheet]
        target[cell] = value
        if isinstance(value, str) and value.startswith("#"):
            target[cell].data_type = "e"

    return edit


def _center(row: int, center: tuple[float, float, float], message: str) -> tuple[Callable, str]:
    """Return the edit of a module's coordinates, and the refusal that begins with them."""

    def edit(main: Worksheet, coordinates: Worksheet) -> None:
        for column, value in enumerate(center, start=2):
            coordinates.cell(row, column, value)

    return edit, f"Coordinates!B{row} and y1, z1 put the pinhole of module {row - 2} {message}"


def _row_missing_without_numbers(main: Worksheet, coordinates: Worksheet) -> None:
    main.delete_rows(5)
    main.delete_cols(1)


def _unnumbered(main: Worksheet, coordinates: Worksheet) -> None:
    _typed(main, coordinates)
    main.delete_cols(1)
    coordinates.delete_cols(1)


def _numbered_in_main(numbers: list[object], heading: str = "") -> Callable[[Worksheet, Worksheet], None]:
    """Return the edit that gives the rows of Main alone these numbers or names."""

    def edit(main: Worksheet, coordinates: Worksheet) -> None:
        _typed(main, coordinates)
        coordinates.delete_cols(1)
        for row, value in enumerate([heading, *numbers], start=2):
            main.cell(row, 1).value = value

    return edit


def _two_number_columns(main: Worksheet, coordinates: Worksheet) -> None:
    for row, value in enumerate(["module number", 4, 3, 2, 1], start=2):
        coordinates.cell(row, 24).value = value


def _text_between(main: Worksheet, coordinates: Worksheet) -> None:
    _typed(main, coordinates)
    coordinates.insert_rows(5)
    coordinates["E5"] = "upper ring"


def _without_coordinates(main: Worksheet, coordinates: Worksheet) -> None:
    _one_sheet(main, coordinates)
    for column in range(1, 15):
        coordinates.cell(4, column).value = None


def _long_cycle(main: Worksheet, coordinates: Worksheet) -> None:
    coordinates["B3"], main["H9"] = "=Main!H9", "=Coordinates!B3"


def _copied_table(main: Worksheet, coordinates: Worksheet) -> None:
    coordinates.title = "A"
    main.parent.copy_worksheet(coordinates).title = "B"


def _bad(cell: str, value: object, message: str) -> tuple[Callable[[Worksheet, Worksheet], None], str]:
    """Return the edit of a cell, and the refusal that begins with it."""
    return _set(*cell.split("!"), value), f"{cell} {message}".rstrip()


BAD_CELLS = {
    "text": _bad("Coordinates!B4", "abc", "holds the text 'abc', expected x1 of module 2"),
    "text of several lines": _bad("Coordinates!B4", "a\nb", "holds the text 'a b'"),
    "number as text": _bad("Coordinates!D4", "12,5", "holds the text '12,5', expected z1"),
    "blank": _bad("Coordinates!C5", None, "is blank, expected y1 of module 3"),
    "blank dimension": _bad("Main!D4", None, "is blank, expected Ld of module 2"),
    "boolean": _bad("Main!B3", True, "is TRUE, expected d"),
    "date": _bad("Coordinates!B3", datetime.date(2021, 3, 4), "is formatted as a date or time (yyyy-mm-dd)"),
    "error": _bad("Coordinates!B3", "#REF!", "shows the error #REF!, expected x1"),
    "error in l": _bad("Coordinates!G4", "#REF!", "shows the error #REF!, expected l"),
    "error in a check": _bad("Coordinates!E4", "#NAME?", "shows the error #NAME?, expected b"),
    "reference to an error": _bad("Coordinates!B3", "=#REF!+1", "shows the error #REF!"),
    "division by zero": _bad("Coordinates!B3", "=1/Z1", "shows the error #DIV/0!"),
    "not finite": _bad("Coordinates!B3", 1e999, ""),
    "cycle": _bad("Coordinates!B3", "=B3+1", "holds the formula =B3+1 without a stored value"),
    "long cycle": (_long_cycle, "Coordinates!B3 holds the formula =Main!H9 without a stored value"),
    "formula beyond arithmetic": _bad("Main!B3", "=VLOOKUP(1,A:B,2)", "holds the formula =VLOOKUP(1,A:B,2)"),
    "formula of another file": _bad("Main!B3", "=[1]Main!B3", "holds the formula =[1]Main!B3"),
    "no such sheet in a formula": (_set("Main", "B3", "=Old!B3"), "there is no sheet Old"),
    "zero diameter": _bad("Main!B3", 0, "has d = 0 mm, expected more than 0"),
    "negative side": _bad("Main!D5", -50, "has Ld = -50 mm, expected more than 0"),
    "zero thickness": _bad("Main!E3", 0, "has Td = 0 mm"),
    "negative radius": _bad("Main!C3", -75, "has R = -75 mm"),
    "negative length": _bad("Coordinates!G3", -1, "has l = -1 mm, expected more than 0"),
    "hole wider than crystal": _bad("Main!B3", 51, "has d = 51 mm, expected less than Ld = 50 mm in Main!D3"),
    "at the isocentre": _center(5, (0, 0, 0), "at the isocentre"),
    "inside the ROI": _center(5, (30, 40, 0), "50 mm from the isocentre"),
    "on the ROI": _center(5, (75, 0, 0), "75 mm from"),
    "beyond all numbers": _center(5, (1e200, 0, 0), "too far"),
    "same number": _bad("Coordinates!A5", 2, "is module 2, as is Coordinates!A4"),
    "same number in Main": _bad("Main!A5", 2, "is module 2, as is Main!A4"),
    "same place": _center(6, CENTERS[1], "at the place of module 2"),
    "number missing": _bad("Coordinates!A5", None, "is blank, expected a module's number"),
    "number is text": _bad("Coordinates!A5", "left", "holds the text 'left', expected a module's number"),
    "number is a fraction": _bad("Coordinates!A5", 2.5, "is 2.5, expected a module's number"),
    "number without module": _bad("Coordinates!A7", 5, "is module 5, expected a row for it in sheet Main too"),
    "sum below the table": (
        lambda _, table: table.append(["mean", 1.0, 2.0, 3.0]),
        "Coordinates!A7 holds the text 'mean', expected a module's number",
    ),
    "dimensions of a module missing": (
        lambda main, _: main.delete_rows(5),
        "Coordinates!A5 is module 3, expected a row for it in sheet Main too, with its d",
    ),
    "too few rows": (_row_missing_without_numbers, "sheet Main has 3 rows of d (Main!A3 to Main!A5), expected one or"),
    "two columns of one name": (
        _set("Coordinates", "R1", "x1"),
        "Coordinates!B1 and Coordinates!R1 are both headed as x1",
    ),
    "headings at odds": (_set("Coordinates", "B1", "y2"), "Coordinates!B2 is headed as x1 but Coordinates!B1 as y2"),
    "two tables": (_copied_table, "A!B1 and B!B1, of two sheets, are both headed as x1"),
    "numbers in no order in one sheet": (_numbered_in_main([2, 1, 3, 4]), "in no order, sheet Coordinates has none"),
    "names in one sheet": (_numbered_in_main(list("abcd"), "serial"), "Main!A2 heads names of modules"),
    "two columns of numbers": (_two_number_columns, "both head the modules' numbers, expected one such column"),
    "headings between modules": (_text_between, "between rows of modules, expected one table"),
    "unit in the other sheet": _bad("Main!H1", "all in cm", "holds 'all in cm'"),
    "module without coordinates": (_without_coordinates, "Coordinates!A4 is blank, expected a module's number"),
    "text below modules without numbers": (
        lambda main, table: (_unnumbered(main, table), _set("Coordinates", "A7", "n/a")(main, table)),
        "expected one or one for each of the 5 modules of sheet Coordinates",
    ),
    "other rows blank in one sheet than in the other": (
        lambda main, table: (_unnumbered(main, table), table.insert_rows(4), main.insert_rows(5)),
        "row 5 of sheet Coordinates and row 4 of sheet Main would belong together",
    ),
    "no modules": (
        lambda _, table: table.delete_rows(3, 10),
        "sheet Coordinates has no modules, expected rows with x1, y1, z1",
    ),
}


@pytest.mark.parametrize("kind", BAD_CELLS)
def test_unusable_cell_is_refused_by_its_name(kind, tmp_path):
    edit, expected = BAD_CELLS[kind]
    with pytest.raises(InputError) as refusal:
        read_edited(tmp_path, edit)
    message = str(refusal.value)
    assert message.startswith("scanner.xlsx: ")
    assert expected in message
    assert "\n" not in message
    assert len(message) < 300
    assert "expected" in message


def test_without_coordinates_the_sheets_and_headings_are_named(tmp_path):
    book = Workbook()
    book.active.title = "Values"
    book.create_sheet("Notes")["A1"] = "hello"
    with pytest.raises(InputError) as refusal:
        read_system(saved(book, tmp_path))
    assert str(refusal.value) == (
        "scanner.xlsx: no sheet has a column headed x1 or 'x coordinate value at center of hole'; its sheets are "
        "Values, Notes; a column map can say what is meant (columns='map.toml', --columns map.toml; docs/workbook.md)"
    )


def test_missing_heading_is_named(tmp_path):
    def edit(main, coordinates):
        coordinates["C1"] = coordinates["C2"] = None

    with pytest.raises(InputError, match="no sheet has a column headed y1 or 'y coordinate value"):
        read_edited(tmp_path, edit)
    with pytest.raises(InputError, match="no sheet has a column headed Ld or 'length of side of detector crystal'"):
        read_edited(tmp_path, lambda main, coordinates: main.delete_cols(4))


def test_file_of_absurd_size_is_refused_unread(workbook, tmp_path, monkeypatch):
    workbook = shutil.copy(workbook, tmp_path)  # not one that was read before
    monkeypatch.setattr("mphdrr.core.workbook.book.MAX_UNPACKED_BYTES", 100_000)
    with pytest.raises(InputError, match="unpacks to 139152 bytes, expected at most 100000"):
        read_system(workbook)
    monkeypatch.setattr("mphdrr.core.workbook.book.MAX_FILE_BYTES", 10_000)
    with pytest.raises(InputError, match="expected a workbook of at most 10000 bytes"):
        read_system(workbook)


def test_a_sheet_of_300_mb_of_blanks_is_refused_without_unpacking_it(workbook, tmp_path):
    """Also where the archive lies about the size."""
    name, bomb = "xl/worksheets/sheet1.xml", tmp_path / "bomb.xlsx"
    with zipfile.ZipFile(workbook) as old, zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as new:
        for info in old.infolist():
            with new.open(info.filename, "w") as part:
                before, data, after = old.read(info).partition(b"<sheetData>")
                part.write(before + data)
                for _ in range(300 if info.filename == name else 0):
                    part.write(b" " * 10**6)
                part.write(after)
        size = new.getinfo(name).file_size
    content = bomb.read_bytes()
    lying = content.replace(size.to_bytes(4, "little"), (5000).to_bytes(4, "little"))
    read_system(workbook)
    for given, found in (
        (content, "unpacks to 286 MiB, expected at most 128 MiB"),
        (lying, "is damaged or cannot be read (Bad CRC-32"),
    ):
        bomb.write_bytes(given)
        tracemalloc.start()
        with pytest.raises(InputError) as refusal:
            read_system(bomb)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert f"bomb.xlsx: its part {name} {found}" in str(refusal.value)
        assert most < 4 * 2**20


def test_too_many_rows_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("mphdrr.core.workbook.book.MAX_ROWS", 5)
    with pytest.raises(InputError, match="sheet Main has more than 5 rows with content"):
        read_edited(tmp_path, lambda main, coordinates: None)


def test_too_many_modules_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("mphdrr.core.workbook.layout.MAX_MODULES", 3)
    with pytest.raises(InputError, match="sheet Coordinates has 4 modules, expected at most 3"):
        read_edited(tmp_path, lambda main, coordinates: None)
