"""A sheet's headings, and the columns and rows under them."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass, field
from functools import cached_property

from .book import HEADING_ROWS, Book, Sheet
from .cells import module_number
from .headings import Heading, heading_of, is_label_heading, is_number_heading, plain, quoted, unit_of
from .layout import Table
from .quantities import DIMENSIONS, NEEDED, POSITION, QUANTITIES
from .references import Reference
from .sheet_xml import At
from .workbook_xml import areas_in

SCANNER_SHEETS = frozenset(("coordinates", "main"))
"""Sheets that hold the scanner in the users' workbooks."""
OWN_SHEETS = frozenset(("mdsl cloud import", "theta", "values", "design table"))
"""Sheets that users' workbooks carry beside these, whatever they hold."""
ASIDE = frozenset(("s", "3d slope"))
"""Headings of the users' workbooks whose columns are of no concern."""

_ROWS_APART = 2
"""A symbol row and a description row that are further apart do not belong together."""
_SUMMARY = re.compile(r"\b(SUM|AVERAGE|MEAN|MEDIAN|MIN|MAX|COUNT|COUNTA|STDEV|VAR|SUBTOTAL|AGGREGATE)[.SP]*\(", re.I)
_NUMERIC = re.compile(r"[\d.,eE+\-\s]+")


