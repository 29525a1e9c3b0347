"""Phantoms in the window: dragging a setting does not block, voxels follow when it rests, undo restores the old ones."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("window_phantom.py")


@pytest.mark.alone
def test_phantom_follows_its_slider_and_beats_in_the_window(blender_window, work_folder):
    result = work_folder / "result.json"
    blender_window(SCRIPT.read_text(encoding="utf-8"), result)
    seen = json.loads(result.read_text())
    assert seen["ok"], seen
    before, rested = seen["before"], seen["rested"]
    assert seen["dragging"]["outdated"] and seen["dragging"]["file"] == before["file"]
    assert seen["seconds"][len(seen["seconds"]) // 2] < 0.1
    for name, length in (("before", 180), ("rested", 260), ("small", 220), ("undone", 180)):
        assert seen[name]["length"] == length and seen[name]["loads"] and not seen[name]["outdated"]
        assert len(seen[name]["planes"]) == 3
    assert rested["file"] != before["file"] and seen["undone"] == before
    assert seen["frames"] == [1, 2, 3]
