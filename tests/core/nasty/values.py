"""Cells: texts for numbers, errors, dates, extreme numbers; stored values that differ from their formulas' results."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import openpyxl

from .case import DOUBTED, READ_OR_REFUSED, REFUSED, RIGHT, WARNED, Catalogue
from .scanners import (
    BIG,
    CENTERS,
    SCANNER,
    formulas_of,
    one_sheet,
    one_sheet_map,
    scaled,
    scanner,
    typed,
    users,
    with_cells,
    with_format,
)
from .sheets import Book, Error, Formula, Raw, by_hand, by_openpyxl, by_xlsxwriter

STALE = "the stored value is not the formula's, which no map changes"
CASES = Catalogue("values", place="Coordinates!", unmappable=STALE)
NO_NUMBER = "the cell is no number, which no map changes"
RECALCULATE = '<calcPr calcId="191029" fullCalcOnLoad="1"/>'


def _cell(at: str, value: object) -> Book:
    return with_cells(one_sheet(BIG), **{at: value})


def _cells() -> None:
    at = {"place": "Geometry!B3", "unmappable": NO_NUMBER}
    for text in ("315", " 3.15e2 ", "315\N{NO-BREAK SPACE}", "３１５"):
        CASES.add(f"text {text!r}", _cell("B3", text), BIG, *READ_OR_REFUSED, **at)
    for text in ("315,0", "1.315,0", "1 315", "315 mm", "315 ± 0.1", "(315)", "3l5", "n/a", "NaN", '"', "=B2", "TRUE"):
        CASES.add(f"text {text!r}", _cell("B3", text), None, REFUSED, **at)
    for name, value in {
        "blank text": " ",
        "TRUE": True,
        "#N/A": Error("#N/A"),
        "nothing": None,
        "a date of ISO": Raw('<c r="B3" t="d"><v>2021-12-05</v></c>'),
        "no value": Raw('<c r="B3"/>'),
        "an empty value": Raw('<c r="B3"><v></v></c>'),
        "an empty inline text": Raw('<c r="B3" t="inlineStr"><is><t/></is></c>'),
        "1e300": 1e300,
        "1e999": Raw('<c r="B3"><v>1e999</v></c>'),
        "NaN": Raw('<c r="B3"><v>NaN</v></c>'),
        "a unit in the value": Raw('<c r="B3"><v>315mm</v></c>'),
        "a text's index out of range": Raw('<c r="B3" t="s"><v>9999</v></c>'),
        "a kind that is none": Raw('<c r="B3" t="zz"><v>315</v></c>'),
    }.items():
        CASES.add(f"value: {name}", _cell("B3", value), None, REFUSED, place="Geometry")
    for name, xml in {
        "17 digits": '<c r="B3" t="n"><v>3.1500000000000006E2</v></c>',
        "a cell's metadata": '<c r="B3" cm="1" vm="1"><v>+315</v></c>',
        "an extension": '<c r="B3"><v>315</v><extLst><ext uri="x"/></extLst></c>',
        "a style that is none": '<c r="B3" s="99"><v> 315 </v></c>',
        "CDATA": '<c r="B3"><v><![CDATA[315]]></v></c>',
        "an XML comment between digits": '<c r="B3"><v>3<!-- x -->15</v></c>',
    }.items():
        allowed = (RIGHT,) if name == "17 digits" else READ_OR_REFUSED
        CASES.add(f"value with {name}", _cell("B3", Raw(xml)), BIG, *allowed, **at)
    for name, factor in {"in metres": 1e-3, "tenfold": 10.0}.items():
        # Without a word about a unit: mm, but no scanner has this size.
        small = scanner(CENTERS * factor, 2.3 * factor, 75 * factor, 50 * factor, 10 * factor)
        what = f"no unit said, a scanner {name}"
        CASES.add(what, one_sheet(small), small, WARNED, REFUSED, place="Geometry", columns=one_sheet_map())
    for name, factor, cells in (
        ("d times 0.1, l says so", 0.1, [f"E{row}" for row in range(2, 6)]),
        ("Ld times 10, l says so", 10.0, [f"G{row}" for row in range(2, 6)]),
        ("one module's coordinates in cm", 0.1, ["B4", "C4", "D4"]),
    ):
        CASES.add(name, scaled(one_sheet(BIG), factor, cells), None, *DOUBTED, place="Geometry!")
    for epoch in (False, True):
        made = with_format(one_sheet(BIG), "yyyy-mm-dd", "B")
        made.date1904 = epoch
        CASES.add(
            f"numbers shown as dates{', 1904' if epoch else ''}", made, BIG, REFUSED, **at | {"place": "Geometry!B"}
        )
    plain_1904 = one_sheet(BIG)
    plain_1904.date1904 = True
    CASES.add("dates from 1904, none used", plain_1904, BIG, RIGHT)


def _calculated(book: Book, flagged: bool = True) -> Book:
    """The book, which asks for calculation."""
    book.calculation = RECALCULATE if flagged else book.calculation
    return book


def _in_coordinates(**cells: object) -> Book:
    return with_cells(users(), **{f"Coordinates_{at}": value for at, value in cells.items()})


def _z_formulas(stored: Callable[[float], object] = float) -> Book:
    """The users' workbook, its z1 by formulas."""
    book = users()
    for i, z in enumerate(SCANNER.centers[:, 2].tolist()):
        book["Coordinates"][f"Y{3 + i}"] = z / 2
        book["Coordinates"][f"D{3 + i}"] = Formula(f"Y{3 + i}*2", stored(z))
    return book