@dataclass(eq=False)
class SheetSeen:
    """A sheet that has headings, and what they say.

    Attributes
    ----------
    sheet : Sheet
    first_heading, last_heading : int
        The rows with headings.
    headings : dict
        Column -> {row: what its heading there says}.
    doubts : list of str
    """

    sheet: Sheet
    first_heading: int
    last_heading: int
    headings: dict[int, dict[int, Heading]]
    doubts: list[str] = field(default_factory=list)

    @cached_property
    def first_row(self) -> int:
        """The first row with a number, or with anything else than text, under a heading."""
        below = (row for row, column in self.sheet.cells if row > self.last_heading and column in self.headings)
        return next((row for row in sorted(set(below)) if self._has_number(row)), self.last_heading + 1)

    def _has_number(self, row: int) -> bool:
        return any(is_number(self.sheet, row, column) for column in self.headings)

    @cached_property
    def above(self) -> dict[At, str]:
        """The texts from the first row of headings to the first module."""
        found = {at: text for at, text in self.sheet.texts.items() if self.first_heading <= at[0] < self.first_row}
        return dict(sorted(found.items()))

    @cached_property
    def columns(self) -> dict[str, tuple[int, str]]:
        """Quantity -> column and unit."""
        found: dict[str, tuple[int, str]] = {}
        for column in sorted(self.headings):
            name, unit = self._column(column)
            if name in found:
                first = self._place(found[name][0])
                self.doubt(f"{first} and {self._place(column)} are both headed as {name}, expected one such column")
                continue
            found[name] = column, unit
        return found

    def _column(self, column: int) -> tuple[str, str]:
        said = self.headings[column]
        first = next(iter(said.values()))
        units = {}
        for (row, c), text in self.above.items():
            if c != column:
                continue
            heading, unit = said.get(row), unit_of(text)
            place = self.sheet.place(row, c)
            if heading is None and unit not in QUANTITIES[first.quantity].units:
                self.doubt(
                    f"{place} holds {quoted(text)} in the heading of {first.quantity}, expected its name and a unit alone"
                )
                continue
            if heading is not None and heading.quantity != first.quantity:
                self.doubt(
                    f"{place} is headed as {heading.quantity} but {self._place(column)} as {first.quantity}, expected "
                    "one of them"
                )
            if (unit := heading.unit if heading is not None else unit) is not None:
                units[unit] = place
        if len(units) > 1:
            (a, place), (b, other) = list(units.items())[:2]
            self.doubt(f"{place} says {a} but {other} {b}, expected one unit of {first.quantity}")
        for area in self.merged:
            if area.left < area.right and area.left <= column <= area.right and area.top in said:
                self.doubt(f"{self.sheet.place(area.top, area.left)} heads several columns as {first.quantity}, merged")
        return first.quantity, next(iter(units), next(iter(QUANTITIES[first.quantity].units)))

    def _place(self, column: int) -> str:
        return self.sheet.place(next(iter(self.headings[column])), column)

    def doubt(self, text: str) -> None:
        """Note a doubt about this sheet."""
        self.doubts.append(f"{self.sheet.book.path.name}: {text}")

    # Columns that are not understood

    @cached_property
    def aside(self) -> dict[int, list[At]]:
        """The texts at the head of the other columns."""
        found: dict[int, list[At]] = defaultdict(list)
        for at in self.above:
            if at[1] not in self.headings:
                found[at[1]].append(at)
        return found

    @cached_property
    def numeric(self) -> set[int]:
        """The columns with numbers in the modules' rows."""
        rows = set(self.rows)
        return {column for row, column in self.sheet.cells if row in rows and is_number(self.sheet, row, column)}

    @property
    def filled(self) -> list[str]:
        """What is needed and has numbers here."""
        return [name for name in (*NEEDED, "l") if name in self.columns and self.columns[name][0] in self.numeric]

    @property
    def label_headings(self) -> dict[str, At]:
        """The headings of other names of the modules."""
        return {plain(text).casefold(): at for at, text in self.above.items() if is_label_heading(text)}

    def unknown(self) -> list[tuple[At, str]]:
        """The headings over numbers that are none of a known column's."""
        known = {column for column in (self.label_column,) if column is not None}
        return [
            (at, text)
            for column, places in self.aside.items()
            if column in self.numeric - known
            for at in places
            if not (is_number_heading(text := self.above[at]) or is_label_heading(text))
            and plain(text).casefold() not in ASIDE
        ]

    # Rows

    @property
    def wanted(self) -> list[int]:
        """The columns that make a row one of the table's."""
        names = POSITION if self.columns.keys() >= set(POSITION) else (*NEEDED, "l")
        return sorted(self.columns[name][0] for name in names if name in self.columns)

    @cached_property
    def label_column(self) -> int | None:
        """The column of the modules' numbers or names: one that is headed so, or one without heading at the left."""
        headed = {
            at[1]: at for at, text in self.above.items() if is_number_heading(text) and at[1] not in self.headings
        }
        filled = [column for column in headed if self._filled(column)]
        if len(filled) > 1:
            places = [self.sheet.place(*headed[column]) for column in filled]
            self.doubt(f"{places[0]} and {places[1]} both head the modules' numbers, expected one such column")
        if filled:
            return filled[0]
        left = [column for column in range(1, min(self.headings)) if column not in self.aside]
        numbers = {c: [module_number(value) for value in self._filled(c)] for c in left}
        size = len(self._sized)
        whole = [c for c in left if 2 * len(set(numbers[c]) - {None}) > size]
        named = [c for c in left if len(set(self._filled(c))) == size > 1 and set(numbers[c]) == {None}]
        return next(iter(whole + [c for c in named if all(type(value) is str for value in self._filled(c))]), None)

    def _filled(self, column: int) -> list[object]:
        values = (self.sheet.value(row, column) for row in self._sized)
        return [value for value in values if value is not None]

    @cached_property
    def _sized(self) -> list[int]:
        """The rows with numbers, or with what cannot be a note, in the wanted columns; or with typed dimensions."""
        typed = [self.columns[name][0] for name in (*DIMENSIONS, "l") if name in self.columns]
        found: list[int] = []
        wanted = self.wanted
        for row in self.sheet.rows:
            if row < self.first_row or row in self.summaries:
                continue
            values = [value for column in wanted if (value := self.sheet.value(row, column)) is not None]
            alone = len(values) == 1 and type(values[0]) is str and not _NUMERIC.fullmatch(values[0])
            note = alone and len(wanted) > 1 and row - 1 not in found[-1:]
            if (values and not note) or any(self._is_typed(row, column) for column in typed):
                found.append(row)
        return found

    @cached_property
    def summaries(self) -> dict[int, At]:
        """The rows that sum up others: each number in the wanted columns is a sum, mean ... of its column."""
        found, wanted = {}, self.wanted
        for row in self.sheet.rows:
            filled = [(row, column) for column in wanted if self.sheet.value(row, column) is not None]
            if filled and row >= self.first_row and all(self._sums_up(*at) for at in filled):
                found[row] = filled[0]
        return found

    def _sums_up(self, row: int, column: int) -> bool:
        """Whether a cell's formula is a sum, mean ... over several rows of its own column."""
        formula = self.sheet.formula(row, column)
        if formula is None or not _SUMMARY.search(formula):
            return False
        return any(
            area.top < area.bottom and area.left <= column <= area.right and area.sheet in (None, self.sheet.name)
            for area in areas_in(formula)
        )

    def _is_typed(self, row: int, column: int) -> bool:
        return self.sheet.formula(row, column) is None and type(self.sheet.value(row, column)) is float

    @cached_property
    def rows(self) -> tuple[int, ...]:
        """The rows of the modules, those with a number but nothing else included: a blank is to be refused."""
        if self.label_column is None:
            return tuple(self._sized)
        sized = set(self._sized)
        return tuple(
            row
            for row in self.sheet.rows
            if row in sized
            or (
                row >= self.first_row
                and row not in self.summaries
                and module_number(self.sheet.value(row, self.label_column)) is not None
            )
        )

    def table(self) -> Table:
        """The table, as far as it is understood."""
        return Table(self.sheet, self.columns, self.rows, self.label_column)

    # Around them

    @property
    def merged(self) -> list[Reference]:
        """Cells that are shown as one."""
        return self.sheet.book.workbook.sheets[self.sheet.name].merged

    @cached_property
    def texts_of_row(self) -> dict[int, list[At]]:
        """Where the texts of each row stand."""
        found: dict[int, list[At]] = defaultdict(list)
        for at in sorted(self.sheet.texts):
            found[at[0]].append(at)
        return found


