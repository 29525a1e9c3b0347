"""`read_system`: a geometry workbook as a `PinholeSystem`."""

from __future__ import annotations

import math
import os
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, InputWarning
from ..geometry.design_formulas import collimator_length
from ..geometry.system import PinholeSystem
from ..system_source import QuantityCells, SystemSource
from .book import Book
from .column_map import ColumnMap, column_map
from .layout import Column, Layout, mapped_layout
from .plausibility import derived, warn_of_differences, warn_of_implausible
from .quantities import DERIVED, DIMENSIONS, NEEDED, POSITION, tolerance
from .recognition import recognized_layout

_COMPUTED = ("b", "l", *DERIVED[1:])
"""Columns that may hold formulas, causes before effects, so that the cause of an error is the cell refused."""
_SAME_PLACE = 1e-6
"""mm; two pinholes nearer than this are one."""


def read_system(
    path: str | os.PathLike[str], columns: ColumnMap | str | os.PathLike[str] | None = None
) -> PinholeSystem:
    """The scanner of a geometry workbook.

    Sheets, heading rows and columns are found by their headings, symbols (x1 y1 z1 l d R Ld Td ...) or descriptions
    ("x coordinate value at center of hole", ...), of which `core.workbook.quantities` has the list, with their units.
    What is not understood for certain is refused; `columns` then says what is meant. The pinhole centres, d, R, Ld and
    Td must be there, a number a module, or one for all modules. l comes from its column, and where that is blank from
    `collimator_length`. Formulas may have stored values or not; a stored value that is not what its formula gives is
    refused. The sheet's other numbers are only checked: one that differs from the formulas by more than 1e-6
    (relative, mm or radians) and by more than rounding in its last decimal is an `InputWarning`.

    Parameters
    ----------
    path
        An .xlsx or .xlsm file, which is only read; it may be open in Excel.
    columns
        Which cells hold which quantity: a `ColumnMap`, or the path of one as TOML. Nothing else of the workbook is
        then read. Default: by the headings.

    Returns
    -------
    PinholeSystem
        Modules in the order of their rows, lengths in mm; `source` names the workbook and the cell of every number.

    Raises
    ------
    InputError
        Not a workbook, a heading, a note or a table that is not understood, or a cell that cannot be used: one
        line with sheet and cell, what is there and what was expected.

    Examples
    --------
    >>> system = read_system("examples/dc-spect-80.xlsx")    # doctest: +SKIP
    >>> len(system), system.collimator_length[0].round(4)    # doctest: +SKIP
    (80, 89.0702)
    """
    columns = column_map(columns, path)  # before the file, which may be large
    return read(Book(path), columns).system


@dataclass(frozen=True)
class Reading:
    """What is read from a workbook.

    Attributes
    ----------
    layout : Layout
    given : dict
        Quantity -> its numbers (M,) as they stand in the cells, in the cells' unit.
    system : PinholeSystem
    """

    layout: Layout
    given: dict[str, NDArray[np.float64]]
    system: PinholeSystem


def read(book: Book, column_map: ColumnMap | None = None) -> Reading:
    """The scanner of `book` and where its numbers stand; see `read_system`."""
    layout = recognized_layout(book) if column_map is None else mapped_layout(book, column_map)
    columns, modules = layout.columns, layout.modules
    given = {name: columns[name].given() for name in NEEDED}
    values = {name: given[name] * columns[name].factor for name in NEEDED}
    _refuse_impossible(columns, values)
    centers = np.stack([values[name] for name in POSITION], axis=1)
    on_axis = np.hypot(values["x1"], values["y1"]) == 0
    for name in _COMPUTED:
        if name in columns:
            # On the z axis a spreadsheet's ATAN2 shows #DIV/0!, and any azimuth is right.
            may_fail = on_axis if name == "azimuth" else None
            named = name == "l" and column_map is not None
            given[name] = columns[name].given() if named else columns[name].given_or_nan(may_fail)
    values["l"] = _collimator_length(columns, values, given)
    for name in (*DIMENSIONS, "l"):
        warn_of_implausible(name, values[name], columns[name if name in columns else "x1"])
    warn_of_implausible("b", np.linalg.norm(centers, axis=1), columns["x1"])
    _check_derived(columns, given, derived(centers, values["l"], values["Td"]), values["l"])
    for place, why in list(book.unverified.items())[:1]:
        warnings.warn(
            f"{book.path.name}: {book.workbook.text(place)}: the stored value is used, though the file asks to be "
            f"calculated when it is opened and the formula cannot be computed here ({why})",
            InputWarning,
            stacklevel=3,
        )
    system = PinholeSystem(
        centers=centers,
        pinhole_diameter=values["d"],
        collimator_length=values["l"],
        detector_side=values["Ld"],
        detector_thickness=values["Td"],
        roi_radius=values["R"],
        numbers=np.array(modules.names),
        source=_source(book, layout, column_map),
    )
    return Reading(layout, given, system)


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
    column = columns["l"]
    l_given = given["l"] * column.factor
    column.refuse(l_given <= 0, lambda i: f"has l = {l_given[i]:g} mm, expected more than 0")
    warn_of_differences(column, given["l"], designed)
    return np.where(np.isnan(l_given), designed, l_given)


def _check_derived(
    columns: dict[str, Column],
    given: dict[str, NDArray[np.float64]],
    expected: dict[str, NDArray[np.float64]],
    l_used: NDArray[np.float64],
) -> None:
    # Where l is typed as displayed, H and x2, y2, z2 may come from all its digits.
    rounding_of_l: NDArray[np.float64] | float = 0.0
    if "l" in given:
        column = columns["l"]
        typed = l_used / column.factor
        rounding_of_l = column.factor * np.array([tolerance(x, x, column.unit) for x in typed])
    on_axis = expected["range"] == 0
    for name in (name for name in _COMPUTED if name in given and name in expected):
        numbers = np.where(on_axis, math.nan, given[name]) if name == "azimuth" else given[name]
        slack = rounding_of_l if name in ("H", "x2", "y2", "z2") else 0.0
        warn_of_differences(columns[name], numbers, expected[name], slack)


def _source(book: Book, layout: Layout, column_map: ColumnMap | None) -> SystemSource:
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
        numbers=modules.names,
        cells=tuple(cells),
        columns=column_map,
    )
