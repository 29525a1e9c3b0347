"""The numbers of a system put into the cells of a workbook; its formulas are not recalculated yet."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Iterable

import numpy as np

from ..errors import InputError, InputWarning
from ..geometry.system import PinholeSystem
from .book import module_number
from .column_map import ColumnMap
from .layout import Column, Table
from .plausibility import is_by_design
from .quantities import DERIVED, EXACT, NEEDED, QUANTITIES, agree
from .reader import Reading
from .rows import Rows, matched
from .workbook_xml import Place, WorkbookXml

_SHOWN = 3
"""Places that one warning names; it counts the rest."""
_SAME = 1e-12
"""NumPy's last digit of the same number may depend on where in memory it lies."""


class Edit:
    """The cells of a workbook changed such that it holds another system; `InputError` if it cannot."""

    def __init__(self, system: PinholeSystem, reading: Reading, workbook: WorkbookXml) -> None:
        self.system = system
        self.old, self.given, self.layout = reading.system, reading.given, reading.layout
        self.columns, self.modules = self.layout.columns, self.layout.modules
        self.workbook = workbook
        self.by_design = is_by_design(system)
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
        for name in (*NEEDED, *(["l"] if "l" in self.columns else [])):
            self._require(self.columns[name])
        for name in DERIVED:
            if name in self.columns:
                self._derive(self.columns[name])
        for table, rows in self.rows.items():
            name, last = table.sheet.name, max(rows.old)
            own = {workbook.text((name, row, column)) for row in rows.new for column in rows.columns}
            found = [text for text in workbook.ranges_ending_at(name, last) if text not in own] if rows.added else []
            if found:
                warnings.warn(
                    f"{workbook.name}: {several(found)} end{'s' * (len(found) == 1)} at row {last} of sheet {name}, so the "
                    "modules added below are left out there",
                    InputWarning,
                    stacklevel=3,
                )

    @property
    def changed(self) -> list[Place]:
        """The cells whose formulas, and those that depend on them, have to be recalculated."""
        return list(dict.fromkeys([*self.workbook.changed, *sorted(self.unsettled)]))

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
            warnings.warn(
                f"{file}: sheet {sheet} has no column of the modules' numbers: {several(numbers)} will be read as "
                "1, 2, ... in the order of their rows",
                InputWarning,
                stacklevel=4,
            )
        if "l" not in self.columns and not self.by_design.all():
            i = np.argmin(self.by_design)
            raise InputError(
                f"{file}: sheet {sheet} has no column headed l for the collimator length of module {numbers[i]}, "
                f"{self.system.collimator_length[i]:g} mm, which is not the design formula's"
            )

    # Rows

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

    # Numbers

    def _require(self, column: Column) -> None:
        """Demand the numbers of a quantity, in the column's unit."""
        name, sheet = column.quantity, self.workbook.sheet(column.table.sheet.name)
        new, old = (QUANTITIES[name].of(system) for system in (self.system, self.old))
        rows = self.rows.get(column.table)
        old_of = self.old_of
        if rows is None and self._is_spread(column):
            places = self._rows_of_all(column)
        elif rows is None or (column.shared and np.all(new == new[0])):
            places, old_of = column.rows[:1], [0]
        else:
            places = rows.new
        for i, row in enumerate(places):
            if name == "l" and self.by_design[i] and sheet.cell((row, column.column)).blank:
                was_cell = sheet.original.get((self.rows[column.table].source(i), column.column))
                if was_cell is None or was_cell.blank:
                    continue  # and it is read as the design formula's
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


def several(things: Iterable[object]) -> str:
    """The first few, and how many more."""
    texts = [str(thing) for thing in things]
    more = f" and {len(texts) - _SHOWN} more" if len(texts) > _SHOWN else ""
    return ", ".join(texts[:_SHOWN]) + more
