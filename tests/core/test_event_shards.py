"""Shards that lost members, events that are stored twice, and links in a set's folders."""

from __future__ import annotations

import os
import shutil
import time
import warnings
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

import mphdrr.core as mph
from mphdrr.addon.cli import main
from mphdrr.core import events
from mphdrr.core.events import store as stores
from mphdrr.core.events.event_files import read_header
from mphdrr.core.events.folders import SetFolder
from mphdrr.core.events.store import Store

from .conftest import refused, warned
from .small_events import small_recipe
from .test_event_check import flip_a_bit
from .test_event_work import tree

COUNT = 5


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    events.make(small_recipe(folder), folder / "set", COUNT)
    return folder / "set"


@pytest.fixture
def whole(made, tmp_path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "set"))


@pytest.fixture
def shard(whole) -> Path:
    """Return the shard of a packed set."""
    SetFolder(whole).store.pack()
    return whole / "shards" / "000000.tar"


def change(path: Path, position: int, data: bytes) -> None:
    with path.open("r+b") as file:
        file.seek(position)
        file.write(data)


def heading(folder: Path, number: int) -> int:
    """Return the position of a packed event's heading."""
    return Store(folder).locations()[number].offset - 512


def assert_mended(folder: Path, made: Path, asked: int) -> None:
    """Check that a repair gives the events as they were made; `asked` faults are there before."""
    assert len(events.check(folder)) == asked
    assert main(["events", "check", str(folder), "--repair"]) == 0
    assert warned(lambda: events.EventSet(folder)) == [] and events.check(folder) == []
    SetFolder(folder).store.unpack()
    assert tree(folder / "events") == tree(made / "events")


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9])
def test_a_set_whose_shard_was_cut_says_what_is_missing(whole, made, shard, share, capsys):
    with shard.open("r+b") as file:
        file.truncate(int(share * shard.stat().st_size))
    missing = events.status(whole).missing
    ranges = f"{missing[0]}-{COUNT - 1}" if len(missing) > 1 else f"{COUNT - 1}"
    text = f"{whole}: {len(missing)} of {COUNT} events are missing: {ranges}; mphdrr events make {whole} makes them"
    for _ in range(2):
        with pytest.warns(mph.InputWarning) as caught:
            opened = events.EventSet(whole)
        assert [str(warning.message) for warning in caught] == [text]
    if len(opened):
        assert warned(lambda: [event.pose for event in opened.split("train") + opened]) == []
        if find_spec("torch"):
            assert warned(lambda: events.torch_dataset(opened, "lines")[0]) == []
        capsys.readouterr()
        assert main(["events", "show", str(whole), "-o", str(whole.parent / "sheet.png")]) == 0
        assert capsys.readouterr().err.count("events are missing") == 1
    assert_mended(whole, made, len(missing))


def test_a_set_that_is_not_done_says_so_and_a_whole_one_nothing(whole, tmp_path):
    assert warned(lambda: events.EventSet(whole)) == []
    shutil.rmtree(whole / "asked")  # as in sets of version 0.1.0: the index says what was asked for
    assert warned(lambda: events.EventSet(whole)) == []
    (whole / "events" / "000002.h5").unlink()
    (text,) = warned(lambda: events.EventSet(whole))
    assert f"1 of {COUNT} events are missing: 2;" in text
    folder = SetFolder(tmp_path / "begun")
    folder.prepare(events.read_recipe(whole / "recipe.toml"), [range(10**6)], [])
    begun = time.process_time()
    (text,) = warned(lambda: events.EventSet(folder.path))
    assert "1000000 of 1000000 events are missing: 0-999999;" in text and time.process_time() - begun < 2


@pytest.mark.parametrize(
    ("position", "data"),
    [
        (0, b"\xff"),  # the name
        (5, b"x"),
        (124, b"\xff"),  # the size
        (124, b"7"),
        (124, b"00000000000"),  # the next heading would be within the event
        (124, b"-0000001000"),  # the heading would follow itself
        (0, bytes(512)),
    ],
)
def test_a_damaged_heading_loses_its_event_alone(whole, made, shard, position, data):
    change(shard, heading(whole, 2) + position, data)
    assert warned(lambda: events.EventSet(whole)) == ([] if data == b"00000000000" else [text_of_missing(whole, 2)])
    # The seal behind the heading says how long the event is.
    assert [event.number for event in readable(whole)] == ([0, 1, 2, 3, 4] if data == b"00000000000" else [0, 1, 3, 4])
    size = shard.stat().st_size
    assert len(events.make(events.read_recipe(whole / "recipe.toml"), whole, COUNT)) == COUNT
    assert shard.stat().st_size > size  # packed behind the others, of which none is cut off
    assert_mended(whole, made, 1 if data == b"00000000000" else 0)


