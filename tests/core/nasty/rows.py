"""Rows: which of them are modules, which of two sheets belong together, in whatever order the file has them."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from .case import DOUBTED, READ_OR_REFUSED, REFUSED, RIGHT, WARNED, WARNED_OF, Catalogue
from .scanners import (
    BIG,
    CENTERS,
    ONE_SHEET_COLUMNS,
    SCANNER,
    VARIED,
    column_map,
    one_sheet,
    one_sheet_map,
    scanner,
    typed,
    users,
    users_map,
    with_cells,
    with_gap,
)
from .sheets import Book, Formula, Raw, split

CASES = Catalogue("rows", place=("Geometry",), columns=one_sheet_map())
USERS = {"place": ("Main", "Coordinates")}
HEADS = ["No.", "x1", "y1", "z1", "d", "R", "Ld", "Td", "l"]


def _labelled(left: list[object], right: list[object], heads: tuple[str, str] = ("Definitions", "Definitions")) -> Book:
    """The users' workbook with row labels in Coordinates (left) and Main (right); without l, which would decide."""
    book = typed(users(VARIED))
    book["Coordinates"].cells = {at: v for at, v in book["Coordinates"].cells.items() if at[0] not in "GHIJK"}
    for sheet, labels, head in ((book["Coordinates"], left, heads[0]), (book["Main"], right, heads[1])):
        sheet["A2"] = head
        for i, label in enumerate(labels):
            sheet[f"A{3 + i}"] = label
    return book


def _swapped(book: Book, first: int = 3, second: int = 4) -> Book:
    """The book, two rows of Main exchanged but for their labels."""
    cells = book["Main"].cells
    for c in {re.sub(r"\d", "", at) for at in cells} - {"A"}:
        a, b = f"{c}{first}", f"{c}{second}"
        cells[a], cells[b] = cells.get(b), cells.get(a)
    return book


