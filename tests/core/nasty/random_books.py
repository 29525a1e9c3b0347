"""Workbooks of random scanners, layouts, units and decorations, each with the system that a person reads in it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from openpyxl.utils import get_column_letter as letter

from mphdrr.core import PinholeSystem

from .scanners import DESCRIPTIONS, MILLIMETRES, SYMBOLS, column_map, quantity, scanner
from .sheets import Book, Formula, Sheet, by_hand, by_openpyxl

POSITION, DIMENSIONS = ("x1", "y1", "z1"), ("d", "R", "Ld", "Td")


@dataclass(frozen=True)
class Layout:
    """Where the tables stand, and how their headings look."""

    modules: int
    seed: int
    sheets: tuple[str, ...]  # one, or two: the second has the dimensions
    top: int
    left: int
    gap: int
    order: tuple[str, ...]  # of the columns
    style: str  # symbols, descriptions or both
    numbers: str  # the heading of the numbers, "" for none
    length: bool
    dimensions_reversed: bool
    shared: bool  # one row of dimensions for all modules
    unit: str
    units_of: str  # which quantities are in `unit`, said in their headings: all, position, one

    @property
    def with_unit(self) -> tuple[str, ...]:
        return {"all": self.order, "position": POSITION, "one": self.order[:1]}[self.units_of]


@dataclass
class Draft:
    """A workbook in the making. `truth` None: nobody can tell. `plain`: it must be read as it is, without a map."""

    layout: Layout
    book: Book
    truth: PinholeSystem | None
    columns: dict[str, tuple[Sheet, str]]
    heading_row: int
    first: int
    plain: bool = True
    numbered: bool = True
    said: set[str] = field(default_factory=set)  # the units that decorations speak of
    units: dict[str, str] = field(default_factory=dict)  # in which the numbers are stored, where it is not mm

    @property
    def last(self) -> int:
        return self.first + self.layout.modules - 1

    def rows(self, name: str) -> range:
        once = self.layout.shared and name in DIMENSIONS and len(self.layout.sheets) == 2
        return range(self.first, self.first + (1 if once else self.layout.modules))

    @property
    def free(self) -> str:
        """A column right of the first sheet's table."""
        from openpyxl.utils import column_index_from_string

        own = [column for sheet, column in self.columns.values() if sheet is self.book.sheets[0]]
        return letter(max(map(column_index_from_string, own)) + 2)


def system_of(layout: Layout) -> PinholeSystem:
    """A scanner that looks like one in centimetres too."""
    rng = np.random.default_rng(layout.seed)
    directions = rng.normal(size=(layout.modules, 3))
    distances = rng.uniform(450, 900, (layout.modules, 1))
    centers = np.round(directions / np.linalg.norm(directions, axis=1)[:, None] * distances, 3)
    many = 1 if layout.shared and len(layout.sheets) == 2 else layout.modules
    d, R, Ld, Td = (
        np.resize(np.round(rng.uniform(*r, many), 2), layout.modules) for r in ((2, 6), (100, 200), (60, 120), (5, 30))
    )
    numbers = np.sort(rng.choice(np.arange(1, 99), layout.modules, replace=False)) if layout.numbers else None
    return scanner(centers, d, R, Ld, Td, numbers=numbers)


