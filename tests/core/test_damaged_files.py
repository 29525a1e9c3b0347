"""Damage of one bit: an error in one line, or the same content; never other numbers without a word."""

import gzip
import json
import warnings
import zipfile
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core import hdf5

from .conftest import needs_torch, refused, run_python
from .test_volume_formats import write_meta_image


@pytest.fixture
def volume(rng) -> mph.Volume:
    affine = np.diag([1.25, 0.7, 2.0, 1.0])
    affine[:3, 3] = (-3.5, 1.25, 7.75)
    return mph.Volume(rng.normal(size=(4, 5, 6)), mph.Grid((4, 5, 6), affine), "mu")


@pytest.fixture
def run(system, volume, rng) -> mph.ProjectionRun:
    views = system.views(shape=(4, 6), detector="virtual", magnification=2.0)
    images = rng.uniform(size=(len(system), 4, 6)).astype(np.float32)
    background = rng.uniform(size=images.shape).astype(np.float32)
    return mph.ProjectionRun(
        images, system, views, volume, settings={"a": [1, 2.5]}, seed=7, workbook="w.xlsx", background=background
    )


@pytest.fixture
def result(volume) -> mph.Reconstruction:
    return mph.Reconstruction(volume, np.array([1.0, 2.5]), {"method": "mlem"}, {"previous": np.arange(7.0)})


def content(value: Any) -> Any:
    """Return all that a volume, a run or a reconstruction says, to be compared."""
    if isinstance(value, mph.Volume):
        return value.array.tobytes(), value.grid.shape, value.grid.affine.tobytes(), value.quantity
    if isinstance(value, mph.ProjectionRun):
        arrays = [value.projections, value.system.centers, value.system.numbers, value.system.pinhole_diameter]
        arrays += [value.views.sources, value.views.u_steps, np.asarray(value.background), value.system.roi_radius]
        texts = value.unit, value.settings, value.seed, value.workbook, value.workbook_sha256, value.versions
        return [array.tobytes() for array in arrays], *texts, content(value.volume)
    state = sorted((name, array.tobytes()) for name, array in value.state.items())
    return content(value.volume), value.objective.tobytes(), state, value.settings


