"""Column maps: valid ones and faulty ones."""

from __future__ import annotations

import re

from .case import DOUBTED, READ_OR_REFUSED, REFUSED, RIGHT, WARNED, Catalogue
from .scanners import (
    BIG,
    ONE_SHEET_COLUMNS,
    SCANNER,
    column_map,
    one_sheet,
    one_sheet_map,
    scanner,
    users,
    users_map,
    with_cells,
    with_format,
)
from .sheets import Formula

MAP = ("scanner.toml", "map", "scanner.xlsx")
CASES = Catalogue("maps", place=MAP)
"""Here `columns` is what the workbook is read with, whatever it would be without."""

RECALCULATE = '<calcPr calcId="191029" fullCalcOnLoad="1"/>'


def _right() -> None:
    plain = one_sheet(BIG)
    CASES.add("the whole sheet", plain, BIG, RIGHT, columns=one_sheet_map())
    CASES.add("a part of the rows", plain, BIG[1:3], RIGHT, columns=one_sheet_map(first=3, last=4))
    CASES.add("without numbers", plain, BIG, RIGHT, columns=one_sheet_map(number=None))
    CASES.add("with the row of headings", plain, BIG, RIGHT, columns=one_sheet_map(header_row=1))
    small = re.sub('"[A-I]"', lambda m: m[0].lower(), one_sheet_map())
    CASES.add("columns in small letters", plain, BIG, *READ_OR_REFUSED, columns=small)
    other = one_sheet(BIG, {"x1": "q", "y1": "p"})
    sheet = other.sheets[0]
    for row in range(2, 6):
        sheet[f"B{row}"], sheet[f"C{row}"] = sheet[f"C{row}"], sheet[f"B{row}"]
    CASES.add("x1 by another column", other, BIG, RIGHT, columns=one_sheet_map(columns={"x1": "C", "y1": "B"}))
    for name, mapped in {
        "": users_map(),
        " without l": users_map(length=False),
        " in order": users_map(dimensions={"rows": "in order", "number": None}),
        ", one row for all": users_map(dimensions={"rows": "one for all", "number": None, "last_row": 3}),
    }.items():
        CASES.add(f"users' workbook{name}", users(), SCANNER, RIGHT, columns=mapped)
    three = scanner(BIG.centers[:3], 4.0, 150.0, 120.0, 20.0, BIG.collimator_length[:3])
    total = with_cells(one_sheet(BIG), A5="Total")
    CASES.add("rows end above a total", total, three, RIGHT, columns=one_sheet_map(last=4))
    for unit, of in {"cm": "cm", "in": "in", "\N{GREEK SMALL LETTER MU}m": "um"}.items():
        bare = one_sheet(BIG, dict.fromkeys(ONE_SHEET_COLUMNS, "?"), of)
        CASES.add(f"unit {unit}", bare, BIG, RIGHT, columns=one_sheet_map(unit))
    mixed = {"x1": "cm", "d": "um", "l": "m", "Ld": "in"}
    CASES.add("a unit each", one_sheet(BIG, dict.fromkeys(mixed, "?"), mixed), BIG, RIGHT, columns=one_sheet_map(mixed))
    far = one_sheet(BIG)
    far.sheets[0].moved(down=1000, right=700)
    names = ("ZZ", "AAA", "AAB", "AAC", "AAD", "AAE", "AAF", "AAG")
    columns = dict(zip(ONE_SHEET_COLUMNS, names, strict=True))
    mapped = one_sheet_map(first=1002, last=1005, columns=columns, number="ZY")
    CASES.add("a table far down to the right", far, BIG, RIGHT, columns=mapped)