def laid_out(layout: Layout) -> Draft:
    system = system_of(layout)
    sheets = [Sheet(name) for name in layout.sheets]
    names = {name: sheets[-1 if name in DIMENSIONS else 0] for name in layout.order}
    two_rows = layout.style == "both"
    heading_row, first = layout.top + 1, layout.top + 2 + two_rows
    columns: dict[str, tuple[Sheet, str]] = {}
    used = {sheet.name: layout.left + 1 + bool(layout.numbers) for sheet in sheets}
    for name in layout.order:
        sheet = names[name]
        column = letter(used[sheet.name])
        used[sheet.name] += 1 + layout.gap
        columns[name] = (sheet, column)
        unit = layout.unit if name in layout.with_unit else ""
        written = f" ({unit})" if unit else ""
        if two_rows:
            sheet[f"{column}{heading_row}"] = SYMBOLS[name]
            sheet[f"{column}{heading_row + 1}"] = DESCRIPTIONS[name] + written
        else:
            texts = SYMBOLS if layout.style == "symbols" else DESCRIPTIONS
            sheet[f"{column}{heading_row}"] = texts[name] + written
        values = quantity(system, name)
        once = layout.shared and name in DIMENSIONS and len(sheets) == 2
        order = range(layout.modules)
        if name in DIMENSIONS and len(sheets) == 2 and layout.dimensions_reversed and layout.numbers and not once:
            order = range(layout.modules - 1, -1, -1)
        for row, i in enumerate(order if not once else range(1), start=first):
            sheet[f"{column}{row}"] = float(f"{values[i] / MILLIMETRES[unit or 'mm']:.15g}")
    draft = Draft(layout, Book(sheets), system, columns, heading_row, first, numbered=bool(layout.numbers))
    if layout.numbers:
        column = letter(layout.left + 1)
        for sheet in sheets:
            sheet[f"{column}{first - 1}"] = layout.numbers
            once = layout.shared and sheet is not sheets[0]
            order = list(map(int, system.numbers))
            if sheet is not sheets[0] and layout.dimensions_reversed and not once:
                order.reverse()
            for row, number in enumerate(order if not once else order[:1], start=first):
                sheet[f"{column}{row}"] = number
    draft.units = dict.fromkeys(layout.with_unit, layout.unit) if layout.unit else {}
    # One row for all is plain without numbers only: with them it might be the first module's.
    draft.plain = not (layout.shared and layout.numbers and len(sheets) == 2)
    return draft


# Decorations: each changes the draft, and what a person reads in it.


def _other_unit(draft: Draft, unit: str, sheets: list[Sheet]) -> None:
    """Store the numbers of `sheets` in `unit`, but for those whose headings say a unit."""
    for name, (sheet, column) in draft.columns.items():
        if sheet not in sheets or (draft.layout.unit and name in draft.layout.with_unit):
            continue
        draft.units[name] = unit
        for row in draft.rows(name):
            at = f"{column}{row}"
            if isinstance(sheet[at], float):
                sheet[at] = float(f"{sheet[at] / MILLIMETRES[unit]:.15g}")
            else:
                draft.truth = None  # a formula, of a number in mm


def title(draft: Draft, text: str, meaning: str) -> None:
    """A text above the table, if there is room."""
    if draft.layout.top:
        draft.book.sheets[0][f"{letter(draft.layout.left + 1)}{max(1, draft.heading_row - 2)}"] = text
        draft.plain = False
        _mean(draft, meaning)


def band(draft: Draft, text: str, meaning: str) -> None:
    """A text merged over the headings of the first sheet."""
    if draft.layout.top:
        row = draft.heading_row - 1
        columns = [column for sheet, column in draft.columns.values() if sheet is draft.book.sheets[0]]
        first, last = min(columns, key=lambda c: (len(c), c)), max(columns, key=lambda c: (len(c), c))
        draft.book.sheets[0][f"{first}{row}"] = text
        if first != last:
            draft.book.sheets[0].merged.append(f"{first}{row}:{last}{row}")
        draft.plain = False
        _mean(draft, meaning)


def units_row(draft: Draft, text: str, meaning: str) -> None:
    """A unit above every heading."""
    if draft.layout.top:
        for sheet, column in draft.columns.values():
            sheet[f"{column}{draft.heading_row - 1}"] = text
        draft.plain = False
        _mean(draft, meaning, everywhere=True)


def number_format(draft: Draft, code: str, meaning: str) -> None:
    for name, (sheet, column) in draft.columns.items():
        for row in draft.rows(name):
            sheet.formats[f"{column}{row}"] = code
    draft.plain &= meaning == "same" and '"' not in code
    _mean(draft, meaning, everywhere=True)


