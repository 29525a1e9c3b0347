"""Calculation of formulas that refer to each other, and of new stored values for formulas whose cells have changed."""

import math
import re
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from .agreement import agree
from .formulas import FormulaContext, NotComputable, calculate, references_and_names, tokenize_formula
from .sheet_xml import Cell, CellError, Reference, UnreadableValue, parse_reference
from .workbook_xml import Address, WorkbookXml

_MAX_NESTED_NAMES = 20
_SMALL_AREA = 64
"""Largest number of cells of an area that are indexed one by one; a larger area is compared with each stale cell."""
_OTHER_FILE = re.compile(r"'?[^!]*\[[^\]]+\][^!]*'?!")


class UncomputedValue(str):
    """Stand-in for the value of a formula that cannot be computed here and stores no reliable value; its text says why."""


@dataclass
class Calculation:
    """Values of a workbook's formulas, each calculated after the formulas that it needs, without recursion."""

    workbook: WorkbookXml
    cell_at: Callable[[Address], Cell]
    """Function that returns the content of a cell."""
    is_calculated: Callable[[Address, Cell], bool]
    """Function of a cell's address and content: whether its value is calculated, or else taken as stored."""
    settle: Callable[[Address, Any], Any]
    """Function of a formula's address and computed value, or `UncomputedValue`, that returns the value others see."""
    _values: dict[Address, Any] = field(default_factory=dict)

    def value(self, address: Address) -> Any:
        """Return the settled value of the formula at `address`."""
        pending, begun = [address], set()
        while pending:
            if (current := pending[-1]) in self._values:
                pending.pop()
                continue
            begun.add(current)
            missing: list[Address] = []
            value = self._calculate(current, missing)
            loop = next((needed for needed in missing if needed in begun), None)
            if loop is not None:
                detour = f"to {self.workbook.address_text(loop)}, which refers back to it"
                value = UncomputedValue(f"it refers {'back to itself' if loop == current else detour}")
            elif missing:
                pending += missing
                continue
            self._values[current] = self.settle(current, value)
        return self._values[address]

    def _calculate(self, address: Address, missing: list[Address]) -> Any:
        """Return the value of a formula, and append to `missing` the formulas that must be calculated first.

        The value is meaningless if any are appended.
        """
        workbook, sheet = self.workbook, address[0]

        def title(name: str | None) -> str:
            """Return a sheet's name as the workbook writes it, the formula's own sheet for None."""
            if (known_title := sheet if name is None else workbook.find_title(name)) is None:
                raise NotComputable(f"there is no sheet {name}")
            return known_title

        def lookup(name: str | None, row: int, column: int) -> Any:
            """Return the value of a cell that the formula refers to, or enter it in `missing`."""
            needed = (title(name), row, column)
            cell = self.cell_at(needed)
            if not self.is_calculated(needed, cell):
                if isinstance(cell.value, UnreadableValue):
                    raise NotComputable(f"{workbook.address_text(needed)} holds {cell.value!r}")
                return cell.value
            if needed not in self._values:
                missing.append(needed)
                return 0.0
            value = self._values[needed]
            if isinstance(value, UncomputedValue):
                raise NotComputable(f"it needs {workbook.address_text(needed)}, and there: {value}")
            return value

        cell = self.cell_at(address)
        if cell.array is not None or cell.formula is None:
            return UncomputedValue("it is an array formula or a data table")
        context = FormulaContext(
            lookup, address[1:], lambda name: workbook.extent(title(name)), partial(workbook.defined_formula, sheet)
        )
        try:
            return calculate(cell.formula, context)
        except NotComputable as problem:
            return UncomputedValue(str(problem))


