"""New stored values for the formulas that depend on changed cells, and for those that store none."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from .formulas import CellError, NotComputable, operands, tokens_of
from .plausibility import AGREEING
from .references import Reference, reference
from .sheet_xml import Cell
from .workbook_xml import Place, WorkbookXml

_NAMES_DEEP = 20
_FEW = 64
"""Cells of an area that are indexed one by one; a larger area is compared with each stale cell."""
_OTHER_FILE = re.compile(r"'?[^!]*\[[^\]]+\][^!]*'?!")


@dataclass
class Recalculated:
    """What became of the formulas.

    Attributes
    ----------
    values : dict
        Formula -> the value that it stores now.
    cleared : dict
        Formula that stores no value now -> why it cannot be calculated; causes before effects.
    replaced : dict
        Cell whose formula was replaced by the number that it must hold -> why.
    """

    values: dict[Place, Any] = field(default_factory=dict)
    cleared: dict[Place, str] = field(default_factory=dict)
    replaced: dict[Place, str] = field(default_factory=dict)


def agree(value: Any, wanted: float) -> bool:
    """Whether a cell's value is the number `wanted`."""
    return type(value) is float and abs(value - wanted) <= AGREEING * abs(wanted)


def recalculate(
    workbook: WorkbookXml, changed: Iterable[Place], required: Mapping[Place, float], expected: Mapping[Place, float]
) -> Recalculated:
    """Give every formula of `workbook` that depends on the `changed` cells its new value, or none.

    Parameters
    ----------
    required
        The numbers that cells must hold: a formula that gives another one, or cannot be calculated, is replaced.
    expected
        The numbers that other formulas should give: one that gives another one is replaced.
    """
    formulas = workbook.formulas
    stale = _dependents(workbook, formulas, changed)
    without_value = {place for place, cell in formulas.items() if cell.value is None}
    calculation = _Calculation(workbook, stale, stale | without_value, required, expected)
    for place in sorted(stale | without_value):
        calculation.calculate(place)
    edited = {title for title, _, _ in workbook.changed}
    for place in without_value - stale:
        if place[0] in edited and not isinstance(calculation.outcomes[place], NotComputable):
            calculation.store(place, calculation.outcomes[place])
    return calculation.result


class _Calculation:
    """The values of the `waiting` formulas; all other cells hold the right ones.

    Attributes
    ----------
    outcomes : dict
        Formula -> its value, or the `NotComputable` that says why it has none.
    result : Recalculated
    """

    def __init__(
        self,
        workbook: WorkbookXml,
        stale: set[Place],
        waiting: set[Place],
        required: Mapping[Place, float],
        expected: Mapping[Place, float],
    ) -> None:
        self.workbook, self.stale, self.waiting = workbook, stale, waiting
        self.required, self.expected = required, expected
        self.outcomes: dict[Place, Any] = {}
        self.result = Recalculated()

    def calculate(self, place: Place) -> None:
        """Calculate a formula and before it those that it needs, without recursion."""
        pending, begun = [place], set()
        while pending:
            current = pending[-1]
            if current in self.outcomes:
                pending.pop()
                continue
            begun.add(current)
            missing: list[Place] = []
            outcome = self._outcome(current, missing)
            loop = next((other for other in missing if other in begun), None)
            if loop is not None:
                other = f"to {self.workbook.text(loop)}, which refers back to it"
                outcome = NotComputable(f"it refers {'back to itself' if loop == current else other}")
            elif missing:
                pending += missing
                continue
            self.outcomes[current] = self._settled(current, outcome) if current in self.stale else outcome

    def _outcome(self, place: Place, missing: list[Place]) -> Any:
        """A formula's value; meaningless if formulas that have to be calculated before it are added to `missing`."""

        def value_of(other: Place) -> Any:
            if other not in self.waiting:
                return self.workbook.value(other)
            if other not in self.outcomes:
                missing.append(other)
                return 0.0
            value = self.outcomes[other]
            if isinstance(value, NotComputable):
                raise NotComputable(f"it needs {self.workbook.text(other)}, and there: {value}")
            return value

        cell = self.workbook.cell(place)
        if cell.array is not None or cell.formula is None:
            return NotComputable("it is an array formula or a data table")
        try:
            return self.workbook.calculated(place, cell.formula, value_of)
        except NotComputable as why:
            return why

    def _settled(self, place: Place, outcome: Any) -> Any:
        """What a stale formula's cell holds from now on: its value, nothing, or a number instead of the formula."""
        unknown = isinstance(outcome, NotComputable)
        number = self.required.get(place, self.expected.get(place, math.nan))
        if place in self.required:
            wrong = unknown or not agree(outcome, number)
        elif place in self.expected and not unknown:  # perhaps a 0 that rounding errors miss
            wrong = type(outcome) is not float or abs(outcome - number) > AGREEING * max(abs(number), 1)
        else:
            wrong = False
        if wrong:
            self.workbook.sheets[place[0]].type(place[1:], number)
            self.result.replaced[place] = str(outcome) if unknown else f"it gives {_shown(outcome)}"
            return number
        if unknown:
            self.workbook.put(place, replace(self.workbook.cell(place), value=None))
            self.result.cleared[place] = str(outcome)
            return outcome
        return self.store(place, self.required.get(place, outcome))

    def store(self, place: Place, value: Any) -> Any:
        """Store a formula's value."""
        cell = self.workbook.cell(place)
        if type(cell.value) is not type(value) or cell.value != value:
            self.workbook.put(place, replace(cell, value=value))
        self.result.values[place] = value
        return value


def _dependents(workbook: WorkbookXml, formulas: Mapping[Place, Cell], changed: Iterable[Place]) -> set[Place]:
    """The formulas that depend on the `changed` cells, however far, or may do so; those that changed are among them."""
    readers: dict[Place, list[Place]] = defaultdict(list)
    readers_of_area: dict[str, dict[Reference, list[Place]]] = defaultdict(lambda: defaultdict(list))
    pending = list(changed)
    found = {place for place in pending if place in formulas}
    for place, cell in formulas.items():
        first = cell if cell.array is None else workbook.cell((place[0], cell.array.top, cell.array.left))
        areas = None if first.formula is None else _areas_read(workbook, place, first.formula)
        if areas is None and place not in found:
            found.add(place)
            pending.append(place)
        for area in areas or ():
            sheet, top, left, bottom, right = area
            assert sheet is not None, "the areas that a formula reads are on known sheets"
            if (bottom - top + 1) * (right - left + 1) > _FEW:
                readers_of_area[sheet][area].append(place)
                continue
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    readers[sheet, row, column].append(place)
    while pending:
        sheet, row, column = place = pending.pop()
        large = readers_of_area[sheet]
        hit = [area for area in large if area.top <= row <= area.bottom and area.left <= column <= area.right]
        for reader in [*readers.pop(place, ()), *(reader for area in hit for reader in large.pop(area))]:
            if reader not in found:
                found.add(reader)
                pending.append(reader)
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
            meaning = workbook.meaning(place, text)
            areas = None if meaning is None else _areas_read(workbook, place, meaning, depth + 1)
            if areas is None:
                return None
            found += areas
        elif area.sheet is not None and ":" in area.sheet:
            return None  # through several sheets
        elif (title := place[0] if area.sheet is None else workbook.title(area.sheet)) is not None:
            found.append(area._replace(sheet=title))
    return found


def _shown(value: Any) -> str:
    if type(value) is float:
        return f"{value:.9g}"
    return str(value) if isinstance(value, CellError) else repr(value)
