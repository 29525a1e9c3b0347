"""Which row of a table each module gets, and the moving, emptying and adding of rows."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

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


class Rows:
    """The rows of a table that has a row for each module, and the rows that the modules of another system get in it.

    `old` has the row of each module of the workbook; `own` and `new` have the rows that the modules of the system have so
    far (None for a new one) and get: their own, if these are in the modules' order. `columns` move with the modules, but
    `shared_columns` do not: they have one value for all in the first row. With `keep_first`, that stays a module's.
    """

    def __init__(
        self, table: Table, old: Sequence[int], own: Sequence[int | None], shared_columns: set[int], keep_first: bool
    ) -> None:
        self.table, self.old, self.own = table, old, own
        last = max((row for row in own if row is not None), default=min(old) - 1)
        below = max(*table.rows, *old)
        free = iter([*(row for row in sorted(old) if row > last), *range(below + 1, below + 1 + list(own).count(None))])
        wanted = [next(free) if row is None else row for row in own]
        if keep_first and min(old) not in wanted:
            wanted[wanted.index(min(wanted))] = min(old)
        # Rows that are not in the order of the coordinates are found by their numbers, and stay.
        in_order = list(old) == sorted(old) and set(own) <= {*old, None}
        self.new = sorted(wanted) if in_order else wanted
        self.columns = [column for column in _columns(table, old) if column not in shared_columns]

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
        emptied = [at for row in held.difference(self.new) for at in self._cells(row)]
        for i, row in enumerate(self.new):
            if self.own[i] == row:
                continue
            for start, at in zip(self._cells(self.source(i)), self._cells(row), strict=True):
                cell = before[start]
                if cell.origin is None:
                    emptied.append(at)
                else:
                    typed_for_another = cell.formula is None and self.own[i] is None
                    sheet.copy(cell.typed(None) if typed_for_another else cell, start, at)
        for at in emptied:
            if not sheet.cell(at).blank:
                sheet.type(at, None)

    def _cells(self, row: int) -> list[tuple[int, int]]:
        return [(row, column) for column in self.columns]

    def _refuse_occupied(self, sheet: SheetXml) -> None:
        last = max(self.old)
        for at in [at for row in self.added for at in self._cells(row)]:
            cell, model = sheet.cell(at), (last, at[1])
            # Formulas filled down beyond the modules are no obstacle.
            filled_down = cell.formula is not None and cell.formula == moved(sheet.cell(model).formula, model, at)
            if not (cell.blank or filled_down):
                raise InputError(
                    f"{self.table.sheet.book.path.name}: {self.table.sheet.place(*at)} is not blank, where an added "
                    f"module's row belongs, expected {len(self.added)} free rows below row {last}"
                )


def _columns(table: Table, rows: Sequence[int]) -> list[int]:
    """The columns that move with the modules' rows.

    Those of the known quantities, those filled in at least half of the rows, and what stands right beside them. A
    summary stays where it is: what stands apart from the table, or beside it with a formula over several rows.
    """
    cells = {at: cell for at, cell in table.sheet.cells.items() if at[0] in set(rows) and not cell.blank}
    filled = Counter(column for _, column in cells)
    own = {column for column, _ in table.columns.values()} | {table.number_column or 0}
    own |= {column for column, count in filled.items() if 2 * count >= len(rows)}
    used = filled.keys() | own
    summing = {at[1] for at, cell in cells.items() if any(a.top < a.bottom for a in areas_in(cell.formula or ""))}
    for step in (-1, 1):
        for column in sorted(own):
            beside = []
            while (column := column + step) in used - own:
                beside.append(column)
            if not summing.intersection(beside):
                own.update(beside)
    return sorted(own - {0})
