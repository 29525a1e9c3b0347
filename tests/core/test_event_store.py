"""Events in files of their own and in shards: the same events, whatever is read, killed, packed or damaged."""

from __future__ import annotations

import csv
import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.cli import main
from mphdrr.core import events, files, hdf5
from mphdrr.core.events import event_files
from mphdrr.core.events import store as stores
from mphdrr.core.events.folders import SetFolder
from mphdrr.core.events.store import Store

from .conftest import refused
from .small_events import TEXT, small_recipe
from .test_event_work import tree

h5py = pytest.importorskip("h5py")
COUNT = 6


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    events.make(small_recipe(folder), folder / "set", COUNT)
    return folder / "set"


@pytest.fixture
def whole(made, tmp_path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "set"))


def packed(folder: Path, shard_bytes: int = 10**9) -> Store:
    store = SetFolder(folder).store
    store.pack(shard_bytes=shard_bytes)
    return store


def assert_same_events(folder: Path, made: Path) -> None:
    """Check that the first events of a folder, all unless it grew, are those of `made`."""
    for event, other in zip(events.EventSet(folder)[:COUNT], events.EventSet(made), strict=True):
        assert_same_event(event, other)


def assert_same_event(event: events.Event, other: events.Event) -> None:
    assert (event.number, event.row, event.attributes) == (other.number, other.row, other.attributes)
    assert np.array_equal(event.truth.array, other.truth.array) and np.array_equal(event.pose, other.pose)
    for model in ("lines", "emission"):
        assert np.array_equal(event.images(model), other.images(model))


def test_packed_events_are_the_same_and_come_back_byte_for_byte(whole, made):
    before = tree(whole)
    assert main(["events", "pack", str(whole), "--gigabytes", "0.00015"]) == 0
    shards = sorted((whole / "shards").glob("*.tar"))
    assert len(shards) > 1 and not list((whole / "events").iterdir())
    assert_same_events(whole, made)
    assert main(["events", "check", str(whole)]) == 0
    status = events.status(whole)
    assert (status.made, status.missing, status.shards) == (COUNT, [], len(shards))
    # any tar gives the same files
    with tarfile.open(shards[0]) as tar:
        name = tar.getnames()[0]
        assert tar.extractfile(name).read() == before[f"events/{name}"]
    assert main(["events", "unpack", str(whole)]) == 0
    shutil.rmtree(whole / "shards")
    assert main(["events", "unpack", str(whole)]) == 0  # nothing is left to do
    assert tree(whole) == before


def test_a_set_with_shards_grows_in_them(whole, made):
    packed(whole)
    assert len(events.make(events.read_recipe(whole / "recipe.toml"), whole, COUNT + 2)) == COUNT + 2
    assert not list((whole / "events").iterdir())
    assert len(Store(whole).locations()) == COUNT + 2 and events.check(whole) == []
    assert_same_events(whole, made)


@pytest.mark.parametrize("at", [100, 512, 20_000])
def test_a_kill_while_packing_loses_nothing(whole, made, at, monkeypatch):
    """What reached the disk ends anywhere within the second event; the first one's own file is removed already."""
    store, write, flush = SetFolder(whole).store, stores._write_member, stores._flush
    monkeypatch.setattr(stores, "_BATCH", 1)
    written = []

    def killed(file, end, name, data):
        written.append(name)
        write(file, end, name, data)
        if len(written) == 2:
            file.flush()
            os.truncate(file.name, end + at)
            raise KeyboardInterrupt

    monkeypatch.setattr(stores, "_write_member", killed)
    monkeypatch.setattr(stores, "_flush", lambda *batch: None if len(written) == 2 else flush(*batch))
    with pytest.raises(KeyboardInterrupt):
        store.pack()
    monkeypatch.undo()
    assert len(list((whole / "events").glob("*.h5"))) == COUNT - 1
    assert_same_events(whole, made)
    assert store.pack() == COUNT - 1
    assert_same_events(whole, made)
    assert events.check(whole) == []


def test_a_kill_before_the_own_files_are_removed_packs_no_event_twice(whole, made):
    store = packed(whole)
    size = store.shard_paths()[0].stat().st_size
    shutil.copytree(made / "events", whole / "events", dirs_exist_ok=True)
    assert store.pack() == COUNT
    assert store.shard_paths()[0].stat().st_size == size and not list((whole / "events").iterdir())
    assert_same_events(whole, made)


