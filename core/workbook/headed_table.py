"""Tables as the headings of sheets describe them: their columns, and the rows that hold modules."""

import re
from collections import defaultdict
from functools import cached_property

from ..geometry.scanner import Scanner
from ..scanner_kinds import SCANNERS
from .book import HEADING_ROWS, Book, Sheet, parse_module_number
from .formulas import referenced_areas
from .headings import Heading, Vocabulary, get_vocabulary, is_label_heading, is_number_heading, normalize, parse_unit
from .layout import ModuleTable
from .sheet_xml import Position

SCANNER_SHEETS = frozenset(("coordinates", "main"))
"""Case-folded names of the sheets that hold the scanner in the users' workbooks."""
OTHER_SHEETS = frozenset(("mdsl cloud import", "theta", "values", "design table"))
"""Case-folded names of the sheets that users' workbooks have beside the scanner's, whatever they hold."""

_MAX_HEADING_DISTANCE = 2
"""Largest distance of a row of symbols from a row of descriptions that belongs to it."""
_SUMMARY = re.compile(r"\b(SUM|AVERAGE|MEAN|MEDIAN|MIN|MAX|COUNT|COUNTA|STDEV|VAR|SUBTOTAL|AGGREGATE)[.SP]*\(", re.I)
_NUMERIC = re.compile(r"[\d.,eE+\-\s]+")


