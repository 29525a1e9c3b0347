"""The live preview in the window: what it takes of the main thread, and that it is what the projector says."""

import json
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("window_preview.py")


@pytest.mark.alone
def test_a_live_preview_follows_module_phantom_and_numbers(blender_window, work_folder):
    result_file = work_folder / "seen.json"
    blender_window(SCRIPT.read_text(encoding="utf-8"), result_file)
    seen = json.loads(result_file.read_text())
    assert seen["ok"], seen
    assert seen["off"]["median"] < 0.2
    assert seen["on"]["median"] <= 25, seen
    assert seen["quick"] > 35 and seen["full"], "few pixels while it moves, all of them at rest"
    assert seen["largest"] > 0 and seen["differs"] < 2e-5 and seen["same place"]
    assert seen["typed"] == 60 and seen["unit"] == "counts" and seen["images"]
    assert "pinhole_diameter" in seen["impossible"] and seen["again"] == ""
    assert seen["picked"] == [False, 0.0, True], "the eyedropper's click set the window's high end to an exact number"