def test_damage_in_a_shard_is_found_and_mended(whole, made, capsys):
    store = packed(whole)
    location = store.locations()[3]
    with open(location.path, "r+b") as file:
        file.seek(location.offset + location.size // 2)
        byte = file.read(1)
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([byte[0] ^ 4]))
    (fault,) = events.check(whole)
    assert (fault.kind, fault.event, str(fault.path)) == ("damaged", 3, location.path)
    assert main(["events", "check", str(whole), "--repair"]) == 0
    assert_same_events(whole, made)
    assert events.check(whole) == []


def test_a_set_of_version_0_1_0_opens_is_whole_and_goes_on(tmp_path):
    shutil.copytree(Path(__file__).parent / "data" / "events-0.1.0", tmp_path / "set")
    old = events.EventSet(tmp_path / "set")
    assert events.check(tmp_path / "set") == [] and old.numbers == [0, 1]
    assert old[0].images("emission").shape == (3, 7, 8) and old[0].row["phantom.radius"] == pytest.approx(32.52799)
    with pytest.warns(mph.InputWarning, match="another build"):
        events.make(old.recipe, tmp_path / "set", 3)
    made = events.EventSet(tmp_path / "set")
    assert len(made) == 3 and events.check(tmp_path / "set") == []
    fresh = events.make(old.recipe, tmp_path / "fresh", 1)[0]
    np.testing.assert_allclose(made[0].images("emission").sum(), fresh.images("emission").sum(), rtol=0.01)
    np.testing.assert_allclose(made[0].truth.array.sum(), fresh.truth.array.sum(), rtol=1e-3)
    np.testing.assert_allclose(made[0].pose, fresh.pose, rtol=1e-12)


def test_a_set_of_an_earlier_version_opens_and_goes_on(whole, made):
    """Its events have no table of blocks and no build; its index alone says what was asked for, in columns of its own."""
    for path in (whole / "events").glob("*.h5"):
        data = path.read_bytes()
        seal = hdf5.parse_seal(data[: hdf5.HEADER])
        body = data[hdf5.HEADER : hdf5.HEADER + seal.size]
        fields = {name: value for name, value in seal.fields.items() if name != "build"}
        old = hdf5.Seal(seal.kind, seal.size, fields, hashlib.sha256(body).hexdigest(), version=1)
        path.write_bytes(old.text() + body)
    shutil.rmtree(whole / "asked")
    order = list(csv.reader((made / "index.csv").open()))
    with (whole / "index.csv").open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([row[0], *reversed(row[1:])] for row in order)
    assert_same_events(whole, made)
    assert events.status(whole).builds == {"": COUNT}
    (whole / "events" / "000004.h5").unlink()
    with pytest.warns(mph.InputWarning, match=r"another build of mphDRR \(of version 0\.1"):
        events.make(events.read_recipe(whole / "recipe.toml"), whole, COUNT + 1)
    assert events.check(whole) == [] and SetFolder(whole).requested == [range(COUNT + 1)]
    packed(whole)
    assert_same_events(whole, made)
    data = bytearray((whole / "shards" / "000000.tar").read_bytes())
    data[3000] ^= 1
    (whole / "shards" / "000000.tar").write_bytes(data)
    refused(lambda: events.EventSet(whole)[0].pose, "changed")


def test_two_works_pack_one_after_the_other(whole):
    store = SetFolder(whole).store
    store.shards.mkdir()
    with files.locked(store.shards / stores.LOCK, "busy"):
        refused(store.pack, "another process is packing")
    assert store.pack() == COUNT


def test_readers_go_on_while_a_set_is_packed(whole, made):
    opened = events.EventSet(whole)
    packed(whole)
    for event, other in zip(opened, events.EventSet(made), strict=True):
        assert_same_event(event, other)


def test_writers_of_the_same_events_overlap_without_harm(tmp_path, made, monkeypatch):
    """Several works make the same events of a slow disk at once, while another one looks for what was left."""
    recipe = small_recipe(tmp_path)
    replace = os.replace
    monkeypatch.setattr(os, "replace", lambda a, b: (time.sleep(0.01), replace(a, b))[1])
    with ThreadPoolExecutor(3) as pool:
        works = [pool.submit(events.make, recipe, tmp_path / "set", COUNT) for _ in range(3)]
        while not all(work.done() for work in works):
            try:
                events.repair(tmp_path / "set", [f for f in events.check(tmp_path / "set") if f.kind == "leftover"])
            except mph.InputError as error:
                assert "no event set" in str(error) or "no copy" in str(error)
            time.sleep(0.02)
    assert all(len(work.result()) == COUNT for work in works)
    assert tree(tmp_path / "set") == tree(made)


