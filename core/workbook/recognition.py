"""Recognition of a scanner's columns by a workbook's headings, and the doubts about them.

A doubt is anything that may make a number mean something else than its heading says: a heading, a unit or a table that
is unaccounted for. `headed_layout` refuses a workbook with any doubt; `core.workbook.draft` asks a person.
"""

import itertools
import re
from collections import defaultdict
from collections.abc import Iterator
from typing import NamedTuple

from ..errors import InputError, warn
from ..geometry.columns import LENGTH_UNITS, ColumnTable
from ..geometry.scanner import Scanner
from .book import HEADING_ROWS, Book, Sheet
from .headed_table import HeadedTable, candidate_sheets, find_headed_table, find_headed_tables, holds_non_text
from .headings import UNIT_WORDS, get_vocabulary, parse_unit, quote_text, shows_as_stored, units_mentioned
from .layout import WorkbookLayout, match_rows_by_label, match_rows_in_order
from .sheet_xml import Position

_HELP = "a column map can say what is meant (columns='map.toml', --columns map.toml; docs/workbook.md)"

_ABOUT_ALL = re.compile(
    r"\b(all|every|lengths?|dimensions?|distances?|coordinates?|sizes?|units?|numbers?|values?)\b", re.I
)
"""Words of a note that speaks of all numbers of a workbook."""


class RecognizedTables(NamedTuple):
    """Tables of a scanner that a workbook's headings describe."""

    sheets: dict[str, Sheet]
    """Name -> sheet, of the sheets that may hold the scanner."""
    tables: dict[str, HeadedTable]
    """Name of the scanner's column -> the table that holds it."""
    doubts: list[str]
    """Reasons, as texts of messages, why the tables may not be what is meant."""
    missing: list[str]
    """A text of a message for each column that no sheet has."""


def recognize_tables(book: Book, scanner: type[Scanner]) -> RecognizedTables:
    """Find the tables of a scanner in a workbook, and collect the doubts about them."""
    sheets, candidates = find_headed_tables(book, scanner)
    definitions = scanner.columns
    tables: dict[str, HeadedTable] = {}
    doubts, missing = [], []
    for name in definitions.typed:
        having = [table for table in candidates if name in table.columns]
        filled = [table for table in having if table.is_filled(name)]
        if len(filled) > 1:
            first, second = (t.sheet.address(t.first_heading, t.columns[name][0]) for t in filled[:2])
            doubts.append(f"{first} and {second}, of two sheets, are both headed as {name}, expected one such column")
        if having:
            tables[name] = (filled or having)[0]
        elif name in definitions.needed:
            missing.append(_describe_missing(book, sheets, definitions, name))
    if (modules := tables.get(definitions.leading)) is not None:
        tables.update({name: modules for name in definitions.derived if name in modules.columns})
        for name in definitions.position:
            if name in tables and tables[name] is not modules:
                places = f"in sheet {modules.sheet.name} but {name} in sheet {tables[name].sheet.name}"
                doubts.append(f"{definitions.leading} is {places}, expected one table")
        doubts += _find_visible_twins(book, scanner, modules)
    for table in dict.fromkeys(tables.values()):
        names = {*definitions.typed, *(name for name, holder in tables.items() if holder is table)}
        doubts += _find_doubts(table, names)
    return RecognizedTables(sheets, tables, doubts, missing)


def _find_visible_twins(book: Book, scanner: type[Scanner], modules: HeadedTable) -> Iterator[str]:
    """Yield a doubt for each visible sheet with the columns of the table of `modules`, if that one's sheet is hidden."""
    hidden, needed = book.workbook.hidden, {scanner.columns.leading, *scanner.columns.position}
    for sheet in candidate_sheets(book, scanner).values() if modules.sheet.name in hidden else ():
        table = None if sheet.name in hidden else find_headed_table(sheet, modules.vocabulary)
        if table is not None and table.rows and table.columns.keys() >= needed:
            yield f"sheet {modules.sheet.name} is hidden, but {sheet.name} is shown, expected one of them"


