"""Jobs in the window: it stays alive in each, they say what they do, wait for each other, and can be cancelled."""

import json
import re
from pathlib import Path

SCRIPT = Path(__file__).with_name("window_jobs.py")
WORKBOOK = Path(__file__).resolve().parents[2] / "examples" / "dc-spect-80.xlsx"


def test_jobs_leave_the_window_alive_and_are_cancelled_without_a_trace(blender_window, work_folder):
    result = work_folder / "result.json"
    blender_window(SCRIPT.read_text(encoding="utf-8"), result, WORKBOOK, seconds=75)
    seen = json.loads(result.read_text())
    assert seen["ok"], seen
    assert seen["changed"] == []
    assert seen["queue"] == [True, False, False] and seen["added"] == ["C"]
    for words in (r"Voxelizing \d+ of \d+", r"Projecting \d+ of 80", r"Packing \d+ of 160", r".*\d s left"):
        assert any(re.fullmatch(words, text) for text in seen["words"]), words
    late = {name: gaps for name, gaps in seen["gaps"].items() if gaps[0] > gaps[1] + 0.1}
    assert not late, f"longest pause and that of a redraw, s: {late}"
