"""A reconstruction in the window is seen while it runs; Finish Now keeps it, with its score and slices."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

SCRIPT = Path(__file__).with_name("window_reconstruction.py")


def test_a_reconstruction_is_seen_while_it_runs(blender_window, work_folder):
    result_file = work_folder / "seen.json"
    picture = blender_window(SCRIPT.read_text(encoding="utf-8"), result_file)
    seen = json.loads(result_file.read_text())
    assert seen["ok"], seen
    first, second = seen["iterations"]
    assert 1 <= first < second < 20000
    assert seen["while"] == seen["volume"] == seen["active"] and seen["volume"].endswith("OSEM")
    assert seen["title"].startswith("OSEM, ") and seen["scores"][:2] == ["NRMSE", "8 mm rods"]
    assert seen["image"] == "mphDRR reconstruction"
    screen = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    left, top, width, height = seen["editor"]
    page = screen[top : top + height, left : left + width]
    assert (np.abs(page - (252, 255, 164)).max(axis=2) < 12).sum() > 50, "hot rods"
    assert (np.abs(page - (200, 68, 43)).max(axis=2) < 40).sum() > 10, "the objective"
