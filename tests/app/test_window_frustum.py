"""A phantom as a module sees it, a frustum of pictures, and a back-projection, in the window."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

SCRIPT = Path(__file__).with_name("window_frustum.py")


def test_a_frustum_and_a_back_projection_are_seen(blender_window, work_folder):
    result_file = work_folder / "seen.json"
    last = blender_window(SCRIPT.read_text(encoding="utf-8"), result_file, str(work_folder))
    seen = json.loads(result_file.read_text())
    assert seen["ok"], seen
    assert len(seen["shown"]) == 13 and seen["active"] == "Derenzo"
    corners = np.array(seen["corners"])
    assert purple(work_folder / "aside.png", corners.min(axis=0), corners.max(axis=0)) > 3000
    # From the pinhole, all layers lie on one another, in the frame of what the camera sees.
    layers, frame = np.array(seen["through"]).reshape(12, 4, 2), np.array(seen["frame"])
    assert np.abs(layers - layers[0]).max() <= 1
    assert np.abs(layers[0].min(axis=0) - frame.min(axis=0)).max() <= 2
    assert np.abs(layers[0].max(axis=0) - frame.max(axis=0)).max() <= 2
    assert purple(work_folder / "pinhole.png", frame.min(axis=0), frame.max(axis=0)) > 10000
    assert seen["kept"] == "Derenzo through Module 27"
    assert seen["backprojected"].endswith("Geometric Mean")
    x, y = seen["middle"]
    found = np.asarray(Image.open(last).convert("RGB")).astype(int)[y - 80 : y + 80, x - 100 : x + 100]
    assert ((found[..., 1] > found[..., 0] + 30) & (found[..., 1] > 80)).sum() > 1000, "slices in greens"


def purple(picture: Path, low: np.ndarray, high: np.ndarray) -> int:
    """How many pixels between two places have the colours of activity."""
    screen = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    red, green, blue = np.moveaxis(screen[low[1] : high[1], low[0] : high[0]], 2, 0)
    return int(((blue > green + 30) & (red > green + 30)).sum())
