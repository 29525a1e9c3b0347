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

AS_SHIPPED = True  # other processes make the same


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    events.make(small_recipe(folder), folder / "set", 5)
    other = small_recipe(folder / "other", TEXT.replace("seed = 5", "seed = 6"))
    events.make(other, folder / "foreign", 3)
    return folder


@pytest.fixture
def folder(made, tmp_path) -> Path:
    """A copy of the set, to damage."""
    return Path(shutil.copytree(made / "set", tmp_path / "set"))


def cut(folder: Path, others: Path) -> Path:
    path = folder / "events" / "000001.h5"
    path.write_bytes(path.read_bytes()[:-7])
    return path


def other_recipe(folder: Path, others: Path) -> Path:
    return Path(shutil.copy(others / "foreign" / "events" / "000002.h5", folder / "events" / "000002.h5"))


def changed_byte(folder: Path, others: Path) -> Path:
    path = folder / "events" / "000003.h5"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    return path


def missing(folder: Path, others: Path) -> Path:
    path = folder / "events" / "000004.h5"
    path.unlink()
    return path


def renamed(folder: Path, others: Path) -> Path:
    return Path(shutil.copy(folder / "events" / "000000.h5", folder / "events" / "000001.h5"))


def header_byte(folder: Path, others: Path) -> Path:
    path = folder / "events" / "000002.h5"
    data = bytearray(path.read_bytes())
    data[500] = 1
    path.write_bytes(data)
    return path


def foreign(folder: Path, others: Path) -> Path:
    (folder / "events" / "notes.txt").write_text("mine")
    return folder / "events" / "notes.txt"


def leftover(folder: Path, others: Path) -> Path:
    (folder / "events" / ".0123abcd-000001.h5").write_bytes(b"half")
    return folder / "events" / ".0123abcd-000001.h5"


def index(folder: Path, others: Path) -> Path:
    path = folder / "index.csv"
    path.write_text(path.read_text().replace("train", "test"))
    return path


def index_saved_elsewhere(folder: Path, others: Path) -> Path:
    path = folder / "index.csv"
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    return path


def index_cut_between_rows(folder: Path, others: Path) -> Path:
    path = folder / "index.csv"
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:4]))
    return path


def index_of_no_text(folder: Path, others: Path) -> Path:
    path = folder / "index.csv"
    path.write_bytes(path.read_bytes() + b"\xff\xfe")
    return path


def foreign_event(folder: Path, others: Path) -> Path:
    return Path(shutil.copy(others / "foreign" / "events" / "000002.h5", folder / "events" / "000077.h5"))


def folder_for_event(folder: Path, others: Path) -> Path:
    path = missing(folder, others)
    path.mkdir()
    return path


DAMAGE = {
    cut: "cut: ", other_recipe: "of another recipe", changed_byte: "changed: its bytes", missing: "missing",
    renamed: "is event 0", header_byte: "changed: its first", foreign: "does not belong to this set",
    leftover: "interrupted", index: "changed: its rows differ from those that recipe.toml gives",
    index_saved_elsewhere: "changed: ", index_cut_between_rows: "changed: ", index_of_no_text: "changed: ",
    foreign_event: "not in the index", folder_for_event: "",
}  # fmt: skip


@pytest.mark.parametrize("damage", DAMAGE, ids=lambda damage: damage.__name__)
def test_damage_is_found_and_mended_and_nothing_else_is_touched(tmp_path, made, folder, damage, command):
    before = tree(folder)
    assert "5 events, every byte as it was written" in command("events", "check", folder).out
    path = damage(folder, made)
    times = {file: file.stat().st_mtime_ns for file in folder.rglob("*") if file.is_file() and file != path}
    said = command("events", "check", folder, status=1)
    (line,) = said.out.splitlines()
    assert line.startswith(str(path)) and DAMAGE[damage] in line
    assert "1 fault; --repair mends" in said.err
    command("events", "check", folder, "--repair")
    assert tree(folder) == before
    assert {file: file.stat().st_mtime_ns for file in times} == times
    moved = [file.name for file in (tmp_path / "set-foreign").glob("*")]
    assert moved == ([path.name] if damage in (foreign, foreign_event, folder_for_event) else [])
    command("events", "check", folder)


def test_all_damage_at_once(made, folder, command):
    before = tree(folder)
    paths = {str(damage(folder, made)) for damage in (cut, other_recipe, changed_byte, missing, foreign)}
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
    missing(folder, made)
    cut(folder, made)
    said = command("events", "status", folder).out
    assert "3 of 5 events" in said and "missing: 1, 4; mphdrr events make" in said
    found = json.loads(command("events", "status", folder, "--json").out)
    assert found["missing"] == [1, 4] and sum(found["phantoms"].values()) == sum(found["splits"].values()) == 3
    assert "no event set" in command("events", "status", made, status=1).err
    assert events.status(folder) == events.Status(**found)
    refused(lambda: events.check(tmp_path), "no event set")
