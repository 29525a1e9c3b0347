"""The scanners in the nasty workbooks, and the plain workbooks that the nasty ones start from."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from mphdrr.core import PinholeSystem, collimator_length

from .sheets import Book, Error, Formula, Sheet

CENTERS = np.array([[277.0, 70.3, -70.0], [155.0, 158.4, -70.9], [-63.1, -245.8, 70.4], [-10.5, 190.25, 12.0]])
BIG_CENTERS = np.array([[540.0, 70.5, -92.0], [315.0, 416.0, -96.5], [-164.0, -490.5, 104.0], [-25.5, 480.25, 24.0]])

SYMBOLS = {
    "x1": "x1",
    "y1": "y1",
    "z1": "z1",
    "b": "b",
    "l": "l",
    "H": "l + b+Td",
    "x2": "x2",
    "y2": "y2",
    "z2": "z2",
    "d": "d",
    "R": "R",
    "Ld": "Ld",
    "Td": "Td",
}
DESCRIPTIONS = {
    "x1": "x coordinate value at center of hole",
    "y1": "y coordinate value at center of hole",
    "z1": "z coordinate value at center of hole",
    "b": "distance from center of hole to center of heart",
    "l": "length of collimator",
    "x2": "x coordinate value at end of detector",
    "y2": "y coordinate value at end of detector",
    "z2": "z coordinate value at end of detector",
    "d": "diameter of pinhole",
    "R": "radius of spherical region of interest",
    "Ld": "length of side of detector crystal",
    "Td": "thickness of detector crystal",
}
NEEDED = ("x1", "y1", "z1", "d", "R", "Ld", "Td")
MILLIMETRES = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4, "um": 1e-3, "dm": 100.0, "ft": 304.8}
NUMBER_COLUMN = "A"


def scanner(
    centers: np.ndarray = CENTERS,
    d: Any = 2.3,
    R: Any = 75.0,
    Ld: Any = 50.0,
    Td: Any = 10.0,
    l: Any = None,
    numbers: Any = None,
) -> PinholeSystem:
    """A scanner whose l is by design unless given."""
    if l is None:
        l = collimator_length(np.linalg.norm(centers, axis=1), d, Ld, R)
    return PinholeSystem(centers, d, l, Ld, Td, R, None if numbers is None else np.asarray(numbers))


SCANNER = scanner()
# In centimetres its distances still look like a small scanner's in millimetres: its size does not reveal the unit.
BIG = scanner(BIG_CENTERS, 4.0, 150.0, 120.0, 20.0)
VARIED = scanner(CENTERS, d=[2.0, 2.5, 3.0, 3.5], Ld=[50.0, 52.0, 54.0, 56.0], Td=[8.0, 9.0, 10.0, 11.0])


def quantity(system: PinholeSystem, name: str) -> np.ndarray:
    """The numbers (M,) of a column, mm."""
    s = system
    b = s.pinhole_distance
    end = b + s.collimator_length + s.detector_thickness
    columns = {f"{axis}1": s.centers[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"{axis}2": s.centers[:, i] * end / b for i, axis in enumerate("xyz")}
    columns |= {"number": s.numbers, "b": b, "l": s.collimator_length, "H": end, "R": s.roi_radius}
    columns |= {"d": s.pinhole_diameter, "Ld": s.detector_side, "Td": s.detector_thickness}
    return columns[name]


# The workbook of the users: sheets Main and Coordinates, formulas with their values. A module's row is its number + 2.

USERS_COLUMNS = {
    "x1": "B",
    "y1": "C",
    "z1": "D",
    "b": "E",
    "l": "G",
    "H": "H",
    "x2": "I",
    "y2": "J",
    "z2": "K",
    "d": "P",
    "R": "Q",
    "Ld": "S",
    "Td": "T",
}


def users(system: PinholeSystem = SCANNER) -> Book:
    """The users' workbook of a scanner."""
    main, coordinates = Sheet("Main"), Sheet("Coordinates")
    main["A2"] = coordinates["A2"] = "Definitions"
    for name, column in USERS_COLUMNS.items():
        sheet = main if name in ("d", "R", "Ld", "Td") else coordinates
        sheet[f"{column}1"] = SYMBOLS[name]
        if name in DESCRIPTIONS:
            sheet[f"{column}2"] = DESCRIPTIONS[name]
    coordinates["F1"], coordinates["F2"] = "S", "3D slope"
    coordinates["U2"], coordinates["V2"] = "pinhole range", "pinhole azimuth (radians)"
    coordinates["W2"] = "pinhole elevation (radians)"
    values = {name: quantity(system, name) for name in USERS_COLUMNS}
    for i in range(len(system)):
        r = i + 3
        v = {name: float(column[i]) for name, column in values.items()}
        x, y, z, b = v["x1"], v["y1"], v["z1"], v["b"]
        planar = float(np.hypot(x, y))
        main[f"A{r}"] = coordinates[f"A{r}"] = int(system.numbers[i])
        for name in ("d", "R", "Ld", "Td"):
            main[f"{USERS_COLUMNS[name]}{r}"] = v[name]
        for name in ("x1", "y1", "z1"):
            coordinates[f"{USERS_COLUMNS[name]}{r}"] = v[name]
        formulas = {
            "E": (f"SQRT(SUMSQ(B{r},C{r},D{r}))", b),
            "F": (f"E{r}/B{r}", b / x if x else Error("#DIV/0!")),
            "G": (
                f"(Main!S{r}-Main!P{r})*(E{r}^2-Main!Q{r}^2)/(E{r}*Main!P{r}"
                f"+2*Main!Q{r}*SQRT(E{r}^2-Main!Q{r}^2+Main!P{r}^2/4))",
                v["l"],
            ),
            "H": (f"E{r}+G{r}+Main!T{r}", v["H"]),
            "I": (f"B{r}*H{r}/E{r}", v["x2"]),
            "J": (f"C{r}*H{r}/E{r}", v["y2"]),
            "K": (f"D{r}*H{r}/E{r}", v["z2"]),
            "U": (f"SQRT(SUMSQ(B{r},C{r}))", planar),
            "V": (f"(ATAN2(B{r},C{r}))", float(np.arctan2(y, x))),
            "W": (f"(ATAN2(U{r},D{r}))", float(np.arctan2(z, planar))),
        }
        for column, (text, value) in formulas.items():
            coordinates[f"{column}{r}"] = Formula(text, value)
    return Book([main, coordinates])


