"""Which cells hold which quantity, by a workbook's headings: what is understood for certain, and doubts of the rest.

A doubt is whatever may make a number mean something else than its heading says: a heading, a unit or a table that is
not accounted for. `recognized_layout` refuses a workbook with any; `core.workbook.draft` asks a person.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass

from ..errors import InputError, InputWarning
from .book import HEADING_ROWS, Book, Sheet
from .doubts import look_around
from .headings import heading_of, may_mean, quoted, units_mentioned
from .layout import Column, Layout, Table, by_label, check_modules, in_order
from .quantities import (
    DERIVED,
    DIMENSIONS,
    LENGTH_UNITS,
    NEEDED,
    POSITION,
    QUANTITIES,
)
from .sheet_seen import SheetSeen, several, sheet_seen, sheets_seen

HELP = "a column map can say what is meant (columns='map.toml', --columns map.toml; docs/workbook.md)"

_OF_ALL = re.compile(
    r"\b(all|every|lengths?|dimensions?|distances?|coordinates?|sizes?|units?|numbers?|values?)\b", re.I
)


@dataclass(frozen=True, eq=False)
class Recognized:
    """What is seen of the scanner in a workbook.

    Attributes
    ----------
    book : Book
    sheets : dict
        Name -> `Sheet`, of those that may hold the scanner.
    taken : dict
        Quantity -> the sheet that it is taken from.
    doubts : list of str
        What keeps the workbook from being read.
    """

    book: Book
    sheets: dict[str, Sheet]
    taken: dict[str, SheetSeen]
    doubts: list[str]


def recognize(book: Book) -> Recognized:
    """What is seen of the scanner in a workbook, with the doubts."""
    sheets, seen = sheets_seen(book)
    taken: dict[str, SheetSeen] = {}
    doubts, missing = [], []
    for name in (*NEEDED, "l"):
        having = [s for s in seen if name in s.columns]
        filled = [s for s in having if name in s.filled]
        if len(filled) > 1:
            first, second = (s.sheet.place(s.first_heading, s.columns[name][0]) for s in filled[:2])
            doubts.append(
                f"{book.path.name}: {first} and {second}, of two sheets, are both headed as {name}, expected one such column"
            )
        if having:
            taken[name] = (filled or having)[0]
        elif name != "l":
            missing.append(_missing(book, sheets, name))
    if (coordinates := taken.get("x1")) is not None:
        taken.update({name: coordinates for name in DERIVED if name in coordinates.columns})
        for name in POSITION:
            if name in taken and taken[name] is not coordinates:
                doubts.append(
                    f"{book.path.name}: x1 is in sheet {coordinates.sheet.name} but {name} in sheet "
                    f"{taken[name].sheet.name}, expected one table"
                )
        doubts += _shown_instead(book, coordinates.sheet)
    for sheet in dict.fromkeys(taken.values()):
        look_around(sheet, {*NEEDED, "l", *(name for name, of in taken.items() if of is sheet)})
        doubts += sheet.doubts
    return Recognized(book, sheets, taken, doubts + missing)


def _shown_instead(book: Book, sheet: Sheet) -> list[str]:
    """A doubt where the coordinates' sheet is hidden, and another that is shown has such a table."""
    if sheet.name not in book.workbook.hidden:
        return []
    shown = [other for title, other in book.sheets.items() if title not in book.workbook.hidden]
    for seen in filter(None, map(sheet_seen, shown)):
        if seen.columns.keys() >= set(POSITION) and seen.rows:
            return [
                f"{book.path.name}: sheet {sheet.name} is hidden, but {seen.sheet.name} is shown, expected one of them"
            ]
    return []


def _missing(book: Book, sheets: dict[str, Sheet], name: str) -> str:
    quantity = QUANTITIES[name]
    close = [
        f"{sheet.place(*at)} {quoted(text)}"
        for sheet in sheets.values()
        for at, text in sheet.texts.items()
        if at[0] <= HEADING_ROWS and name in may_mean(text) and heading_of(text) is None
    ]
    saw = f"not understood: {', '.join(close[:3])}" if close else f"its sheets are {', '.join(book.sheets) or 'none'}"
    return f"{book.path.name}: no sheet has a column headed {name} or {quantity.headings[1]!r}; {saw}"


def recognized_layout(book: Book) -> Layout:
    """The layout that a workbook's headings state; `InputError` where there is any doubt."""
    recognized = recognize(book)
    for doubt in recognized.doubts:
        raise InputError(f"{doubt}; {HELP}")
    taken = recognized.taken
    tables = {seen: seen.table() for seen in dict.fromkeys(taken.values())}
    modules = tables[taken["x1"]]
    check_modules(modules)
    layout = Layout(modules, {}, {modules: modules.rows})
    for name, seen in taken.items():
        table = tables[seen]
        layout.columns[name] = Column(table, name, modules, _rows_of(name, layout, seen, taken["x1"], table))
    if "l" not in taken:
        _warn_of_unknown(taken["x1"])
    _warn_of_other_sheets(layout, recognized.sheets)
    _warn_of_gap(modules)
    return layout


