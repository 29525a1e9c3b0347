"""A first column map for a person to check, and what the cells of a workbook show."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from ..errors import InputError
from ..files import AnyPath
from ..geometry.columns import ColumnTable
from ..recording import recorded_warnings
from ..scanner_kinds import scanner_kind
from .book import HEADING_ROWS, Book, Outdated, Sheet, shortened
from .calculation import Uncomputed
from .column_map import ColumnMap, Joined, MappedColumn, MappedTable
from .headed_table import HeadedTable
from .headings import is_number_heading, vocabulary
from .recognition import recognize, recognized_layout


@dataclass(frozen=True)
class ColumnMapDraft:
    """A best guess at a workbook's column map."""

    columns: ColumnMap
    """For a person to check; units that are stated nowhere are empty, and what was not found is missing."""
    questions: tuple[str, ...]
    """What is uncertain or missing, a line each; empty if the headings are understood."""

    def write(self, path: AnyPath) -> None:
        """Write the map as TOML, with the questions as comments above it."""
        lines = ["A draft of what the workbook's cells hold. Check every line.", *self.questions]
        self.columns.write(path, "\n".join(lines))


def draft_column_map(path: AnyPath, kind: str = "pinhole") -> ColumnMapDraft:
    """A best guess at a workbook's column map for a kind of scanner, for a person to check.

    For a workbook that `read_scanner` understands, it is the map that says the same.
    """
    book, scanner = Book(path), scanner_kind(kind)
    declared, found = scanner.columns, recognize(book, scanner)
    questions, certain = found.doubts, True
    try:
        with recorded_warnings():  # given when the workbook is read
            recognized_layout(book, scanner)
    except InputError as error:
        questions, certain = questions or [str(error).removeprefix(f"{book.path.name}: ")], False
    optional = found.tables.keys() - set(declared.needed) if certain else ()
    partial = {name for name in optional if _has_gaps(found.tables[name], name)}
    chosen = {name: table for name, table in found.tables.items() if name not in partial}
    tables = [mapped for table in dict.fromkeys(chosen.values()) for mapped in _mapped(table, chosen, certain)]
    for name in declared.optional:
        if name in partial and found.tables[name].is_filled(name):
            used = declared[name].fallback.removesuffix("'s")
            questions.append(f"{name} stands in some rows only and is left out here: {used} is then used for all")
    missing = [name for name in declared.typed if name not in found.tables and not declared[name].is_text]
    if not certain:
        _add_guesses(tables, found.sheets, declared, missing)
    if missing and not tables:
        tables = [MappedTable(next(iter(book.sheets), "Coordinates"), 2, 2, ())]
    leading = {declared.leading, *declared.position}
    tables.sort(key=lambda table: leading.isdisjoint(c.quantity for c in table.columns))
    for i, table in enumerate(tables):
        joined: Joined = "by number" if tables[0].number and table.number else "in order"
        tables[i] = replace(table, rows=None if i == 0 else table.rows or joined)
    columns = ColumnMap(tuple(tables))
    return ColumnMapDraft(columns, tuple(dict.fromkeys([*questions, *columns.faults(kind)])))


def _has_gaps(table: HeadedTable, name: str) -> bool:
    """Whether cells of a column are blank or cannot be computed, which a map allows of texts alone."""
    values = [table.sheet.value(row, table.columns[name][0]) for row in table.rows]
    return not table.declared[name].is_text and any(value is None or isinstance(value, Uncomputed) for value in values)


def _mapped(table: HeadedTable, chosen: dict[str, HeadedTable], certain: bool) -> Iterator[MappedTable]:
    """A table's part in the map: its rows, and apart from these what a single row gives for all modules."""
    rows, sheet = table.rows or (table.first_row,), table.sheet
    each: dict[str, tuple[int, str]] = {}
    once: dict[str, tuple[int, str]] = {}
    for name in (*table.declared.typed, *table.declared.derived):
        if chosen.get(name) is table:
            column, unit = table.columns[name]
            is_single = table.is_single(name) and (len(rows) > 1 or table is not chosen.get(table.declared.leading))
            (once if is_single else each)[name] = column, unit if certain or table.units(column) else ""
    if each:
        yield _mapped_table(sheet, rows, each, table.first_heading, table.label_column)
    if once:
        yield _mapped_table(sheet, rows[:1], once, table.first_heading, rows_are="one for all")


def _mapped_table(
    sheet: Sheet,
    rows: Sequence[int],
    columns: dict[str, tuple[int, str]],
    header_row: int,
    number: int | None = None,
    rows_are: Joined | None = None,
) -> MappedTable:
    from openpyxl.utils import get_column_letter as letters

    mapped = tuple(MappedColumn(name, letters(column), unit) for name, (column, unit) in columns.items())
    table = MappedTable(sheet.name, 0, 0, mapped, None if number is None else letters(number), rows_are, header_row)
    return table.with_rows(rows)


def _add_guesses(
    tables: list[MappedTable], sheets: dict[str, Sheet], declared: ColumnTable, missing: list[str]
) -> None:
    """Add columns whose headings speak of what is missing, to the table with the same rows if there is one."""
    used = {(table.sheet, c.column) for table in tables for c in table.columns}
    for name in missing:
        guesses = (guess for sheet in sheets.values() for guess in _guesses(sheet, declared, name))
        guess = next((guess for guess in guesses if (guess.sheet, guess.columns[0].column) not in used), None)
        if guess is None:
            continue
        used.add((guess.sheet, guess.columns[0].column))
        rows = (guess.sheet, guess.first_row, guess.last_row)
        same = [i for i, table in enumerate(tables) if (table.sheet, table.first_row, table.last_row) == rows]
        if same:
            tables[same[0]] = replace(tables[same[0]], columns=tables[same[0]].columns + guess.columns)
        else:
            tables.append(guess)


def _guesses(sheet: Sheet, declared: ColumnTable, name: str) -> Iterator[MappedTable]:
    """Columns with numbers under a heading that may mean a column of the scanner."""
    words = vocabulary(declared)
    headings = {at: text for at, text in sheet.texts.items() if at[0] <= HEADING_ROWS}
    numbers = {column for (_, column), text in headings.items() if is_number_heading(text)}
    for (row, column), text in headings.items():
        below = [r for r in sheet.rows if r > row and type(sheet.value(r, column)) is float]
        if below and name in words.may_mean(text) and words.heading_of(text) is None:
            rows, columns = range(below[0], below[-1] + 1), {name: (column, "")}
            if len(rows) == 1 and name not in declared.position:
                yield _mapped_table(sheet, rows, columns, row, rows_are="one for all")
            else:
                yield _mapped_table(sheet, rows, columns, row, next(iter(numbers)) if len(numbers) == 1 else None)


def preview_workbook(path: AnyPath, rows: int = 20, columns: int = 26) -> dict[str, tuple[tuple[str, ...], ...]]:
    """What the first `rows` and `columns` of each sheet show: sheet -> rows of short texts.

    They begin with row 1 and column A; a blank cell is an empty text, and a smaller sheet gives what it has.
    """
    found = {}
    for name, sheet in Book(path).sheets.items():
        bottom, right = map(min, (rows, columns), sheet.book.workbook.extent(name))
        cells = [[_text(sheet.value(row, column)) for column in range(1, right + 1)] for row in range(1, bottom + 1)]
        found[name] = tuple(map(tuple, cells))
    return found


def _text(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, Uncomputed):
        return "(no value)"
    if isinstance(value, Outdated):
        return f"{_text(value.stored)} (outdated: {_text(value.computed)})"
    return shortened(f"{value:.9g}" if type(value) is float else str(value))
