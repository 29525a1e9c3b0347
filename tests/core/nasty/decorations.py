"""What people and programs add to a workbook: each changes a draft, and what a person reads in it."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Iterable
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
from openpyxl.utils import column_index_from_string, get_column_letter

from .layouts import DESCRIPTIONS, MILLIMETRES, POSITION, SYMBOLS, TYPED, Draft, Table, formulas_of
from .sheets import Error, Formula, Raw, Rich, Sheet, split


class Element(NamedTuple):
    """A decoration with its arguments, what a layout must be like for it, and what other decorations must not touch."""

    decorate: Callable[..., None]
    arguments: tuple[Any, ...]
    needs: tuple[tuple[str, Any], ...]


ELEMENTS: list[Element] = []


def add(decorate: Callable[..., None], *arguments: Any, **needs: Any) -> None:
    """Add an element."""
    ELEMENTS.append(Element(decorate, arguments, tuple(needs.items())))


USUAL = {"headings": "own", "style": "symbols"}
IN_MM = {"order": TYPED, "unit": "", "units_of": "all"}
TWO_SHEETS = {"second": "sheet", "once": "", "shuffled": False}
CALCULATED = {**IN_MM, **TWO_SHEETS, "formulas": "stored"}
NUMBERED = {"modules": 4, "labels": ("numbers", "numbers"), "number": "No."}
AT_THE_CORNER = {"modules": 4, "style": "symbols", **dict.fromkeys(("top", "left", "gap", "under"), 0)}
AT_THE_CORNER |= dict.fromkeys(("formulas", "second", "once"), "")
USERS_SHEETS = {"sheets": ("Coordinates", "Main")}
"""What layouts must be like for several decorations."""

SAME, NOBODY, BROKEN, UNMAPPED = "same", "nobody", "broken", "unmapped"
"""What a decoration makes of the numbers, if not a unit: nothing, something that nobody can tell, no numbers, or what a
person reads and no column map."""


def mean(draft: Draft, meaning: str, names: Iterable[str] = (), *places: str) -> None:
    """Store the numbers of the columns `names` as a decoration says that they are."""
    draft.plain = False
    draft.places += places
    names = [name for name in names if name in draft.units and name not in ("slope", "azimuth", "elevation")]
    if meaning == BROKEN:
        draft.truth = None
    elif meaning == UNMAPPED:
        draft.mappable = False
    elif meaning == NOBODY:
        draft.clear = False
    elif meaning != SAME:
        again = meaning in draft.said
        draft.said.add(meaning)
        if len(draft.said) > 1 or any(draft.layout.in_unit.get(name, meaning) != meaning for name in names):
            draft.clear = False  # it contradicts the headings, or another decoration
        elif not again:
            _convert(draft, [name for name in names if name not in draft.layout.in_unit], meaning)


def _convert(draft: Draft, names: list[str], unit: str) -> None:
    """Store the numbers of columns in a unit, if all are typed."""
    cells = [(name, draft.table(name).sheet, at) for name in names for at in draft.cells(name)]
    if any(formulas_of(sheet) for sheet in draft.book.sheets) or any(type(sheet[at]) is Raw for _, sheet, at in cells):
        draft.clear = draft.clear and not cells  # numbers of which the text is not true
        return
    draft.units |= dict.fromkeys(names, unit)
    for _, sheet, at in cells:
        if isinstance(sheet[at], float):
            sheet[at] = float(f"{sheet[at] / MILLIMETRES[unit]:.15g}")


# Texts

WORDS = {
    "cm": "cm|in cm|all lengths in cm|Units: cm|[cm]|1 unit = 10 mm|cm!",
    "in": 'inches|Maße in Zoll|Unit = inch|(")',
    "m": "m|all in metres",
    "dm": "dm",
    "0.1 mm": "tenths of a mm|0.1 mm",
    "ft": "feet",
    NOBODY: "Unit: Elle|scale 1:10",
    "near": "half values|mirrored: swap the sign of x|values x 10|old|× 0.1|nominal",
    SAME: "mm|lengths in mm|DC-SPECT, 80 modules|2021-03-04|R: ROI|measured in 2021 by CMM|OBSOLETE",
}
ANYWHERE = (
    "beside the headings|beside the modules|a column|heading of the numbers|below|far below|name of the sheet|"
    "note of a heading|note of a number|another sheet"
)
"""Places that every layout has."""
WHERE = {
    "title": {"top": 2},
    "pair": {"top": 2},
    "band": {"top": 2},
    "band over x1 to z1": {"top": 1},
    "over a heading": {"top": 1},
    "under a heading": {"under": 1},
    "over every heading": {"top": 1},
    "far over every heading": {"top": 2, "second": "sheet"},
    "under every heading": {"under": 1},
    "between headings": {"apart": 1, "style": "both"},
    **{where: {} for where in ANYWHERE.split("|")},
}


def text(draft: Draft, where: str, words: str, meaning: str) -> None:
    """Add a text apart from the headings."""
    table, name = draft.tables[0], next(iter(draft.tables[0].columns))
    sheet, column = table.sheet, table.columns[name]
    left, free = get_column_letter(draft.layout.left + 1), draft.free()
    here = [n for t in draft.tables if t.sheet is sheet for n in t.columns]
    every = [(t, c) for t in draft.tables for c in t.columns.values()]
    if where in ("over a heading", "under a heading", "note of a heading", "beside the modules", "note of a number"):
        # It speaks of one column or module, or of all: who knows?
        meaning = meaning if meaning in (SAME, draft.layout.in_unit.get(name)) else NOBODY
    if where == "name of the sheet":
        sheet.name += f" ({words})" if re.search(r"[\\/*?:\[\]\"]", words) is None else " (cm)"
        return mean(draft, meaning, here, sheet.name)
    if where == "another sheet":
        sheet = Sheet("Read me", {"B2": words})
        draft.book.sheets.append(sheet)
        about_all = re.search("all|lengths", words) and meaning != SAME
        return mean(draft, NOBODY if about_all else SAME, (), "Read me!B2", *(s.name for s in draft.book.sheets))
    if where == "beside the modules" and re.search(r"\d|tenths|mirr|Elle", words):
        meaning = SAME  # a note of one module
    if where == "note of a number":
        sheet.notes[draft.cells(name)[-1]] = words
        draft.plain = False  # "moved by 2 cm in 2021" says nothing of the number
        return None
    if where.endswith("every heading"):
        row = {"over": -1, "far": -2, "under": 0}[where.split()[0]]
        for t, c in every:
            t.sheet[f"{c}{t.rows[0] - 1 if row == 0 else t.row + row}"] = words
        return mean(draft, meaning, TYPED, sheet.name)
    at = {
        "title": f"{left}{max(1, table.row - 2)}",
        "pair": f"{left}{max(1, table.row - 2)}",
        "band": f"{column}{table.row - 1}",
        "band over x1 to z1": f"{table.columns['x1']}{table.row - 1}",
        "over a heading": f"{column}{table.row - 1}",
        "under a heading": f"{column}{table.rows[0] - 1}",
        "between headings": f"{column}{table.row + 1}",
        "beside the headings": f"{free}{table.row}",
        "beside the modules": f"{free}{table.rows[-1]}",
        "a column": f"{free}{table.row}",
        "heading of the numbers": f"{left}{table.rows[0] - 1}",
        "below": f"{left}{draft.bottom + 2}",
        "far below": f"{column}{draft.bottom + 7}",
        "note of a heading": draft.heading(name, last=False),
    }[where]
    if where == "heading of the numbers":
        draft.numbered = False
        if not table.number or re.search("=|Elle", words):  # a heading of other numbers
            return None
    if where == "note of a heading":
        sheet.notes[at] = words
    elif where == "pair" and ": " in words:
        sheet[at], sheet[f"{column}{split(at)[1]}"] = words.split(" ", 1)
    elif where == "a column":
        for row in (table.row, *table.rows):
            sheet[f"{free}{row}"] = "unit" if row == table.row else words
    else:
        sheet[at] = words
    if where.startswith("band"):
        names = POSITION if "x1" in where else here
        last = max((table.columns[n] for n in names if n in table.columns), key=lambda c: (len(c), c))
        if (end := f"{last}{table.row - 1}") != at:
            sheet.merged.append(f"{at}:{end}")
        here = list(names)
    elif where == "between headings":
        here = [name]
        meaning = meaning if meaning in (SAME, draft.layout.in_unit.get(name)) else NOBODY
    return mean(draft, meaning, here, f"{sheet.name}!", *(t.sheet.name for t in draft.tables if "numbers" in where))


for _i, (_where, _needs) in enumerate(WHERE.items()):
    _near = re.search("^(band|over|under|between)", _where)
    _pairs = [
        (words, meaning) for meaning, texts in WORDS.items() for words in texts.split("|") if _near or meaning != "near"
    ]
    for _words, _meaning in _pairs[_i % 4 :: 4]:
        if _where == "a column" and " in " in _words:
            continue  # a sentence in each row is no unit of a column
        add(text, _where, _words, NOBODY if _meaning == "near" else _meaning, **_needs)


# Number formats

MIXED_FORMATS = ('0.00" mm";-0.00" cm"', '0.00" mm (cm)"', '0.00;-0.00" cm"')
FORMATS = {
    "plain": ("0.00", "0.000E+00", "[$-409]0.0", "0.0_m", "[Red]0.0;[Blue]-0.0", "@", "#,##0.00", 4),
    "plain too": ('_(* #,##0.00_);_(* \\(#,##0.00\\);_(* "-"??_);_(@_)',),
    SAME: ('0.0" mm"', "0.0\\ \\m\\m"),
    "cm": ('0.00" cm"', "0.0\\ \\c\\m", '0.00" cm";-0.00" cm"', '[>100]0.0" cm";0.000" cm"', "[$cm] 0.00"),
    "in": ('0.0"″"', '0.0##\\"', '0.0" Zoll"'),
    NOBODY: ("0.0,", '"-"0.0', '0.00" k"', "0.00%", "0‰", 10, *MIXED_FORMATS),
    BROKEN: ("yyyy-mm-dd", "mm:ss", 14, 45),
}


def number_format(draft: Draft, code: str | int, meaning: str, scope: str) -> None:
    """Set the number format of all columns, of one, or of one cell."""
    plain = draft.plain
    names = draft.layout.order if scope == "all" else draft.layout.order[:1]
    for name in names:
        for at in draft.cells(name)[-1 if scope == "a cell" else None :]:
            draft.table(name).sheet.formats[at] = code
    if meaning.startswith("plain"):
        draft.plain = plain
        return
    says = {draft.layout.in_unit.get(name, "mm") for name in names}
    if says == {meaning}:
        meaning = SAME
    elif (scope == "a cell" and meaning not in (SAME, BROKEN)) or (meaning == SAME and says != {"mm"}):
        meaning = NOBODY
    tables = [(name, draft.table(name)) for name in names]
    mean(draft, meaning, names, *(f"{table.sheet.name}!{table.columns[name]}" for name, table in tables))


add(number_format, '0.00" cm"', "cm", "all", unit="cm", units_of="all")
for _meaning, _codes in FORMATS.items():
    for _code, _scope in zip(_codes, cycle(("all", "a column", "a cell")), strict=False):
        add(number_format, _code, _meaning, _scope)
        if _meaning in ("cm", NOBODY):
            add(number_format, _code, _meaning, "a column" if _scope == "all" else "all")


# Headings

FORMS = {
    "cm": "{} (cms)|cm {}|{} (\N{SQUARE CM})|{}\N{ZERO WIDTH SPACE}(cm)|{} (c\N{SOFT HYPHEN}m)|{} (厘米)",
    "cm too": "{} (cm) nominal|{} (10 mm)|{} ×10 (mm)|{} (mm) in cm|{} cm|{} (cm), cm",
    "in": '{} (")|{} (Zoll)',
    SAME: "{}_mm|{}, mm|{} (mm, not cm)| {} |{}:|'{}'|{} ¹⁾|{}\N{ZERO WIDTH SPACE}",
    "dm": "{} (dm)",
    "0.1 mm": "{} (0,1 mm)|{} (mm × 0.1)",
    "mil": "{} (mils)",
    "ft": "{} (')",
    "voxel": "{} (voxels)|{} (%)|{} (cm²)|{} (?)",
    NOBODY: "{} (old)|tolerance of {}|half {}|{} nominal|{}²|{} (cm, CAD)|{} × 10|Δ{}|{}/2",
    "nobody too": "{}, mm or cm|{} of window|-{}|{} (±)|{}/b|{}, mirrored|{}0|{} (max)|{}*",
}
OTHER_QUANTITIES = {
    "d": "radius of pinhole|outer diameter of pinhole insert|half diameter of pinhole|D",
    "R": "r|range|ROI diameter|radius of detector ring",
    "Ld": "area of detector crystal|length of detector crystal diagonal",
    "Td": "thickness of pinhole plate|tolerance of thickness of detector crystal|thickness of detector window",
    "x1": "x10|x coordinate value at center of detector|y1|y coordinate value at center of hole|corrected",
    "l": "length of collimator + detector|l (max)|effective length|length of side of detector crystal",
}
"""Headings of other quantities, or of nothing, in the place of a column's own heading."""
SPELLINGS: dict[str, Callable[[str, str], Any]] = {
    "a typing error": lambda text, at: text.replace("ng", "gn").replace("th", "ht"),
    "in capitals, spelt otherwise": lambda text, at: text.replace("center", "centre").upper(),
    "several lines": lambda text, at: text.replace(" ", "\n", 1),
    "blanks around": lambda text, at: f"  {text}\N{NO-BREAK SPACE} ",
    "a subscript": lambda text, at: text.replace("1", "₁"),
    "underscores": lambda text, at: f"{text[:1]}_{text[1:]}",
    "full-width letters": lambda text, at: "".join(chr(ord(c) + 0xFEE0) if c.isalnum() else c for c in text),
    "a Cyrillic x": lambda text, at: text.replace("x", "х"),
    "a letter l for the digit 1": lambda text, at: text.replace("1", "l"),
    "fonts": lambda text, at: Rich(f"<r><t>{text[:1]}</t></r><r><rPr><b/></rPr><t>{text[1:]}</t></r>"),
    "a letter struck out": lambda text, at: Rich(f"<r><rPr><strike/></rPr><t>y</t></r><r><t>{text}</t></r>"),
    "a reading of Japanese": lambda text, at: Rich(f'<t>{text}</t><rPh sb="0" eb="2"><t>エックス</t></rPh>'),
    "text in the cell, of fonts": lambda text, at: Raw(
        _inline(at, f"<r><t>{text[:1]}</t></r><r><t>{text[1:]}</t></r>")
    ),
    "CDATA": lambda text, at: Raw(_inline(at, f"<t><![CDATA[{text}]]></t>")),
    "Excel's escape": lambda text, at: Raw(_inline(at, f"<t>{text[:-1]}_x{ord(text[-1]):04x}_</t>")),
    "a formula": lambda text, at: Formula(f'"{text[:1]}"&"{text[1:]}"', text),
    "a formula without a value": lambda text, at: Formula(f'"{text[:1]}"&"{text[1:]}"'),
    "a stale formula": lambda text, at: Formula(f'"{text[:1]}"&"{text[1:]}, half"', text),
    "stored twice": lambda text, at: Raw(_inline(at, f"<t>{text}</t>") + _inline(at, "<t>y1</t>")),
    "without its unit": lambda text, at: text.split(" (")[0],
    "a unit of two fonts": lambda text, at: Rich(f"<r><t>{text}</t></r><r><t> (cm)</t></r>"),
}


