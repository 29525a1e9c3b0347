"""Rows: which of them are modules, which of two sheets belong together, in whatever order the file has them."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from .case import REFUSED, RIGHT, WARNED, WARNED_OF, Catalogue
from .scanners import (
    BIG,
    CENTERS,
    ONE_SHEET_COLUMNS,
    SCANNER,
    column_map,
    one_sheet,
    one_sheet_map,
    scanner,
    typed,
    users,
    users_map,
)
from .sheets import Book, Formula, Raw

CASES = Catalogue("rows")
GEOMETRY = ("Geometry",)
USERS = ("Main", "Coordinates")
VARIED = scanner(CENTERS, d=[2.0, 2.5, 3.0, 3.5], Ld=[50.0, 52.0, 54.0, 56.0], Td=[8.0, 9.0, 10.0, 11.0])


def _labelled(left: list[object], right: list[object], heads: tuple[str, str] = ("Definitions", "Definitions")) -> Book:
    """The users' workbook with row labels in Coordinates (left) and Main (right); without l, which would decide."""
    book = typed(users(VARIED))
    book["Coordinates"].cells = {at: v for at, v in book["Coordinates"].cells.items() if at[0] not in "GHIJK"}
    for sheet, labels, head in ((book["Coordinates"], left, heads[0]), (book["Main"], right, heads[1])):
        sheet["A2"] = head
        for i, label in enumerate(labels):
            sheet[f"A{3 + i}"] = label
    return book


def _swap(book: Book, sheet: str, first: int, second: int) -> Book:
    cells = book[sheet].cells
    columns = {re.sub(r"\d", "", at) for at in cells} - {"A"}
    for c in columns:
        a, b = f"{c}{first}", f"{c}{second}"
        cells[a], cells[b] = cells.get(b), cells.get(a)
    return book


