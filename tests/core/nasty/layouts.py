"""Layouts: tables beside and below each other, legends, single values; derived columns that contradict the rest."""

from __future__ import annotations

import numpy as np

from .case import REFUSED, RIGHT, WARNED, WARNED_OF, Catalogue
from .scanners import (
    BIG,
    CENTERS,
    DESCRIPTIONS,
    ONE_SHEET_COLUMNS,
    SCANNER,
    SYMBOLS,
    column_map,
    one_sheet,
    one_sheet_map,
    quantity,
    scanner,
    typed,
    users,
    users_map,
)
from .sheets import Book, Formula, Sheet

CASES = Catalogue("layouts")
GEOMETRY = ("Geometry",)
VARIED = scanner(CENTERS, d=[2.0, 2.5, 3.0, 3.5], Ld=[50.0, 52.0, 54.0, 56.0], Td=[8.0, 9.0, 10.0, 11.0])
POSITION, DIMENSIONS = ("x1", "y1", "z1"), ("d", "R", "Ld", "Td")


def _block(names: tuple[str, ...], order: tuple[int, ...] = (0, 1, 2, 3), numbered: bool = True) -> list[list[object]]:
    """A table of VARIED, its rows in an order of their own."""
    head: list[object] = ["No."] if numbered else []
    rows: list[list[object]] = [[*head, *names]]
    for i in order:
        number = [int(VARIED.numbers[i])] if numbered else []
        rows.append([*number, *(float(quantity(VARIED, name)[i]) for name in names)])
    return rows


def _mapped(at: str, first: int, number: str | None, letters: str, rows: str, last: int | None = None) -> str:
    """A map of x1 y1 z1 in B2:D5 of sheet Geometry and of d R Ld Td in `letters` from row `first`."""
    position = {"sheet": "Geometry", "first_row": 2, "last_row": 5, "number": "A"}
    dimensions = {"sheet": at, "first_row": first, "last_row": last or first + 3, "rows": rows}
    if number:
        dimensions["number"] = number
    return column_map(
        {**position, "columns": {q: (c, "mm") for q, c in zip(POSITION, "BCD", strict=True)}},
        {**dimensions, "columns": {q: (c, "mm") for q, c in zip(DIMENSIONS, letters, strict=True)}},
    )


