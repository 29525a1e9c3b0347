"""The column map dialog's settings: filled with a draft, read as a `ColumnMap`, previewed as the reader reads it.

They live on the window manager while the dialog is open. Nothing is read from the workbook while the dialog is drawn: a
setting that changes calls `update`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import bpy
import numpy as np
from bpy.props import BoolProperty, CollectionProperty, EnumProperty, IntProperty, StringProperty

from ..core.errors import InputError
from ..core.recording import recorded_warnings
from ..core.workbook import ColumnMap, MappedColumn, MappedTable, draft_column_map, preview_workbook, read_system
from ..core.workbook.quantities import ANGLE_UNITS, LENGTH_UNITS, NEEDED, QUANTITIES
from . import choices, ids

MAX_TABLES = 9
_ALWAYS = (*NEEDED, "l")
_FIRST = 3  # modules previewed at the top
_SEEN = 80  # rows and columns whose texts are shown beside the settings


def settings(context: bpy.types.Context) -> ColumnMapProperties:
    """The settings of the dialog."""
    return getattr(context.window_manager, ids.WINDOW_COLUMNS)


def _changed(self: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    update(settings(context))


def _number_of_tables_changed(self: ColumnMapProperties, context: bpy.types.Context) -> None:
    if not self.filled:
        return
    while len(self.tables) > self.n_tables:
        self.tables.remove(len(self.tables) - 1)
    while len(self.tables) < self.n_tables:
        last = self.tables[-1]
        values = {name: getattr(last, name) for name in ("sheet", "header_row", "first_row", "last_row", "number")}
        _set(self.tables.add(), values)
    update(self)


def _unit_of_all_changed(self: ColumnMapProperties, context: bpy.types.Context) -> None:
    if not self.filled:
        return
    self.filled = False
    for quantity in self.quantities:
        if QUANTITIES[quantity.name].kind == "length":
            quantity.unit = self.unit
    self.filled = True
    update(self)


def _sheets(self: ColumnMapTable, context: bpy.types.Context, edit_text: str) -> list[str]:
    return json.loads(settings(context).sheets or "[]")


def _units(*tables: Iterable[str]) -> choices.Items:
    units = [(unit, unit, "") for table in tables for unit in table]
    return choices.items(choices.UNITS, [("NONE", "?", "Not known"), *units])


class ColumnMapTable(bpy.types.PropertyGroup):
    """Rows of a sheet (`MappedTable`)."""

    sheet: StringProperty(name="Sheet", description="Name of the sheet", search=_sheets, update=_changed)
    header_row: IntProperty(
        name="Header Row", description="Row of the headings that are shown below; they are not read. 0: none", min=0,
        update=_changed,
    )  # fmt: skip
    first_row: IntProperty(name="First Row", description="Row of the first module", default=2, min=1, update=_changed)
    last_row: IntProperty(name="Last Row", description="Row of the last module", default=2, min=1, update=_changed)
    skip_rows: StringProperty(
        name="Skip Rows", description="Rows between these that are of no module, such as 43, 50-52", update=_changed
    )
    number: StringProperty(
        name="Number Column",
        description="Letters of the column of the modules' numbers or names. Empty: row by row 1, 2, ...", update=_changed,
    )  # fmt: skip
    rows: EnumProperty(
        name="Rows",
        description="How the rows belong to those of table 1",
        items=choices.items(
            choices.JOINED,
            (
                ("BY_NUMBER", "By Number", "A row is of the module whose number, or name, it has"),
                ("IN_ORDER", "In Order", "The first row is of the first module, and so on"),
                ("ONE_FOR_ALL", "One for All", "The first row holds what all modules share"),
            ),
        ),
        default="BY_NUMBER",
        update=_changed,
    )


class ColumnMapQuantity(bpy.types.PropertyGroup):
    """The column of a quantity (`MappedColumn`)."""

    name: StringProperty(name="Quantity", description="Its symbol")
    table: IntProperty(name="Table", description="Which table its column is in", default=1, min=1, max=MAX_TABLES,
                       update=_changed)  # fmt: skip
    column: StringProperty(name="Column", description="The column's letters. Empty: none", update=_changed)
    unit: EnumProperty(
        name="Unit", description="Of the numbers in the column",
        items=_units(LENGTH_UNITS, ANGLE_UNITS), default="NONE", update=_changed,
    )  # fmt: skip
    seen: StringProperty(name="Seen", description="The column's heading and first number in the workbook")


class ColumnMapProperties(bpy.types.PropertyGroup):
    """The dialog's settings and what they give; `WindowManager.mphdrr_columns`."""

    filled: BoolProperty(name="Filled", description="A change of a setting updates the preview", options={"HIDDEN"})
    workbook: StringProperty(name="Workbook", description="File that the settings are of", subtype="FILE_PATH")
    sheets: StringProperty(name="Sheets", description="Names of its sheets, JSON", options={"HIDDEN"})
    doubts: StringProperty(name="Doubts", description="What the reader did not understand, JSON", options={"HIDDEN"})
    n_tables: IntProperty(
        name="Tables", description="Ranges of rows: the first holds x1, y1 and z1, further ones the dimensions",
        default=2, min=1, max=MAX_TABLES, update=_number_of_tables_changed,
    )  # fmt: skip
    unit: EnumProperty(
        name="All Lengths In", description="Changing it sets the unit of every length below",
        items=_units(LENGTH_UNITS), default="NONE", update=_unit_of_all_changed,
    )  # fmt: skip
    tables: CollectionProperty(type=ColumnMapTable, name="Tables")
    quantities: CollectionProperty(type=ColumnMapQuantity, name="Quantities")
    save_as: StringProperty(
        name="Save Map As", description="Also write the column map to this new .toml file. Without a folder: beside the "
        "workbook",
    )  # fmt: skip
    refusal: StringProperty(name="Refusal", description="Why the workbook cannot be read so")
    remarks: StringProperty(name="Remarks", description="The reader's warnings, JSON", options={"HIDDEN"})
    n_modules: IntProperty(name="Modules", description="How many are read", min=0)
    preview: StringProperty(
        name="Preview", description="Headings, then rows of numbers as they are read, JSON", options={"HIDDEN"}
    )


