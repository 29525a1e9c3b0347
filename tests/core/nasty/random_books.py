"""Random workbooks: layouts with decorations, written by several programs."""

from __future__ import annotations

import dataclasses
import importlib.util
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

import openpyxl
from hypothesis import strategies as st

from .decorations import ELEMENTS, Element
from .layouts import OTHER_HEADINGS, PLAIN_FORMS, TYPED, USERS, Draft, Layout, formulas_of, laid_out
from .sheets import Formula, by_hand, by_xlsxwriter, openpyxl_workbook

SHEETS = [("Coordinates", "Main"), ("Geometry", "Sheet2"), ("Lage", "Größen"), (" Main ", "COORDINATES")]
SHEETS += [("a'b", "c d"), ("a" * 31, "b" * 31), ("Main", "Coordinates")]
LABELS = [("numbers", "numbers"), ("", ""), ("names", "names"), ("texts", "numbers"), ("zeros", "numbers")]
LABELS += [("decimals", "texts"), ("halves", "halves"), ("", "numbers"), ("numbers", ""), ("names", "numbers")]
LABELS += [("formulas", "numbers"), ("unstored", "numbers")]
CHOICES = {
    "modules": [4, 1, 2, 3, 60],
    "seed": [0, 1, 2, 3, 4, 5],
    "sheets": SHEETS,
    "second": ["", "sheet", "beside", "below"],
    "main_first": [False, True],
    "top": [0, 1, 2, 4, 60],
    "left": [0, 1, 2, 700],
    "gap": [0, 1],
    "under": [0, 1, 3],
    "style": ["symbols", "descriptions", "both", "both reversed", *OTHER_HEADINGS],
    "unit": ["", "mm", "cm", "m", "in", "um"],
    "unit_form": [*PLAIN_FORMS, "{} (in {})"],
    "unit_in": ["all", "symbol", "description"],
    "units_of": ["all", "position", "one", "own"],
    "number": ["No.", "Definitions", "Module", "Nr.", "", "pinhole", "serial"],
    "labels": LABELS,
    "shuffled": [False, True],
    "once": ["", "row", "cells", "merged"],
    "formulas": ["", "typed", "stored", "unstored", "zeros"],
}
"""What the fields of a layout may be; the first is the usual one."""
PROGRAMS = ["by hand", "openpyxl", "openpyxl, values alone", "XlsxWriter", "XlsxWriter in constant memory"]


@dataclass(frozen=True)
class Recipe:
    """A layout, its decorations in order, and the program that writes it."""

    layout: Layout
    elements: tuple[Element, ...] = ()
    program: str = "by hand"

    @property
    def name(self) -> str:
        """The name of a test: the decorations, or the layout's unusual values."""
        usual = Layout()
        fields = [f"{key} {value}" for key, value in vars(self.layout).items() if value != getattr(usual, key)]
        words = [" ".join(map(str, (e.decorate.__name__, *e.arguments))) for e in self.elements]
        return ", ".join(words or fields)[:90] or "usual"

    @property
    def group(self) -> str:
        """The kind of its first decoration."""
        return self.elements[0].decorate.__name__ if self.elements else "layouts"

    @property
    def fitting(self) -> Layout:
        """The layout as the decorations need it."""
        fields = {field.name for field in dataclasses.fields(Layout)}
        needs = {name: value for element in self.elements for name, value in element.needs if name in fields}
        return dataclasses.replace(self.layout, **needs)


def written(recipe: Recipe, path: Path) -> Draft:
    """Write the recipe's workbook to `path`, and return what a person reads in it."""
    draft = laid_out(recipe.fitting)
    for decorate, arguments, _ in recipe.elements:
        decorate(draft, *arguments)
    program = recipe.program if _is_plain_data(draft, bool(recipe.elements)) else "by hand"
    if program.startswith("XlsxWriter") and importlib.util.find_spec("xlsxwriter"):
        by_xlsxwriter(draft.book, path, constant_memory=program.endswith("memory"))
        draft.plain &= not any("form" in kind or kind == "unstored" for kind in draft.layout.labels)
        return draft
    if program == "openpyxl":
        openpyxl_workbook(draft.book).save(path)
        return draft
    by_hand(draft.book, path)
    if program.endswith("values alone") and not {draft.layout.formulas, *draft.layout.labels} & {"unstored", "zeros"}:
        openpyxl.load_workbook(path, data_only=True).save(path)
    return draft


def _is_plain_data(draft: Draft, decorated: bool) -> bool:
    """Return whether every program writes a workbook alike."""
    book = draft.book
    usual = all(
        not (s.row_order or s.after_data or s.table or s.merged or s.hidden_columns or s.hidden_rows)
        and s.state == "visible"
        and re.fullmatch(r"[^\[\]:*?/\\']{1,31}", s.name)
        and all(isinstance(code, str) for code in s.formats.values())
        and all(isinstance(v, (str, int, float, Formula, type(None))) for v in s.cells.values())
        for s in book.sheets
    )
    return usual and not (decorated and any(formulas_of(sheet) for sheet in book.sheets))


def _layout(pairs: list[tuple[str, Any]], order: tuple[str, ...] = TYPED) -> Layout:
    return Layout(**dict(pairs), order=order)


VARIED = [
    _layout([(name, value)] if name == "second" else [("second", ("", "sheet")[k % 2]), (name, value)])
    for name, values in CHOICES.items()
    for k, value in enumerate(values)
]
"""Layouts that are unusual in one thing: together they have every choice."""
VARIED += [dataclasses.replace(USERS, unit=unit) for unit in CHOICES["unit"]]
BASES = [layout for layout in dict.fromkeys(VARIED) if laid_out(layout).plain and layout.modules == 4]
orders = st.one_of(st.just(TYPED), st.just(TYPED[:-1]), st.permutations(TYPED).map(tuple))
layouts = st.builds(
    _layout,
    st.lists(
        st.sampled_from([(name, value) for name, values in CHOICES.items() for value in values]),
        max_size=6,
        unique_by=lambda pair: pair[0],
    ),
    orders,
)


def _together(elements: list[Element]) -> tuple[Element, ...]:
    """Return the elements whose needs agree with those before."""
    needs: dict[str, Any] = {}
    chosen = []
    for element in elements:
        if all(needs.get(name, value) == value for name, value in element.needs):
            needs |= dict(element.needs)
            chosen.append(element)
    return tuple(chosen)


recipes = st.builds(
    Recipe,
    st.one_of(st.sampled_from(BASES), layouts),
    st.lists(st.sampled_from(ELEMENTS), max_size=4, unique_by=lambda element: element.decorate).map(_together),
    st.sampled_from(PROGRAMS),
)


def every_recipe() -> Iterator[Recipe]:
    """Yield recipes in which every choice of a layout, every program and every decoration occurs alone."""
    for layout, program in zip(dict.fromkeys(VARIED), cycle(PROGRAMS), strict=False):
        yield Recipe(layout, (), program)
    recipes = [Recipe(layout, (element,)) for element, layout in zip(ELEMENTS, cycle(BASES), strict=False)]
    yield from sorted(recipes, key=lambda recipe: recipe.group)
