"""Jobs in the window: it stays alive in each, they say what they do, wait for each other, and can be cancelled."""

import json
import re
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("window_jobs.py")
WORKBOOK = Path(__file__).resolve().parents[2] / "examples" / "dc-spect-80.xlsx"


@pytest.mark.alone
def test_jobs_leave_the_window_alive_and_are_cancelled_without_a_trace(blender_window, work_folder):
    result = work_folder / "result.json"
    blender_window(SCRIPT.read_text(encoding="utf-8"), result, WORKBOOK)
    seen = json.loads(result.read_text())
    assert seen["ok"], seen
    assert seen["changed"] == [] and seen["undone"] == 0.0
    assert seen["queue"] == [True, False, False] and seen["added"] == ["C"]
    for words in (r"Voxelizing \d+ of \d+", r"Projecting \d+ of 80", r"Packing \d+ of 160", r".*\d s left"):
        assert any(re.fullmatch(words, text) for text in seen["words"]), words
    late = {name: pauses for name, pauses in seen["gaps"].items() if min(pauses) > 0.1}
    assert len(seen["gaps"]) == 5 and not late, f"longest pauses beyond that of a redraw, s: {late}"
