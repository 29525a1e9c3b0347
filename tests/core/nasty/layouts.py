"""Layouts: tables beside and below each other, legends, single values; derived columns that contradict the rest."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .case import DOUBTED, READ_OR_REFUSED, REFUSED, RIGHT, WARNED, Catalogue
from .scanners import (
    BIG,
    CENTERS,
    DESCRIPTIONS,
    SCANNER,
    SYMBOLS,
    VARIED,
    column_map,
    one_sheet,
    one_sheet_map,
    quantity,
    scanner,
    typed,
    users,
    users_map,
    with_cells,
    with_gap,
)
from .sheets import Book, Formula, Sheet

CASES = Catalogue("layouts", place=("Geometry", "scanner.xlsx"), columns=one_sheet_map())
POSITION, DIMENSIONS = ("x1", "y1", "z1"), ("d", "R", "Ld", "Td")


def _block(names: tuple[str, ...], order: tuple[int, ...] = (0, 1, 2, 3), numbered: bool = True) -> list[list[object]]:
    """A table of VARIED, its rows in an order of their own."""
    head: list[object] = ["No."] if numbered else []
    rows: list[list[object]] = [[*head, *names]]
    for i in order:
        number = [int(VARIED.numbers[i])] if numbered else []
        rows.append([*number, *(float(quantity(VARIED, name)[i]) for name in names)])
    return rows


def _table(names: tuple[str, ...], columns: str, first: int, last: int, **more: object) -> dict[str, object]:
    """A table of a column map in sheet Geometry."""
    entries = {"sheet": "Geometry", "first_row": first, "last_row": last, **more}
    return {**entries, "columns": {q: (c, "mm") for q, c in zip(names, columns, strict=True)}}


def _tables_in_one_sheet() -> None:
    position = _table(POSITION, "BCD", 2, 5, number="A")
    for name, order, numbered in (
        ("alike", (0, 1, 2, 3), True),
        ("in another order", (2, 0, 3, 1), True),
        ("without numbers", (0, 1, 2, 3), False),
    ):
        joint = {"rows": "by number"} if numbered else {"rows": "in order"}
        for gap in (0, 1):
            letters = "ABCDEFGHIJKLMNO"[4 + gap :]  # columns A to D are the first table's
            for where, at, row in (("side by side", letters, 1), ("one below the other", "ABCDEFG", 6 + gap)):
                book = Book([Sheet("Geometry")])
                book.sheets[0].put("A1", _block(POSITION))
                book.sheets[0].put(f"{at[0]}{row}", _block(DIMENSIONS, order, numbered))
                own = {"number": at[0]} if numbered else {}
                dimensions = _table(DIMENSIONS, at[numbered : numbered + 4], row + 1, row + 4, **joint, **own)
                mapped = column_map(position, dimensions)
                # In another order, a row holds two modules.
                what = f"two tables {where}, the numbers {name}, gap {gap}"
                CASES.add(what, book, VARIED, *READ_OR_REFUSED, columns=mapped)
    for name, top, first in (("above", 1, 6), ("below", 8, 1)):
        book = Book([Sheet("Geometry")])
        centers = BIG.centers.tolist()
        book.sheets[0].put(f"A{first}", [["No.", *POSITION], *[[i + 1, *row] for i, row in enumerate(centers)]])
        book.sheets[0].put(f"A{top}", [[q, float(quantity(BIG, q)[0])] for q in DIMENSIONS])
        tables = [_table(POSITION, "BCD", first + 1, first + 4, number="A")]
        tables += [_table((q,), "B", top + i, top + i, rows="one for all") for i, q in enumerate(DIMENSIONS)]
        what = f"names and values of the dimensions {name} the table"
        CASES.add(what, book, BIG, *READ_OR_REFUSED, columns=column_map(*tables))
        wrong = one_sheet(BIG, top=first, length=False)
        wrong.sheets[0].put(f"A{top}", [["d", 5.0]])
        mapped = one_sheet_map("mm", first + 1, first + 4, columns={"l": ""})
        CASES.add(f"another d {name} the table", wrong, BIG, RIGHT, WARNED, REFUSED, columns=mapped)


def _cells_left_out() -> None:
    first_only = with_cells(one_sheet(BIG), **{f"{c}{row}": None for c in "EFGH" for row in (3, 4, 5)})
    position = _table((*POSITION, "l"), "BCDI", 2, 5, number="A")
    once = _table(DIMENSIONS, "EFGH", 2, 2, rows="one for all")
    name = "dimensions in the first row alone"
    CASES.add(name, first_only, BIG, *READ_OR_REFUSED, columns=column_map(position, once))
    gone = with_cells(one_sheet(BIG), I3=None)
    without_l = one_sheet_map(columns={"l": ""})
    CASES.add("one l missing", gone, BIG, RIGHT, WARNED, REFUSED, columns=without_l)
    fixed = with_cells(one_sheet(scanner(BIG.centers, 4.0, 150.0, 120.0, 20.0, 200.0)), I4=None)
    CASES.add("one l missing where the others are not by design", fixed, None, *DOUBTED)
    one = one_sheet(BIG[:1])
    CASES.add("one module", one, BIG[:1], RIGHT)
    angles = np.linspace(0, 3, 60)
    centers = np.stack([500 * np.cos(angles), 500 * np.sin(angles), 3 * np.arange(60) - 100.0], axis=1)
    many = scanner(np.round(centers, 4), 4.0, 150.0, 120.0, 20.0)
    CASES.add("sixty modules", one_sheet(many), many, RIGHT)
    flat = scanner(CENTERS * [1, 1, 0])
    CASES.add(
        "z1 of minus zero", with_cells(users(flat), **{f"Coordinates_D{r}": -0.0 for r in range(3, 7)}), flat, RIGHT
    )


def _sheets_and_rows_of_headings() -> None:
    of_users = {"columns": users_map()}
    blank = users()
    template = users()["Coordinates"]
    cells = {at: v for at, v in template.cells.items() if at[-1] in "12" and len(at) == 2}
    blank.add("Coordinates (blank)", cells)
    for name, book, place, allowed in (
        ("an empty copy of Coordinates", blank, "Coordinates", READ_OR_REFUSED),
        ("descriptions one column off", _descriptions_off(), ("Coordinates", "scanner.xlsx"), (REFUSED,)),
        ("a sheet of symbols and descriptions", _legend(down=True), "Legend", READ_OR_REFUSED),
        ("a sheet of headings without rows", _legend(down=False), "Legend", READ_OR_REFUSED),
    ):
        CASES.add(name, book, SCANNER, *allowed, place=place, **of_users)
    legend = one_sheet(BIG)
    legend.sheets[0].put("L1", [["symbol", "meaning"], *[[q, DESCRIPTIONS[q]] for q in ("x1", "y1", "z1", "d")]])
    CASES.add("a legend at the right", legend, BIG, *READ_OR_REFUSED)
    plot = users()
    points = [
        [Formula(f"Coordinates!{c}{3 + r}", x) for c, x in zip("BC", center[:2], strict=True)]
        for r, center in enumerate(SCANNER.centers.tolist())
    ]
    plot.add("Plot").put("A1", [["x1", "y1"], *points])
    CASES.add("a sheet of x1 and y1 alone, for a plot", plot, SCANNER, *READ_OR_REFUSED, place="Plot", **of_users)
    for texts, name in (([f"({i})" for i in range(9)], "texts"), (list(range(1, 10)), "numbers")):
        counted = with_gap(one_sheet(BIG))
        counted.sheets[0].put("A2", [texts])
        what = f"a row that counts the columns in {name}"
        CASES.add(what, counted, BIG, *READ_OR_REFUSED, columns=one_sheet_map("mm", 3, 6))
    for builtin, truth, allowed in ((10, None, DOUBTED), (14, None, DOUBTED), (45, None, DOUBTED), (4, BIG, (RIGHT,))):
        made = one_sheet(BIG)
        made.sheets[0].formats = {f"B{row}": "0.0000" for row in range(2, 6)}
        made.replace("xl/styles.xml", '<xf numFmtId="164"', f'<xf numFmtId="{builtin}"')
        CASES.add(f"Excel's own number format {builtin}", made, truth, *allowed)


def _descriptions_off() -> Book:
    shifted = with_cells(users(), Coordinates_B2=None)
    shifted["Coordinates"].put("C2", [[DESCRIPTIONS[q] for q in POSITION]])
    return shifted


def _legend(down: bool) -> Book:
    book = users()
    rows = [[SYMBOLS[q], DESCRIPTIONS[q]] for q in DESCRIPTIONS]
    book.add("Legend", first=not down).put("A1", rows if down else [list(row) for row in zip(*rows, strict=True)])
    return book


def _changed(column: str, change: Callable[[float], float], heading: str = "") -> Book:
    """The users' workbook of typed numbers, a column of Coordinates changed, and its heading."""
    book = typed(users())
    sheet = book["Coordinates"]
    for r in range(3, 7):
        sheet[f"{column}{r}"] = change(sheet[f"{column}{r}"])
    if heading:
        row = 2 if sheet[f"{column}2"] else 1
        sheet[f"{column}{row}"] = heading.format(sheet[f"{column}{row}"])
    return book


