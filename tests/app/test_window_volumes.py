"""What volumes are is seen in the window: spheres in NEMA's slices, the colours of a map."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

SCRIPT = Path(__file__).with_name("window_volumes.py")


def test_slices_shells_and_maps(blender_window, work_folder):
    result = work_folder / "seen.json"
    blender_window(SCRIPT.read_text(encoding="utf-8"), result, work_folder)
    seen = json.loads(result.read_text())
    assert seen["ok"], seen
    left, top, right, bottom = seen["frame"]

    def picture(name: str) -> np.ndarray:
        """The middle of the 3D view, away from its buttons."""
        screen = np.asarray(Image.open(work_folder / f"{name}.png").convert("RGB")).astype(int)
        return screen[top + 60 : bottom - 20, left + 170 : right - 60]

    def colored(name: str, saturation: float = 0.15) -> tuple[np.ndarray, np.ndarray]:
        """Hue in degrees, and where a picture has colours."""
        hsv = np.asarray(Image.fromarray(picture(name).astype(np.uint8)).convert("HSV")).astype(float)
        return hsv[..., 0] * 360 / 255, (hsv[..., 1] > 255 * saturation) & (hsv[..., 2] > 60)

    def parts(name: str) -> int:
        hue, where = colored(name)
        labels, _ = ndimage.label(where & (hue > 255) & (hue < 350))
        return int((np.bincount(labels.ravel())[1:] > 20).sum())

    assert parts("slice") == 6, "a slice of NEMA shows six spheres"
    assert parts("shell") == 6 and parts("heart") == 1
    before, after = seen["dragged"]
    assert after[:2] == before[:2] and 5 <= after[2] - before[2] <= 15, "the slice follows the mouse"
    assert seen["undone"] == [after[2], True, True], "undo brings back what was painted"
    hue, where = colored("map")
    counts = np.bincount(hue[where & (hue > 55) & (hue < 205)].astype(int), minlength=360)
    assert (counts >= 5).sum() >= 20, "a map in Solid view has at least 20 hues"
    screen = np.asarray(Image.open(work_folder / "map.png").convert("RGB")).astype(int)
    x, y, width, height = seen["bar"]
    bar = screen[round(y) : round(y + height), round(x + width / 2)]
    assert len(np.unique(bar, axis=0)) > 50 and bar[0].sum() > bar[-1].sum() + 200, "its colour bar, brighter upwards"