def heading_word(draft: Draft, word: str, meaning: str) -> None:
    """An additional word in the heading of the first column."""
    name = draft.layout.order[0]
    sheet, column = draft.columns[name]
    sheet[f"{column}{draft.first - 1}"] = word.format(sheet[f"{column}{draft.first - 1}"])
    draft.plain = False
    _mean(draft, meaning)


def _mean(draft: Draft, meaning: str, everywhere: bool = False) -> None:
    """What a decoration of the first sheet, or of all, says about the numbers: their unit, nothing, or something unclear."""
    if meaning == "nobody":
        draft.truth = None
    elif meaning != "same":
        again = meaning in draft.said
        draft.said.add(meaning)
        if draft.layout.unit not in ("", meaning) or len(draft.said) > 1:
            draft.truth = None  # contradicts the headings, or another decoration
        if not again:
            _other_unit(draft, meaning, draft.book.sheets if everywhere else draft.book.sheets[:1])


def extra_column(draft: Draft, heading: str, meaning: str) -> None:
    """A column more, numbers in it; a second candidate where its heading is like that of the first column."""
    name = draft.layout.order[0]
    sheet, column = draft.columns[name]
    free = draft.free
    if sheet is not draft.book.sheets[0]:
        return
    sheet[f"{free}{draft.heading_row}"] = heading.format(SYMBOLS[name], DESCRIPTIONS[name])
    for row in draft.rows(name):
        if isinstance(value := sheet[f"{column}{row}"], float):
            sheet[f"{free}{row}"] = value * 1.01
    # Without l, a column of a name that is not known might be it.
    draft.plain = draft.plain and draft.layout.length and meaning == "same" and "{" not in heading
    _mean(draft, meaning)


def rows_below(draft: Draft, label: str, gap: int) -> None:
    """Rows of numbers below the modules, after a label: nobody takes them for modules."""
    sheet = draft.book.sheets[0]
    start = draft.last + 1 + gap
    sheet[f"{letter(draft.layout.left + 1)}{start}"] = label
    for name in POSITION:
        of, column = draft.columns[name]
        of[f"{column}{start + 1}"] = 777.0
    if draft.layout.numbers:
        sheet[f"{letter(draft.layout.left + 1)}{start + 1}"] = 98 if draft.layout.seed % 2 else 1
    draft.plain = False


def total_below(draft: Draft, label: str, gap: int) -> None:
    """A row of sums, by formulas."""
    sheet = draft.book.sheets[0]
    row = draft.last + 1 + gap
    sheet[f"{letter(draft.layout.left + 1)}{row}"] = label
    for name in POSITION:
        of, column = draft.columns[name]
        total = sum(of[f"{column}{r}"] for r in draft.rows(name) if isinstance(of[f"{column}{r}"], float))
        of[f"{column}{row}"] = Formula(f"SUM({column}{draft.first}:{column}{draft.last})", total)
    draft.plain = False


def note_below(draft: Draft, text: str, meaning: str) -> None:
    draft.book.sheets[0][f"{letter(draft.layout.left + 1)}{draft.last + 3}"] = text
    draft.plain = False
    _mean(draft, meaning)


def cell(draft: Draft, value: Any) -> None:
    """Something else instead of a number."""
    name = draft.layout.order[-1]
    sheet, column = draft.columns[name]
    sheet[f"{column}{draft.first}"] = value
    draft.plain = False
    if name != "l" or value is not None:  # an l that is missing is by design, as all are
        draft.truth = None


