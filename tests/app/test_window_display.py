"""The example in one click; a click on a tile makes its module active."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

SCRIPT = Path(__file__).with_name("window_display.py")


@pytest.mark.alone
def test_the_example_is_seen_and_tiles_planes_list_and_mosaic_show_one_module(blender_window, work_folder):
    result_file = work_folder / "seen.json"
    picture = blender_window(SCRIPT.read_text(encoding="utf-8"), result_file)
    seen = json.loads(result_file.read_text())
    assert seen["ok"], seen
    log = (work_folder / "log.txt").read_text()
    assert not [word for word in ("Traceback", "Error", "mphDRR:") if word in log], log
    assert seen["seconds"] < 15 and seen["hidden"] == ["Camera", "Cube", "Light"]
    assert seen["clicked"] == [30, 30] and seen["selected"] == [55, 55] and seen["planes"] == 80
    screen = np.asarray(Image.open(picture).convert("RGB")).astype(int)

    def lit(tile) -> float:
        """The share of a tile's left edge that is white."""
        left, top, _, bottom = map(round, tile)
        return float((screen[top + 4 : bottom - 4, left - 2 : left + 3].min(axis=2).max(axis=1) > 200).mean())

    tiles = [
        screen[round(top) : round(bottom), round(left) : round(right)] for left, top, right, bottom in seen["tiles"]
    ]
    assert min((tile[15:].max(axis=2) > 90).mean() for tile in tiles) > 0.05, "every tile shows the phantom"
    assert lit(seen["tile"]) > 0.9 and lit(seen["other"]) < 0.3, "the active module's tile has a frame"
