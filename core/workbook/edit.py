"""A system's numbers put into the cells of a workbook, its formulas not yet calculated."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, InputWarning
from ..geometry.system import PinholeSystem
from .arrangement import Arrangement, arrange, matched
from .cells import module_number
from .column_map import ColumnMap
from .layout import Column, Table, column_map_of
from .plausibility import derived, is_by_design
from .quantities import DIMENSIONS, EXACT, POSITION
from .reader import Reading
from .recalculate import agree
from .workbook_xml import Place, WorkbookXml

_SHOWN = 3
"""Places that one warning names; it counts the rest."""
_SAME = {"rel_tol": 1e-12, "abs_tol": 1e-12}
"""NumPy's last digit of one and the same number may depend on where in memory it lies."""
_OF_DIMENSIONS = ("H", "x2", "y2", "z2")
"""Derived from l and Td, which other cells hold: their formulas may refer to one cell for all modules."""


class Edit:
    """The system's numbers in the cells of a workbook.

    Attributes
    ----------
    changed : list of places
        Cells on which others may depend.
    required : dict
        Place -> the number that it must have.
    derived : dict
        Place of a formula of H, x2, y2 or z2 that was right -> the new number that it should give.
    settled : set of places
        Those required that were so when the workbook was read.
    module_numbers : set of places
        Those required that hold modules' numbers.
    numbered : bool
        Whether the workbook has the modules' numbers.
    """

    def __init__(self, system: PinholeSystem, reading: Reading, workbook: WorkbookXml) -> None:
        self.system, self.old, self.workbook = system, reading.system, workbook
        self.layout, self.given = reading.layout, reading.given
        self.columns, self.modules = reading.layout.columns, reading.layout.modules
        self.numbered = self.modules.number_column is not None
        self.old_of = matched(system, self.old, self.numbered)
        self.required: dict[Place, float] = {}
        self.derived: dict[Place, float] = {}
        self.settled: set[Place] = set()
        self.module_numbers: set[Place] = set()
        self.changed: list[Place] = []

    def apply(self) -> None:
        """Change the workbook's cells; `InputError` where it cannot hold the system."""
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
        self._put_derived()
        # A typed number that had to change is among the workbook's changed cells; of a formula it is to be seen.
        to_be_seen = (self.required.keys() - self.settled) | self.derived.keys()
        self.changed = list(dict.fromkeys([*self.workbook.changed, *to_be_seen]))
        for arrangement in self.arrangements.values():
            if arrangement.added:
                self._warn_of_short_ranges(arrangement)

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
        if "l" not in self.columns:
            differing = np.flatnonzero(~is_by_design(self.system))
            if len(differing):
                i = differing[0]
                raise InputError(
                    f"{file}: sheet {sheet} has no column headed l for the collimator length of module {numbers[i]}, "
                    f"{self.system.collimator_length[i]:g} mm, which is not the design formula's"
                )

    # Rows

    def _arranged(self) -> dict[Table, Arrangement]:
        """The rows of those tables that have a row for each module."""
        return {table: self._arrangement(table, rows) for table, rows in self.layout.rows_of.items()}

    def _arrangement(self, table: Table, old: tuple[int, ...]) -> Arrangement:
        shared = [c.column for c in self.columns.values() if c.table.sheet is table.sheet and c.shared]
        row_of = {} if table is self.modules else dict(zip(table.labels or (), table.rows, strict=False))
        own: list[int | None] = []
        for number, j in zip(self.system.numbers, self.old_of, strict=True):
            row = row_of.get(int(number)) if self.numbered else None  # of a module that had no coordinates
            own.append(old[j] if j is not None else None if row in old else row)
        return arrange(
            table, old, own, filled_to=max(table.rows), number_column=table.number_column, kept_columns=shared
        )

    def written_columns(self) -> ColumnMap:
        """The column map of the workbook as it is now."""
        return column_map_of(self.layout, {table: found.rows for table, found in self.arrangements.items()})

    # Numbers

    def _require_numbers(self) -> None:
        for table, arrangement in self.arrangements.items():
            if table is self.modules or self.numbered:
                numbers: Iterable[tuple[int, int]] = enumerate(self.system.numbers)
            else:  # a table whose numbers mean nothing, but must be there
                added = [i for i, j in enumerate(self.old_of) if j is None]
                numbers = zip(added, itertools.count(max(table.numbers or (0,)) + 1), strict=False)
            if table.number_column is not None:
                for i, number in numbers:
                    place = (table.sheet.name, arrangement.rows[i], table.number_column)
                    self._demand_number(place, number, self._was(i, self.old.numbers))

    def _require(self, name: str) -> None:
        column = self.columns[name]
        sheet = column.table.sheet.name
        values, old = values_of(self.system, name), values_of(self.old, name)
        arrangement = self.arrangements.get(column.table)
        single = arrangement is None or column.shared
        if single and np.all(values == values[0]):
            self._demand_length((sheet, column.rows[0], column.column), column, values[0], 0, old)
            return
        rows = arrangement.rows if arrangement is not None else self._new_rows(column)
        for i, row in enumerate(rows):
            self._demand_length((sheet, row, column.column), column, values[i], self.old_of[i], old)

    def _new_rows(self, column: Column) -> tuple[int, ...]:
        """Rows for all modules in a table that had one for all."""
        table = column.table
        first = table.rows[0]
        found = tuple(range(first, first + len(self.system)))
        sheet = self.workbook.sheets[table.sheet.name]
        for i, row in enumerate(found):
            for c in (column.column, table.number_column):
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
            if table.number_column is not None:
                self._demand_number((table.sheet.name, row, table.number_column), self.system.numbers[i], None)
        return found

    def _require_lengths(self) -> None:
        column = self.columns["l"]
        arrangement = self.arrangements[column.table]
        sheet = self.workbook.sheets[column.table.sheet.name]
        lengths = self.system.collimator_length
        by_design = is_by_design(self.system)
        for i, row in enumerate(arrangement.rows):
            at = (row, column.column)
            was = sheet.original.get((arrangement.source(i), column.column))
            if by_design[i] and sheet.cell(at).blank and (was is None or was.blank):
                continue  # as the reader takes a blank
            place = (column.table.sheet.name, *at)
            self._demand_length(place, column, lengths[i], self.old_of[i], self.old.collimator_length)

    def _was(self, i: int, old: NDArray) -> float | None:
        """The number that was read of a module of the system; None of a new one."""
        j = self.old_of[i]
        return None if j is None else float(old[j])

    def _demand_length(self, place: Place, column: Column, number: float, j: int | None, old: NDArray) -> None:
        """Demand a length, mm, in the column's unit; `j` is the module's index in the `old` lengths, None of a new one."""
        given = None if j is None else float(self.given[column.quantity][j])
        same = j is not None and old[j] == number and given == given
        was = None if j is None else float(old[j]) / column.factor
        self._demand(place, float(given if same else number / column.factor), was)  # type: ignore[arg-type]

    def _demand(self, place: Place, number: float, was: float | None) -> None:
        self.required[place] = number
        if was is not None and agree(float(was), number):
            self.settled.add(place)

    def _demand_number(self, place: Place, number: int, was: float | None) -> None:
        self._demand(place, float(number), was)
        self.module_numbers.add(place)

    def _type(self, place: Place, number: float) -> None:
        cell = self.workbook.cell(place)
        if cell.formula is not None or cell.array is not None:
            return
        if place in self.module_numbers:
            same = module_number(cell.value) == number  # which may be a text
        else:
            same = type(cell.value) is float and cell.value == number
        if not same:
            self.workbook.sheets[place[0]].type(place[1:], number)

    def _put_derived(self) -> None:
        """Derived numbers (b, H, x2, ..., azimuth), where they change: typed ones, and what right formulas have to give."""
        old, new = (derived(s.centers, s.collimator_length, s.detector_thickness) for s in (self.old, self.system))
        for name in new:
            if name not in self.columns:
                continue
            column = self.columns[name]
            title = column.table.sheet.name
            sheet, arrangement = self.workbook.sheets[title], self.arrangements[column.table]
            for i, row in enumerate(arrangement.rows):
                source, j = arrangement.source(i), self.old_of[i]
                was = sheet.original.get((source, column.column))
                if was is None or (j is not None and math.isclose(old[name][j], new[name][i], **_SAME)):
                    continue
                number = float(new[name][i]) / column.factor
                if was.formula is not None and was.array is None and name in _OF_DIMENSIONS:
                    right = float(old[name][arrangement.old.index(source)]) / column.factor
                    shown = column.table.sheet.value(source, column.column)
                    was_right = type(shown) is float and abs(shown - right) <= EXACT * max(abs(right), 1)
                    if was_right and (j is None or not agree(right, number)):
                        self.derived[title, row, column.column] = number
                elif was.formula is None and type(was.value) is float:
                    sheet.type((row, column.column), number)

    def _warn_of_short_ranges(self, arrangement: Arrangement) -> None:
        name, old = arrangement.table.sheet.name, arrangement.old
        found = self.workbook.ranges_ending_at(name, max(old))
        own = {self.workbook.text((name, row, column)) for row in arrangement.rows for column in arrangement.columns}
        found = [place for place in found if place not in own]
        if found:
            warnings.warn(
                f"{self.workbook.name}: {several(found)} end{'s' * (len(found) == 1)} at row {max(old)} of sheet {name}, "
                "so the modules added below are left out there",
                InputWarning,
                stacklevel=4,
            )


def several(things: Iterable[object]) -> str:
    """The first few, and how many more."""
    texts = [str(thing) for thing in things]
    more = f" and {len(texts) - _SHOWN} more" if len(texts) > _SHOWN else ""
    return ", ".join(texts[:_SHOWN]) + more


def values_of(system: PinholeSystem, quantity: str) -> NDArray[np.float64]:
    """A quantity (M,), mm, by its symbol."""
    if quantity in POSITION:
        return system.centers[:, POSITION.index(quantity)]
    return {
        "d": system.pinhole_diameter,
        "R": system.roi_radius,
        "Ld": system.detector_side,
        "Td": system.detector_thickness,
        "l": system.collimator_length,
    }[quantity]
