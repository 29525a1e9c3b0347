"""Which cells hold which column of a scanner, by a workbook's headings, and the doubts about that.

A doubt is anything that may make a number mean something else than its heading says: a heading, a unit or a table that
is unaccounted for. `recognized_layout` refuses a workbook with any; `core.workbook.draft` asks a person.
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
from .headed_table import HeadedTable, headed_table, headed_tables, is_number, sheets_of
from .headings import UNIT_WORDS, quoted, shows_as_stored, unit_of, units_mentioned, vocabulary
from .layout import Layout, by_label, in_order
from .sheet_xml import At

_HELP = "a column map can say what is meant (columns='map.toml', --columns map.toml; docs/workbook.md)"

_ABOUT_ALL = re.compile(
    r"\b(all|every|lengths?|dimensions?|distances?|coordinates?|sizes?|units?|numbers?|values?)\b", re.I
)


class Recognized(NamedTuple):
    """What the headings say: the sheets that may hold the scanner, its columns' tables, and the doubts."""

    sheets: dict[str, Sheet]
    tables: dict[str, HeadedTable]
    doubts: list[str]


def recognize(book: Book, scanner: type[Scanner]) -> Recognized:
    """Find the tables of a scanner in a workbook, and collect the doubts about them."""
    sheets, candidates = headed_tables(book, scanner)
    declared = scanner.columns
    tables: dict[str, HeadedTable] = {}
    doubts, missing = [], []
    for name in declared.typed:
        having = [table for table in candidates if name in table.columns]
        filled = [table for table in having if table.is_filled(name)]
        if len(filled) > 1:
            first, second = (t.sheet.place(t.first_heading, t.columns[name][0]) for t in filled[:2])
            doubts.append(f"{first} and {second}, of two sheets, are both headed as {name}, expected one such column")
        if having:
            tables[name] = (filled or having)[0]
        elif name in declared.needed:
            missing.append(_missing(book, sheets, declared, name))
    if (modules := tables.get(declared.leading)) is not None:
        tables.update({name: modules for name in declared.derived if name in modules.columns})
        for name in declared.position:
            if name in tables and tables[name] is not modules:
                here, there = modules.sheet.name, tables[name].sheet.name
                doubts.append(f"{declared.leading} is in sheet {here} but {name} in sheet {there}, expected one table")
        doubts += _shown_twins(book, scanner, modules)
    for table in dict.fromkeys(tables.values()):
        own = {*declared.typed, *(name for name, its in tables.items() if its is table)}
        doubts += _doubts_about(table, own)
    return Recognized(sheets, tables, doubts + missing)


def _shown_twins(book: Book, scanner: type[Scanner], modules: HeadedTable) -> Iterator[str]:
    """Sheets that are shown and have what that of the `modules`, which is hidden, has."""
    hidden, needed = book.workbook.hidden, {scanner.columns.leading, *scanner.columns.position}
    for other in sheets_of(book, scanner).values() if modules.sheet.name in hidden else ():
        table = None if other.name in hidden else headed_table(other, modules.words)
        if table is not None and table.rows and table.columns.keys() >= needed:
            yield f"sheet {modules.sheet.name} is hidden, but {other.name} is shown, expected one of them"


def _missing(book: Book, sheets: dict[str, Sheet], declared: ColumnTable, name: str) -> str:
    words = vocabulary(declared)
    close = [
        f"{sheet.place(*at)} {quoted(text)}"
        for sheet in sheets.values()
        for at, text in sheet.texts.items()
        if at[0] <= HEADING_ROWS and name in words.may_mean(text) and words.heading_of(text) is None
    ]
    saw = f"not understood: {', '.join(close[:3])}" if close else f"its sheets are {', '.join(book.sheets) or 'none'}"
    return f"no sheet has a column headed {' or '.join([name, *map(repr, declared[name].headings[1:2])])}; {saw}"


def recognized_layout(book: Book, scanner: type[Scanner]) -> Layout:
    """The layout that a workbook's headings describe; `InputError` if there is any doubt."""
    found = recognize(book, scanner)
    for doubt in found.doubts:
        raise _unclear(book, doubt)
    modules = found.tables[scanner.columns.leading]
    for table in dict.fromkeys(found.tables.values()):
        table.read_labels()
    layout = Layout(modules)
    for name, table in found.tables.items():
        once = table.is_single(name)
        if not table.rows:
            raise InputError(f"{book.path.name}: sheet {table.sheet.name} has no numbers under {name}")
        if table not in layout.rows_of and not (once and len(table.rows) == 1):
            try:
                layout.rows_of[table] = _matched_rows(modules, table)
            except InputError:
                if not once:
                    raise
        layout.add(table, name, (table.rows[0],) * len(modules.rows) if once else layout.rows_of[table])
    for note in _notes(layout, found):
        warn(f"{book.path.name}: {note}", 5)
    return layout


def _unclear(book: Book, doubt: str) -> InputError:
    return InputError(f"{book.path.name}: {doubt}; {_HELP}")