def test_a_heading_of_another_number_hides_no_event(whole, made, shard):
    """The event that seems to be there twice is the one whose seal says so."""
    change(shard, heading(whole, 3), b"000002.h5")
    assert warned(lambda: events.EventSet(whole)) == [text_of_missing(whole, 3)]
    assert [event.number for event in readable(whole)] == [0, 1, 2, 4]
    faults = events.check(whole)
    assert [(fault.kind, fault.event) for fault in faults] == [("damaged", None), ("missing", 3)]
    assert f"{shard}: is event 3 (event 2 is stored twice)" in faults[0].text
    assert_mended(whole, made, 2)


def text_of_missing(folder: Path, number: int) -> str:
    return f"{folder}: 1 of {COUNT} events are missing: {number}; mphdrr events make {folder} makes them"


def readable(folder: Path) -> Iterator[events.Event]:
    """Yield the events of a set that can be read."""
    with warnings.catch_warnings(action="ignore", category=mph.InputWarning):
        opened = events.EventSet(folder)
    for event in opened:
        try:
            _ = event.pose, event.truth, event.images("lines"), event.images("emission")
        except mph.InputError:
            continue
        yield event


def twice_in_shards(folder: Path, first: bool) -> None:
    """Store event 2 twice in the shard, of which one is damaged."""
    store = SetFolder(folder).store
    path = store.event_path(2)
    data = path.read_bytes()
    path.write_bytes(flip_a_bit(data))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stores, "verify", read_header)
        if not first:
            path.write_bytes(data)
        store.pack()
        path.write_bytes(data if first else flip_a_bit(data))
        store.pack()


def in_a_file_too(folder: Path, first: bool) -> None:
    """Store event 2 in the shard and in a file of its own, of which one is damaged."""
    store = SetFolder(folder).store
    path = store.event_path(2)
    data = path.read_bytes()
    store.pack()
    path.write_bytes(data if first else flip_a_bit(data))
    if first:
        location = store.locations()[3]
        member = min(location.offset for location in store.copies()[2] if location.offset)
        change(Path(location.path), member, flip_a_bit(data))


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("store_twice", [twice_in_shards, in_a_file_too])
def test_of_an_event_that_is_stored_twice_the_intact_one_is_kept(whole, made, store_twice, first, tmp_path):
    store_twice(whole, first)
    assert [event.number for event in readable(whole)] == [0, 1, 2, 3, 4]
    (fault,) = events.check(whole)
    assert (fault.kind, fault.event) == ("damaged", None) and fault.text.endswith("(event 2 is stored twice)")
    for name, action in (("unpack", Store.unpack), ("pack", Store.pack), ("repair", None)):
        folder = Path(shutil.copytree(whole, tmp_path / name))
        if action is None:
            assert events.repair(folder, events.check(folder)) == [] == events.check(folder)  # nothing is made anew
        else:
            action(SetFolder(folder).store)
        assert [event.number for event in readable(folder)] == [0, 1, 2, 3, 4]
        assert_mended(folder, made, len(events.check(folder)))


def test_what_is_damaged_twice_is_made_anew(whole, made, shard):
    data = (made / "events" / "000002.h5").read_bytes()
    (whole / "events" / "000002.h5").write_bytes(flip_a_bit(data))
    change(shard, heading(whole, 2) + 512, flip_a_bit(data))
    assert sorted(fault.event or 0 for fault in events.check(whole)) == [0, 2]
    assert events.repair(whole, events.check(whole)) == [2]
    assert_mended(whole, made, 1)


def test_a_damaged_event_that_nobody_asked_for_takes_no_other_along(whole, made, shard):
    change(shard, heading(whole, 2), b"000077.h5")
    assert_mended(whole, made, 2)
    assert not list(whole.parent.glob("*-foreign"))


def test_unpacking_says_how_many_events_it_gives(whole, shard, capsys):
    change(shard, heading(whole, 2) + 3000, b"\xff\xff\xff")
    assert main(["events", "unpack", str(whole)]) == 0
    assert f"{COUNT - 1} events have files" in capsys.readouterr().out
    assert events.status(whole).missing == [2]


@pytest.fixture
def elsewhere(tmp_path) -> Path:
    (tmp_path / "elsewhere").mkdir()
    return tmp_path / "elsewhere"


def move_and_link(path: Path, elsewhere: Path) -> Path:
    """Move a file or folder elsewhere, put a link in its place, and return where it is now."""
    shutil.move(path, elsewhere / path.name)
    os.symlink(elsewhere / path.name, path)
    return elsewhere / path.name


