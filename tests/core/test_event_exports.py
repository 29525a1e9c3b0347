"""Exports of event sets, read as their programs' documents say: by torch, h5py, tarfile and numpy alone."""

from __future__ import annotations

import csv
import gzip
import io
import json
import tarfile
from pathlib import Path

import h5py
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core.events.exports import PROGRAMS, export_events
from mphdrr.core.events.exports.slots import read_slots, row_slots

from .conftest import refused
from .small_events import TEXT, small_recipe
from .test_event_work import tree


def rows_of(folder: Path, name: str) -> list[dict[str, str]]:
    with open(folder / name, newline="") as file:
        return list(csv.DictReader(file))


def test_slots_of_the_users_scanner_are_96_of_which_columns_20_to_23_mirror_the_last_four(scanner):
    slots = row_slots(scanner)
    images = np.random.default_rng(1).random((80, 3, 5)).astype(np.float32)
    arranged = slots.arrange(images)
    assert arranged.shape == (96, 3, 5)
    for row in range(4):
        for column in range(20):
            assert np.array_equal(arranged[24 * row + column], images[20 * row + column])
        for j in range(4):
            assert np.array_equal(arranged[24 * row + 20 + j], np.fliplr(images[20 * row + 19 - j]))


def test_table_of_slots_says_what_they_show_and_is_read_back(scanner, tmp_path):
    slots = row_slots(scanner)
    (tmp_path / "slots.csv").write_text(slots.table(scanner))
    rows = rows_of(tmp_path, "slots.csv")
    assert rows[24 + 21] == {"slot": "45", "row": "1", "column": "21", "module": "39", "ring": "2", "mirrored": "1"}
    read = read_slots(tmp_path / "slots.csv", scanner)
    assert np.array_equal(read.modules, slots.modules) and np.array_equal(read.mirrored, slots.mirrored)
    assert read.columns == 24


def test_rings_of_several_sizes_need_a_table(scanner, tmp_path):
    some = scanner[np.r_[0:5, 20:26]]
    refused(lambda: row_slots(some), "rings have 5, 6 modules")
    (tmp_path / "t.csv").write_text("slot,module,mirrored\n0,21,no\n1,1,yes\n")
    slots = read_slots(tmp_path / "t.csv", some)
    assert slots.modules.tolist() == [5, 0] and slots.mirrored.tolist() == [False, True]
    heading = "slot,module,mirrored\n"
    wrong = {"slot,module\n": "mirrored", heading: "no slots", f"{heading}0,99,0\n": "line 2"}
    for text, found in (wrong | {f"{heading}1,1,0\n": "from 0"}).items():
        (tmp_path / "t.csv").write_text(text)
        refused(lambda: read_slots(tmp_path / "t.csv", some), found)


def test_legacy_holds_the_tensors_the_poses_and_what_each_number_is(event_set, tmp_path):
    torch = pytest.importorskip("torch")
    export_events(event_set, tmp_path / "out", "legacy", models="counts", noise="own")
    out = tmp_path / "out"
    moved, turned = np.load(out / "RunTranslate.npy"), np.load(out / "RunRotate.npy")
    assert moved.shape == turned.shape == (5, 3)
    shows = rows_of(out, "slots.csv")
    numbers = event_set.system.numbers.tolist()
    for i, event in enumerate(event_set):
        truth, images = (torch.load(out / f"{name}_{i}.pt", weights_only=True) for name in ("truth", "Projections"))
        assert truth.dtype == images.dtype == torch.float32
        assert np.array_equal(truth, event.truth.array[None])
        expected = event.images("counts", noise_seed=event.noise_seed)
        assert images.shape == (1, 16, 12, 12)
        for slot, row in enumerate(shows):
            image = expected[numbers.index(int(row["module"]))]
            assert np.array_equal(images[0, slot], image[:, ::-1] if row["mirrored"] == "1" else image)
        for n in (16, 6):
            assert np.array_equal(torch.load(out / f"ProjRadon{n}_{i}.pt", weights_only=True), event.radon(n)[None])
        assert np.allclose(mph.euler_pose(*turned[i], moved[i]), event.pose, atol=1e-9)
    rows = rows_of(out, "events.csv")
    assert [int(row["event"]) for row in rows] == event_set.numbers
    assert [int(row["noise_seed"]) for row in rows] == [event.noise_seed for event in event_set]


