"""Which cells hold which quantity, by a workbook's headings, and the doubts about that.

A doubt is anything that may make a number mean something else than its heading says: a heading, a unit or a table that
is unaccounted for. `recognized_layout` refuses a workbook with any; `core.workbook.draft` asks a person.
"""

import itertools
import re
from collections import defaultdict
from collections.abc import Iterator
from typing import NamedTuple

from ..errors import InputError, warn
from ..geometry.columns import LENGTH_UNITS
from .book import HEADING_ROWS, Book, Sheet
from .headed_table import HeadedTable, headed_table, headed_tables, is_number
from .headings import UNIT_WORDS, heading_of, may_mean, quoted, rivals, shows_as_stored, unit_of, units_mentioned
from .layout import Column, Layout, Table, by_label, in_order
from .quantities import DERIVED, NEEDED, OPTIONAL, POSITION, QUANTITIES, TYPED
from .sheet_xml import At

_HELP = "a column map can say what is meant (columns='map.toml', --columns map.toml; docs/workbook.md)"

_ABOUT_ALL = re.compile(
    r"\b(all|every|lengths?|dimensions?|distances?|coordinates?|sizes?|units?|numbers?|values?)\b", re.I
)


class Recognized(NamedTuple):
    """What the headings say: the sheets that may hold the scanner, quantity -> its table, and the doubts."""

    sheets: dict[str, Sheet]
    tables: dict[str, HeadedTable]
    doubts: list[str]


def recognize(book: Book) -> Recognized:
    """Find the tables of the scanner in a workbook, and collect the doubts about them."""
    sheets, candidates = headed_tables(book)
    tables: dict[str, HeadedTable] = {}
    doubts, missing = [], []
    for name in TYPED:
        having = [table for table in candidates if name in table.columns]
        filled = [table for table in having if table.has_numbers(name)]
        if len(filled) > 1:
            first, second = (t.sheet.place(t.first_heading, t.columns[name][0]) for t in filled[:2])
            doubts.append(f"{first} and {second}, of two sheets, are both headed as {name}, expected one such column")
        if having:
            tables[name] = (filled or having)[0]
        elif name in NEEDED:
            missing.append(_missing(book, sheets, name))
    if (modules := tables.get("x1")) is not None:
        tables.update({name: modules for name in DERIVED if name in modules.columns})
        for name in POSITION:
            if name in tables and tables[name] is not modules:
                doubts.append(
                    f"x1 is in sheet {modules.sheet.name} but {name} in sheet {tables[name].sheet.name}, expected one table"
                )
        hidden = book.workbook.hidden
        for other in book.sheets.values() if modules.sheet.name in hidden else ():
            table = None if other.name in hidden else headed_table(other)
            if table is not None and table.columns.keys() >= set(POSITION) and table.rows:
                doubts.append(f"sheet {modules.sheet.name} is hidden, but {other.name} is shown, expected one of them")
    for table in dict.fromkeys(tables.values()):
        doubts += _doubts_about(table, {*TYPED, *(name for name, its in tables.items() if its is table)})
    return Recognized(sheets, tables, doubts + missing)


def _missing(book: Book, sheets: dict[str, Sheet], name: str) -> str:
    close = [
        f"{sheet.place(*at)} {quoted(text)}"
        for sheet in sheets.values()
        for at, text in sheet.texts.items()
        if at[0] <= HEADING_ROWS and name in may_mean(text) and heading_of(text) is None
    ]
    saw = f"not understood: {', '.join(close[:3])}" if close else f"its sheets are {', '.join(book.sheets) or 'none'}"
    return f"no sheet has a column headed {name} or {QUANTITIES[name].headings[1]!r}; {saw}"


def recognized_layout(book: Book) -> Layout:
    """The layout that a workbook's headings describe; `InputError` if there is any doubt."""
    recognized = recognize(book)
    for doubt in recognized.doubts:
        raise _unclear(book, doubt)
    coordinates = recognized.tables["x1"]
    tables = {
        headed: Table(headed.sheet, headed.columns, headed.rows, headed.label_column)
        for headed in dict.fromkeys(recognized.tables.values())
    }
    modules = tables[coordinates]
    layout = Layout(modules)
    for name, headed in recognized.tables.items():
        table, once = tables[headed], headed.is_single(name)
        if not table.rows:
            raise InputError(f"{book.path.name}: sheet {table.sheet.name} has no numbers under {name}")
        if table not in layout.rows_of and not (once and len(table.rows) == 1):
            try:
                layout.rows_of[table] = _matched_rows(modules, table, coordinates, headed)
            except InputError:
                if not once:
                    raise
        rows = (table.rows[0],) * len(modules.rows) if once else layout.rows_of[table]
        layout.columns[name] = Column(table, name, modules, rows)
    for note in _notes(layout, recognized):
        warn(f"{book.path.name}: {note}", 4)
    return layout


def _unclear(book: Book, doubt: str) -> InputError:
    return InputError(f"{book.path.name}: {doubt}; {_HELP}")