def _labels() -> None:
    in_order = users_map(length=False, position={"number": None}, dimensions={"number": None, "rows": "in order"})
    for labels in (
        ["M01", "M02", "M03", "M04"],
        ["left", "right", "top", "bottom"],
        ["#1", "#2", "#3", "#4"],
        [1.5, 2.5, 3.5, 4.5],
        ["I", "II", "III", "IV"],
    ):
        name = str(labels[0])
        CASES.add(
            f"labels {name} alike",
            _labelled(labels, labels),
            VARIED,
            RIGHT,
            REFUSED,
            place=USERS,
            columns=in_order,
            numbered=False,
        )
        other = [labels[1], labels[0], *labels[2:]]
        # The rows of Main belong to other modules than their order says.
        swapped = _swap(_labelled(labels, other), "Main", 3, 4)
        CASES.add(
            f"labels {name} in another order",
            swapped,
            VARIED,
            RIGHT,
            REFUSED,
            place=USERS,
            unmappable="no order of the rows fits",
            numbered=False,
        )
        more = _labelled(labels, [*labels[:3], "X9"])
        CASES.add(f"labels {name}, one different", more, None, REFUSED, WARNED_OF, place=USERS)
    for name, left, right, truth in (
        ("numbers and numbers as text", [1, 2, 3, 4], ["1", "2", "3", "4"], VARIED),
        ("numbers with zeros in front as text", ["01", "02", "03", "04"], [1, 2, 3, 4], VARIED),
        ("numbers as decimals", [1.0, 2.0, 3.0, 4.0], [1, 2, 3, 4], VARIED),
        ("numbers from 0", [0, 1, 2, 3], [0, 1, 2, 3], replace(VARIED, numbers=[0, 1, 2, 3])),
        ("numbers with gaps", [2, 5, 9, 40], [2, 5, 9, 40], replace(VARIED, numbers=[2, 5, 9, 40])),
        ("numbers falling", [4, 3, 2, 1], [4, 3, 2, 1], replace(VARIED, numbers=[4, 3, 2, 1])),
    ):
        CASES.add(name, _labelled(left, right), truth, RIGHT, REFUSED, place=USERS, columns=users_map(length=False))
    CASES.add(
        "Main in another order, by number", _swap(_labelled([1, 2, 3, 4], [2, 1, 3, 4]), "Main", 3, 4), VARIED, RIGHT
    )
    CASES.add(
        "Main in reverse order, by number",
        _swap(_swap(_labelled([1, 2, 3, 4], [4, 3, 2, 1]), "Main", 3, 6), "Main", 4, 5),
        VARIED,
        RIGHT,
    )
    CASES.add(
        "Main without numbers",
        _labelled([1, 2, 3, 4], [None] * 4),
        VARIED,
        RIGHT,
        REFUSED,
        place=USERS,
        columns=users_map(length=False, dimensions={"number": None, "rows": "in order"}),
    )
    CASES.add(
        "Coordinates without numbers",
        _labelled([None] * 4, [1, 2, 3, 4]),
        VARIED,
        RIGHT,
        REFUSED,
        place=USERS,
        columns=users_map(length=False, position={"number": None}, dimensions={"number": None, "rows": "in order"}),
    )
    CASES.add(
        "Coordinates without numbers, Main in another order",
        _swap(_labelled([None] * 4, [2, 1, 3, 4]), "Main", 3, 4),
        VARIED,
        REFUSED,
        RIGHT,
        place=USERS,
        unmappable="the modules have no numbers of their own",
    )
    CASES.add(
        "both without numbers", _labelled([None] * 4, [None] * 4), VARIED, RIGHT, REFUSED, place=USERS, columns=in_order
    )
    CASES.add("other numbers in Main", _labelled([1, 2, 3, 4], [5, 6, 7, 8]), None, REFUSED, place=USERS)
    CASES.add(
        "serial numbers in Main",
        _labelled([1, 2, 3, 4], [1007, 1003, 1012, 1001], ("No.", "serial")),
        None,
        REFUSED,
        place=USERS,
    )
    CASES.add(
        "serial numbers in Main, its rows in another order",
        _swap(_labelled([1, 2, 3, 4], [1007, 1003, 1012, 1001], ("No.", "S/N")), "Main", 3, 4),
        None,
        REFUSED,
        place=USERS,
    )
    CASES.add(
        "labels in Coordinates, numbers in Main",
        _labelled(["M1", "M2", "M3", "M4"], [1, 2, 3, 4]),
        VARIED,
        RIGHT,
        REFUSED,
        place=USERS,
        columns=in_order,
        numbered=False,
    )
    CASES.add(
        "labels in Coordinates, numbers of another order in Main",
        _swap(_labelled(["M1", "M2", "M3", "M4"], [2, 1, 3, 4]), "Main", 3, 4),
        VARIED,
        REFUSED,
        place=USERS,
        unmappable="no order of the rows fits",
    )
    CASES.add("a number twice", _labelled([1, 2, 2, 4], [1, 2, 3, 4]), None, REFUSED, place=USERS)
    CASES.add("a number twice in Main", _labelled([1, 2, 3, 4], [1, 2, 2, 4]), None, REFUSED, place=USERS)
    CASES.add("a number missing", _labelled([1, 2, None, 4], [1, 2, 3, 4]), None, REFUSED, place=USERS)
    CASES.add("a number missing in Main", _labelled([1, 2, 3, 4], [1, 2, None, 4]), None, REFUSED, place=USERS)
    CASES.add(
        "numbers of each ring",
        _labelled([1, 2, 1, 2], [1, 2, 1, 2]),
        VARIED,
        REFUSED,
        place=USERS,
        columns=in_order,
        numbered=False,
    )
    CASES.add(
        "numbers that are formulas",
        _labelled([1, Formula("A3+1", 2), Formula("A4+1", 3), Formula("A5+1", 4)], [1, 2, 3, 4]),
        VARIED,
        RIGHT,
    )
    CASES.add(
        "numbers that are formulas without values",
        _labelled([1, Formula("A3+1"), Formula("A4+1"), Formula("A5+1")], [1, 2, 3, 4]),
        VARIED,
        RIGHT,
    )
    stale = _labelled([1, Formula("A3+1", 3), Formula("A4+1", 2), Formula("A5+1", 4)], [1, 2, 3, 4])
    CASES.add("numbers that are stale formulas", stale, None, REFUSED, WARNED_OF, place=USERS)
    two = _labelled([1, 2, 3, 4], [1, 2, 3, 4])
    two["Main"]["B2"] = "Module"
    for i, n in enumerate((2, 1, 4, 3)):
        two["Main"][f"B{3 + i}"] = n
    CASES.add("two columns of numbers at odds", two, None, REFUSED, WARNED_OF, place=USERS)
    three = _labelled([1, 2, 3, 4], [1, 2, 3, 4])
    three["Coordinates"]["X2"] = "module number"
    for i, n in enumerate((4, 3, 2, 1)):
        three["Coordinates"][f"X{3 + i}"] = n
    CASES.add("a second column of numbers at the right, at odds", three, None, REFUSED, WARNED_OF, place=USERS)
    ring = _labelled([1, 2, 3, 4], [1, 2, 3, 4])
    ring["Coordinates"]["X2"] = "ring"
    for i, n in enumerate((1, 1, 2, 2)):
        ring["Coordinates"][f"X{3 + i}"] = n
    CASES.add("a column of rings", ring, VARIED, RIGHT, WARNED, place="Coordinates!X2")
    pandas = one_sheet(BIG, number="")
    for i in range(4):
        pandas.sheets[0][f"A{2 + i}"] = i
    CASES.add("pandas' index", pandas, BIG, RIGHT, REFUSED, place=GEOMETRY, columns=one_sheet_map(), numbered=False)