def _rows_of(name: str, layout: Layout, seen: SheetSeen, coordinates: SheetSeen, table: Table) -> tuple[int, ...]:
    """The row of each module; a single value, in the table's first row, stands for all modules."""
    modules, column = layout.modules, table.columns[name][0]
    rows = table.rows
    if not rows:
        raise InputError(f"{table.sheet.book.path.name}: sheet {table.sheet.name} has no numbers under {name}")
    shared = name in DIMENSIONS and [r for r in rows if table.sheet.value(r, column) is not None] == [rows[0]]
    if table not in layout.rows_of and not (shared and len(rows) == 1):
        try:
            layout.rows_of[table] = _joined(modules, table, coordinates, seen)
        except InputError:
            if not shared:
                raise
    return (rows[0],) * len(modules.rows) if shared else layout.rows_of[table]


def _joined(modules: Table, table: Table, coordinates: SheetSeen, seen: SheetSeen) -> tuple[int, ...]:
    """The row of each module in another sheet: by their numbers where both have them, else in order."""
    file, own, other = modules.sheet.book.path.name, coordinates.label_headings, seen.label_headings
    if modules.labels is not None and table.labels is not None:
        rows = by_label(modules, table)
    else:
        rows = in_order(modules, table)
        for row, its in zip(modules.rows, rows, strict=True):
            if row - modules.rows[0] != its - rows[0]:
                raise InputError(
                    f"{file}: row {row} of sheet {modules.sheet.name} and row {its} of sheet {table.sheet.name} would "
                    "belong together, expected the modules' numbers in both, as other rows are blank in one than in the "
                    f"other; {HELP}"
                )
        if table.numbers is not None and list(table.numbers) != sorted(table.numbers):
            raise InputError(
                f"{file}: the modules of sheet {table.sheet.name} have numbers in no order, those of sheet "
                f"{modules.sheet.name} none, expected numbers in both; {HELP}"
            )
        for heading, at in other.items():
            if heading not in own:
                raise InputError(
                    f"{file}: {table.sheet.place(*at)} heads names of modules that sheet {modules.sheet.name} has not, "
                    f"expected a column in both that says which rows belong together; {HELP}"
                )
    for heading in own.keys() & other.keys():
        for row, its in zip(modules.rows, rows, strict=True):
            here, there = (row, own[heading][1]), (its, other[heading][1])
            one, another = modules.sheet.value(*here), table.sheet.value(*there)
            if one != another:
                raise InputError(
                    f"{file}: {modules.sheet.place(*here)} is {one!r} but {table.sheet.place(*there)}, in the row that "
                    f"belongs to it, is {another!r}, expected the same; {HELP}"
                )
    return rows


def _warn_of_unknown(seen: SheetSeen) -> None:
    unknown = seen.unknown()
    if unknown:
        at, text = unknown[0]
        warnings.warn(
            f"{seen.sheet.book.path.name}: no column is headed l, so the collimator length is the design formula's; "
            f"{seen.sheet.place(*at)} {quoted(text)} is not understood",
            InputWarning,
            stacklevel=4,
        )


def _warn_of_gap(modules: Table) -> None:
    gap = sorted(set(range(modules.rows[0], modules.rows[-1])) - set(modules.rows))
    if gap and modules.labels is None:
        warnings.warn(
            f"{modules.sheet.book.path.name}: row {gap[0]} of sheet {modules.sheet.name} is no module's, and the rows "
            "below, which have no numbers to tell, were taken for modules too",
            InputWarning,
            stacklevel=4,
        )


def _warn_of_other_sheets(layout: Layout, sheets: dict[str, Sheet]) -> None:
    """Warn of a sheet beside the scanner's that says of all lengths what the headings do not."""
    used = {column.table.sheet.name for column in layout.columns.values()}
    units = {column.unit for column in layout.columns.values() if column.unit in LENGTH_UNITS}
    book = layout.modules.sheet.book
    for name, sheet in sheets.items():
        if name in used:
            continue
        for at, text in sheet.texts.items():
            if _OF_ALL.search(text) and any(units != {unit} for unit in units_mentioned(text)):
                warnings.warn(
                    f"{book.path.name}: {sheet.place(*at)} says {quoted(text)}, where the headings of the scanner's "
                    f"sheets say {several(units)}, which was used",
                    InputWarning,
                    stacklevel=4,
                )
                return
