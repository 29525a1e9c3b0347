"""The values of formulas that refer to each other, and new stored values where cells have changed."""

import math
import re
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Any

from .agreement import agree
from .formulas import NotComputable, Surroundings, calculate, operands, tokens_of
from .sheet_xml import Cell, CellError, Reference, Unreadable, reference
from .workbook_xml import Place, WorkbookXml

_NAMES_DEEP = 20
_FEW = 64
"""Cells of an area that are indexed one by one; a larger area is compared with each stale cell."""
_OTHER_FILE = re.compile(r"'?[^!]*\[[^\]]+\][^!]*'?!")


class Uncomputed(str):
    """Stands for a formula without a reliable stored value that cannot be computed here; the text says why."""


class Calculation:
    """Values of a workbook's formulas, each calculated after those that it needs, without recursion.

    `cell_at` gives the content of a cell, and `is_calculated` says of a place and its content whether its value is
    calculated; all others are taken as they stand. Given a formula's place and its value, or the `Uncomputed` that says
    why there is none, `settled` gives the value that other formulas see.
    """

    def __init__(
        self,
        workbook: WorkbookXml,
        cell_at: Callable[[Place], Cell],
        is_calculated: Callable[[Place, Cell], bool],
        settled: Callable[[Place, Any], Any],
    ) -> None:
        self._workbook, self._cell_at, self._is_calculated, self._settled = workbook, cell_at, is_calculated, settled
        self._values: dict[Place, Any] = {}

    def value(self, place: Place) -> Any:
        """The settled value of a formula."""
        pending, begun = [place], set()
        while pending:
            current = pending[-1]
            if current in self._values:
                pending.pop()
                continue
            begun.add(current)
            missing: list[Place] = []
            value = self._calculated(current, missing)
            loop = next((other for other in missing if other in begun), None)
            if loop is not None:
                other = f"to {self._workbook.text(loop)}, which refers back to it"
                value = Uncomputed(f"it refers {'back to itself' if loop == current else other}")
            elif missing:
                pending += missing
                continue
            self._values[current] = self._settled(current, value)
        return self._values[place]

    def _calculated(self, place: Place, missing: list[Place]) -> Any:
        """What a formula gives; meaningless if formulas that have to be calculated before it are added to `missing`."""
        workbook, sheet = self._workbook, place[0]

        def title(name: str | None) -> str:
            found = sheet if name is None else workbook.title(name)
            if found is None:
                raise NotComputable(f"there is no sheet {name}")
            return found

        def lookup(name: str | None, row: int, column: int) -> Any:
            other = (title(name), row, column)
            cell = self._cell_at(other)
            if not self._is_calculated(other, cell):
                if isinstance(cell.value, Unreadable):
                    raise NotComputable(f"{workbook.text(other)} holds {cell.value!r}")
                return cell.value
            if other not in self._values:
                missing.append(other)
                return 0.0
            value = self._values[other]
            if isinstance(value, Uncomputed):
                raise NotComputable(f"it needs {workbook.text(other)}, and there: {value}")
            return value

        cell = self._cell_at(place)
        if cell.array is not None or cell.formula is None:
            return Uncomputed("it is an array formula or a data table")
        surroundings = Surroundings(
            lookup, place[1:], lambda name: workbook.extent(title(name)), lambda name: workbook.meaning(sheet, name)
        )
        try:
            return calculate(cell.formula, surroundings)
        except NotComputable as why:
            return Uncomputed(str(why))


