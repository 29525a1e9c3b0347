"""`write_system`: a `PinholeSystem` into a copy of a geometry workbook, of which nothing else changes."""

from __future__ import annotations

import os
import warnings
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import InputError, InputWarning
from ..files import replacing
from ..geometry.system import PinholeSystem
from ..recording import recorded_warnings
from ..validation import instance
from .book import Book
from .column_map import ColumnMap, column_map
from .edit import Edit, several, values_of
from .new_workbook import new_workbook, numbers_of
from .quantities import DIMENSIONS, POSITION
from .reader import read
from .recalculate import Recalculated, recalculate
from .workbook_xml import KINDS, Place, WorkbookXml


@dataclass(frozen=True)
class WrittenWorkbook:
    """What `write_system` has written.

    Attributes
    ----------
    path : Path
    changed : tuple of str
        The cells (``"Coordinates!B3"``) whose numbers or formulas are not the template's.
    recalculated : dict
        Cell with a formula that depends on these, or stored no value in a sheet that changes -> the value it stores now.
    cleared : tuple of str
        Cells that depend on these and store no value now, because it could not be calculated here.
    columns : ColumnMap or None
        The column map that the new file is read by, its rows being those of the modules now; None where its headings
        are understood.
    """

    path: Path
    changed: tuple[str, ...]
    recalculated: dict[str, str]
    cleared: tuple[str, ...]
    columns: ColumnMap | None = None


def write_system(
    system: PinholeSystem,
    path: str | os.PathLike[str],
    template: str | os.PathLike[str] | None = None,
    columns: ColumnMap | str | os.PathLike[str] | None = None,
) -> WrittenWorkbook:
    """Write a scanner's geometry workbook.

    Into a copy of `template` only what differs is written: its modules are found by their numbers, their cells
    as by `read_system`. Formulas stay as long as they give the system's numbers (to 1e-9, relative). Every formula
    of the workbook that depends on a changed cell stores its new value if `core.workbook.formulas` can calculate it,
    else none, and the workbook is marked to be recalculated when opened. In a sheet that changes, formulas that
    stored no value get theirs too. All other parts of the file - sheets, formats, charts, images, comments, macros -
    are byte for byte the template's; if nothing differs, the whole file is.

    Removed modules leave empty rows, added ones come below the last with copies of its formulas, and modules in
    another order take their rows' contents along.

    Parameters
    ----------
    system
        The scanner. Of a workbook with a column of modules' numbers, these are compared; else their order is.
    path
        The file to write, .xlsx or .xlsm as the template; it may be the template, which is then replaced.
    template
        The workbook to change, read anew. Default: a new one in the users' layout, sheets Main and Coordinates.
    columns
        The template's column map, or the path of one. Default: the one that the system was read by, if it was.

    Returns
    -------
    WrittenWorkbook
        The changed and the recalculated cells.

    Raises
    ------
    InputError
        The template is refused by `read_system` or cannot hold the system, or the file cannot be written. The file
        at `path` is then as it was.

    Warns
    -----
    InputWarning
        Formulas that had to be replaced by numbers or store no value, and ranges that leave added modules out.
    """
    instance(system, PinholeSystem, "write_system")
    target = Path(path)
    suffix = target.suffix.lower()
    if suffix not in KINDS:
        raise InputError(f"{target}: expected a name ending in {' or '.join(KINDS)}")
    if template is None:
        if suffix != ".xlsx":
            raise InputError(f"{target}: a workbook without a template has no macros, expected a name ending in .xlsx")
        workbook = new_workbook(system)
        cells = {(title, *at): cell for title, sheet in workbook.sheets.items() for at, cell in sheet.cells.items()}
        formulas = [place for place, cell in cells.items() if cell.formula is not None]
        required = {place: number for place, number in numbers_of(system).items() if cells[place].formula is not None}
        return _saved(workbook, system, target, recalculate(workbook, formulas, required), [])
    said = column_map(columns, template) if columns is not None else system.source.columns if system.source else None
    book = Book(template)
    workbook = book.workbook
    _refuse_other_kind(workbook, target, suffix)
    with recorded_warnings():  # said when the system was read
        reading = read(book, said)
    edit = Edit(system, reading, workbook)
    edit.apply()
    edited = workbook.changed
    result = recalculate(workbook, edit.changed, edit.required, edit.derived) if edit.changed else Recalculated()
    return _saved(workbook, system, target, result, edited, edit.numbered, edit.written_columns() if said else None)


