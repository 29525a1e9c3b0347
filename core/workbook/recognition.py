"""Which cells hold which quantity, by a workbook's headings: what is understood for certain, and doubts of the rest.

A doubt is whatever may make a number mean something else than its heading says: a heading, a unit or a table that is
not accounted for. `recognized_layout` refuses a workbook with any; `core.workbook.draft` asks a person.
"""

from __future__ import annotations

import re
import warnings
from collections import defaultdict
from dataclasses import dataclass, field
from functools import cached_property

from ..errors import InputError, InputWarning
from .book import HEADING_ROWS, Book, Sheet
from .cells import module_number
from .layout import Column, Layout, Table, by_label, check_modules, in_order
from .quantities import (
    DERIVED,
    DIMENSIONS,
    LENGTH_UNITS,
    NEEDED,
    POSITION,
    QUANTITIES,
    UNIT_WORDS,
    Heading,
    is_label_heading,
    is_number_heading,
    may_mean,
    plain,
    shown_as_stored,
    understood,
    unit_alone,
    units_in,
)
from .references import Reference
from .sheet_xml import At
from .workbook_xml import areas_in

OWN_SHEETS = frozenset(("mdsl cloud import", "theta", "values", "design table"))
"""Sheets that users' workbooks carry beside the scanner's, whatever they hold."""
ASIDE = frozenset(("s", "3d slope"))
"""Headings of the users' workbooks whose columns are of no concern."""
HELP = "a column map can say what is meant (--columns, docs/workbook.md)"

