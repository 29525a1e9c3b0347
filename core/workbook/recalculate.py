"""New stored values for the formulas that depend on changed cells."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from .dependencies import Dependencies
from .formulas import CellError, NotComputable
from .plausibility import AGREEING
from .sheet_xml import Cell
from .workbook_xml import Place, WorkbookXml


@dataclass
class Recalculated:
    """What became of the formulas.

    Attributes
    ----------
    by : dict
        Cell -> its new value.
    cleared : dict
        Cell whose value nobody could calculate, and which therefore stores none -> why.
    replaced : dict
        Cell whose formula does not give the number that it must -> why; it holds that number now.
    """

    by: dict[Place, Any] = field(default_factory=dict)
    cleared: dict[Place, str] = field(default_factory=dict)
    replaced: dict[Place, str] = field(default_factory=dict)


def agree(value: Any, wanted: float) -> bool:
    """Whether a cell's value is the number `wanted`."""
    return type(value) is float and abs(value - wanted) <= AGREEING * abs(wanted)


def recalculate(
    workbook: WorkbookXml,
    changed: Iterable[Place],
    required: Mapping[Place, float],
    derived: Mapping[Place, float] | None = None,
) -> Recalculated:
    """Give every formula of `workbook` that depends on the `changed` cells its new value.

    So are formulas without a value in sheets in which anything changes, as far as our own evaluator knows them.
    `required` are the numbers that cells must have in the end: a formula among them which gives another one, or
    of which that cannot be known, is replaced by the number. `derived` are the numbers that formulas should give:
    one that is known to give another one is replaced.
    """
    calculation = _Calculation(workbook, changed, required, derived or {})
    calculation.by_formulas()
    calculation.clear()
    calculation.fill()
    return calculation.result


class _Calculation:
    def __init__(
        self,
        workbook: WorkbookXml,
        changed: Iterable[Place],
        required: Mapping[Place, float],
        derived: Mapping[Place, float],
    ) -> None:
        self.workbook, self.required, self.derived = workbook, required, derived
        self.result = Recalculated()
        dependencies = Dependencies(workbook)
        self.affected = dependencies.affected(changed)
        # What affected formulas refer to may have come without values.
        cells = {place: workbook.cell(place) for place in dependencies.formulas - self.affected}
        valueless = {place for place, cell in cells.items() if cell.value is None}
        ordered, rest = dependencies.in_order(self.affected | valueless)
        circular = required.keys() & dependencies.circular(rest)
        for place in sorted(circular):
            self._replace(place, "it refers back to itself")
        more, rest = dependencies.in_order(set(rest) - circular)
        self.waiting = ordered + more + rest
        self.not_yet = set(self.waiting)
        self.unknown: dict[Place, str] = {}
        self.elsewhere: dict[Place, Any] = {}

    def by_formulas(self) -> None:
        for place in self.waiting:
            cell = self.workbook.cell(place)
            try:
                value = self._calculated(place, cell)
            except NotComputable as why:
                self.unknown[place] = str(why)
                self.not_yet.discard(place)
                continue
            self.not_yet.discard(place)
            if self._is_wrong(place, value):
                self._replace(place, f"it gives {_shown(value)}")
            elif place in self.affected:
                self._store(place, self.required.get(place, value))
            else:
                self.elsewhere[place] = value
        self.unknown = {place: why for place, why in self.unknown.items() if place in self.affected}

    def _calculated(self, place: Place, cell: Cell) -> Any:
        if cell.array is not None:
            raise NotComputable("it is an array formula or a data table")
        assert cell.formula is not None, "only formulas are calculated"
        return self.workbook.calculated(place, cell.formula, self._value)

    def _value(self, place: Place) -> Any:
        if place in self.unknown:
            if place in self.required:  # whether by its formula or as a number, this it will be
                return self.required[place]
            raise NotComputable(f"it needs {self.workbook.text(place)}, and there: {self.unknown[place]}")
        if place in self.not_yet:
            raise NotComputable(f"it refers to {self.workbook.text(place)}, which refers back to it")
        if place in self.elsewhere:
            return self.elsewhere[place]
        return self.workbook.value(place)

    def clear(self) -> None:
        for place, why in self.unknown.items():
            cell = self.workbook.cell(place)
            if place in self.required:
                self._replace(place, f"its value is not known: {why}")
            else:
                self._set(place, replace(cell, value=None))
                self.result.cleared[place] = why

    def fill(self) -> None:
        """Formulas that came without values get theirs too, in the sheets that change anyway."""
        changed = {title for title, sheet in self.workbook.sheets.items() if sheet.changed}
        for place, value in self.elsewhere.items():
            if place[0] in changed:
                self._store(place, value)

    def _is_wrong(self, place: Place, value: Any) -> bool:
        if place in self.required:
            return not agree(value, self.required[place])
        wanted = self.derived.get(place)  # which may be a 0 that rounding has missed
        return wanted is not None and not (
            type(value) is float and abs(value - wanted) <= AGREEING * max(abs(wanted), 1)
        )

    def _replace(self, place: Place, why: str) -> None:
        self.workbook.sheets[place[0]].refuse_array(place[1:])
        number = self.required[place] if place in self.required else self.derived[place]
        self._set(place, self.workbook.cell(place).typed(number))
        self.result.replaced[place] = why

    def _store(self, place: Place, value: Any) -> None:
        cell = self.workbook.cell(place)
        if not _identical(cell.value, value):
            self._set(place, replace(cell, value=value))
        self.result.by[place] = value

    def _set(self, place: Place, cell: Cell) -> None:
        self.workbook.sheets[place[0]].cells[place[1:]] = cell


def _identical(a: Any, b: Any) -> bool:
    return type(a) is type(b) and a == b


def _shown(value: Any) -> str:
    if type(value) is float and math.isfinite(value):
        return f"{value:.9g}"
    return str(value) if isinstance(value, CellError) else repr(value)