def _single_values() -> None:
    one = users_map(dimensions={"last_row": 3, "number": None, "rows": "one for all"})
    for name in ("one row of dimensions", "one row of dimensions without a number"):

        def single(name: str = name) -> Book:
            book = typed(users())
            main = book["Main"]
            main.cells = {
                at: v
                for at, v in main.cells.items()
                if int(re.sub(r"\D", "", at)) < 4 and (v != 1 or "without" not in name)
            }
            return book

        CASES.add(name, single, SCANNER, RIGHT, REFUSED, place=USERS, columns=one)
    for kept in (3, 4, 6):

        def first(kept: int = kept) -> Book:
            book = typed(users())
            for row in range(3, 7):
                if row != kept:
                    for c in "QST":
                        book["Main"][f"{c}{row}"] = None
            return book

        truth = SCANNER
        CASES.add(
            f"R, Ld, Td in row {kept} alone",
            first,
            truth,
            *([RIGHT] if kept == 3 else []),
            REFUSED,
            place=USERS,
            unmappable="a table's columns are alike",
        )
    for name, areas in (("all modules", ["P3:P6"]), ("two modules each", ["P3:P4", "P5:P6"])):

        def merged(areas: list[str] = areas) -> Book:
            book = typed(users(scanner(CENTERS, d=2.0 if len(areas) == 1 else [2.0, 2.0, 3.0, 3.0])))
            book["Main"].merged += areas
            for area in areas:
                a, b = (int(x[1:]) for x in area.split(":"))
                for row in range(a + 1, b + 1):
                    book["Main"][f"P{row}"] = None
            return book

        truth = scanner(CENTERS, d=2.0) if len(areas) == 1 else scanner(CENTERS, d=[2.0, 2.0, 3.0, 3.0])
        CASES.add(
            f"d merged over {name}",
            merged,
            truth,
            RIGHT,
            REFUSED,
            place=USERS,
            unmappable="a map's columns have a number in each row",
        )
    ditto = typed(users())
    for row in (4, 5, 6):
        ditto["Main"][f"P{row}"] = '"'
    CASES.add("ditto marks", ditto, SCANNER, REFUSED, place=("Main!P4",), unmappable="text")
    blank = typed(users())
    blank["Main"]["P5"] = None
    CASES.add("one d missing", blank, None, REFUSED, place=("Main!P5",))
    label_value = typed(users())
    main = label_value["Main"]
    main.cells = {}
    main.put(
        "A1",
        [
            ["diameter of pinhole", 2.3],
            ["radius of spherical region of interest", 75],
            ["length of side of detector crystal", 50],
            ["thickness of detector crystal", 10],
        ],
    )
    CASES.add(
        "dimensions as a list of names and values",
        label_value,
        SCANNER,
        REFUSED,
        place=("scanner.xlsx",),
        unmappable="a map is of columns",
    )
    values = typed(users())
    for c in "PQST":
        values["Main"][f"{c}7"] = values["Main"][f"{c}3"]
    CASES.add("one more row of dimensions without a number", values, None, REFUSED, WARNED_OF, place=USERS)