_ROWS_APART = 2
"""A symbol row and a description row that are further apart do not belong together."""
_SUMMARY = re.compile(r"\b(SUM|AVERAGE|MEAN|MEDIAN|MIN|MAX|COUNT|COUNTA|STDEV|VAR|SUBTOTAL|AGGREGATE)[.SP]*\(", re.I)
_OF_ALL = re.compile(
    r"\b(all|every|lengths?|dimensions?|distances?|coordinates?|sizes?|units?|numbers?|values?)\b", re.I
)
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
        return any(_is_number(self.sheet, row, column) for column in self.headings)

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
            heading, unit = said.get(row), unit_alone(text)
            place = self.sheet.place(row, c)
            if heading is None and unit not in QUANTITIES[first.quantity].units:
                self.doubt(
                    f"{place} holds {_quoted(text)} in the heading of {first.quantity}, expected its name and a unit alone"
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
        for area in self._merged:
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
        return {column for row, column in self.sheet.cells if row in rows and _is_number(self.sheet, row, column)}

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
        for row in self.sheet.rows:
            if row < self.first_row:
                continue
            values = [value for column in self.wanted if (value := self.sheet.value(row, column)) is not None]
            if _is_summary(self.sheet, row, self.wanted):
                continue
            alone = len(values) == 1 and type(values[0]) is str and not _NUMERIC.fullmatch(values[0])
            note = alone and len(self.wanted) > 1 and row - 1 not in found[-1:]
            if (values and not note) or any(self._is_typed(row, column) for column in typed):
                found.append(row)
        return found

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
            or (row >= self.first_row and module_number(self.sheet.value(row, self.label_column)) is not None)
        )

    def table(self) -> Table:
        """The table, as far as it is understood."""
        return Table(self.sheet, self.columns, self.rows, self.label_column)

    # Doubts

    def look_around(self, quantities: set[str]) -> None:
        """Note what else in the sheet may concern `quantities`, which are taken from here."""
        for at, text in self.unknown():
            about = [name for name in may_mean(text) if name in quantities]
            if about:
                self.doubt(
                    f"{self.sheet.place(*at)} is headed {_quoted(text)}, which is not understood and may mean {about[0]}"
                )
        self._other_tables()
        self._texts_between()
        used = [self.columns[name] for name in self.columns if name in quantities]
        lengths = {unit for _, unit in used if unit in LENGTH_UNITS}
        self._notes(lengths)
        self._formats(used)
        self._hidden_under_merged(used)
        self._above_headings(used)

    def _hidden_under_merged(self, used: list[tuple[int, str]]) -> None:
        """Numbers that a merged cell covers, so that nobody sees them."""
        rows = set(self.rows)
        for area in self._merged:
            for column, _ in used:
                for row in range(area.top, area.bottom + 1):
                    covered = area.left <= column <= area.right and (row, column) != (area.top, area.left)
                    if covered and row in rows and self.sheet.value(row, column) is not None:
                        self.doubt(
                            f"{self.sheet.place(row, column)} is hidden under a merged cell, expected it to be seen"
                        )
                        return

    def _above_headings(self, used: list[tuple[int, str]]) -> None:
        """A text right above a heading, or merged over it, which may be part of what it says."""
        for column, _ in used:
            at = next(iter(self.headings[column])) - 1, column
            over = [a for a in self._merged if a.top <= at[0] <= a.bottom and a.left <= column <= a.right]
            at = (over[0].top, over[0].left) if over else at
            if at in self.sheet.texts and at not in self.above:
                text = _quoted(self.sheet.texts[at])
                self.doubt(
                    f"{self.sheet.place(*at)} holds {text} right above a heading, expected nothing, or a row between"
                )
                return

    @property
    def _merged(self) -> list[Reference]:
        return self.sheet.book.workbook.sheets[self.sheet.name].merged

    def _other_tables(self) -> None:
        """Headings of what is needed that stand apart: a second table, or a second heading."""
        apart: dict[int, dict[str, int]] = defaultdict(dict)
        for (row, column), text in self.sheet.texts.items():
            heading = understood(text)
            if heading is not None and not self.first_heading <= row < self.first_row:
                apart[row][heading.quantity] = column
        for row, found in sorted(apart.items()):
            over_numbers = any(_is_number(self.sheet, row + 1, column) for column in found.values())
            if row < self.first_heading or len(found) > 1 or over_numbers:
                name, column = next(iter(found.items()))
                self.doubt(
                    f"{self.sheet.place(row, column)} is headed as {name}, apart from the headings in row "
                    f"{self.first_heading}, expected one table"
                )
                return

    def _texts_between(self) -> None:
        """Something between the modules' rows: what follows may be another table."""
        if not self.rows:
            return
        columns = {*self.headings, self.label_column or min(self.headings)}
        modules = set(self.rows)
        for row in range(self.rows[0], self.rows[-1] + 1):
            if row in modules:
                continue
            texts = [at for at in self._texts_of_row.get(row, ()) if min(columns) <= at[1] <= max(columns)]
            if texts and not _is_summary(self.sheet, row, self.wanted):
                text = _quoted(self.sheet.texts[texts[0]])
                self.doubt(f"{self.sheet.place(*texts[0])} holds {text} between rows of modules, expected one table")
                return

    @cached_property
    def _texts_of_row(self) -> dict[int, list[At]]:
        found: dict[int, list[At]] = defaultdict(list)
        for at in sorted(self.sheet.texts):
            found[at[0]].append(at)
        return found

    def _notes(self, lengths: set[str]) -> None:
        """Units in the sheet's name and in texts that are no heading, and that are not the headings' own."""
        for unit in units_in(self.sheet.name.replace("_", " ")):
            if lengths != {unit}:
                self.doubt(
                    f"the name of sheet {self.sheet.name} speaks of {unit}, where the headings say {_several(lengths)}"
                )
        modules = set(self.rows)
        for at, text in self.sheet.texts.items():
            row, column = at
            if at in self.above and (column in self.headings or self._heads_its_own(at)):
                continue
            for unit in units_in(text, alone=row in modules):
                named = unit in UNIT_WORDS and any(
                    units_in(self.sheet.texts[a]) for a in self._texts_of_row[row] if a != at
                )
                if lengths != {unit} and not named:
                    self.doubt(
                        f"{self.sheet.place(*at)} holds {_quoted(text)}, where the headings say {_several(lengths)}: "
                        "expected one unit"
                    )
        for at, text in self.sheet.comments.items():
            if at[0] < self.first_row and any(lengths != {unit} for unit in units_in(text)):
                self.doubt(
                    f"{self.sheet.place(*at)} has the comment {_quoted(text)}, where the headings say "
                    f"{_several(lengths)}: expected one unit"
                )

    def _heads_its_own(self, at: At) -> bool:
        """Whether a text is the heading of numbers that are of no concern: its unit is theirs alone."""
        alone = len(self.aside[at[1]]) == 1 and units_in(self.above[at], alone=True)
        return at[1] in self.numeric - {self.label_column} and not alone

    def _formats(self, used: list[tuple[int, str]]) -> None:
        """Number formats that show another unit, or another number, than the cell's."""
        for column, unit in used:
            for row in self.rows:
                if (row, column) not in self.sheet.cells or self.sheet.is_date(row, column):
                    continue
                shown = self.sheet.number_format(row, column)
                if not shown_as_stored(shown, unit):
                    self.doubt(
                        f"{self.sheet.place(row, column)} is shown as {_quoted(shown)}, where its heading says {unit}: "
                        "expected one unit"
                    )
                    break


def sheets_seen(book: Book) -> list[SheetSeen]:
    """The sheets with headings, in the workbook's order; those that only accompany users' workbooks left out."""
    found = [_seen(sheet) for name, sheet in book.sheets.items() if plain(name).casefold() not in OWN_SHEETS]
    return [seen for seen in found if seen is not None]