def _wrong() -> None:
    plain, good = one_sheet(BIG), one_sheet_map()
    for name, text in {
        "an empty file": "",
        "no TOML": "this is = = not toml",
        "TOML of something else": "[tool]\nx = 1\n",
        "no tables": "tables = []\n",
        "a table without columns": '[[tables]]\nsheet = "Geometry"\nfirst_row = 2\nlast_row = 5\n',
        "a sheet that is not there": good.replace("Geometry", "Coordinates"),
        "a sheet by a number": good.replace('"Geometry"', "1"),
        "no sheet": good.replace('sheet = "Geometry"\n', ""),
        "no first row": good.replace("first_row = 2\n", ""),
        "the last row above the first": good.replace("last_row = 5", "last_row = 1"),
        "first row 0": good.replace("first_row = 2", "first_row = 0"),
        "a fraction of a row": good.replace("first_row = 2", "first_row = 2.5"),
        "rows beyond the sheet": good.replace("last_row = 5", "last_row = 9"),
        "the row of headings among the modules": good.replace("first_row = 2", "first_row = 1"),
        "a column that is none": good.replace('"B"', '"2"'),
        "a column by a number": good.replace('"B"', "2"),
        "a column without numbers": good.replace('"B"', '"K"'),
        "no unit": good.replace(', unit = "mm"', "", 1),
        "an empty unit": good.replace('unit = "mm"', 'unit = ""', 1),
        "a unit that is none": good.replace('unit = "mm"', 'unit = "furlong"', 1),
        "a quantity that is none": good.replace("x1 =", "x9 ="),
        "x1 missing": good.replace('x1 = { column = "B", unit = "mm" }\n', ""),
        "d missing": good.replace('d = { column = "E", unit = "mm" }\n', ""),
        "a word more in a table": good.replace("first_row", 'colour = "red"\nfirst_row', 1),
        "a word more in a column": good.replace('unit = "mm" }', 'unit = "mm", scale = 2 }', 1),
        "first_row misspelt": good.replace("first_row", "firstrow"),
        "one column for two quantities": good.replace('y1 = { column = "C"', 'y1 = { column = "B"'),
        "a quantity in two tables": good
        + column_map(
            {"sheet": "Geometry", "first_row": 2, "last_row": 5, "rows": "in order", "columns": {"d": ("F", "mm")}}
        ),
        "a column as a text": good.replace('{ column = "B", unit = "mm" }', '"B"'),
        "rows joined in a way that is none": good
        + column_map(
            {"sheet": "Geometry", "first_row": 2, "last_row": 5, "rows": "by name", "columns": {"b": ("F", "mm")}}
        ),
    }.items():
        assert text != good, name
        CASES.add(f"wrong: {name}", plain, None, REFUSED, columns=text)
    for name, text in {
        "more rows of Main than modules, in order": users_map(
            dimensions={"rows": "in order", "number": None, "last_row": 7}
        ),
        "fewer rows of Main than modules, in order": users_map(
            dimensions={"rows": "in order", "number": None, "last_row": 5}
        ),
        "several rows for one for all": users_map(dimensions={"rows": "one for all", "number": None}),
        "by number without numbers": users_map(dimensions={"number": None}),
        "by number, none in Coordinates": users_map(position={"number": None}),
        "no way of joining": users_map(dimensions={"rows": None}),
        "numbers in a column without them": users_map(position={"number": "X"}),
        "numbers in a column of lengths": users_map(position={"number": "B"}),
    }.items():
        allowed = READ_OR_REFUSED if name in ("by number, none in Coordinates", "no way of joining") else (REFUSED,)
        CASES.add(f"wrong: {name}", users(), SCANNER, *allowed, columns=text, unmappable="it is wrong")
    # The map contradicts the sheet.
    for unit, said in (("mm", "cm"), ("cm", "mm")):
        book = one_sheet(BIG, {q: f"{q} ({said})" for q in ONE_SHEET_COLUMNS}, said)
        CASES.add(f"map in {unit}, headings in {said}", book, None, *DOUBTED, columns=one_sheet_map(unit))
    format_cm = with_format(one_sheet(BIG, unit="cm"), '0.0" cm"', "B")
    for name, book, mapped in (
        ("map in mm, number format in cm", format_cm, good),
        ("map of y1 on the column headed x1", plain, one_sheet_map(columns={"x1": "C", "y1": "B"})),
        ("map of d on the column headed R", plain, one_sheet_map(columns={"d": "F", "R": "E"})),
        ("map in m on a sheet in mm", plain, one_sheet_map("m")),
    ):
        CASES.add(name, book, None, *DOUBTED, place=(*MAP, "Geometry"), columns=mapped)
    # Faults of a workbook remain faults with a map.
    for name, value in {"a text": "315", "a blank cell": None, "a stale formula": Formula("300+20", 315.0)}.items():
        book = with_cells(one_sheet(BIG), B3=value)
        book.calculation = RECALCULATE
        truth, allowed = (BIG, READ_OR_REFUSED) if name == "a text" else (None, (REFUSED,))
        CASES.add(f"{name} in a mapped column", book, truth, *allowed, place="Geometry!B3", columns=good)
    zeros = users()
    for at, value in zeros["Coordinates"].cells.items():
        if isinstance(value, Formula) and at[0] == "G":
            zeros["Coordinates"][at] = Formula(value.text, 0)
    zeros.calculation = RECALCULATE
    name = "0 stored for every l in a mapped column"
    CASES.add(name, zeros, SCANNER, *READ_OR_REFUSED, place="Coordinates!G3", columns=users_map())
    repeated = {"place": ("Geometry!A4", "Geometry!A3"), "columns": good}
    CASES.add("a number twice in a mapped column", with_cells(one_sheet(BIG), A4=2), None, REFUSED, **repeated)
    hidden = one_sheet(BIG)
    hidden.sheets[0].state = "hidden"
    hidden.add("Notes", {"A1": "x"})
    CASES.add("map on a hidden sheet", hidden, BIG, RIGHT, WARNED, place="Geometry", columns=good)


_right()
_wrong()