def _stored_values() -> None:
    """Formulas whose stored values are stale, missing, or of another kind."""
    for calculation in ("", '<calcPr calcId="0" calcMode="manual"/>', '<calcPr calcCompleted="0" forceFullCalc="1"/>'):
        made = users()
        made.calculation = calculation
        CASES.add(f"right stored values, {calculation or 'no calcPr'}", made, SCANNER, RIGHT)
    # Stored l of another d: what the sheet's formula gives is what a person sees on opening it. It depends on no Td.
    for at, value, truth in (("P4", 3.1, None), ("T4", 20.0, scanner(Td=[10.0, 20.0, 10.0, 10.0]))):
        for flagged in (False, True):
            name = f"{at} changed, formulas not calculated since{', calculation asked for' if flagged else ''}"
            book = _calculated(with_cells(users(), **{f"Main_{at}": value}), flagged)
            CASES.add(name, book, truth, REFUSED, *((WARNED,) if truth else ()))
    CASES.add("x1 changed, formulas not calculated since", _in_coordinates(B4=200.0), None, REFUSED)
    for column, name in (("G", "l"), ("E", "b"), ("W", "elevation")):
        for wrong in (0, 1.0):
            made = users()
            sheet = made["Coordinates"]
            sheet[f"{column}4"] = Formula(sheet[f"{column}4"].text, wrong)
            # Where only a check differs a warning of the cell will do.
            flagged = wrong == 0
            CASES.add(f"stored value of {name} is {wrong:g}", _calculated(made, flagged), SCANNER, *DOUBTED, WARNED)
    for stored, name in ((0, "0"), ("", "empty text"), (Error("#NAME?"), "an error"), (True, "TRUE"), (None, "none")):
        for column, formula in (("D", "-70.9"), ("C", "C3+88.1")):
            # Nothing stored: the formula is computed. Anything else is not what the formula gives.
            allowed = READ_OR_REFUSED if stored is None or stored == "" else (REFUSED,)
            book = _calculated(_in_coordinates(**{f"{column}4": Formula(formula, stored)}))
            CASES.add(f"{column}4 ={formula} with {name} stored, calculation asked for", book, SCANNER, *allowed)
    whole = _calculated(_z_formulas(lambda z: 0))
    for at, formula in formulas_of(whole["Coordinates"]).items():
        whole["Coordinates"][at] = Formula(formula.text, 0)
    CASES.add("0 stored for every formula, z1 among them", whole, SCANNER, *READ_OR_REFUSED)
    CASES.add("0 stored for the formulas of z1", _z_formulas(lambda z: 0), None, *DOUBTED)
    for name, at, truth, allowed in (
        ("a cell that changed since", 186.0, None, DOUBTED),
        ("another cell", 155.0, SCANNER, (RIGHT,)),
    ):
        CASES.add(f"x1 is a formula of {name}", _in_coordinates(B4=Formula("AA1*1", 155.0), AA1=at), truth, *allowed)
    polar = users()
    for i, (x, y, _) in enumerate(SCANNER.centers.tolist()):
        r = 3 + i
        row = [[Formula(f"Y{r}*COS(RADIANS(Z{r}))", x), Formula(f"Y{r}*SIN(RADIANS(Z{r}))", y)]]
        polar["Coordinates"].put(f"B{r}", row)
        polar["Coordinates"].put(f"Y{r}", [[float(np.hypot(x, y)), float(np.degrees(np.arctan2(y, x)))]])
    CASES.add("x1 and y1 are formulas of polar coordinates", polar, SCANNER, RIGHT)
    for formula, name in (
        ("VLOOKUP(A4,AA1:AB9,2,FALSE)", "VLOOKUP"),
        ("_xlfn.XLOOKUP(A4,AA1:AA9,AB1:AB9)", "XLOOKUP as it is stored"),
        ("[1]Sheet1!$B$4", "another workbook"),
        ('INDIRECT("AB4")', "INDIRECT"),
        ("RAND()*300", "RAND"),
        ('IFERROR(__xludf.DUMMYFUNCTION("IMPORTRANGE()"),155)', "Google's stand-in"),
        ("SQRT(-1)", "an error, of which the stored value is none"),
        ("1/0", "a division by zero"),
        ('"155"', "a text"),
        ("B4", "itself"),
    ):
        for flagged in (False, True):
            made = _calculated(_in_coordinates(B4=Formula(formula, 155.0), AA2="x", AB4=155.0), flagged)
            made["Coordinates"].put("AA1", [[i, 155.0 if i == 2 else 150.0 + i] for i in range(1, 10)])
            allowed = (RIGHT, WARNED, REFUSED)
            if name in ("an error, of which the stored value is none", "a division by zero", "itself", "RAND"):
                allowed = (WARNED, REFUSED, *((RIGHT,) if not flagged or name == "RAND" else ()))
            asked = ", calculation asked for" if flagged else ""
            CASES.add(f"x1 is a formula of {name}{asked}", made, SCANNER, *allowed)
    shared = [' t="shared" si="0" ref="{0}3:{0}6"', *[' t="shared" si="0"'] * 3]
    arrays = [f' t="array" ref="{{0}}{row}"' for row in range(3, 7)]
    for name, attributes in (("shared", shared), ("array", arrays)):
        for column, keeps in (("E", True), ("G", False)):
            made = users()
            for i, of in enumerate(attributes):
                cell = made["Coordinates"][f"{column}{3 + i}"]
                text = cell.text if i == 0 or name == "array" else ""
                value = cell.stored if keeps else None
                made["Coordinates"][f"{column}{3 + i}"] = Formula(text, value, of.format(column))
            what = f"{name} formulas of {column}{'' if keeps else ' without values'}"
            CASES.add(what, made, SCANNER, *((RIGHT,) if keeps else READ_OR_REFUSED))
    stale_shared = users()
    for i, (x, of) in enumerate(zip(SCANNER.centers[:, 0].tolist(), shared, strict=True)):
        stale_shared["Coordinates"][f"Y{3 + i}"] = x / 2 + (10 if i == 2 else 0)
        stale_shared["Coordinates"][f"B{3 + i}"] = Formula("" if i else "Y3*2", x, of.format("B"))
    name = "shared formulas of x1, one stored value stale"
    CASES.add(name, stale_shared, None, *DOUBTED, place="Coordinates!B5")
    block = users()
    for i, x in enumerate(SCANNER.centers[:, 0].tolist()):
        block["Coordinates"][f"Y{3 + i}"] = x / 2
        block["Coordinates"][f"B{3 + i}"] = x if i else Formula("Y3:Y6*2", x, ' t="array" ref="B3:B6"')
    CASES.add("one array formula for all x1", block, SCANNER, *READ_OR_REFUSED)
    table = _in_coordinates(B4=Formula("", 155.0, ' t="dataTable" ref="B4:B4" dt2D="0" dtr="0" r1="AA1"'))
    CASES.add("a what-if table's cell", table, SCANNER, *READ_OR_REFUSED)
    # A typed l prevails; the sheet's formula for the others gives another one.
    lengths = SCANNER.collimator_length.copy()
    lengths[1] = 60.0
    for name, book, columns, length in (
        ("one l typed over its formula", _in_coordinates(G4=60.0), "4", lengths),
        ("every l typed, none by design", _in_coordinates(**{f"G{r}": 60.0 for r in range(3, 7)}), "3456", 60.0),
        (
            "l by a formula of their own",
            _in_coordinates(
                **{
                    f"G{3 + i}": Formula(f"0.25*E{3 + i}", b / 4)
                    for i, b in enumerate(SCANNER.pinhole_distance.tolist())
                }
            ),
            "3456",
            SCANNER.pinhole_distance / 4,
        ),
    ):
        for at in [f"{column}{row}" for column in "HIJK" for row in columns]:
            book["Coordinates"][at] = Formula(book["Coordinates"][at].text)
        CASES.add(name, book, scanner(l=length), WARNED, RIGHT if "own" in name else WARNED, place="Coordinates!G")
    chain = _in_coordinates(AA1=Formula("Main!AA1+5", 100.0), B4=Formula("AA1+55", 155.0))
    chain["Main"]["AA1"] = 150.0
    CASES.add("x1 two formulas away from what changed", chain, None, *DOUBTED)
    for value, truth, allowed in ((55.0, SCANNER, READ_OR_REFUSED), (65.0, None, DOUBTED)):
        named = with_cells(_in_coordinates(B4=Formula("100+offset", 155.0)), Main_AA1=value)
        named.names["offset"] = "Main!$AA$1"
        name = f"x1 is a formula of a name{'' if truth else ', stale, calculation asked for'}"
        CASES.add(name, _calculated(named, truth is None), truth, *allowed)
    short = typed(users())
    for at, value in short["Coordinates"].cells.items():
        if isinstance(value, float) and at[0] in "EHIJKU":
            short["Coordinates"][at] = round(value, 3)
    CASES.add("derived numbers typed as displayed", short, SCANNER, RIGHT)
    on_axis = scanner(np.array([[0.0, 0.0, 200.0], *CENTERS[1:].tolist()]))
    axis = with_cells(users(on_axis), Coordinates_V3=Formula("(ATAN2(B3,C3))", Error("#DIV/0!")))
    CASES.add("a module on the axis", axis, on_axis, RIGHT)
    failed = _in_coordinates(**{f"F{3 + i}": Error("#NAME?") for i in range(4)})
    CASES.add("errors in a column that is not used", failed, SCANNER, RIGHT)