@pytest.mark.long
def test_works_overlap_without_harm(tmp_path, made):
    """Requeued jobs and repairs beside them, as processes: each ends with status 0, and the bytes are the same."""
    small_recipe(tmp_path)
    for turn in range(2):
        folder = str(tmp_path / str(turn))
        make = ["events", "make", folder, "--recipe", str(tmp_path / "small.toml"), "-n", str(COUNT), "--quiet"]
        slow = (
            "import os, sys, time; from mphdrr.addon.cli import main; old = os.replace\n"
            "os.replace = lambda a, b: (time.sleep(0.05), old(a, b))[1]\n"
            "sys.exit(main(sys.argv[1:]))"
        )
        works = [subprocess.Popen([sys.executable, "-c", slow, *make]) for _ in range(3)]
        while not list(Path(folder).glob("events/*.h5")):
            time.sleep(0.01)
        repair = [sys.executable, "-c", slow, "events", "check", folder, "--repair"]
        works += [subprocess.Popen(repair) for _ in range(2)]
        assert [work.wait(600) for work in works] == [0] * 5
        assert tree(Path(folder)) == tree(made)


def test_works_that_grow_a_set_at_once_lose_no_rows(tmp_path):
    recipe = small_recipe(tmp_path)
    with ThreadPoolExecutor(3) as pool:
        for part in [pool.submit(events.make, recipe, tmp_path / "set", 4, first) for first in (0, 4, 8)]:
            part.result()
    assert events.EventSet(tmp_path / "set").numbers == list(range(12))
    lines = (tmp_path / "set" / "index.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in lines] == ["event", *map(str, range(12))]
    folder = SetFolder(tmp_path / "set")
    assert folder.requested == [range(12)] and events.check(folder.path) == []
    for name in ("0-3", "2-9"):  # as of works that asked at one time
        (folder.requests_path / name).touch()
    assert folder.requested == [range(12)] and events.check(folder.path) == []
    events.make(recipe, folder.path, 12)
    assert [path.name for path in folder.requests_path.iterdir()] == ["0-11"]


@pytest.mark.parametrize("kept", [0, 5, 14])
@pytest.mark.parametrize("more", [(), (2, 4)])
def test_an_index_whose_heading_was_cut_or_is_just_begun_is_read_and_completed(whole, made, kept, more):
    path = whole / "index.csv"
    path.write_bytes((made / "index.csv").read_bytes()[:kept])
    for number in more:
        SetFolder(whole).index.add(number)
    assert events.status(whole).made == COUNT
    assert events.EventSet(whole).split("train").numbers == events.EventSet(made).split("train").numbers
    events.make(events.EventSet(whole).recipe, whole, COUNT)
    assert tree(whole) == tree(made)


@pytest.mark.parametrize("kept", [1, 14, -1])
def test_a_row_of_the_index_that_was_cut_is_drawn_anew(whole, made, kept):
    """Alone at the end of the file, and with other rows written on behind it."""
    path, lines = whole / "index.csv", (made / "index.csv").read_text().splitlines(keepends=True)
    for more in (False, True):
        path.write_text("".join([*lines[:3], lines[3][:kept]]))
        for number in range(3, COUNT) if more else ():
            SetFolder(whole).index.add(number)
        assert_same_events(whole, made)
        for name in ("train", "test"):
            assert events.EventSet(whole).split(name).numbers == events.EventSet(made).split(name).numbers
        events.make(events.read_recipe(whole / "recipe.toml"), whole, COUNT)
        assert path.read_text() == "".join(lines)


def test_another_build_is_said(whole, monkeypatch, capsys):
    monkeypatch.setattr("mphdrr.core.events.folders.build", lambda: "0123456789ab")
    monkeypatch.setattr("mphdrr.core.events.event_files.build", lambda: "0123456789ab")
    with pytest.warns(mph.InputWarning, match="event 0 was made by another build of mphDRR"):
        events.make(events.read_recipe(whole / "recipe.toml"), whole, COUNT + 1)
    assert sorted(events.status(whole).builds.values()) == [1, COUNT]
    assert main(["events", "status", str(whole)]) == 0
    assert "builds of mphDRR: 0123456789ab 1" in capsys.readouterr().out


def edited(path: Path, edit) -> None:
    with h5py.File(path, "r+") as file:
        edit(file)


def sealed_again(path: Path, edit) -> None:
    """Seal a changed event as a program would that knows the format: only its content is not the recipe's."""
    with h5py.File(path, "r") as old:
        seal = hdf5.parse_seal(path.read_bytes()[: hdf5.HEADER])

        def fill(new):
            for name in old:
                old.copy(name, new)
            new.attrs.update(old.attrs)
            edit(new)

        data = bytes(hdf5.pack(seal.kind, seal.fields, fill))
    path.write_bytes(data)


def other_shape(file) -> None:
    unit = file["images/lines"].attrs["unit"]
    del file["images/lines"]
    file["images/lines"] = np.ones((8, 14, 17), np.float32)
    file["images/lines"].attrs["unit"] = unit


def external(file) -> None:
    del file["images/lines"]
    file.create_dataset("images/lines", (8, 14, 16), "f4", external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)])


