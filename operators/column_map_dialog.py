"""How the column map dialog of the import looks."""

from __future__ import annotations

import json
import textwrap

import bpy

from ..addon.column_maps import ColumnMapProperties
from ..core.workbook.quantities import QUANTITIES

WIDTH = 760  # of the dialog, pixels
_LINE = 128  # characters that fit in it
_DOUBTS = 2  # more of them push the preview off the screen
_REMARKS = 2
_RESULT = 9  # lines kept for the preview: a dialog that grows moves away from the mouse


def draw(layout: bpy.types.UILayout, form: ColumnMapProperties) -> None:
    """The settings, and beneath them what they give."""
    _lines(layout, json.loads(form.doubts or "[]"), _DOUBTS, "INFO")
    row = layout.row()
    row.prop(form, "n_tables")
    row.prop(form, "unit")
    _tables(layout, form)
    _quantities(layout, form)
    _result(layout, form)
    layout.prop(form, "save_as")


def _tables(layout: bpy.types.UILayout, form: ColumnMapProperties) -> None:
    grid = layout.grid_flow(row_major=True, columns=min(3, len(form.tables)), even_columns=True)
    for i, table in enumerate(form.tables):
        box = grid.box()
        box.use_property_split = True
        box.use_property_decorate = False
        one = i > 0 and table.rows == "ONE_FOR_ALL"
        box.label(text=f"Table {i + 1}" + (": pinholes" if i == 0 else ""))
        column = box.column(align=True)
        column.prop(table, "sheet")
        column.prop(table, "header_row")
        column.prop(table, "first_row")
        rest = column.column(align=True)
        rest.enabled = not one
        for name in ("last_row", "skip_rows", "number"):
            rest.prop(table, name)
        if i > 0:
            column.prop(table, "rows")


def _quantities(layout: bpy.types.UILayout, form: ColumnMapProperties) -> None:
    box = layout.box().column(align=True)
    cells = _cells(box)
    for cell, text in zip(cells, ("Quantity", "Table", "Column", "Unit", "In the workbook"), strict=True):
        cell.active = False
        cell.label(text=text)
    for quantity in form.quantities:
        name, table, column, unit, seen = _cells(box)
        described = QUANTITIES[quantity.name].headings[1:2]
        name.label(text=" ".join([quantity.name, *(f"({text})" for text in described)]))
        table.prop(quantity, "table", text="")
        column.prop(quantity, "column", text="")
        unit.prop(quantity, "unit", text="")
        seen.label(text=quantity.seen)


def _cells(layout: bpy.types.UILayout) -> list[bpy.types.UILayout]:
    """Name, table, column, unit and what is seen, side by side."""
    first = layout.split(factor=0.34)
    name, rest = first.row(), first.split(factor=0.5)
    settings = rest.row(align=True)
    return [name, settings.row(), settings.row(), settings.row(), rest.row()]


def _result(layout: bpy.types.UILayout, form: ColumnMapProperties) -> None:
    box = layout.box().column(align=True)
    rows = json.loads(form.preview or "[]")
    if form.refusal:
        box.alert = True
        used = _lines(box, [form.refusal], 1, "ERROR")
    else:
        box.label(text=f"{form.n_modules} modules, in mm:", icon="CHECKMARK")
        columns = box.row()
        for texts in zip(*rows, strict=True):
            column = columns.column(align=True)
            for i, text in enumerate(texts):
                cell = column.row()
                cell.alignment, cell.active = "RIGHT", i > 0
                cell.label(text=text)
        used = 1 + len(rows) + _lines(box, json.loads(form.remarks or "[]"), _REMARKS, "ERROR")
    for _ in range(used, _RESULT):
        box.label(text="")


def _lines(layout: bpy.types.UILayout, texts: list[str], most: int, icon: str) -> int:
    """Texts of any length, broken into lines; says how many."""
    column = layout.column(align=True)
    lines = [
        (line, icon if i == 0 else "BLANK1")
        for text in texts[:most]
        for i, line in enumerate(textwrap.wrap(text, _LINE))
    ]
    if len(texts) > most:
        lines.append((f"... and {len(texts) - most} more", "BLANK1"))
    for line, sign in lines:
        column.label(text=line, icon=sign)
    return len(lines)