def formulas_of(sheet: Sheet) -> dict[str, Formula]:
    return {at: value for at, value in sheet.cells.items() if isinstance(value, Formula)}


def typed(book: Book) -> Book:
    """The same with the values of its formulas typed in."""
    for sheet in book.sheets:
        for at, formula in formulas_of(sheet).items():
            sheet[at] = formula.stored
    return book


# One sheet with typed numbers: A number, B x1, C y1, D z1, E d, F R, G Ld, H Td, I l; headings in row 1 or where asked.

ONE_SHEET_COLUMNS = {"x1": "B", "y1": "C", "z1": "D", "d": "E", "R": "F", "Ld": "G", "Td": "H", "l": "I"}


def one_sheet(
    system: PinholeSystem = BIG,
    headings: dict[str, str] | None = None,
    unit: dict[str, str] | str = "mm",
    names: dict[str, str] = SYMBOLS,
    top: int = 1,
    number: str = "No.",
    sheet: str = "Geometry",
    length: bool = True,
) -> Book:
    """A table of `system` with its numbers in `unit` (for all, or for each quantity); the unit is stated nowhere."""
    cells: dict[str, Any] = {f"A{top}": number}
    for name, column in ONE_SHEET_COLUMNS.items():
        if name == "l" and not length:
            continue
        of = unit if isinstance(unit, str) else unit.get(name, "mm")
        cells[f"{column}{top}"] = (headings or {}).get(name, names[name])
        for i, value in enumerate(quantity(system, name)):
            cells[f"A{top + 1 + i}"] = int(system.numbers[i])
            cells[f"{column}{top + 1 + i}"] = float(f"{value / MILLIMETRES[of]:.15g}")
    return Book([Sheet(sheet, cells)])


