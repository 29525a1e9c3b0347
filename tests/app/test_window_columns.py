"""The column map dialog in the window, from a workbook that is refused to the scanner."""

from __future__ import annotations

import json
from pathlib import Path

import openpyxl

from mphdrr.core.workbook import ColumnMap

SCRIPT = Path(__file__).with_name("window_columns.py")
WORKBOOK = Path(__file__).resolve().parents[2] / "examples" / "dc-spect-80.xlsx"


def test_a_refused_workbook_is_imported_by_its_columns(blender_window, work_folder):
    book = openpyxl.load_workbook(WORKBOOK, data_only=True)
    sheet = book["Coordinates"]
    sheet.delete_cols(5, sheet.max_column)
    for column, axis in enumerate("xyz", start=2):
        sheet.cell(1, column, f"Position {axis} (Zentimeter)")
        sheet.cell(2, column).value = None
        for row in range(3, 83):
            sheet.cell(row, column).value /= 10
    path = work_folder / "zentimeter.xlsx"
    book.save(path)

    result, pictures = (
        work_folder / "result.json",
        [work_folder / f"{name}.png" for name in ("opened", "complete", "replace")],
    )
    blender_window(SCRIPT.read_text(encoding="utf-8"), path, result, *pictures)
    seen = json.loads(result.read_text())
    assert seen["ok"], seen
    assert seen["opened"]["refusal"] and "x1" in seen["opened"]["doubts"]
    assert seen["asked_again"]["refusal"] and seen["asked_again"]["scanners"] == 0
    assert seen["settled"]["refusal"] == "" and '"277.002"' in seen["settled"]["preview"]
    units = {c.quantity: c.unit for table in ColumnMap.from_toml(seen["source"]).tables for c in table.columns}
    assert units == {"x1": "cm", "y1": "cm", "z1": "cm", "d": "mm", "R": "mm", "Ld": "mm", "Td": "mm"}
    assert seen["emptied"] and seen["kept"] and seen["moved_back"]