def _labels() -> None:
    own, in_sheets, order = [1, 2, 3, 4], {"number": None}, {"number": None, "rows": "in order"}
    in_order = users_map(length=False, position=in_sheets, dimensions=order)
    no_order = {**USERS, "unmappable": "no order of the rows fits", "numbered": False}
    for labels in (["M01", "M02", "M03", "M04"], [1.5, 2.5, 3.5, 4.5]):
        name = f"labels {labels[0]}"
        other = [labels[1], labels[0], *labels[2:]]
        alike = {**USERS, "columns": in_order, "numbered": False}
        CASES.add(f"{name} alike", _labelled(labels, labels), VARIED, *READ_OR_REFUSED, **alike)
        # The rows of Main belong to other modules than their order says.
        swapped = _swapped(_labelled(labels, other))
        CASES.add(f"{name} in another order", swapped, VARIED, *READ_OR_REFUSED, **no_order)
        CASES.add(f"{name}, one different", _labelled(labels, [*labels[:3], "X9"]), None, *DOUBTED, **USERS)
    for name, left, right in (
        ("numbers and numbers as text", own, ["1", "2", "3", "4"]),
        ("numbers with zeros in front as text", ["01", "02", "03", "04"], own),
        ("numbers as decimals, from 0", [0.0, 1.0, 2.0, 3.0], [0, 1, 2, 3]),
        ("numbers with gaps", [2, 5, 9, 40], [2, 5, 9, 40]),
        ("numbers falling", [4, 3, 2, 1], [4, 3, 2, 1]),
    ):
        truth = replace(VARIED, numbers=[int(n) for n in left])
        CASES.add(name, _labelled(left, right), truth, *READ_OR_REFUSED, **USERS, columns=users_map(length=False))
    reverse = _swapped(_swapped(_labelled(own, [4, 3, 2, 1]), 3, 6), 4, 5)
    CASES.add("Main in reverse order, by number", reverse, VARIED, RIGHT)
    none = [None] * 4
    for name, book, mapped in (
        ("Main without numbers", _labelled(own, none), users_map(length=False, dimensions=order)),
        ("Coordinates without numbers", _labelled(none, own), in_order),
        ("both without numbers", _labelled(none, none), in_order),
    ):
        CASES.add(name, book, VARIED, *READ_OR_REFUSED, **USERS, columns=mapped)
    unnumbered = _swapped(_labelled(none, [2, 1, 3, 4]))
    name = "Coordinates without numbers, Main in another order"
    CASES.add(name, unnumbered, VARIED, *READ_OR_REFUSED, **USERS, unmappable="no numbers of their own")
    serials = [1007, 1003, 1012, 1001]
    for name, book in {
        "other numbers in Main": _labelled(own, [5, 6, 7, 8]),
        "serial numbers in Main": _labelled(own, serials, ("No.", "serial")),
        "serial numbers in Main, its rows in another order": _swapped(_labelled(own, serials, ("No.", "S/N"))),
        "a number twice": _labelled([1, 2, 2, 4], own),
        "a number twice in Main": _labelled(own, [1, 2, 2, 4]),
        "a number missing": _labelled([1, 2, None, 4], own),
        "a number missing in Main": _labelled(own, [1, 2, None, 4]),
    }.items():
        CASES.add(name, book, None, REFUSED, **USERS)
    named = ["M1", "M2", "M3", "M4"]
    unlike = {**USERS, "columns": in_order, "numbered": False}
    CASES.add("labels in Coordinates, numbers in Main", _labelled(named, own), VARIED, *READ_OR_REFUSED, **unlike)
    disordered = _swapped(_labelled(named, [2, 1, 3, 4]))
    CASES.add("labels in Coordinates, numbers of another order in Main", disordered, VARIED, REFUSED, **no_order)
    CASES.add("numbers of each ring", _labelled([1, 2, 1, 2], [1, 2, 1, 2]), VARIED, REFUSED, **unlike)
    for name, stored, truth, allowed in (
        ("that are formulas", (2, 3, 4), VARIED, (RIGHT,)),
        ("that are formulas without values", none[:3], VARIED, (RIGHT,)),
        ("that are stale formulas", (3, 2, 4), None, DOUBTED),
    ):
        formulas = [1, *(Formula(f"A{3 + i}+1", value) for i, value in enumerate(stored))]
        CASES.add(f"numbers {name}", _labelled(formulas, own), truth, *allowed, **USERS)
    for name, sheet, column, head, numbers, truth, allowed in (
        ("two columns of numbers at odds", "Main", "B", "Module", (2, 1, 4, 3), None, DOUBTED),
        ("two far columns of numbers at odds", "Coordinates", "X", "module number", (4, 3, 2, 1), None, DOUBTED),
        ("a column of rings", "Coordinates", "X", "ring", (1, 1, 2, 2), VARIED, (RIGHT, WARNED)),
    ):
        book = _labelled(own, own)
        book[sheet].put(f"{column}2", [[head], *[[n] for n in numbers]])
        CASES.add(name, book, truth, *allowed, place=f"{sheet}!" if truth else USERS["place"])
    pandas = with_cells(one_sheet(BIG, number=""), A2=0, A3=1, A4=2, A5=3)
    CASES.add("pandas' index", pandas, BIG, *READ_OR_REFUSED, numbered=False)


