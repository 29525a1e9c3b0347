"""`read_system`: a geometry workbook as a `PinholeSystem`, and whether its numbers are possible and plausible."""

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, warn
from ..geometry.system import PinholeSystem, same_place
from ..system_source import QuantityCells, SystemSource
from .book import Book
from .column_map import ColumnMap, column_map
from .layout import Column, Layout, mapped_layout
from .quantities import DERIVED, DIMENSIONS, NEEDED, OPTIONAL, POSITION, QUANTITIES, Numbers, tolerance
from .recognition import recognized_layout

_SHOWN = 5
"""Warnings of one column; the last one counts the rest."""


def read_system(
    path: str | os.PathLike[str], columns: ColumnMap | str | os.PathLike[str] | None = None
) -> PinholeSystem:
    """The scanner in a geometry workbook; `source` names the workbook and the cell of every number.

    Tables are found by their headings, listed in `core.workbook.quantities`, with their units. What could be mistaken is
    refused; `columns` then says what is meant. The pinhole centres, d, R, Ld and Td are needed, a number for each module or
    one for all. l comes from its column, and where that is blank from `collimator_length`. A stored value that is not what
    its formula gives is refused, unless all formulas store 0 or nothing. Numbers that follow from the others are only
    checked: one that differs by more than 1e-6 (relative, mm or radians) and by more than rounding in its last decimal is an
    `InputWarning`. So are columns that may be about the scanner and are not understood.

    Parameters
    ----------
    path
        An .xlsx or .xlsm file, which is only read; it may be open in Excel.
    columns
        Which cells hold which quantity: a `ColumnMap`, or the path of one as TOML. Nothing else of the workbook is
        then read. Default: by the headings.

    Raises
    ------
    InputError
        Not a workbook, a heading, a note or a table that is not understood, or a cell that cannot be used: one
        line with sheet and cell, what is there and what was expected.
    """
    columns = column_map(columns, path)  # before the file, which may be large
    return read(Book(path), columns).system


@dataclass(frozen=True)
class Reading:
    """What is read from a workbook; `given` are the numbers in the cells, in their units, NaN where there is none."""

    layout: Layout
    given: Numbers
    system: PinholeSystem


def read(book: Book, columns: ColumnMap | None = None) -> Reading:
    """The scanner in `book` and where its numbers are; see `read_system`."""
    layout = recognized_layout(book) if columns is None else mapped_layout(book, columns)
    cells = layout.columns
    given = {name: cells[name].numbers() for name in NEEDED}
    values = {name: given[name] * cells[name].factor for name in NEEDED}
    _refuse_impossible(cells, values)
    on_axis = np.hypot(values["x1"], values["y1"]) == 0
    for name, quantity in QUANTITIES.items():
        if name in cells and name not in NEEDED:
            # On the z axis a spreadsheet's ATAN2 shows #DIV/0!, and any azimuth is right.
            ignored = on_axis if name == "azimuth" else None
            given[name] = cells[name].numbers(quantity.role == "derived" or columns is None, ignored)
    defaults = {name: QUANTITIES[name].default(values) for name in OPTIONAL}
    values |= defaults
    for name in OPTIONAL:
        if name in given:
            in_sheet = given[name] * cells[name].factor
            _refuse_not_positive(cells[name], in_sheet)
            values[name] = np.where(np.isnan(in_sheet), defaults[name], in_sheet)
    source = _source(book, layout, columns)
    system = PinholeSystem.from_values(values, np.array(layout.modules.module_numbers), source)
    for doubtful in _doubtful(book, cells, given, defaults, system):
        warn(doubtful)
    return Reading(layout, given, system)


def _doubtful(
    book: Book, columns: dict[str, Column], given: Numbers, defaults: Numbers, system: PinholeSystem
) -> Iterator[str]:
    """What is read but may be wrong, as texts of warnings; `defaults` are the numbers of blank cells, mm."""
    for name in OPTIONAL:
        if name in given and QUANTITIES[name].formula:
            yield from _differences(columns[name], given[name], defaults[name])
    rounding_of_l: NDArray[np.float64] | float = 0.0
    if (column := columns.get("l")) is not None:
        typed = system.collimator_length / column.factor
        rounding_of_l = column.factor * np.array([tolerance(x, x, column.unit) for x in typed])
    yield from _implausible(system, columns)
    for name in DERIVED:
        if name in given:
            slack = rounding_of_l if QUANTITIES[name].depends_on_length else 0.0
            yield from _differences(columns[name], given[name], QUANTITIES[name].of(system), slack)
    for place, why in list(book.unverified.items())[:1]:
        yield (
            f"{book.path.name}: {book.workbook.text(place)}: the stored value is used, though the file asks to be "
            f"calculated when it is opened and the formula cannot be computed here ({why})"
        )