PLAIN_SPELLINGS = [form for form in SPELLINGS if form in ("several lines", "blanks around", "fonts", "CDATA")]
PLAIN_SPELLINGS += ["a reading of Japanese", "text in the cell, of fonts", "a formula", "a subscript"]
PLAIN_SPELLINGS += ["full-width letters", "in capitals, spelt otherwise", "a formula without a value"]
"""Spellings of a heading that the reader must understand, not only refuse."""


def _inline(at: str, xml: str) -> str:
    """Return the XML of a cell with its text in it."""
    return f'<c r="{at}" t="inlineStr"><is>{xml}</is></c>'


def heading(draft: Draft, name: str, form: str, meaning: str, every: bool = False) -> None:
    """Give a column, or all, another heading: a form with its own text, or one of `SPELLINGS`."""
    names, plain = draft.layout.order if every else [name], draft.plain
    for q in names:
        sheet, at = draft.table(q).sheet, draft.heading(q)
        own = str(sheet[at])
        sheet[at] = SPELLINGS[form](own, at) if form in SPELLINGS else form.format(own)
    places = [f"{draft.table(q).sheet.name}!{draft.table(q).columns[q]}" for q in names]
    if meaning not in (SAME, NOBODY, UNMAPPED) and any(q in draft.layout.in_unit for q in names):
        meaning = NOBODY
    mean(draft, meaning, names, *places, draft.table(name).sheet.name)
    draft.plain = plain and form in PLAIN_SPELLINGS


