"""Draft of a column map for a person to check, and preview of a workbook's cells."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from ..errors import InputError
from ..files import AnyPath
from ..geometry.columns import LENGTH_UNITS, ColumnTable
from ..recording import recorded_warnings
from ..scanner_kinds import scanner_kind
from .book import HEADING_ROWS, Book, OutdatedValue, Sheet, shorten
from .calculation import UncomputedValue
from .column_map import ColumnMap, MappedColumn, MappedTable, RowMatching
from .headed_table import HeadedTable
from .headings import get_vocabulary, is_number_heading, quote_text, units_mentioned
from .recognition import headed_layout, recognize_tables


@dataclass(frozen=True)
class ColumnMapDraft:
    """Best guess at a workbook's column map."""

    columns: ColumnMap
    """The map for a person to check; units that are stated nowhere are empty, columns that were not found are missing."""
    questions: tuple[str, ...]
    """The uncertain and the missing points, a line each; empty if the headings are understood."""

    def write(self, path: AnyPath) -> None:
        """Write the map as TOML, with the questions as comments above it."""
        lines = ["A draft of what the workbook's cells hold. Check every line.", *self.questions]
        self.columns.write(path, "\n".join(lines))


def draft_column_map(path: AnyPath, kind: str = "pinhole") -> ColumnMapDraft:
    """Return a best guess at a workbook's column map for a kind of scanner, for a person to check.

    For a workbook that `read_scanner` understands, the map says the same as the headings.
    """
    book, scanner = Book(path), scanner_kind(kind)
    definitions, recognized = scanner.columns, recognize_tables(book, scanner)
    questions, is_certain = recognized.doubts, True
    try:
        with recorded_warnings():  # they are given when the workbook is read
            headed_layout(book, scanner)
    except InputError as error:
        is_certain = False
        if not questions and not recognized.missing:
            questions = [str(error).removeprefix(f"{book.path.name}: ")]
    optional = recognized.tables.keys() - set(definitions.needed) if is_certain else ()
    incomplete = {name for name in optional if _has_gaps(recognized.tables[name], name)}
    table_of = {name: table for name, table in recognized.tables.items() if name not in incomplete}
    tables = [m for table in dict.fromkeys(table_of.values()) for m in _map_table(table, table_of, is_certain)]
    for name in definitions.optional:
        if name in incomplete and recognized.tables[name].is_filled(name):
            used = definitions[name].fallback.removesuffix("'s")
            questions.append(f"{name} stands in some rows only and is left out here: {used} is then used for all")
    missing = [name for name in definitions.typed if name not in recognized.tables and not definitions[name].is_text]
    if not is_certain:
        guesses = _add_guesses(tables, recognized.sheets, definitions, missing)
        # A doubt names the heading already where its table is recognized.
        guesses = {name: text for name, text in guesses.items() if not any(text in doubt for doubt in questions)}
        if guesses:
            questions.append(f"guessed by the headings: {', '.join(map(' '.join, guesses.items()))}")
        questions += _propose_units(tables, recognized.sheets, definitions)
    if missing and not tables:
        tables = [MappedTable(next(iter(book.sheets), "Coordinates"), 2, 2, ())]
    leading = {definitions.leading, *definitions.position}
    tables.sort(key=lambda table: leading.isdisjoint(c.quantity for c in table.columns))
    for i, table in enumerate(tables):
        matching: RowMatching = "by number" if tables[0].number and table.number else "in order"
        tables[i] = replace(table, rows=None if i == 0 else table.rows or matching)
    column_map = ColumnMap(tuple(tables))
    return ColumnMapDraft(column_map, tuple(dict.fromkeys([*questions, *column_map.faults(kind)])))


def _has_gaps(table: HeadedTable, name: str) -> bool:
    """Return whether cells of a column are blank or cannot be computed, which a map allows of texts alone."""
    values = [table.sheet.value(row, table.columns[name][0]) for row in table.rows]
    return not table.definitions[name].is_text and any(v is None or isinstance(v, UncomputedValue) for v in values)


def _map_table(table: HeadedTable, table_of: dict[str, HeadedTable], is_certain: bool) -> Iterator[MappedTable]:
    """Yield the tables of a column map for a table with headings: its rows, and its first row for values of all modules.

    `table_of` is name of a scanner's column -> the table that it is read from.
    """
    rows, sheet = table.rows or (table.first_row,), table.sheet
    per_module: dict[str, tuple[int, str]] = {}
    for_all: dict[str, tuple[int, str]] = {}
    is_leading = table is table_of.get(table.definitions.leading)
    for name in (*table.definitions.typed, *table.definitions.derived):
        if table_of.get(name) is table:
            column, unit = table.columns[name]
            is_for_all = table.is_given_once(name) and (len(rows) > 1 or not is_leading)
            (for_all if is_for_all else per_module)[name] = column, unit if is_certain or table.units(column) else ""
    if per_module:
        yield _mapped_table(sheet, rows, per_module, table.first_heading, table.label_column)
    if for_all:
        yield _mapped_table(sheet, rows[:1], for_all, table.first_heading, matching="one for all")


