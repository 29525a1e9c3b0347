"""The main path in the window, and a screenshot of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image

SCRIPT = Path(__file__).with_name("window_main_path.py")
WORKBOOK = Path(__file__).resolve().parents[2] / "examples" / "dc-spect-80.xlsx"


def test_main_path_runs_in_the_window(blender_window, work_folder):
    files = work_folder / "files"
    files.mkdir()
    picture = blender_window(SCRIPT.read_text(encoding="utf-8"), WORKBOOK, files)
    result = json.loads((files / "result.json").read_text())
    assert result["ok"], result
    assert {"run.npz", "scanner.blend", "scanner_mphdrr"} <= set(result["files"])

    # The rods are drawn, also after the first save has moved their .vdb.
    screen = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    x, y = result["phantom_at"]
    red, green, blue = screen[y - 30 : y + 30, x - 30 : x + 30].reshape(-1, 3).T
    assert np.mean((red > 110) & (red - green > 20) & (blue - green > 5)) > 0.3