def test_numbers_of_files_are_the_exports_own(event_set, tmp_path):
    part = event_set.split("test")
    export_events(part, tmp_path / "out", "npz")
    assert sorted(p.name for p in (tmp_path / "out").glob("*.npz")) == [f"{i:06d}.npz" for i in range(len(part))]
    rows = rows_of(tmp_path / "out", "events.csv")
    assert [(row["i"], row["event"], row["split"]) for row in rows] == [
        (str(i), str(event.number), "test") for i, event in enumerate(part)
    ]
    export_events(event_set[:2] + event_set[1:3], tmp_path / "joined", "npz")  # one event twice
    assert [row["event"] for row in rows_of(tmp_path / "joined", "events.csv")] == ["0", "1", "1", "2"]
    assert len(list((tmp_path / "joined").glob("*.npz"))) == 4


def test_3dunet_pairs_slots_with_radon_images_of_one_shape(event_set, tmp_path):
    export_events(event_set, tmp_path / "out", "3dunet", models="counts")
    for i, event in enumerate(event_set):
        with h5py.File(tmp_path / "out" / event.split / f"{i:06d}.h5") as file:
            raw, label = file["raw"], file["label"]
            assert raw.dtype == label.dtype == np.float32 and raw.shape == label.shape == (16, 12, 12)
            assert np.array_equal(raw[:4], event.images("counts")[:4])
            assert np.array_equal(raw[4], np.fliplr(event.images("counts")[3]))
            assert np.array_equal(label, event.radon(16))


def test_3dunet_pairs_back_projections_with_the_truth_as_z_y_x(event_set, tmp_path):
    export_events(event_set, tmp_path / "out", "3dunet", models="rays", raw="backprojection")
    event = event_set[0]
    with h5py.File(tmp_path / "out" / event.split / "000000.h5") as file:
        raw, label = file["raw"][()], file["label"][()]
    assert raw.shape == label.shape == (8, 9, 10)
    assert label[1, 4, 6] == event.truth.array[6, 4, 1]
    assert np.array_equal(label, np.moveaxis(event.truth.array, (0, 1, 2), (2, 1, 0)))
    expected = mph.backproject(event.images("rays"), event.views, event.truth.grid)
    assert np.allclose(raw, expected.array.transpose(2, 1, 0), rtol=1e-6)


def test_a_level_does_not_change_the_scale_of_back_projections(event_set, tmp_path):
    """Line integrals are per time: a share of the time makes them noisier, not smaller."""
    sums = []
    for level in (1.0, 0.5):
        folder = tmp_path / str(level)
        export_events(event_set[:1], folder, "3dunet", models="counts", noise=1, level=level, raw="backprojection")
        (path,) = folder.glob("*/000000.h5")
        with h5py.File(path) as file:
            sums.append(file["raw"][()].sum(dtype=float))
    counts = event_set[0].images("counts").sum(dtype=float)
    assert abs(sums[1] / sums[0] - 1) < 10 * np.sqrt(2 / counts)


def test_3dunet_says_what_does_not_fit(event_set, tmp_path):
    one_model = "takes the images of one model: choose one of counts, rays"
    refused(lambda: export_events(event_set, tmp_path, "3dunet"), one_model)
    (tmp_path / "few.csv").write_text("slot,module,mirrored\n0,1,0\n")
    options = {"models": "rays", "slots": tmp_path / "few.csv"}
    slots = "1 slots need Radon images of as many angles .* has 16, 6"
    refused(lambda: export_events(event_set, tmp_path / "out", "3dunet", **options), slots)


def read_shards(folder: Path) -> dict[str, dict[str, object]]:
    """Return WebDataset's samples: members that are equal up to the first dot, which follow each other."""
    samples: dict[str, dict[str, object]] = {}
    for path in sorted(folder.glob("*.tar")):
        before = None
        with tarfile.open(path) as tar:
            for member in tar:
                key, _, ending = member.name.partition(".")
                assert key == before or f"{path.stem} {key}" not in samples
                data = tar.extractfile(member).read()
                data = gzip.decompress(data) if ending.endswith(".gz") else data
                value = json.loads(data) if ending.endswith("json") else np.load(io.BytesIO(data))
                samples.setdefault(f"{path.stem} {key}", {})[ending] = value
                before = key
    return samples