def _derived() -> None:
    """Derived columns in other units are checked in these; those that contradict the coordinates give a warning."""
    of_users = {"place": "Coordinates!", "columns": users_map()}
    for letter, name in {"E": "b", "H": "H", "I": "x2", "U": "range"}.items():
        CASES.add(f"{name} in cm, said so", _changed(letter, lambda v: v / 10, "{} (cm)"), SCANNER, RIGHT)
        not_said = _changed(letter, lambda v: v / 10)
        CASES.add(f"{name} in cm, not said", not_said, SCANNER, WARNED, REFUSED, **of_users)
        tenths = _changed(letter, lambda v: v / 100, "{} (dm)")
        CASES.add(f"{name} in dm", tenths, SCANNER, WARNED, REFUSED, RIGHT, **of_users)
    for letter, name, change, heading, allowed in (
        ("V", "azimuth in degrees", np.degrees, "pinhole azimuth (degrees)", (RIGHT,)),
        ("W", "elevation in °", np.degrees, "pinhole elevation (°)", (RIGHT, WARNED, REFUSED)),
        ("V", "azimuth said to be in radians, wrong", np.degrees, "pinhole azimuth (radians)", (WARNED, REFUSED)),
        ("W", "elevation in mrad", lambda v: 1000 * v, "pinhole elevation (mrad)", (RIGHT, WARNED, REFUSED)),
        ("W", "elevation of the other sign", lambda v: -v, "", (WARNED, REFUSED)),
        ("W", "elevation from the axis", lambda v: np.pi / 2 - v, "", (WARNED, REFUSED)),
        ("H", "l + b+Td without Td", lambda v: v - 10.0, "", (WARNED, REFUSED)),
    ):
        CASES.add(name, _changed(letter, lambda v, f=change: float(f(v)), heading), SCANNER, *allowed, **of_users)
    shifted = typed(users())
    for i, center in enumerate(SCANNER.centers):
        shifted["Coordinates"][f"E{3 + i}"] = float(np.linalg.norm(center - [0, 0, 5]))
    CASES.add("b from another isocentre", shifted, SCANNER, WARNED, REFUSED, **of_users | {"place": "Coordinates!E"})
    turned = typed(users())
    for name, letter in {"x2": "I", "y2": "J", "z2": "K"}.items():
        for i in range(4):
            turned["Coordinates"][f"{letter}{3 + i}"] = float(quantity(SCANNER, name)[(i + 1) % 4])
    CASES.add("x2 y2 z2 of other modules", turned, SCANNER, WARNED, REFUSED, **of_users)
    swapped, mirrored = users(), users()
    for r in range(3, 7):
        sheet = swapped["Coordinates"]
        sheet[f"B{r}"], sheet[f"C{r}"] = sheet[f"C{r}"], sheet[f"B{r}"]
        mirrored["Coordinates"][f"D{r}"] *= -1
    sorted_half = typed(users(VARIED))
    sheet = sorted_half["Coordinates"]
    for column in "BCD":
        sheet[f"{column}3"], sheet[f"{column}6"] = sheet[f"{column}6"], sheet[f"{column}3"]
    for name, book in {
        "x1 and y1 exchanged since": swapped,
        "z1 mirrored since": mirrored,
        "coordinates sorted, the rest of the row not": sorted_half,
    }.items():
        CASES.add(name, book, None, *DOUBTED, place="Coordinates!")


_tables_in_one_sheet()
_cells_left_out()
_sheets_and_rows_of_headings()
_derived()