class Recalculation:
    """New stored values of every formula of a workbook that depends on changed cells.

    Formulas that stored no value get one too: in the sheets that change anyway, and in all sheets if the workbook was never
    calculated. A formula is replaced by a number if it does not give the number that its cell is `required` to hold, or
    cannot be calculated; and by the `expected` number if it gives another one.
    """

    def __init__(
        self,
        workbook: WorkbookXml,
        changed: set[Address],
        required: Mapping[Address, float | str],
        expected: Mapping[Address, float],
    ) -> None:
        self.values: dict[Address, Any] = {}
        """Address of a formula -> the value that it stores now."""
        self.cleared: dict[Address, str] = {}
        """Address of a formula that stores no value now -> why it cannot be calculated; causes before effects."""
        self.replaced: dict[Address, str] = {}
        """Address of a cell whose formula was replaced by a number -> why."""
        self._workbook, self._required, self._expected = workbook, required, expected
        formulas = workbook.formulas if changed else {}
        without_value = {address for address, cell in formulas.items() if cell.value is None}
        zeros = formulas.keys() - without_value if workbook.was_never_calculated else set()
        self._stale = _find_dependents(workbook, formulas, changed) | zeros
        pending = self._stale | without_value
        calculation = Calculation(workbook, workbook.cell, lambda address, _: address in pending, self._store_result)
        values = {address: calculation.value(address) for address in sorted(pending)}
        edited_sheets = {title for title, _, _ in workbook.changed_addresses}
        for address in sorted(without_value - self._stale):
            if address[0] in edited_sheets and not isinstance(values[address], UncomputedValue):
                self._store(address, values[address])

    def _store_result(self, address: Address, value: Any) -> Any:
        """Write the new value of a stale formula into its cell, and return the value that other formulas see.

        The cell gets the computed value, a number in place of the formula, or no value if that cannot be computed. A formula
        that is not stale is left as it is.
        """
        if address not in self._stale:
            return value
        is_unknown, is_wrong = isinstance(value, UncomputedValue), False
        number = self._required.get(address, self._expected.get(address, math.nan))
        if address in self._required:
            is_wrong = is_unknown or not agree(value, number)
        elif address in self._expected and not is_unknown:  # the expected value may be a 0 that rounding errors miss
            is_wrong = not agree(value, number, at_least=1)
        if is_wrong:
            self._workbook.sheet(address[0]).set_value(address[1:], number)
            text = str(value) if isinstance(value, CellError) else repr(value)
            text = f"{value:.9g}" if type(value) is float else text
            self.replaced[address] = str(value) if is_unknown else f"it gives {text}"
            return number
        if is_unknown:
            self._workbook.set_cell(address, replace(self._workbook.cell(address), value=None))
            self.cleared[address] = str(value)
            return value
        return self._store(address, self._required.get(address, value))

    def _store(self, address: Address, value: Any) -> Any:
        """Store a formula's value in its cell, and return it."""
        cell = self._workbook.cell(address)
        if type(cell.value) is not type(value) or cell.value != value:
            self._workbook.set_cell(address, replace(cell, value=value))
        self.values[address] = value
        return value


def _find_dependents(workbook: WorkbookXml, formulas: dict[Address, Cell], changed: set[Address]) -> set[Address]:
    """Return the formulas that depend, or may depend, on the `changed` cells, directly or through other formulas.

    The changed formulas are among them.
    """
    readers: dict[Address, list[Address]] = defaultdict(list)
    readers_of_area: dict[str, dict[Reference, list[Address]]] = defaultdict(lambda: defaultdict(list))
    pending = list(changed)
    dependents = formulas.keys() & changed
    for address, cell in formulas.items():
        first = cell if cell.array is None else workbook.cell((address[0], cell.array.top, cell.array.left))
        areas = None if first.formula is None else _areas_read_by(workbook, address, first.formula)
        if areas is None and address not in dependents:
            dependents.add(address)
            pending.append(address)
        for area in areas or ():
            sheet, top, left, bottom, right = area
            assert sheet is not None, "the areas that a formula reads are on known sheets"
            if area.size > _SMALL_AREA:
                readers_of_area[sheet][area].append(address)
                continue
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    readers[sheet, row, column].append(address)
    while pending:
        sheet, row, column = address = pending.pop()
        large_areas = readers_of_area[sheet]
        hit = [area for area in large_areas if area.contains(row, column)]
        new = {*readers.pop(address, ()), *(reader for area in hit for reader in large_areas.pop(area))} - dependents
        dependents |= new
        pending += new
    return dependents


def _areas_read_by(workbook: WorkbookXml, address: Address, formula: str, depth: int = 0) -> list[Reference] | None:
    """Return the areas that a formula at `address` reads; None if they cannot be told from its text.

    `depth` counts the defined names through which the formula was reached.
    """
    try:
        functions = [token.value[:-1].upper() for token in tokenize_formula(formula) if token.type == "FUNC"]
    except NotComputable:
        return None
    if depth == _MAX_NESTED_NAMES or any(name in ("INDIRECT", "OFFSET") or ":" in name for name in functions):
        return None
    areas: list[Reference] = []
    for text in references_and_names(formula):
        if (area := parse_reference(text)) is None:
            if _OTHER_FILE.match(text):
                continue  # the cells of another file do not change with this one's
            table = workbook.tables.get(text.partition("[")[0].casefold())
            name_formula = workbook.defined_formula(address[0], text)
            if table is not None:
                areas.append(table)  # the whole table, whichever of its cells the formula means
            elif name_formula is None or (inner := _areas_read_by(workbook, address, name_formula, depth + 1)) is None:
                return None
            else:
                areas += inner
        elif area.sheet is not None and ":" in area.sheet:
            return None  # an area through several sheets
        elif (title := address[0] if area.sheet is None else workbook.find_title(area.sheet)) is not None:
            areas.append(area._replace(sheet=title))
    return areas
