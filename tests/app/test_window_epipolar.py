"""A pixel picked in the window, by a click on a tile and on a plane, and the marker dragged to a point source."""

import json
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("window_epipolar.py")


@pytest.mark.alone
def test_the_marker_dragged_to_a_point_is_where_all_modules_see_it(blender_window, work_folder):
    result_file = work_folder / "seen.json"
    blender_window(SCRIPT.read_text(encoding="utf-8"), result_file)
    seen = json.loads(result_file.read_text())
    assert seen["ok"], seen
    log = (work_folder / "log.txt").read_text()
    assert not [word for word in ("Traceback", "Error", "mphDRR:") if word in log], log
    assert seen["picked"][:3] == [30, 37, 26], "the click's pixel"
    wanted, k, steps = seen["k"]
    assert abs(k / wanted - 1) < 0.01 and steps > 5 and seen["moved"] > 1, "the slider was dragged"
    off = [each for each in seen["off"] if each is not None]
    assert len(off) == seen["seen by"] > 60 and max(off) < 1, "pixels between the marker and the point's image"
    assert seen["on plane"] == seen["target"][0]
    assert seen["ms for each k"] < 20 and max(seen["ms to draw"]) < 50
