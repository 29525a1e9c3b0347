"""Checking and mending of event sets."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from mphdrr.core import events

from .conftest import refused
from .small_events import TEXT, WORKBOOK, small_recipe
from .test_event_work import tree


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    events.make(small_recipe(folder), folder / "set", 5)
    other = small_recipe(folder / "other", TEXT.replace("seed = 5", "seed = 6"))
    events.make(other, folder / "foreign", 3)
    return folder


@pytest.fixture
def folder(made, tmp_path) -> Path:
    """Return a copy of the set, to damage."""
    return Path(shutil.copytree(made / "set", tmp_path / "set"))


def flip_a_bit(data: bytes) -> bytes:
    """Return the bytes with another bit in the middle."""
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :]


FOREIGN_EVENT, FIRST_EVENT = "foreign/events/000002.h5", "set/events/000000.h5"
DAMAGE = {
    "cut": ("events/000001.h5", lambda data: data[:-7], "cut: "),
    "of another recipe": ("events/000002.h5", FOREIGN_EVENT, "of another recipe"),
    "a changed byte": ("events/000003.h5", flip_a_bit, "changed: its bytes"),
    "missing": ("events/000004.h5", None, "missing"),
    "renamed": ("events/000001.h5", FIRST_EVENT, "is event 0"),
    "a changed header": ("events/000002.h5", lambda data: data[:500] + b"\1" + data[501:], "changed: its first"),
    "a foreign file": ("events/notes.txt", lambda _: b"mine", "does not belong to this set"),
    "a leftover": ("events/.0123abcd-000001.h5", lambda _: b"half", "interrupted"),
    "a changed index": ("index.csv", lambda data: data.replace(b"train", b"test"), "changed: its rows differ from"),
    "an index saved elsewhere": ("index.csv", lambda data: data.replace(b"\n", b"\r\n"), "changed: "),
    "an index cut between rows": ("index.csv", lambda data: b"".join(data.splitlines(keepends=True)[:4]), "changed: "),
    "an index of no text": ("index.csv", lambda data: data + b"\xff\xfe", "changed: "),
    "a foreign event": ("events/000077.h5", FOREIGN_EVENT, "not in the index"),
    "a folder for an event": ("events/000004.h5", Path.mkdir, ""),
}  # fmt: skip
"""A file, what becomes of its bytes or which file takes its place, and what is said of it."""
MOVED = ("a foreign file", "a foreign event", "a folder for an event")


def damaged(folder: Path, sets: Path, name: str) -> Path:
    """Damage a set in one of these ways, and return the path that is at fault."""
    path, change = folder / DAMAGE[name][0], DAMAGE[name][1]
    if isinstance(change, str):
        shutil.copy(sets / change, path)
    elif change in (None, Path.mkdir):
        path.unlink()
        if change is not None:
            change(path)
    else:
        path.write_bytes(change(path.read_bytes() if path.exists() else b""))
    return path


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_found_and_mended_and_nothing_else_is_touched(tmp_path, made, folder, damage, command):
    before = tree(folder)
    assert "5 events, every byte as it was written" in command("events", "check", folder).out
    path = damaged(folder, made, damage)
    times = {file: file.stat().st_mtime_ns for file in folder.rglob("*") if file.is_file() and file != path}
    said = command("events", "check", folder, status=1)
    (line,) = said.out.splitlines()
    assert line.startswith(str(path)) and DAMAGE[damage][2] in line
    assert "1 fault; --repair mends" in said.err
    command("events", "check", folder, "--repair")
    assert tree(folder) == before
    assert {file: file.stat().st_mtime_ns for file in times} == times
    moved = [file.name for file in (tmp_path / "set-foreign").glob("*")]
    assert moved == ([path.name] if damage in MOVED else [])
    command("events", "check", folder)


def test_all_damage_at_once(made, folder, command):
    before = tree(folder)
    names = ("cut", "of another recipe", "a changed byte", "missing", "a foreign file")
    paths = {str(damaged(folder, made, name)) for name in names}
    assert {str(fault.path) for fault in events.check(folder)} == paths
    assert {fault["path"] for fault in json.loads(command("events", "check", folder, "--json", status=1).out)} == paths
    assert "4 events made anew" in command("events", "check", folder, "--repair", "--workers", "2").out
    assert tree(folder) == before


def test_a_changed_input_is_found_and_not_mended(folder, command):
    path = folder / "inputs" / WORKBOOK.name
    path.write_bytes(path.read_bytes() + b" ")
    assert "put the original back" in command("events", "check", folder, "--repair", status=1).err


def test_a_changed_recipe_is_found_and_its_events_made_anew(made, folder, command):
    (folder / "recipe.toml").write_text(TEXT.replace("seed = 5", "seed = 6"))
    assert "an event of another recipe" in command("events", "make", folder, "-n", "5", status=1).err
    assert command("events", "check", folder, status=1).out.count("of another recipe") == 5
    command("events", "check", folder, "--repair")
    for number in range(3):
        name = f"events/{number:06d}.h5"
        assert (folder / name).read_bytes() == (made / "foreign" / name).read_bytes()


def test_what_the_recipe_names_may_lie_in_the_folder(tmp_path, command):
    """A recipe that was written there, with its workbook beside it and in the folder of copies."""
    folder = tmp_path / "set"
    (folder / "inputs").mkdir(parents=True)
    for name in ("scanner.xlsx", "inputs/scanner.xlsx", "inputs/mine.txt"):
        shutil.copy(WORKBOOK, folder / name)
    recipe = small_recipe(folder, TEXT.replace(repr(str(WORKBOOK)), '"scanner.xlsx"'))
    (folder / "small.toml").rename(folder / "recipe.toml")
    events.make(events.read_recipe(folder / "recipe.toml"), folder, 1)
    assert (folder / "inputs" / "mine.txt").exists() and recipe.seed == 5
    assert [fault.path.name for fault in events.check(folder)] == ["mine.txt"]
    command("events", "make", folder, "-n", "2")


def test_status(tmp_path, made, folder, command):
    for name in ("missing", "cut"):
        damaged(folder, made, name)
    said = command("events", "status", folder).out
    assert "3 of 5 events" in said and "missing: 1, 4; mphdrr events make" in said
    found = json.loads(command("events", "status", folder, "--json").out)
    assert found["missing"] == [1, 4] and sum(found["phantoms"].values()) == sum(found["splits"].values()) == 3
    assert "no event set" in command("events", "status", made, status=1).err
    assert events.status(folder) == events.Status(**found)
    refused(lambda: events.check(tmp_path), "no event set")
