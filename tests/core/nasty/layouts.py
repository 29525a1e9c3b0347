"""Layouts of workbooks: where the tables stand and how they are headed, with the scanner that a person reads in them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from openpyxl.utils import column_index_from_string, get_column_letter

from mphdrr.core import PinholeSystem, collimator_length

from .sheets import Book, Error, Formula, Sheet, split

CENTERS = np.array([[277.0, 70.3, -70.0], [155.0, 158.4, -70.9], [-63.1, -245.8, 70.4], [-10.5, 190.25, 12.0]])
BIG_CENTERS = np.array([[540.0, 70.5, -92.0], [315.0, 416.0, -96.5], [-164.0, -490.5, 104.0], [-25.5, 480.25, 24.0]])
POSITION, DIMENSIONS = ("x1", "y1", "z1"), ("d", "R", "Ld", "Td")
TYPED = (*POSITION, *DIMENSIONS, "l")
DERIVED = ("b", "slope", "H", "x2", "y2", "z2", "range", "azimuth", "elevation")
DERIVED_AND_LENGTH = (*DERIVED[:2], "l", *DERIVED[2:])
DESCRIPTIONS = {
    **{f"{axis}1": f"{axis} coordinate value at center of hole" for axis in "xyz"},
    **{f"{axis}2": f"{axis} coordinate value at end of detector" for axis in "xyz"},
    "b": "distance from center of hole to center of heart",
    "slope": "3D slope",
    "l": "length of collimator",
    "d": "diameter of pinhole",
    "R": "radius of spherical region of interest",
    "Ld": "length of side of detector crystal",
    "Td": "thickness of detector crystal",
    "range": "pinhole range",
    "azimuth": "pinhole azimuth (radians)",
    "elevation": "pinhole elevation (radians)",
}
SYMBOLS = {name: name for name in (*TYPED, *DERIVED)} | {"slope": "S", "H": "l + b+Td"}
WITHOUT_SYMBOL = ("range", "azimuth", "elevation")
SYMBOLS |= {name: DESCRIPTIONS[name] for name in WITHOUT_SYMBOL}
OTHER_HEADINGS = {
    "Chinese": "孔中心 x|孔中心 y|孔中心 z|孔径|感兴趣区半径|晶体边长|晶体厚度|准直器长度",
    "short words": "x|y|z|diameter|ROI|crystal|thickness|length",
    "positions": "x position of hole|y position of hole|z position of hole|hole diameter|radius of ROI|detector size"
    "|detector thickness|pinhole to crystal",
    "none": "|||||||",
}
"""Rows of headings that a person understands, or guesses, and no vocabulary needs to have."""
HEADINGS = {"symbols": SYMBOLS, "descriptions": DESCRIPTIONS}
HEADINGS |= {style: dict(zip(TYPED, texts.split("|"), strict=True)) for style, texts in OTHER_HEADINGS.items()}
FORMULAS = {
    "b": "SQRT(SUMSQ({x1},{y1},{z1}))",
    "slope": "{b}/{x1}",
    "l": "({Ld}-{d})*({b}^2-{R}^2)/({b}*{d}+2*{R}*SQRT({b}^2-{R}^2+{d}^2/4))",
    "H": "{b}+{l}+{Td}",
    **{f"{axis}2": f"{{{axis}1}}*{{H}}/{{b}}" for axis in "xyz"},
    "range": "SQRT(SUMSQ({x1},{y1}))",
    "azimuth": "(ATAN2({x1},{y1}))",
    "elevation": "(ATAN2({range},{z1}))",
}
ANGLES = ("slope", "azimuth", "elevation")
"""Derived columns that are no lengths."""
MILLIMETRES = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4, "um": 1e-3, "dm": 100.0, "ft": 304.8, "mil": 0.0254}
MILLIMETRES |= {"0.1 mm": 0.1, "voxel": 4.0}  # of which a column map can name no voxels


def scanner(
    centers: np.ndarray = CENTERS,
    d: Any = 2.3,
    R: Any = 75.0,
    Ld: Any = 50.0,
    Td: Any = 10.0,
    l: Any = None,
    numbers: Any = None,
) -> PinholeSystem:
    """Return a scanner whose l is by design unless given."""
    if l is None:
        l = collimator_length(np.linalg.norm(centers, axis=1), d, Ld, R)
    return PinholeSystem(centers, d, l, Ld, Td, R, None if numbers is None else np.asarray(numbers))


SCANNER = scanner()
BIG = scanner(BIG_CENTERS, 4.0, 150.0, 120.0, 20.0)
"""A scanner whose numbers in centimetres look like a small one's in millimetres: its size does not reveal the unit."""


