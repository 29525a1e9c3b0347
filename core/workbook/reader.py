"""`read_system`: a geometry workbook as a `PinholeSystem`."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputWarning
from ..geometry.design_formulas import collimator_length
from ..geometry.system import PinholeSystem
from ..system_source import QuantityCells, SystemSource
from .book import Book
from .column_map import ColumnMap, column_map
from .layout import Column, Layout, mapped_layout
from .plausibility import Numbers, differences, implausible, refuse_impossible, refuse_not_positive
from .quantities import DERIVED, NEEDED, POSITION, QUANTITIES, tolerance
from .recognition import recognized_layout


def read_system(
    path: str | os.PathLike[str], columns: ColumnMap | str | os.PathLike[str] | None = None
) -> PinholeSystem:
    """The scanner in a geometry workbook; `source` names the workbook and the cell of every number.

    Tables are found by their headings, listed in `core.workbook.quantities`, with their units. Anything that is not
    understood for certain is refused; `columns` then says what is meant. The pinhole centres, d, R, Ld and Td are needed,
    a number for each module or one for all. l comes from its column, and where that is blank from `collimator_length`. A
    stored value that is not what its formula gives is refused. Numbers that follow from the others are only checked: one
    that differs by more than 1e-6 (relative, mm or radians) and by more than rounding in its last decimal is an
    `InputWarning`.

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

    Examples
    --------
    >>> system = read_system("examples/dc-spect-80.xlsx")    # doctest: +SKIP
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
    given = {name: layout.columns[name].numbers() for name in NEEDED}
    values = {name: given[name] * layout.columns[name].factor for name in NEEDED}
    refuse_impossible(layout.columns, values)
    on_axis = np.hypot(values["x1"], values["y1"]) == 0
    for name in QUANTITIES:
        if name in layout.columns and name not in NEEDED:
            # On the z axis a spreadsheet's ATAN2 shows #DIV/0!, and any azimuth is right.
            ignored = on_axis if name == "azimuth" else None
            given[name] = layout.columns[name].numbers(name != "l" or columns is None, ignored)
    designed = collimator_length(
        np.sqrt(sum(values[name] ** 2 for name in POSITION)), values["d"], values["Ld"], values["R"]
    )
    length = designed
    if "l" in given:
        in_sheet = given["l"] * layout.columns["l"].factor
        refuse_not_positive(layout.columns["l"], in_sheet)
        length = np.where(np.isnan(in_sheet), designed, in_sheet)
    system = PinholeSystem(
        centers=np.stack([values[name] for name in POSITION], axis=1),
        pinhole_diameter=values["d"],
        collimator_length=length,
        detector_side=values["Ld"],
        detector_thickness=values["Td"],
        roi_radius=values["R"],
        numbers=np.array(layout.modules.module_numbers),
        source=_source(book, layout, columns),
    )
    for doubtful in _doubtful(book, layout.columns, given, system, designed):
        warnings.warn(doubtful, InputWarning, stacklevel=3)
    return Reading(layout, given, system)


def _doubtful(
    book: Book, columns: dict[str, Column], given: Numbers, system: PinholeSystem, designed: NDArray[np.float64]
) -> Iterator[str]:
    """What is read but may be wrong, as texts of warnings; `designed` is the design formula's l (M,)."""
    rounding_of_l: NDArray[np.float64] | float = 0.0
    if "l" in given:
        column = columns["l"]
        yield from differences(column, given["l"], designed)
        typed = system.collimator_length / column.factor
        rounding_of_l = column.factor * np.array([tolerance(x, x, column.unit) for x in typed])
    yield from implausible(system, columns)
    for name in DERIVED:
        if name in given:
            slack = rounding_of_l if QUANTITIES[name].depends_on_length else 0.0
            yield from differences(columns[name], given[name], QUANTITIES[name].of(system), slack)
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