def _refuse_other_kind(workbook: WorkbookXml, target: Path, suffix: str) -> None:
    kind = workbook.suffix
    if kind is None:
        raise InputError(f"{workbook.name}: is neither an .xlsx nor an .xlsm workbook inside, expected it saved as one")
    if kind != suffix:
        has = "has macros" if kind == ".xlsm" else "is a workbook without macros"
        raise InputError(f"{target}: the template {workbook.name} {has}, expected a name ending in {kind}")


def _saved(
    workbook: WorkbookXml,
    system: PinholeSystem,
    target: Path,
    result: Recalculated,
    edited: list[Place],
    numbered: bool = True,
    columns: ColumnMap | None = None,
) -> WrittenWorkbook:
    _warn_of_formulas(workbook, result)
    content = workbook.to_bytes()
    with replacing(target) as temporary:
        temporary.write_bytes(content)
        _refuse_unlike(temporary, workbook.name, system, numbered, columns)
    texts = [workbook.text(place) for place in dict.fromkeys([*edited, *result.replaced])]
    return WrittenWorkbook(
        path=target.absolute(),
        changed=tuple(texts),
        recalculated={workbook.text(place): by for place, by in sorted(result.by.items())},
        cleared=tuple(workbook.text(place) for place in sorted(result.cleared)),
        columns=columns,
    )


def _refuse_unlike(written: Path, name: str, system: PinholeSystem, numbered: bool, columns: ColumnMap | None) -> None:
    """Refuse a workbook that is not read as `system`: a template may be laid out so that it cannot hold it."""
    with recorded_warnings():
        try:
            reading = read(Book(written), columns)
        except InputError as error:
            why = str(error).replace(str(written), name).replace(written.name, name)
            raise InputError(f"{name} cannot hold this system, with it: {why}") from error
    back = reading.system
    if len(back) != len(system) or (numbered and not np.array_equal(back.numbers, system.numbers)):
        raise InputError(
            f"{name} cannot hold this system: its modules {several(system.numbers)} would be read as "
            f"{several(back.numbers)}"
        )
    for quantity in (*POSITION, *DIMENSIONS, "l"):
        wanted, got = values_of(system, quantity), values_of(back, quantity)
        differing = np.flatnonzero(np.abs(got - wanted) > 2e-9 * np.abs(wanted))
        if len(differing):
            i = int(differing[0])
            column = reading.layout.columns.get(quantity)
            why = f": {column.place(i)} is read for all modules" if column is not None and column.shared else ""
            raise InputError(
                f"{name} cannot hold this system: {quantity} = {wanted[i]:.9g} mm of module {system.numbers[i]} would be "
                f"read as {got[i]:.9g} mm{why}"
            )


def _warn_of_formulas(workbook: WorkbookXml, result: Recalculated) -> None:
    by_column: dict[tuple[str, int], list[Place]] = defaultdict(list)
    for place in sorted(result.replaced):
        by_column[place[0], place[2]].append(place)
    for places in by_column.values():
        warnings.warn(
            f"{workbook.name}: {_cell_and_more(workbook, places)}: the formula was replaced by the system's number "
            f"({result.replaced[places[0]]})",
            InputWarning,
            stacklevel=4,
        )
    if result.cleared:
        places = list(result.cleared)  # causes before effects
        warnings.warn(
            f"{workbook.name}: {_cell_and_more(workbook, places)}: the formula's new value could not be "
            f"calculated ({result.cleared[places[0]]}); opening the workbook in Excel or LibreOffice and saving "
            "it stores the value",
            InputWarning,
            stacklevel=4,
        )


def _cell_and_more(workbook: WorkbookXml, places: list[Place]) -> str:
    return workbook.text(places[0]) + (f" and {len(places) - 1} more" if len(places) > 1 else "")
