"""Cells: texts for numbers, errors, dates, extreme numbers; stored values that differ from their formulas' results."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .case import REFUSED, RIGHT, WARNED, WARNED_OF, Catalogue
from .scanners import (
    BIG,
    CENTERS,
    ONE_SHEET_COLUMNS,
    SCANNER,
    USERS_COLUMNS,
    formulas_of,
    one_sheet,
    one_sheet_map,
    quantity,
    scanner,
    typed,
    users,
)
from .sheets import Book, Error, Formula, Raw, Sheet, by_hand, by_openpyxl, by_xlsxwriter

CASES = Catalogue("values")
NO_NUMBER = "the cell is no number, which no map changes"
RECALCULATE = '<calcPr calcId="191029" fullCalcOnLoad="1"/>'
STALE = "the stored value is not the formula's, which no map changes"


def _cell(at: str, value: object) -> Book:
    book = one_sheet(BIG)
    book.sheets[0][at] = value
    return book


def _with_length(length: np.ndarray) -> object:
    return scanner(BIG.centers, 4.0, 150.0, 120.0, 20.0, length)


def _cells() -> None:
    at = ("Geometry!B3",)
    for text in ("315", " 315 ", "3.15e2", "315\N{NO-BREAK SPACE}", "３１５"):
        CASES.add(f"text {text!r}", _cell("B3", text), BIG, RIGHT, REFUSED, place=at, unmappable=NO_NUMBER)
    for text in (
        *("315,0", "1,315", "1.315,0", "1 315", "315 mm", "12.4 in", "315mm"),
        *("315 ± 0.1", "315(2)", "(315)", "315-316", "−315", "3l5", "x"),
        *("n/a", "-", "TBD", "NaN", "inf", "1.#INF"),
        *("#N/A", "#REF!", "''", '"'),
        *("same", "=315", "=B2", "0x13B", "3_1_5", "1e3", "TRUE", "12.05.2021", "5-Dec"),
    ):
        CASES.add(f"text {text!r}", _cell("B3", text), None, REFUSED, place=at)
    for name, value in {
        "blank text": " ",
        "TRUE": True,
        "#N/A": Error("#N/A"),
        "#DIV/0!": Error("#DIV/0!"),
        "#SPILL!": Error("#SPILL!"),
        "nothing": None,
        "a date of ISO": Raw('<c r="B3" t="d"><v>2021-12-05</v></c>'),
        "no value": Raw('<c r="B3"/>'),
        "an empty value": Raw('<c r="B3"><v></v></c>'),
        "an empty inline text": Raw('<c r="B3" t="inlineStr"><is><t/></is></c>'),
        "1e300": 1e300,
        "1e999": Raw('<c r="B3"><v>1e999</v></c>'),
        "NaN": Raw('<c r="B3"><v>NaN</v></c>'),
        "a comma": Raw('<c r="B3"><v>315,0</v></c>'),
        "hexadecimal": Raw('<c r="B3"><v>0x13B</v></c>'),
        "a unit in the value": Raw('<c r="B3"><v>315mm</v></c>'),
        "a text's index out of range": Raw('<c r="B3" t="s"><v>9999</v></c>'),
        "a kind that is none": Raw('<c r="B3" t="zz"><v>315</v></c>'),
    }.items():
        CASES.add(f"value: {name}", _cell("B3", value), None, REFUSED, place=("Geometry",))
    for name, xml in {
        "an exponent": '<c r="B3"><v>3.15E2</v></c>',
        "a leading plus": '<c r="B3"><v>+315</v></c>',
        "17 digits": '<c r="B3"><v>315.00000000000006</v></c>',
        "t=n": '<c r="B3" t="n"><v>315</v></c>',
        "a cell's metadata": '<c r="B3" cm="1" vm="1"><v>315</v></c>',
        "an extension": '<c r="B3"><v>315</v><extLst><ext uri="x"/></extLst></c>',
        "a style that is none": '<c r="B3" s="99"><v>315</v></c>',
        "blanks in the value": '<c r="B3"><v> 315 </v></c>',
        "an XML comment": '<c r="B3"><v><!-- x -->315</v></c>',
        "CDATA": '<c r="B3"><v><![CDATA[315]]></v></c>',
        "an XML comment between digits": '<c r="B3"><v>3<!-- x -->15</v></c>',
    }.items():
        allowed = (RIGHT,) if name in ("an exponent", "17 digits", "t=n") else (RIGHT, REFUSED)
        CASES.add(f"value with {name}", _cell("B3", Raw(xml)), BIG, *allowed, place=("Geometry",), unmappable=NO_NUMBER)
    for name, factor in {"in metres": 1e-3, "in centimetres": 0.1, "in micrometres": 1000.0, "tenfold": 10.0}.items():
        # Without a word about a unit: mm, but no scanner has this size.
        small = scanner(CENTERS * factor, 2.3 * factor, 75 * factor, 50 * factor, 10 * factor)
        book = one_sheet(small)
        CASES.add(
            f"no unit said, a scanner {name}",
            book,
            small,
            WARNED,
            REFUSED,
            place=("Geometry",),
            columns=one_sheet_map(),
        )
    for quantity_name, factor in (
        ("d", 0.1),
        ("R", 0.1),
        ("Ld", 10.0),
        ("l", 0.1),
    ):

        def odd(name: str = quantity_name, factor: float = factor) -> Book:
            made = one_sheet(BIG)
            for row in range(2, 6):
                made.sheets[0][f"{ONE_SHEET_COLUMNS[name]}{row}"] *= factor
            return made

        CASES.add(f"{quantity_name} times {factor:g}, l says so", odd, None, REFUSED, WARNED_OF, place=("Geometry!",))
    for row, name in ((2, "the first"), (4, "one")):

        def one(row: int = row) -> Book:
            made = one_sheet(BIG)
            for column in "BCD":
                made.sheets[0][f"{column}{row}"] *= 0.1
            return made

        CASES.add(f"{name} module's coordinates in cm", one, None, REFUSED, WARNED_OF, place=("Geometry!",))
    for column, name in (("x2", "x2 in the place of x1"),):
        made = one_sheet(BIG)
        for i in range(4):
            made.sheets[0][f"B{2 + i}"] = float(quantity(BIG, column)[i])
        CASES.add(name, made, None, REFUSED, WARNED_OF, place=("Geometry!",))
    dates = _cell("B3", 44535.0)
    dates.sheets[0].formats["B3"] = "d-mmm"
    CASES.add("a number made a date by Excel", dates, None, REFUSED, place=at)
    for epoch in (False, True):
        made = _cell("B3", 315.0)
        made.sheets[0].formats["B3"] = "yyyy-mm-dd"
        made.date1904 = epoch
        CASES.add(
            f"a number shown as a date{', 1904' if epoch else ''}", made, BIG, REFUSED, place=at, unmappable=NO_NUMBER
        )
    plain_1904 = one_sheet(BIG)
    plain_1904.date1904 = True
    CASES.add("dates from 1904, none used", plain_1904, BIG, RIGHT)


def _dimension_in_main(at: str, value: object, recalculated: bool = False) -> Book:
    book = users()
    book["Main"][at] = value
    if recalculated:
        book.calculation = RECALCULATE
    return book


def _stored_values() -> None:
    """Formulas whose stored values are stale, missing, or of another kind."""
    for calculation in (
        "",
        RECALCULATE,
        '<calcPr calcId="0" calcMode="manual"/>',
        '<calcPr calcId="191029" calcCompleted="0" forceFullCalc="1"/>',
        '<calcPr calcId="191029" iterate="1"/>',
    ):
        made = users()
        made.calculation = calculation
        CASES.add(f"right stored values, {calculation or 'no calcPr'}", made, SCANNER, RIGHT)
    full = users()
    full.calculation = '<calcPr calcId="191029" fullPrecision="0"/>'
    CASES.add(
        "precision as displayed, values of all digits",
        full,
        SCANNER,
        RIGHT,
        WARNED,
        REFUSED,
        place=("!",),
        unmappable=STALE,
    )

    # Stored l of another d, R, Ld: what the sheet's formula gives is what a person sees on opening it.
    for at, value, name in (("P4", 3.1, "d"), ("Q4", 90.0, "R"), ("S4", 60.0, "Ld"), ("T4", 20.0, "Td")):
        for flagged in (False, True):
            CASES.add(
                f"{name} changed, formulas not calculated since{', calculation asked for' if flagged else ''}",
                _dimension_in_main(at, value, flagged),
                scanner(Td=[10.0, 20.0, 10.0, 10.0]) if name == "Td" else None,
                REFUSED,
                *((WARNED,) if name == "Td" else ()),  # l does not depend on it
                place=("Coordinates!",),
                unmappable=STALE,
            )
    for name, at, value in (("x1", "B4", 200.0), ("y1", "C5", -100.0), ("z1", "D6", 50.0)):
        made = users()
        made["Coordinates"][at] = value
        CASES.add(f"{name} changed, formulas not calculated since", made, None, REFUSED, place=("Coordinates!",))
    for column, name in (
        ("G", "l"),
        ("E", "b"),
        ("H", "l + b+Td"),
        ("W", "elevation"),
    ):
        for wrong in (0, 1.0):
            for flagged in (False, True):
                made = users()
                sheet = made["Coordinates"]
                sheet[f"{column}4"] = Formula(sheet[f"{column}4"].text, wrong)
                made.calculation = RECALCULATE if flagged else made.calculation
                # Where only a check differs a warning of the cell will do.
                CASES.add(
                    f"stored value of {name} is {wrong:g}{', calculation asked for' if flagged else ''}",
                    made,
                    SCANNER,
                    REFUSED,
                    WARNED,
                    place=("Coordinates!",),
                    unmappable=STALE,
                )
    for stored, name in (
        (0, "0"),
        ("", "empty text"),
        (Error("#NAME?"), "an error"),
        (True, "TRUE"),
        (None, "none"),
    ):
        for column, formula in (("D", "-70.9"), ("B", "100+55"), ("C", "C3+88.1")):
            made = users()
            made["Coordinates"][f"{column}4"] = Formula(formula, stored)
            made.calculation = RECALCULATE
            # Nothing stored: the formula is computed. Anything else is not what the formula gives.
            allowed = (RIGHT, REFUSED) if stored is None or stored == "" else (REFUSED,)
            CASES.add(
                f"{column}4 ={formula} with {name} stored, calculation asked for",
                made,
                SCANNER,
                *allowed,
                place=("Coordinates!",),
                unmappable=STALE,
            )

    whole = users()
    for at, formula in formulas_of(whole["Coordinates"]).items():
        whole["Coordinates"][at] = Formula(formula.text, 0)
    for i in range(4):
        whole["Coordinates"][f"D{3 + i}"] = Formula(f"{float(SCANNER.centers[i, 2])!r}+0", 0)
    whole.calculation = RECALCULATE
    CASES.add(
        "0 stored for every formula, z1 among them, calculation asked for",
        whole,
        SCANNER,
        REFUSED,
        RIGHT,
        place=("Coordinates!",),
        unmappable=STALE,
    )
    unflagged = users()
    for i in range(4):
        unflagged["Coordinates"][f"D{3 + i}"] = Formula(f"{float(SCANNER.centers[i, 2])!r}+0", 0)
    CASES.add("0 stored for the formulas of z1", unflagged, None, REFUSED, WARNED_OF, place=("Coordinates!",))
    for at, column in (("B4", "x1"), ("D3", "z1")):
        made = users()
        value = made["Coordinates"][at]
        made["Coordinates"][at] = Formula("AA1*1", value)
        made["Coordinates"]["AA1"] = value * 1.2
        CASES.add(
            f"{column} is a formula of a cell that changed since",
            made,
            None,
            REFUSED,
            WARNED_OF,
            place=("Coordinates!",),
        )
        same = users()
        same["Coordinates"][at] = Formula("AA1*1", value)
        same["Coordinates"]["AA1"] = value
        CASES.add(f"{column} is a formula of another cell", same, SCANNER, RIGHT)
        same.calculation = RECALCULATE
    polar = users()
    for i, (x, y, _) in enumerate(SCANNER.centers):
        r = 3 + i
        polar["Coordinates"][f"Y{r}"], polar["Coordinates"][f"Z{r}"] = (
            float(np.hypot(x, y)),
            float(np.degrees(np.arctan2(y, x))),
        )
        polar["Coordinates"][f"B{r}"] = Formula(f"Y{r}*COS(RADIANS(Z{r}))", float(x))
        polar["Coordinates"][f"C{r}"] = Formula(f"Y{r}*SIN(RADIANS(Z{r}))", float(y))
    CASES.add("x1 and y1 are formulas of polar coordinates", polar, SCANNER, RIGHT)
    for formula, name in (
        ("VLOOKUP(A4,AA1:AB9,2,FALSE)", "VLOOKUP"),
        ("XLOOKUP(A4,AA1:AA9,AB1:AB9)", "XLOOKUP"),
        ("_xlfn.XLOOKUP(A4,AA1:AA9,AB1:AB9)", "XLOOKUP as it is stored"),
        ("[1]Sheet1!$B$4", "another workbook"),
        ('INDIRECT("AB4")', "INDIRECT"),
        ("OFFSET(AB1,3,0)", "OFFSET"),
        ("RAND()*300", "RAND"),
        ('IFERROR(__xludf.DUMMYFUNCTION("IMPORTRANGE()"),155)', "Google's stand-in"),
        ("myFunction(A4)", "a macro's function"),
        ('WEBSERVICE("http://a")', "the web"),
        ("SQRT(-1)", "an error, of which the stored value is none"),
        ("1/0", "a division by zero"),
        ('"155"', "a text"),
        ("B4", "itself"),
    ):
        for flagged in (False, True):
            made = users()
            made["Coordinates"]["B4"] = Formula(formula, 155.0)
            made["Coordinates"].put("AA1", [[i, 150.0 + i] for i in range(1, 10)])
            made["Coordinates"].put("AA3", [[2, 155.0]])
            made["Coordinates"]["AB4"] = 155.0
            made["Coordinates"]["AA2"] = "x"
            made.calculation = RECALCULATE if flagged else made.calculation
            allowed = (RIGHT, WARNED, REFUSED)
            if name in ("an error, of which the stored value is none", "a division by zero", "itself", "RAND"):
                allowed = (WARNED, REFUSED, *((RIGHT,) if not flagged or name == "RAND" else ()))
            CASES.add(
                f"x1 is a formula of {name}{', calculation asked for' if flagged else ''}",
                made,
                SCANNER,
                *allowed,
                place=("Coordinates!",),
                unmappable=STALE,
            )
    for name, attributes, rows in (
        ("shared", ' t="shared" si="0" ref="E3:E6"', ' t="shared" si="0"'),
        ("array", ' t="array" ref="E3"', None),
    ):
        made = users()
        sheet = made["Coordinates"]
        for i in range(4):
            cell = sheet[f"E{3 + i}"]
            if rows is None:
                sheet[f"E{3 + i}"] = Formula(cell.text, cell.stored, f' t="array" ref="E{3 + i}"')
            else:
                sheet[f"E{3 + i}"] = Formula(cell.text if i == 0 else "", cell.stored, attributes if i == 0 else rows)
        CASES.add(f"{name} formulas", made, SCANNER, RIGHT)
        stripped = users()
        sheet = stripped["Coordinates"]
        for i in range(4):
            cell = sheet[f"G{3 + i}"]
            if rows is None:
                sheet[f"G{3 + i}"] = Formula(cell.text, None, f' t="array" ref="G{3 + i}"')
            else:
                sheet[f"G{3 + i}"] = Formula(
                    cell.text if i == 0 else "", None, attributes.replace("E", "G") if i == 0 else rows
                )
        CASES.add(
            f"{name} formulas of l without values",
            stripped,
            SCANNER,
            RIGHT,
            REFUSED,
            place=("Coordinates!",),
            unmappable=STALE,
        )
    stale_shared = users()
    sheet = stale_shared["Coordinates"]
    for i in range(4):
        sheet[f"Y{3 + i}"] = float(SCANNER.centers[i, 0]) / 2 + (10 if i == 2 else 0)
        sheet[f"B{3 + i}"] = Formula(
            "Y3*2" if i == 0 else "",
            float(SCANNER.centers[i, 0]),
            ' t="shared" si="0" ref="B3:B6"' if i == 0 else ' t="shared" si="0"',
        )
    CASES.add(
        "shared formulas of x1, one stored value stale",
        stale_shared,
        None,
        REFUSED,
        WARNED_OF,
        place=("Coordinates!B5",),
    )
    block = users()
    sheet = block["Coordinates"]
    for i in range(4):
        sheet[f"Y{3 + i}"] = float(SCANNER.centers[i, 0]) / 2
        sheet[f"B{3 + i}"] = (
            Formula("Y3:Y6*2", 277.0, ' t="array" ref="B3:B6"') if i == 0 else float(SCANNER.centers[i, 0])
        )
    CASES.add("one array formula for all x1", block, SCANNER, RIGHT, REFUSED, place=("Coordinates!",), unmappable=STALE)
    table = users()
    table["Coordinates"]["B4"] = Formula("", 155.0, ' t="dataTable" ref="B4:B4" dt2D="0" dtr="0" r1="AA1"')
    CASES.add("a what-if table's cell", table, SCANNER, RIGHT, REFUSED, place=("Coordinates!",), unmappable=STALE)
    empty = users()
    empty["Coordinates"]["B4"] = Formula("", 155.0)
    CASES.add("a formula without a text", empty, SCANNER, RIGHT, REFUSED, place=("Coordinates!",), unmappable=STALE)
    # A typed l prevails; the sheet's formula for the others gives another one.
    master = users()
    master["Coordinates"]["G4"] = 60.0
    length = SCANNER.collimator_length.copy()
    length[1] = 60.0
    for column in "HIJK":
        cell = master["Coordinates"][f"{column}4"]
        master["Coordinates"][f"{column}4"] = Formula(cell.text, None)
    CASES.add("one l typed over its formula", master, scanner(l=length), WARNED, place=("Coordinates!G4",))
    all_typed = typed(users())
    for i in range(4):
        all_typed["Coordinates"][f"G{3 + i}"] = 60.0
        for column in "HIJK":
            all_typed["Coordinates"][f"{column}{3 + i}"] = None
    CASES.add("every l typed, none by design", all_typed, scanner(l=60.0), WARNED, place=("Coordinates!G",))
    other = users()
    for i in range(4):
        r = 3 + i
        other["Coordinates"][f"G{r}"] = Formula(f"0.25*E{r}", float(SCANNER.pinhole_distance[i] / 4))
        for column in "HIJK":
            cell = other["Coordinates"][f"{column}{r}"]
            other["Coordinates"][f"{column}{r}"] = Formula(cell.text, None)
    CASES.add(
        "l by a formula of their own",
        other,
        scanner(l=SCANNER.pinhole_distance / 4),
        WARNED,
        RIGHT,
        place=("Coordinates!G",),
    )
    chain = users()
    chain["Coordinates"]["AA1"], chain["Main"]["AA1"] = Formula("Main!AA1+5", 100.0), 150.0
    chain["Coordinates"]["B4"] = Formula("AA1+55", 155.0)
    CASES.add("x1 two formulas away from what changed", chain, None, REFUSED, WARNED_OF, place=("Coordinates!",))
    named = users()
    named.names["offset"] = "Main!$AA$1"
    named["Main"]["AA1"] = 55.0
    named["Coordinates"]["B4"] = Formula("100+offset", 155.0)
    CASES.add("x1 is a formula of a name", named, SCANNER, RIGHT, REFUSED, place=("Coordinates!",), unmappable=STALE)
    renamed = users()
    renamed.names["offset"] = "Main!$AA$1"
    renamed["Main"]["AA1"] = 65.0
    renamed["Coordinates"]["B4"] = Formula("100+offset", 155.0)
    renamed.calculation = RECALCULATE
    CASES.add(
        "x1 is a formula of a name, stale, calculation asked for",
        renamed,
        None,
        REFUSED,
        WARNED_OF,
        place=("Coordinates!",),
    )
    rounded = users()
    for at, formula in formulas_of(rounded["Coordinates"]).items():
        rounded["Coordinates"][at] = Formula(formula.text, float(f"{formula.stored:.15g}"))
    CASES.add("stored values of 15 digits", rounded, SCANNER, RIGHT)
    short = typed(users())
    for at, value in short["Coordinates"].cells.items():
        if isinstance(value, float) and at[0] in "EHIJKU":
            short["Coordinates"][at] = round(value, 3)
    CASES.add("derived numbers typed as displayed", short, SCANNER, RIGHT)
    axis = users(scanner(np.array([[0.0, 0.0, 200.0], *CENTERS[1:].tolist()])))
    axis["Coordinates"]["V3"] = Formula("(ATAN2(B3,C3))", Error("#DIV/0!"))
    CASES.add("a module on the axis", axis, scanner(np.array([[0.0, 0.0, 200.0], *CENTERS[1:].tolist()])), RIGHT)
    failed = users()
    for i in range(4):
        failed["Coordinates"][f"F{3 + i}"] = Error("#NAME?")
    CASES.add("errors in a column that is not used", failed, SCANNER, RIGHT)


def _xlsxwriter(book: Book, path: Path, values: bool) -> None:
    if not values:
        for sheet in book.sheets:
            for at, formula in formulas_of(sheet).items():
                sheet[at] = Formula(formula.text)
    by_xlsxwriter(book, path)


def _z_formulas() -> Book:
    book = users()
    for i in range(4):
        z = float(SCANNER.centers[i, 2])
        book["Coordinates"][f"Y{3 + i}"] = z / 2
        book["Coordinates"][f"D{3 + i}"] = Formula(f"Y{3 + i}*2", z)
    return book


def _programs() -> None:
    """The same workbook by three programs; XlsxWriter stores 0 for a formula and asks for calculation."""
    for name, make in {"users": users, "z1 by formula": _z_formulas, "one sheet": lambda: one_sheet(BIG)}.items():
        truth = BIG if name == "one sheet" else SCANNER
        CASES.add(f"{name}, by hand", lambda make=make: make(), truth, RIGHT)
        CASES.add(f"{name}, by openpyxl", lambda path, make=make: by_openpyxl(make(), path), truth, RIGHT)
        CASES.add(
            f"{name}, by XlsxWriter with values",
            lambda path, make=make: _xlsxwriter(make(), path, True),
            truth,
            RIGHT,
            needs="xlsxwriter",
        )
        allowed = (RIGHT,) if name == "one sheet" else (RIGHT, REFUSED)
        CASES.add(
            f"{name}, by XlsxWriter without values",
            lambda path, make=make: _xlsxwriter(make(), path, False),
            truth,
            *allowed,
            place=("Coordinates!",),
            unmappable=STALE,
            needs="xlsxwriter",
        )
        CASES.add(
            f"{name}, by XlsxWriter in constant memory",
            lambda path, make=make: by_xlsxwriter(make(), path, constant_memory=True),
            truth,
            RIGHT,
            needs="xlsxwriter",
        )
        CASES.add(f"{name}, saved again by openpyxl", lambda path, make=make: _saved_again(make(), path), truth, RIGHT)
        CASES.add(
            f"{name}, values only by openpyxl",
            lambda path, make=make: _saved_again(make(), path, data_only=True),
            truth,
            RIGHT,
        )
    for column in ("x1", "z1", "l", "d"):
        name = USERS_COLUMNS[column]
        sheet_name = "Main" if column == "d" else "Coordinates"

        def half(path: Path, name: str = name, sheet_name: str = sheet_name) -> None:
            book = typed(users())
            sheet: Sheet = book[sheet_name]
            for row in range(3, 7):
                sheet[f"AA{row}"] = sheet[f"{name}{row}"] / 2
                sheet[f"{name}{row}"] = Formula(f"AA{row}*2")
            by_xlsxwriter(book, path)

        CASES.add(
            f"{column} alone a formula, by XlsxWriter without values",
            half,
            SCANNER,
            RIGHT,
            REFUSED,
            place=("!" + name,),
            unmappable=STALE,
            needs="xlsxwriter",
        )


def _saved_again(book: Book, path: Path, data_only: bool = False) -> None:
    import openpyxl

    by_hand(book, path)
    openpyxl.load_workbook(path, data_only=data_only).save(path)


_cells()
_stored_values()
_programs()
