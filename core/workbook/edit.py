"""Edit of a workbook's cells such that they hold another scanner; the rows of the table move with the modules.

The formulas are not recalculated here.
"""

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from ..errors import InputError, several, warn
from ..geometry.scanner import Scanner
from .agreement import EXACT, agree, cell_text
from .book import parse_module_number
from .column_map import ColumnMap, MappedColumn
from .formulas import referenced_areas
from .layout import ColumnCells, ModuleTable, is_absent
from .reader import WorkbookReading
from .sheet_xml import MAX_COLUMN, Position, SheetXml, cell_name, translate_formula
from .workbook_xml import Address, WorkbookXml

_SAME = 1e-12
"""Largest difference, relative and absolute, of equal numbers: NumPy's last digit may depend on the place in memory."""


def match_modules(system: Scanner, old: Scanner, numbered: bool) -> list[int | None]:
    """Return the index in `old` of each module of `system`, None for a new one.

    Modules are found by their numbers; a module whose number is new, by the exact position of its source. If no source has
    moved, the order decides; so it does if a workbook that is not `numbered` cannot hold the new numbers.
    """
    positions, old_positions = ([tuple(row) for row in scanner.poses()[:, :3, 3].tolist()] for scanner in (system, old))
    if positions == old_positions:
        return list(range(len(old)))
    index = {int(number): j for j, number in enumerate(old.numbers)}
    numbers = [int(number) for number in system.numbers]
    if not numbered and not set(numbers) <= set(index):
        return [i if i < len(old) else None for i in range(len(system))]
    by_number = [index.get(number) for number in numbers]
    by_position = {position: j for j, position in enumerate(old_positions) if j not in set(by_number)}
    return [by_position.get(positions[i]) if j is None else j for i, j in enumerate(by_number)]


class ModuleRows:
    """Rows of the modules in a table with a row for each module, before and after an edit.

    `old` has the row of each module of the workbook. `current` has the present row of each module of the edited system, None
    for a new module; `new` has the row that each module gets: its present one, if these are in the modules' order. The
    contents of `columns` move with the modules; columns in `shared`, which have one value for all in the first row, do
    not. With `keep_first`, the table's first row stays a module's.
    """

    def __init__(
        self, table: ModuleTable, old: Sequence[int], current: Sequence[int | None], shared: set[int], keep_first: bool
    ) -> None:
        self.table, self.old, self.current = table, old, current
        last = max((row for row in current if row is not None), default=min(old) - 1)
        below = max(*table.rows, *old)
        free = itertools.chain((row for row in sorted(old) if row > last), itertools.count(below + 1))
        new = [next(free) if row is None else row for row in current]
        if keep_first and min(old) not in new:
            new[new.index(min(new))] = min(old)
        # Rows that are not in the order of the coordinates are found by their numbers, and stay.
        are_sorted = list(old) == sorted(old) and set(current) <= {*old, None}
        self.new = sorted(new) if are_sorted else new
        self.columns = [column for column in _find_moving_columns(table, old) if column not in shared]

    @property
    def added(self) -> list[int]:
        """Rows that held no module and get one."""
        return [row for row in self.new if row not in {*self.old, *self.current}]

    def source_row(self, i: int) -> int:
        """Return the row that the cells of module `i` come from; a new module copies the formulas of another row."""
        current, new = self.current[i], self.new[i]
        if current is not None:
            return current
        return new if new in self.old else max(self.old)

    def move(self, workbook: WorkbookXml) -> None:
        """Move, empty and add the rows in the workbook; a new module gets formulas, but no typed values yet.

        As when a spreadsheet sorts, the relative references of a formula move with its row, and references to the row
        from elsewhere stay.
        """
        sheet = workbook.sheet(self.table.sheet.name)
        self._refuse_occupied(sheet)
        module_rows = {*self.old, *(row for row in self.current if row is not None)}
        original = {position: sheet.cell(position) for row in module_rows for position in self._positions(row)}
        emptied = [position for row in module_rows.difference(self.new) for position in self._positions(row)]
        for i, row in enumerate(self.new):
            if self.current[i] == row:
                continue
            for start, target in zip(self._positions(self.source_row(i)), self._positions(row), strict=True):
                cell = original[start]
                if cell.origin is None:
                    emptied.append(target)
                else:
                    is_others_value = cell.formula is None and self.current[i] is None
                    sheet.copy_cell(cell.with_value(None) if is_others_value else cell, start, target)
        for position in emptied:
            if not sheet.cell(position).blank:
                sheet.set_value(position, None)

    def _positions(self, row: int) -> list[Position]:
        """Return the positions of a row's cells that move."""
        return [(row, column) for column in self.columns]

    def _refuse_occupied(self, sheet: SheetXml) -> None:
        """Raise `InputError` if a cell of an added row has content."""
        last = max(self.old)
        for position in [position for row in self.added for position in self._positions(row)]:
            cell, model = sheet.cell(position), (last, position[1])
            # Formulas filled down beyond the modules are no obstacle.
            formula = sheet.cell(model).formula
            is_filled_down = cell.formula is not None and cell.formula == translate_formula(formula, model, position)
            if not (cell.blank or is_filled_down):
                expected = f"{len(self.added)} free rows below row {last}"
                location = self.table.sheet.location(*position)
                raise InputError(f"{location} is not blank, where an added module's row belongs, expected {expected}")


