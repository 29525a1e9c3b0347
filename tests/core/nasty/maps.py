"""Column maps: valid ones and faulty ones."""

from __future__ import annotations

from .case import REFUSED, RIGHT, WARNED, WARNED_OF, Catalogue
from .scanners import BIG, SCANNER, column_map, one_sheet, one_sheet_map, scanner, users, users_map
from .sheets import Formula

CASES = Catalogue("maps")
"""Here `columns` is what the workbook is read with, whatever it would be without."""

MAP = ("scanner.toml", "map", "scanner.xlsx")


def _right() -> None:
    plain = one_sheet(BIG)
    CASES.add("the whole sheet", plain, BIG, RIGHT, columns=one_sheet_map())
    CASES.add("a part of the rows", plain, BIG[1:3], RIGHT, columns=one_sheet_map(first=3, last=4))
    CASES.add("one row", plain, BIG[3:], RIGHT, columns=one_sheet_map(first=5, last=5))
    CASES.add("without numbers", plain, BIG, RIGHT, columns=one_sheet_map(number=None))
    CASES.add("with the row of headings", plain, BIG, RIGHT, columns=one_sheet_map(header_row=1))
    CASES.add(
        "columns in small letters",
        plain,
        BIG,
        RIGHT,
        REFUSED,
        place=MAP,
        columns=one_sheet_map()
        .lower()
        .replace("geometry", "Geometry")
        .replace("ld =", "Ld =")
        .replace("td =", "Td =")
        .replace("\nr =", "\nR ="),
    )
    CASES.add("x1 by another column", _exchanged(), BIG, RIGHT, columns=one_sheet_map(columns={"x1": "C", "y1": "B"}))
    CASES.add("users' workbook", users(), SCANNER, RIGHT, columns=users_map())
    CASES.add("users' workbook without l", users(), SCANNER, RIGHT, columns=users_map(length=False))
    CASES.add(
        "users' workbook in order",
        users(),
        SCANNER,
        RIGHT,
        columns=users_map(dimensions={"rows": "in order", "number": None}),
    )
    CASES.add(
        "users' workbook, one row for all",
        users(),
        SCANNER,
        RIGHT,
        columns=users_map(dimensions={"rows": "one for all", "number": None, "last_row": 3}),
    )
    three = scanner(BIG.centers[:3], 4.0, 150.0, 120.0, 20.0, BIG.collimator_length[:3])
    CASES.add("rows end above a total", _total(), three, RIGHT, columns=one_sheet_map(last=4))
    for unit in ("mm", "cm", "m", "in", "um", "µm", "\N{GREEK SMALL LETTER MU}m"):
        of = unit if unit in ("mm", "cm", "m", "in") else "um"
        bare = one_sheet(BIG, dict.fromkeys(("x1", "y1", "z1", "d", "R", "Ld", "Td", "l"), "?"), of)
        CASES.add(f"unit {unit}", bare, BIG, RIGHT, columns=one_sheet_map(unit))
    mixed = {"x1": "cm", "d": "um", "l": "m", "Ld": "in"}
    CASES.add("a unit each", one_sheet(BIG, dict.fromkeys(mixed, "?"), mixed), BIG, RIGHT, columns=one_sheet_map(mixed))
    far = one_sheet(BIG)
    far.sheets[0].moved(down=1000)
    CASES.add("rows far down", far, BIG, RIGHT, columns=one_sheet_map(first=1002, last=1005))
    far = one_sheet(BIG)
    far.sheets[0].moved(right=700)
    names = ("ZZ", "AAA", "AAB", "AAC", "AAD", "AAE", "AAF", "AAG")
    columns = dict(zip(("x1", "y1", "z1", "d", "R", "Ld", "Td", "l"), names, strict=True))
    CASES.add("columns far to the right", far, BIG, RIGHT, columns=one_sheet_map(columns=columns, number="ZY"))


def _exchanged():
    book = one_sheet(BIG, {"x1": "q", "y1": "p"})
    sheet = book.sheets[0]
    for row in range(2, 6):
        sheet[f"B{row}"], sheet[f"C{row}"] = sheet[f"C{row}"], sheet[f"B{row}"]
    return book


def _total():
    book = one_sheet(BIG)
    book.sheets[0]["A5"] = "Total"
    return book