def no_heading(draft: Draft, name: str, form: str) -> None:
    """Remove a heading, or merge it with others."""
    table = draft.table(name)
    column, after = table.columns[name], table.columns[TYPED[TYPED.index(name) + 1]]
    if form == "merged across":
        table.sheet.merged.append(f"{column}{table.row}:{after}{table.row}")
        table.sheet[f"{after}{table.row}"] = None
    elif form == "merged down":
        table.sheet.merged.append(f"{column}{table.row}:{column}{table.row + 1}")
    elif form == "merged over its own":
        table.sheet.merged.append(f"{column}{table.row}:{after}{table.row}")
    for row in range(table.row, table.rows[0]) if form == "none" else ():
        table.sheet[f"{column}{row}"] = None
    mean(draft, SAME if form == "merged down" else NOBODY, (), table.sheet.name)


def groups(draft: Draft, own: str, other: str, names: str, meaning: str) -> None:
    """Put x y z under a word, and other numbers headed alike under another word."""
    table = draft.tables[0]
    first, free = table.columns["x1"], draft.free()
    table.sheet[f"{first}{table.row - 1}"], table.sheet[f"{free}{table.row - 1}"] = own, other
    table.sheet.merged += [f"{first}{table.row - 1}:{table.columns['z1']}{table.row - 1}"]
    for k, (name, head) in enumerate(zip(POSITION, names.split(), strict=True)):
        table.sheet[draft.heading(name)] = head
        _copied(draft, name, get_column_letter(column_index_from_string(free) + k), head, 1.3)
    mean(draft, meaning, (), table.sheet.name)


for _meaning, _forms in FORMS.items():
    for _form, _name in zip(_forms.split("|"), cycle(("x1", "d", "l")), strict=False):
        add(heading, _name, _form, _meaning.removesuffix(" too"), order=TYPED, headings="others")
        if not _meaning.startswith(NOBODY):
            add(heading, "x1", _form, _meaning.removesuffix(" too"), True, headings="others")
for _name, _texts in OTHER_QUANTITIES.items():
    for _i, _text in enumerate(_texts.split("|")):
        add(heading, _name, _text, NOBODY, order=TYPED, style=("symbols", "both")[_i % 2], headings="others")
for _i, _form in enumerate(form for form in SPELLINGS if form != "without its unit"):
    _meaning = {"a stale formula": NOBODY, "a unit of two fonts": "cm", "stored twice": UNMAPPED}.get(_form, SAME)
    _style = "descriptions" if _i < 5 else "symbols"
    _column = ("x1", "z1")[_i % 2] if _i > 2 else "l"
    add(heading, _column, _form, _meaning, order=TYPED, style=_style, formulas="", headings="others")
add(heading, "x1", "see drawing 12", NOBODY, style="both", headings="others")
_needs = {"unit": "cm", "units_of": "all", "unit_form": "{} ({})", "style": "symbols", "headings": "others"}
add(heading, "x1", "without its unit", NOBODY, **_needs)
for _form in ("{} (cm)", "{}, in cm!"):
    add(heading, "x1", _form, "cm", style="both", unit="mm", unit_in="symbol", units_of="all", headings="others")
for _form in ("none", "merged across", "merged down", "merged over its own"):
    add(no_heading, "x1", _form, under=1, order=TYPED)
add(groups, "pinhole", "crystal", "x y z", SAME, top=1, order=TYPED, gap=0)
add(groups, "hole centre", "detector end", "x y z", SAME, top=1, order=TYPED, gap=0)
add(groups, "nominal", "measured", "x1 y1 z1", NOBODY, top=1, order=TYPED, gap=0)


# Further columns


def _copied(draft: Draft, name: str, column: str, head: Any, factor: float) -> None:
    """Write the numbers of a column, times `factor`, into another one."""
    table = draft.table(name)
    table.sheet[f"{column}{split(draft.heading(name))[1]}"] = head
    for at in draft.cells(name):
        if isinstance(table.sheet[at], float):
            table.sheet[f"{column}{split(at)[1]}"] = table.sheet[at] * factor


def further_column(draft: Draft, name: str, head: str, meaning: str, own: str = "{}", hidden: str = "") -> None:
    """Add a column with numbers like those of the column `name`, whose heading becomes `own`."""
    plain, table, column = draft.plain, draft.table(name), draft.free()
    if table.sheet is not draft.tables[0].sheet:
        return
    if own != "{}":
        at = draft.heading(name)
        table.sheet[at] = own.format(table.sheet[at])
    _copied(draft, name, column, head.format(SYMBOLS[name], DESCRIPTIONS[name]), 1.01)
    table.sheet.hidden_columns += {"": [], "first": [table.columns[name]], "second": [column]}[hidden]
    mean(draft, meaning, (), f"{table.sheet.name}!{column}", f"{table.sheet.name}!{table.columns[name]}")
    draft.plain = plain and meaning == SAME and not hidden and "l" in draft.layout.order and head in HARMLESS


HARMLESS = ("serial", "S", "3D slope", "weight (kg)", "note", "sensitivity (cps/MBq)", "S2")
BESIDE = "side of the patient|x1 error|half diameter of pinhole|material of collimator|z1 limit (cm)|D|B|x2|ring"
SECOND = ("{0}", "{0} new", "{0} (measured)", "{1}", "{1} (cm)", "{0}_corr", "{0} [mm]", "{1} (surveyed)", "{0}*")
for _head in HARMLESS:
    add(further_column, "y1", _head, SAME)
