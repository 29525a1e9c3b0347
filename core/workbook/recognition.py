"""Which cells hold which quantity, by a workbook's headings, and the doubts about that.

A doubt is anything that may make a number mean something else than its heading says: a heading, a unit or a table that
is unaccounted for. `recognized_layout` refuses a workbook with any; `core.workbook.draft` asks a person.
"""

from __future__ import annotations

import itertools
import re
import warnings
from collections.abc import Iterator
from typing import NamedTuple

from ..errors import InputError, InputWarning
from .book import HEADING_ROWS, Book, Sheet
from .doubts import doubts_about, listed
from .headed_table import HeadedTable, headed_table, headed_tables
from .headings import heading_of, may_mean, quoted, units_mentioned
from .layout import Column, Layout, Table, by_label, in_order
from .quantities import DERIVED, LENGTH_UNITS, NEEDED, POSITION, QUANTITIES, TYPED

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
        doubts += doubts_about(table, {*TYPED, *(name for name, its in tables.items() if its is table)})
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
        warnings.warn(f"{book.path.name}: {note}", InputWarning, stacklevel=4)
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
    if "l" not in recognized.tables:
        for at, text in table.unknown()[:1]:
            yield (
                "no column is headed l, so the collimator length is the design formula's; "
                f"{table.sheet.place(*at)} {quoted(text)} is not understood"
            )
    used = {column.table.sheet.name for column in layout.columns.values()}
    units = {column.unit for column in layout.columns.values() if column.unit in LENGTH_UNITS}
    others = (
        f"{sheet.place(*at)} says {quoted(text)}, where the headings of the scanner's sheets say {listed(units)}, which "
        "was used"
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
