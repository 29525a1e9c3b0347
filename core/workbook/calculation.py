"""The values of formulas that refer to each other."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from .cells import Uncomputed
from .formulas import NotComputable, Surroundings, calculate
from .sheet_xml import Cell, Unreadable
from .workbook_xml import Place, WorkbookXml


class Calculation:
    """Values of a workbook's formulas, each calculated after those that it needs, without recursion.

    Parameters
    ----------
    workbook
    cell_at
        Gives the content of a cell.
    is_calculated
        Says of a place and its content whether its value is calculated; all others are taken as they stand.
    settled
        Given a formula's place and its value, or the `Uncomputed` that says why there is none, gives the value that
        other formulas see.
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
            lookup,
            at=place[1:],
            extent=lambda name: workbook.extent(title(name)),
            name=lambda name: workbook.meaning(sheet, name),
        )
        try:
            return calculate(cell.formula, surroundings)
        except NotComputable as why:
            return Uncomputed(str(why))
