"""The Rendered view of an imported scanner is neither black nor bleached."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image

SCRIPT = Path(__file__).with_name("window_rendered.py")


def test_the_rendered_view_shows_the_scanner(blender_window, work_folder):
    result = work_folder / "seen.json"
    screen = blender_window(SCRIPT.read_text(encoding="utf-8"), result)
    seen = json.loads(result.read_text())
    assert seen["ok"], seen
    left, top, right, bottom = seen["frame"]
    view = (
        np.asarray(Image.open(screen).convert("L")).astype(float)[top + 30 : bottom - 60, left + 30 : right - 30] / 255
    )
    scanner = view[np.abs(view - np.median(view)) > 0.03]
    assert 0.15 < view.mean() < 0.6 and 0.15 < scanner.mean() < 0.6
    assert scanner.size > 0.08 * view.size, "the scanner stands out from the world"
    assert scanner.std() > 0.1, "it has lit sides and sides in shadow"