def formula(draft: Draft, stale: bool, asked: bool) -> None:
    """A number by a formula of a cell far off, which has changed since or not."""
    name = draft.layout.order[-1]
    sheet, column = draft.columns[name]
    at = f"{column}{draft.first}"
    if not isinstance(sheet[at], float):
        return
    draft.book.calculation = f'<calcPr calcId="191029"{" fullCalcOnLoad=" + chr(34) + "1" + chr(34) if asked else ""}/>'
    sheet["AZ1"] = sheet[at] * (1.05 if stale else 1.0)
    sheet[at] = Formula("AZ1*1", sheet[at])
    if stale:
        draft.truth, draft.plain = None, False


def other_sheet(draft: Draft, name: str, kind: str, state: str) -> None:
    """A sheet more: of something else, or a copy with other numbers."""
    if kind == "notes":
        sheet = Sheet(name, {"A1": "see the drawings", "A2": 3.5, "B2": "cm"})
    else:
        source = draft.book.sheets[0]
        sheet = dataclasses.replace(source, name=name, cells=dict(source.cells), formats={}, merged=[])
        for q, (of, column) in draft.columns.items():
            if of is source:
                for row in draft.rows(q):
                    if isinstance(sheet[f"{column}{row}"], float):
                        sheet[f"{column}{row}"] *= 1.02
        draft.plain = False
        if name != "Theta" or draft.layout.sheets != ("Coordinates", "Main"):  # beside them it is known to be no table
            draft.truth = None
    sheet.state = state
    draft.book.sheets.append(sheet)


def labels(draft: Draft, disagree: bool) -> None:
    """Labels instead of the modules' numbers, the same in both sheets or not."""
    if not draft.layout.numbers or len(draft.layout.sheets) == 1 or draft.layout.shared:
        return
    column = letter(draft.layout.left + 1)
    for sheet in draft.book.sheets[:2]:
        for row in range(draft.first, draft.last + 1):
            if isinstance(sheet[f"{column}{row}"], int):
                sheet[f"{column}{row}"] = f"M{sheet[f'{column}{row}']:02d}"
    draft.plain = draft.numbered = False
    if disagree and draft.layout.modules > 1:
        draft.book.sheets[1][f"{column}{draft.last}"] = "spare"
        draft.truth = None


def note_of_heading(draft: Draft, text: str, meaning: str) -> None:
    """A comment of the heading of the first column, which speaks of that column."""
    name = draft.layout.order[0]
    sheet, column = draft.columns[name]
    sheet.notes[f"{column}{draft.heading_row}"] = text
    draft.plain = False
    said = draft.layout.unit if name in draft.layout.with_unit else ""
    if meaning not in ("same", said):
        draft.truth = None  # of this column alone, or of all


def beside(draft: Draft, text: str, meaning: str, row: int) -> None:
    """A text right of the first sheet's table."""
    draft.book.sheets[0][f"{letter(30)}{draft.heading_row + row}"] = text
    draft.plain = False
    _mean(draft, meaning)


def name_of_sheet(draft: Draft, form: str, meaning: str) -> None:
    """The first sheet's name says a unit."""
    sheet = draft.book.sheets[0]
    sheet.name = form.format(sheet.name)
    draft.plain = False
    _mean(draft, meaning)


def number_twice(draft: Draft) -> None:
    if draft.layout.numbers and draft.layout.modules > 1:
        column = letter(draft.layout.left + 1)
        draft.book.sheets[0][f"{column}{draft.last}"] = draft.book.sheets[0][f"{column}{draft.first}"]
        draft.truth, draft.plain = None, False


def hidden_column(draft: Draft, heading: str) -> None:
    """A hidden column, which may be a second candidate."""
    name = draft.layout.order[0]
    sheet = draft.columns[name][0]
    heading = heading.format(SYMBOLS[name])
    sheet[f"AC{draft.heading_row}"] = heading
    sheet.hidden_columns.append("AC")
    for row in draft.rows(name):
        sheet[f"AC{row}"] = 1.5
    draft.plain = False
    if heading == SYMBOLS[name]:
        draft.truth = None