def _wrong() -> None:
    plain, good = one_sheet(BIG), one_sheet_map()
    for name, text in {
        "an empty file": "",
        "no TOML": "this is = = not toml",
        "TOML of something else": "[tool]\nx = 1\n",
        "no tables": "tables = []\n",
        "tables that are none": "tables = 3\n",
        "a table without columns": '[[tables]]\nsheet = "Geometry"\nfirst_row = 2\nlast_row = 5\n',
        "a sheet that is not there": good.replace("Geometry", "Coordinates"),
        "a sheet by a number": good.replace('"Geometry"', "1"),
        "no sheet": good.replace('sheet = "Geometry"\n', ""),
        "no first row": good.replace("first_row = 2\n", ""),
        "no last row": good.replace("last_row = 5\n", ""),
        "the last row above the first": good.replace("last_row = 5", "last_row = 1"),
        "first row 0": good.replace("first_row = 2", "first_row = 0"),
        "a negative row": good.replace("first_row = 2", "first_row = -2"),
        "a fraction of a row": good.replace("first_row = 2", "first_row = 2.5"),
        "a row in quotes": good.replace("first_row = 2", 'first_row = "2"'),
        "a row that is true": good.replace("first_row = 2", "first_row = true"),
        "rows beyond the sheet": good.replace("last_row = 5", "last_row = 9"),
        "rows beyond all sheets": good.replace("last_row = 5", "last_row = 99999999"),
        "the row of headings among the modules": good.replace("first_row = 2", "first_row = 1"),
        "a column that is none": good.replace('"B"', '"2"'),
        "a column by a number": good.replace('"B"', "2"),
        "a column with a row": good.replace('"B"', '"B2"'),
        "a column beyond all sheets": good.replace('"B"', '"XFE"'),
        "an empty column": good.replace('"B"', '""'),
        "a column without numbers": good.replace('"B"', '"K"'),
        "no unit": good.replace(', unit = "mm"', "", 1),
        "an empty unit": good.replace('unit = "mm"', 'unit = ""', 1),
        "a unit that is none": good.replace('unit = "mm"', 'unit = "furlong"', 1),
        "a unit of angles for a length": good.replace('unit = "mm"', 'unit = "deg"', 1),
        "a quantity that is none": good.replace("x1 =", "x9 ="),
        "a quantity in other letters": good.replace("x1 =", "X1 ="),
        "x1 missing": good.replace('x1 = { column = "B", unit = "mm" }\n', ""),
        "d missing": good.replace('d = { column = "E", unit = "mm" }\n', ""),
        "a word more in a table": good.replace("first_row", 'colour = "red"\nfirst_row', 1),
        "a word more in a column": good.replace('unit = "mm" }', 'unit = "mm", scale = 2 }', 1),
        "a word more in the file": 'version = "x"\n' + good,
        "first_row misspelt": good.replace("first_row", "firstrow"),
        "one column for two quantities": good.replace('y1 = { column = "C"', 'y1 = { column = "B"'),
        "the column of the numbers for x1": good.replace('x1 = { column = "B"', 'x1 = { column = "A"'),
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
        CASES.add(f"wrong: {name}", plain, None, REFUSED, place=MAP, columns=text)
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
        allowed = (REFUSED,) if name not in ("by number, none in Coordinates",) else (REFUSED, RIGHT)
        if name == "no way of joining":
            allowed = (REFUSED, RIGHT)
        CASES.add(f"wrong: {name}", users(), SCANNER, *allowed, place=MAP, columns=text, unmappable="it is wrong")
    # The map contradicts the sheet.
    for heading, unit in (("{} (cm)", "mm"), ("{} (mm)", "cm"), ("{} (in)", "cm")):
        said = heading[4:6]
        book = one_sheet(BIG, {q: heading.format(q) for q in ("x1", "y1", "z1", "d", "R", "Ld", "Td", "l")}, said)
        CASES.add(
            f"map in {unit}, headings in {said}", book, None, REFUSED, WARNED_OF, place=MAP, columns=one_sheet_map(unit)
        )
    format_cm = one_sheet(BIG, unit="cm")
    for row in range(2, 6):
        format_cm.sheets[0].formats[f"B{row}"] = '0.0" cm"'
    CASES.add(
        "map in mm, number format in cm", format_cm, None, REFUSED, WARNED_OF, place=MAP, columns=one_sheet_map("mm")
    )
    CASES.add(
        "map of y1 on the column headed x1",
        plain,
        None,
        REFUSED,
        WARNED_OF,
        place=MAP,
        columns=one_sheet_map(columns={"x1": "C", "y1": "B"}),
    )
    CASES.add(
        "map of d on the column headed R",
        plain,
        None,
        REFUSED,
        WARNED_OF,
        place=MAP,
        columns=one_sheet_map(columns={"d": "F", "R": "E"}),
    )
    # Faults of a workbook remain faults with a map.
    for name, value in {
        "a text": "315",
        "a blank cell": None,
        "an error": "#N/A",
        "a stale formula": Formula("300+20", 315.0),
    }.items():
        book = one_sheet(BIG)
        book.sheets[0]["B3"] = value
        book.calculation = '<calcPr calcId="191029" fullCalcOnLoad="1"/>'
        allowed = (REFUSED, RIGHT) if name == "a text" else (REFUSED,)
        CASES.add(
            f"{name} in a mapped column",
            book,
            BIG if name == "a text" else None,
            *allowed,
            place=("Geometry!B3",),
            columns=good,
        )
    zeros = users()
    for at, value in zeros["Coordinates"].cells.items():
        if isinstance(value, Formula) and at[0] == "G":
            zeros["Coordinates"][at] = Formula(value.text, 0)
    zeros.calculation = '<calcPr calcId="191029" fullCalcOnLoad="1"/>'
    CASES.add(
        "0 stored for every l in a mapped column",
        zeros,
        SCANNER,
        REFUSED,
        RIGHT,
        place=("Coordinates!G3",),
        columns=users_map(),
    )
    repeated = one_sheet(BIG)
    repeated.sheets[0]["A4"] = 2
    CASES.add(
        "a number twice in a mapped column", repeated, None, REFUSED, place=("Geometry!A4", "Geometry!A3"), columns=good
    )
    tiny = one_sheet(BIG)
    CASES.add(
        "map in m on a sheet in mm", tiny, None, REFUSED, WARNED_OF, place=("Geometry",), columns=one_sheet_map("m")
    )
    CASES.add(
        "map in um on a sheet in mm", tiny, None, REFUSED, WARNED_OF, place=("Geometry",), columns=one_sheet_map("um")
    )
    CASES.add("map on a hidden sheet", _hidden(), BIG, RIGHT, WARNED, columns=good, place=("Geometry",))
    CASES.add("map where all is plain without one", plain, BIG, RIGHT, columns=good)


def _hidden():
    book = one_sheet(BIG)
    book.sheets[0].state = "hidden"
    book.add("Notes", {"A1": "x"})
    return book


_right()
_wrong()