def _below_and_beside() -> None:
    def below(*rows: list[object], gap: int = 1, sheet: str = "Geometry") -> Callable[[], Book]:
        def book() -> Book:
            made = one_sheet(BIG, sheet=sheet)
            made.sheets[0].put(f"A{6 + gap}", [*rows])
            return made

        return book

    cut = {"place": GEOMETRY, "columns": one_sheet_map()}
    old = [[n, 500.0 + n, 100.0 - 20 * n, 3.0, 4.0, 150.0, 120.0, 20.0, 200.0] for n in range(1, 4)]
    more = [[n + 4, *row[1:]] for n, row in enumerate(old, start=1)]
    heads = ["No.", "x1", "y1", "z1", "d", "R", "Ld", "Td", "l"]
    for gap in (0, 2):
        for name, title in (
            ("OLD DESIGN, do not use", ["OLD DESIGN, do not use"]),
            ("heads again", heads),
            ("spare modules", ["spare modules"]),
            ("a text over x1", [None, "prototype"]),
        ):
            CASES.add(
                f"{name!r} and more rows below, gap {gap}", below(title, *more, gap=gap), BIG, REFUSED, WARNED_OF, **cut
            )
        CASES.add(
            f"a title, headings and rows below, gap {gap}",
            below(["Version 2"], heads, *old, gap=gap),
            BIG,
            REFUSED,
            WARNED_OF,
            **cut,
        )
    CASES.add("rows of the same numbers below", below(*old), BIG, REFUSED, WARNED_OF, **cut)
    CASES.add("rows without numbers below", below(*[[None, *row[1:]] for row in old]), BIG, REFUSED, WARNED_OF, **cut)
    for gap in (1, 3):
        centers = np.vstack([BIG.centers, [row[1:4] for row in more]])
        going_on = scanner(centers, 4.0, 150.0, 120.0, 20.0, np.r_[BIG.collimator_length, [200.0] * 3])
        CASES.add(
            f"numbers go on after {gap} blank rows",
            below(*more, gap=gap),
            going_on,
            RIGHT,
            WARNED,
            REFUSED,
            place=GEOMETRY,
            unmappable="the blank rows are in between",
        )
    for name, row in {
        "mean": ["mean", *[Formula(f"AVERAGE({c}2:{c}5)", 166.0) for c in "BCDEFGHI"]],
        "sum": ["Sum", *[Formula(f"SUM({c}2:{c}5)", 660.0) for c in "BCDEFGHI"]],
        "mean, typed": ["mean", 166.4, 119.1, -15.1, 4.0, 150.0, 120.0, 20.0, 190.0],
        "std": ["σ", *[Formula(f"STDEV({c}2:{c}5)", 300.0) for c in "BCDEFGHI"]],
        "subtotal": [None, *[Formula(f"SUBTOTAL(101,{c}2:{c}5)", 166.0) for c in "BCDEFGHI"]],
        "a formula of each without a label": [None, *[Formula(f"({c}2+{c}3+{c}4+{c}5)/4", 166.0) for c in "BCDEFGHI"]],
        "typed means without a label": [None, 166.4, 119.1, -15.1, 4.0, 150.0, 120.0, 20.0, 190.0],
        "tolerance": ["tolerance", 0.1, 0.1, 0.1, 0.02, 0.5, 0.1, 0.1, 0.1],
        "units": ["unit", *["mm"] * 8],
        "count": [4],
        "count with a number only": [None, 4.0],
    }.items():
        for gap in (0, 2):
            allowed = (RIGHT, WARNED, REFUSED)
            truth = BIG
            if "without a label" in name or name == "count with a number only":
                allowed = (REFUSED, WARNED_OF) if "typed" in name else (RIGHT, WARNED, REFUSED, WARNED_OF)
            CASES.add(f"{name} below, gap {gap}", below(row, gap=gap), truth, *allowed, **cut)
    for name, row in {
        "a note": ["Note: measured in 2021"],
        "a date": [None, "as of 2021-03-04"],
        "a note in the column of x1": [None, "centres of the holes, not of the plates"],
    }.items():
        for gap in (1, 3):
            CASES.add(f"{name} below, gap {gap}", below(row, gap=gap), BIG, RIGHT, REFUSED, **cut)
    for label, more in (("5", []), ("Sum", [[98, 777.0, 777.0, 777.0]])):
        shared = one_sheet(BIG, length=False)
        sheet = shared.sheets[0]
        dimensions = shared.add("Main")
        for column in "EFGH":
            for row in range(1, 6):
                value = sheet.cells.pop(f"{column}{row}")
                if row < 3:
                    dimensions[f"{column}{row}"] = value
        sheet.put("A6", [[label, *[Formula(f"SUM({c}2:{c}5)", 660.0) for c in "BCD"]], *more])
        position = {"sheet": "Geometry", "first_row": 2, "last_row": 5, "number": "A"}
        once = {"sheet": "Main", "first_row": 2, "last_row": 2, "rows": "one for all"}
        mapped = column_map(
            {**position, "columns": {q: (ONE_SHEET_COLUMNS[q], "mm") for q in ("x1", "y1", "z1")}},
            {**once, "columns": {q: (ONE_SHEET_COLUMNS[q], "mm") for q in ("d", "R", "Ld", "Td")}},
        )
        what = f"{label!r} before sums{' and a row below them' if more else ''}, one row of dimensions"
        allowed = (REFUSED, WARNED_OF) if more else (RIGHT, WARNED, REFUSED)
        CASES.add(what, shared, BIG, *allowed, place=GEOMETRY, columns=mapped)
    beside = one_sheet(BIG)
    beside.sheets[0].put("L1", [heads, *old])
    CASES.add("a second table beside", beside, BIG, REFUSED, **cut)
    beside_old = one_sheet(BIG, top=2)
    beside_old.sheets[0].put("L1", [["OLD"], heads, *old])
    CASES.add(
        "a second table beside, called OLD", beside_old, BIG, REFUSED, place=GEOMETRY, columns=one_sheet_map("mm", 3, 6)
    )
    above = one_sheet(BIG, top=7)
    above.sheets[0].put("A1", [heads, *old])
    CASES.add("a second table above", above, BIG, REFUSED, place=GEOMETRY, columns=one_sheet_map("mm", 8, 11))
    example = one_sheet(BIG, top=4)
    example.sheets[0].put("A1", [["example:", 100.0, 100.0, 100.0, 4.0, 150.0, 120.0, 20.0]])
    CASES.add(
        "an example row above the headings",
        example,
        BIG,
        RIGHT,
        REFUSED,
        place=GEOMETRY,
        columns=one_sheet_map("mm", 5, 8),
    )
    origin = one_sheet(BIG)
    origin.sheets[0].put("A7", [["isocentre", 3.0, -2.0, 10.0]])
    CASES.add("a row of the isocentre below", origin, BIG, REFUSED, WARNED_OF, **cut)
    offset = one_sheet(BIG, top=3)
    offset.sheets[0].put("A1", [["offset", 3.0, -2.0, 10.0]])
    CASES.add(
        "a row of offsets above the headings",
        offset,
        BIG,
        REFUSED,
        WARNED_OF,
        RIGHT,
        place=GEOMETRY,
        columns=one_sheet_map("mm", 4, 7),
    )
    zero = one_sheet(BIG)
    zero.sheets[0].put("A6", [[5, 0, 0, 0, 0, 0, 0, 0, 0]])
    CASES.add("a row of zeros, module 5", zero, BIG, REFUSED, **cut)
    prepared = one_sheet(BIG)
    for n in range(5, 9):
        prepared.sheets[0][f"A{n + 1}"] = n
    CASES.add("numbered rows without values", prepared, BIG, REFUSED, WARNED, **cut)
    ahead = users()
    for r in range(7, 12):
        ahead["Coordinates"][f"E{r}"] = Formula(f"SQRT(SUMSQ(B{r},C{r},D{r}))", 0)
        ahead["Coordinates"][f"V{r}"] = Formula(f"(ATAN2(B{r},C{r}))")
    CASES.add("formulas filled down beyond the modules", ahead, SCANNER, RIGHT)
    blank_between = one_sheet(BIG)
    sheet = blank_between.sheets[0]
    sheet.cells = {at if int(at[1:]) < 4 else f"{at[0]}{int(at[1:]) + 1}": v for at, v in sheet.cells.items()}
    CASES.add(
        "a blank row in the middle",
        blank_between,
        BIG,
        RIGHT,
        REFUSED,
        place=GEOMETRY,
        unmappable="the blank row is in between",
    )
    titled = one_sheet(BIG)
    sheet = titled.sheets[0]
    sheet.cells = {at if int(at[1:]) < 4 else f"{at[0]}{int(at[1:]) + 1}": v for at, v in sheet.cells.items()}
    sheet["A4"] = "ring 2"
    CASES.add(
        "a title of the second ring in the middle",
        titled,
        BIG,
        RIGHT,
        REFUSED,
        place=GEOMETRY,
        unmappable="the title is in between",
    )
    for title in ("removed:", "spare"):
        made = one_sheet(BIG)
        sheet = made.sheets[0]
        sheet.cells = {at if int(at[1:]) < 4 else f"{at[0]}{int(at[1:]) + 1}": v for at, v in sheet.cells.items()}
        sheet["A4"] = title
        CASES.add(f"{title!r} in the middle", made, None, REFUSED, WARNED_OF, place=GEOMETRY)
    under = one_sheet(BIG)
    sheet = under.sheets[0]
    sheet.cells = {at if at[1:] == "1" else f"{at[0]}{int(at[1:]) + 3}": v for at, v in sheet.cells.items()}
    CASES.add(
        "blank rows below the headings", under, BIG, RIGHT, REFUSED, place=GEOMETRY, columns=one_sheet_map("mm", 5, 8)
    )
    tail = one_sheet(BIG)
    tail.sheets[0].cells["B1000000"] = 5.0
    CASES.add("a number a million rows down", tail, BIG, REFUSED, WARNED, **cut)
    filtered = one_sheet(BIG)
    filtered.sheets[0].hidden_rows = [3, 5]
    filters = '<filterColumn colId="0"><filters><filter val="1"/><filter val="3"/></filters></filterColumn>'
    filtered.sheets[0].after_data = f'<autoFilter ref="A1:I5">{filters}</autoFilter>'
    CASES.add(
        "a filter hides two modules", filtered, BIG, RIGHT, WARNED, REFUSED, place=GEOMETRY, columns=one_sheet_map()
    )
    hidden = one_sheet(BIG)
    hidden.sheets[0].hidden_rows = [3]
    CASES.add("a hidden row", hidden, BIG, RIGHT, WARNED, REFUSED, place=GEOMETRY, columns=one_sheet_map())
    column = one_sheet(BIG)
    column.sheets[0].hidden_columns = ["C", "E"]
    CASES.add("hidden columns", column, BIG, RIGHT, WARNED, REFUSED, place=GEOMETRY, columns=one_sheet_map())
    candidate = one_sheet(BIG)
    candidate.sheets[0].hidden_columns = ["J"]
    candidate.sheets[0].put("J1", [["x1"], [1.0], [2.0], [3.0], [4.0]])
    CASES.add("a hidden second column of x1", candidate, BIG, REFUSED, **cut)
    shadow = one_sheet(BIG)
    shadow.sheets[0].hidden_columns = ["B"]
    shadow.sheets[0].put("J1", [["x1"], *[[float(v)] for v in BIG.centers[:, 0] * 1.01]])
    CASES.add(
        "the first of two columns of x1 is hidden",
        shadow,
        scanner(BIG.centers * [1.01, 1, 1], 4.0, 150.0, 120.0, 20.0, BIG.collimator_length),
        REFUSED,
        place=GEOMETRY,
        columns=one_sheet_map(columns={"x1": "J"}),
    )
    for totals in (False, True):
        table = one_sheet(BIG)
        table.sheets[0].table = "A1:I6" if totals else "A1:I5"
        table.sheets[0].table_totals = totals
        if totals:
            table.sheets[0].put("A6", [["Total", *[Formula(f"SUBTOTAL(101,Table1[{h}])", 166.0) for h in heads[1:]]]])
        CASES.add(
            f"an Excel table{' with a totals row' if totals else ''}",
            table,
            BIG,
            *([RIGHT] if not totals else [RIGHT, REFUSED]),
            **({} if not totals else cut),
        )
    part = one_sheet(BIG)
    part.sheets[0].table = "A1:I4"
    CASES.add("an Excel table that ends above the last module", part, BIG, RIGHT, WARNED, REFUSED, **cut)
    grouped = typed(users())
    grouped["Main"].put("A8", [["old"], ["", None]])
    for i in range(4):
        grouped["Main"].put(f"P{10 + i}", [[4.0, 60.0, None, 40.0, 5.0]])
    CASES.add(
        "an old table below in Main, without numbers",
        grouped,
        SCANNER,
        REFUSED,
        WARNED,
        place=USERS,
        columns=users_map(),
    )
    for n in (5, 6):
        extra = typed(users())
        extra["Main"].put(f"A{n + 2}" if n == 5 else "A9", [[n]])
        extra["Main"].put(f"P{n + 2}" if n == 5 else "P9", [[4.0, 60.0, None, 40.0, 5.0]])
        CASES.add(f"module {n} in Main alone", extra, SCANNER, WARNED, REFUSED, place=USERS, columns=users_map())
    fewer = typed(users())
    fewer["Main"].cells = {at: v for at, v in fewer["Main"].cells.items() if not at.endswith("6")}
    CASES.add("module 4 in Coordinates alone", fewer, None, REFUSED, place=USERS)
    fewer_unnumbered = typed(users())
    fewer_unnumbered["Main"].cells = {
        at: v for at, v in fewer_unnumbered["Main"].cells.items() if not at.endswith("6") and at[0] != "A"
    }
    CASES.add("three rows of dimensions without numbers", fewer_unnumbered, None, REFUSED, place=USERS)
    shifted = typed(users(VARIED))
    shifted["Main"].cells = {
        at
        if int(re.sub(r"\D", "", at)) < 3
        else f"{re.sub(chr(92) + 'd', '', at)}{int(re.sub(chr(92) + 'D', '', at)) + 2}": v
        for at, v in shifted["Main"].cells.items()
        if at[0] != "A"
    }
    CASES.add(
        "Main two rows further down, without numbers",
        shifted,
        VARIED,
        RIGHT,
        REFUSED,
        place=USERS,
        columns=users_map(dimensions={"first_row": 5, "last_row": 8, "number": None, "rows": "in order"}),
    )