def backwards(draft: Draft) -> None:
    """Rows stored in reverse order."""
    draft.book.sheets[0].row_order = lambda rows: rows[::-1]
    draft.plain = False


def all_mean(meaning: str, *texts: str) -> list[tuple[str, str]]:
    """Texts, each with what it makes the numbers mean."""
    return [(text, meaning) for text in texts]


UNIT_WORDS = [
    *all_mean("cm", "cm", "in cm", "all lengths in cm", "Units: cm"),
    *(("inches", "in"), ("m", "m"), ("dm", "dm"), ("[cm]", "cm"), ("Maße in Zoll", "in")),
    *(("lengths in mm", "same"), ("mm", "same"), ("feet", "ft")),
]
OTHER_WORDS = [("OBSOLETE", "same"), ("half values", "nobody"), ("mirrored", "nobody"), ("values x 10", "nobody")]
TITLES = [("DC-SPECT", "same"), ("Geometry of the scanner", "same"), ("2021-03-04", "same")]
HEADING_WORDS = [
    *all_mean("nobody", "{} (old)", "tolerance of {}", "half {}", "{} nominal", "{}²", "{} (dm)", "{} (cm, CAD)"),
    *all_mean("nobody", "{} × 10", "Δ{}", "{}/2", "{}, mm or cm", "{} of window", "{} (0.1 mm)", "-{}"),
    *all_mean("same", "{}", " {} ", "{}:"),
]
FORMATS = [
    ("0.00", "same"),
    ("0.000E+00", "same"),
    ('0.0" mm"', "same"),
    ('0.00" cm"', "cm"),
    ("0.0\\ \\c\\m", "cm"),
    ('0.0"″"', "in"),
    ("[$-409]0.0", "same"),
    ("0.0,", "nobody"),
    ('"-"0.0', "nobody"),
]
COLUMNS = [
    *all_mean("same", "serial", "S", "3D slope", "weight (kg)", "note"),
    *all_mean("nobody", "{0}", "{0} new", "{0} (measured)", "{1}", "{1} (cm)", "{0}_corr"),
]
GAPS = st.integers(0, 2)

decorations = st.one_of(
    st.sampled_from([*UNIT_WORDS, *TITLES]).map(lambda pair: (title, *pair)),
    st.sampled_from([*UNIT_WORDS, *OTHER_WORDS]).map(lambda pair: (band, *pair)),
    st.sampled_from(UNIT_WORDS).map(lambda pair: (units_row, *pair)),
    st.sampled_from(FORMATS).map(lambda pair: (number_format, *pair)),
    st.sampled_from(HEADING_WORDS).map(lambda pair: (heading_word, *pair)),
    st.sampled_from(COLUMNS).map(lambda pair: (extra_column, *pair)),
    st.tuples(st.just(rows_below), st.sampled_from(["OLD DESIGN, do not use", "spare", "removed", "x1", "99"]), GAPS),
    st.tuples(st.just(total_below), st.sampled_from(["mean", "Sum", "", "5"]), GAPS),
    st.sampled_from([("measured in 2021", "same"), ("all in cm", "cm"), ("cm", "cm"), ("R: ROI", "same")]).map(
        lambda pair: (note_below, *pair)
    ),
    st.tuples(st.just(cell), st.sampled_from(["12,5", "12.5 cm", "n/a", True, None, "?", "see above", "1e3x"])),
    st.tuples(st.just(formula), st.booleans(), st.booleans()),
    st.tuples(
        st.just(other_sheet),
        st.sampled_from(["Theta", "Coordinates old", "backup", "Units"]),
        st.sampled_from(["notes", "copy"]),
        st.sampled_from(["visible", "hidden", "veryHidden"]),
    ),
    st.tuples(st.just(labels), st.booleans()),
    st.tuples(st.just(backwards)),
    st.tuples(st.just(number_twice)),
    st.tuples(st.just(hidden_column), st.sampled_from(["{}", "{} old", "serial"])),
    st.sampled_from([("in cm", "cm"), ("checked by JS", "same"), ("inches", "in")]).map(
        lambda pair: (note_of_heading, *pair)
    ),
    st.tuples(st.sampled_from([("<- in cm", "cm"), ("cm", "cm"), ("see drawing", "same")]), st.integers(0, 2)).map(
        lambda drawn: (beside, *drawn[0], drawn[1])
    ),
    st.sampled_from([("{} (cm)", "cm"), ("{} in inches", "in"), ("{} 2", "same")]).map(
        lambda pair: (name_of_sheet, *pair)
    ),
)