def test_webdataset_has_an_event_a_key_in_shards_of_a_split(event_set, tmp_path):
    export_events(event_set, tmp_path / "out", "webdataset", events_per_shard=2, noise=5, level=0.5)
    samples = read_shards(tmp_path / "out")
    assert len(samples) == 5
    for name, sample in samples.items():
        shard, key = name.split()
        event = event_set[int(key)]
        assert set(sample) == {"json", *(f"{name}.npy.gz" for name in ("truth", "counts", "rays", "radon16", "radon6"))}
        assert np.array_equal(sample["truth.npy.gz"], event.truth.array)
        assert np.array_equal(sample["rays.npy.gz"], event.images("rays"))
        said = sample["json"]
        assert np.array_equal(sample["counts.npy.gz"], event.images("counts", said["noise_seed"], 0.5))
        assert shard.startswith(event.split) and said["number"] == event.number
        assert np.allclose(said["pose"], event.pose) and said["settings"]["activity"] == event.settings["activity"]
    seeds = {sample["json"]["noise_seed"] for sample in samples.values()}
    assert len(seeds) == 5, "events of one seed have noise each of its own"


def test_uncompressed_shards_hold_the_same_as_compressed_ones(event_set, tmp_path):
    for name in ("packed", "plain"):
        export_events(event_set, tmp_path / name, "webdataset", uncompressed=name == "plain")
    plain = read_shards(tmp_path / "plain")
    for name, sample in read_shards(tmp_path / "packed").items():
        for ending, value in sample.items():
            same = plain[name][ending.removesuffix(".gz")]
            assert np.array_equal(value, same) if ending != "json" else value == same


def test_compressed_exports_are_at_most_a_fifth_larger_than_the_set(tmp_path):
    text = TEXT.replace("voxels = 16", "voxels = 96").replace("spacing = 6.0", "spacing = 1.0")
    text = text.replace("rows = 14", "rows = 96").replace("columns = 16", "columns = 96")
    there = mph.events.make(small_recipe(tmp_path, text), tmp_path / "set", 2)
    size = sum(event.path.stat().st_size for event in there)
    for program in ("webdataset", "npz"):
        export_events(there, tmp_path / program, program)
        written = sum(path.stat().st_size for path in (tmp_path / program).iterdir())
        assert written <= 1.2 * size, (program, written / size)


def test_npz_holds_all_that_is_known(event_set, tmp_path):
    export_events(event_set[:1], tmp_path / "out", "npz")
    event = event_set[0]
    with np.load(tmp_path / "out" / "000000.npz") as file:
        assert set(file) == {"truth", "truth_affine", "counts", "rays", "radon16", "radon6", "pose", "record"}
        assert np.array_equal(file["truth"], event.truth.array)
        assert np.array_equal(file["truth_affine"], event.truth.grid.affine)
        assert np.array_equal(file["pose"], event.pose)
        assert json.loads(str(file["record"]))["units"] == {"counts": "counts", "rays": event.unit("rays")}


OPTIONS = {"legacy": {"models": "rays"}, "3dunet": {"models": "rays"}, "webdataset": {"events_per_shard": 2}, "npz": {}}


@pytest.mark.parametrize("program", PROGRAMS)
def test_exports_that_stopped_go_on_and_more_events_are_added_and_the_bytes_are_the_same(program, event_set, tmp_path):
    if program == "legacy":
        pytest.importorskip("torch")
    options = OPTIONS[program]
    export_events(event_set, tmp_path / "whole", program, **options)

    def stop(done: int, total: int) -> None:
        if done == 3:
            raise mph.Cancelled

    with pytest.raises(mph.Cancelled):
        export_events(event_set, tmp_path / "parts", program, progress=stop, **options)
    there = {path: path.stat().st_ino for path in (tmp_path / "parts").rglob("*.*") if "0" in path.stem}
    assert there
    export_events(event_set, tmp_path / "parts", program, **options)
    assert tree(tmp_path / "parts") == tree(tmp_path / "whole")
    assert {path: path.stat().st_ino for path in there} == there, "what was there is kept"
    export_events(event_set[:3], tmp_path / "grown", program, **options)
    export_events(event_set, tmp_path / "grown", program, **options)
    assert tree(tmp_path / "grown") == tree(tmp_path / "whole")


