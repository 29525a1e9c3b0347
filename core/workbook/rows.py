"""Which row of a table each module gets, and the moving, emptying and adding of rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..geometry.system import PinholeSystem
from .formulas import areas_in
from .layout import Table
from .sheet_xml import SheetXml, moved
from .workbook_xml import WorkbookXml


def matched(system: PinholeSystem, old: PinholeSystem, numbered: bool) -> list[int | None]:
    """The index in `old` of each module of `system`, None for a new one.

    Modules are found by their numbers; renumbered ones by the exact position of their pinholes. If no pinhole has moved,
    or if a workbook without numbers cannot tell the new numbers, their order counts.
    """
    if np.array_equal(system.centers, old.centers):
        return list(range(len(old)))
    index = {int(number): j for j, number in enumerate(old.numbers)}
    numbers = [int(number) for number in system.numbers]
    if not numbered and not set(numbers) <= set(index):
        return [i if i < len(old) else None for i in range(len(system))]
    found = [index.get(number) for number in numbers]
    taken = set(found)
    at_position = {tuple(center): j for j, center in enumerate(old.centers) if j not in taken}
    return [at_position.get(tuple(system.centers[i])) if j is None else j for i, j in enumerate(found)]


@dataclass(frozen=True)
class Rows:
    """The rows of a table that has a row for each module.

    Attributes
    ----------
    table : Table
    old : tuple of int
        The row of each module of the workbook.
    own : tuple of int or None
        The row that each module of the system has so far, None for a new one.
    new : tuple of int
        The row that each module of the system gets.
    columns : tuple of int
        Those that move with the modules.
    """

    table: Table
    old: tuple[int, ...]
    own: tuple[int | None, ...]
    new: tuple[int, ...]
    columns: tuple[int, ...]

    @property
    def added(self) -> list[int]:
        """The rows that held no module."""
        return [row for row in self.new if row not in {*self.old, *self.own}]

    def source(self, i: int) -> int:
        """The row that a module's cells come from: its own, or for a new module the row whose formulas it copies."""
        own, new = self.own[i], self.new[i]
        if own is not None:
            return own
        return new if new in self.old else max(self.old)

    def move(self, workbook: WorkbookXml) -> None:
        """Move, empty and add the rows; a new module gets formulas, but no typed values yet.

        As when a spreadsheet sorts, the relative references of a formula move with its row, and references to the row
        from elsewhere stay.
        """
        sheet = workbook.sheet(self.table.sheet.name)
        self._refuse_occupied(sheet)
        held = {*self.old, *(row for row in self.own if row is not None)}
        before = {at: sheet.cell(at) for row in held for at in self._cells(row)}
        for row in held.difference(self.new):
            for at in self._cells(row):
                _empty(sheet, at)
        for i, row in enumerate(self.new):
            source = self.source(i)
            if self.own[i] == row:
                continue
            for start, at in zip(self._cells(source), self._cells(row), strict=True):
                cell = before[start]
                if cell.origin is None:
                    _empty(sheet, at)
                else:
                    typed_for_another = cell.formula is None and self.own[i] is None
                    sheet.copy(cell.typed(None) if typed_for_another else cell, start, at)

    def _cells(self, row: int) -> list[tuple[int, int]]:
        return [(row, column) for column in self.columns]

    def _refuse_occupied(self, sheet: SheetXml) -> None:
        last = max(self.old)
        for row in self.added:
            for at in self._cells(row):
                cell, model = sheet.cell(at), (last, at[1])
                # Formulas filled down beyond the modules are no obstacle.
                if not cell.blank and (
                    cell.formula is None or cell.formula != moved(sheet.cell(model).formula, model, at)
                ):
                    raise InputError(
                        f"{self.table.sheet.book.path.name}: {self.table.sheet.place(*at)} is not blank, where an added "
                        f"module's row belongs, expected {len(self.added)} free rows below row {last}"
                    )


def rows_after(
    table: Table,
    old: Sequence[int],
    own: Sequence[int | None],
    number_column: int | None,
    shared_columns: set[int],
    keep_first: bool,
) -> Rows:
    """The rows that the system's modules get in `table`: those that they have, if these are in the modules' order.

    Parameters
    ----------
    old
        The row of each module of the workbook.
    own
        The row of each module of the system, None for a new one.
    number_column
        The column of the modules' numbers.
    shared_columns
        Columns with one value for all modules, which stays in the first row.
    keep_first
        Whether the first row must remain a module's.
    """
    last = max((row for row in own if row is not None), default=min(old) - 1)
    below = max(*table.rows, *old)
    free = iter([*(row for row in sorted(old) if row > last), *range(below + 1, below + 1 + list(own).count(None))])
    wanted = [next(free) if row is None else row for row in own]
    if keep_first and min(old) not in wanted:
        wanted[wanted.index(min(wanted))] = min(old)
    # Rows that are not in the order of the coordinates are found by their numbers, and stay.
    in_order = list(old) == sorted(old) and set(own) <= {*old, None}
    new = sorted(wanted) if in_order else wanted
    columns = [column for column in _columns(table, old, number_column) if column not in shared_columns]
    return Rows(table, tuple(old), tuple(own), tuple(new), tuple(columns))


def _columns(table: Table, rows: Sequence[int], number_column: int | None) -> list[int]:
    """The columns that move with the modules' rows.

    Those of the known quantities, those filled in at least half of the rows, and what stands right beside them. A
    summary stays where it is: what stands apart from the table, or beside it with a formula over several rows.
    """
    cells = {at: cell for at, cell in table.sheet.cells.items() if at[0] in set(rows) and not cell.blank}
    filled = np.bincount([column for _, column in cells], minlength=1)
    own = {column for column, _ in table.columns.values()} | {number_column or 0}
    own |= {int(column) for column in np.flatnonzero(2 * filled >= len(rows))}
    used = set(np.flatnonzero(filled).tolist()) | own
    summing = {at[1] for at, cell in cells.items() if any(a.top < a.bottom for a in areas_in(cell.formula or ""))}
    for step in (-1, 1):
        for column in sorted(own):
            beside = []
            while (column := column + step) in used - own:
                beside.append(column)
            if not summing.intersection(beside):
                own.update(beside)
    return sorted(own - {0})


def _empty(sheet: SheetXml, at: tuple[int, int]) -> None:
    if not sheet.cell(at).blank:
        sheet.type(at, None)