def _single_values() -> None:
    one = users_map(dimensions={"last_row": 3, "number": None, "rows": "one for all"})
    for name in ("with", "without"):
        single = typed(users())
        kept = {at: v for at, v in single["Main"].cells.items() if split(at)[1] < 4}
        single["Main"].cells = kept if name == "with" else {at: v for at, v in kept.items() if at != "A3"}
        CASES.add(f"one row of dimensions {name} a number", single, SCANNER, *READ_OR_REFUSED, **USERS, columns=one)
    for kept in (3, 4):
        first = typed(users())
        for at in [f"{c}{row}" for c in "QST" for row in range(3, 7) if row != kept]:
            first["Main"][at] = None
        allowed = READ_OR_REFUSED if kept == 3 else (REFUSED,)
        unalike = "a table's columns are alike"
        CASES.add(f"R, Ld, Td in row {kept} alone", first, SCANNER, *allowed, **USERS, unmappable=unalike)
    for name, areas, d in (
        ("all modules", ["P3:P6"], [2.0] * 4),
        ("two modules each", ["P3:P4", "P5:P6"], [2.0, 2.0, 3.0, 3.0]),
    ):
        merged = typed(users(scanner(CENTERS, d=d)))
        merged["Main"].merged += areas
        for row in {3, 4, 5, 6} - {int(area[1]) for area in areas}:
            merged["Main"][f"P{row}"] = None
        gaps = "a map's columns have a number in each row"
        CASES.add(f"d merged over {name}", merged, scanner(CENTERS, d=d), *READ_OR_REFUSED, **USERS, unmappable=gaps)
    ditto = with_cells(typed(users()), Main_P4='"', Main_P5='"', Main_P6='"')
    CASES.add("ditto marks", ditto, SCANNER, REFUSED, place="Main!P4", unmappable="text")
    CASES.add("one d missing", with_cells(typed(users()), Main_P5=None), None, REFUSED, place="Main!P5")
    listed = typed(users())
    listed["Main"].cells = {}
    names = ("diameter of pinhole", "radius of spherical region of interest", "length of side of detector crystal")
    values = zip((*names, "thickness of detector crystal"), (2.3, 75, 50, 10), strict=True)
    listed["Main"].put("A1", [list(pair) for pair in values])
    name = "dimensions as a list of names and values"
    CASES.add(name, listed, SCANNER, REFUSED, place="scanner.xlsx", unmappable="a map is of columns")
    extra = with_cells(typed(users()), Main_P7=2.3, Main_Q7=75.0, Main_S7=50.0, Main_T7=10.0)
    CASES.add("one more row of dimensions without a number", extra, None, *DOUBTED, **USERS)


def _below(*rows: list[object], gap: int = 1, at: str = "A") -> Book:
    book = one_sheet(BIG)
    book.sheets[0].put(f"{at}{6 + gap}", [*rows])
    return book


def _summed(formula: str, label: str | None = None) -> list[object]:
    return [label, *[Formula(formula.format(c), 166.0) for c in "BCDEFGHI"]]