def test_what_a_killed_export_was_writing_is_removed(event_set, tmp_path):
    """Programs take all files of a folder, hidden ones as well."""
    out = tmp_path / "out"
    out.mkdir()
    (out / ".0a1b2c3d-export.json").write_text("{")
    export_events(event_set, out, "3dunet", models="rays")
    whole = tree(out)
    (out / "train" / ".0a1b2c3d-000000.h5").write_bytes(b"half")
    (out / ".0a1b2c3d-events.csv").write_text("i")
    export_events(event_set, out, "3dunet", models="rays")
    assert tree(out) == whole


def test_another_table_of_slots_is_another_export(event_set, tmp_path):
    slots = tmp_path / "slots.csv"
    slots.write_text(row_slots(event_set.system).table(event_set.system))
    export_events(event_set, tmp_path / "out", "3dunet", models="rays")
    export_events(event_set, tmp_path / "out", "3dunet", models="rays", slots=slots, raw="slots")
    slots.write_text(slots.read_text().replace(",1\n", ",0\n"))
    again = {"models": "rays", "slots": slots}
    refused(lambda: export_events(event_set, tmp_path / "out", "3dunet", **again), "differs in options")


def test_folders_that_hold_something_else_are_refused(event_set, tmp_path):
    export_events(event_set, tmp_path / "out", "npz", models="rays")
    before = tree(tmp_path / "out")
    refused(lambda: export_events(event_set, tmp_path / "out", "npz"), "differs in models")
    refused(lambda: export_events(event_set, tmp_path / "out", "webdataset", models="rays"), "differs in program")
    refused(lambda: export_events(event_set[1:], tmp_path / "out", "npz", models="rays"), "other events")
    assert tree(tmp_path / "out") == before
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").write_text("mine")
    refused(lambda: export_events(event_set, tmp_path / "full", "npz"), "expected a new or empty folder")


@pytest.mark.parametrize(
    ("options", "found"),
    [
        ({"models": "heart"}, "model 'heart': expected one of counts, rays"),
        ({"noise": -1}, "noise -1: expected own"),
        ({"level": 0.5}, "level: needs noise"),
        ({"models": "rays", "noise": 1}, "only counts and photons have it"),
        ({"raw": "slots"}, "npz: no option 'raw', it has none"),
    ],
)
def test_what_cannot_be_exported_is_said(options, found, event_set, tmp_path):
    refused(lambda: export_events(event_set, tmp_path / "out", "npz", **options), found)
    assert not (tmp_path / "out").exists()


def test_command_says_the_size_first_and_writes(event_set, tmp_path, command):
    words = ["events", "export", event_set[0].path.parents[1], "--to", "webdataset", "--split", "train"]
    words += ["--model", "counts", "-o", tmp_path / "out"]
    printed = command(*words, "--noise", "own", "--level", 0.25, "--events-per-shard", 2)
    train = event_set.split("train")
    size = 4 * (10 * 9 * 8 + 8 * 12 * 12 + 22 * 12 * 12)
    assert printed.err.startswith(f"mphdrr: {len(train)} events of at most {size / 2**10:.0f} KiB, ")
    samples = read_shards(tmp_path / "out")
    assert len(samples) == len(train)
    assert all(sample["json"]["level"] == 0.25 for sample in samples.values())
    assert "expected own, or a seed" in command(*words, "--noise", "loud", status=2).err


def test_make_new_and_export_say_what_they_did_as_json(tmp_path, command):
    recipe, folder = tmp_path / "small.toml", str(tmp_path / "set")

    def said(*words: str) -> dict[str, object]:
        return json.loads(command("events", *words, "--json").out)  # nothing else is on standard output

    new = said("new", "-o", str(recipe))
    assert new == {"file": str(recipe), "recipe": recipe.read_text(encoding="utf-8")}
    printed = said("new")
    assert printed["file"] is None and "[[phantoms]]" in printed["recipe"]
    small_recipe(tmp_path)
    made = said("make", folder, "--recipe", str(recipe), "-n", "3", "--first", "1")
    assert made == {"folder": folder, "asked": 3, "events": 3, "made": 3}
    assert said("make", folder, "-n", "4") == {"folder": folder, "asked": 4, "events": 4, "made": 1}
    out = str(tmp_path / "npz")
    exported = said("export", folder, "--to", "npz", "-o", out)
    assert exported == {"folder": out, "program": "npz", "events": 4}
