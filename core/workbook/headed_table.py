"""A table as a sheet's headings describe it: which columns it has, and which rows hold modules."""

import re
from collections import defaultdict
from functools import cached_property

from ..geometry.scanner import Scanner
from ..scanner_kinds import SCANNERS
from .book import HEADING_ROWS, Book, Sheet, module_number
from .formulas import areas_in
from .headings import Heading, Vocabulary, is_label_heading, is_number_heading, plain, unit_of, vocabulary
from .layout import Table
from .sheet_xml import At

SCANNER_SHEETS = frozenset(("coordinates", "main"))
"""Sheets that hold the scanner in the users' workbooks."""
OTHER_SHEETS = frozenset(("mdsl cloud import", "theta", "values", "design table"))
"""Sheets that users' workbooks have beside these, whatever they hold."""

_ROWS_APART = 2
"""A row of symbols and a row of descriptions that are further apart do not belong together."""
_SUMMARY = re.compile(r"\b(SUM|AVERAGE|MEAN|MEDIAN|MIN|MAX|COUNT|COUNTA|STDEV|VAR|SUBTOTAL|AGGREGATE)[.SP]*\(", re.I)
_NUMERIC = re.compile(r"[\d.,eE+\-\s]+")


class HeadedTable(Table):
    """A sheet with headings that are understood, `headings`: column -> {row: what it says}, and what is under them."""

    def __init__(self, sheet: Sheet, words: Vocabulary, headings: dict[int, dict[int, Heading]]) -> None:
        self.sheet, self.words, self.declared, self.headings = sheet, words, words.columns, headings
        rows = [row for heads in self.headings.values() for row in heads]
        self.first_heading, self.last_heading = min(rows), max(rows)
        self.heading_rows = tuple(dict.fromkeys((self.first_heading, self.last_heading)))

    @cached_property
    def first_row(self) -> int:
        """The first row below with something other than text under a heading."""
        below = ((row, c) for row, c in sorted(self.sheet.cells) if row > self.last_heading and c in self.headings)
        return next((row for row, column in below if is_number(self.sheet, row, column)), self.last_heading + 1)

    @cached_property
    def head(self) -> dict[At, str]:
        """The texts from the first row of headings down to the first module, row by row."""
        return {at: text for at, text in self.sheet.texts.items() if self.first_heading <= at[0] < self.first_row}

    @cached_property
    def columns(self) -> dict[str, tuple[int, str]]:  # type: ignore[override]
        """Column of the scanner -> its first column in the sheet, and the unit."""
        found: dict[str, tuple[int, str]] = {}
        for column in sorted(self.headings):
            name = self.name_of(column)
            found.setdefault(name, (column, [*self.units(column), *self.declared[name].units][0]))
        return found

    def name_of(self, column: int) -> str:
        """The scanner's column that the first heading of a column names."""
        return next(iter(self.headings[column].values())).name

    def units(self, column: int) -> dict[str, At]:
        """The units that the headings of a column name, and a unit in a row of its own."""
        found: dict[str, At] = {}
        for at, text in self.head.items():
            if at[1] == column:
                heading = self.headings[column].get(at[0])
                unit = unit_of(text) if heading is None else heading.unit
                if unit is not None and unit in self.declared[self.name_of(column)].units:
                    found.setdefault(unit, at)
        return found

    def heading_place(self, column: int) -> str:
        """The first heading of a column, as a cell's name."""
        return self.sheet.place(next(iter(self.headings[column])), column)

    @cached_property
    def other_heads(self) -> dict[int, list[At]]:
        """The texts at the head of the columns that are not the scanner's."""
        columns = {column for _, column in self.head} - self.headings.keys()
        return {column: [at for at in self.head if at[1] == column] for column in sorted(columns)}

    @cached_property
    def numeric(self) -> set[int]:
        """The columns with numbers in the modules' rows."""
        rows = set(self.rows)
        return {column for row, column in self.sheet.cells if row in rows and is_number(self.sheet, row, column)}

    @cached_property
    def text_columns(self) -> set[int]:
        """The sheet's columns that hold texts of the scanner."""
        return {column for column in self.headings if self.declared[self.name_of(column)].is_text}

    def is_filled(self, name: str) -> bool:
        """Whether the table has this column of the scanner, with anything for it in the modules' rows."""
        if name not in self.columns:
            return False
        column = self.columns[name][0]
        texts = column in self.text_columns and any(self.sheet.value(row, column) is not None for row in self.rows)
        return texts or column in self.numeric

    @cached_property
    def label_headings(self) -> dict[str, At]:
        """The headings of other names of the modules."""
        return {plain(text).casefold(): at for at, text in self.head.items() if is_label_heading(text)}

    def unknown(self) -> list[tuple[At, str]]:
        """The headings over numbers that are not understood: of each column the first, and the texts of all."""
        found = []
        for column in self.other_heads.keys() & self.numeric - {self.label_column}:
            texts = {at: text for at in self.other_heads[column] if not self.words.is_known(text := self.head[at])}
            found += [(min(texts), " ".join(texts.values()))] if texts else []
        return sorted(found)

    @cached_property
    def _key_columns(self) -> list[int]:
        """The columns that make a row one of the table's: x1, y1, z1, or whatever typed columns there are."""
        position = self.declared.position
        names = position if position and self.columns.keys() >= set(position) else self.declared.typed
        return sorted(self.columns[name][0] for name in names if name in self.columns)

    @cached_property
    def number_columns(self) -> dict[int, At]:
        """The columns headed as the modules' numbers, with something under the heading, and these headings."""
        heads = {at[1]: at for at, text in self.head.items() if is_number_heading(text) and at[1] not in self.headings}
        return {column: at for column, at in heads.items() if self._values(column)}

    @cached_property
    def label_column(self) -> int | None:  # type: ignore[override]
        """The column of the modules' numbers or names: one that is headed so, or one without heading at the left."""
        if self.number_columns:
            return next(iter(self.number_columns))
        left = [column for column in range(1, min(self.headings)) if column not in self.other_heads]
        numbers = {c: [module_number(value) for value in self._values(c)] for c in left}
        size = len(self._filled_rows)
        whole = [c for c in left if 2 * len(set(numbers[c]) - {None}) > size]
        named = [c for c in left if len(set(self._values(c))) == size > 1 and set(numbers[c]) == {None}]
        return next(iter(whole + [c for c in named if all(type(value) is str for value in self._values(c))]), None)

    def _values(self, column: int) -> list[object]:
        values = (self.sheet.value(row, column) for row in self._filled_rows)
        return [value for value in values if value is not None]

    @cached_property
    def _filled_rows(self) -> list[int]:
        """The rows with anything but a note in the key columns, or with typed dimensions."""
        position = self.declared.position
        typed = [self.columns[name][0] for name in self.declared.typed if name in self.columns and name not in position]
        found: list[int] = []
        for row in self.sheet.rows:
            if row < self.first_row or row in self.summaries:
                continue
            values = [value for column in self._key_columns if (value := self.sheet.value(row, column)) is not None]
            alone = len(values) == 1 and type(values[0]) is str and not _NUMERIC.fullmatch(values[0])
            note = alone and len(self._key_columns) > 1 and row - 1 not in found[-1:]
            dimensions = [self.sheet.value(row, c) for c in typed if self.sheet.formula(row, c) is None]
            if (values and not note) or any(type(value) is float for value in dimensions):
                found.append(row)
        return found

    @cached_property
    def summaries(self) -> dict[int, At]:
        """The rows whose key columns hold nothing but sums, means ... of their columns, and the first of these cells."""
        found = {}
        for row in self.sheet.rows:
            filled = [(row, column) for column in self._key_columns if self.sheet.value(row, column) is not None]
            if filled and row >= self.first_row and all(self._is_summary(*at) for at in filled):
                found[row] = filled[0]
        return found

    def _is_summary(self, row: int, column: int) -> bool:
        formula = self.sheet.formula(row, column) or ""
        areas = [area for area in areas_in(formula) if area.sheet in (None, self.sheet.name) and area.top < area.bottom]
        return bool(_SUMMARY.search(formula)) and any(area.left <= column <= area.right for area in areas)

    @cached_property
    def rows(self) -> tuple[int, ...]:  # type: ignore[override]
        """The rows of the modules, including those with a number and nothing else: a blank is to be refused."""
        if self.label_column is None:
            return tuple(self._filled_rows)
        below = [row for row in self.sheet.rows if row >= self.first_row and row not in self.summaries]
        numbered = [row for row in below if module_number(self.sheet.value(row, self.label_column)) is not None]
        return tuple(sorted({*self._filled_rows, *numbered}))

    def is_single(self, name: str) -> bool:
        """Whether a column that each module must have is given once for all of them, in the table's first row."""
        column = self.columns[name][0]
        filled = [row for row in self.rows if self.sheet.value(row, column) is not None]
        return name in self.declared.dimensions and filled == [*self.rows[:1]]