class HeadedTable(ModuleTable):
    """Table of modules in a sheet, found by the headings of its columns.

    `headings` is column of the sheet -> {row: meaning of the heading there}, of all headings that are understood.
    """

    def __init__(self, sheet: Sheet, vocabulary: Vocabulary, headings: dict[int, dict[int, Heading]]) -> None:
        self.sheet, self.vocabulary, self.definitions, self.headings = sheet, vocabulary, vocabulary.columns, headings
        rows = [row for heading_of_row in self.headings.values() for row in heading_of_row]
        self.first_heading, self.last_heading = min(rows), max(rows)
        """First and last row of the headings."""
        self.heading_rows = tuple(dict.fromkeys((self.first_heading, self.last_heading)))

    @cached_property
    def first_row(self) -> int:
        """First row below the headings with anything but text in a column of the scanner."""
        below = ((row, c) for row, c in sorted(self.sheet.cells) if row > self.last_heading and c in self.headings)
        return next((row for row, column in below if holds_non_text(self.sheet, row, column)), self.last_heading + 1)

    @cached_property
    def head_texts(self) -> dict[Position, str]:
        """Texts from the first row of headings down to the first module, row by row."""
        return {p: text for p, text in self.sheet.texts.items() if self.first_heading <= p[0] < self.first_row}

    @cached_property
    def columns(self) -> dict[str, tuple[int, str]]:  # type: ignore[override]
        """Name of the scanner's column -> the first column of the sheet that is headed so, and its unit."""
        columns: dict[str, tuple[int, str]] = {}
        for column in sorted(self.headings):
            name = self.name_of_column(column)
            columns.setdefault(name, (column, [*self.units(column), *self.definitions[name].units][0]))
        return columns

    def name_of_column(self, column: int) -> str:
        """Return the name of the scanner's column that the first heading of a column of the sheet states."""
        return next(iter(self.headings[column].values())).name

    def units(self, column: int) -> dict[str, Position]:
        """Return the units that the head of a column states, in a heading or in a row of its own: unit -> first cell."""
        units: dict[str, Position] = {}
        for position, text in self.head_texts.items():
            if position[1] == column:
                heading = self.headings[column].get(position[0])
                unit = parse_unit(text) if heading is None else heading.unit
                if unit is not None and unit in self.definitions[self.name_of_column(column)].units:
                    units.setdefault(unit, position)
        return units

    def heading_address(self, column: int) -> str:
        """Return the address of a column's first heading, such as ``Coordinates!B1``."""
        return self.sheet.address(next(iter(self.headings[column])), column)

    @cached_property
    def unrelated_heads(self) -> dict[int, dict[Position, str]]:
        """Column of the sheet that is no column of the scanner -> position and text of each cell at its head."""
        columns = {column for _, column in self.head_texts} - self.headings.keys()
        return {c: {p: text for p, text in self.head_texts.items() if p[1] == c} for c in sorted(columns)}

    @cached_property
    def numeric_columns(self) -> set[int]:
        """Columns with anything but text in the modules' rows."""
        rows = set(self.rows)
        return {column for row, column in self.sheet.cells if row in rows and holds_non_text(self.sheet, row, column)}

    @cached_property
    def text_columns(self) -> set[int]:
        """Columns of the sheet that hold texts of the scanner."""
        return {column for column in self.headings if self.definitions[self.name_of_column(column)].is_text}

    def is_filled(self, name: str) -> bool:
        """Return whether the table has this column of the scanner, with anything for it in the modules' rows."""
        if name not in self.columns:
            return False
        column = self.columns[name][0]
        has_text = column in self.text_columns and any(self.sheet.value(row, column) is not None for row in self.rows)
        return has_text or column in self.numeric_columns

    @cached_property
    def label_headings(self) -> dict[str, Position]:
        """Headings of columns with other names of the modules: case-folded heading -> cell."""
        return {normalize(text).casefold(): p for p, text in self.head_texts.items() if is_label_heading(text)}

    def unknown_headings(self) -> list[tuple[Position, str]]:
        """Return the headings over numbers that are not understood: per column the first cell, and the texts of all."""
        unknown = []
        for column in self.unrelated_heads.keys() & self.numeric_columns - {self.label_column}:
            heads = self.unrelated_heads[column].items()
            texts = {position: text for position, text in heads if not self.vocabulary.is_unrelated(text)}
            unknown += [(min(texts), " ".join(texts.values()))] if texts else []
        return sorted(unknown)

    @cached_property
    def _key_columns(self) -> list[int]:
        """Columns that make a row one of the table's: those of x1, y1, z1 if it has all, else all typed columns."""
        position = self.definitions.position
        names = position if position and self.columns.keys() >= set(position) else self.definitions.typed
        return sorted(self.columns[name][0] for name in names if name in self.columns)

    @cached_property
    def number_columns(self) -> dict[int, Position]:
        """Column that is headed as the modules' numbers and not empty -> its heading."""
        heads = {position[1]: position for position, text in self.head_texts.items() if is_number_heading(text)}
        return {c: position for c, position in heads.items() if c not in self.headings and self._filled_values(c)}

    @cached_property
    def label_column(self) -> int | None:  # type: ignore[override]
        """Column of the modules' numbers or names: one that is headed so, or one without heading left of the others."""
        if self.number_columns:
            return next(iter(self.number_columns))
        unheaded = [column for column in range(1, min(self.headings)) if column not in self.unrelated_heads]
        numbers = {c: [parse_module_number(value) for value in self._filled_values(c)] for c in unheaded}
        size = len(self._filled_rows)
        numbered = [c for c in unheaded if 2 * len(set(numbers[c]) - {None}) > size]
        distinct = [c for c in unheaded if len(set(self._filled_values(c))) == size > 1 and set(numbers[c]) == {None}]
        return next(iter(numbered + [c for c in distinct if all(type(v) is str for v in self._filled_values(c))]), None)

    def _filled_values(self, column: int) -> list[object]:
        """Return the values of a column in `_filled_rows`, without blank cells."""
        values = (self.sheet.value(row, column) for row in self._filled_rows)
        return [value for value in values if value is not None]

    @cached_property
    def _filled_rows(self) -> list[int]:
        """Rows with anything but a lone note in the key columns, or with typed dimensions; summary rows are left out."""
        names = (name for name in self.definitions.typed if name not in self.definitions.position)
        dimension_columns = [self.columns[name][0] for name in names if name in self.columns]
        filled_rows: list[int] = []
        for row in self.sheet.rows:
            if row < self.first_row or row in self.summary_rows:
                continue
            values = [value for column in self._key_columns if (value := self.sheet.value(row, column)) is not None]
            is_text = len(values) == 1 and type(values[0]) is str and not _NUMERIC.fullmatch(values[0])
            # A single text right below a module is an error in that row, not a note below the table.
            is_note = is_text and len(self._key_columns) > 1 and row - 1 not in filled_rows[-1:]
            dimensions = [self.sheet.value(row, c) for c in dimension_columns if self.sheet.formula(row, c) is None]
            if (values and not is_note) or any(type(value) is float for value in dimensions):
                filled_rows.append(row)
        return filled_rows

    @cached_property
    def summary_rows(self) -> dict[int, Position]:
        """Row whose key columns hold nothing but sums, means ... of their columns -> the first of these cells."""
        summaries = {}
        for row in self.sheet.rows:
            filled = [(row, column) for column in self._key_columns if self.sheet.value(row, column) is not None]
            if filled and row >= self.first_row and all(self._is_summary(*position) for position in filled):
                summaries[row] = filled[0]
        return summaries

    def _is_summary(self, row: int, column: int) -> bool:
        """Return whether a cell has a sum, a mean or the like over several rows of its own column."""
        formula = self.sheet.formula(row, column) or ""
        areas = (a for a in referenced_areas(formula) if a.sheet in (None, self.sheet.name) and a.top < a.bottom)
        return bool(_SUMMARY.search(formula)) and any(area.left <= column <= area.right for area in areas)

    @cached_property
    def rows(self) -> tuple[int, ...]:  # type: ignore[override]
        """Rows of the modules; a row with a number and nothing else is one, so that its blanks are refused."""
        if self.label_column is None:
            return tuple(self._filled_rows)
        below = [row for row in self.sheet.rows if row >= self.first_row and row not in self.summary_rows]
        numbered = [row for row in below if parse_module_number(self.sheet.value(row, self.label_column)) is not None]
        return tuple(sorted({*self._filled_rows, *numbered}))

    def is_given_once(self, name: str) -> bool:
        """Return whether a dimension of the modules is given once for all of them, in the table's first row."""
        column = self.columns[name][0]
        filled = [row for row in self.rows if self.sheet.value(row, column) is not None]
        return name in self.definitions.dimensions and filled == [*self.rows[:1]]


