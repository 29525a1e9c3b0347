"""The column map dialog of the import, drawn."""

import json
import textwrap

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon.blender.layouts import draw_all, labelled
from ..addon.scanner.column_maps import ColumnMapProperties, ColumnMapQuantity
from ..core.geometry.system import PinholeSystem

WIDTH = 1000  # of the dialog, pixels
_LINE = 170  # characters that fit in it
_MOST = 2  # doubts and remarks shown; more would push the preview off the screen
_RESULT = 9  # lines reserved for the preview: a dialog that grows moves away from the mouse


def draw(layout: bpy.types.UILayout, form: ColumnMapProperties) -> None:
    """Draw the settings, and below them what is read with them."""
    _lines(layout, json.loads(form.doubts or "[]"), "INFO")
    row = layout.row()
    draw_all(row, form, "n_tables", "unit")
    _tables(layout, form)
    needed, compared = ([q for q in form.quantities if _is_derived(q) == derived] for derived in (False, True))
    split = layout.split(factor=0.6) if compared else layout
    _columns(split, "Quantity", needed, 0.38)
    if compared:
        _columns(split, "Compared", compared, 0.2)
    _result(layout, form)
    layout.prop(form, "save_as")


def _is_derived(quantity: ColumnMapQuantity) -> bool:
    return quantity.name in PinholeSystem.columns.derived


def _tables(layout: bpy.types.UILayout, form: ColumnMapProperties) -> None:
    grid = layout.grid_flow(row_major=True, columns=min(3, len(form.tables)), even_columns=True)
    for i, table in enumerate(form.tables):
        box = labelled(grid.box())
        one = i > 0 and table.rows == "ONE_FOR_ALL"
        box.label(text=iface("Table {number}" if i else "Table {number}: pinholes").format(number=i + 1))
        column = box.column(align=True)
        draw_all(column, table, "sheet", "header_row", "first_row")
        rest = column.column(align=True)
        rest.enabled = not one
        draw_all(rest, table, "last_row", "skip_rows", "number")
        if i > 0:
            column.prop(table, "rows")


def _columns(layout: bpy.types.UILayout, head: str, quantities: list[ColumnMapQuantity], factor: float) -> None:
    box = layout.box().column(align=True)
    for cell, text in zip(_cells(box, factor), (head, "Table", "Column", "Unit", "In the workbook"), strict=True):
        cell.active = False
        cell.label(text=text)
    for quantity in quantities:
        name, table, column, unit, seen = _cells(box, factor)
        described = () if _is_derived(quantity) else PinholeSystem.columns[quantity.name].headings[1:2]
        name.label(text=" ".join([quantity.name, *(f"({text})" for text in described)]))
        table.prop(quantity, "table", text="")
        column.prop(quantity, "column", text="")
        unit.prop(quantity, "unit", text="")
        seen.label(text=quantity.seen)


def _cells(layout: bpy.types.UILayout, factor: float) -> list[bpy.types.UILayout]:
    """Name, table, column, unit and what is seen, side by side."""
    first = layout.split(factor=factor)
    name, rest = first.row(), first.split(factor=0.55)
    settings = rest.row(align=True)
    return [name, settings.row(), settings.row(), settings.row(), rest.row()]


def _result(layout: bpy.types.UILayout, form: ColumnMapProperties) -> None:
    box = layout.box().column(align=True)
    rows = json.loads(form.preview or "[]")
    if form.refusal:
        box.alert = True
        used = _lines(box, [form.refusal], "ERROR")
    else:
        box.label(text=iface("{count} modules, in mm:").format(count=form.n_modules), icon="CHECKMARK")
        columns = box.row()
        for texts in zip(*rows, strict=True):
            column = columns.column(align=True)
            for i, text in enumerate(texts):
                cell = column.row()
                cell.alignment, cell.active = "RIGHT", i > 0
                cell.label(text=text)
        used = 1 + len(rows) + _lines(box, json.loads(form.remarks or "[]"), "ERROR")
    for _ in range(used, _RESULT):
        box.label(text="")


def _lines(layout: bpy.types.UILayout, texts: list[str], icon: str) -> int:
    """Draw texts of any length, broken into lines; returns how many lines."""
    lines = [
        (line, icon if i == 0 else "BLANK1")
        for text in texts[:_MOST]
        for i, line in enumerate(textwrap.wrap(text, _LINE))
    ]
    if len(texts) > _MOST:
        lines.append((f"... and {len(texts) - _MOST} more", "BLANK1"))
    column = layout.column(align=True)
    for line, sign in lines:
        column.label(text=line, icon=sign)
    return len(lines)