CLASSES = (ColumnMapTable, ColumnMapQuantity, ColumnMapProperties)


def fill(form: ColumnMapProperties, workbook: Path, columns: ColumnMap | None = None) -> bool:
    """Fill the settings with a column map, or with a draft of what is seen in the workbook.

    Returns
    -------
    bool
        Whether the dialog can help: something in the workbook is not understood without a map, or one was given.

    Raises
    ------
    InputError
        The file is no workbook; the settings are then empty.
    """
    clear(form)
    draft = draft_column_map(workbook)
    said = draft.columns if columns is None else columns
    faults = draft.columns.faults()
    form.workbook, form.sheets = str(workbook), json.dumps(list(_cells(workbook)))
    form.doubts = json.dumps([question for question in draft.questions if question not in faults])
    for table in said.tables[:MAX_TABLES]:
        values = {
            "sheet": table.sheet, "header_row": table.header_row or 0, "first_row": table.first_row,
            "last_row": table.last_row, "skip_rows": ", ".join(map(str, table.skip_rows)), "number": table.number or "",
        }  # fmt: skip
        if table.rows is not None:
            values["rows"] = table.rows.upper().replace(" ", "_")
        _set(form.tables.add(), values)
    if not form.tables:
        form.tables.add()
    found = {c.quantity: (i, c) for i, table in enumerate(said.tables[:MAX_TABLES], start=1) for c in table.columns}
    for name in dict.fromkeys((*_ALWAYS, *(name for name in found if name in QUANTITIES))):
        quantity = form.quantities.add()
        quantity.name = name
        quantity.table = 1 if name in _ALWAYS[:3] else len(form.tables)
        if name in found:
            quantity.table, column = found[name]
            quantity.column = column.column
            quantity.unit = column.unit if column.unit in choices.UNITS else "NONE"
    form.n_tables = len(form.tables)
    form.filled = True
    update(form)
    return bool(draft.questions) or columns is not None


def clear(form: ColumnMapProperties) -> None:
    """Empty the settings: they are of no workbook."""
    form.filled = False
    for prop in form.bl_rna.properties:
        if not prop.is_readonly or prop.type == "COLLECTION":
            form.property_unset(prop.identifier)


def column_map(form: ColumnMapProperties) -> ColumnMap:
    """The column map that the settings say, complete or not; `InputError` where they cannot be understood."""
    found: list[list[MappedColumn]] = [[] for _ in form.tables]
    for quantity in form.quantities:
        if not quantity.column.strip():
            continue
        if quantity.table > len(found):
            raise InputError(f"{quantity.name} is in table {quantity.table}, expected 1 to {len(found)}")
        unit = "" if quantity.unit == "NONE" else quantity.unit
        found[quantity.table - 1].append(MappedColumn(quantity.name, quantity.column.strip().upper(), unit))
    tables = []
    for i, (table, columns) in enumerate(zip(form.tables, found, strict=True)):
        one = i > 0 and table.rows == "ONE_FOR_ALL"
        tables.append(
            MappedTable(
                sheet=table.sheet,
                first_row=table.first_row,
                last_row=table.first_row if one else table.last_row,
                columns=tuple(columns),
                number=None if one else table.number.strip().upper() or None,
                rows=None if i == 0 else table.rows.lower().replace("_", " "),
                header_row=table.header_row or None,
                skip_rows=() if one else _rows(table.skip_rows, i),
            )
        )
    return ColumnMap(tuple(tables))