class Recalculation:
    """New values for every formula of a workbook that depends on `changed` cells, stored in its cells.

    Formulas that stored no value get theirs too, in the sheets that change anyway, and all if the workbook was never
    calculated. A formula is replaced by the number
    that its cell is `required` to hold if it gives another one or cannot be calculated, and by the `expected` number if
    it gives another one.
    """

    def __init__(
        self,
        workbook: WorkbookXml,
        changed: Collection[Place],
        required: Mapping[Place, float | str],
        expected: Mapping[Place, float],
    ) -> None:
        self.values: dict[Place, Any] = {}
        """Formula -> the value that it stores now."""
        self.cleared: dict[Place, str] = {}
        """Formula that stores no value now -> why it cannot be calculated; causes before effects."""
        self.replaced: dict[Place, str] = {}
        """Cell whose formula was replaced by a number -> why."""
        self._workbook, self._required, self._expected = workbook, required, expected
        formulas = workbook.formulas if changed else {}
        without_value = {place for place, cell in formulas.items() if cell.value is None}
        zeros = formulas.keys() - without_value if workbook.never_calculated else set()
        self._stale = _dependents(workbook, formulas, changed) | zeros
        waiting = self._stale | without_value
        calculation = Calculation(workbook, workbook.cell, lambda place, _: place in waiting, self._settled)
        values = {place: calculation.value(place) for place in sorted(waiting)}
        edited = {title for title, _, _ in workbook.changed}
        for place in sorted(without_value - self._stale):
            if place[0] in edited and not isinstance(values[place], Uncomputed):
                self._store(place, values[place])

    def _settled(self, place: Place, value: Any) -> Any:
        """What a stale formula's cell holds from now on: its value, nothing, or a number instead of the formula."""
        if place not in self._stale:
            return value
        unknown, wrong = isinstance(value, Uncomputed), False
        number = self._required.get(place, self._expected.get(place, math.nan))
        if place in self._required:
            wrong = unknown or not agree(value, number)
        elif place in self._expected and not unknown:  # perhaps a 0 that rounding errors miss
            wrong = not agree(value, number, at_least=1)
        if wrong:
            self._workbook.sheet(place[0]).type(place[1:], number)
            shown = str(value) if isinstance(value, CellError) else repr(value)
            shown = f"{value:.9g}" if type(value) is float else shown
            self.replaced[place] = str(value) if unknown else f"it gives {shown}"
            return number
        if unknown:
            self._workbook.put(place, replace(self._workbook.cell(place), value=None))
            self.cleared[place] = str(value)
            return value
        return self._store(place, self._required.get(place, value))

    def _store(self, place: Place, value: Any) -> Any:
        """Store a formula's value."""
        cell = self._workbook.cell(place)
        if type(cell.value) is not type(value) or cell.value != value:
            self._workbook.put(place, replace(cell, value=value))
        self.values[place] = value
        return value


def _dependents(workbook: WorkbookXml, formulas: Mapping[Place, Cell], changed: Collection[Place]) -> set[Place]:
    """The formulas that depend on the `changed` cells, however far, or may do so; those that changed are among them."""
    readers: dict[Place, list[Place]] = defaultdict(list)
    readers_of_area: dict[str, dict[Reference, list[Place]]] = defaultdict(lambda: defaultdict(list))
    pending = list(changed)
    found = formulas.keys() & set(changed)
    for place, cell in formulas.items():
        first = cell if cell.array is None else workbook.cell((place[0], cell.array.top, cell.array.left))
        areas = None if first.formula is None else _areas_read(workbook, place, first.formula)
        if areas is None and place not in found:
            found.add(place)
            pending.append(place)
        for area in areas or ():
            sheet, top, left, bottom, right = area
            assert sheet is not None, "the areas that a formula reads are on known sheets"
            if area.size > _FEW:
                readers_of_area[sheet][area].append(place)
                continue
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    readers[sheet, row, column].append(place)
    while pending:
        sheet, row, column = place = pending.pop()
        large = readers_of_area[sheet]
        hit = [area for area in large if area.contains(row, column)]
        new = {*readers.pop(place, ()), *(reader for area in hit for reader in large.pop(area))} - found
        found |= new
        pending += new
    return found


def _areas_read(workbook: WorkbookXml, place: Place, formula: str, depth: int = 0) -> list[Reference] | None:
    """The areas that a formula at `place` reads, None if it does not say which."""
    try:
        functions = [token.value[:-1].upper() for token in tokens_of(formula) if token.type == "FUNC"]
    except NotComputable:
        return None
    if depth == _NAMES_DEEP or any(name in ("INDIRECT", "OFFSET") or ":" in name for name in functions):
        return None
    found: list[Reference] = []
    for text in operands(formula):
        area = reference(text)
        if area is None:
            if _OTHER_FILE.match(text):
                continue  # another file's cells do not change with this one's
            table = workbook.tables.get(text.partition("[")[0].casefold())
            meaning = workbook.meaning(place[0], text)
            if table is not None:
                found.append(table)  # whichever of its cells are meant
            elif meaning is None or (areas := _areas_read(workbook, place, meaning, depth + 1)) is None:
                return None
            else:
                found += areas
        elif area.sheet is not None and ":" in area.sheet:
            return None  # through several sheets
        elif (title := place[0] if area.sheet is None else workbook.title(area.sheet)) is not None:
            found.append(area._replace(sheet=title))
    return found