def _below_and_beside() -> None:
    old = [[n, 500.0 + n, 100.0 - 20 * n, 3.0, 4.0, 150.0, 120.0, 20.0, 200.0] for n in range(1, 4)]
    more = [[n + 4, *row[1:]] for n, row in enumerate(old, start=1)]
    for name, book in {
        "'OLD DESIGN, do not use' and more rows below": _below(["OLD DESIGN, do not use"], *more, gap=0),
        "heads again and more rows below": _below(HEADS, *more, gap=2),
        "a text over x1 and more rows below": _below([None, "prototype"], *more, gap=0),
        "a title, headings and rows below": _below(["Version 2"], HEADS, *old),
        "rows of the same numbers below": _below(*old),
        "rows without numbers below": _below(*[[None, *row[1:]] for row in old]),
        "a row of the isocentre below": _below(["isocentre", 3.0, -2.0, 10.0]),
        "typed means without a label below": _below([None, 166.4, 119.1, -15.1, 4.0, 150.0, 120.0, 20.0, 190.0]),
    }.items():
        CASES.add(name, book, BIG, *DOUBTED)
    centers = np.vstack([BIG.centers, [row[1:4] for row in more]])
    going_on = scanner(centers, 4.0, 150.0, 120.0, 20.0, np.r_[BIG.collimator_length, [200.0] * 3])
    between = "the blank rows are in between"
    CASES.add("numbers go on after a blank row", _below(*more), going_on, RIGHT, WARNED, REFUSED, unmappable=between)
    for name, row in {
        "mean": _summed("AVERAGE({0}2:{0}5)", "mean"),
        "std": _summed("STDEV({0}2:{0}5)", "σ"),
        "subtotal": _summed("SUBTOTAL(101,{0}2:{0}5)"),
        "a formula of each without a label": _summed("({0}2+{0}3+{0}4+{0}5)/4"),
        "tolerance": ["tolerance", 0.1, 0.1, 0.1, 0.02, 0.5, 0.1, 0.1, 0.1],
        "units": ["unit", *["mm"] * 8],
        "count": [4],
        "count with a number only": [None, 4.0],
    }.items():
        unlabelled = (WARNED_OF,) if "without" in name or "only" in name else ()
        for gap in (0, 2):
            CASES.add(f"{name} below, gap {gap}", _below(row, gap=gap), BIG, RIGHT, WARNED, REFUSED, *unlabelled)
    CASES.add("a note below", _below(["Note: measured in 2021"]), BIG, *READ_OR_REFUSED)
    CASES.add("a note in the column of x1 below", _below([None, "as of 2021-03-04"]), BIG, *READ_OR_REFUSED)
    for label, beyond in (("5", []), ("Sum", [[98, 777.0, 777.0, 777.0]])):
        shared = one_sheet(BIG, length=False)
        sheet, dimensions = shared.sheets[0], shared.add("Main")
        for at in [f"{column}{row}" for column in "EFGH" for row in range(1, 6)]:
            value = sheet.cells.pop(at)
            if split(at)[1] < 3:
                dimensions[at] = value
        sheet.put("A6", [[label, *[Formula(f"SUM({c}2:{c}5)", 660.0) for c in "BCD"]], *beyond])
        position = {"sheet": "Geometry", "first_row": 2, "last_row": 5, "number": "A"}
        once = {"sheet": "Main", "first_row": 2, "last_row": 2, "rows": "one for all"}
        mapped = column_map(
            {**position, "columns": {q: (ONE_SHEET_COLUMNS[q], "mm") for q in ("x1", "y1", "z1")}},
            {**once, "columns": {q: (ONE_SHEET_COLUMNS[q], "mm") for q in ("d", "R", "Ld", "Td")}},
        )
        what = f"{label!r} before sums{' and a row below them' if beyond else ''}, one row of dimensions"
        CASES.add(what, shared, BIG, *(DOUBTED if beyond else (RIGHT, WARNED, REFUSED)), columns=mapped)
    CASES.add("a second table beside", _below(HEADS, *old, gap=-5, at="L"), BIG, REFUSED)
    beside_old = one_sheet(BIG, top=2)
    beside_old.sheets[0].put("L1", [["OLD"], HEADS, *old])
    CASES.add("a second table beside, called OLD", beside_old, BIG, REFUSED, columns=one_sheet_map("mm", 3, 6))
    for name, rows, top, allowed in (
        ("a second table", [HEADS, *old], 7, (REFUSED,)),
        ("an example row", [["example:", 100.0, 100.0, 100.0, 4.0, 150.0, 120.0, 20.0]], 4, READ_OR_REFUSED),
        ("a row of offsets", [["offset", 3.0, -2.0, 10.0]], 3, (RIGHT, *DOUBTED)),
    ):
        above = one_sheet(BIG, top=top)
        above.sheets[0].put("A1", rows)
        CASES.add(f"{name} above the headings", above, BIG, *allowed, columns=one_sheet_map("mm", top + 1, top + 4))
    CASES.add("a row of zeros, module 5", _below([5, *[0] * 8], gap=0), BIG, REFUSED)
    CASES.add("numbered rows without values", _below(*[[n] for n in range(5, 9)], gap=0), BIG, REFUSED, WARNED)
    ahead = users()
    for r in range(7, 12):
        ahead["Coordinates"][f"E{r}"] = Formula(f"SQRT(SUMSQ(B{r},C{r},D{r}))", 0)
        ahead["Coordinates"][f"V{r}"] = Formula(f"(ATAN2(B{r},C{r}))")
    CASES.add("formulas filled down beyond the modules", ahead, SCANNER, RIGHT)
    for name, text, truth, allowed in (
        ("a blank row", None, BIG, READ_OR_REFUSED),
        ("a title of the second ring", "ring 2", BIG, READ_OR_REFUSED),
        ("'removed:'", "removed:", None, DOUBTED),
    ):
        made = with_cells(with_gap(one_sheet(BIG), below=3), A4=text)
        CASES.add(f"{name} in the middle", made, truth, *allowed, unmappable="it is in between")
    under = with_gap(one_sheet(BIG), rows=3)
    CASES.add("blank rows below the headings", under, BIG, *READ_OR_REFUSED, columns=one_sheet_map("mm", 5, 8))
    CASES.add("a number a million rows down", with_cells(one_sheet(BIG), B1000000=5.0), BIG, REFUSED, WARNED)