def _tables_in_one_sheet() -> None:
    for name, order, numbered in (
        ("alike", (0, 1, 2, 3), True),
        ("in another order", (2, 0, 3, 1), True),
        ("without numbers", (0, 1, 2, 3), False),
    ):
        for gap in (0, 1, 3):
            left = 4 + gap  # columns A to D are the first table's
            letters = "ABCDEFGHIJKLMNO"[left + numbered : left + numbered + 4]
            book = Book([Sheet("Geometry")])
            book.sheets[0].put("A1", _block(POSITION))
            book.sheets[0].put(f"{'ABCDEFGHIJKLMNO'[left]}1", _block(DIMENSIONS, order, numbered))
            number = "ABCDEFGHIJKLMNO"[left] if numbered else None
            mapped = _mapped("Geometry", 2, number, letters, "by number" if numbered else "in order")
            # In another order, a row holds two modules.
            CASES.add(
                f"two tables side by side, the numbers {name}, {gap} columns between",
                book,
                VARIED,
                RIGHT,
                REFUSED,
                place=GEOMETRY,
                columns=mapped,
            )
        for gap in (0, 1, 2):
            book = Book([Sheet("Geometry")])
            book.sheets[0].put("A1", _block(POSITION))
            book.sheets[0].put(f"A{6 + gap}", _block(DIMENSIONS, order, numbered))
            mapped = _mapped(
                "Geometry",
                7 + gap,
                "A" if numbered else None,
                "BCDE" if numbered else "ABCD",
                "by number" if numbered else "in order",
            )
            CASES.add(
                f"dimensions below the coordinates, the numbers {name}, gap {gap}",
                book,
                VARIED,
                RIGHT,
                REFUSED,
                place=("Geometry", "scanner.xlsx"),
                columns=mapped,
            )
    for name, top in (("above", 1), ("below", 8)):
        book = Book([Sheet("Geometry")])
        first = 6 if name == "above" else 1
        book.sheets[0].put(
            f"A{first}", [["No.", *POSITION], *[[i + 1, *map(float, row)] for i, row in enumerate(BIG.centers)]]
        )
        for i, q in enumerate(DIMENSIONS):
            book.sheets[0].put(f"A{top + i}", [[q, float(quantity(BIG, q)[0])]])
        tables = [
            {
                "sheet": "Geometry",
                "first_row": first + 1,
                "last_row": first + 4,
                "number": "A",
                "columns": {q: (c, "mm") for q, c in zip(POSITION, "BCD", strict=True)},
            }
        ]
        tables += [
            {
                "sheet": "Geometry",
                "first_row": top + i,
                "last_row": top + i,
                "rows": "one for all",
                "columns": {q: ("B", "mm")},
            }
            for i, q in enumerate(DIMENSIONS)
        ]
        CASES.add(
            f"names and values of the dimensions {name} the table",
            book,
            BIG,
            RIGHT,
            REFUSED,
            place=("Geometry", "scanner.xlsx"),
            columns=column_map(*tables),
        )
        wrong = Book([Sheet("Geometry")])
        wrong.sheets[0].put(
            f"A{first}",
            [
                ["No.", *POSITION, *DIMENSIONS],
                *[[i + 1, *map(float, row), 4.0, 150.0, 120.0, 20.0] for i, row in enumerate(BIG.centers)],
            ],
        )
        wrong.sheets[0].put(f"A{top}", [["d", 5.0]])
        CASES.add(
            f"another d {name} the table",
            wrong,
            BIG,
            RIGHT,
            REFUSED,
            WARNED,
            place=GEOMETRY,
            columns=one_sheet_map("mm", first + 1, first + 4, columns={"l": ""}),
        )
    first_only = one_sheet(BIG)
    for column in "EFGH":
        for row in (3, 4, 5):
            first_only.sheets[0][f"{column}{row}"] = None
    position = {
        "sheet": "Geometry",
        "first_row": 2,
        "last_row": 5,
        "number": "A",
        "columns": {q: (ONE_SHEET_COLUMNS[q], "mm") for q in (*POSITION, "l")},
    }
    once = {
        "sheet": "Geometry",
        "first_row": 2,
        "last_row": 2,
        "rows": "one for all",
        "columns": {q: (ONE_SHEET_COLUMNS[q], "mm") for q in DIMENSIONS},
    }
    CASES.add(
        "dimensions in the first row alone",
        first_only,
        BIG,
        RIGHT,
        REFUSED,
        place=GEOMETRY,
        columns=column_map(position, once),
    )
    for row in (3, 5):
        gone = one_sheet(BIG)
        gone.sheets[0][f"I{row}"] = None
        CASES.add(
            f"one l missing, row {row}",
            gone,
            BIG,
            RIGHT,
            WARNED,
            REFUSED,
            place=GEOMETRY,
            columns=one_sheet_map(columns={"l": ""}),
        )
    fixed = one_sheet(scanner(BIG.centers, 4.0, 150.0, 120.0, 20.0, 200.0))
    fixed.sheets[0]["I4"] = None
    CASES.add("one l missing where the others are not by design", fixed, None, REFUSED, WARNED_OF, place=GEOMETRY)
    blank = users()
    template = users()["Coordinates"]
    template.name = "Coordinates (blank)"
    template.cells = {at: v for at, v in template.cells.items() if at[-1] in "12" and len(at) == 2}
    blank.sheets.append(template)
    CASES.add(
        "an empty copy of Coordinates", blank, SCANNER, RIGHT, REFUSED, place=("Coordinates",), columns=users_map()
    )
    shifted = users()
    for column, q in zip("CDE", POSITION, strict=True):
        shifted["Coordinates"][f"{column}2"] = DESCRIPTIONS[q]
    shifted["Coordinates"]["B2"] = None
    CASES.add(
        "descriptions one column off",
        shifted,
        SCANNER,
        REFUSED,
        place=("Coordinates", "scanner.xlsx"),
        columns=users_map(),
    )
    legend = one_sheet(BIG)
    legend.sheets[0].put("L1", [["symbol", "meaning"], *[[q, DESCRIPTIONS[q]] for q in ("x1", "y1", "z1", "d")]])
    CASES.add("a legend at the right", legend, BIG, RIGHT, REFUSED, place=GEOMETRY, columns=one_sheet_map())
    sheet = users()
    sheet.add("Legend").put("A1", [[SYMBOLS[q], DESCRIPTIONS[q]] for q in DESCRIPTIONS])
    CASES.add(
        "a sheet of symbols and descriptions", sheet, SCANNER, RIGHT, REFUSED, place=("Legend",), columns=users_map()
    )
    across = users()
    across.add("Legend", first=True).put("A1", [list(DESCRIPTIONS), list(DESCRIPTIONS.values())])
    CASES.add(
        "a sheet of headings without rows", across, SCANNER, RIGHT, REFUSED, place=("Legend",), columns=users_map()
    )
    plot = users()
    plot.add("Plot").put(
        "A1",
        [
            ["x1", "y1"],
            *[
                [Formula(f"Coordinates!{c}{r}", float(SCANNER.centers[r - 3, i])) for i, c in enumerate("BC")]
                for r in range(3, 7)
            ],
        ],
    )
    CASES.add(
        "a sheet of x1 and y1 alone, for a plot", plot, SCANNER, RIGHT, REFUSED, place=("Plot",), columns=users_map()
    )
    for texts, name in (
        ([f"({i})" for i in range(9)], "texts"),
        (list(range(1, 10)), "numbers"),
        (list("ABCDEFGHI"), "letters"),
    ):
        counted = one_sheet(BIG, top=1)
        counted.sheets[0].cells = {
            at if at[1:] == "1" else f"{at[0]}{int(at[1:]) + 1}": v for at, v in counted.sheets[0].cells.items()
        }
        counted.sheets[0].put("A2", [texts])
        CASES.add(
            f"a row that counts the columns in {name}",
            counted,
            BIG,
            RIGHT,
            REFUSED,
            place=GEOMETRY,
            columns=one_sheet_map("mm", 3, 6),
        )
    negative = users(scanner(CENTERS * [1, 1, 0]))
    for row in range(3, 7):
        negative["Coordinates"][f"D{row}"] = -0.0
    CASES.add("z1 of minus zero", negative, scanner(CENTERS * [1, 1, 0]), RIGHT)
    one = one_sheet(BIG[:1])
    CASES.add("one module", one, BIG[:1], RIGHT)
    angles = enumerate(np.linspace(0, 3, 60))
    centers = np.array([[500 * np.cos(a), 500 * np.sin(a), 3 * i - 100] for i, a in angles])
    many = scanner(np.round(centers, 4), 4.0, 150.0, 120.0, 20.0)
    CASES.add("sixty modules", one_sheet(many), many, RIGHT)
    for builtin, meaning in ((9, "0%"), (10, "0.00%"), (14, "a date"), (20, "a time"), (45, "mm:ss")):
        made = one_sheet(BIG)
        made.sheets[0].formats = {f"B{row}": "0.0000" for row in range(2, 6)}
        made.replace("xl/styles.xml", '<xf numFmtId="164"', f'<xf numFmtId="{builtin}"')
        CASES.add(f"Excel's own format of {meaning}", made, None, REFUSED, WARNED_OF, place=GEOMETRY)
    for builtin in (1, 2, 3, 4, 11, 12, 37, 39, 48):
        made = one_sheet(BIG)
        made.sheets[0].formats = {f"B{row}": "0.0000" for row in range(2, 6)}
        made.replace("xl/styles.xml", '<xf numFmtId="164"', f'<xf numFmtId="{builtin}"')
        CASES.add(f"Excel's own number format {builtin}", made, BIG, RIGHT)