def _describe_missing(book: Book, sheets: dict[str, Sheet], definitions: ColumnTable, name: str) -> str:
    """Return the doubt about a column that no sheet has, with similar headings that are not understood."""
    vocabulary = get_vocabulary(definitions)
    texts = [
        f"{sheet.address(*p)} {quote_text(text)}"
        for sheet in sheets.values()
        for p, text in sheet.texts.items()
        if p[0] <= HEADING_ROWS and name in vocabulary.suggest_columns(text) and vocabulary.parse_heading(text) is None
    ]
    hint = f"not understood: {', '.join(texts[:3])}" if texts else f"its sheets are {', '.join(book.sheets) or 'none'}"
    return f"no sheet has a column headed {' or '.join([name, *map(repr, definitions[name].headings[1:2])])}; {hint}"


def headed_layout(book: Book, scanner: type[Scanner]) -> WorkbookLayout:
    """Return the layout that a workbook's headings describe; raise `InputError` if there is any doubt."""
    recognized = recognize_tables(book, scanner)
    for doubt in (*recognized.doubts, *recognized.missing):
        raise _unclear_error(book, doubt)
    modules = recognized.tables[scanner.columns.leading]
    for table in dict.fromkeys(recognized.tables.values()):
        table.read_labels()
    layout = WorkbookLayout(modules)
    for name, table in recognized.tables.items():
        is_given_once = table.is_given_once(name)
        if not table.rows:
            raise InputError(f"{book.path.name}: sheet {table.sheet.name} has no numbers under {name}")
        if table not in layout.rows_of and not (is_given_once and len(table.rows) == 1):
            try:
                layout.rows_of[table] = _match_rows(modules, table)
            except InputError:
                if not is_given_once:
                    raise
        layout.add_column(table, name, (table.rows[0],) * len(modules.rows) if is_given_once else layout.rows_of[table])
    for note in _find_notes(layout, recognized):
        warn(f"{book.path.name}: {note}", 5)
    return layout


def _unclear_error(book: Book, doubt: str) -> InputError:
    """Return the error for a doubt, with the advice to write a column map."""
    return InputError(f"{book.path.name}: {doubt}; {_HELP}")


def _match_rows(modules: HeadedTable, table: HeadedTable) -> tuple[int, ...]:
    """Return the row of each module in another table: by the modules' numbers or names if both have them, else in order.

    Raises `InputError` if there is any doubt that the rows belong together.
    """
    book, headings, table_headings = modules.sheet.book, modules.label_headings, table.label_headings
    sheet, table_sheet = f"sheet {modules.sheet.name}", f"sheet {table.sheet.name}"
    if modules.labels is not None and table.labels is not None:
        rows = match_rows_by_label(modules, table)
    else:
        rows = match_rows_in_order(modules, table)
        for row, table_row in zip(modules.rows, rows, strict=True):
            if row - modules.rows[0] != table_row - rows[0]:
                pair = f"row {row} of {sheet} and row {table_row} of {table_sheet} would belong together"
                raise _unclear_error(book, f"{pair}, but blank rows differ: expected the modules' numbers in both")
        if table.numbers is not None and list(table.numbers) != sorted(table.numbers):
            unsorted = f"the modules' numbers in {table_sheet} are in no order, {sheet} has none"
            raise _unclear_error(book, f"{unsorted}, expected numbers in both")
        for heading in (heading for heading in table_headings if heading not in headings):
            heads = f"{table.sheet.address(*table_headings[heading])} heads names of modules"
            raise _unclear_error(book, f"{heads}, which {sheet} lacks, expected a column in both that matches the rows")
    for heading in headings.keys() & table_headings.keys():
        for row, table_row in zip(modules.rows, rows, strict=True):
            position, table_position = (row, headings[heading][1]), (table_row, table_headings[heading][1])
            name, table_name = modules.sheet.value(*position), table.sheet.value(*table_position)
            if name != table_name:
                problem = f"{modules.sheet.address(*position)} is {name!r} but {table.sheet.address(*table_position)}"
                raise _unclear_error(book, f"{problem}, in the matching row, is {table_name!r}, expected the same")
    return rows


