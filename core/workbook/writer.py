"""`write_system`: a `PinholeSystem` into a copy of a geometry workbook, of which nothing else changes."""

from __future__ import annotations

import itertools
import os
import warnings
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, InputWarning
from ..files import replacing
from ..system import PinholeSystem
from . import libreoffice
from .arrangement import Arrangement, arrange, matched
from .book import Book
from .cells import module_number
from .checks import derived, is_by_design
from .headings import DIMENSIONS, POSITION, Table
from .new_workbook import new_workbook, numbers_of
from .reader import Reading, read
from .recalculate import Recalculated, agree, recalculate
from .rows import dimension_rows
from .workbook_xml import KINDS, Place, WorkbookXml

_SHOWN = 3
"""Places that one warning names; it counts the rest."""


@dataclass(frozen=True)
class WrittenWorkbook:
    """What `write_system` has written.

    Attributes
    ----------
    path : Path
    changed : tuple of str
        The cells (``"Coordinates!B3"``) whose numbers or formulas are not the template's.
    recalculated : dict
        Cell with a formula that depends on these -> who calculated the value it stores now: "formulas" (mphDRR's
        own evaluator) or "LibreOffice".
    cleared : tuple of str
        Such cells that store no value now, because neither could calculate it.
    """

    path: Path
    changed: tuple[str, ...]
    recalculated: dict[str, str]
    cleared: tuple[str, ...]