def quantity(system: PinholeSystem, name: str) -> np.ndarray:
    """Return the numbers (M,) of a column, mm or rad."""
    s = system
    b, planar = s.pinhole_distance, np.hypot(*s.centers[:, :2].T)
    end = b + s.collimator_length + s.detector_thickness
    columns = {f"{axis}1": s.centers[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"{axis}2": s.centers[:, i] * end / b for i, axis in enumerate("xyz")}
    columns |= {"b": b, "l": s.collimator_length, "H": end, "R": s.roi_radius, "range": planar}
    columns |= {"d": s.pinhole_diameter, "Ld": s.detector_side, "Td": s.detector_thickness}
    columns |= {"azimuth": np.arctan2(s.centers[:, 1], s.centers[:, 0])}
    with np.errstate(divide="ignore"):
        return (columns | {"elevation": np.arctan2(s.centers[:, 2], planar), "slope": b / s.centers[:, 0]})[name]


@dataclass(frozen=True)
class Layout:
    """Where the tables stand, and how their headings look."""

    modules: int = 4
    seed: int = 0
    sheets: tuple[str, str] = ("Coordinates", "Main")
    second: str = ""  # where the dimensions' table stands: "" for one table, sheet, beside, below
    main_first: bool = False  # the order of the sheets
    top: int = 0
    left: int = 0
    gap: int = 0  # blank columns between two
    apart: int = 0  # blank rows between symbols and descriptions
    under: int = 0  # blank rows between the headings and the first module
    order: tuple[str, ...] = TYPED  # of the columns; without l there is none
    columns: tuple[tuple[str, str], ...] = ()  # letters of columns that do not follow the order
    style: str = "symbols"  # or descriptions, both, both reversed, or another row of headings
    unit: str = ""
    unit_form: str = "{} ({})"
    unit_in: str = "all"  # of the two headings: symbol, description, all
    units_of: str = "all"  # the columns that are in `unit`: all, position, one; or each has a unit of its own
    number: str = "No."  # the heading of the modules' numbers
    labels: tuple[str, str] = ("numbers", "numbers")  # of the two tables
    shuffled: bool = False  # the rows of the second table, by their labels
    once: str = ""  # what holds for all modules: the table's single row, the first cells, or those merged
    formulas: str = ""  # of the derived columns, if there are any: typed, stored, unstored, zeros

    @property
    def in_unit(self) -> dict[str, str]:
        """The unit that the heading of each column says."""
        names = (*self.order, *self.derived)
        if self.units_of == "own":
            return dict(zip(names, ("mm", "cm", "m", "in") * 5, strict=False))
        some = {"all": names, "position": POSITION, "one": self.order[:1]}[self.units_of]
        return dict.fromkeys(some, self.unit) if self.unit else {}

    @property
    def derived(self) -> tuple[str, ...]:
        """The derived columns."""
        beyond = () if "l" in self.order else ("H", "x2", "y2", "z2")
        return tuple(name for name in DERIVED if name not in beyond) if self.formulas else ()


@dataclass
class Table:
    """A table in a sheet: columns by letters, and the index of the module in each of its rows."""

    sheet: Sheet
    columns: dict[str, str]
    number: str
    row: int  # of the first heading
    rows: list[int]
    modules: list[int]


@dataclass
class Draft:
    """A workbook in the making.

    `truth` is the scanner that its cells hold, None if they hold none. A reader that says nothing must have read that, if
    it is `clear` what the cells mean; if `plain`, it must have read it. One of the `places` is named in a refusal.
    """

    layout: Layout
    book: Book
    system: PinholeSystem  # before any decoration
    truth: PinholeSystem | None
    tables: list[Table]
    once: tuple[str, ...]
    units: dict[str, str]  # in which the numbers are stored
    plain: bool = True
    clear: bool = True
    numbered: bool = True
    mappable: bool = True  # a column map reads it
    said: set[str] = field(default_factory=set)  # the units that texts apart from the headings speak of
    places: list[str] = field(default_factory=list)

    def table(self, name: str) -> Table:
        """Return the table that has a column."""
        return next(table for table in self.tables if name in table.columns)

    def at(self, name: str, i: int) -> str:
        """Return the cell of module index `i` in a column."""
        table = self.table(name)
        row = table.rows[0] if name in self.once else table.rows[table.modules.index(i)]
        return f"{table.columns[name]}{row}"

    def cells(self, name: str) -> list[str]:
        """Return the cells of a column, module by module, each once."""
        return list(dict.fromkeys(self.at(name, i) for i in self.tables[0].modules))

    def heading(self, name: str, last: bool = True) -> str:
        """Return the cell of a column's heading, of two the last one or the first."""
        table = self.table(name)
        row = max(
            r for r in range(table.row, table.rows[0]) if table.sheet[f"{table.columns[name]}{r}"] or r == table.row
        )
        return f"{table.columns[name]}{row if last else table.row}"

    @property
    def bottom(self) -> int:
        """The last row of modules in the first sheet."""
        return max(table.rows[-1] for table in self.tables if table.sheet is self.tables[0].sheet)

    def free(self, k: int = 2) -> str:
        """Return the letters of the k-th column right of everything in the first sheet."""
        return get_column_letter(max(split(at)[0] for at in self.tables[0].sheet.cells) + k)


def random_centers(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return random centres of pinholes (n, 3), 450 to 900 mm from the isocentre."""
    directions = rng.normal(size=(n, 3))
    return np.round(directions / np.linalg.norm(directions, axis=1)[:, None] * rng.uniform(450, 900, (n, 1)), 3)


def system_of(layout: Layout) -> PinholeSystem:
    """Return a random scanner that looks like one in centimetres too."""
    rng = np.random.default_rng(layout.seed)
    M = layout.modules
    centers = random_centers(rng, M)
    ranges = ((2, 6), (100, 200), (60, 120), (5, 30))
    d, R, Ld, Td = (np.resize(np.round(rng.uniform(*r, 1 if layout.once else M), 2), M) for r in ranges)
    numbers = rng.choice(np.arange(1, 10 * M), M, replace=False)
    return scanner(centers, d, R, Ld, Td, numbers=numbers if layout.seed % 3 == 2 else np.sort(numbers))


def label(kind: str, number: int) -> Any:
    """Return what a row calls its module."""
    return {
        "numbers": number,
        "texts": str(number),
        "zeros": f"{number:03d}",
        "decimals": float(number),
        "names": f"M{number:02d}",
        "halves": number + 0.5,
        "formulas": Formula(f"{number}*1", number),
        "unstored": Formula(f"{number}*1"),
    }.get(kind)


NUMBERS = ("numbers", "texts", "zeros", "decimals", "formulas", "unstored")
"""Kinds of labels that are numbers."""


def laid_out(layout: Layout, system: PinholeSystem | None = None) -> Draft:
    """Return the workbook of a layout."""
    system = system_of(layout) if system is None else system
    sheets = [Sheet(name) for name in layout.sheets[: 2 if layout.second == "sheet" else 1]]
    modules = list(range(len(system)))
    others = DIMENSIONS if layout.second else ()
    first = [name for name in layout.order if name not in others]
    names = [[*first, *layout.derived], [name for name in layout.order if name in others]]
    once = DIMENSIONS if layout.once else ()
    two_headings = layout.style.startswith("both")
    tables: list[Table] = []
    left, row = layout.left, layout.top + 1
    for own, kind in zip(names[: 1 + bool(layout.second)], layout.labels, strict=False):
        if tables and layout.second == "beside":
            left = 1 + max(map(column_index_from_string, tables[0].columns.values())) + layout.gap
        if tables and layout.second == "below":
            row = tables[0].rows[-1] + 2 + layout.gap
        numbered = kind != ""
        step = 1 + layout.gap
        columns = {name: get_column_letter(left + 1 + numbered + step * k) for k, name in enumerate(own)}
        columns |= {name: letters for name, letters in layout.columns if name in own}
        start = row + 1 + two_headings * (1 + layout.apart) + layout.under
        order = modules
        if tables:
            order = modules[:1] if layout.once == "row" else list(modules)
            if layout.shuffled and "" not in layout.labels:
                np.random.default_rng(layout.seed).shuffle(order)
        number = get_column_letter(left + 1) if numbered else ""
        tables.append(
            Table(sheets[-1 if tables else 0], columns, number, row, [start + k for k in range(len(order))], order)
        )
    book = Book(sheets[::-1] if layout.main_first else sheets)
    units = dict.fromkeys((*layout.order, *layout.derived), "mm") | layout.in_unit
    draft = Draft(layout, book, system, system, tables, once, units)
    for table, kind in zip(tables, layout.labels, strict=False):
        _head(draft, table)
        _fill(draft, table)
        for r, i in zip(table.rows, table.modules, strict=True) if table.number else ():
            table.sheet[f"{table.number}{r}"] = label(kind, int(system.numbers[i]))
    if layout.once == "merged":
        for name in DIMENSIONS:
            table = draft.table(name)
            if len(table.rows) > 1:
                table.sheet.merged.append(f"{table.columns[name]}{table.rows[0]}:{table.columns[name]}{table.rows[-1]}")
    kinds = layout.labels[: len(tables)]
    draft.numbered = kinds[0] in NUMBERS and layout.number not in ("pinhole", "serial")
    draft.plain = _is_plain(layout, kinds)
    draft.mappable = layout.formulas != "zeros" or "formulas" not in kinds
    # A table with numbers that do not rise beside one without: who knows whether they are in order?
    rising = list(system.numbers) == sorted(system.numbers)
    alike = len({kind if kind == "names" else kind in NUMBERS for kind in kinds}) == 1
    draft.clear = (rising or all(kinds) or not any(kinds)) and (alike or not layout.shuffled or not all(kinds))
    return draft


def _is_plain(layout: Layout, kinds: Sequence[str]) -> bool:
    """Return whether a layout must be understood."""
    usual = layout.style in ("symbols", "descriptions", "both") and layout.second in ("", "sheet") and layout.top < 10
    rows = not layout.once or (layout.once == "row" and "" in layout.labels and layout.second == "sheet")
    labels = set(kinds) <= set(NUMBERS) or set(kinds) == {""}
    labels = labels and layout.number in ("No.", "Definitions", "Module", "Nr.")
    return bool(
        usual
        and rows
        and labels
        and layout.unit in ("", "mm", "cm", "m", "in", "um")
        and layout.unit_form in PLAIN_FORMS
        and layout.unit_in == "all"
        and not layout.apart
        and not layout.under
    )


PLAIN_FORMS = ("{} ({})", "{} [{}]", "{}, {}", "{}/{}", "{} in {}")


def _head(draft: Draft, table: Table) -> None:
    """Write the headings of a table."""
    layout, sheet = draft.layout, table.sheet
    styles = [layout.style]
    if layout.style.startswith("both"):
        styles = ["descriptions", "symbols"] if layout.style.endswith("reversed") else ["symbols", "descriptions"]
    rows = [table.row, table.row + 1 + layout.apart][: len(styles)]
    for name, column in table.columns.items():
        unit = None if name in ANGLES else layout.in_unit.get(name)
        for row, style in zip(rows, styles, strict=True):
            text = HEADINGS[style].get(name, "" if len(rows) == 2 else SYMBOLS[name])
            if len(rows) == 2 and style == "symbols" and name in WITHOUT_SYMBOL:
                text = ""
            says = unit and (len(rows) == 1 or name not in TYPED or layout.unit_in in ("all", style.removesuffix("s")))
            sheet[f"{column}{row}"] = (layout.unit_form.format(text, unit) if says else text) if text else None
    if table.number:
        sheet[f"{table.number}{rows[-1]}"] = layout.number or None


def _fill(draft: Draft, table: Table) -> None:
    """Write the numbers and formulas of a table."""
    layout, system, sheet = draft.layout, draft.system, table.sheet
    same = len({draft.units[name] for name in draft.units if name not in ANGLES}) == 1
    calculated = layout.formulas in ("stored", "unstored", "zeros") and same
    for name, column in table.columns.items():
        values = quantity(system, name) / (1.0 if name in ANGLES else MILLIMETRES[draft.units[name]])
        for k, (row, i) in enumerate(zip(table.rows, table.modules, strict=True)):
            if k and name in draft.once:
                break
            value: Any = float(f"{values[i]:.15g}")
            if calculated and name in FORMULAS:
                text = FORMULAS[name].format_map({q: _reference(draft, table, q, i) for q in draft.units})
                value = Error("#DIV/0!") if not np.isfinite(value) else value
                value = Formula(text, {"unstored": None, "zeros": 0}.get(layout.formulas, value))
            sheet[f"{column}{row}"] = value


def _reference(draft: Draft, table: Table, name: str, i: int) -> str:
    """Return a reference to a module's cell in a formula of `table`."""
    sheet = draft.table(name).sheet
    quoted = sheet.name if sheet.name.isalnum() else "'" + sheet.name.replace("'", "''") + "'"
    return ("" if sheet is table.sheet else f"{quoted}!") + draft.at(name, i)


# The users' workbook: sheets Main and Coordinates, formulas with their values. A module's row is its number + 2.

USERS = Layout(
    second="sheet",
    main_first=True,
    style="both",
    number="Definitions",
    formulas="stored",
    columns=(
        *zip(("x1", "y1", "z1", "b", "slope", "l", "H", "x2", "y2", "z2"), "BCDEFGHIJK", strict=True),
        *zip(("range", "azimuth", "elevation", "d", "R", "Ld", "Td"), "UVWPQST", strict=True),
    ),
)
PLAIN = replace(USERS, formulas="unstored", columns=tuple(zip(DERIVED_AND_LENGTH, "EFGHIJKLMN", strict=True)))
"""The same as a library writes it: no stored values, and the columns of each sheet side by side."""
GEOMETRY = Layout(sheets=("Geometry", ""))
"""One sheet: A number, B x1, C y1, D z1, E d, F R, G Ld, H Td, I l; headings in row 1."""


def formulas_of(sheet: Sheet) -> dict[str, Formula]:
    """Return the formulas of a sheet by their cells."""
    return {at: value for at, value in sheet.cells.items() if isinstance(value, Formula)}


# Column maps


def column_map(*tables: dict[str, Any]) -> str:
    """Return the TOML of a column map."""
    return "\n".join(line for table in tables for line in _toml(table))


def _toml(table: dict[str, Any]) -> Iterator[str]:
    yield "[[tables]]"
    for key, value in table.items():
        if key != "columns":
            shown = value.replace("\\", "\\\\").replace('"', '\\"') if isinstance(value, str) else None
            yield f"{key} = {value!r}" if shown is None else f'{key} = "{shown}"'
    yield "[tables.columns]"
    for name, (column, unit) in table["columns"].items():
        yield f'{name} = {{ column = "{column}", unit = "{unit}" }}'
    yield ""


def map_of(draft: Draft) -> str | None:
    """Return the column map for what a person sees; None if a map cannot express it."""
    if not draft.mappable or "voxel" in (draft.units[name] for name in draft.layout.order):
        return None
    kinds = [kind if kind == "names" else kind in NUMBERS for kind in draft.layout.labels[: len(draft.tables)]]
    by_number = len(kinds) > 1 and kinds[0] == kinds[1] and bool(kinds[0])
    tables = []
    for k, table in enumerate(draft.tables):
        columns = {name: (c, draft.units[name]) for name, c in table.columns.items() if name in TYPED}
        each = {name: c for name, c in columns.items() if name not in draft.once}
        if each:
            rows = range(table.rows[0], table.rows[-1] + 1)
            entries: dict[str, Any] = {"sheet": table.sheet.name, "first_row": rows[0], "last_row": rows[-1]}
            if skipped := sorted(set(rows) - set(table.rows)):
                entries["skip_rows"] = skipped
            if by_number or (k == 0 and kinds[0]):
                entries["number"] = table.number
            if k and not by_number and table.modules != draft.tables[0].modules:
                return None
            if k:
                entries["rows"] = "by number" if by_number else "in order"
            tables.append({**entries, "columns": each})
        if single := {name: c for name, c in columns.items() if name in draft.once}:
            entries = {"sheet": table.sheet.name, "first_row": table.rows[0], "last_row": table.rows[0]}
            tables.append({**entries, "rows": "one for all", "columns": single})
    return column_map(*tables)
