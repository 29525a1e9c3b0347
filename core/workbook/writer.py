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
from .edit import Edit, several
from .new_workbook import new_workbook
from .quantities import QUANTITIES, TYPED
from .reader import Reading, read
from .recalculate import Recalculation
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
    if template is None and suffix != ".xlsx":
        raise InputError(f"{target}: a workbook without a template has no macros, expected a name ending in .xlsx")
    said: ColumnMap | None = None
    if template is not None and columns is not None:
        said = column_map(columns, template)
    elif template is not None and system.source is not None:
        said = system.source.columns
    with replacing(target) as temporary:
        if template is None:
            temporary.write_bytes(new_workbook(system))
        book = Book(temporary if template is None else template)
        workbook = book.workbook
        _refuse_other_kind(workbook, target, suffix)
        name = "the new workbook" if template is None else workbook.name
        with recorded_warnings():  # they were given when the system was read
            reading = read(book, said) if template is not None else _read_written(temporary, name, None)
        edit = Edit(system, reading, workbook)
        edited = [] if template is None else workbook.changed
        to_recalculate = workbook.formulas if template is None else edit.changed
        recalculated = Recalculation(workbook, to_recalculate, edit.required, edit.expected)
        _warn_of_formulas(workbook, recalculated)
        temporary.write_bytes(workbook.to_bytes())
        own = edit.column_map(said) if said is not None else None
        _refuse_other_system(_read_written(temporary, name, own), name, system, edit.numbered)
    return WrittenWorkbook(
        path=target.absolute(),
        changed=tuple(workbook.text(place) for place in dict.fromkeys([*edited, *recalculated.replaced])),
        recalculated={workbook.text(place): value for place, value in sorted(recalculated.values.items())},
        cleared=tuple(workbook.text(place) for place in sorted(recalculated.cleared)),
        columns=own,
    )


def _refuse_other_kind(workbook: WorkbookXml, target: Path, suffix: str) -> None:
    kind = workbook.suffix
    if kind is None:
        raise InputError(f"{workbook.name}: is neither an .xlsx nor an .xlsm workbook inside, expected it saved as one")
    if kind != suffix:
        has = "has macros" if kind == ".xlsm" else "is a workbook without macros"
        raise InputError(f"{target}: the template {workbook.name} {has}, expected a name ending in {kind}")


def _read_written(path: Path, name: str, columns: ColumnMap | None) -> Reading:
    """A written workbook as it will be read; messages call it `name`."""
    try:
        with recorded_warnings():
            return read(Book(path), columns)
    except InputError as error:
        why = str(error).replace(str(path), name).replace(path.name, name)
        raise InputError(f"{name} cannot hold this system, with it: {why}") from error


def _refuse_other_system(back: Reading, name: str, system: PinholeSystem, numbered: bool) -> None:
    """Refuse a workbook that would be read as another system: a template may be laid out so that it cannot hold it."""
    if len(back.system) != len(system) or (numbered and not np.array_equal(back.system.numbers, system.numbers)):
        raise InputError(
            f"{name} cannot hold this system: its modules {several(system.numbers)} would be read as "
            f"{several(back.system.numbers)}"
        )
    for quantity in TYPED:
        wanted, got = (QUANTITIES[quantity].of(s) for s in (system, back.system))
        differing = np.flatnonzero(np.abs(got - wanted) > 2e-9 * np.abs(wanted))
        if len(differing):
            i = int(differing[0])
            column = back.layout.columns.get(quantity)
            why = f": {column.place(i)} is read for all modules" if column is not None and column.shared else ""
            raise InputError(
                f"{name} cannot hold this system: {quantity} = {wanted[i]:.9g} mm of module {system.numbers[i]} would be "
                f"read as {got[i]:.9g} mm{why}"
            )


def _warn_of_formulas(workbook: WorkbookXml, recalculated: Recalculation) -> None:
    by_column: dict[tuple[str, int], list[Place]] = defaultdict(list)
    for place in sorted(recalculated.replaced):
        by_column[place[0], place[2]].append(place)
    messages = [
        f"{_and_more(workbook, places)}: the formula was replaced by the system's number "
        f"({recalculated.replaced[places[0]]})"
        for places in by_column.values()
    ]
    if recalculated.cleared:
        places = list(recalculated.cleared)
        messages.append(
            f"{_and_more(workbook, places)}: the formula's new value could not be calculated "
            f"({recalculated.cleared[places[0]]}); opening the workbook in Excel or LibreOffice and saving it stores the "
            "value"
        )
    for message in messages:
        warnings.warn(f"{workbook.name}: {message}", InputWarning, stacklevel=3)


def _and_more(workbook: WorkbookXml, places: list[Place]) -> str:
    return workbook.text(places[0]) + (f" and {len(places) - 1} more" if len(places) > 1 else "")