def _source(book: Book, layout: Layout, columns: ColumnMap | None) -> SystemSource:
    from openpyxl.utils import get_column_letter

    modules = layout.modules
    cells = [
        QuantityCells(name, column.table.sheet.name, get_column_letter(column.column), column.rows)
        for name, column in layout.columns.items()
    ]
    if modules.number_column is not None:
        letters = get_column_letter(modules.number_column)
        cells.insert(0, QuantityCells("number", modules.sheet.name, letters, modules.rows))
    return SystemSource(
        path=book.path.absolute(),
        sha256=book.sha256,
        coordinates_sheet=modules.sheet.name,
        dimensions_sheet=layout.columns["d"].table.sheet.name,
        numbers=modules.module_numbers,
        cells=tuple(cells),
        columns=columns,
    )


def _refuse_impossible(columns: dict[str, Column], values: Numbers) -> None:
    """Raise `InputError` if no scanner can have the typed `values`, mm, naming the cell."""
    for name in DIMENSIONS:
        _refuse_not_positive(columns[name], values[name])
    d, side, roi = values["d"], values["Ld"], values["R"]
    columns["d"].refuse(
        d >= side, lambda i: f"has d = {d[i]:g} mm, expected less than Ld = {side[i]:g} mm in {columns['Ld'].place(i)}"
    )
    x1, roi_column = columns["x1"], columns["R"]
    with np.errstate(over="ignore"):
        b = np.sqrt(sum(values[name] ** 2 for name in POSITION))
    puts = [f"and y1, z1 put the pinhole of module {number}" for number in x1.modules.module_numbers]
    x1.refuse(b == 0, lambda i: f"{puts[i]} at the isocentre, expected outside the ROI")
    x1.refuse(np.isinf(b), lambda i: f"{puts[i]} too far away to compute, expected millimetres")
    outside = "mm from the isocentre, expected outside the ROI of"
    x1.refuse(b <= roi, lambda i: f"{puts[i]} {b[i]:g} {outside} {roi[i]:g} mm in {roi_column.place(i)}")
    if (same := same_place(np.stack([values[name] for name in POSITION], axis=1))) is not None:
        j, i = same
        raise InputError(
            f"{x1.where(i)} {puts[i]} at the place of module {x1.modules.module_numbers[j]} ({x1.place(j)}), expected "
            "another place"
        )


def _refuse_not_positive(column: Column, values: NDArray[np.float64]) -> None:
    """Raise `InputError` if a number (M,), mm or rad, is not positive but plausible ones are."""
    quantity = QUANTITIES[column.quantity]
    bad = (values <= 0) & (quantity.plausible[0] > 0)
    column.refuse(bad, lambda i: f"has {quantity.name} = {quantity.text_of(values[i])}, expected more than 0")


def _implausible(system: PinholeSystem, columns: dict[str, Column]) -> Iterator[str]:
    """For each quantity, the first module whose number is unlike that of any scanner."""
    for name, quantity in QUANTITIES.items():
        low, high = quantity.plausible
        if quantity.is_text:
            continue
        values = quantity.of(system)
        column = columns[name if name in columns and quantity.role != "derived" else "x1"]
        odd = np.flatnonzero((values < low) | (values > high))
        if len(odd):
            several = len(set(column.rows)) > 1 and len(odd) > 1
            more = f" (so it is for {len(odd) - 1} more modules)" if several else ""
            yield (
                f"{column.where(int(odd[0]))} makes {name} = {quantity.text_of(values[odd[0]])}{more}, which is unlikely, "
                f"expected {low:g} to {quantity.text_of(high)}: are the units right?"
            )


def _differences(
    column: Column, given: NDArray[np.float64], expected: NDArray[np.float64], slack: NDArray[np.float64] | float = 0.0
) -> Iterator[str]:
    """The first modules whose number `given` (M,) in the sheet, in its unit, is not as `expected` (M,), mm or rad.

    The tolerance is larger by `slack`, mm, for rounding of the numbers behind `expected`.
    """
    name, unit = column.quantity, column.unit
    expected, slack = expected / column.factor, np.broadcast_to(slack, given.shape) / column.factor
    difference = np.abs(given - expected)
    if QUANTITIES[name].kind == "angle":
        turn = 2 * math.pi / column.factor
        difference = np.abs((given - expected + turn / 2) % turn - turn / 2)
    differing = [
        int(i)
        for i in np.flatnonzero(np.isfinite(given))
        if difference[i] > tolerance(given[i], expected[i], unit) + slack[i]
    ]
    used = "the sheet's is used" if name in OPTIONAL else "the formula's is used"
    for n, i in enumerate(differing[:_SHOWN], start=1):
        more = f"; so do {len(differing) - _SHOWN} more cells of this column" if n == _SHOWN < len(differing) else ""
        yield (
            f"{column.where(i)} has {name} = {given[i]:.9g} {unit}, the formula gives {expected[i]:.9g} {unit} "
            f"({used}{more})"
        )