def _matched_rows(modules: HeadedTable, table: HeadedTable) -> tuple[int, ...]:
    """The row of each module in another sheet: by the modules' numbers or names if both have them, else in order."""
    book, own, other = modules.sheet.book, modules.label_headings, table.label_headings
    here, there = f"sheet {modules.sheet.name}", f"sheet {table.sheet.name}"
    if modules.labels is not None and table.labels is not None:
        rows = by_label(modules, table)
    else:
        rows = in_order(modules, table)
        for row, its in zip(modules.rows, rows, strict=True):
            if row - modules.rows[0] != its - rows[0]:
                together = f"row {row} of {here} and row {its} of {there} would belong together"
                raise _unclear(book, f"{together}, but blank rows differ: expected the modules' numbers in both")
        if table.numbers is not None and list(table.numbers) != sorted(table.numbers):
            unsorted = f"the modules' numbers in {there} are in no order, {here} has none"
            raise _unclear(book, f"{unsorted}, expected numbers in both")
        for heading in (heading for heading in other if heading not in own):
            heads = f"{table.sheet.place(*other[heading])} heads names of modules, which {here} does not have"
            raise _unclear(book, f"{heads}, expected a column in both that says which rows belong together")
    for heading in own.keys() & other.keys():
        for row, its in zip(modules.rows, rows, strict=True):
            at, its_at = (row, own[heading][1]), (its, other[heading][1])
            one, another = modules.sheet.value(*at), table.sheet.value(*its_at)
            if one != another:
                is_one = f"{modules.sheet.place(*at)} is {one!r} but {table.sheet.place(*its_at)}"
                raise _unclear(book, f"{is_one}, in the matching row, is {another!r}, expected the same")
    return rows


def _notes(layout: Layout, found: Recognized) -> Iterator[str]:
    """What a person should know of a workbook without doubts, as texts of warnings."""
    declared, tables = layout.modules.declared, list(dict.fromkeys(found.tables.values()))
    modules = found.tables[declared.leading]
    unknown = {table.sheet.place(*at): text for table in tables for at, text in table.unknown()}
    absent = [declared[name] for name in declared.optional if name not in found.tables and declared[name].formula]
    without = [f"no column is headed {c.name}, so the {c.title} is {c.fallback}; " for c in absent if modules.unknown()]
    if without or any(map(modules.words.may_mean, unknown.values())):
        places = ", ".join(f"{place} {quoted(text)}" for place, text in unknown.items())
        yield f"{''.join(without)}{places}: not understood and not read"
    used = {column.table.sheet.name for column in layout.columns.values()}
    units = {column.unit for column in layout.columns.values() if column.unit in LENGTH_UNITS}
    stated = " and ".join(sorted(units))
    others = (
        f"{sheet.place(*at)} says {quoted(text)}, where the headings of the scanner's sheets say {stated}, which was used"
        for name, sheet in found.sheets.items()
        if name not in used
        for at, text in sheet.texts.items()
        if _ABOUT_ALL.search(text) and any(units != {unit} for unit in units_mentioned(text))
    )
    yield from itertools.islice(others, 1)
    gap = sorted(set(range(modules.rows[0], modules.rows[-1])) - set(modules.rows))
    if gap and modules.labels is None:
        below = "the rows below have no numbers and were taken for modules too"
        yield f"row {gap[0]} of sheet {modules.sheet.name} holds no module; {below}"


def _doubts_about(table: HeadedTable, names: set[str]) -> Iterator[str]:
    """The doubts about a table from which these columns are read, each as the text of a message."""
    used = [table.columns[name] for name in table.columns if name in names and not table.declared[name].is_text]
    lengths = {unit for _, unit in used if unit in LENGTH_UNITS}
    yield from _headings(table)
    for at, text in table.unknown():
        for name in table.words.rivals(text)[:1]:
            yield f"{table.sheet.place(*at)} is headed {quoted(text)}, which is not understood and may mean {name}"
    numbers = [table.sheet.place(*at) for at in table.number_columns.values()]
    if len(numbers) > 1:
        yield f"{numbers[0]} and {numbers[1]} both head the modules' numbers, expected one such column"
    yield from _other_tables(table)
    yield from _texts_between_modules(table)
    yield from _notes_with_units(table, lengths)
    yield from _columns(table, used)


def _headings(table: HeadedTable) -> Iterator[str]:
    """Columns of one name, or with headings that say different things or more than a name and unit."""
    for column, heads in sorted(table.headings.items()):
        name, place = table.name_of(column), table.heading_place(column)
        for at, text in table.head.items():
            if at[1] != column:
                continue
            heading, cell = heads.get(at[0]), table.sheet.place(*at)
            if heading is None and unit_of(text) not in table.declared[name].units:
                yield f"{cell} holds {quoted(text)} in the heading of {name}, expected its name and a unit alone"
            if heading is not None and heading.name != name:
                yield f"{cell} is headed as {heading.name} but {place} as {name}, expected one of them"
        units = [(unit, table.sheet.place(*at)) for unit, at in table.units(column).items()]
        if len(units) > 1:
            (unit, cell), (other, its) = units[:2]
            yield f"{cell} says {unit} but {its} {other}, expected one unit of {name}"
        for area in table.sheet.merged:
            if area.left < area.right and area.left <= column <= area.right and area.top in heads:
                yield f"{table.sheet.place(area.top, area.left)} heads several columns as {name}, merged"
        first, _ = table.columns[name]
        if first != column:
            yield f"{table.heading_place(first)} and {place} are both headed as {name}, expected one such column"