def update(form: ColumnMapProperties) -> None:
    """Read the workbook by the settings: the preview, or why it is refused."""
    if not form.filled:
        return
    workbook = Path(form.workbook)
    form.refusal = form.preview = form.remarks = ""
    try:
        for quantity in form.quantities:
            quantity.seen = _seen(form, quantity, workbook)
        with recorded_warnings() as warned:
            form.n_modules, rows = preview(workbook, column_map(form))
        form.preview = json.dumps(rows)
        form.remarks = json.dumps(list(warned))
    except InputError as error:
        form.refusal = str(error)


def preview(workbook: Path, columns: ColumnMap) -> tuple[int, list[list[str]]]:
    """How many modules the map has read; headings, then the numbers of the first modules and the last, mm.

    Raises
    ------
    InputError
        What the reader says of a workbook that it refuses.
    """
    system = read_system(workbook, columns)
    lengths = [
        *system.centers.T, system.pinhole_distance, system.pinhole_diameter, system.roi_radius, system.detector_side,
        system.detector_thickness, system.collimator_length,
    ]  # fmt: skip
    rows = [
        [str(number), *(f"{value:.3f}" for value in values)]
        for number, *values in zip(system.numbers.tolist(), *(np.asarray(x).tolist() for x in lengths), strict=True)
    ]
    if len(rows) > _FIRST + 1:
        rows[_FIRST:-1] = [["..."] * len(rows[0])] if len(rows) > _FIRST + 2 else rows[_FIRST:-1]
    return len(system), [["Module", "x1", "y1", "z1", "b", "d", "R", "Ld", "Td", "l"], *rows]


def accept(form: ColumnMapProperties) -> ColumnMap:
    """The column map that the settings say, by which the workbook can be read; saved, where they ask for that.

    Raises
    ------
    InputError
        The workbook is refused, or the map cannot be saved.
    """
    update(form)
    if form.refusal:
        raise InputError(form.refusal)
    columns = column_map(form)
    if form.save_as.strip():
        path = Path(form.workbook).parent / bpy.path.abspath(form.save_as.strip())
        if path.suffix.lower() != ".toml":
            raise InputError(f"{path}: expected a name ending in .toml")
        if path.exists():
            raise InputError(f"{path}: is there already, expected a new name")
        columns.write(path, f"Columns of {Path(form.workbook).name}.")
    return columns


def _set(group: bpy.types.PropertyGroup, values: dict[str, object]) -> None:
    for name, value in values.items():
        setattr(group, name, value)


def _rows(text: str, i: int) -> tuple[int, ...]:
    """The rows that a text such as "43, 50-52" lists."""
    rows: set[int] = set()
    for part in filter(None, (part.strip() for part in text.split(","))):
        first, _, last = part.partition("-")
        try:
            rows.update(range(int(first), int(last or first) + 1))
        except ValueError:
            raise InputError(f"table {i + 1}: skip rows {text!r}, expected numbers such as 43, 50-52") from None
    return tuple(sorted(rows))


@lru_cache(maxsize=1)
def _shown(workbook: Path, changed: int) -> dict[str, tuple[tuple[str, ...], ...]]:
    return preview_workbook(workbook, _SEEN, _SEEN)


def _cells(workbook: Path) -> dict[str, tuple[tuple[str, ...], ...]]:
    try:
        changed = workbook.stat().st_mtime_ns
    except OSError:
        changed = 0  # what is wrong with it, the reader says
    return _shown(workbook, changed)


def _seen(form: ColumnMapProperties, quantity: ColumnMapQuantity, workbook: Path) -> str:
    """What stands in a quantity's column, as far as it is shown: the heading and the first number."""
    from openpyxl.utils import column_index_from_string

    if quantity.name == "l" and not quantity.column.strip():
        return "(by the design formula)"
    if quantity.table > len(form.tables):
        return ""
    table = form.tables[quantity.table - 1]
    try:
        column = column_index_from_string(quantity.column.strip().upper())
    except ValueError:
        return ""
    rows = _cells(workbook).get(table.sheet, ())
    texts = [
        rows[row - 1][column - 1] for row in (table.header_row, table.first_row) if 0 < row <= len(rows)
        and column <= len(rows[row - 1])
    ]  # fmt: skip
    return ": ".join(filter(None, texts))
