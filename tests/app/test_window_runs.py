"""A module that is moved makes the run stale in the window, undo makes it current; the difference of two runs is seen."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

SCRIPT = Path(__file__).with_name("window_runs.py")


def test_stale_runs_are_said_and_compared_in_the_window(blender_window, work_folder):
    result_file = work_folder / "seen.json"
    picture = blender_window(SCRIPT.read_text(encoding="utf-8"), result_file)
    seen = json.loads(result_file.read_text())
    assert seen["ok"], seen
    moved = ["Module 30 moved"]
    said = [seen[when] for when in ("loaded", "moved", "undone", "moved again", "rendered", "chosen")]
    assert said == [[], moved, [], moved, [], moved]
    assert seen["handler ms"] < 0.1, "of each update of the scene, selecting included"
    assert seen["shown"] == "As imported" and len(seen["runs"]) == 2
    assert seen["image"] == "mphDRR difference"
    screen = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    left, top, width, height = seen["editor"]
    letters = np.abs(screen[top : top + height, left : left + width] - (255, 115, 89)).max(axis=2) < 12
    assert letters.sum() > 100, "a line over the picture says it, in this colour"