layouts = st.builds(
    Layout,
    modules=st.integers(1, 5),
    seed=st.integers(0, 1000),
    sheets=st.sampled_from(
        [("Coordinates", "Main"), ("Geometry",), ("Lage", "Größen"), ("Sheet1", "Sheet2"), ("Main",), ("a'b", "c d")]
    ),
    top=st.integers(0, 4),
    left=st.integers(0, 2),
    gap=st.integers(0, 1),
    order=st.permutations([*POSITION, *DIMENSIONS, "l"]).map(tuple),
    style=st.sampled_from(["symbols", "descriptions", "both"]),
    numbers=st.sampled_from(["Definitions", "No.", "Module", ""]),
    length=st.booleans(),
    dimensions_reversed=st.booleans(),
    shared=st.booleans(),
    unit=st.sampled_from(["", "", "mm", "cm", "m", "in"]),
    units_of=st.sampled_from(["all", "position", "one"]),
).map(
    lambda layout: (
        layout if layout.length else dataclasses.replace(layout, order=tuple(q for q in layout.order if q != "l"))
    )
)


@dataclass(frozen=True)
class Recipe:
    """A layout, its decorations in order, and the program that writes it."""

    layout: Layout
    added: tuple[tuple, ...]
    program: str


def _some(low: int, high: int) -> st.SearchStrategy[tuple]:
    return st.lists(decorations, min_size=low, max_size=high, unique_by=lambda added: added[0]).map(tuple)


recipes = st.builds(
    Recipe,
    layout=layouts,
    added=st.one_of(st.just(()), *(_some(low, high) for low, high in ((1, 1), (1, 2), (2, 3), (3, 4)))),
    program=st.sampled_from(["by hand", "by hand", "openpyxl"]),
)


def written(recipe: Recipe, path: Path) -> Draft:
    """The recipe's workbook, in `path`, and what a person reads in it."""
    draft = laid_out(recipe.layout)
    for add, *arguments in recipe.added:
        add(draft, *arguments)
    stale = any(add is formula and arguments[0] for add, *arguments in recipe.added)
    if recipe.program == "openpyxl" and not stale:  # openpyxl stores no values that could be stale
        try:
            by_openpyxl(draft.book, path)
        except ValueError:  # what openpyxl does not write
            by_hand(draft.book, path)
    else:
        by_hand(draft.book, path)
    return draft


def map_of(draft: Draft) -> str | None:
    """The column map for what a person sees; None if a map cannot express it."""
    units = {name: draft.units.get(name, "mm") for name in draft.columns}
    if draft.truth is None or not set(units.values()) <= {"mm", "cm", "m", "in"}:
        return None
    layout, tables = draft.layout, []
    for i, sheet in enumerate(draft.book.sheets[: len(layout.sheets)]):
        shared = bool(i) and layout.shared
        table: dict[str, Any] = {"sheet": sheet.name, "first_row": draft.first}
        table["last_row"] = draft.first if shared else draft.last
        if layout.numbers and not shared:
            table["number"] = letter(layout.left + 1)
        if i:
            table["rows"] = "one for all" if shared else "by number" if layout.numbers else "in order"
        table["columns"] = {name: (c, units[name]) for name, (of, c) in draft.columns.items() if of is sheet}
        tables.append(table)
    return column_map(*tables)