def _matched_rows(modules: Table, table: Table, coordinates: HeadedTable, headed: HeadedTable) -> tuple[int, ...]:
    """The row of each module in another sheet: by the modules' numbers or names if both have them, else in order."""
    book, own, other = modules.sheet.book, coordinates.label_headings, headed.label_headings
    sheets = f"sheet {modules.sheet.name}", f"sheet {table.sheet.name}"
    if modules.labels is not None and table.labels is not None:
        rows = by_label(modules, table)
    else:
        rows = in_order(modules, table)
        for row, its in zip(modules.rows, rows, strict=True):
            if row - modules.rows[0] != its - rows[0]:
                together = f"row {row} of {sheets[0]} and row {its} of {sheets[1]} would belong together"
                raise _unclear(book, f"{together}, but blank rows differ: expected the modules' numbers in both")
        if table.numbers is not None and list(table.numbers) != sorted(table.numbers):
            unsorted = f"the modules' numbers in {sheets[1]} are in no order, {sheets[0]} has none"
            raise _unclear(book, f"{unsorted}, expected numbers in both")
        for heading, at in other.items():
            if heading not in own:
                heads = f"{table.sheet.place(*at)} heads names of modules, which {sheets[0]} does not have"
                raise _unclear(book, f"{heads}, expected a column in both that says which rows belong together")
    for heading in own.keys() & other.keys():
        for row, its in zip(modules.rows, rows, strict=True):
            here, there = (row, own[heading][1]), (its, other[heading][1])
            one, another = modules.sheet.value(*here), table.sheet.value(*there)
            if one != another:
                is_one = f"{modules.sheet.place(*here)} is {one!r} but {table.sheet.place(*there)}"
                raise _unclear(book, f"{is_one}, in the matching row, is {another!r}, expected the same")
    return rows


def _notes(layout: Layout, recognized: Recognized) -> Iterator[str]:
    """What a person should know of a workbook without doubts, as texts of warnings."""
    table, modules = recognized.tables["x1"], layout.modules
    unknown = {(its, at): text for its in dict.fromkeys(recognized.tables.values()) for at, text in its.unknown()}
    absent = [QUANTITIES[name] for name in OPTIONAL if name not in recognized.tables and table.unknown()]
    without = [f"no column is headed {q.name}, so the {q.title} is {q.blank_is}; " for q in absent if q.formula]
    if without or any(map(may_mean, unknown.values())):
        places = ", ".join(f"{its.sheet.place(*at)} {quoted(text)}" for (its, at), text in unknown.items())
        yield f"{''.join(without)}{places}: not understood and not read"
    used = {column.table.sheet.name for column in layout.columns.values()}
    units = {column.unit for column in layout.columns.values() if column.unit in LENGTH_UNITS}
    said = " and ".join(sorted(units))
    others = (
        f"{sheet.place(*at)} says {quoted(text)}, where the headings of the scanner's sheets say {said}, which was used"
        for name, sheet in recognized.sheets.items()
        if name not in used
        for at, text in sheet.texts.items()
        if _ABOUT_ALL.search(text) and any(units != {unit} for unit in units_mentioned(text))
    )
    yield from itertools.islice(others, 1)
    gap = sorted(set(range(modules.rows[0], modules.rows[-1])) - set(modules.rows))
    if gap and modules.labels is None:
        yield (
            f"row {gap[0]} of sheet {modules.sheet.name} holds no module; the rows below have no numbers and were taken "
            "for modules too"
        )


def _doubts_about(table: HeadedTable, quantities: set[str]) -> Iterator[str]:
    """The doubts about a table that these quantities are read from, each as the text of a message."""
    used = [table.columns[name] for name in table.columns if name in quantities]
    lengths = {unit for _, unit in used if unit in LENGTH_UNITS}
    yield from _headings(table)
    for at, text in table.unknown():
        for name in rivals(text)[:1]:
            yield f"{table.sheet.place(*at)} is headed {quoted(text)}, which is not understood and may mean {name}"
    numbers = [table.sheet.place(*at) for at in table.number_columns.values()]
    if len(numbers) > 1:
        yield f"{numbers[0]} and {numbers[1]} both head the modules' numbers, expected one such column"
    yield from _other_tables(table)
    yield from _texts_between_modules(table)
    yield from _notes_with_units(table, lengths)
    yield from _columns(table, used)


def _headings(table: HeadedTable) -> Iterator[str]:
    """Columns with the same quantity, or with headings that say different things or more than a quantity and unit."""
    for column, said in sorted(table.headings.items()):
        quantity, place = table.quantity(column), table.heading_place(column)
        for at, text in table.head.items():
            if at[1] != column:
                continue
            heading = said.get(at[0])
            if heading is None and unit_of(text) not in QUANTITIES[quantity].units:
                yield (
                    f"{table.sheet.place(*at)} holds {quoted(text)} in the heading of {quantity}, expected its name and a "
                    "unit alone"
                )
            if heading is not None and heading.quantity != quantity:
                yield (
                    f"{table.sheet.place(*at)} is headed as {heading.quantity} but {place} as {quantity}, expected "
                    "one of them"
                )
        units = [(unit, table.sheet.place(*at)) for unit, at in table.units(column).items()]
        if len(units) > 1:
            (unit, cell), (other, its) = units[:2]
            yield f"{cell} says {unit} but {its} {other}, expected one unit of {quantity}"
        for area in table.sheet.merged:
            if area.left < area.right and area.left <= column <= area.right and area.top in said:
                yield f"{table.sheet.place(area.top, area.left)} heads several columns as {quantity}, merged"
        first, _ = table.columns[quantity]
        if first != column:
            yield f"{table.heading_place(first)} and {place} are both headed as {quantity}, expected one such column"


def _other_tables(table: HeadedTable) -> Iterator[str]:
    """Headings apart from the table's: a second table, or a second heading."""
    apart: dict[int, dict[str, int]] = defaultdict(dict)
    for (row, column), text in table.sheet.texts.items():
        heading = heading_of(text)
        if heading is not None and not table.first_heading <= row < table.first_row:
            apart[row][heading.quantity] = column
    for row, found in sorted(apart.items()):
        over_numbers = any(is_number(table.sheet, row + 1, column) for column in found.values())
        if row < table.first_heading or len(found) > 1 or over_numbers:
            name, column = next(iter(found.items()))
            yield (
                f"{table.sheet.place(row, column)} is headed as {name}, apart from the headings in row "
                f"{table.first_heading}, expected one table"
            )
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
