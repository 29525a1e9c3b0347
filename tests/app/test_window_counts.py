"""Measured counts become the shown run of the window; its file browser asks for what is not said."""

import json
from pathlib import Path

SCRIPT = Path(__file__).with_name("window_counts.py")
WORKBOOK = Path(__file__).parents[2] / "examples" / "dc-spect-80.xlsx"


def test_measured_counts_are_imported_in_the_window(blender_window, work_folder):
    result_file = work_folder / "seen.json"
    blender_window(SCRIPT.read_text(encoding="utf-8"), WORKBOOK, result_file)
    seen = json.loads(result_file.read_text())
    assert seen["ok"], seen
    assert seen["browsers"] == 1
    assert seen["runs"] == ["counts.npy, emission"] and seen["image"] == ["mphDRR mosaic"]
    assert seen["said"].startswith("counts.npy, 600 s, frames front+v.") and seen["changes"] == []
