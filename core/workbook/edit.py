"""The numbers of a system put into the cells of a workbook, whose rows move with the modules.

Its formulas are not recalculated yet.
"""

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np

from ..errors import InputError, warn
from ..geometry.system import PinholeSystem
from .book import module_number
from .column_map import ColumnMap
from .formulas import areas_in
from .layout import Column, Table
from .quantities import DERIVED, EXACT, OPTIONAL, QUANTITIES, TYPED, agree
from .reader import Reading
from .sheet_xml import SheetXml, moved
from .workbook_xml import Place, WorkbookXml

_SAME = 1e-12
"""NumPy's last digit of the same number may depend on where in memory it lies."""


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


class Edit:
    """The cells of a workbook changed such that it holds another system; `InputError` if it cannot."""

    def __init__(self, system: PinholeSystem, reading: Reading, workbook: WorkbookXml) -> None:
        self.system = system
        self.old, self.given, self.layout = reading.system, reading.given, reading.layout
        self.columns, self.modules = self.layout.columns, self.layout.modules
        self.workbook = workbook
        self.is_default = {name: QUANTITIES[name].is_default(system) for name in OPTIONAL}
        self.numbered = self.modules.number_column is not None  # whether the workbook has the modules' numbers
        self.old_of = matched(system, self.old, self.numbered)
        self.required: dict[Place, float] = {}
        """Cell -> the number that it must hold, typed or by its formula."""
        self.expected: dict[Place, float] = {}
        """Cell of a right formula of H, x2, y2 or z2 -> the number that it should give from now on."""
        self.unsettled: set[Place] = set()
        """The cells of these two that held other numbers, or none."""
        self._refuse_unheld()
        self.rows = {table: self._rows_after(table, rows) for table, rows in self.layout.rows_of.items()}
        for rows in self.rows.values():
            rows.move(workbook)
        self._number_modules()
        for name in TYPED:
            if name in self.columns:
                self._require(self.columns[name])
        for name in DERIVED:
            if name in self.columns:
                self._derive(self.columns[name])
        for table, rows in self.rows.items():
            name, last = table.sheet.name, max(rows.old)
            own = {workbook.text((name, row, column)) for row in rows.new for column in rows.columns}
            found = [text for text in workbook.ranges_ending_at(name, last) if text not in own] if rows.added else []
            if found:
                warn(
                    f"{workbook.name}: {several(found)} end{'s' * (len(found) == 1)} at row {last} of sheet {name}, so the "
                    "modules added below are left out there"
                )

    def column_map(self) -> ColumnMap | None:
        """The column map that the workbook was read by, if any, with the rows that the modules have now."""
        read_by = self.old.source.columns if self.old.source else None
        if read_by is None:
            return None
        tables = [self.columns[said.columns[0].quantity].table for said in read_by.tables]
        rows = [sorted(self.rows[table].new if table in self.rows else table.rows) for table in tables]
        return ColumnMap(tuple(said.with_rows(its) for said, its in zip(read_by.tables, rows, strict=True)))

    def _refuse_unheld(self) -> None:
        file, sheet = self.workbook.name, self.modules.sheet.name
        numbers = self.system.numbers
        if not self.numbered and not np.array_equal(numbers, np.arange(1, len(numbers) + 1)):
            warn(
                f"{file}: sheet {sheet} has no column of the modules' numbers: {several(numbers)} will be read as "
                "1, 2, ... in the order of their rows",
                4,
            )
        for name, is_default in self.is_default.items():
            if name not in self.columns and not is_default.all():
                i, quantity = np.argmin(is_default), QUANTITIES[name]
                raise InputError(
                    f"{file}: sheet {sheet} has no column headed {name} for the {quantity.title} of module {numbers[i]}, "
                    f"{quantity.text_of(quantity.of(self.system)[i])}, which is not {quantity.blank_is}"
                )

    def _rows_after(self, table: Table, old: tuple[int, ...]) -> Rows:
        shared = {c.column for c in self.columns.values() if c.table.sheet is table.sheet and c.shared}
        row_of = {} if table is self.modules else dict(zip(table.labels or (), table.rows, strict=False))
        own: list[int | None] = []
        for number, j in zip(self.system.numbers, self.old_of, strict=True):
            row = row_of.get(int(number)) if self.numbered else None  # of a module that had no coordinates
            own.append(old[j] if j is not None else None if row in old else row)
        # Without numbers, rows of several sheets belong together by their distance from the first.
        spread = not self.numbered and any(self._is_spread(column) for column in self.columns.values())
        return Rows(table, old, own, shared, keep_first=bool(shared) or spread)

    def _is_spread(self, column: Column) -> bool:
        """Whether the modules need different numbers in place of one cell of a table with one row for all."""
        new = QUANTITIES[column.quantity].of(self.system)
        return column.table not in self.layout.rows_of and bool(np.any(new != new[0]))

    def _number_modules(self) -> None:
        for table, rows in self.rows.items():
            if table is self.modules or self.numbered:
                numbers: Iterable[tuple[int, int]] = enumerate(self.system.numbers)
            else:  # numbers that mean nothing, but must be there
                added = [i for i, j in enumerate(self.old_of) if j is None]
                numbers = zip(added, itertools.count(max(table.numbers or (0,)) + 1), strict=False)
            if table.number_column is not None:
                for i, number in numbers:
                    j = self.old_of[i]
                    was = None if j is None else float(self.old.numbers[j])
                    self._demand((table.sheet.name, rows.new[i], table.number_column), float(number), was)

    def _rows_of_all(self, column: Column) -> tuple[int, ...]:
        """Rows for all modules in a table that had one row for all; without numbers, as far apart as the coordinates'."""
        sheet, table, first = self.workbook.sheet(column.table.sheet.name), column.table, column.table.rows[0]
        coordinates = self.rows[self.modules].new
        found = tuple(first + (i if self.numbered else row - coordinates[0]) for i, row in enumerate(coordinates))
        for c in (column.column, table.number_column):
            if c is None:
                continue
            model = sheet.original[first, c]
            for i, row in enumerate(found):
                place = (sheet.name, row, c)
                if row != first and place not in self.required:
                    if not sheet.cell((row, c)).blank:
                        raise InputError(
                            f"{self.workbook.name}: {self.workbook.text(place)} is not blank, where the modules' different "
                            f"numbers in place of {table.sheet.place(first, c)} belong, expected free cells below that"
                        )
                    sheet.copy(model.typed(None), (first, c), (row, c))
                if c == table.number_column:
                    self._demand(place, float(self.system.numbers[i]), None)
        return found

    def _require(self, column: Column) -> None:
        """Demand the numbers of a quantity, in the column's unit."""
        name, sheet = column.quantity, self.workbook.sheet(column.table.sheet.name)
        new, old = (QUANTITIES[name].of(system) for system in (self.system, self.old))
        rows, old_of = self.rows.get(column.table), self.old_of
        places: Sequence[int]
        if rows is None and self._is_spread(column):
            places = self._rows_of_all(column)
        elif rows is None or (column.shared and np.all(new == new[0])):
            places, old_of = column.rows[:1], [0]
        else:
            places = rows.new
        for i, row in enumerate(places):
            if name in OPTIONAL and self.is_default[name][i] and sheet.cell((row, column.column)).blank:
                was_cell = sheet.original.get((self.rows[column.table].source(i), column.column))
                if was_cell is None or was_cell.blank:
                    continue  # and it is read as the default
            j = old_of[i]
            number, was = float(new[i] / column.factor), None if j is None else float(old[j] / column.factor)
            if j is not None and old[j] == new[i] and not math.isnan(self.given[name][j]):
                number = float(self.given[name][j])
            self._demand((sheet.name, row, column.column), number, was)

    def _demand(self, place: Place, number: float, was: float | None) -> None:
        """Demand a number of a cell, and type it where there is no formula; `was` is the module's number so far."""
        self.required[place] = number
        if was is None or not agree(was, number):
            self.unsettled.add(place)
        cell = self.workbook.cell(place)
        held = float(module_number(cell.value) or 0) if type(cell.value) is str else cell.value
        if cell.formula is None and cell.array is None and (type(held) is not float or held != number):
            self.workbook.sheet(place[0]).type(place[1:], number)

    def _derive(self, column: Column) -> None:
        """Type derived numbers that change, and expect those of H, x2, y2, z2 of formulas that were right.

        The formulas of these four may refer to one cell for all modules where each has its own now.
        """
        quantity, sheet = QUANTITIES[column.quantity], self.workbook.sheet(column.table.sheet.name)
        new, old = (quantity.of(system) / column.factor for system in (self.system, self.old))
        rows = self.rows[column.table]
        for i, (row, j) in enumerate(zip(rows.new, self.old_of, strict=True)):
            source = rows.source(i)
            was, number = sheet.original.get((source, column.column)), float(new[i])
            if was is None or (j is not None and math.isclose(old[j], number, rel_tol=_SAME, abs_tol=_SAME)):
                continue
            if was.formula is None and type(was.value) is float:
                sheet.type((row, column.column), number)
            elif was.formula is not None and was.array is None and quantity.depends_on_length:
                right = float(old[rows.old.index(source)])
                shown = column.table.sheet.value(source, column.column)
                was_right = type(shown) is float and abs(shown - right) <= EXACT * max(abs(right), 1)
                if was_right and (j is None or not agree(right, number)):
                    self.expected[sheet.name, row, column.column] = number
                    self.unsettled.add((sheet.name, row, column.column))


def several(things: Iterable[object], shown: int = 3) -> str:
    """The first few, and how many more."""
    texts = [str(thing) for thing in things]
    return ", ".join(texts[:shown]) + (f" and {len(texts) - shown} more" if len(texts) > shown else "")
