"""Settings of the column map dialog, on the window manager while it is open; every change updates its preview."""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import bpy
from bpy.props import BoolProperty, CollectionProperty, EnumProperty, IntProperty, StringProperty

from ...core import InputError, PinholeSystem, recording
from ...core.errors import expecting
from ...core.geometry.columns import ANGLE_UNITS, LENGTH_UNITS
from ...core.workbook import ColumnMap, MappedColumn, MappedTable, draft_column_map, preview_workbook, read_system
from ..blender import choices

MAX_TABLES = 9
_PREVIEW_MODULES = 3  # modules shown at the top of the preview
_PREVIEW_CELLS = 80  # rows and columns of a sheet whose texts may be shown beside the settings
_read_cells = lru_cache(maxsize=1)(lambda workbook, changed: preview_workbook(workbook, _PREVIEW_CELLS, _PREVIEW_CELLS))


def _edited(self: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    """Update the preview after an edit of any setting."""
    update(context.window_manager.mphdrr_columns)


def _number_of_tables_changed(self: ColumnMapProperties, context: bpy.types.Context) -> None:
    """Add or remove tables at the end after an edit of their number."""
    if not self.filled:
        return
    while len(self.tables) > self.n_tables:
        self.tables.remove(len(self.tables) - 1)
    while len(self.tables) < self.n_tables:
        last, new = self.tables[-1], self.tables.add()
        for name in ("sheet", "header_row", "first_row", "last_row", "number"):
            setattr(new, name, getattr(last, name))
    update(self)


def _unit_of_all_changed(self: ColumnMapProperties, context: bpy.types.Context) -> None:
    """Set the unit of all lengths after an edit of "All Lengths In"."""
    if not self.filled:
        return
    self.filled = False  # no update of the preview until all units are set
    for quantity in self.quantities:
        if PinholeSystem.columns[quantity.name].kind == "length":
            quantity.unit = self.unit
    self.filled = True
    update(self)


def _sheets(self: ColumnMapTable, context: bpy.types.Context, edit_text: str) -> list[str]:
    """Return the names of the workbook's sheets for the search field."""
    return json.loads(context.window_manager.mphdrr_columns.sheets or "[]")


def _units(*tables: Iterable[str]) -> choices.Items:
    """Return the units of the tables as items of an enumeration, with "?" for an unknown one."""
    units = [(unit, unit, "") for table in tables for unit in table]
    return choices.items(choices.UNITS, [("NONE", "?", "Not known"), *units])


class ColumnMapTable(bpy.types.PropertyGroup):
    """Rows of a sheet (`MappedTable`)."""

    sheet: StringProperty(name="Sheet", description="Name of the sheet", search=_sheets, update=_edited)
    header_row: IntProperty(name="Header Row",
                            description="Row of the headings shown below, which are not read; 0: none", min=0,
                            update=_edited)  # fmt: skip
    first_row: IntProperty(name="First Row", description="Row of the first module", default=2, min=1, update=_edited)
    last_row: IntProperty(name="Last Row", description="Row of the last module", default=2, min=1, update=_edited)
    skip_rows: StringProperty(name="Skip Rows", description="Rows without a module, such as 43, 50-52", update=_edited)
    number: StringProperty(
        name="Number Column",
        description="Letters of the column with module numbers or names. Empty: the rows are modules 1, 2, ...",
        update=_edited,
    )
    rows: EnumProperty(
        name="Rows", description="How rows are assigned to the modules of table 1", default="BY_NUMBER", update=_edited,
        items=choices.items(choices.JOINED, (
            ("BY_NUMBER", "By Number", "A row belongs to the module with its number or name"),
            ("IN_ORDER", "In Order", "The first row belongs to the first module, and so on"),
            ("ONE_FOR_ALL", "One for All", "The first row holds what all modules share"),
        )),
    )  # fmt: skip


class ColumnMapQuantity(bpy.types.PropertyGroup):
    """Column of a quantity (`MappedColumn`)."""

    name: StringProperty(name="Quantity", description="Symbol of the quantity")
    table: IntProperty(name="Table", description="Table with the quantity's column", default=1, min=1, max=MAX_TABLES,
                       update=_edited)  # fmt: skip
    column: StringProperty(name="Column", description="The column's letters. Empty: none", update=_edited)
    unit: EnumProperty(name="Unit", description="Unit of the numbers in the column",
                       items=_units(LENGTH_UNITS, ANGLE_UNITS), default="NONE", update=_edited)  # fmt: skip
    seen: StringProperty(name="Seen", description="The column's heading and first number in the workbook")


class ColumnMapProperties(bpy.types.PropertyGroup):
    """Settings of the dialog and what they yield; `WindowManager.mphdrr_columns`."""

    filled: BoolProperty(name="Filled", description="A changed setting updates the preview", options={"HIDDEN"})
    workbook: StringProperty(name="Workbook", description="Workbook that the settings belong to", subtype="FILE_PATH")
    sheets: StringProperty(name="Sheets", description="Names of the workbook's sheets, JSON", options={"HIDDEN"})
    doubts: StringProperty(name="Doubts", description="What the reader did not understand, JSON", options={"HIDDEN"})
    n_tables: IntProperty(name="Tables",
                          description="Ranges of rows: the first holds x1, y1 and z1, the others dimensions", default=2,
                          min=1, max=MAX_TABLES, update=_number_of_tables_changed)  # fmt: skip
    unit: EnumProperty(name="All Lengths In", description="Unit for every length below", items=_units(LENGTH_UNITS),
                       default="NONE", update=_unit_of_all_changed)  # fmt: skip
    tables: CollectionProperty(type=ColumnMapTable, name="Tables")
    quantities: CollectionProperty(type=ColumnMapQuantity, name="Quantities")
    save_as: StringProperty(
        name="Save Map As",
        description="Also write the column map to this new .toml file, beside the workbook unless a folder is given",
    )
    refusal: StringProperty(name="Refusal", description="Reason why the workbook cannot be read with these settings")
    remarks: StringProperty(name="Remarks", description="The reader's warnings, JSON", options={"HIDDEN"})
    n_modules: IntProperty(name="Modules", description="Number of modules that are read", min=0)
    preview: StringProperty(
        name="Preview", description="Headings, then rows as they are read, JSON", options={"HIDDEN"}
    )


CLASSES = (ColumnMapTable, ColumnMapQuantity, ColumnMapProperties)


def fill(form: ColumnMapProperties, workbook: Path, columns: ColumnMap | None = None) -> bool:
    """Fill the settings from a column map, by default from a draft made of the workbook's headings.

    Return whether the dialog is needed: the reader has questions about the workbook, or a map was given.
    """
    clear(form)
    draft = draft_column_map(workbook)
    displayed = draft.columns if columns is None else columns
    faults = draft.columns.faults()
    form.workbook, form.sheets = str(workbook), json.dumps(list(_cells(workbook)))
    form.doubts = json.dumps([question for question in draft.questions if question not in faults])
    columns_of: dict[str, tuple[int, MappedColumn]] = {}
    for i, table in enumerate(displayed.tables[:MAX_TABLES], start=1):
        row = form.tables.add()
        row.sheet, row.header_row, row.number = table.sheet, table.header_row or 0, table.number or ""
        row.first_row, row.last_row = table.first_row, table.last_row
        row.skip_rows = ", ".join(map(str, table.skip_rows))
        if table.rows is not None:
            row.rows = table.rows.upper().replace(" ", "_")
        columns_of |= {c.quantity: (i, c) for c in table.columns if c.quantity in PinholeSystem.columns}
    if not form.tables:
        form.tables.add()
    for name in dict.fromkeys((*PinholeSystem.columns.typed, *columns_of)):
        quantity = form.quantities.add()
        quantity.name = name
        quantity.table = 1 if name in PinholeSystem.columns.position else len(form.tables)
        if name in columns_of:
            quantity.table, column = columns_of[name]
            quantity.column = column.column
            quantity.unit = column.unit if column.unit in choices.UNITS else "NONE"
    form.n_tables = len(form.tables)
    form.filled = True
    update(form)
    return bool(draft.questions) or columns is not None


def clear(form: ColumnMapProperties) -> None:
    """Empty the settings, so that they belong to no workbook."""
    form.filled = False
    for prop in form.bl_rna.properties:
        if not prop.is_readonly or prop.type == "COLLECTION":
            form.property_unset(prop.identifier)


def column_map(form: ColumnMapProperties) -> ColumnMap:
    """Return the column map that the settings describe, complete or not; raise `InputError` for contradictory settings."""
    columns: list[list[MappedColumn]] = [[] for _ in form.tables]
    for quantity in form.quantities:
        letters, unit = quantity.column.strip().upper(), "" if quantity.unit == "NONE" else quantity.unit
        if letters and quantity.table > len(columns):
            raise InputError(f"{quantity.name} is in table {quantity.table}, expected 1 to {len(columns)}")
        if letters:
            columns[quantity.table - 1].append(MappedColumn(quantity.name, letters, unit))
    tables = []
    for i, table in enumerate(form.tables):
        is_single_row = i > 0 and table.rows == "ONE_FOR_ALL"
        tables.append(
            MappedTable(
                sheet=table.sheet,
                first_row=table.first_row,
                last_row=table.first_row if is_single_row else table.last_row,
                columns=tuple(columns[i]),
                number=None if is_single_row else table.number.strip().upper() or None,
                rows=None if i == 0 else table.rows.lower().replace("_", " "),
                header_row=table.header_row or None,
                skip_rows=() if is_single_row else _parse_rows(table.skip_rows, i),
            )
        )
    return ColumnMap(tuple(tables))


def update(form: ColumnMapProperties) -> None:
    """Read the workbook with the settings, and show the modules' numbers or the reason for its refusal."""
    if not form.filled:
        return
    workbook = Path(form.workbook)
    form.refusal = form.preview = form.remarks = ""
    try:
        for quantity in form.quantities:
            quantity.seen = _column_preview(form, quantity, workbook)
        with recording.recorded_warnings() as warnings:
            form.n_modules, rows = _preview_modules(workbook, column_map(form))
        form.preview, form.remarks = json.dumps(rows), json.dumps(list(warnings))
    except InputError as error:
        form.refusal = str(error)


def _preview_modules(workbook: Path, columns: ColumnMap) -> tuple[int, list[list[str]]]:
    """Return the number of modules, and headings with the numbers, mm, of the first modules and the last."""
    system = read_system(workbook, columns)
    shown_columns = [c for c in system.columns.values() if c.name == "b" or not (c.derived or c.is_unused(system))]
    values = zip(*(c.values(system).tolist() for c in shown_columns), strict=True)
    rows = [
        [str(module), *(value if isinstance(value, str) else f"{value:.3f}" for value in row)]
        for module, row in zip(system.numbers.tolist(), values, strict=True)
    ]
    if len(rows) > _PREVIEW_MODULES + 2:
        rows[_PREVIEW_MODULES:-1] = [["..."] * len(rows[0])]
    return len(system), [["Module", *(c.name for c in shown_columns)], *rows]


def accept(form: ColumnMapProperties) -> ColumnMap:
    """Return the column map that the settings describe, and save it where they ask for that; raise the reader's refusal."""
    update(form)
    if form.refusal:
        raise InputError(form.refusal)
    columns = column_map(form)
    if form.save_as.strip():
        path = Path(form.workbook).parent / bpy.path.abspath(form.save_as.strip())
        if path.suffix.lower() != ".toml":
            raise InputError(f"{path}: expected a name ending in .toml")
        if path.exists():
            raise InputError(f"{path}: exists already, expected a new name")
        columns.write(path, f"Columns of {Path(form.workbook).name}.")
    return columns


def _parse_rows(text: str, i: int) -> tuple[int, ...]:
    """Return the rows that a text such as "43, 50-52" lists; `i` is the table's index for the message."""
    rows: set[int] = set()
    for part in filter(None, (part.strip() for part in text.split(","))):
        first, _, last = part.partition("-")
        with expecting(f"table {i + 1}: skip rows {text!r}, expected numbers such as 43, 50-52"):
            rows.update(range(int(first), int(last or first) + 1))
    return tuple(sorted(rows))


def _cells(workbook: Path) -> dict[str, tuple[tuple[str, ...], ...]]:
    """Return the texts of each sheet by its name, row by row; the file is read again only when it has changed."""
    # For a missing file the reader raises the error.
    return _read_cells(workbook, workbook.stat().st_mtime_ns if workbook.is_file() else 0)


def _column_preview(form: ColumnMapProperties, quantity: ColumnMapQuantity, workbook: Path) -> str:
    """Return the heading and the first number in a quantity's column."""
    from openpyxl.utils import column_index_from_string

    letters = quantity.column.strip().upper()
    if quantity.name == "l" and not letters:
        return "(by the design formula)"
    if quantity.table > len(form.tables):
        return ""
    table = form.tables[quantity.table - 1]
    try:
        column = column_index_from_string(letters) - 1
    except ValueError:
        return ""
    cells = _cells(workbook).get(table.sheet, ())
    rows = [cells[row - 1] for row in (table.header_row, table.first_row) if 0 < row <= len(cells)]
    return ": ".join(row[column] for row in rows if column < len(row) and row[column])