def linked(file) -> None:
    del file["images/lines"]
    file["images/lines"] = h5py.ExternalLink("/etc/hostname", "/x")


@pytest.mark.parametrize(
    ("change", "edit", "said"),
    [
        (edited, lambda file: file["pose"].__setitem__((0, 3), 99.0), "c(ut|hanged): "),
        (sealed_again, other_shape, r"images/lines: expected the shape \(8, 14, 16\), got \(8, 14, 17\)"),
        (sealed_again, external, "its numbers are in other files"),
        (sealed_again, linked, "a link to another file"),
    ],
)
def test_an_event_that_is_not_as_it_should_be_is_refused_by_name(whole, change, edit, said):
    path = whole / "events" / "000002.h5"
    change(path, edit)
    event = events.EventSet(whole)[2]
    refused(lambda: (event.pose, event.images("lines")), f"000002.h5: .*{said}")


@pytest.mark.parametrize("count", [60, pytest.param(200, marks=pytest.mark.long)])
def test_no_flipped_bit_of_an_event_reads_as_another_event(whole, made, count):
    path = whole / "events" / "000001.h5"
    data, random = path.read_bytes(), np.random.default_rng(7)
    for bit in random.integers(8 * len(data), size=count):
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        path.write_bytes(changed)
        try:
            assert_same_event(events.EventSet(whole)[1], events.EventSet(made)[1])
        except mph.InputError as error:
            assert "000001.h5" in str(error)


def test_a_loader_skips_damaged_events_where_asked(whole):
    torch = pytest.importorskip("torch")
    path = whole / "events" / "000001.h5"
    path.write_bytes(path.read_bytes()[:-100])
    (whole / "events" / "000003.h5").unlink()
    there = events.EventSet(whole)
    for options in ({"batch_size": 2}, {"num_workers": 1}):
        with pytest.raises(mph.InputError, match=r"000001\.h5: cut"):
            list(torch.utils.data.DataLoader(events.torch_dataset(there, "lines"), **options))
    chosen = events.torch_dataset(there, ("lines", "truth"), skip_damaged=True)
    with pytest.warns(mph.InputWarning, match=r"000001\.h5: cut.*left out"):
        batches = list(torch.utils.data.DataLoader(chosen, batch_size=2))
    assert [number for batch in batches for number in batch["number"].tolist()] == [0, 2, 2, 4, 5]
    for batch in batches:
        for number, truth, lines in zip(batch["number"].tolist(), batch["truth"], batch["lines"], strict=True):
            (event,) = (event for event in there if event.number == number)
            assert np.array_equal(truth, event.truth.array) and np.array_equal(lines, event.images("lines"))


def test_a_part_reads_only_what_it_needs(tmp_path, monkeypatch):
    text = TEXT.replace("voxels = 16", "voxels = 80").replace("spacing = 6.0", "spacing = 1.2")
    event = events.make(small_recipe(tmp_path, text), tmp_path / "set", 1)[0]
    read, inflate = [], event_files.inflate
    monkeypatch.setattr(event_files, "inflate", lambda data: (read.append(len(data)), inflate(data))[1])
    whole, all_of_it = event.truth.array, len(read)
    part = (slice(33, 39), slice(30, 45), slice(40, 41))
    read.clear()
    assert np.array_equal(event.truth_part(part), whole[part]) and 0 < len(read) <= 2 < all_of_it
    # bricks without activity are in no file, and zeros
    assert all_of_it < 27 and np.array_equal(whole, event.truth_part()) and whole.any()


def test_sets_without_ends_are_refused_or_begin_at_once(tmp_path, capsys):
    recipe = small_recipe(tmp_path)
    words = "at most 10,000,000 events in a set, got 1,000,000,000, of up to .* GiB"
    refused(lambda: events.making(recipe, tmp_path / "set", 10**9), words)
    begun = time.process_time()
    assert next(events.making(recipe, tmp_path / "set", 10**6, shard=(7, 50))).number == 6
    assert time.process_time() - begun < 20
    assert SetFolder(tmp_path / "set").requested == [range(10**6)]