@pytest.mark.parametrize("name", ["events", "shards", "inputs", "asked"])
def test_what_lies_beyond_a_linked_folder_is_read_alone(whole, elsewhere, name, capsys):
    (whole / "shards").mkdir()
    store = SetFolder(whole).store
    if name == "shards":
        store.pack()
        change(whole / "shards" / "000000.tar", heading(whole, 2) + 3000, b"\xff\xff\xff")
    else:
        (whole / "events" / "000002.h5").write_bytes(b"damaged")
    (whole / name / ".0123abcd-000001.h5").write_bytes(b"half")
    (whole / name / "notes.txt").write_bytes(b"mine")
    move_and_link(whole / name, elsewhere)
    before = tree(elsewhere)
    assert [event.number for event in readable(whole)] == [0, 1, 3, 4]
    assert 2 in [fault.event for fault in events.check(whole)]
    recipe = events.read_recipe(whole / "recipe.toml")
    for call in (
        lambda: events.make(recipe, whole, COUNT),
        lambda: events.repair(whole, events.check(whole)),
        store.pack,
        store.unpack,
    ):
        if name in ("events", "shards") or call not in (store.pack, store.unpack):
            refused(call, f"{whole / name}: is a link: files beyond it are read, but not changed")
    assert main(["events", "check", str(whole), "--repair"]) == 1
    assert f"mphdrr: {whole / name}: is a link: " in capsys.readouterr().err.splitlines()[-1]
    assert tree(elsewhere) == before and (whole / name).is_symlink()


def test_a_linked_set_is_as_good_as_its_folder(whole, made, elsewhere):
    target = move_and_link(whole, elsewhere)
    (target / "events" / "000002.h5").write_bytes(b"damaged")
    SetFolder(whole).store.unpack()
    assert_mended(whole, made, 1)
    assert SetFolder(whole).store.pack() == COUNT and whole.is_symlink()


@pytest.mark.parametrize("action", ["repair", "make", "pack", "unpack", "damaged unpack", "grow"])
def test_a_link_is_moved_or_removed_and_never_its_target(whole, made, elsewhere, action):
    """Links for a damaged event, an intact one, a foreign file, a leftover, and a shard."""
    store, data = SetFolder(whole).store, (made / "events" / "000002.h5").read_bytes()
    if action in ("unpack", "damaged unpack", "grow"):
        store.pack()
        move_and_link(whole / "shards" / "000000.tar", elsewhere)
    targets = {name: elsewhere / name for name in ("000002.h5", "000003.h5", "notes.txt", ".0123abcd-000001.h5")}
    is_damaged = action in ("repair", "make", "damaged unpack")
    contents = [b"my own text" if is_damaged else data, (made / "events" / "000003.h5").read_bytes(), b"mine", b"half"]
    for (name, target), content in zip(targets.items(), contents, strict=True):
        target.write_bytes(content)
        (whole / "events" / name).unlink(missing_ok=True)
        os.symlink(target, whole / "events" / name)
    before = tree(elsewhere)
    if action == "repair":
        assert main(["events", "check", str(whole), "--repair"]) == 0
        assert (whole.parent / "set-foreign" / "notes.txt").is_symlink()
    elif action in ("make", "grow"):
        events.make(events.read_recipe(whole / "recipe.toml"), whole, COUNT + (action == "grow"))
    else:
        store.pack() if action == "pack" else store.unpack()
    assert tree(elsewhere) == before
    assert [event.number for event in readable(whole)][:COUNT] == [0, 1, 2, 3, 4]


def test_a_linked_index_is_not_written(whole, elsewhere):
    target = move_and_link(whole / "index.csv", elsewhere)
    target.write_bytes(b"my own text\n")
    refused(lambda: events.make(events.read_recipe(whole / "recipe.toml"), whole, COUNT + 1), "index.csv: is a link")
    refused(lambda: events.repair(whole, events.check(whole)), "index.csv: is a link")
    assert target.read_bytes() == b"my own text\n"


def test_a_list_of_copies_that_names_other_folders_removes_nothing_there(whole, elsewhere):
    victim = elsewhere / "mine.xlsx"
    victim.write_bytes(b"mine")
    entry = '{"file": "../../elsewhere/mine.xlsx", "what": "copy", "sha256": "0"}'
    (whole / "inputs" / "inputs.json").write_text(f'{{"other.xlsx": {entry}}}')
    shutil.rmtree(whole / "events")
    with pytest.warns(mph.InputWarning, match="4 of 5 events are missing: 1-4"):
        events.make(small_recipe(whole.parent), whole, 1)
    assert victim.read_bytes() == b"mine"


def test_folders_with_the_names_of_leftovers_stay(whole):
    (whole / "events" / ".0123abcd-000001.h5").mkdir()
    events.make(events.read_recipe(whole / "recipe.toml"), whole, COUNT)
    assert main(["events", "check", str(whole), "--repair"]) == 0
    assert (whole.parent / "set-foreign" / ".0123abcd-000001.h5").is_dir()


@pytest.mark.parametrize("name", ["train", "test"])
def test_an_export_does_not_write_beyond_a_linked_folder(made, elsewhere, tmp_path, name):
    folder = tmp_path / "export"
    events.export_events(events.EventSet(made), folder, "3dunet", models="emission", raw="backprojection")
    move_and_link(folder / name, elsewhere)
    before = tree(elsewhere)
    file = next((elsewhere / name).iterdir())
    file.unlink()
    refused(
        lambda: events.export_events(events.EventSet(made), folder, "3dunet", models="emission", raw="backprojection"),
        f"{folder / name}: is a link",
    )
    assert set(tree(elsewhere)) < set(before)