def _find_notes(layout: WorkbookLayout, recognized: RecognizedTables) -> Iterator[str]:
    """Yield the warnings that a user should see about a workbook whose layout is beyond doubt."""
    definitions, tables = layout.modules.definitions, list(dict.fromkeys(recognized.tables.values()))
    modules = recognized.tables[definitions.leading]
    unknown = {t.sheet.address(*position): text for t in tables for position, text in t.unknown_headings()}
    absent = [definitions[name] for name in definitions.optional if name not in recognized.tables]
    computed = [column for column in absent if column.formula and modules.unknown_headings()]
    defaults = [f"no column is headed {c.name}, so the {c.title} is {c.fallback}; " for c in computed]
    if defaults or any(map(modules.vocabulary.suggest_columns, unknown.values())):
        cells = ", ".join(f"{cell} {quote_text(text)}" for cell, text in unknown.items())
        yield f"{''.join(defaults)}{cells}: not understood and not read"
    used_sheets = {column.table.sheet.name for column in layout.columns.values()}
    units = {column.unit for column in layout.columns.values() if column.unit in LENGTH_UNITS}
    stated = f"where the headings of the scanner's sheets say {' and '.join(sorted(units))}, which was used"
    contradictions = (
        f"{sheet.address(*position)} says {quote_text(text)}, {stated}"
        for name, sheet in recognized.sheets.items()
        if name not in used_sheets
        for position, text in sheet.texts.items()
        if _ABOUT_ALL.search(text) and any(units != {unit} for unit in units_mentioned(text))
    )
    yield from itertools.islice(contradictions, 1)
    gap = sorted(set(range(modules.rows[0], modules.rows[-1])) - set(modules.rows))
    if gap and modules.labels is None:
        below = "the rows below have no numbers and were taken for modules too"
        yield f"row {gap[0]} of sheet {modules.sheet.name} holds no module; {below}"


def _find_doubts(table: HeadedTable, names: set[str]) -> Iterator[str]:
    """Yield each doubt about a table from which the columns `names` are read."""
    columns = [table.columns[name] for name in table.columns if name in names and not table.definitions[name].is_text]
    lengths = {unit for _, unit in columns if unit in LENGTH_UNITS}
    yield from _find_heading_doubts(table)
    for position, text in table.unknown_headings():
        for name in table.vocabulary.mistakable_columns(text)[:1]:
            cell = f"{table.sheet.address(*position)} is headed {quote_text(text)}"
            yield f"{cell}, which is not understood and may mean {name}"
    numbers = [table.sheet.address(*position) for position in table.number_columns.values()]
    if len(numbers) > 1:
        yield f"{numbers[0]} and {numbers[1]} both head the modules' numbers, expected one such column"
    yield from _find_second_table(table)
    yield from _find_texts_between_modules(table)
    yield from _find_contradicting_units(table, lengths)
    yield from _find_cell_doubts(table, columns)


def _find_heading_doubts(table: HeadedTable) -> Iterator[str]:
    """Yield a doubt for columns of one name, and for heads that contradict each other or say more than a name and unit."""
    for column, heading_of_row in sorted(table.headings.items()):
        name, place = table.name_of_column(column), table.heading_address(column)
        for (row, head_column), text in table.head_texts.items():
            if head_column != column:
                continue
            heading, cell = heading_of_row.get(row), table.sheet.address(row, column)
            if heading is None and parse_unit(text) not in table.definitions[name].units:
                yield f"{cell} holds {quote_text(text)} in the heading of {name}, expected its name and a unit alone"
            if heading is not None and heading.name != name:
                yield f"{cell} is headed as {heading.name} but {place} as {name}, expected one of them"
        units = [(unit, table.sheet.address(*position)) for unit, position in table.units(column).items()]
        if len(units) > 1:
            (unit, cell), (second_unit, second_cell) = units[:2]
            yield f"{cell} says {unit} but {second_cell} {second_unit}, expected one unit of {name}"
        for area in table.sheet.merged_areas:
            if area.left < area.right and area.left <= column <= area.right and area.top in heading_of_row:
                yield f"{table.sheet.address(area.top, area.left)} heads several columns as {name}, merged"
        first_column, _ = table.columns[name]
        if first_column != column:
            yield f"{table.heading_address(first_column)} and {place} are both headed as {name}, expected one such column"


def _find_second_table(table: HeadedTable) -> Iterator[str]:
    """Yield a doubt if there are headings apart from the table's own: a second table, or a second heading."""
    apart: dict[int, dict[str, int]] = defaultdict(dict)
    for (row, column), text in table.sheet.texts.items():
        heading = None if column in table.text_columns and row in table.rows else table.vocabulary.parse_heading(text)
        if heading is not None and not table.first_heading <= row < table.first_row:
            apart[row][heading.name] = column
    for row, column_of_name in sorted(apart.items()):
        is_over_numbers = any(holds_non_text(table.sheet, row + 1, column) for column in column_of_name.values())
        if row < table.first_heading or len(column_of_name) > 1 or is_over_numbers:
            name, column = next(iter(column_of_name.items()))
            apart_from = f"apart from the headings in row {table.first_heading}"
            yield f"{table.sheet.address(row, column)} is headed as {name}, {apart_from}, expected one table"
            return