def _in_the_file() -> None:
    """Rows and cells as no spreadsheet program writes them, but others do."""

    def ordered(order: Callable[[list[str]], list[str]]) -> Callable[[], Book]:
        def book() -> Book:
            made = one_sheet(BIG)
            made.sheets[0].row_order = order
            return made

        return book

    odd = {"place": ("Geometry", "scanner.xlsx"), "unmappable": "the file is damaged"}
    for name, order in {
        "rows stored backwards": lambda rows: rows[::-1],
        "rows stored in another order": lambda rows: [rows[i] for i in (0, 3, 1, 4, 2)],
        "headings stored last": lambda rows: [*rows[1:], rows[0]],
        "a row stored in two parts": lambda rows: [
            *rows[:2],
            re.sub(r"(<row[^>]*>)(.*)(<c r=\"D3\".*)(</row>)", r"\1\2\4\1\3\4", rows[2]),
            *rows[3:],
        ],
        "rows without numbers": lambda rows: [re.sub(r'<row r="\d+"', "<row", r) for r in rows],
        "cells without names": lambda rows: [re.sub(r'<c r="\w+"', "<c", r) for r in rows],
        "rows and cells without names": lambda rows: [re.sub(r'<(row|c) r="\w+"', r"<\1", r) for r in rows],
        "cells of other rows in a row": lambda rows: [
            rows[0],
            re.sub(r'</row><row r="[34]">', "", "".join(rows[1:])),
            "",
        ],
        "a row's number not its cells'": lambda rows: [r.replace('<row r="3"', '<row r="13"') for r in rows],
        "rows numbered from 0": lambda rows: [
            re.sub(r'<row r="(\d+)"', lambda m: f'<row r="{int(m[1]) - 1}"', r) for r in rows
        ],
        "cells in small letters": lambda rows: [
            re.sub(r'<c r="(\w+)"', lambda m: f'<c r="{m[1].lower()}"', r) for r in rows
        ],
        "cells with $": lambda rows: [re.sub(r'<c r="([A-Z]+)(\d+)"', r'<c r="$\1$\2"', r) for r in rows],
        "cells stored backwards": lambda rows: [
            re.sub(r"(?<=>)(<c .*</c>)(?=</row>)", lambda m: "".join(re.findall("<c .*?</c>", m[1])[::-1]), r)
            for r in rows
        ],
    }.items():
        CASES.add(name, ordered(order), BIG, RIGHT, REFUSED, **odd)
    for name, at in (("a row stored twice", 5), ("a row stored twice, one after the other", 3)):
        CASES.add(
            name,
            ordered(lambda rows, at=at: [*rows[:at], rows[2].replace("<v>315.0</v>", "<v>215.0</v>"), *rows[at:]]),
            None,
            REFUSED,
            place=odd["place"],
        )
    CASES.add("wrong spans", ordered(lambda rows: [r.replace("<row ", '<row spans="1:2" ') for r in rows]), BIG, RIGHT)
    twice = one_sheet(BIG)
    twice.sheets[0]["B3"] = Raw('<c r="B3"><v>315</v></c><c r="B3"><v>215</v></c>')
    CASES.add("a cell stored twice", twice, None, REFUSED, place="Geometry!B3 is stored twice")
    same = one_sheet(BIG)
    same.sheets[0]["B3"] = Raw('<c r="B3"><v>315</v></c><c r="B3"><v>315</v></c>')
    CASES.add("a cell stored twice alike", same, BIG, RIGHT, REFUSED, **odd)
    heading = one_sheet(BIG)
    heading.sheets[0]["B1"] = Raw(
        '<c r="B1" t="inlineStr"><is><t>x1</t></is></c><c r="B1" t="inlineStr"><is><t>x2</t></is></c>'
    )
    CASES.add("a heading stored twice", heading, None, REFUSED, place=odd["place"])
    two_values = one_sheet(BIG)
    two_values.sheets[0]["B3"] = Raw('<c r="B3"><v>315</v><v>215</v></c>')
    CASES.add("a cell with two values", two_values, None, REFUSED, place=odd["place"])
    elsewhere = one_sheet(BIG)
    elsewhere.sheets[0]["B3"] = Raw('<c r="B3000"><v>315</v></c>')
    CASES.add("a cell of another row in its place", elsewhere, None, REFUSED, place=odd["place"])
    for name, dimension in (
        ("too small", "A1:B2"),
        ("far too large", "A1:XFD1048576"),
        ("nonsense", "foo"),
        ("empty", ""),
    ):
        made = one_sheet(BIG)
        made.replace("xl/worksheets/sheet1.xml", "<sheetData>", f'<dimension ref="{dimension}"/><sheetData>')
        CASES.add(
            f"a stated size that is {name}",
            made,
            BIG,
            *([RIGHT] if name in ("too small", "far too large") else [RIGHT, REFUSED]),
            **odd,
        )
    two_data = one_sheet(BIG)
    two_data.replace(
        "xl/worksheets/sheet1.xml",
        "</sheetData>",
        '</sheetData><sheetData><row r="3"><c r="B3"><v>215</v></c></row></sheetData>',
    )
    CASES.add("two blocks of data in a sheet", two_data, None, REFUSED, place=odd["place"])
    merged = one_sheet(BIG)
    merged.sheets[0].merged.append("B3:B5")
    CASES.add("values hidden under a merged cell", merged, None, REFUSED, WARNED_OF, place=GEOMETRY)
    overlap = one_sheet(BIG)
    overlap.sheets[0].merged.append("C3:D3")
    CASES.add("z1 of a module hidden under a merged cell", overlap, None, REFUSED, WARNED_OF, place=GEOMETRY)


_labels()
_single_values()
_below_and_beside()
_in_the_file()