def _seen(sheet: Sheet) -> SheetSeen | None:
    rows: dict[int, dict[int, Heading]] = defaultdict(dict)
    for (row, column), text in sheet.texts.items():
        if row <= HEADING_ROWS and (heading := understood(text)) is not None:
            rows[row][column] = heading
    if not rows:
        return None
    main = max(rows, key=lambda row: (len({heading.quantity for heading in rows[row].values()}), -row))
    chosen = {main}
    for step in (-1, 1):
        for row in sorted(rows, key=lambda row: step * row):
            near = 0 < step * (row - (min(chosen) if step < 0 else max(chosen))) <= _ROWS_APART
            if near and not any(_is_number(sheet, row, column) for column in rows[main]):
                chosen.add(row)
    headings: dict[int, dict[int, Heading]] = defaultdict(dict)
    for row in sorted(chosen):
        for column, heading in rows[row].items():
            headings[column][row] = heading
    return SheetSeen(sheet, min(chosen), max(chosen), dict(headings))


@dataclass(frozen=True, eq=False)
class Recognized:
    """What is seen of the scanner in a workbook.

    Attributes
    ----------
    book : Book
    taken : dict
        Quantity -> the sheet that it is taken from.
    doubts : list of str
        What keeps the workbook from being read.
    """

    book: Book
    taken: dict[str, SheetSeen]
    doubts: list[str]


def recognize(book: Book) -> Recognized:
    """What is seen of the scanner in a workbook, with the doubts."""
    seen = sheets_seen(book)
    taken: dict[str, SheetSeen] = {}
    doubts, missing = [], []
    for name in (*NEEDED, "l"):
        having = [s for s in seen if name in s.columns]
        filled = [s for s in having if s.columns[name][0] in s.numeric]
        if len(filled) > 1:
            first, second = (s.sheet.place(s.first_heading, s.columns[name][0]) for s in filled[:2])
            doubts.append(
                f"{book.path.name}: {first} and {second}, of two sheets, are both headed as {name}, expected one such column"
            )
        if having:
            taken[name] = (filled or having)[0]
        elif name != "l":
            missing.append(_missing(book, name))
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
        sheet.look_around({*NEEDED, "l", *(name for name, of in taken.items() if of is sheet)})
        doubts += sheet.doubts
    return Recognized(book, taken, doubts + missing)


def _shown_instead(book: Book, sheet: Sheet) -> list[str]:
    """A doubt where the coordinates' sheet is hidden, and another that is shown has such a table."""
    if sheet.name not in book.workbook.hidden:
        return []
    shown = [other for title, other in book.sheets.items() if title not in book.workbook.hidden]
    for seen in filter(None, map(_seen, shown)):
        if seen.columns.keys() >= set(POSITION) and seen.rows:
            return [
                f"{book.path.name}: sheet {sheet.name} is hidden, but {seen.sheet.name} is shown, expected one of them"
            ]
    return []


def _missing(book: Book, name: str) -> str:
    quantity = QUANTITIES[name]
    close = [
        f"{sheet.place(*at)} {_quoted(text)}"
        for title, sheet in book.sheets.items()
        if plain(title).casefold() not in OWN_SHEETS
        for at, text in sheet.texts.items()
        if at[0] <= HEADING_ROWS and name in may_mean(text) and understood(text) is None
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
    _warn_of_other_sheets(layout)
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
            f"{seen.sheet.place(*at)} {_quoted(text)} is not understood",
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


def _warn_of_other_sheets(layout: Layout) -> None:
    """Warn of a sheet beside the scanner's that says of all lengths what the headings do not."""
    used = {column.table.sheet.name for column in layout.columns.values()}
    units = {column.unit for column in layout.columns.values() if column.unit in LENGTH_UNITS}
    book = layout.modules.sheet.book
    for name, sheet in book.sheets.items():
        if name in used or plain(name).casefold() in OWN_SHEETS:
            continue
        for at, text in sheet.texts.items():
            if _OF_ALL.search(text) and any(units != {unit} for unit in units_in(text)):
                warnings.warn(
                    f"{book.path.name}: {sheet.place(*at)} says {_quoted(text)}, where the headings of the scanner's "
                    f"sheets say {_several(units)}, which was used",
                    InputWarning,
                    stacklevel=4,
                )
                return


def _is_number(sheet: Sheet, row: int, column: int) -> bool:
    """Whether a cell holds anything but text or nothing."""
    value = sheet.value(row, column)
    return value is not None and type(value) is not str


def _is_summary(sheet: Sheet, row: int, columns: list[int]) -> bool:
    """Whether a row sums up others: each number in `columns` is a sum, mean ... over several rows of its column."""
    filled = [column for column in columns if sheet.value(row, column) is not None]
    return bool(filled) and all(_sums_up(sheet, sheet.formula(row, column), column) for column in filled)


def _sums_up(sheet: Sheet, formula: str | None, column: int) -> bool:
    if formula is None or not _SUMMARY.search(formula):
        return False
    return any(
        area.top < area.bottom and area.left <= column <= area.right and area.sheet in (None, sheet.name)
        for area in areas_in(formula)
    )


def _quoted(text: str) -> str:
    text = plain(text)
    return repr(text if len(text) <= 60 else text[:59] + "…")


def _several(units: set[str]) -> str:
    return " and ".join(sorted(units))