def _mapped_table(
    sheet: Sheet,
    rows: Sequence[int],
    columns: dict[str, tuple[int, str]],
    header_row: int,
    number: int | None = None,
    matching: RowMatching | None = None,
) -> MappedTable:
    """Return a table of a column map; `columns` is name of a scanner's column -> (column of the sheet, unit)."""
    from openpyxl.utils import get_column_letter as letters

    mapped = tuple(MappedColumn(name, letters(column), unit) for name, (column, unit) in columns.items())
    table = MappedTable(sheet.name, 0, 0, mapped, None if number is None else letters(number), matching, header_row)
    return table.with_rows(rows)


def _add_guesses(
    tables: list[MappedTable], sheets: dict[str, Sheet], definitions: ColumnTable, missing: list[str]
) -> dict[str, str]:
    """Add columns whose headings may name a missing column, to the table with the same rows if there is one.

    Return the headings, in quotes, by name of the column.
    """
    from openpyxl.utils import column_index_from_string

    guessed: dict[str, str] = {}
    used_columns = {(table.sheet, c.column) for table in tables for c in table.columns}
    for name in missing:
        guesses = (guess for sheet in sheets.values() for guess in _guess_columns(sheet, definitions, name))
        guess = next((guess for guess in guesses if (guess.sheet, guess.columns[0].column) not in used_columns), None)
        if guess is None:
            continue
        used_columns.add((guess.sheet, guess.columns[0].column))
        heading = sheets[guess.sheet].texts[guess.header_row or 0, column_index_from_string(guess.columns[0].column)]
        guessed[name] = quote_text(heading)
        row_range = (guess.sheet, guess.first_row, guess.last_row)
        matches = [i for i, table in enumerate(tables) if (table.sheet, table.first_row, table.last_row) == row_range]
        if matches:
            tables[matches[0]] = replace(tables[matches[0]], columns=tables[matches[0]].columns + guess.columns)
        else:
            tables.append(guess)
    return guessed


def _propose_units(tables: list[MappedTable], sheets: dict[str, Sheet], definitions: ColumnTable) -> Iterator[str]:
    """Fill in the unit of lengths that have none, if sheet's name and titles mention one; yield what is to be checked."""
    for i, table in enumerate(tables):
        titles = [text for (row, _), text in sheets[table.sheet].texts.items() if row < (table.header_row or 0)]
        units = {unit for text in (table.sheet.replace("_", " "), *titles) for unit in units_mentioned(text)}
        names = [c.quantity for c in table.columns if not c.unit and definitions[c.quantity].kind == "length"]
        if names and len(units) == 1 and units <= LENGTH_UNITS.keys():
            (unit,) = units
            columns = tuple(replace(c, unit=unit) if c.quantity in names else c for c in table.columns)
            tables[i] = replace(table, columns=columns)
            yield f"{unit}, of the title of sheet {table.sheet}, is proposed for {', '.join(names)}"


def _guess_columns(sheet: Sheet, definitions: ColumnTable, name: str) -> Iterator[MappedTable]:
    """Yield a table of one column for each column of numbers under a heading that may mean the scanner's column `name`."""
    vocabulary = get_vocabulary(definitions)
    headings = {position: text for position, text in sheet.texts.items() if position[0] <= HEADING_ROWS}
    numbered = {column for (_, column), text in headings.items() if is_number_heading(text)}
    for (row, column), text in headings.items():
        below = [r for r in sheet.rows if r > row and type(sheet.value(r, column)) is float]
        if below and name in vocabulary.suggest_columns(text) and vocabulary.parse_heading(text) is None:
            rows, columns = range(below[0], below[-1] + 1), {name: (column, "")}
            if len(rows) == 1 and name not in definitions.position:
                yield _mapped_table(sheet, rows, columns, row, matching="one for all")
            else:
                yield _mapped_table(sheet, rows, columns, row, next(iter(numbered)) if len(numbered) == 1 else None)


def preview_workbook(path: AnyPath, rows: int = 20, columns: int = 26) -> dict[str, tuple[tuple[str, ...], ...]]:
    """Return the contents of the first `rows` and `columns` of each sheet: sheet -> rows of short texts.

    They begin with row 1 and column A; a blank cell is an empty text, and a smaller sheet gives what it has.
    """
    preview = {}
    for name, sheet in Book(path).sheets.items():
        bottom, right = map(min, (rows, columns), sheet.book.workbook.extent(name))
        cells = [[_preview_text(sheet.value(row, c)) for c in range(1, right + 1)] for row in range(1, bottom + 1)]
        preview[name] = tuple(map(tuple, cells))
    return preview


def _preview_text(value: object) -> str:
    """Return the value of a cell as a short text."""
    if value is None:
        return ""
    if isinstance(value, UncomputedValue):
        return "(no value)"
    if isinstance(value, OutdatedValue):
        return f"{_preview_text(value.stored)} (outdated: {_preview_text(value.computed)})"
    return shorten(f"{value:.9g}" if type(value) is float else str(value))