def flipped(data: bytes, bit: int) -> bytes:
    """Return the data with one bit flipped."""
    damaged = bytearray(data)
    damaged[bit // 8] ^= 1 << bit % 8
    return bytes(damaged)


def outcome(path: Path, read: Callable[[Path], Any], expected: Any) -> str:
    """Return what becomes of a damaged file: "same", "refused", or what is wrong."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return "same" if content(read(path)) == expected else "silent"
    except mph.InputError as error:
        text = str(error)
        return "refused" if path.name in text and "\n" not in text else f"unclear: {text}"
    except Exception as error:
        return f"raw: {error!r}"


FILES = {
    "run": (mph.write_run, mph.read_run),
    "volume": (mph.write_volume, mph.read_volume),
    "result": (mph.write_reconstruction, mph.read_reconstruction),
}
NAMES = ["run.h5", "run.npz", "volume.h5", "volume.npz", "volume.nii.gz", "volume.nrrd", "result.h5"]


@pytest.mark.parametrize(
    ("seed", "count"), [(5, 200), *(pytest.param(k, 1000, marks=pytest.mark.long) for k in (0, 1))]
)
@pytest.mark.parametrize("name", [*NAMES, pytest.param("run.pt", marks=needs_torch)])
def test_no_flipped_bit_is_silent(tmp_path, request, name, seed, count):
    """Of NRRD only the voxels have a checksum, not the text before them."""
    kind, path = name.partition(".")[0], tmp_path / name
    write, read = FILES[kind]
    write(subject := request.getfixturevalue(kind), path)
    assert kind != "result" or content(mph.read_volume(path)) == content(subject.volume)
    data, expected = path.read_bytes(), content(read(path))
    start = data.index(b"\n\n") + 2 if path.suffix == ".nrrd" else 0
    outcomes = {}
    for bit in np.random.default_rng(seed).integers(8 * start, 8 * len(data), count).tolist():
        path.write_bytes(flipped(data, bit))
        outcomes[bit] = outcome(path, read, expected)
    assert {bit: text for bit, text in outcomes.items() if text not in ("same", "refused")} == {}
    assert list(outcomes.values()).count("refused") > 0.5 * len(outcomes)


@pytest.mark.long
def test_every_bit_of_a_seal_counts(tmp_path):
    """Also of what it says beside the content, such as an event's number."""
    whole = bytes(hdf5.pack("mphDRR thing", {"number": "12"}, lambda file: file.create_dataset("a", data=[1.0, 2.0])))
    for bit in range(8 * len("mphDRR "), 8 * hdf5.HEADER):
        (tmp_path / "a.h5").write_bytes(flipped(whole, bit))
        refused(lambda: hdf5.verify(tmp_path / "a.h5"))


def test_damage_is_called_so_and_stops_no_other_thread(tmp_path, rng):
    """In any block of a large file: h5py loses what is raised while it reads."""
    grid = mph.Grid((60, 60, 60), np.eye(4))
    volume = mph.Volume(rng.normal(size=grid.shape), grid, "mu")
    mph.write_volume(volume, tmp_path / "whole.h5")
    whole = (tmp_path / "whole.h5").read_bytes()
    assert len(whole) > 8 << 16
    for place in range(hdf5.HEADER, len(whole), 1 << 16):
        (tmp_path / "a.h5").write_bytes(flipped(whole, 8 * place))
        refused(lambda: mph.read_volume(tmp_path / "a.h5"), "a.h5", "changed")
    with ThreadPoolExecutor(1) as pool:
        assert content(pool.submit(mph.read_volume, tmp_path / "whole.h5").result(20)) == content(volume)


@pytest.mark.parametrize("place", [600, 2000, 70000])
def test_damage_that_is_found_while_hdf5_reads_is_an_error_and_no_crash(tmp_path, place):
    """Of a process, too, when it ends."""
    whole = hdf5.pack(
        "mphDRR x", {}, lambda file: [file.create_dataset(f"g{i}/a", data=np.arange(9999.0)) for i in (1, 2)]
    )
    (tmp_path / "a.h5").write_bytes(flipped(whole, 8 * place))
    code = f"""
from mphdrr.core import hdf5, InputError
try:
    with hdf5.opened({str(tmp_path / "a.h5")!r}) as file:
        print([hdf5.read_numbers(file[f"g{{i}}/a"]).sum() for i in (1, 2)])
except InputError as error:
    print(error)
"""
    done = run_python(code)
    assert done.returncode == 0 and done.stderr == ""
    assert done.stdout.endswith("a.h5: changed: its bytes are not those that were written\n")


@pytest.mark.parametrize("name", NAMES[:-1])
def test_a_cut_file_or_another_one_is_refused_wherever_it_is_cut(tmp_path, request, name):
    kind, path = name.partition(".")[0], tmp_path / name
    write, read = FILES[kind]
    write(request.getfixturevalue(kind), path)
    data = path.read_bytes()
    whole = len(data) - (8 if path.suffix == ".nrrd" else 0)  # its last bytes are only a checksum
    for size in (0, 1, 300, 511, 600, len(data) // 3, len(data) // 2, len(data) - 9, len(data) - 8, len(data) - 1):
        path.write_bytes(data[:size])
        if size < whole:
            refused(lambda: read(path), str(path))
    path.write_bytes(b"not a run" * 50)
    refused(lambda: read(path), str(path))


def test_the_checksum_of_a_packed_metaimage_is_read(tmp_path, rng):
    array = rng.integers(0, 200, (4, 5, 6)).astype("<i2")
    data = zlib.compress(array.tobytes("F"))
    for wrong in (data[:-4], data[:-1], data[:-1] + bytes([data[-1] ^ 1])):
        write_meta_image(tmp_path / "a.mha", array, data=wrong, CompressedData="True")
        refused(lambda: mph.read_volume(tmp_path / "a.mha"), "a.mha")


def test_files_of_earlier_versions_are_read(tmp_path, run, volume):
    """Which have no seal and no checksum."""
    mph.write_run(run, tmp_path / "run.h5")
    with hdf5.opened(tmp_path / "run.h5") as new, h5py.File(tmp_path / "old.h5", "w") as old:
        old.attrs.update(new.attrs)
        for name in new:
            new.copy(name, old)
    assert content(mph.read_run(tmp_path / "old.h5")) == content(run)
    assert content(mph.read_volume(tmp_path / "old.h5")) == content(volume)

    mph.write_run(run, tmp_path / "run.npz")
    arrays = dict(np.load(tmp_path / "run.npz"))
    attributes = json.loads(str(arrays.pop("attributes")))
    assert len(attributes.pop("sha256")) == 64
    np.savez(tmp_path / "old.npz", attributes=np.array(json.dumps(attributes)), **arrays)
    assert content(mph.read_run(tmp_path / "old.npz")) == content(run)


def test_an_edited_array_is_noticed(tmp_path, run):
    """Though the archive's own checksums are those of the edited one."""
    mph.write_run(run, tmp_path / "run.npz")
    arrays = dict(np.load(tmp_path / "run.npz"))
    arrays["geometry/center"] = arrays["geometry/center"] + 1e-6
    np.savez(tmp_path / "run.npz", **arrays)
    refused(lambda: mph.read_run(tmp_path / "run.npz"), "run.npz", "changed")


def test_a_packed_nifti_with_something_behind_its_voxels_is_read(tmp_path, volume):
    mph.write_volume(volume, tmp_path / "v.nii")
    (tmp_path / "w.nii.gz").write_bytes(gzip.compress((tmp_path / "v.nii").read_bytes() + b"more"))
    assert np.array_equal(mph.read_volume(tmp_path / "w.nii.gz").array, volume.array)


def test_an_archive_with_more_than_is_wanted_is_read(tmp_path, volume):
    mph.write_volume(volume, tmp_path / "v.npz")
    with zipfile.ZipFile(tmp_path / "v.npz", "a") as archive:
        archive.writestr("notes.npy", b"no array")
    assert np.array_equal(mph.read_volume(tmp_path / "v.npz").array, volume.array)