def sheets_seen(book: Book) -> tuple[dict[str, Sheet], list[SheetSeen]]:
    """The sheets that may hold the scanner, and those of them with headings, in the workbook's order.

    The users' own sheets are passed over, unless other sheets than the users' Coordinates and Main hold tables.
    """
    sheets = {name: sheet for name, sheet in book.sheets.items() if not _is_called(name, OWN_SHEETS)}
    seen = [found for sheet in sheets.values() if (found := sheet_seen(sheet)) is not None]
    if all(_is_called(found.sheet.name, SCANNER_SHEETS) for found in seen if found.filled):
        return sheets, seen
    every = {found.sheet.name: found for found in seen}
    every |= {name: found for name in book.sheets.keys() - sheets if (found := sheet_seen(book.sheets[name]))}
    return book.sheets, [every[name] for name in book.sheets if name in every]


def _is_called(name: str, names: frozenset[str]) -> bool:
    return plain(name).casefold() in names


def sheet_seen(sheet: Sheet) -> SheetSeen | None:
    """A sheet's headings, None where it has none."""
    rows: dict[int, dict[int, Heading]] = defaultdict(dict)
    for (row, column), text in sheet.texts.items():
        if row <= HEADING_ROWS and (heading := heading_of(text)) is not None:
            rows[row][column] = heading
    if not rows:
        return None
    main = max(rows, key=lambda row: (len({heading.quantity for heading in rows[row].values()}), -row))
    chosen = {main}
    for step in (-1, 1):
        for row in sorted(rows, key=lambda row: step * row):
            near = 0 < step * (row - (min(chosen) if step < 0 else max(chosen))) <= _ROWS_APART
            if near and not any(is_number(sheet, row, column) for column in rows[main]):
                chosen.add(row)
    headings: dict[int, dict[int, Heading]] = defaultdict(dict)
    for row in sorted(chosen):
        for column, heading in rows[row].items():
            headings[column][row] = heading
    return SheetSeen(sheet, min(chosen), max(chosen), dict(headings))


def is_number(sheet: Sheet, row: int, column: int) -> bool:
    """Whether a cell holds anything but text or nothing."""
    value = sheet.value(row, column)
    return value is not None and type(value) is not str


def several(units: set[str]) -> str:
    """Units as messages list them."""
    return " and ".join(sorted(units))