def _other_tables(table: HeadedTable) -> Iterator[str]:
    """Headings apart from the table's: a second table, or a second heading."""
    apart: dict[int, dict[str, int]] = defaultdict(dict)
    for (row, column), text in table.sheet.texts.items():
        heading = None if column in table.text_columns and row in table.rows else table.words.heading_of(text)
        if heading is not None and not table.first_heading <= row < table.first_row:
            apart[row][heading.name] = column
    for row, found in sorted(apart.items()):
        over_numbers = any(is_number(table.sheet, row + 1, column) for column in found.values())
        if row < table.first_heading or len(found) > 1 or over_numbers:
            name, column = next(iter(found.items()))
            apart_from = f"apart from the headings in row {table.first_heading}"
            yield f"{table.sheet.place(row, column)} is headed as {name}, {apart_from}, expected one table"
            return


def _texts_between_modules(table: HeadedTable) -> Iterator[str]:
    """Texts or sums between the modules' rows: what follows may be another table."""
    if not table.rows:
        return
    columns = {*table.headings, table.label_column or min(table.headings)}
    between = set(range(table.rows[0], table.rows[-1])).difference(table.rows)
    found = {row: at for row, at in table.summaries.items() if row in between}
    for row, column in table.sheet.texts:
        if row in between and min(columns) <= column <= max(columns):
            found.setdefault(row, (row, column))
    for row, at in sorted(found.items())[:1]:
        place = table.sheet.place(*at)
        if row in table.summaries:
            yield f"{place} sums up its column between rows of modules, expected sums below the last module"
        else:
            yield f"{place} holds {quoted(table.sheet.texts[at])} between rows of modules, expected one table"


def _notes_with_units(table: HeadedTable, lengths: set[str]) -> Iterator[str]:
    """Units in the sheet's name, in its notes and in comments on the headings that are not those of the headings."""
    sheet, headings_say = table.sheet, f"where the headings say {' and '.join(sorted(lengths))}"
    for unit in units_mentioned(sheet.name.replace("_", " ")):
        if lengths != {unit}:
            yield f"the name of sheet {sheet.name} speaks of {unit}, {headings_say}"
    modules = set(table.rows)
    texts_of_row: dict[int, list[At]] = defaultdict(list)
    for at in sheet.texts:
        texts_of_row[at[0]].append(at)
    for at, text in sheet.texts.items():
        row, column = at
        if at in table.head:
            # The unit of a text that heads a column of other numbers is theirs alone.
            only_a_unit = len(table.other_heads.get(column, ())) == 1 and units_mentioned(text, alone=True)
            others_numbers = column in table.numeric - {table.label_column} and not only_a_unit
            if column in table.headings or others_numbers:
                continue
        elif row in modules and column in table.text_columns:
            continue
        for unit in units_mentioned(text, alone=row in modules):
            others = (sheet.texts[other] for other in texts_of_row[row] if other != at)
            explained = unit in UNIT_WORDS and any(map(units_mentioned, others))
            if lengths != {unit} and not explained:
                yield f"{sheet.place(*at)} holds {quoted(text)}, {headings_say}: expected one unit"
    for at, text in sheet.book.workbook.comments(sheet.name).items():
        if at[0] < table.first_row and any(lengths != {unit} for unit in units_mentioned(text)):
            yield f"{sheet.place(*at)} has the comment {quoted(text)}, {headings_say}: expected one unit"


def _columns(table: HeadedTable, used: list[tuple[int, str]]) -> Iterator[str]:
    """Number formats, merged cells and texts above a heading that give the numbers in `used` columns another meaning."""
    sheet = table.sheet
    for column, unit in used:
        for row in table.rows:
            shown = sheet.number_format(row, column)
            if not sheet.is_date(row, column) and not shows_as_stored(shown, unit):
                place = sheet.place(row, column)
                yield f"{place} is shown as {quoted(shown)}, where its heading says {unit or 'no unit'}: expected one unit"
                break
    for area in sheet.merged:
        below = [(row, c) for c, _ in used for row in table.rows if area.contains(row, c)]
        for at in below:
            if at != (area.top, area.left) and sheet.value(*at) is not None:
                yield f"{sheet.place(*at)} is hidden under a merged cell, expected a visible number"
                break
    for column, _ in used:
        above = next(iter(table.headings[column])) - 1, column
        at = next(((area.top, area.left) for area in sheet.merged if area.contains(*above)), above)
        if at in sheet.texts and at not in table.head:
            text = quoted(sheet.texts[at])
            yield f"{sheet.place(*at)} holds {text} right above a heading, expected nothing, or a row between"
            break
