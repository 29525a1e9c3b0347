"""Event sets in the window: another one on the phantom, a set made, cancelled and gone on with, an event opened."""

import json
from pathlib import Path

SCRIPT = Path(__file__).with_name("window_events.py")


def test_events_are_tried_made_and_opened(blender_window, work_folder):
    result_file = work_folder / "seen.json"
    blender_window(SCRIPT.read_text(encoding="utf-8"), result_file)
    seen = json.loads(result_file.read_text())
    assert seen["ok"], seen
    assert seen["note"] == ["derenzo, defrise; lines; Radon 32; 64³ voxels of 1.5 mm", False]
    assert seen["numbers"] == [1, 2, 3] and len(set(map(str, seen["poses"]))) == 3
    assert seen["undone"] == seen["poses"][1] and seen["number_undone"] == 2
    assert 0 < seen["after_cancel"] < 12 and seen["made"] == 12 and seen["kept"]
    assert any(text.startswith("Making events") and text.endswith(" left") for text in seen["words"]), seen["words"]
    assert min(seen["pauses"]) < 0.1, "the window stands still"
    assert seen["opened"].startswith("Event 3 ") and seen["run"] == seen["opened"] + ", lines"
    assert seen["image"] == "mphDRR mosaic" and seen["changes"] == []