def _hidden_and_tables() -> None:
    filtered = one_sheet(BIG)
    filtered.sheets[0].hidden_rows = [3, 5]
    filters = '<filterColumn colId="0"><filters><filter val="1"/><filter val="3"/></filters></filterColumn>'
    filtered.sheets[0].after_data = f'<autoFilter ref="A1:I5">{filters}</autoFilter>'
    CASES.add("a filter hides two modules", filtered, BIG, RIGHT, WARNED, REFUSED)
    column = one_sheet(BIG)
    column.sheets[0].hidden_columns = ["C", "E"]
    CASES.add("hidden columns", column, BIG, RIGHT, WARNED, REFUSED)
    shadow = one_sheet(BIG)
    shadow.sheets[0].hidden_columns = ["B"]
    shadow.sheets[0].put("J1", [["x1"], *[[float(v)] for v in BIG.centers[:, 0] * 1.01]])
    truth = scanner(BIG.centers * [1.01, 1, 1], 4.0, 150.0, 120.0, 20.0, BIG.collimator_length)
    mapped = one_sheet_map(columns={"x1": "J"})
    CASES.add("the first of two columns of x1 is hidden", shadow, truth, REFUSED, columns=mapped)
    for name, area, totals, allowed in (
        ("", "A1:I5", False, (RIGHT,)),
        (" with a totals row", "A1:I6", True, READ_OR_REFUSED),
        (" that ends above the last module", "A1:I4", False, (RIGHT, WARNED, REFUSED)),
    ):
        table = one_sheet(BIG)
        table.sheets[0].table, table.sheets[0].table_totals = area, totals
        if totals:
            formulas = [Formula(f"SUBTOTAL(101,Table1[{h}])", 166.0) for h in HEADS[1:]]
            table.sheets[0].put("A6", [["Total", *formulas]])
        CASES.add(f"an Excel table{name}", table, BIG, *allowed)
    for name, area in (("x1 of modules", "B3:B5"), ("z1 of a module", "C3:D3")):
        merged = one_sheet(BIG)
        merged.sheets[0].merged.append(area)
        CASES.add(f"{name} hidden under a merged cell", merged, None, *DOUBTED)


def _of_two_sheets() -> None:
    mapped = {**USERS, "columns": users_map()}
    grouped = typed(users())
    grouped["Main"].put("A8", [["old"], ["", None]])
    grouped["Main"].put("P10", [[4.0, 60.0, None, 40.0, 5.0]] * 4)
    CASES.add("an old table below in Main, without numbers", grouped, SCANNER, REFUSED, WARNED, **mapped)
    extra = with_cells(typed(users()), Main_A7=5)
    extra["Main"].put("P7", [[4.0, 60.0, None, 40.0, 5.0]])
    CASES.add("module 5 in Main alone", extra, SCANNER, WARNED, REFUSED, **mapped)
    for name, gone in (("module 4 in Coordinates alone", ""), ("three rows of dimensions without numbers", "A")):
        fewer = typed(users())
        cells = fewer["Main"].cells.items()
        fewer["Main"].cells = {at: v for at, v in cells if not at.endswith("6") and at[0] != gone}
        CASES.add(name, fewer, None, REFUSED, **USERS)
    shifted = typed(users(VARIED))
    main = shifted["Main"]
    main.cells = {
        at if split(at)[1] < 3 else f"{at[0]}{split(at)[1] + 2}": v for at, v in main.cells.items() if at[0] != "A"
    }
    lower = users_map(dimensions={"first_row": 5, "last_row": 8, "number": None, "rows": "in order"})
    name = "Main two rows further down, without numbers"
    CASES.add(name, shifted, VARIED, *READ_OR_REFUSED, **USERS, columns=lower)


