"""A projection job in the window: it runs, it can be cancelled, the window stays alive and the scene usable."""

from __future__ import annotations

import json
from pathlib import Path

SCRIPT = Path(__file__).with_name("window_projection_job.py")
WORKBOOK = Path(__file__).resolve().parents[2] / "examples" / "dc-spect-80.xlsx"


def test_job_runs_and_is_cancelled_while_the_window_stays_alive(blender_window, work_folder):
    result = work_folder / "result.json"
    blender_window(SCRIPT.read_text(encoding="utf-8"), result, WORKBOOK, seconds=60)
    seen = json.loads(result.read_text())
    assert seen["ok"], seen["events"]
