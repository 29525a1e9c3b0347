"""A very small benchmark runs, and its plain C reference is right."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "projector.py"


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no compiler cc")
@pytest.mark.long
def test_plain_c_integrates_the_same(tmp_path):
    size = ["--voxels", "16", "--pixels", "8", "--views", "2", "--rounds", "1", "--no-growth"]
    command = [sys.executable, str(SCRIPT), "--only", "c", *size, "--output", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "benchmarks.md").read_text().splitlines()
    head, _, *rows = (line.strip("| ").split(" | ") for line in page if line.startswith("|"))
    row = dict(zip(head, rows[0], strict=True))
    assert row["projector"] == "plain C, OpenMP" and float(row["forward ms"]) > 0 and float(row["emission ms"]) > 0
    assert float(row["error"]) < 1e-5 and float(row["offset px"]) < 1e-3 and float(row["mismatch"]) < 1e-5


@pytest.mark.long
def test_event_sets_are_measured_and_the_page_keeps_the_rest(tmp_path):
    page = tmp_path / "benchmarks.md"
    page.write_text("# Benchmarks\n\nkept\n\n## Event sets\n\nold\n")
    size = ["--voxels", "64", "--pixels", "8", "--events", "2", "--no-pipeline"]
    command = [sys.executable, str(SCRIPT.with_name("events.py")), *size, "--output", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    text = page.read_text()
    assert text.startswith("# Benchmarks\n\nkept\n\n## Event sets\n") and "old" not in text
    head, _, *rows = (line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|"))
    found = [dict(zip(head, row, strict=True)) for row in rows]
    assert {row["images"] for row in found} == {"line integrals", "emission"}
    assert all(float(row["s an event"]) > 0 and float(row["MB an event"]) > 0 for row in found)