def _in_the_file() -> None:
    """Rows and cells as no spreadsheet program writes them, but others do."""
    odd = {"place": ("Geometry", "scanner.xlsx"), "unmappable": "the file is damaged"}

    def each(pattern: str, new) -> object:
        return lambda rows: [re.sub(pattern, new, r) for r in rows]

    def backwards(match: re.Match[str]) -> str:
        return "".join(re.findall("<c .*?</c>", match[1])[::-1])

    for name, order in {
        "rows and headings stored in another order": lambda rows: [rows[i] for i in (4, 3, 1, 0, 2)],
        "a row stored in two parts": each(r'(<row r="3"[^>]*>)(.*)(<c r="D3".*)(</row>)', r"\1\2\4\1\3\4"),
        "rows and cells without names": each(r'<(row|c) r="\w+"', r"<\1"),
        "cells of other rows in a row": lambda rows: [
            rows[0],
            re.sub(r'</row><row r="[34]">', "", "".join(rows[1:])),
            "",
        ],
        "rows numbered from 0": each(r'<row r="(\d+)"', lambda m: f'<row r="{int(m[1]) - 1}"'),
        "cells in small letters": each(r'<c r="(\w+)"', lambda m: f'<c r="{m[1].lower()}"'),
        "cells with $": each(r'<c r="([A-Z]+)(\d+)"', r'<c r="$\1$\2"'),
        "cells stored backwards": each(r"(?<=>)(<c .*</c>)(?=</row>)", backwards),
        "wrong spans": each("<row ", '<row spans="1:2" '),
        "a row stored twice": lambda rows: [*rows, rows[2].replace("<v>315.0</v>", "<v>215.0</v>")],
    }.items():
        made = one_sheet(BIG)
        made.sheets[0].row_order = order
        twice = name.endswith("twice")
        CASES.add(name, made, None if twice else BIG, *((REFUSED,) if twice else READ_OR_REFUSED), **odd)
    for name, xml, truth, allowed in (
        ("a cell stored twice", '<c r="B3"><v>315</v></c><c r="B3"><v>215</v></c>', None, (REFUSED,)),
        ("a cell stored twice alike", '<c r="B3"><v>315</v></c><c r="B3"><v>315</v></c>', BIG, READ_OR_REFUSED),
        ("a cell with two values", '<c r="B3"><v>315</v><v>215</v></c>', None, (REFUSED,)),
        ("a cell of another row in its place", '<c r="B3000"><v>315</v></c>', None, (REFUSED,)),
    ):
        CASES.add(name, with_cells(one_sheet(BIG), B3=Raw(xml)), truth, *allowed, **odd)
    both = "".join(f'<c r="B1" t="inlineStr"><is><t>{text}</t></is></c>' for text in ("x1", "x2"))
    CASES.add("a heading stored twice", with_cells(one_sheet(BIG), B1=Raw(both)), None, REFUSED, **odd)
    second = '<sheetData><row r="3"><c r="B3"><v>215</v></c></row></sheetData>'
    for name, old, new, truth, allowed in (
        ("a stated size that is too small", "<sheetData>", '<dimension ref="A1:B2"/><sheetData>', BIG, (RIGHT,)),
        ("a stated size that is nonsense", "<sheetData>", '<dimension ref="foo"/><sheetData>', BIG, READ_OR_REFUSED),
        ("two blocks of data in a sheet", "</sheetData>", f"</sheetData>{second}", None, (REFUSED,)),
    ):
        made = one_sheet(BIG)
        made.replace("xl/worksheets/sheet1.xml", old, new)
        CASES.add(name, made, truth, *allowed, **odd)


_labels()
_single_values()
_below_and_beside()
_hidden_and_tables()
_of_two_sheets()
_in_the_file()
