"""The values of a scanner put into the cells of a workbook, whose rows move with the modules.

Its formulas are not recalculated yet.
"""

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from ..errors import InputError, several, warn
from ..geometry.scanner import Scanner
from .agreement import EXACT, agree, text_of
from .book import module_number
from .column_map import ColumnMap, MappedColumn
from .formulas import areas_in
from .layout import ColumnCells, Table, absent
from .reader import Reading
from .sheet_xml import MAX_COLUMN, SheetXml, cell_name, moved
from .workbook_xml import Place, WorkbookXml

_SAME = 1e-12
"""NumPy's last digit of the same number may depend on where in memory it lies."""


def matched(system: Scanner, old: Scanner, numbered: bool) -> list[int | None]:
    """The index in `old` of each module of `system`, None for a new one.

    Modules are found by their numbers; renumbered ones by the exact place of their source. If none has moved, or if a
    workbook without numbers cannot tell the new numbers, their order counts.
    """
    places, old_places = ([tuple(row) for row in one.poses()[:, :3, 3].tolist()] for one in (system, old))
    if places == old_places:
        return list(range(len(old)))
    index = {int(number): j for j, number in enumerate(old.numbers)}
    numbers = [int(number) for number in system.numbers]
    if not numbered and not set(numbers) <= set(index):
        return [i if i < len(old) else None for i in range(len(system))]
    found = [index.get(number) for number in numbers]
    at_place = {place: j for j, place in enumerate(old_places) if j not in set(found)}
    return [at_place.get(places[i]) if j is None else j for i, j in enumerate(found)]


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
                expected = f"{len(self.added)} free rows below row {last}"
                where = self.table.sheet.where(*at)
                raise InputError(f"{where} is not blank, where an added module's row belongs, expected {expected}")


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
    """The cells of a workbook changed such that it holds another scanner; `InputError` if it cannot."""

    def __init__(self, system: Scanner, reading: Reading[Scanner], workbook: WorkbookXml) -> None:
        self.system = system
        self.old, self.given, self.layout = reading.system, reading.given, reading.layout
        self.columns, self.modules = self.layout.columns, self.layout.modules
        self.workbook, declared = workbook, system.columns
        self.is_default = {name: declared[name].is_default(system) for name in declared.optional}
        missing = [name for name in declared.optional if name not in self.columns]
        self.added = [name for name in missing if not self.is_default[name].all()]
        self.numbered = self.modules.number_column is not None  # whether the workbook has the modules' numbers
        self.old_of = matched(system, self.old, self.numbered)
        self.required: dict[Place, float | str] = {}
        """Cell -> the number or text that it must hold, typed or by its formula."""
        self.expected: dict[Place, float] = {}
        """Cell of a right formula of H, x2, y2 or z2 -> the number that it should give from now on."""
        self.unsettled: set[Place] = set()
        """The cells of these two that held other values, or none."""
        self._warn_of_unheld_numbers()
        for name in self.added:
            self._add_column(name)
        self.rows = {table: self._rows_after(table, rows) for table, rows in self.layout.rows_of.items()}
        for rows in self.rows.values():
            rows.move(workbook)
        self._number_modules()
        for column in [self.columns[name] for name in declared.typed if name in self.columns]:
            self._require(column)
        for column in [self.columns[name] for name in declared.derived if name in self.columns]:
            self._derive(column)
        for table, rows in self.rows.items():
            name, last = table.sheet.name, max(rows.old)
            own = {workbook.text((name, row, column)) for row in rows.new for column in rows.columns}
            found = [text for text in workbook.ranges_ending_at(name, last) if text not in own] if rows.added else []
            if found:
                ends = f"{several(found)} end{'s' * (len(found) == 1)} at row {last} of sheet {name}"
                warn(f"{workbook.name}: {ends}, so the modules added below are left out there")

    def column_map(self) -> ColumnMap | None:
        """The column map that the workbook was read by, if any, with the rows and columns that it has now."""
        read_by = self.old.source.columns if self.old.source else None
        if read_by is None:
            return None
        tables = []
        for mapped in read_by.tables:
            table = self.columns[mapped.columns[0].quantity].table
            rows = self.rows[table].new if table in self.rows else table.rows
            more = [self.columns[name] for name in self.added if table is self.modules]
            columns = [MappedColumn(c.name, cell_name((1, c.column)).removesuffix("1"), c.unit) for c in more]
            tables.append(replace(mapped.with_rows(sorted(rows)), columns=(*mapped.columns, *columns)))
        return ColumnMap(tuple(tables))

    def _warn_of_unheld_numbers(self) -> None:
        numbers = self.system.numbers
        if not self.numbered and not np.array_equal(numbers, np.arange(1, len(numbers) + 1)):
            without = f"sheet {self.modules.sheet.name} has no column of the modules' numbers"
            read_as = f"{several(numbers)} will be read as 1, 2, ... in the order of their rows"
            warn(f"{self.workbook.name}: {without}: {read_as}", 4)

    def _add_column(self, name: str) -> None:
        """Add a column that the workbook lacks at the right of the modules' sheet, with its headings.

        A length is in the unit of the modules' coordinates there. What has a formula stays refused: the sheet would go on
        calculating with it.
        """
        table, declared, numbers = self.modules, self.system.columns[name], self.system.numbers
        title, sheet = table.sheet.name, self.workbook.sheet(table.sheet.name)
        right = max(self.workbook.extent(title)[1], *(area.right for area in sheet.merged), 0) + 1
        if declared.formula or right > MAX_COLUMN:
            i = int(np.argmin(self.is_default[name]))
            lacks = f"sheet {title} has no column headed {name} for the {declared.title} of module {numbers[i]}"
            value = declared.text_of(declared.values(self.system)[i])
            raise InputError(f"{self.workbook.name}: {lacks}, {value}, which is not {declared.fallback}")
        of_coordinates, usual = self.columns[self.system.columns.leading].unit, next(iter(declared.units))
        unit = of_coordinates if declared.kind == "length" else usual
        table.columns[name] = right, unit
        self.layout.add(table, name, table.rows)
        self.given[name] = np.array(["" if declared.is_text else math.nan] * len(self.old))
        symbol, description = declared.heading(unit)
        heads = (symbol, description) if len(table.heading_rows) == 2 else (description or symbol,)
        for row, text in zip(table.heading_rows, heads, strict=False):
            sheet.type((row, right), text)

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

    def _is_spread(self, column: ColumnCells) -> bool:
        """Whether the modules need different values in place of one cell of a table with one row for all."""
        new = column.declared.values(self.system)
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

    def _rows_of_all(self, column: ColumnCells) -> tuple[int, ...]:
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
                        where = f"{self.workbook.name}: {self.workbook.text(place)}"
                        belong = f"the modules' different numbers in place of {table.sheet.place(first, c)} belong"
                        raise InputError(f"{where} is not blank, where {belong}, expected free cells below that")
                    sheet.copy(model.typed(None), (first, c), (row, c))
                if c == table.number_column:
                    self._demand(place, float(self.system.numbers[i]), None)
        return found

    def _require(self, column: ColumnCells) -> None:
        """Demand the values of a column of the scanner, in the cells' unit."""
        name, sheet, read_by = column.name, self.workbook.sheet(column.table.sheet.name), self.old.source
        new, old = (column.in_cells(column.declared.values(system)).tolist() for system in (self.system, self.old))
        given, blank = self.given[name].tolist(), absent(self.given[name])
        # By a column map, each cell of numbers must be filled.
        is_default = self.is_default.get(name)
        if name in self.added and read_by is not None and read_by.columns is not None:
            is_default = None
        rows, old_of = self.rows.get(column.table), self.old_of
        places: Sequence[int]
        if rows is None and self._is_spread(column):
            places = self._rows_of_all(column)
        elif rows is None or (column.shared and all(value == new[0] for value in new)):
            places, old_of = column.rows[:1], [0]
        else:
            places = rows.new
        for i, row in enumerate(places):
            if is_default is not None and is_default[i] and sheet.cell((row, column.column)).blank:
                was_cell = sheet.original.get((self.rows[column.table].source(i), column.column))
                if was_cell is None or was_cell.blank:
                    continue  # and it is read as the default
            j = old_of[i]
            as_it_was = j is not None and old[j] == new[i] and not blank[j]
            value = given[j] if as_it_was else new[i]
            self._demand((sheet.name, row, column.column), value, None if j is None else old[j])

    def _demand(self, place: Place, value: float | str, was: float | str | None) -> None:
        """Demand a value of a cell, and type it where there is no formula; `was` is the module's value so far."""
        self.required[place] = value
        if was is None or not agree(was, value):
            self.unsettled.add(place)
        cell = self.workbook.cell(place)
        held = cell.value
        if isinstance(value, str):
            held = text_of(held)
        elif type(held) is str:
            held = float(module_number(held) or 0)
        if cell.formula is None and cell.array is None and (type(held) is not type(value) or held != value):
            self.workbook.sheet(place[0]).type(place[1:], value)

    def _derive(self, column: ColumnCells) -> None:
        """Type derived numbers that change, and expect those of H, x2, y2, z2 of formulas that were right.

        The formulas of these four may refer to one cell for all modules where each has its own now, and know of no tilt.
        """
        declared, sheet = column.declared, self.workbook.sheet(column.table.sheet.name)
        new, old = (column.in_cells(declared.values(system)).tolist() for system in (self.system, self.old))
        rows = self.rows[column.table]
        for i, (row, j) in enumerate(zip(rows.new, self.old_of, strict=True)):
            source = rows.source(i)
            was, number = sheet.original.get((source, column.column)), new[i]
            if was is None or (j is not None and math.isclose(old[j], number, rel_tol=_SAME, abs_tol=_SAME)):
                continue
            if was.formula is None and type(was.value) is float:
                sheet.type((row, column.column), number)
            elif was.formula is not None and was.array is None and declared.rounded_with:
                right = old[rows.old.index(source)]
                shown = column.table.sheet.value(source, column.column)
                was_right = type(shown) is float and abs(shown - right) <= EXACT * max(abs(right), 1)
                if was_right and (j is None or not agree(right, number)):
                    self.expected[sheet.name, row, column.column] = number
                    self.unsettled.add((sheet.name, row, column.column))