def with_cells(book: Book, **cells: Any) -> Book:
    """The book with cells such as B3=1.0 in its first sheet or Main_P4=2.0 in sheet Main."""
    for name, value in cells.items():
        sheet, _, at = name.rpartition("_")
        (book[sheet] if sheet else book.sheets[0])[at] = value
    return book


def with_gap(book: Book, below: int = 1, rows: int = 1) -> Book:
    """The book, the rows below row `below` of its first sheet moved down."""
    sheet = book.sheets[0]
    moved = {}
    for at, value in sheet.cells.items():
        column, row = at.rstrip("0123456789"), int(at.lstrip("ABCDEFGHIJKLMNOPQRSTUVWXYZ"))
        moved[f"{column}{row + rows * (row > below)}"] = value
    sheet.cells = moved
    return book


def with_format(book: Book, code: str, columns: str) -> Book:
    """The book, the number format of these columns' cells in its first sheet `code`."""
    for column in columns:
        for row in range(2, 6):
            book.sheets[0].formats[f"{column}{row}"] = code
    return book


def scaled(book: Book, factor: float, cells: Iterable[str]) -> Book:
    """The book, these cells of its first sheet times `factor`."""
    for at in cells:
        book.sheets[0][at] *= factor
    return book


# Column maps


def column_map(*tables: dict[str, Any]) -> str:
    """The TOML of a column map."""
    return "\n".join(map(_table, tables))


def _table(table: dict[str, Any]) -> str:
    columns = table["columns"]
    lines = ["[[tables]]"]
    lines += [f"{key} = {_toml(value)}" for key, value in table.items() if key != "columns"]
    lines.append("[tables.columns]")
    lines += [f'{name} = {{ column = "{c}", unit = "{u}" }}' for name, (c, u) in columns.items()]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return repr(value)


def one_sheet_map(
    unit: dict[str, str] | str = "mm",
    first: int = 2,
    last: int = 5,
    columns: dict[str, str] | None = None,
    sheet: str = "Geometry",
    number: str | None = "A",
    **more: Any,
) -> str:
    """The map of `one_sheet`."""
    chosen = {**ONE_SHEET_COLUMNS, **(columns or {})}
    units = {name: unit if isinstance(unit, str) else unit.get(name, "mm") for name in chosen}
    table = {"sheet": sheet, "first_row": first, "last_row": last, **({"number": number} if number else {}), **more}
    return column_map({**table, "columns": {q: (c, units[q]) for q, c in chosen.items() if c}})


def users_map(
    unit: dict[str, str] | str = "mm",
    first: int = 3,
    last: int = 6,
    position: dict[str, Any] | None = None,
    dimensions: dict[str, Any] | None = None,
    columns: dict[str, str] | None = None,
    length: bool = True,
) -> str:
    """The map of `users`; `position` and `dimensions` are changes of the two tables, None takes an entry away."""
    chosen = {**USERS_COLUMNS, **(columns or {})}
    units = {name: unit if isinstance(unit, str) else unit.get(name, "mm") for name in chosen}

    def table(sheet: str, names: tuple[str, ...], change: dict[str, Any] | None, **more: Any) -> dict[str, Any]:
        entries = {"sheet": sheet, "first_row": first, "last_row": last, "number": "A", **more, **(change or {})}
        columns = {q: (chosen[q], units[q]) for q in names if chosen[q]}
        return {**{k: v for k, v in entries.items() if v is not None}, "columns": columns}

    return column_map(
        table("Coordinates", ("x1", "y1", "z1", *(["l"] if length else [])), position),
        table("Main", ("d", "R", "Ld", "Td"), dimensions, rows="by number"),
    )
