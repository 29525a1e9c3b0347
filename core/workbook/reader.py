"""`read_system`: a geometry workbook as a `PinholeSystem`."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..design import collimator_length
from ..errors import InputError
from ..system import PinholeSystem
from .book import Book, Uncomputed
from .cells import length, where
from .checks import derived, tolerance, warn_of_differences
from .headings import DIMENSIONS, EXPECTED_HEADINGS, POSITION, Table, tables
from .rows import Rows, module_rows, rows_of_modules, warn_of_left_out
from .source import QuantityCells, SystemSource

_PREFERRED_SHEETS = {"position": ("coordinates", "main"), "dimensions": ("main", "coordinates")}
_COMPUTED = ("b", "l", "H", "x2", "y2", "z2", "range", "azimuth", "elevation")
"""Columns that may hold formulas, causes before effects, so that the cause of an error is the cell refused."""
_SAME_PLACE = 1e-6
"""mm; two pinholes nearer than this are one."""


def read_system(path: str | os.PathLike[str]) -> PinholeSystem:
    """The scanner of a geometry workbook.

    Sheets, heading rows and columns are found by their headings: symbols (x1 y1 z1 l d R Ld Td, and b, l+b+Td,
    x2 y2 z2) or descriptions ("x coordinate value at center of hole", "length of collimator", "pinhole
    azimuth (radians)", ...), anywhere in a sheet's first 20 rows. Formulas may have stored values or not. The
    pinhole centres, d, R, Ld and Td must be there, a number a module, or one for all modules. l comes from
    its column, and where that is blank from `collimator_length`. The sheet's other numbers are only checked:
    one that differs from the formulas by more than 1e-6 (relative, mm or radians) and by more than rounding in
    its last decimal (to 2 decimals at least, 3 of radians) is an `InputWarning`.

    Parameters
    ----------
    path
        An .xlsx or .xlsm file, which is only read; it may be open in Excel.

    Returns
    -------
    PinholeSystem
        Modules in the order of their rows; `source` names the workbook and the cell of every number.

    Raises
    ------
    InputError
        Not a workbook, no table of coordinates, more than one that fits, or a cell that cannot be used: one
        line with sheet and cell, what is there and what was expected.

    Examples
    --------
    >>> system = read_system("examples/dc-spect-80.xlsx")    # doctest: +SKIP
    >>> len(system), system.collimator_length[0].round(4)    # doctest: +SKIP
    (80, 89.0702)
    """
    return read(Book(path)).system


@dataclass(frozen=True)
class Reading:
    """What is read from a workbook.

    Attributes
    ----------
    modules : Rows
        The modules of the coordinates' table.
    columns : dict
        Quantity -> `Column`, of each that has one.
    system : PinholeSystem
    """

    modules: Rows
    columns: dict[str, Column]
    system: PinholeSystem


def read(book: Book) -> Reading:
    """The scanner of `book` and where its numbers stand; see `read_system`."""
    found_tables = tables(book)
    coordinates = _coordinates(book, found_tables)
    modules = module_rows(coordinates)
    if not modules.rows:
        column = coordinates.column("x1") or 1
        at = where(coordinates.sheet, coordinates.first_row, column)
        raise InputError(f"{at} and the rows below hold no modules, expected their x1, y1, z1")
    columns = {name: Column(coordinates, name, modules, modules.rows) for name in POSITION}
    values = {name: columns[name].numbers() for name in POSITION}
    for name in DIMENSIONS:
        table = _dimensions(name, book, found_tables, coordinates)
        columns[name] = Column(table, name, modules, rows_of_modules(name, modules, table))
        values[name] = columns[name].numbers()
    _refuse_impossible(columns, values)

    centers = np.stack([values[name] for name in POSITION], axis=1)
    on_axis = np.hypot(values["x1"], values["y1"]) == 0
    given = {}
    for name in _COMPUTED:
        if coordinates.column(name) is not None:
            columns[name] = Column(coordinates, name, modules, modules.rows)
            # On the z axis a spreadsheet's ATAN2 shows #DIV/0!, and any azimuth is right.
            given[name] = columns[name].numbers_or_nan(on_axis if name == "azimuth" else None)
    l_used = _collimator_length(columns, values, given)
    _check_derived(columns, given, derived(centers, l_used, values["Td"]), l_used)
    for table in dict.fromkeys(columns[name].table for name in DIMENSIONS):
        warn_of_left_out(modules, table)

    system = PinholeSystem(
        centers=centers,
        pinhole_diameter=values["d"],
        collimator_length=l_used,
        detector_side=values["Ld"],
        detector_thickness=values["Td"],
        roi_radius=values["R"],
        numbers=np.array(modules.names),
        source=_source(book, modules, columns),
    )
    return Reading(modules, columns, system)


class Column:
    """The cells of one quantity, one for each module."""

    def __init__(self, table: Table, quantity: str, modules: Rows, rows: Sequence[int]) -> None:
        column = table.column(quantity)
        assert column is not None, "made only of columns that are there"
        self.table, self.quantity, self.modules, self.rows = table, quantity, modules, tuple(rows)
        self.column = column

    def where(self, i: int) -> str:
        """File, sheet and cell of module index `i`."""
        return where(self.table.sheet, self.rows[i], self.column)

    def place(self, i: int) -> str:
        """Sheet and cell of module index `i`."""
        return self.table.sheet.place(self.rows[i], self.column)

    def numbers(self) -> NDArray[np.float64]:
        """The numbers (M,); a cell without one is refused."""
        return np.array([self._number(i) for i in range(len(self.rows))])

    def numbers_or_nan(self, may_fail: NDArray[np.bool_] | None = None) -> NDArray[np.float64]:
        """The numbers (M,), NaN where blank or not computable, and where no number but `may_fail`."""
        numbers = np.full(len(self.rows), math.nan)
        for i, row in enumerate(self.rows):
            value = self.table.sheet.value(row, self.column)
            optional = value is None or isinstance(value, Uncomputed) or (may_fail is not None and may_fail[i])
            if isinstance(value, float) or not optional:
                numbers[i] = self._number(i)
        return numbers

    def _number(self, i: int) -> float:
        of = f" of module {self.modules.names[i]}" if len(set(self.rows)) == len(self.rows) else ""
        return length(self.table.sheet, self.rows[i], self.column, self.quantity, of)

    def refuse(self, bad: NDArray[np.bool_], why: Callable[[int], str]) -> None:
        """Refuse the first module of `bad` (M,)."""
        if bad.any():
            i = int(np.argmax(bad))
            raise InputError(f"{self.where(i)} {why(i)}")


def _coordinates(book: Book, found_tables: list[Table]) -> Table:
    fitting = [table for table in found_tables if table.quantities.issuperset(POSITION)]
    if fitting:
        return _choose(fitting, "position", "x1, y1, z1")
    nearest = max(found_tables, key=lambda table: len(table.quantities & set(POSITION)), default=None)
    missing = [name for name in POSITION if nearest is None or name not in nearest.quantities]
    looked_for = " or ".join((", ".join(missing), repr(EXPECTED_HEADINGS[missing[0]])))
    if nearest is not None and len(missing) < 3:
        raise InputError(
            f"{book.path.name}: sheet {nearest.sheet.name} has no column headed {looked_for} in row "
            f"{nearest.heading_rows[0]}, beside those of the other coordinates"
        )
    raise InputError(
        f"{book.path.name}: no sheet has a table of pinholes, expected columns headed {looked_for}, ...; "
        f"its sheets are {', '.join(book.sheets) or 'none'}"
    )


def _dimensions(quantity: str, book: Book, found_tables: list[Table], coordinates: Table) -> Table:
    fitting = [table for table in found_tables if quantity in table.quantities]
    if not fitting:
        raise InputError(
            f"{book.path.name}: no sheet has a column headed {quantity} or {EXPECTED_HEADINGS[quantity]!r}; "
            f"its sheets are {', '.join(book.sheets)}"
        )
    own = [table for table in fitting if table is coordinates]
    named = any(_preference(table, "dimensions") == 0 for table in fitting)
    return _choose(own if own and not named else fitting, "dimensions", quantity)


def _choose(fitting: list[Table], kind: str, what: str) -> Table:
    """The table by its sheet's name, else the one with values and the most of the known headings."""

    def rank(table: Table) -> tuple[int, bool, int]:
        wanted = POSITION if kind == "position" else DIMENSIONS
        columns = {column for _, column, quantity in table.headings if quantity in wanted}
        below = [row for row in table.sheet.rows if row >= table.first_row]
        filled = any(table.sheet.value(row, column) is not None for row in below for column in columns)
        known = table.quantities - {"number"} if kind == "position" else table.quantities & set(DIMENSIONS)
        return (_preference(table, kind), not filled, -len(known))

    ranked = sorted(fitting, key=rank) if len(fitting) > 1 else fitting
    if len(ranked) > 1 and rank(ranked[0]) == rank(ranked[1]):
        first, second = ranked[:2]
        raise InputError(
            f"{first.sheet.book.path.name}: sheets {first.sheet.name} and {second.sheet.name} both have columns "
            f"headed {what}, expected one; call the one to be used {_PREFERRED_SHEETS[kind][0].capitalize()}"
        )
    return ranked[0]


def _preference(table: Table, kind: str) -> int:
    names = _PREFERRED_SHEETS[kind]
    name = table.sheet.name.strip().casefold()
    return names.index(name) if name in names else len(names)


def _refuse_impossible(columns: dict[str, Column], values: dict[str, NDArray[np.float64]]) -> None:
    for name in DIMENSIONS:

        def too_small(i: int, name: str = name) -> str:
            return f"has {name} = {values[name][i]:g} mm, expected more than 0"

        columns[name].refuse(values[name] <= 0, too_small)
    d, side, roi = values["d"], values["Ld"], values["R"]
    columns["d"].refuse(
        d >= side,
        lambda i: f"has d = {d[i]:g} mm, expected less than Ld = {side[i]:g} mm in {columns['Ld'].place(i)}",
    )
    x1 = columns["x1"]
    names = x1.modules.names
    with np.errstate(over="ignore"):
        b = np.sqrt(sum(values[name] ** 2 for name in POSITION))
    x1.refuse(
        b == 0,
        lambda i: f"and y1, z1 put the pinhole of module {names[i]} at the isocentre, expected outside the ROI",
    )
    x1.refuse(
        np.isinf(b),
        lambda i: f"and y1, z1 put the pinhole of module {names[i]} too far away to compute, expected millimetres",
    )
    x1.refuse(
        b <= roi,
        lambda i: (
            f"and y1, z1 put the pinhole of module {names[i]} {b[i]:g} mm from the isocentre, expected outside "
            f"the ROI of {roi[i]:g} mm in {columns['R'].place(i)}"
        ),
    )
    first: dict[tuple[int, ...], int] = {}
    for i, position in enumerate(zip(*(values[name] for name in POSITION), strict=True)):
        j = first.setdefault(tuple(round(x / _SAME_PLACE) for x in position), i)
        if j != i:
            raise InputError(
                f"{x1.where(i)} and y1, z1 put the pinhole of module {names[i]} where that of module {names[j]} "
                f"is ({x1.place(j)}), expected another place"
            )


def _collimator_length(
    columns: dict[str, Column], values: dict[str, NDArray[np.float64]], given: dict[str, NDArray[np.float64]]
) -> NDArray[np.float64]:
    b = np.sqrt(sum(values[name] ** 2 for name in POSITION))
    designed = collimator_length(b, values["d"], values["Ld"], values["R"])
    if "l" not in given:
        return designed
    l_given = given["l"]
    columns["l"].refuse(l_given <= 0, lambda i: f"has l = {l_given[i]:g} mm, expected more than 0")
    warn_of_differences("l", l_given, designed, columns["l"].where)
    return np.where(np.isnan(l_given), designed, l_given)


def _check_derived(
    columns: dict[str, Column],
    given: dict[str, NDArray[np.float64]],
    expected: dict[str, NDArray[np.float64]],
    l_used: NDArray[np.float64],
) -> None:
    # Where l is typed as displayed, H and x2, y2, z2 may come from all its digits.
    rounding_of_l = np.array([tolerance(x, x, "mm") for x in l_used]) if "l" in given else 0.0
    on_axis = expected["range"] == 0
    for name in (name for name in _COMPUTED if name in given and name in expected):
        column = columns[name]
        numbers = np.where(on_axis, math.nan, given[name]) if name == "azimuth" else given[name]
        degrees = column.table.in_degrees(name)
        slack = rounding_of_l if name in ("H", "x2", "y2", "z2") else 0.0
        warn_of_differences(name, numbers, expected[name], column.where, degrees=degrees, slack=slack)


def _source(book: Book, modules: Rows, columns: dict[str, Column]) -> SystemSource:
    from openpyxl.utils import get_column_letter

    cells = [
        QuantityCells(name, column.table.sheet.name, get_column_letter(column.column), column.rows)
        for name, column in columns.items()
    ]
    if modules.number_column is not None:
        letters = get_column_letter(modules.number_column)
        cells.insert(0, QuantityCells("number", modules.table.sheet.name, letters, modules.rows))
    return SystemSource(
        path=book.path.absolute(),
        sha256=book.sha256,
        coordinates_sheet=modules.table.sheet.name,
        dimensions_sheet=columns["d"].table.sheet.name,
        numbers=modules.names,
        cells=tuple(cells),
    )