for _head in (*BESIDE.split("|"), "principal ray z axis", "width of the gap, cm", "azimuth of the cable"):
    add(further_column, "d", _head, SAME, second="")
for _head, _name in zip(SECOND, cycle(("x1", "l", "d", "R")), strict=False):
    add(further_column, _name, _head, NOBODY, second="", formulas="", order=TYPED)
add(further_column, "x1", "{0} new", NOBODY, "{} old")
add(further_column, "x1", "{0} (cm)", NOBODY, "{} (mm)")
add(further_column, "z1", "{0} (CMM)", NOBODY, "{} (CAD)")
add(further_column, "R", "ROI radius", NOBODY, second="")
for _hidden in ("first", "second"):
    add(further_column, "x1", "{0}", NOBODY, "{}", _hidden)
add(further_column, "y1", "serial", SAME, "{}", "second")


def second_place(draft: Draft, by_formula: bool) -> None:
    """Write d beside the coordinates too: other numbers, or the same by formula."""
    table, other, column = draft.tables[0], draft.table("d"), draft.free()
    table.sheet[f"{column}{table.row}"] = "d"
    for row, at in zip(table.rows, draft.cells("d"), strict=True):
        value = other.sheet[at]
        table.sheet[f"{column}{row}"] = Formula(f"{other.sheet.name}!{at}", value) if by_formula else value * 1.5
    mean(draft, SAME if by_formula else NOBODY, (), table.sheet.name, other.sheet.name)


for _by_formula in (False, True):
    add(second_place, _by_formula, **TWO_SHEETS, **USERS_SHEETS, unit="", headings="own")


# Rows

NEXT, AGAIN = "further numbers", "the same numbers"
SUM = "SUM({0}:{1})"
ROWS: dict[str, list[tuple[Any, Any]]] = {
    "an old design": [("OLD DESIGN, do not use", None), (NEXT, 1.02), (NEXT, 1.03)],
    "headings again": [("No.", "headings"), (NEXT, 1.02), (NEXT, 1.03)],
    "headings and rows": [("Version 2", None), ("No.", "headings"), (AGAIN, 1.02)],
    "a text over x1": [(None, {"x1": "prototype"}), (NEXT, 1.02)],
    "the same numbers": [(AGAIN, 1.02), (AGAIN, 1.03)],
    "without numbers": [(None, 1.02), (None, 1.03)],
    "the isocentre": [("isocentre", {"x1": 3.0, "y1": -2.0, "z1": 10.0})],
    "typed means": [(None, 1.01)],
    "the mean": [("mean", "AVERAGE({0}:{1})")],
    "σ": [("σ", "STDEV({0}:{1})")],
    "a subtotal": [(None, "SUBTOTAL(101,{0}:{1})")],
    "a sum of each": [(None, "({0}+{1})/2")],
    "a sum numbered": [("5", SUM)],
    "a sum and a row": [("Sum", SUM), (98, {"x1": 777.0, "y1": 777.0, "z1": 777.0})],
    "tolerances": [("tolerance", {"x1": 0.1, "d": 0.02, "Td": 0.1})],
    "units": [("unit", dict.fromkeys(TYPED, "mm"))],
    "a count": [(4, None)],
    "a count of x1": [(None, {"x1": 4.0})],
    "a note": [("Note: measured in 2021", None)],
    "a note under x1": [(None, {"x1": "as of 2021-03-04"})],
    "zeros": [(NEXT, 0.0)],
    "numbers alone": [(NEXT, None), (NEXT, None)],
    "a value": [("d", {"x1": 5.0})],
    "a legend": [("symbol", {"x1": "meaning"}), ("x1", {"x1": DESCRIPTIONS["x1"]}), ("d", {"x1": DESCRIPTIONS["d"]})],
    "counts of the columns": [(0, dict(zip(TYPED, map(float, range(1, 9)), strict=True)))],
    "an example": [("example:", 1.02)],
    "offsets": [("offset", {"x1": 3.0, "y1": -2.0, "z1": 10.0})],
}


def _written(draft: Draft, table: Table, row: int, mark: Any, fill: Any, k: int, right: int = 0) -> str:
    """Write a row of `ROWS`, as far as it is about the columns of a table; return its first cell."""
    numbers = sorted(map(int, draft.system.numbers))
    value = {NEXT: 1000 + k, AGAIN: numbers[k % len(numbers)]}.get(mark, mark)
    left = get_column_letter((split(f"{table.number}1")[0] if table.number else max(1, draft.layout.left)) + right)
    table.sheet[f"{left}{row}"] = value
    for name, column in table.columns.items():
        column = get_column_letter(split(f"{column}1")[0] + right)
        own = table.sheet[draft.at(name, table.modules[0])]
        if name not in TYPED or not isinstance(own, float):
            continue
        if fill == "headings":
            table.sheet[f"{column}{row}"] = SYMBOLS[name]
        elif isinstance(fill, str):
            area = (f"{table.columns[name]}{table.rows[0]}", f"{table.columns[name]}{table.rows[-1]}")
            table.sheet[f"{column}{row}"] = Formula(fill.format(*area))
        elif isinstance(fill, dict):
            table.sheet[f"{column}{row}"] = fill.get(name)
        elif fill is not None:
            table.sheet[f"{column}{row}"] = own * fill
    return f"{table.sheet.name}!"


def rows(draft: Draft, kind: str, where: str, gap: int) -> None:
    """Rows of numbers apart from the modules: nobody takes them for modules."""
    table = draft.tables[0]
    right, row = 0, table.rows[-1] + 1 + gap
    if where in ("above", "under"):
        row = 1 if where == "above" else table.rows[0] - 1
    elif where == "beside":
        right, row = column_index_from_string(draft.free(3)), table.row + gap
    places = [_written(draft, table, row + k, *entry, k, right) for k, entry in enumerate(ROWS[kind])]
    meaning = NOBODY if kind in ("without numbers", "typed means") else SAME  # rows like those of modules may be some
    mean(draft, meaning, (), *places, *(t.sheet.name for t in draft.tables))


for _i, _kind in enumerate(ROWS):
    for _gap in (_i % 2, 2):
        add(rows, _kind, "below", _gap, second=("", "sheet")[_i % 2], once="", headings="own", style="symbols")
add(rows, "counts of the columns", "under", 0, under=1, headings="own")
for _kind in ("headings and rows", "an example", "offsets", "a note", "units", "a value"):
    add(rows, _kind, "above", 0, top=6, headings="own", style="symbols")
for _kind in ("headings again", "headings and rows", "a legend"):
    add(rows, _kind, "beside", 0, headings="own", style="symbols")


