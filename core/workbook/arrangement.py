"""Which row of a table each module is to have, and the moving, emptying and adding of rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..geometry.system import PinholeSystem
from .layout import Table
from .sheet_xml import SheetXml
from .workbook_xml import WorkbookXml, areas_in


def matched(system: PinholeSystem, old: PinholeSystem, numbered: bool) -> list[int | None]:
    """The module of `old` that each of `system` is, None for a new one.

    They go by their numbers; those left over, if renumbered, by the pinhole's exact place. They go by their order
    where all pinholes are where they were, and in a workbook without numbers if the system has other numbers.
    """
    if np.array_equal(system.centers, old.centers):
        return list(range(len(old)))
    index = {int(number): j for j, number in enumerate(old.numbers)}
    numbers = [int(number) for number in system.numbers]
    if not numbered and not set(numbers) <= set(index):
        return [i if i < len(old) else None for i in range(len(system))]
    found = [index.get(number) for number in numbers]
    taken = set(found)
    at_place = {tuple(center): j for j, center in enumerate(old.centers) if j not in taken}
    return [at_place.get(tuple(system.centers[i])) if j is None else j for i, j in enumerate(found)]


@dataclass(frozen=True)
class Arrangement:
    """The rows of a table with a row for each module.

    Attributes
    ----------
    table : Table
    old : tuple of int
        The row of each module of the workbook.
    own : tuple of int or None
        The row that each module of the system has, None for a new one.
    rows : tuple of int
        The row that each module of the system is to have.
    columns : tuple of int
        Those that go with the modules.
    """

    table: Table
    old: tuple[int, ...]
    own: tuple[int | None, ...]
    rows: tuple[int, ...]
    columns: tuple[int, ...]

    @property
    def model(self) -> int:
        """The row that added rows are made after."""
        return max(self.old)

    @property
    def added(self) -> list[int]:
        """The rows that held no module."""
        return [row for row in self.rows if row not in {*self.old, *self.own}]

    def source(self, i: int) -> int:
        """The row that a module's cells come from: its own, or, for a new one, that whose formulas it takes."""
        own, row = self.own[i], self.rows[i]
        if own is not None:
            return own
        return row if row in set(self.old) else self.model

    def apply(self, workbook: WorkbookXml) -> None:
        """Move, empty and add the rows; a new module has formulas, but no typed values yet.

        As when a spreadsheet sorts, relative references of a formula move with its row, and the references of
        others stay.
        """
        sheet = workbook.sheets[self.table.sheet.name]
        self._refuse_occupied(sheet)
        held = {*self.old, *(row for row in self.own if row is not None)}
        before = {row: [sheet.cells.get((row, column)) for column in self.columns] for row in held}
        for row in held.difference(self.rows):
            for column in self.columns:
                self._empty(sheet, (row, column))
        for i, row in enumerate(self.rows):
            source = self.source(i)
            if self.own[i] == row:
                continue
            for column, cell in zip(self.columns, before[source], strict=True):
                at, start = (row, column), (source, column)
                if cell is None:
                    self._empty(sheet, at)
                    continue
                sheet.refuse_array(start)
                sheet.refuse_array(at)
                typed = cell.formula is None
                sheet.copy_row(cell.typed(None) if typed and self.own[i] is None else cell, start, at)

    def _empty(self, sheet: SheetXml, at: tuple[int, int]) -> None:
        if not sheet.cell(at).blank:
            sheet.type(at, None)

    def _refuse_occupied(self, sheet: SheetXml) -> None:
        for row in self.added:
            for column in self.columns:
                cell, model = sheet.cell((row, column)), (self.model, column)
                # Formulas filled down beyond the modules are no obstacle.
                if not cell.blank and (cell.formula is None or cell.formula != sheet.formula_at(model, (row, column))):
                    raise InputError(
                        f"{self.table.sheet.book.path.name}: {self.table.sheet.place(row, column)} is not blank, where "
                        f"an added module's row belongs, expected {len(self.added)} free rows below row {self.model}"
                    )


def arrange(
    table: Table,
    old: Sequence[int],
    own: Sequence[int | None],
    *,
    filled_to: int,
    number_column: int | None,
    kept_columns: Sequence[int],
) -> Arrangement:
    """The rows that the modules are to have in `table`: those they have, if that is their order.

    Parameters
    ----------
    old
        The row of each module of the workbook.
    own
        The row of each module of the system, None for a new one.
    filled_to
        The table's last row.
    number_column
        The column of the modules' numbers.
    kept_columns
        Columns with one value for all modules, in the first row: they don't go with it.
    """
    kept = sorted(row for row in own if row is not None)
    missing = len(own) - len(kept)
    last = max(kept, default=min(old) - 1)
    below = max(filled_to, *old)
    free = [row for row in sorted(old) if row > last] + list(range(below + 1, below + missing + 1))
    added = iter(free)
    wanted = [next(added) if row is None else row for row in own]
    if kept_columns and min(old) not in wanted:
        wanted[wanted.index(min(wanted))] = min(old)
    # Rows in another order than the coordinates' go by their numbers, and stay.
    in_order = list(old) == sorted(old) and set(own) <= {*old, None}
    rows = sorted(wanted) if in_order else wanted
    columns = tuple(column for column in _columns(table, old, number_column) if column not in set(kept_columns))
    return Arrangement(table, tuple(old), tuple(own), tuple(rows), columns)


def _columns(table: Table, rows: Sequence[int], number_column: int | None) -> list[int]:
    """The columns that go with the modules' rows.

    Those of the known quantities, those filled in half of the rows or more, and what stands right beside them. A
    summary stays where it is: what is apart from the table, or beside it with a formula over several rows.
    """
    sheet, wanted = table.sheet, set(rows)
    cells = {at for at, cell in sheet.cells.items() if at[0] in wanted and not cell.blank}
    filled = np.bincount([column for _, column in cells], minlength=1)
    own = {column for column, _ in table.columns.values()} | {number_column or 0}
    own |= {int(column) for column in np.flatnonzero(2 * filled >= len(rows))}
    used = set(np.flatnonzero(filled).tolist()) | own
    formulas = {at: cell.formula for at, cell in sheet.cells.items() if at[0] in wanted and cell.formula is not None}
    summing = {column for (_, column), formula in formulas.items() if _is_over_rows(formula)}
    for step in (-1, 1):
        for column in sorted(own):
            beside = []
            while (column := column + step) in used - own:
                beside.append(column)
            if not summing.intersection(beside):
                own.update(beside)
    return sorted(own - {0})


def _is_over_rows(formula: str) -> bool:
    return any(area.top < area.bottom for area in areas_in(formula))