def _find_moving_columns(table: ModuleTable, rows: Sequence[int]) -> list[int]:
    """Return the columns whose cells in the modules' rows move with the modules.

    These are the columns of the scanner, those filled in at least half of the rows, and the columns right beside them. A
    summary stays where it is: content apart from the table, or beside it with a formula over several rows.
    """
    cells = {p: cell for p, cell in table.sheet.cells.items() if p[0] in set(rows) and not cell.blank}
    filled = Counter(column for _, column in cells)
    moving = {column for column, _ in table.columns.values()} | {table.number_column or 0}
    moving |= {column for column, count in filled.items() if 2 * count >= len(rows)}
    used = filled.keys() | moving
    summing = {p[1] for p, cell in cells.items() if any(a.top < a.bottom for a in referenced_areas(cell.formula or ""))}
    for step in (-1, 1):
        for column in sorted(moving):
            beside = []
            while (column := column + step) in used - moving:
                beside.append(column)
            if not summing.intersection(beside):
                moving.update(beside)
    return sorted(moving - {0})


class WorkbookEdit:
    """Edit of a workbook such that its cells hold another scanner.

    `reading` is what the workbook holds so far; the cells of `workbook` are changed. Raises `InputError` if the workbook
    cannot hold the scanner.
    """

    def __init__(self, system: Scanner, reading: WorkbookReading[Scanner], workbook: WorkbookXml) -> None:
        self.system = system
        self.old, self.cell_values, self.layout = reading.system, reading.cell_values, reading.layout
        self.columns, self.modules = self.layout.columns, self.layout.modules
        self.workbook, definitions = workbook, system.columns
        self.is_default = {name: definitions[name].is_default(system) for name in definitions.optional}
        """Name of an optional column -> whether each module has the value of a blank cell (M,)."""
        missing = [name for name in definitions.optional if name not in self.columns]
        self.added = [name for name in missing if not self.is_default[name].all()]
        """Names of the scanner's columns that the workbook lacks and gets."""
        self.numbered = self.modules.number_column is not None
        """Whether the workbook has the modules' numbers."""
        self.old_index = match_modules(system, self.old, self.numbered)
        """Index of each module in the workbook's scanner, None for a new module."""
        self.required: dict[Address, float | str] = {}
        """Cell -> the number or text that it must hold, typed or by its formula."""
        self.expected: dict[Address, float] = {}
        """Cell of a right formula of H, x2, y2 or z2 -> the number that it should give from now on."""
        self.unsettled: set[Address] = set()
        """Cells of `required` and `expected` that held other values, or none."""
        self._warn_of_lost_numbers()
        for name in self.added:
            self._add_column(name)
        self.rows = {table: self._module_rows(table, rows) for table, rows in self.layout.rows_of.items()}
        """Table with a row for each module -> the rows of the modules before and after the edit."""
        for rows in self.rows.values():
            rows.move(workbook)
        self._number_modules()
        for column in [self.columns[name] for name in definitions.typed if name in self.columns]:
            self._require_values(column)
        for column in [self.columns[name] for name in definitions.derived if name in self.columns]:
            self._update_derived(column)
        for table, rows in self.rows.items():
            self._warn_of_short_ranges(table, rows)

    def column_map(self) -> ColumnMap | None:
        """Return the column map that the workbook was read by, if any, with its present rows and columns."""
        old_map = self.old.source.columns if self.old.source else None
        if old_map is None:
            return None
        tables = []
        for mapped in old_map.tables:
            table = self.columns[mapped.columns[0].quantity].table
            rows = self.rows[table].new if table in self.rows else table.rows
            added = [self.columns[name] for name in self.added if table is self.modules]
            columns = [MappedColumn(c.name, cell_name((1, c.column)).removesuffix("1"), c.unit) for c in added]
            tables.append(replace(mapped.with_rows(sorted(rows)), columns=(*mapped.columns, *columns)))
        return ColumnMap(tuple(tables))

    def _warn_of_lost_numbers(self) -> None:
        """Warn if the modules have numbers that the workbook cannot hold."""
        numbers = self.system.numbers
        if not self.numbered and not np.array_equal(numbers, np.arange(1, len(numbers) + 1)):
            problem = f"sheet {self.modules.sheet.name} has no column of the modules' numbers"
            read_as = f"{several(numbers)} will be read as 1, 2, ... in the order of their rows"
            warn(f"{self.workbook.name}: {problem}: {read_as}", 4)

    def _warn_of_short_ranges(self, table: ModuleTable, rows: ModuleRows) -> None:
        """Warn of formulas, names, charts and tables that end at the last old row and so leave added modules out."""
        name, last = table.sheet.name, max(rows.old)
        moved = {self.workbook.address_text((name, row, column)) for row in rows.new for column in rows.columns}
        ranges = self.workbook.describe_ranges_ending_at(name, last) if rows.added else []
        if short := [text for text in ranges if text not in moved]:
            ends = f"{several(short)} end{'s' * (len(short) == 1)} at row {last} of sheet {name}"
            warn(f"{self.workbook.name}: {ends}, so the modules added below are left out there", 4)

    def _add_column(self, name: str) -> None:
        """Add a column that the workbook lacks at the right of the modules' sheet, with its headings.

        A length is in the unit of the modules' coordinates there. A column with a formula is refused: the sheet would go on
        calculating with that formula.
        """
        table, definition, numbers = self.modules, self.system.columns[name], self.system.numbers
        title, sheet = table.sheet.name, self.workbook.sheet(table.sheet.name)
        right = max(self.workbook.extent(title)[1], *(area.right for area in sheet.merged_areas), 0) + 1
        if definition.formula or right > MAX_COLUMN:
            i = int(np.argmin(self.is_default[name]))
            lacks = f"sheet {title} has no column headed {name} for the {definition.title} of module {numbers[i]}"
            value = definition.text_of(definition.values(self.system)[i])
            raise InputError(f"{self.workbook.name}: {lacks}, {value}, which is not {definition.fallback}")
        coordinate_unit = self.columns[self.system.columns.leading].unit
        unit = coordinate_unit if definition.kind == "length" else next(iter(definition.units))
        table.columns[name] = right, unit
        self.layout.add_column(table, name, table.rows)
        self.cell_values[name] = np.array(["" if definition.is_text else math.nan] * len(self.old))
        symbol, description = definition.heading(unit)
        heads = (symbol, description) if len(table.heading_rows) == 2 else (description or symbol,)
        for row, text in zip(table.heading_rows, heads, strict=False):
            sheet.set_value((row, right), text)

    def _module_rows(self, table: ModuleTable, old: tuple[int, ...]) -> ModuleRows:
        """Return the rows of a table before and after the edit; `old` has the row of each module of the workbook."""
        shared = {c.column for c in self.columns.values() if c.table.sheet is table.sheet and c.shared}
        row_of_label = {} if table is self.modules else dict(zip(table.labels or (), table.rows, strict=False))
        current: list[int | None] = []
        for number, j in zip(self.system.numbers, self.old_index, strict=True):
            # A table of dimensions may have had a row for a module without coordinates.
            row = row_of_label.get(int(number)) if self.numbered else None
            current.append(old[j] if j is not None else None if row in old else row)
        # Without numbers, rows of several sheets belong together by their distance from the first row.
        has_spread = not self.numbered and any(self._needs_spreading(column) for column in self.columns.values())
        return ModuleRows(table, old, current, shared, keep_first=bool(shared) or has_spread)

    def _needs_spreading(self, column: ColumnCells) -> bool:
        """Return whether a column with one cell for all modules needs a cell for each, since the values differ."""
        new = column.definition.values(self.system)
        return column.table not in self.layout.rows_of and bool(np.any(new != new[0]))

    def _number_modules(self) -> None:
        """Write the modules' numbers into the tables that have a column of them."""
        for table, rows in self.rows.items():
            if table is self.modules or self.numbered:
                numbers: Iterable[tuple[int, int]] = enumerate(self.system.numbers)
            else:  # the numbers of this table mean nothing, but a new row needs one
                added = [i for i, j in enumerate(self.old_index) if j is None]
                numbers = zip(added, itertools.count(max(table.numbers or (0,)) + 1), strict=False)
            if table.number_column is not None:
                for i, number in numbers:
                    j = self.old_index[i]
                    old_number = None if j is None else float(self.old.numbers[j])
                    self._require_value((table.sheet.name, rows.new[i], table.number_column), float(number), old_number)

    def _spread_rows(self, column: ColumnCells) -> tuple[int, ...]:
        """Copy the single row of a table to a row for each module, and return these rows.

        Without the modules' numbers, the rows are as far apart as those of the coordinates.
        """
        sheet, table, first = self.workbook.sheet(column.table.sheet.name), column.table, column.table.rows[0]
        coordinates = self.rows[self.modules].new
        new_rows = tuple(first + (i if self.numbered else row - coordinates[0]) for i, row in enumerate(coordinates))
        for c in (column.column, table.number_column):
            if c is None:
                continue
            model = sheet.original[first, c]
            for i, row in enumerate(new_rows):
                address = (sheet.name, row, c)
                if row != first and address not in self.required:
                    if not sheet.cell((row, c)).blank:
                        cell = f"{self.workbook.name}: {self.workbook.address_text(address)}"
                        belong = f"the modules' different numbers in place of {table.sheet.address(first, c)} belong"
                        raise InputError(f"{cell} is not blank, where {belong}, expected free cells below that")
                    sheet.copy_cell(model.with_value(None), (first, c), (row, c))
                if c == table.number_column:
                    self._require_value(address, float(self.system.numbers[i]), None)
        return new_rows

    def _require_values(self, column: ColumnCells) -> None:
        """Require the values of a typed column of the scanner in its cells, in the cells' unit."""
        name, sheet, source = column.name, self.workbook.sheet(column.table.sheet.name), self.old.source
        new, old = (column.to_cell_units(column.definition.values(s)).tolist() for s in (self.system, self.old))
        cell_values, is_blank = self.cell_values[name].tolist(), is_absent(self.cell_values[name])
        # With a column map, each cell of numbers must be filled.
        is_default = self.is_default.get(name)
        if name in self.added and source is not None and source.columns is not None:
            is_default = None
        rows, old_index = self.rows.get(column.table), self.old_index
        cell_rows: Sequence[int]
        if rows is None and self._needs_spreading(column):
            cell_rows = self._spread_rows(column)
        elif rows is None or (column.shared and all(value == new[0] for value in new)):
            cell_rows, old_index = column.rows[:1], [0]
        else:
            cell_rows = rows.new
        for i, row in enumerate(cell_rows):
            if is_default is not None and is_default[i] and sheet.cell((row, column.column)).blank:
                original = sheet.original.get((self.rows[column.table].source_row(i), column.column))
                if original is None or original.blank:
                    continue  # a blank cell is read as the default
            j = old_index[i]
            # An unchanged value keeps the digits of the cell, which a conversion of units could round.
            is_unchanged = j is not None and old[j] == new[i] and not is_blank[j]
            value = cell_values[j] if is_unchanged else new[i]
            self._require_value((sheet.name, row, column.column), value, None if j is None else old[j])

    def _require_value(self, address: Address, value: float | str, old_value: float | str | None) -> None:
        """Require a value of a cell, and type it where there is no formula.

        `old_value` is the value that the module had so far, None for a new module.
        """
        self.required[address] = value
        if old_value is None or not agree(old_value, value):
            self.unsettled.add(address)
        cell = self.workbook.cell(address)
        content = cell.value
        if isinstance(value, str):
            content = cell_text(content)
        elif type(content) is str:
            content = float(parse_module_number(content) or 0)
        if cell.formula is None and cell.array is None and (type(content) is not type(value) or content != value):
            self.workbook.sheet(address[0]).set_value(address[1:], value)

    def _update_derived(self, column: ColumnCells) -> None:
        """Type derived numbers that change, and expect those of H, x2, y2, z2 of formulas that were right.

        The formulas of these four may refer to one cell for all modules where each has its own now, and know of no tilt.
        """
        definition, sheet = column.definition, self.workbook.sheet(column.table.sheet.name)
        new, old = (column.to_cell_units(definition.values(system)).tolist() for system in (self.system, self.old))
        rows = self.rows[column.table]
        for i, (row, j) in enumerate(zip(rows.new, self.old_index, strict=True)):
            source_row = rows.source_row(i)
            original, number = sheet.original.get((source_row, column.column)), new[i]
            if original is None or (j is not None and math.isclose(old[j], number, rel_tol=_SAME, abs_tol=_SAME)):
                continue
            if original.formula is None and type(original.value) is float:
                sheet.set_value((row, column.column), number)
            elif original.formula is not None and original.array is None and definition.rounded_with:
                right_value = old[rows.old.index(source_row)]
                value = column.table.sheet.value(source_row, column.column)
                was_right = type(value) is float and abs(value - right_value) <= EXACT * max(abs(right_value), 1)
                if was_right and (j is None or not agree(right_value, number)):
                    self.expected[sheet.name, row, column.column] = number
                    self.unsettled.add((sheet.name, row, column.column))