def between(draft: Draft, mark: Any, fill: Any, meaning: str) -> None:
    """Add a row between those of the modules, in the first sheet."""
    table = draft.tables[0]
    row = table.rows[len(table.rows) // 2]
    table.sheet.moved(down=1, below=row - 1)
    for other in draft.tables:
        if other.sheet is table.sheet:
            other.rows = [r + (r >= row) for r in other.rows]
    place = _written(draft, table, row, mark, fill, 0)
    mean(draft, meaning, (), place, *(s.name for s in draft.book.sheets))


for _mark, _fill, _meaning in (
    *((None, None, SAME), ("ring 2", None, SAME), ("No.", "headings", SAME), (None, {"x1": "y1", "y1": "x1"}, NOBODY)),
    *(("removed:", None, NOBODY), ("mean", "AVERAGE({0}:{1})", NOBODY)),
):
    for _label, _second in (("numbers", ""), ("", "sheet")):
        _needs = {**USUAL, **TWO_SHEETS, "second": _second, "labels": (_label, _label)}
        add(between, _mark, _fill, _meaning, **_needs, modules=4, formulas="")


def filled_down(draft: Draft) -> None:
    """Formulas that go on below the modules."""
    table = draft.tables[0]
    column = table.columns["b"]
    for row in range(table.rows[-1] + 1, table.rows[-1] + 5):
        refers = ",".join(f"{table.columns[name]}{row}" for name in POSITION)
        table.sheet[f"{column}{row}"] = Formula(f"SQRT(SUMSQ({refers}))", 0)


add(filled_down, formulas="stored", unit="", units_of="all")


def extra_dimensions(draft: Draft, kind: str) -> None:
    """Add or remove a row in one of the two sheets."""
    table, sheet = draft.tables[1], draft.tables[1].sheet
    if kind == "fewer":
        for column in filter(None, (*table.columns.values(), table.number)):
            sheet[f"{column}{table.rows[-1]}"] = None
        return mean(draft, BROKEN, (), *(t.sheet.name for t in draft.tables))
    row = table.rows[-1] + 1
    for name, column in table.columns.items():
        sheet[f"{column}{row}"] = sheet[draft.at(name, 0)]
    if kind == "numbered" and table.number:
        sheet[f"{table.number}{row}"] = 999
    return mean(draft, NOBODY, (), *(t.sheet.name for t in draft.tables))


for _kind in ("numbered", "unnumbered", "fewer"):
    add(extra_dimensions, _kind, second="sheet", once="", formulas="", modules=4, numbers="rows")
add(extra_dimensions, "fewer", **TWO_SHEETS, numbers="rows", formulas="", modules=4, labels=("", ""))


# Labels


def labels(draft: Draft, kind: str) -> None:
    """Labels of the modules that do not fit together."""
    table, other = draft.tables[0], draft.tables[-1]
    if kind == "a ring":
        _labelled(table, draft.free(), "ring", [1 + k // 2 for k in range(len(table.rows))])
        return mean(draft, SAME, (), table.sheet.name)
    if kind.startswith("a second column"):
        numbers = [table.sheet[f"{table.number}{row}"] for row in table.rows]
        _labelled(table, draft.free(), "module number", numbers[::-1])
        return mean(draft, NOBODY, (), *(s.name for s in draft.book.sheets))
    if kind.startswith("serials"):
        for own in draft.tables:
            names = [f"W-{7 * i % 5}{i}" for i in own.modules]
            names = names[::-1] if own is other and kind.endswith("at odds") else names
            _labelled(own, get_column_letter(40), "serial", names)
        return mean(draft, NOBODY if kind.endswith("at odds") else SAME, (), *(t.sheet.name for t in draft.tables))
    sheet, last = other.sheet, f"{other.number}{other.rows[-1]}"
    if kind == "others":
        for k, row in enumerate(other.rows):
            sheet[f"{other.number}{row}"] = 5000 + k
    else:
        sheet[last] = {
            "twice": sheet[f"{other.number}{other.rows[0]}"],
            "missing": None,
            "spare": "spare",
            "stale": Formula("7777*1", sheet[last]),
        }[kind]
    return mean(draft, BROKEN, (), *(s.name for s in draft.book.sheets))


def _labelled(table: Table, column: str, head: str, values: list[Any]) -> None:
    table.sheet[f"{column}{table.rows[0] - 1}"] = head
    for row, value in zip(table.rows, values, strict=True):
        table.sheet[f"{column}{row}"] = value


LAST_LABEL = ("twice", "missing", "spare", "stale")
for _kind in LAST_LABEL:
    add(labels, _kind, **NUMBERED, second="", once="")
for _kind in (*LAST_LABEL, "others", "a ring", "a second column", "serials", "serials at odds"):
    add(labels, _kind, **NUMBERED, second="sheet", once="")
add(labels, "serials at odds", second="sheet", modules=4, once="", labels=("", ""))


# Cells

TEXTS = '12,5|1.{:.0f},0|1 {:.0f}|{:g} mm|{:g} ± 0.1|({:g})|3l5|n/a|NaN|"|TRUE|?|see above|1e3x| |=B2'
CELLS: dict[str, tuple[Callable[[float, str], Any], str]] = {
    "as text": (lambda v, at: f"{v:.15g}", UNMAPPED),
    "as text with an exponent": (lambda v, at: f" {v:.15e} ", UNMAPPED),
    "as text, a blank behind": (lambda v, at: f"{v:.15g}\N{NO-BREAK SPACE}", UNMAPPED),
    "full-width digits": (lambda v, at: "".join(chr(ord(c) + 0xFEE0) for c in f"{v:.15g}"), UNMAPPED),
    "17 digits": (lambda v, at: Raw(f'<c r="{at}" t="n"><v>{v:.16E}</v></c>'), SAME),
    "metadata": (lambda v, at: Raw(f'<c r="{at}" cm="1" vm="1"><v>{v:+.15g}</v></c>'), SAME),
    "an extension": (lambda v, at: Raw(f'<c r="{at}"><v>{v!r}</v><extLst><ext uri="x"/></extLst></c>'), SAME),
    "a style that is none": (lambda v, at: Raw(f'<c r="{at}" s="99"><v> {v!r} </v></c>'), SAME),
    "CDATA in the value": (lambda v, at: Raw(f'<c r="{at}"><v><![CDATA[{v!r}]]></v></c>'), SAME),
    "a comment in the value": (lambda v, at: Raw(f'<c r="{at}"><v>{repr(v)[:2]}<!-- x -->{repr(v)[2:]}</v></c>'), SAME),
    "stored twice alike": (lambda v, at: Raw(f'<c r="{at}"><v>{v!r}</v></c>' * 2), UNMAPPED),
    **{f"text {text!r}": (lambda v, at, text=text: text.format(v), BROKEN) for text in TEXTS.split("|")},
    **{
        f"value {value!r}": (lambda v, at, value=value: value, BROKEN)
        for value in (True, None, Error("#N/A"), 1e300, -1.0, 0.0)
    },
    **{
        xml: (lambda v, at, xml=xml: Raw(xml.format(at)), BROKEN)
        for xml in (
            *('<c r="{0}" t="d"><v>2021-12-05</v></c>', '<c r="{0}"/>', '<c r="{0}"><v></v></c>'),
            *('<c r="{0}" t="inlineStr"><is><t/></is></c>', '<c r="{0}"><v>1e999</v></c>', '<c r="{0}"><v>NaN</v></c>'),
            *('<c r="{0}"><v>15mm</v></c>', '<c r="{0}" t="s"><v>9999</v></c>', '<c r="{0}" t="zz"><v>15</v></c>'),
            *('<c r="{0}"><v>15</v></c><c r="{0}"><v>12</v></c>', '<c r="{0}"><v>15</v><v>12</v></c>'),
            '<c r="XX3000"><v>15</v></c>',
        )
    },
}


def cell(draft: Draft, kind: str) -> None:
    """Something else instead of a number, or a number stored otherwise."""
    name = draft.layout.order[-2]
    sheet, at = draft.table(name).sheet, draft.cells(name)[0]
    make, meaning = CELLS[kind]
    if isinstance(sheet[at], float):
        sheet[at] = make(sheet[at], at)
        mean(draft, meaning, (), f"{sheet.name}!{at}", f"{sheet.name}!XX3000", sheet.name if "<v>15" in kind else at)


for _kind in CELLS:
    add(cell, _kind, numbers="a cell")


def merged_modules(draft: Draft, name: str, down: bool) -> None:
    """Numbers hidden under a merged cell."""
    table = draft.table(name)
    column, after = table.columns[name], table.columns[TYPED[TYPED.index(name) + 1]]
    last = f"{column}{table.rows[-1]}" if down else f"{after}{table.rows[0]}"
    table.sheet.merged.append(f"{column}{table.rows[0]}:{last}")
    mean(draft, NOBODY, (), f"{table.sheet.name}!{column}", f"{table.sheet.name}!{after}")


for _down in (False, True):
    add(merged_modules, "x1", _down, modules=4, order=TYPED, gap=0, numbers="merged")


# Formulas

RIGHT, STALE, BEYOND = "right", "stale", "beyond us"
SOURCES: dict[str, tuple[str, dict[str, float], str]] = {
    "another cell": ("AZ1*1", {"AZ1": 1.0}, RIGHT),
    "a cell that changed": ("AZ1*1", {"AZ1": 1.05}, STALE),
    "a formula of a cell": ("AZ2*1", {"AZ1": 0.5}, RIGHT),
    "a formula of a cell that changed": ("AZ2*1", {"AZ1": 0.6}, STALE),
    "a name": ("offset+0", {"AZ1": 1.0}, RIGHT),
    "a name of what changed": ("offset+0", {"AZ1": 1.1}, STALE),
    "polar coordinates": ("AZ1*COS(RADIANS(60))", {"AZ1": 2.0}, RIGHT),
    "VLOOKUP": ("VLOOKUP(AZ1,AZ1:BA9,1,FALSE)", {"AZ1": 1.0}, RIGHT),
    "XLOOKUP as it is stored": ("_xlfn.XLOOKUP(2,AZ1:AZ9,AZ1:AZ9)", {"AZ1": 1.0}, BEYOND),
    "another workbook": ("[1]Sheet1!$B$4", {}, BEYOND),
    "INDIRECT": ('INDIRECT("AZ1")', {"AZ1": 1.0}, BEYOND),
    "RAND": ("RAND()*300", {}, BEYOND),
    "Google's stand-in": ('IFERROR(__xludf.DUMMYFUNCTION("IMPORTRANGE()"),155)', {}, BEYOND),
    "an error": ("SQRT(-1)", {}, STALE),
    "a division by zero": ("1/0", {}, STALE),
    "a text": ('"155"', {}, STALE),
    "itself": ("{0}", {}, BEYOND),
    "a cycle": ("AZ2*1", {"AZ2": "{0}"}, BEYOND),
}
STORED = {"its value": None, "0": 0, "an empty text": "", "an error": Error("#NAME?"), "TRUE": True, "nothing": None}
ASKED = '<calcPr calcId="191029" fullCalcOnLoad="1"/>'
SETTINGS = ("", '<calcPr calcId="0" calcMode="manual"/>', '<calcPr calcCompleted="0" forceFullCalc="1"/>', ASKED)


def formula(draft: Draft, source: str, stored: str, asked: bool) -> None:
    """Put a formula of cells far off, which have changed since or not, in place of a number."""
    name = draft.layout.order[-2]
    sheet, at = draft.table(name).sheet, draft.cells(name)[0]
    value, plain = sheet[at], draft.plain
    text, sources, kind = SOURCES[source]
    if not isinstance(value, float):
        return
    for source_at, factor in sources.items():
        sheet[source_at] = Formula(factor.format(at), value) if isinstance(factor, str) else value * factor
    if "AZ2" in text and "AZ2" not in sources:
        sheet["AZ2"] = Formula("AZ1*2", value)
    draft.book.names |= {"offset": f"'{sheet.name}'!$AZ$1"} if "offset" in text else {}
    draft.book.calculation = ASKED if asked else draft.book.calculation
    sheet[at] = Formula(text.format(at), value if stored == "its value" else STORED[stored])
    mean(draft, BROKEN if kind == STALE else SAME, (), f"{sheet.name}!{at}", sheet.name)
    if stored != "its value":
        draft.truth, draft.mappable = (None if kind == BEYOND else draft.truth), False
    if draft.layout.formulas == "zeros":
        draft.mappable = False  # beside what was calculated, the zeros are out of date
    elif kind == RIGHT and stored == "its value":
        draft.plain = plain


for _source in SOURCES:
    for _asked in (False, True):
        add(formula, _source, "its value", _asked, sheets=("Geometry", "Main"), numbers="a formula")
for _stored in STORED:
    add(formula, "another cell", _stored, _stored != "its value", formulas="", numbers="a formula")
    add(formula, "XLOOKUP as it is stored", _stored, False, formulas="", numbers="a formula")


def column_of_formulas(draft: Draft, kind: str, values: str) -> None:
    """Put formulas of one kind into a column, with all their values, with none, or with one that is stale."""
    name, table = "y1", draft.table("y1")
    column, sheet, plain = table.columns[name], table.sheet, draft.plain
    ref = f"{column}{table.rows[0]}:{column}{table.rows[-1]}"
    for k, row in enumerate(table.rows):
        at, value = f"{column}{row}", sheet[f"{column}{row}"]
        sheet[f"BZ{row}"] = value / 2 + (10 if values == "one stale" and k == 1 else 0)
        stored = None if values == "none" else 0 if values == "zeros" else value
        attributes = {
            "plain": "",
            "shared": f' t="shared" si="0"{"" if k else f" ref={chr(34)}{ref}{chr(34)}"}',
            "array": f' t="array" ref="{at}"',
            "one array": f' t="array" ref="{ref}"',
            "what-if": f' t="dataTable" ref="{at}" dt2D="0" dtr="0" r1="BZ1"',
        }[kind]
        text = f"BZ{row}*2" if k == 0 or kind in ("plain", "array") else ""
        text = {"one array": f"BZ{table.rows[0]}:BZ{table.rows[-1]}*2", "what-if": ""}.get(kind, text)
        sheet[at] = value if kind == "one array" and k else Formula(text, stored, attributes)
    mean(draft, BROKEN if values == "one stale" else SAME, (), sheet.name)
    if kind in ("one array", "what-if") and values != "stored":
        draft.truth = None  # nobody here can tell
    draft.plain = plain and values == "stored" and kind in ("plain", "shared") and draft.layout.formulas != "zeros"


for _kind in ("plain", "shared", "array", "one array", "what-if"):
    for _values in ("stored", "none", "zeros", "one stale")[: 2 if _kind in ("one array", "what-if") else 4]:
        add(column_of_formulas, _kind, _values, **NUMBERED, order=TYPED, formulas="", numbers="formulas")


def settings(draft: Draft, calculation: str) -> None:
    """Set the settings of the calculation."""
    draft.book.calculation = calculation


for _calculation in SETTINGS:
    add(settings, _calculation, formulas="stored", second="sheet", unit="")


def changed_since(draft: Draft, name: str) -> None:
    """Change a typed number without calculating the formulas again."""
    sheet, at = draft.table(name).sheet, draft.cells(name)[0]
    sheet[at] *= 1.3
    mean(draft, BROKEN, (), *(s.name for s in draft.book.sheets))
    if name == "Td":  # which l does not depend on
        thickness = draft.system.detector_thickness * np.where(np.arange(len(draft.system)) == 0, 1.3, 1.0)
        draft.truth, draft.clear = dataclasses.replace(draft.system, detector_thickness=thickness), False


for _name in ("x1", "d", "Td"):
    add(changed_since, _name, **CALCULATED, numbers="since")


def wrongly_stored(draft: Draft, name: str, value: Any, every: bool) -> None:
    """Store values that are not what the formulas give."""
    sheet = draft.table(name).sheet
    for at in draft.cells(name)[: None if every else 1]:
        sheet[at] = Formula(sheet[at].text, value, sheet[at].attributes)
    meaning = BROKEN if name == "l" else NOBODY if name not in ("slope", "range") else SAME
    mean(draft, SAME if value is None else meaning, (), f"{sheet.name}!{draft.table(name).columns[name]}", sheet.name)


for _i, _name in enumerate(("l", "b", "elevation", "H", "x2", "slope")):
    for _j, _value in enumerate((0, 1.0, None, Error("#NAME?"))):
        add(wrongly_stored, _name, _value, (_i + _j) % 2 == 0, **CALCULATED, numbers="stored")


def length(draft: Draft, kind: str) -> None:
    """Type l over its formula, give it a formula of its own, or remove it."""
    table = draft.table("l")
    lengths, bs = draft.system.collimator_length.copy(), draft.system.pinhole_distance
    some = [0] if kind.startswith("one") else draft.tables[0].modules
    for i in some:
        at = draft.at("l", i)
        lengths[i] = {"typed": 60.0, "own": bs[i] / 4}.get(kind.split()[1], lengths[i])
        value = None if kind.endswith("missing") else float(f"{lengths[i]:.15g}")
        table.sheet[at] = Formula(f"0.25*{draft.at('b', i)}", value) if kind.endswith("own") else value
    for name in ("H", "x2", "y2", "z2"):
        for at in draft.cells(name) if draft.layout.formulas else ():
            table.sheet[at] = Formula(table.sheet[at].text)
    mean(draft, SAME if kind.endswith("missing") else NOBODY, (), f"{table.sheet.name}!")
    if draft.truth is not None:
        draft.truth = dataclasses.replace(draft.truth, collimator_length=lengths)
    if kind.endswith("missing"):
        draft.clear, draft.mappable = True, False


for _kind in ("one typed", "every typed", "every own", "one missing"):
    add(length, _kind, **CALCULATED, numbers="l")


def derived(draft: Draft, name: str, change: str, head: str, meaning: str) -> None:
    """Write a derived column in another unit, which its heading says or not, or with other numbers."""
    table = draft.table(name)
    for at in draft.cells(name):
        v = table.sheet[at]
        value = {
            "/10": v / 10,
            "/100": v / 100,
            "degrees": np.degrees(v),
            "mrad": 1000 * v,
            "-": -v,
            "from the axis": np.pi / 2 - v,
            "-10": v - 10.0,
            "a turn": v + 2 * np.pi,
            "rounded": round(v, 3),
        }[change]
        table.sheet[at] = float(value)
    at = draft.heading(name)
    table.sheet[at] = head.format(table.sheet[at])
    plain = draft.plain
    mean(draft, meaning if meaning != "plain" else SAME, (), f"{table.sheet.name}!{table.columns[name]}")
    draft.plain = plain and meaning == "plain"


for _name in ("b", "H", "x2", "range"):
    add(derived, _name, "/10", "{} (cm)", "plain", **IN_MM, formulas="typed")
    add(derived, _name, "/10", "{}", NOBODY, **IN_MM, formulas="typed")
    add(derived, _name, "rounded", "{}", "plain", **IN_MM, formulas="typed")
for _name, _change, _head, _meaning in (
    ("b", "/100", "{} (dm)", SAME),
    ("azimuth", "degrees", "pinhole azimuth (degrees)", "plain"),
    ("azimuth", "a turn", "{}", "plain"),
    ("azimuth", "degrees", "pinhole azimuth (radians)", NOBODY),
    ("elevation", "degrees", "pinhole elevation (°)", SAME),
    ("elevation", "mrad", "pinhole elevation (mrad)", SAME),
    ("elevation", "-", "{}", NOBODY),
    ("elevation", "from the axis", "{}", NOBODY),
    ("azimuth", "rounded", "pinhole azimuth", "plain"),
    ("H", "-10", "{}", NOBODY),
):
    add(derived, _name, _change, _head, _meaning, **IN_MM, formulas="typed", style="symbols")


def coordinates_since(draft: Draft, kind: str) -> None:
    """Coordinates that were changed since the derived numbers were typed."""
    truth, table = draft.truth, draft.table("x1")
    if truth is None:
        return
    centers = truth.centers.copy()
    if kind == "exchanged":
        centers = centers[:, [1, 0, 2]]
    elif kind == "mirrored":
        centers[:, 2] *= -1
    else:
        centers[[0, -1]] = centers[[-1, 0]]
    for k, name in enumerate(POSITION):
        for i in draft.tables[0].modules:
            table.sheet[draft.at(name, i)] = float(centers[i, k] / MILLIMETRES[draft.units[name]])
    mean(draft, NOBODY, (), f"{table.sheet.name}!")
    draft.truth = dataclasses.replace(truth, centers=centers)


for _kind in ("exchanged", "mirrored", "sorted alone"):
    add(coordinates_since, _kind, **IN_MM, numbers="since", formulas="typed", modules=4)


def scale(draft: Draft, factor: float, names: tuple[str, ...], one: bool) -> None:
    """Numbers in another unit, of which nothing is said."""
    truth = draft.truth
    for name in names:
        sheet = draft.table(name).sheet
        for at in draft.cells(name)[: 1 if one else None]:
            sheet[at] = sheet[at] * factor
    mean(draft, NOBODY, (), *(f"{sheet.name}!" for sheet in draft.book.sheets))
    draft.truth = truth if truth is not None and not names else None


for _factor, _names, _one in ((0.1, ("d",), 0), (10, ("Ld",), 0), (0.1, POSITION, 1), (1e-3, TYPED, 0), (10, TYPED, 0)):
    add(scale, _factor, _names, bool(_one), unit="", formulas="", order=TYPED, numbers="scaled")


# Sheets

NOTES: dict[str, dict[str, Any]] = {
    "Export Summary": {"A1": "This document was exported from Numbers.", "A3": "Numbers Sheet Name", "A4": "Sheet 1"},
    "Evaluation Warning": {"A1": "Evaluation Only. Created with Aspose.Cells for .NET."},
    "Theta": {"A1": "theta", "A2": 0.1, "B1": "sin", "B2": Formula("SIN(A2)", 0.09983341664682815)},
    "MDSL cloud import": {"A1": 277.0, "B1": 70.3, "C1": -70.0, "A2": 155.0},
    "Units": {"A1": "This sheet", "A2": "sensitivity", "B2": "cps/MBq", "A3": "rod", "B3": "cm"},
    "empty": {},
    "=1+1'": {"A1": 1.0, "A2": "ä"},
    "drawings": {"A1": "see the drawings", "A2": 3.5, "B2": "cm"},
}


def further_sheet(draft: Draft, name: str, kind: str, state: str) -> None:
    """Add a sheet: of something else, or a copy with other numbers, the same, or none."""
    table, plain = draft.tables[-1 if "dimensions" in kind else 0], draft.plain
    source, meaning = table.sheet, SAME
    if kind == "notes":
        sheet, draft.plain = Sheet(name, dict(NOTES[name])), plain
    elif kind.startswith("legend"):
        pairs = [[SYMBOLS[q], DESCRIPTIONS[q]] for q in DESCRIPTIONS]
        sheet = Sheet(name)
        sheet.put("A1", pairs if kind.endswith("down") else [list(row) for row in zip(*pairs, strict=True)])
    elif kind == "plot":
        sheet = Sheet(name, {"A1": "x1", "B1": "y1"})
        for k, (x, y) in enumerate(zip(draft.cells("x1"), draft.cells("y1"), strict=True), start=2):
            for column, at in (("A", x), ("B", y)):
                stored = source[at].stored if isinstance(source[at], Formula) else source[at]
                sheet[f"{column}{k}"] = Formula(f"'{source.name}'!{at}", stored)
    elif kind == "some dimensions":
        sheet = Sheet(name, {"A1": "d", "B1": "R", "C1": "sensitivity", "A2": 4.0, "B2": 90.0, "C2": 1e-4})
        meaning = SAME if name == "Design Table" else NOBODY
    else:
        cells = dict(source.cells)
        for at in [at for q in table.columns for at in draft.cells(q)] if kind != "the same" else ():
            cells[at] = cells[at] * 1.02 if isinstance(cells[at], float) and "empty" not in kind else None
        sheet = dataclasses.replace(source, name=name, cells=cells, formats={}, merged=[])
        known = draft.layout.sheets == ("Coordinates", "Main") and name in ("Theta", "Values", "MDSL cloud import")
        meaning = NOBODY if "other" in kind and not known else SAME
    sheet.state = state
    draft.book.sheets.append(sheet)
    if kind != "notes":
        mean(draft, meaning, (), name, source.name)


for _name in NOTES:
    add(further_sheet, _name, "notes", "visible", sheets=("Coordinates", "Main"))
for _name, _kind in (
    *(("Theta", "other numbers"), ("Coordinates old", "other numbers"), ("MDSL cloud import", "other numbers")),
    *(("Values", "other dimensions"), ("Main (2)", "other dimensions"), ("Coordinates (2)", "the same")),
    *(("Coordinates (blank)", "empty"), ("Design Table", "some dimensions"), ("Table", "some dimensions")),
    *(("Legend", "legend down"), ("Legend", "legend across"), ("Plot", "plot")),
):
    for _state in ("visible", "hidden", "veryHidden") if "other" in _kind else ("visible",):
        add(further_sheet, _name, _kind, _state, **USERS_SHEETS, second="sheet", formulas="", headings="own")
add(further_sheet, "backup", "other numbers", "visible", headings="own")


def many_sheets(draft: Draft) -> None:
    """Forty sheets before and behind the scanner's."""
    draft.book.sheets[:0] = [Sheet(f"table {n}", {"A1": n}) for n in range(5)]
    draft.book.sheets += [Sheet(f"plot {n}", {"A1": n, "A2": "counts"}) for n in range(35)]


add(many_sheets)


def hidden_sheet(draft: Draft, which: int, state: str, twin: str) -> None:
    """Hide a sheet of the scanner, beside one of notes or one like it that is shown."""
    sheet = draft.tables[which].sheet
    shown = Sheet("Notes", {"A1": "see me"})
    if twin:
        shown = dataclasses.replace(sheet, name=twin, cells=dict(sheet.cells))
        for at in draft.cells("x1"):
            shown[at] = shown[at] * 1.02
    sheet.state = state
    draft.book.sheets.insert(0, shown)
    mean(draft, NOBODY if twin else SAME, (), sheet.name, shown.name)


for _state in ("hidden", "veryHidden"):
    for _which in (0, -1):
        add(hidden_sheet, _which, _state, "", second="sheet")
for _state, _twin in (("hidden", "MDSL cloud import"), ("veryHidden", "Coordinates new")):
    add(hidden_sheet, 0, _state, _twin, sheets=("Coordinates", "Main"), formulas="")


def hidden_parts(draft: Draft, kind: str) -> None:
    """Hidden rows and columns, filters, and Excel's tables."""
    table = draft.tables[0]
    first, last = f"{table.number}{table.row}", max(table.columns.values())
    area, sheet, plain = f"{first}:{last}{table.rows[-1]}", table.sheet, draft.plain
    if kind == "rows":
        sheet.hidden_rows = table.rows[::2]
    elif kind == "columns":
        sheet.hidden_columns += [table.columns["y1"], table.columns["z1"]]
    elif kind == "a filter":
        sheet.hidden_rows = table.rows[1::2]
        filters = '<filterColumn colId="0"><filters><filter val="1"/></filters></filterColumn>'
        sheet.after_data = f'<autoFilter ref="{area}">{filters}</autoFilter>'
    else:
        short = f"{first}:{last}{table.rows[-2]}" if kind == "a short table" else area
        sheet.table, sheet.table_totals = short, kind == "a table with totals"
        if sheet.table_totals:
            sheet.table = f"{first}:{last}{table.rows[-1] + 1}"
            for name in table.columns:
                at = f"{table.columns[name]}{table.rows[-1] + 1}"
                sheet[at] = Formula(f"SUBTOTAL(101,Table1[{sheet[draft.heading(name)]}])", 166.0)
            sheet[f"{table.number}{table.rows[-1] + 1}"] = "Total"
    mean(draft, SAME, (), f"{sheet.name}!")
    draft.plain = plain and kind == "a table"


for _kind in ("rows", "columns", "a filter", "a table", "a short table", "a table with totals"):
    add(hidden_parts, _kind, **NUMBERED, formulas="", second="", gap=0, left=0)


# The file


def _each(pattern: str, new: Any) -> Callable[[list[str]], list[str]]:
    return lambda lines: [re.sub(pattern, new, line) for line in lines]


def _backwards(match: re.Match[str]) -> str:
    return "".join(re.findall("<c .*?</c>", match[1])[::-1])


STORED_ODDLY: dict[str, tuple[Callable[[list[str]], list[str]], str]] = {
    "rows backwards": (lambda lines: lines[::-1], SAME),
    "cells backwards": (_each(r"(?<=>)(<c .*</c>)(?=</row>)", _backwards), SAME),
    "rows and cells without names": (_each(r'<(row|c) r="\w+"', r"<\1"), SAME),
    "cells of other rows in a row": (
        lambda lines: [lines[0], re.sub(r'</row><row r="\d+">', "", "".join(lines[1:]))],
        SAME,
    ),
    "a row in two parts": (_each(r'(<row r="4"[^>]*>)(.*)(<c r="C4".*)(</row>)', r"\1\2\4\1\3\4"), SAME),
    "rows numbered from 0": (_each(r'<row r="(\d+)"', lambda m: f'<row r="{int(m[1]) - 1}"'), SAME),
    "cells in small letters": (_each(r'<c r="(\w+)"', lambda m: f'<c r="{m[1].lower()}"'), SAME),
    "cells with $": (_each(r'<c r="([A-Z]+)(\d+)"', r'<c r="$\1$\2"'), SAME),
    "wrong spans": (_each("<row ", '<row spans="1:2" '), SAME),
    "a row twice": (lambda lines: [*lines, re.sub(r"<v>(\d)", r"<v>2\1", lines[-1])], BROKEN),
    "a second block": (lambda lines: [*lines, "</sheetData><sheetData>", re.sub("<v>", "<v>2", lines[-1])], BROKEN),
}
"""Rows and cells as no spreadsheet program writes them, but others do."""


def stored_oddly(draft: Draft, kind: str) -> None:
    """Change the XML of the first sheet's rows."""
    sheet = draft.tables[0].sheet
    sheet.row_order, meaning = STORED_ODDLY[kind]
    mean(draft, meaning, (), sheet.name, "scanner.xlsx")
    draft.mappable = not (draft.layout.columns and "without names" in kind)  # cells without names are elsewhere
    if kind == "rows and cells without names" or "numbered" in kind or "letters" in kind or "$" in kind:
        draft.truth = None if draft.layout.top or draft.layout.left or draft.layout.gap else draft.truth


for _kind in STORED_ODDLY:
    add(stored_oddly, _kind, **AT_THE_CORNER, numbers="XML")
