"""Design in the window: the module follows while it is moved, undo and redo, Blender's own copying and deleting."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("window_design.py")
WORKBOOK = Path(__file__).resolve().parents[2] / "examples" / "dc-spect-80.xlsx"


def close(one: dict, other: dict) -> None:
    assert one.keys() == other.keys()
    for name, value in one.items():
        assert other[name] == pytest.approx(value, rel=1e-5), name


def consistent(state: dict) -> None:
    assert state["aimed"]
    assert state["crystal"] == pytest.approx(state["collimator_length"], rel=1e-6)
    assert state["lens"] == pytest.approx(state["collimator_length"] / 50.0, rel=1e-6)
    assert sum(x * x for x in state["place"]) ** 0.5 == pytest.approx(state["pinhole_distance"], rel=1e-6)


def test_modules_follow_in_the_window(blender_window, work_folder):
    result = work_folder / "result.json"
    blender_window(SCRIPT.read_text(encoding="utf-8"), WORKBOOK, result)
    seen = json.loads(result.read_text())
    assert seen["ok"], seen
    before = seen["before"]
    for name in ("before", "moved", "translated", "moving"):
        consistent(seen[name])
    assert seen["moved"]["place"] == pytest.approx([before["place"][0] + 30, *before["place"][1:]], abs=1e-4)
    assert seen["moving"]["place"][0] == pytest.approx(before["place"][0] + 40, abs=1e-4)
    assert seen["moved"]["sensitivity"] < 0.95 * before["sensitivity"] and seen["moved"]["total"] < before["total"]
    for name in ("undone", "translated_undone"):
        close(seen[name], before)
    close(seen["redone"], seen["moved"])

    everyone = list(range(1, 81))
    assert seen["copied"]["numbers"] == [*everyone, 81] and seen["copied"]["parts"] == 162
    consistent(seen["copied"]["state"])
    assert seen["adoption_undone"] == {"numbers": sorted([*everyone, 3]), "untidy": "1 copied camera"}
    assert seen["copy_undone"] == {"numbers": everyone, "parts": 160, "untidy": ""}
    assert seen["deleted"] == {"numbers": [n for n in everyone if n != 5], "parts": 158}
    assert seen["delete_undone"]["numbers"] == everyone and seen["delete_undone"]["parts"] == 160
    consistent(seen["delete_undone"]["state"])