def _find_texts_between_modules(table: HeadedTable) -> Iterator[str]:
    """Yield a doubt for the first text or sum between the modules' rows: the rows below it may be another table."""
    if not table.rows:
        return
    columns = {*table.headings, table.label_column or min(table.headings)}
    between = set(range(table.rows[0], table.rows[-1])).difference(table.rows)
    position_of_row = {row: position for row, position in table.summary_rows.items() if row in between}
    for row, column in table.sheet.texts:
        if row in between and min(columns) <= column <= max(columns):
            position_of_row.setdefault(row, (row, column))
    for row, position in sorted(position_of_row.items())[:1]:
        cell = table.sheet.address(*position)
        if row in table.summary_rows:
            yield f"{cell} sums up its column between rows of modules, expected sums below the last module"
        else:
            yield f"{cell} holds {quote_text(table.sheet.texts[position])} between rows of modules, expected one table"


def _find_contradicting_units(table: HeadedTable, lengths: set[str]) -> Iterator[str]:
    """Yield a doubt for each unit in the sheet's name, its notes and comments on headings that no heading states.

    `lengths` are the units of length that the headings state.
    """
    sheet, headings_say = table.sheet, f"where the headings say {' and '.join(sorted(lengths))}"
    for unit in units_mentioned(sheet.name.replace("_", " ")):
        if lengths != {unit}:
            yield f"the name of sheet {sheet.name} speaks of {unit}, {headings_say}"
    module_rows = set(table.rows)
    positions_in_row: dict[int, list[Position]] = defaultdict(list)
    for position in sheet.texts:
        positions_in_row[position[0]].append(position)
    for position, text in sheet.texts.items():
        row, column = position
        if position in table.head_texts:
            # The unit in a text over numbers of another column concerns these alone, unless the text is a bare unit.
            is_only_unit = len(table.unrelated_heads.get(column, ())) == 1 and units_mentioned(text, alone=True)
            heads_unrelated_numbers = column in table.numeric_columns - {table.label_column} and not is_only_unit
            if column in table.headings or heads_unrelated_numbers:
                continue
        elif row in module_rows and column in table.text_columns:
            continue
        for unit in units_mentioned(text, alone=row in module_rows):
            neighbours = (sheet.texts[neighbour] for neighbour in positions_in_row[row] if neighbour != position)
            is_explained = unit in UNIT_WORDS and any(map(units_mentioned, neighbours))
            if lengths != {unit} and not is_explained:
                yield f"{sheet.address(*position)} holds {quote_text(text)}, {headings_say}: expected one unit"
    for position, text in sheet.book.workbook.comments(sheet.name).items():
        if position[0] < table.first_row and any(lengths != {unit} for unit in units_mentioned(text)):
            yield f"{sheet.address(*position)} has the comment {quote_text(text)}, {headings_say}: expected one unit"


def _find_cell_doubts(table: HeadedTable, columns: list[tuple[int, str]]) -> Iterator[str]:
    """Yield a doubt for number formats, merged cells and texts above a heading that change the meaning of numbers.

    `columns` has column and unit of the numbers that are read from the table.
    """
    sheet = table.sheet
    for column, unit in columns:
        for row in table.rows:
            number_format = sheet.number_format(row, column)
            if not sheet.is_date(row, column) and not shows_as_stored(number_format, unit):
                appearance = f"{sheet.address(row, column)} is shown as {quote_text(number_format)}"
                yield f"{appearance}, where its heading says {unit or 'no unit'}: expected one unit"
                break
    for area in sheet.merged_areas:
        covered = [(row, c) for c, _ in columns for row in table.rows if area.contains(row, c)]
        for position in covered:
            if position != (area.top, area.left) and sheet.value(*position) is not None:
                yield f"{sheet.address(*position)} is hidden under a merged cell, expected a visible number"
                break
    for column, _ in columns:
        above = next(iter(table.headings[column])) - 1, column
        position = next(((area.top, area.left) for area in sheet.merged_areas if area.contains(*above)), above)
        if position in sheet.texts and position not in table.head_texts:
            text = quote_text(sheet.texts[position])
            yield f"{sheet.address(*position)} holds {text} right above a heading, expected nothing, or a row between"
            break