def write_system(
    system: PinholeSystem, path: str | os.PathLike[str], template: str | os.PathLike[str] | None = None
) -> WrittenWorkbook:
    """Write a scanner's geometry workbook.

    Into a copy of `template` only what differs is written: its modules are found by their numbers, their cells
    as by `read_system`. Formulas stay as long as they give the system's numbers (to 1e-9, relative). Every formula
    of the workbook that depends on a changed cell stores its new value, calculated by `core.workbook.formulas`
    or else, where it is installed, by LibreOffice; else it stores none, and the workbook is marked to be
    recalculated when opened. All other parts of the file - sheets, formats, charts, images, comments, macros - are
    byte for byte the template's; if nothing differs, the whole file is.

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
        return _saved(workbook, system, target, formulas, required, [])
    book = Book(template)
    workbook = WorkbookXml(book.content, book.path.name)
    _refuse_other_kind(workbook, target, suffix)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)  # said when the system was read
        reading = read(book)
    edit = _Edit(system, reading, workbook)
    edit.apply()
    return _saved(workbook, system, target, edit.changed, edit.required, workbook.changed, edit.numbered)


def _refuse_other_kind(workbook: WorkbookXml, target: Path, suffix: str) -> None:
    kind = workbook.suffix
    if kind is None:
        raise InputError(f"{workbook.name}: is neither an .xlsx nor an .xlsm workbook inside, expected it saved as one")
    if kind != suffix:
        has = "has macros" if kind == ".xlsm" else "is a workbook without macros"
        raise InputError(f"{target}: the template {workbook.name} {has}, expected a name ending in {kind}")


class _Edit:
    """The system's numbers in the cells of a workbook.

    Attributes
    ----------
    changed : list of places
        Cells on which others may depend.
    required : dict
        Place -> the number that it must have.
    numbered : bool
        Whether the workbook has the modules' numbers.
    """

    def __init__(self, system: PinholeSystem, reading: Reading, workbook: WorkbookXml) -> None:
        self.system, self.old, self.workbook = system, reading.system, workbook
        self.columns, self.modules = reading.columns, reading.modules
        self.numbered = reading.modules.number_column is not None
        self.old_of = matched(system, self.old, self.numbered)
        self.required: dict[Place, float] = {}
        self.settled: set[Place] = set()
        self.changed: list[Place] = []

    def apply(self) -> None:
        self._refuse_unheld()
        self.arrangements = self._arranged()
        for arrangement in self.arrangements.values():
            arrangement.apply(self.workbook)
        self._require_numbers()
        for name in (*POSITION, *DIMENSIONS):
            self._require(name)
        if "l" in self.columns:
            self._require_lengths()
        for place, number in self.required.items():
            self._type(place, number)
        self._type_derived()
        formulas = [
            p for p in self.required if self.workbook.cell(p).formula is not None or self.workbook.cell(p).array
        ]
        self.changed = [*self.workbook.changed, *(place for place in formulas if place not in self.settled)]
        for arrangement in self.arrangements.values():
            if arrangement.added:
                self._warn_of_short_ranges(arrangement)

    def _refuse_unheld(self) -> None:
        file, sheet = self.workbook.name, self.modules.table.sheet.name
        numbers = self.system.numbers
        if not self.numbered and not np.array_equal(numbers, np.arange(1, len(numbers) + 1)):
            warnings.warn(
                f"{file}: sheet {sheet} has no column of the modules' numbers: {_several(numbers)} will be read as "
                "1, 2, ... in the order of their rows",
                InputWarning,
                stacklevel=4,
            )
        if "l" not in self.columns:
            differing = np.flatnonzero(~is_by_design(self.system))
            if len(differing):
                i = differing[0]
                raise InputError(
                    f"{file}: sheet {sheet} has no column headed l for the collimator length of module {numbers[i]}, "
                    f"{self.system.collimator_length[i]:g} mm, which is not the design formula's"
                )

    # Rows

    def _arranged(self) -> dict[str, Arrangement]:
        """Sheet -> the rows of its table, of those tables that have a row for each module."""
        modules = self.modules
        found = {}
        last = max(modules.rows)
        table = modules.table
        found[table.sheet.name] = self._arrangement(table, modules.rows, last, modules.number_column, {})
        others = {self.columns[name].table.sheet.name: self.columns[name].table for name in DIMENSIONS}
        for name, table in others.items():
            if name in found:
                continue
            rows = dimension_rows(table)
            row_of = dict(zip(rows.numbers, rows.rows, strict=True)) if rows.numbers is not None else {}
            if row_of and modules.numbers is not None and set(modules.numbers) <= set(row_of):
                old = [row_of[number] for number in modules.numbers]
                found[name] = self._arrangement(table, old, max(rows.rows), rows.number_column, row_of)
            elif len(rows.rows) == len(modules.rows) > 1:
                found[name] = self._arrangement(table, rows.rows, max(rows.rows), rows.number_column, {})
        return found

    def _arrangement(
        self, table: Table, old: Iterable[int], last: int, number_column: int | None, row_of: dict[int, int]
    ) -> Arrangement:
        shared = [
            column.column
            for name, column in self.columns.items()
            if column.table.sheet is table.sheet and self._is_shared(name)
        ]
        old = tuple(old)
        own: list[int | None] = []
        for number, j in zip(self.system.numbers, self.old_of, strict=True):
            row = row_of.get(int(number))  # of a module that had no coordinates
            own.append(old[j] if j is not None else None if row in old else row)
        return arrange(table, old, own, filled_to=last, number_column=number_column, kept_columns=shared)

    def _is_shared(self, name: str) -> bool:
        """Whether one cell holds a quantity of all modules."""
        rows = self.columns[name].rows
        return len(rows) > 1 and len(set(rows)) == 1

    # Numbers

    def _require_numbers(self) -> None:
        for name, arrangement in self.arrangements.items():
            table = arrangement.table
            if table is self.modules.table or self.numbered:
                own = self.modules if table is self.modules.table else dimension_rows(table)
                numbers: Iterable[tuple[int, int]] = enumerate(self.system.numbers)
            else:  # a table whose numbers mean nothing, but must be there
                own = dimension_rows(table)
                added = [i for i, j in enumerate(self.old_of) if j is None]
                numbers = zip(added, itertools.count(max(own.numbers or (0,)) + 1), strict=False)
            if own.number_column is not None:
                for i, number in numbers:
                    place = (name, arrangement.rows[i], own.number_column)
                    self._demand(place, float(number), self._was(i, self.old.numbers))

    def _require(self, name: str) -> None:
        column = self.columns[name]
        sheet = column.table.sheet.name
        values, old = _values(self.system, name), _values(self.old, name)
        arrangement = self.arrangements.get(sheet)
        single = arrangement is None or self._is_shared(name)
        if single and np.all(values == values[0]):
            place = (sheet, column.rows[0], column.column)
            self._demand(place, float(values[0]), float(old[0]))
            return
        rows = arrangement.rows if arrangement is not None else self._new_rows(column.table, column.column)
        for i, row in enumerate(rows):
            self._demand((sheet, row, column.column), float(values[i]), self._was(i, old))

    def _new_rows(self, table: Table, column: int) -> tuple[int, ...]:
        """Rows for all modules in a table that had one for all."""
        rows = dimension_rows(table)
        first = rows.rows[0]
        found = tuple(range(first, first + len(self.system)))
        sheet = self.workbook.sheets[table.sheet.name]
        for i, row in enumerate(found):
            for c in (column, rows.number_column):
                if c is None:
                    continue
                place = (table.sheet.name, row, c)
                if i and not sheet.cell((row, c)).blank and place not in self.required:
                    raise InputError(
                        f"{self.workbook.name}: {self.workbook.text(place)} is not blank, where the modules' different "
                        f"numbers in place of {table.sheet.place(first, c)} belong, expected free cells below that"
                    )
                if i and place not in self.required:
                    sheet.copy_row(sheet.cell((first, c)).typed(None), (first, c), (row, c))
            if rows.number_column is not None:
                self._demand((table.sheet.name, row, rows.number_column), float(self.system.numbers[i]), None)
        return found

    def _require_lengths(self) -> None:
        column = self.columns["l"]
        arrangement = self.arrangements[column.table.sheet.name]
        sheet = self.workbook.sheets[column.table.sheet.name]
        by_design = is_by_design(self.system)
        for i, row in enumerate(arrangement.rows):
            at = (row, column.column)
            was = sheet.original.get((arrangement.source(i), column.column))
            if by_design[i] and sheet.cell(at).blank and (was is None or was.blank):
                continue  # as the reader takes a blank
            place = (column.table.sheet.name, *at)
            self._demand(place, float(self.system.collimator_length[i]), self._was(i, self.old.collimator_length))

    def _was(self, i: int, old: NDArray) -> float | None:
        """The number that was read of a module of the system; None of a new one."""
        j = self.old_of[i]
        return None if j is None else float(old[j])

    def _demand(self, place: Place, number: float, was: float | None) -> None:
        self.required[place] = number
        if was is not None and agree(float(was), number):
            self.settled.add(place)

    def _type(self, place: Place, number: float) -> None:
        cell = self.workbook.cell(place)
        if cell.formula is not None or cell.array is not None:
            return
        is_number = place[2] in self._number_columns(place[0])
        same = module_number(cell.value) == number if is_number else type(cell.value) is float and cell.value == number
        if not same:
            self.workbook.sheets[place[0]].type(place[1:], float(number))

    def _number_columns(self, sheet: str) -> set[int]:
        own = self.modules
        tables = [self.columns[name].table for name in DIMENSIONS if self.columns[name].table.sheet.name == sheet]
        found = {dimension_rows(table).number_column for table in tables if table is not own.table}
        if own.table.sheet.name == sheet:
            found.add(own.number_column)
        return found - {None}  # type: ignore[return-value]

    def _type_derived(self) -> None:
        """Derived numbers (b, H, x2, ..., azimuth) that are typed in: as the formulas give them, where that changed."""
        old, new = (derived(s.centers, s.collimator_length, s.detector_thickness) for s in (self.old, self.system))
        for name in new:
            if name not in self.columns:
                continue
            column = self.columns[name]
            title = column.table.sheet.name
            sheet, arrangement = self.workbook.sheets[title], self.arrangements[title]
            scale = 180 / np.pi if column.table.in_degrees(name) else 1.0
            for i, row in enumerate(arrangement.rows):
                was = sheet.original.get((arrangement.source(i), column.column))
                if was is None or was.formula is not None or type(was.value) is not float:
                    continue
                j = self.old_of[i]
                if j is None or old[name][j] != new[name][i]:
                    sheet.type((row, column.column), float(new[name][i] * scale))

    def _warn_of_short_ranges(self, arrangement: Arrangement) -> None:
        name, old = arrangement.table.sheet.name, arrangement.old
        found = self.workbook.ranges_ending_at(name, min(old), max(old))
        own = {self.workbook.text((name, row, column)) for row in arrangement.rows for column in arrangement.columns}
        found = [place for place in found if place not in own]
        if found:
            warnings.warn(
                f"{self.workbook.name}: {_several(found)} end at row {max(old)} of sheet {name}, so the modules added "
                "below are left out there",
                InputWarning,
                stacklevel=4,
            )


def _saved(
    workbook: WorkbookXml,
    system: PinholeSystem,
    target: Path,
    changed: list[Place],
    required: dict[Place, float],
    edited: list[Place],
    numbered: bool = True,
) -> WrittenWorkbook:
    result = recalculate(workbook, changed, required) if changed else Recalculated()
    _warn_of_formulas(workbook, result)
    content = workbook.to_bytes()
    with replacing(target) as temporary:
        temporary.write_bytes(content)
        _refuse_unlike(temporary, workbook.name, system, numbered)
    texts = [workbook.text(place) for place in dict.fromkeys([*edited, *result.replaced])]
    return WrittenWorkbook(
        path=target.absolute(),
        changed=tuple(texts),
        recalculated={workbook.text(place): by for place, by in sorted(result.by.items())},
        cleared=tuple(workbook.text(place) for place in sorted(result.cleared)),
    )


def _refuse_unlike(written: Path, name: str, system: PinholeSystem, numbered: bool) -> None:
    """Refuse a workbook that is not read as `system`: a template may be laid out so that it cannot hold it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        try:
            back = read(Book(written)).system
        except InputError as error:
            why = str(error).replace(str(written), name).replace(written.name, name)
            raise InputError(f"{name} cannot hold this system, with it: {why}") from error
    if len(back) != len(system) or (numbered and not np.array_equal(back.numbers, system.numbers)):
        raise InputError(
            f"{name} cannot hold this system: its modules {_several(system.numbers)} would be read as "
            f"{_several(back.numbers)}"
        )
    for quantity in (*POSITION, *DIMENSIONS, "l"):
        wanted, got = _values(system, quantity), _values(back, quantity)
        differing = np.flatnonzero(np.abs(got - wanted) > 2e-9 * np.abs(wanted))
        if len(differing):
            i = differing[0]
            raise InputError(
                f"{name} cannot hold this system: {quantity} = {wanted[i]:.9g} mm of module {system.numbers[i]} would be "
                f"read as {got[i]:.9g} mm"
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
        missing = "" if libreoffice.program() else "; LibreOffice, which may know it, is not installed"
        warnings.warn(
            f"{workbook.name}: {_cell_and_more(workbook, places)}: the formula's new value could not be "
            f"calculated ({result.cleared[places[0]]}{missing}); opening the workbook in Excel or LibreOffice and saving "
            "it stores the value",
            InputWarning,
            stacklevel=4,
        )


def _cell_and_more(workbook: WorkbookXml, places: list[Place]) -> str:
    return workbook.text(places[0]) + (f" and {len(places) - 1} more" if len(places) > 1 else "")


def _several(things: Iterable[object]) -> str:
    texts = [str(thing) for thing in things]
    more = f" and {len(texts) - _SHOWN} more" if len(texts) > _SHOWN else ""
    return ", ".join(texts[:_SHOWN]) + more


def _values(system: PinholeSystem, quantity: str) -> NDArray[np.float64]:
    if quantity in POSITION:
        return system.centers[:, POSITION.index(quantity)]
    return {
        "d": system.pinhole_diameter,
        "R": system.roi_radius,
        "Ld": system.detector_side,
        "Td": system.detector_thickness,
        "l": system.collimator_length,
    }[quantity]