def sheets_of(book: Book, scanner: type[Scanner]) -> dict[str, Sheet]:
    """The sheets that may hold a kind of scanner: its own one, or all that are not another kind's own."""
    if scanner.sheet:
        name = book.workbook.title(scanner.sheet) or scanner.sheet
        return {name: book.sheet(name, f", which holds a scanner of the kind {scanner.kind}")}
    others = {kind.sheet.casefold() for kind in SCANNERS.values()}
    return {name: sheet for name, sheet in book.sheets.items() if name.casefold() not in others}


def headed_tables(book: Book, scanner: type[Scanner]) -> tuple[dict[str, Sheet], list[HeadedTable]]:
    """The sheets that may hold a kind of scanner, and the tables in them, in the workbook's order.

    `OTHER_SHEETS` are passed over, unless sheets other than `SCANNER_SHEETS` hold tables.
    """
    sheets, words = sheets_of(book, scanner), vocabulary(scanner.columns)
    usual = {name: sheet for name, sheet in sheets.items() if plain(name).casefold() not in OTHER_SHEETS}
    tables = [table for sheet in usual.values() if (table := headed_table(sheet, words)) is not None]
    filled = [table.sheet.name for table in tables if any(map(table.is_filled, scanner.columns.typed))]
    if all(plain(name).casefold() in SCANNER_SHEETS for name in filled):
        return usual, tables
    return sheets, [table for sheet in sheets.values() if (table := headed_table(sheet, words)) is not None]


def headed_table(sheet: Sheet, words: Vocabulary) -> HeadedTable | None:
    """A sheet's table, None if it has no heading: the row with most headings, and the rows close to it."""
    rows: dict[int, dict[int, Heading]] = defaultdict(dict)
    for (row, column), text in sheet.texts.items():
        if row <= HEADING_ROWS and (heading := words.heading_of(text)) is not None:
            rows[row][column] = heading
    if not rows:
        return None
    main = max(rows, key=lambda row: (len({heading.name for heading in rows[row].values()}), -row))
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
    return HeadedTable(sheet, words, dict(headings))


def is_number(sheet: Sheet, row: int, column: int) -> bool:
    """Whether a cell holds anything but text or nothing."""
    value = sheet.value(row, column)
    return value is not None and type(value) is not str
