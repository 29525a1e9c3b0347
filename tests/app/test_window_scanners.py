"""Two scanners in the window: a crystal that is grabbed moves its module, in one undo step; the panels follow."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

SCRIPT = Path(__file__).with_name("window_scanners.py")
WORKBOOK = Path(__file__).resolve().parents[2] / "examples" / "dc-spect-80.xlsx"


def test_a_crystal_moves_its_module_and_the_panels_follow(blender_window, work_folder):
    result = work_folder / "result.json"
    blender_window(SCRIPT.read_text(encoding="utf-8"), WORKBOOK, result)
    seen = json.loads(result.read_text())
    assert seen["ok"], seen
    before = seen["before"]
    for name, state in seen.items():
        if isinstance(state, dict):
            assert state["off"] < 1e-3, name
            assert abs(state["distance"]) < 1e-3 and state["aimed"] == (name != "turned"), name

    def moved(name: str) -> list[float]:
        return [x - x0 for x, x0 in zip(seen[name]["place"], before["place"], strict=True)]

    assert moved("moved") == pytest.approx([30, 0, 0], abs=1e-3) == moved("redone")
    assert moved("dragged") == pytest.approx([0, 20, 0], abs=1e-3)
    assert moved("scripted") == pytest.approx([0, 0, 25], abs=1e-3)
    assert moved("turned") == pytest.approx([0, 0, 0], abs=1e-3)
    x, y, z = moved("by_mouse")
    assert abs(x) + abs(y) < 1e-3 and abs(z) > 10 and moved("by_mouse_redone") == pytest.approx([x, y, z], abs=1e-3)
    for name in ("undone", "cancelled", "turned_back", "by_mouse_undone", "scripted_undone"):
        assert moved(name) == pytest.approx([0, 0, 0], abs=1e-3), name
        assert seen[name]["turned"] == pytest.approx(before["turned"], abs=1e-5), name

    assert seen["imported"]["panel"] == "B"
    assert (before["panel"], before["listed"], before["active"]) == ("A", 30, "Crystal 30")
    assert (seen["other"]["panel"], seen["other"]["listed"]) == ("B", 60)
    assert seen["back"]["panel"] == "B"
    whole, without, again = seen["counts"]
    assert again == whole
    gone = {kind: whole[kind] - without[kind] for kind in whole}
    assert gone == {"objects": 241, "meshes": 161, "cameras": 80, "materials": 0, "collections": 5}

    start, looking, undone, redone = seen["views"]
    assert undone == start != looking == redone, "the view of before the import comes back"
    assert seen["middle"] == pytest.approx([0.5, 0.5], abs=0.03), "framed beside the sidebar"
    assert moved("moving") == pytest.approx([0, 0, 0], abs=1e-3), "A stays where it is"
