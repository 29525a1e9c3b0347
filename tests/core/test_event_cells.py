"""Tables of event sets hold no text that a spreadsheet would run, and say all texts as they were."""

from __future__ import annotations

import csv
import itertools
import json
from pathlib import Path

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.cli import main
from mphdrr.core import events
from mphdrr.core.events.cells import escaped, unescaped

from .small_events import small_recipe, with_phantoms

RUN = ("=", "+", "-", "@", "\t", "\r")


def test_every_text_comes_back_and_none_is_run():
    texts = ["".join(letters) for n in range(5) for letters in itertools.product("'=-@\t\ra1", repeat=n)]
    cells = [escaped(text) for text in texts]
    assert [unescaped(cell) for cell in cells] == texts and len(set(cells)) == len(cells)
    assert not any(cell.startswith(RUN) for cell in cells)
    assert all(cell == text for cell, text in zip(cells, texts, strict=True) if not text.strip("'").startswith(RUN))
    for number in (-1, -2.5, 0, 1e-300, True, None):
        assert escaped(number) is number


FILES = ["=1+2.nii.gz", "+1,2.nii.gz", "@SUM(A1).nii.gz", "'-quoted.nii.gz", "plain.nii.gz"]


@pytest.fixture
def hostile(tmp_path: Path) -> events.EventSet:
    """Make a set whose phantoms and files have names that are formulas."""
    volume = mph.Volume(np.ones((4, 4, 4)), mph.Grid.centered((4, 4, 4), 9.0))
    for file in FILES:
        mph.write_volume(volume, tmp_path / file)
    entries = f'[[phantoms]]\nname = "-files"\nfile = {{ one_of = {json.dumps(FILES)} }}\n'
    entries += "pose.position = [-5, { from = -8, to = 8 }, 0]\n"
    text = with_phantoms(entries).replace("train", "-train")
    return events.make(small_recipe(tmp_path, text), tmp_path / "set", 12)


def rows_of(path: Path) -> list[dict[str, str]]:
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_names_that_are_formulas_are_texts_in_every_table_and_come_back(hostile, tmp_path):
    folder = tmp_path / "set"
    rows = rows_of(folder / "index.csv")
    assert len({row["file"] for row in rows}) > 2  # several of the names are drawn
    for row in rows:
        assert not any(row[name].startswith(RUN) for name in ("phantom", "split", "file")), row
    assert any(row["x_mm"].startswith("-") for row in rows) and all(float(row["x_mm"]) < 9 for row in rows)
    for given in (hostile.index, events.EventSet(folder).index):
        assert [(row["phantom"], row["file"], row["split"]) for row in given] == [
            (event.name, event.settings["file"], event.split) for event in hostile
        ]
        assert {row["file"] for row in given} <= set(FILES)
    assert not events.check(folder)
    assert set(events.status(folder).splits) == {"-train", "test"}
    for _ in range(2):  # what is there already is recognised
        events.export_events(hostile, tmp_path / "npz", "npz")
    assert [row["name"] for row in rows_of(tmp_path / "npz" / "events.csv")] == ["'-files"] * 12
    assert not any(row["split"].startswith(RUN) for row in rows_of(tmp_path / "npz" / "events.csv"))


def test_an_index_that_was_written_without_this_is_read(hostile, tmp_path):
    path = tmp_path / "set" / "index.csv"
    rows = rows_of(path)
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: unescaped(text) for key, text in row.items()} for row in rows)
    assert [row["file"] for row in events.EventSet(tmp_path / "set").index] == [row["file"] for row in hostile.index]
    assert main(["events", "make", str(tmp_path / "set"), "-n", "12"]) == 0
