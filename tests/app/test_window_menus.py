"""The menus' search finds and starts our commands, by words of the field."""

import json
from pathlib import Path

SCRIPT = Path(__file__).with_name("window_menus.py")
WORKBOOK = Path(__file__).parents[2] / "examples" / "dc-spect-80.xlsx"


def test_commands_are_found_and_started_by_search(blender_window, work_folder):
    result_file = work_folder / "seen.json"
    blender_window(SCRIPT.read_text(encoding="utf-8"), WORKBOOK, result_file)
    seen = json.loads(result_file.read_text())
    assert seen["ok"], seen
    assert seen["before"] == [False, "TRANSMISSION"] and seen["after"] == [True, "EMISSION"]