def _without_values(book: Book) -> Book:
    for sheet in book.sheets:
        for at, formula in formulas_of(sheet).items():
            sheet[at] = Formula(formula.text)
    return book


def _programs() -> None:
    """The same workbook by three programs; XlsxWriter stores 0 for a formula and asks for calculation."""
    for name, make in {"users": users, "z1 by formula": _z_formulas, "one sheet": lambda: one_sheet(BIG)}.items():
        truth = BIG if name == "one sheet" else SCANNER
        allowed = (RIGHT,) if name == "one sheet" else READ_OR_REFUSED
        theirs = {"needs": "xlsxwriter"}
        CASES.add(f"{name}, by openpyxl", lambda path, make=make: by_openpyxl(make(), path), truth, RIGHT)
        CASES.add(
            f"{name}, by XlsxWriter without values",
            lambda path, make=make: by_xlsxwriter(_without_values(make()), path),
            truth,
            *allowed,
            **theirs,
        )
        CASES.add(
            f"{name}, by XlsxWriter in constant memory",
            lambda path, make=make: by_xlsxwriter(make(), path, constant_memory=True),
            truth,
            RIGHT,
            **theirs,
        )
        CASES.add(f"{name}, values only by openpyxl", lambda path, make=make: _values_only(make(), path), truth, RIGHT)
    for sheet, column in (("Coordinates", "D"), ("Main", "P")):
        CASES.add(
            f"{sheet}!{column} alone by formulas, by XlsxWriter without values",
            lambda path, sheet=sheet, column=column: by_xlsxwriter(_halves(sheet, column), path),
            SCANNER,
            *READ_OR_REFUSED,
            place=f"!{column}",
            **theirs,
        )


def _halves(sheet: str, column: str) -> Book:
    """The users' workbook, this column alone by formulas, without their values."""
    book = typed(users())
    for row in range(3, 7):
        book[sheet][f"AA{row}"] = book[sheet][f"{column}{row}"] / 2
        book[sheet][f"{column}{row}"] = Formula(f"AA{row}*2")
    return book


def _values_only(book: Book, path: Path) -> None:
    by_hand(book, path)
    openpyxl.load_workbook(path, data_only=True).save(path)


_cells()
_stored_values()
_programs()
