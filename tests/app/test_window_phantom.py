"""Phantoms in the window: settings that are dragged cost no time, their voxels come by themselves, undo keeps all whole."""

from __future__ import annotations

import json
from pathlib import Path

SCRIPT = Path(__file__).with_name("window_phantom.py")


def test_phantom_follows_its_slider_and_beats_in_the_window(blender_window, work_folder):
    result = work_folder / "result.json"
    blender_window(SCRIPT.read_text(encoding="utf-8"), result, seconds=75)
    seen = json.loads(result.read_text())
    assert seen["ok"], seen
    before, rested = seen["before"], seen["rested"]
    assert seen["dragging"]["sketched"] and seen["dragging"]["shape"] == [32, 32, 32]
    assert seen["dragging"]["size"] == rested["size"]
    assert seen["seconds"][len(seen["seconds"]) // 2] < 0.1
    for name, length in (("rested", 260), ("redone", 260), ("undone", 180), ("undone again", 180)):
        assert seen[name]["length"] == length and seen[name]["shape"] == [100, 100, 100] and seen[name]["loads"]
        assert not seen[name]["outdated"] and len(seen[name]["planes"]) == 3
    assert seen["undone"] == seen["undone again"] == before
    assert seen["redone"]["size"] == rested["size"]
    assert seen["frames"] == [1, 2, 3]
