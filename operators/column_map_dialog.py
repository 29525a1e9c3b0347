"""Drawing of the import's column map dialog: tables, columns, and a preview of the modules that are read."""

import json
import textwrap

import bpy
from bpy.app.translations import pgettext_iface as iface

from ..addon.blender.layouts import draw_all, labelled
from ..addon.scanner.column_maps import ColumnMapProperties, ColumnMapQuantity
from ..core.geometry.system import PinholeSystem

WIDTH = 1000  # width of the dialog, pixels
_LINE_LENGTH = 170  # number of characters that fit into the dialog
_MAX_TEXTS = 2  # number of doubts or remarks shown; more would push the preview off the screen
_PREVIEW_LINES = 9  # lines reserved for the preview, because a dialog that grows moves away from the mouse


def draw(layout: bpy.types.UILayout, form: ColumnMapProperties) -> None:
    """Draw the settings of the dialog, and below them a preview of the modules that are read with them."""
    _draw_texts(layout, json.loads(form.doubts or "[]"), "INFO")
    row = layout.row()
    draw_all(row, form, "n_tables", "unit")
    _draw_tables(layout, form)
    needed, compared = ([q for q in form.quantities if _is_derived(q) == derived] for derived in (False, True))
    split = layout.split(factor=0.6) if compared else layout
    _draw_quantities(split, "Quantity", needed, 0.38)
    if compared:
        _draw_quantities(split, "Compared", compared, 0.2)
    _draw_preview(layout, form)
    layout.prop(form, "save_as")


def _is_derived(quantity: ColumnMapQuantity) -> bool:
    """Return whether a quantity follows from others and is only compared with them."""
    return quantity.name in PinholeSystem.columns.derived


def _draw_tables(layout: bpy.types.UILayout, form: ColumnMapProperties) -> None:
    """Draw the sheet and rows of each table."""
    grid = layout.grid_flow(row_major=True, columns=min(3, len(form.tables)), even_columns=True)
    for i, table in enumerate(form.tables):
        box = labelled(grid.box())
        is_common = i > 0 and table.rows == "ONE_FOR_ALL"
        box.label(text=iface("Table {number}" if i else "Table {number}: pinholes").format(number=i + 1))
        column = box.column(align=True)
        draw_all(column, table, "sheet", "header_row", "first_row")
        rest = column.column(align=True)
        rest.enabled = not is_common
        draw_all(rest, table, "last_row", "skip_rows", "number")
        if i > 0:
            column.prop(table, "rows")


def _draw_quantities(layout: bpy.types.UILayout, head: str, quantities: list[ColumnMapQuantity], factor: float) -> None:
    """Draw table, column, unit and first value of each quantity, under a heading; names take the share `factor`."""
    box = layout.box().column(align=True)
    for cell, text in zip(_cells(box, factor), (head, "Table", "Column", "Unit", "In the workbook"), strict=True):
        cell.active = False
        cell.label(text=text)
    for quantity in quantities:
        name, table, column, unit, value = _cells(box, factor)
        description = () if _is_derived(quantity) else PinholeSystem.columns[quantity.name].headings[1:2]
        name.label(text=" ".join([quantity.name, *(f"({text})" for text in description)]))
        table.prop(quantity, "table", text="")
        column.prop(quantity, "column", text="")
        unit.prop(quantity, "unit", text="")
        value.label(text=quantity.seen)


def _cells(layout: bpy.types.UILayout, factor: float) -> list[bpy.types.UILayout]:
    """Return layouts for name, table, column, unit and value, side by side; the name takes the share `factor`."""
    name_split = layout.split(factor=factor)
    name, rest = name_split.row(), name_split.split(factor=0.55)
    settings = rest.row(align=True)
    return [name, settings.row(), settings.row(), settings.row(), rest.row()]


def _draw_preview(layout: bpy.types.UILayout, form: ColumnMapProperties) -> None:
    """Draw the first modules that are read, or why they cannot be read."""
    box = layout.box().column(align=True)
    rows = json.loads(form.preview or "[]")
    if form.refusal:
        box.alert = True
        n_lines = _draw_texts(box, [form.refusal], "ERROR")
    else:
        box.label(text=iface("{count} modules, in mm:").format(count=form.n_modules), icon="CHECKMARK")
        columns = box.row()
        for texts in zip(*rows, strict=True):
            column = columns.column(align=True)
            for i, text in enumerate(texts):
                cell = column.row()
                cell.alignment, cell.active = "RIGHT", i > 0
                cell.label(text=text)
        n_lines = 1 + len(rows) + _draw_texts(box, json.loads(form.remarks or "[]"), "ERROR")
    for _ in range(n_lines, _PREVIEW_LINES):
        box.label(text="")


def _draw_texts(layout: bpy.types.UILayout, texts: list[str], icon: str) -> int:
    """Draw texts of any length, broken into lines, each text with an icon; return the number of lines."""
    lines = [
        (line, icon if i == 0 else "BLANK1")
        for text in texts[:_MAX_TEXTS]
        for i, line in enumerate(textwrap.wrap(text, _LINE_LENGTH))
    ]
    if len(texts) > _MAX_TEXTS:
        lines.append((f"... and {len(texts) - _MAX_TEXTS} more", "BLANK1"))
    column = layout.column(align=True)
    for line, line_icon in lines:
        column.label(text=line, icon=line_icon)
    return len(lines)