def candidate_sheets(book: Book, scanner: type[Scanner]) -> dict[str, Sheet]:
    """Return the sheets that may hold a kind of scanner: the sheet of the kind, or all that are no other kind's sheet."""
    if scanner.sheet:
        name = book.workbook.find_title(scanner.sheet) or scanner.sheet
        return {name: book.sheet(name, f", which holds a scanner of the kind {scanner.kind}")}
    sheets_of_kinds = {kind.sheet.casefold() for kind in SCANNERS.values()}
    return {name: sheet for name, sheet in book.sheets.items() if name.casefold() not in sheets_of_kinds}


def find_headed_tables(book: Book, scanner: type[Scanner]) -> tuple[dict[str, Sheet], list[HeadedTable]]:
    """Return the sheets that may hold a kind of scanner, and the tables in them, in the workbook's order.

    `OTHER_SHEETS` are passed over, unless sheets other than `SCANNER_SHEETS` hold tables.
    """
    sheets, vocabulary = candidate_sheets(book, scanner), get_vocabulary(scanner.columns)
    usual = {name: sheet for name, sheet in sheets.items() if normalize(name).casefold() not in OTHER_SHEETS}
    tables = [table for sheet in usual.values() if (table := find_headed_table(sheet, vocabulary)) is not None]
    filled = [table.sheet.name for table in tables if any(map(table.is_filled, scanner.columns.typed))]
    if all(normalize(name).casefold() in SCANNER_SHEETS for name in filled):
        return usual, tables
    return sheets, [table for sheet in sheets.values() if (table := find_headed_table(sheet, vocabulary)) is not None]


def find_headed_table(sheet: Sheet, vocabulary: Vocabulary) -> HeadedTable | None:
    """Return the table of a sheet, None if it has no heading.

    Its headings are those in the row with most of them and in the rows close to that one.
    """
    rows: dict[int, dict[int, Heading]] = defaultdict(dict)
    for (row, column), text in sheet.texts.items():
        if row <= HEADING_ROWS and (heading := vocabulary.parse_heading(text)) is not None:
            rows[row][column] = heading
    if not rows:
        return None
    main = max(rows, key=lambda row: (len({heading.name for heading in rows[row].values()}), -row))
    chosen = {main}
    for step in (-1, 1):
        for row in sorted(rows, key=lambda row: step * row):
            is_close = 0 < step * (row - (min(chosen) if step < 0 else max(chosen))) <= _MAX_HEADING_DISTANCE
            if is_close and not any(holds_non_text(sheet, row, column) for column in rows[main]):
                chosen.add(row)
    headings: dict[int, dict[int, Heading]] = defaultdict(dict)
    for row in sorted(chosen):
        for column, heading in rows[row].items():
            headings[column][row] = heading
    return HeadedTable(sheet, vocabulary, dict(headings))


def holds_non_text(sheet: Sheet, row: int, column: int) -> bool:
    """Return whether a cell holds anything but text, such as a number or an error."""
    value = sheet.value(row, column)
    return value is not None and type(value) is not str