def _derived() -> None:
    """Derived columns in other units are checked in these; those that contradict the coordinates give a warning."""
    columns = {"E": "b", "H": "H", "I": "x2", "J": "y2", "K": "z2", "U": "range"}

    def scaled(letters: str, factor: float, heading: str) -> Book:
        book = typed(users())
        sheet = book["Coordinates"]
        for column in letters:
            row = 2 if sheet[f"{column}2"] else 1
            sheet[f"{column}{row}"] = heading.format(sheet[f"{column}{row}"])
            for r in range(3, 7):
                sheet[f"{column}{r}"] *= factor
        return book

    for letter, name in columns.items():
        for unit, factor in (("cm", 0.1), ("in", 1 / 25.4), ("mm", 1.0)):
            allowed = (RIGHT,)
            CASES.add(f"{name} in {unit}, said so", scaled(letter, factor, f"{{}} ({unit})"), SCANNER, *allowed)
        CASES.add(
            f"{name} in cm, not said",
            scaled(letter, 0.1, "{}"),
            SCANNER,
            WARNED,
            REFUSED,
            place=("Coordinates!",),
            columns=users_map(),
        )
        CASES.add(
            f"{name} in dm",
            scaled(letter, 0.01, "{} (dm)"),
            SCANNER,
            WARNED,
            REFUSED,
            RIGHT,
            place=("Coordinates!",),
            columns=users_map(),
        )
        CASES.add(
            f"{name} of something else",
            scaled(letter, 1.01, "{}"),
            SCANNER,
            WARNED,
            REFUSED,
            place=("Coordinates!",),
            columns=users_map(),
        )
    for letter, name in (("V", "azimuth"), ("W", "elevation")):
        of = f"pinhole {name}"
        for unit, factor in (
            ("degrees", 180 / np.pi),
            ("deg", 180 / np.pi),
            ("°", 180 / np.pi),
            ("rad", 1.0),
            ("radians", 1.0),
        ):
            book = scaled(letter, factor, "{}")
            book["Coordinates"][f"{letter}2"] = f"{of} ({unit})"
            CASES.add(
                f"{name} in {unit}",
                book,
                SCANNER,
                RIGHT,
                *((WARNED, REFUSED) if unit == "°" else ()),
                place=("Coordinates!",),
                columns=users_map(),
            )
        for unit, factor in (("radians", 180 / np.pi), ("degrees", 1.0), ("gon", 200 / np.pi), ("mrad", 1000.0)):
            book = scaled(letter, factor, "{}")
            book["Coordinates"][f"{letter}2"] = f"{of} ({unit})"
            CASES.add(
                f"{name} said to be in {unit}, {'right' if unit in ('gon', 'mrad') else 'wrong'}",
                book,
                SCANNER,
                WARNED,
                REFUSED,
                *((RIGHT,) if unit in ("gon", "mrad") else ()),
                place=("Coordinates!",),
                columns=users_map(),
            )
        book = scaled(letter, -1.0, "{}")
        CASES.add(
            f"{name} of the other sign", book, SCANNER, WARNED, REFUSED, place=("Coordinates!",), columns=users_map()
        )
    polar = typed(users())
    for r in range(3, 7):
        polar["Coordinates"][f"W{r}"] = np.pi / 2 - polar["Coordinates"][f"W{r}"]
    CASES.add("elevation from the axis", polar, SCANNER, WARNED, REFUSED, place=("Coordinates!W",), columns=users_map())
    shifted = typed(users())
    for i in range(4):
        shifted["Coordinates"][f"E{3 + i}"] = float(np.linalg.norm(SCANNER.centers[i] - [0, 0, 5]))
    CASES.add(
        "b from another isocentre", shifted, SCANNER, WARNED, REFUSED, place=("Coordinates!E",), columns=users_map()
    )
    front = typed(users())
    for i in range(4):
        front["Coordinates"][f"H{3 + i}"] -= 10.0
    CASES.add("l + b+Td without Td", front, SCANNER, WARNED, REFUSED, place=("Coordinates!H",), columns=users_map())
    swapped = users()
    for r in range(3, 7):
        sheet = swapped["Coordinates"]
        sheet[f"B{r}"], sheet[f"C{r}"] = sheet[f"C{r}"], sheet[f"B{r}"]
    CASES.add("x1 and y1 exchanged since", swapped, None, REFUSED, WARNED_OF, place=("Coordinates!",))
    mirrored = users()
    for r in range(3, 7):
        mirrored["Coordinates"][f"D{r}"] *= -1
    CASES.add("z1 mirrored since", mirrored, None, REFUSED, WARNED_OF, place=("Coordinates!",))
    turned = typed(users())
    for name in ("x2", "y2", "z2"):
        letter = {"x2": "I", "y2": "J", "z2": "K"}[name]
        for i in range(4):
            turned["Coordinates"][f"{letter}{3 + i}"] = float(quantity(SCANNER, name)[(i + 1) % 4])
    CASES.add(
        "x2 y2 z2 of other modules", turned, SCANNER, WARNED, REFUSED, place=("Coordinates!",), columns=users_map()
    )
    sorted_half = typed(users(VARIED))
    sheet = sorted_half["Coordinates"]
    for column in "BCD":
        sheet[f"{column}3"], sheet[f"{column}6"] = sheet[f"{column}6"], sheet[f"{column}3"]
    CASES.add(
        "coordinates sorted, the rest of the row not", sorted_half, None, REFUSED, WARNED_OF, place=("Coordinates!",)
    )


_tables_in_one_sheet()
_derived()
