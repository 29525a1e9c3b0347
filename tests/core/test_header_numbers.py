"""Counts, sizes and levels in files' headers: a number that cannot be one is refused at once, whatever the format."""

from __future__ import annotations

import functools
import gzip
import re
import struct
import time
import tracemalloc
from pathlib import Path

import h5py
import nibabel
import numpy as np
import pytest
from pydicom.datadict import tag_for_keyword
from pydicom.dataset import Dataset

import mphdrr.core as mph

from .conftest import refused
from .dicom_files import set_tags, write_frames, write_tomogram

SECONDS, BYTES = 1.0, 1 << 26
VALUES = ("1e308", "-1", "2.5", "999999999999", "99999999", "nan")
FRAMES = np.arange(2 * 3 * 4, dtype="<u2").reshape(2, 3, 4)
VOLUME = mph.Volume(np.ones((4, 3, 2)), mph.Grid.centered((4, 3, 2), 1.0))

INTERFILE = """!INTERFILE :=
!name of data file := f.sin
data offset in bytes := 0
!total number of images := 2
imagedata byte order := LITTLEENDIAN
number of energy windows := 1
energy window lower level [1] := 130
energy window upper level [1] := 151
number of detector heads := 1
!matrix size [1] := 4
!matrix size [2] := 3
!number format := unsigned integer
!number of bytes per pixel := 2
!image duration (sec) := 600
!number of images this frame group := 2
pause between images (sec) := 1
"""
METAIMAGE = """ObjectType = Image
NDims = 3
HeaderSize = 0
DimSize = 4 3 2
ElementSpacing = 1 1 1
ElementNumberOfChannels = 1
Offset = 0 0 0
ElementType = MET_USHORT
ElementDataFile = f.raw
"""
NRRD = """NRRD0004
type: uint16
dimension: 3
sizes: 4 3 2
encoding: raw
endian: little
line skip: 0
byte skip: 0
space: right-anterior-superior
space directions: (1,0,0) (0,1,0) (0,0,1)
space origin: (0,0,0)
data file: f.raw
"""


def _header(folder: Path, text: str, key: str, value: str, name: str) -> Path:
    """Write a header in text, in which the first number of `key` is `value`, "" for its own, and the numbers beside it."""
    changed, count = re.subn(
        rf"(?m)^(!?{re.escape(key)}\s*:?=?\s*)([\d.]+)", lambda match: match[1] + (value or match[2]), text
    )
    assert count == 1, key
    (folder / name).write_text(changed)
    for data in ("f.sin", "f.raw"):
        FRAMES.tofile(folder / data)
    return folder / name


def interfile(folder: Path, key: str, value: str):
    text = INTERFILE
    if key == "number of images in time window":
        text += "!gated frame mode := on\n!number of images in time window := 2\n"
    elif key == "data starting block":
        text = text.replace("data offset in bytes", key)
    path = _header(folder, text, key, value, "f.hdr")
    return lambda: mph.read_counts(path)


def metaimage(folder: Path, key: str, value: str):
    path = _header(folder, METAIMAGE, key, value, "f.mhd")
    return lambda: mph.read_volume(path, "activity")


def metaimage_counts(folder: Path, key: str, value: str):
    path = _header(folder, METAIMAGE, key, value, "f.mhd")
    return lambda: mph.read_counts(path)


def nrrd(folder: Path, key: str, value: str):
    path = _header(folder, NRRD, key, value, "f.nhdr")
    return lambda: mph.read_volume(path, "activity")


WORDS = {"1e308": 32767, "-1": -1, "2.5": 0, "999999999999": 30000, "99999999": 9999, "nan": -32768}
"""Numbers of 16 bits in place of the values."""


def _binary_header(folder: Path, image, names: tuple[str, str], key: str, value: str):
    """Write an image by nibabel, and into the header in the first of its files `value`; read the second."""
    nibabel.save(image, folder / "f.nii" if names[0].endswith("nii") else folder / "f.hdr")
    data = bytearray((folder / names[0]).read_bytes())
    offset, form = {"dim[0]": (40, "h"), "dim[1]": (42, "h"), "vox_offset": (108, "f")}[key]
    if value:
        struct.pack_into(f"<{form}", data, offset, WORDS[value] if form == "h" else min(float(value), 3e38))
    (folder / names[0]).write_bytes(data)
    return lambda: mph.read_volume(folder / names[1], "activity")


def nifti(folder: Path, key: str, value: str):
    return _binary_header(folder, nibabel.Nifti1Image(VOLUME.array, np.eye(4)), ("f.nii", "f.nii"), key, value)


def analyze(folder: Path, key: str, value: str):
    return _binary_header(folder, nibabel.AnalyzeImage(VOLUME.array, np.eye(4)), ("f.hdr", "f.img"), key, value)


def packed_nifti(folder: Path, key: str, value: str):
    """Write the value as each of the three sizes: a packed file can hold a thousand times its bytes."""
    nibabel.save(nibabel.Nifti1Image(VOLUME.array, np.eye(4)), folder / "f.nii")
    data = bytearray((folder / "f.nii").read_bytes())
    if value:
        struct.pack_into("<3h", data, 42, *[min(WORDS[value], 600)] * 3)
    (folder / "f.nii.gz").write_bytes(gzip.compress(data))
    return lambda: mph.read_volume(folder / "f.nii.gz", "activity")


def _tag(path: Path, key: str, value: str) -> None:
    """Write `value` as text (IS) or 16 bits (US) into the tag of a DICOM file of explicit VR, little endian."""
    if not value:
        return
    tag = tag_for_keyword(key)
    data = path.read_bytes()
    place = data.index(struct.pack("<HH", tag >> 16, tag & 0xFFFF) + (b"IS" if key == "NumberOfFrames" else b"US"))
    (length,) = struct.unpack_from("<H", data, place + 6)
    text = value.encode() + b" " * (len(value) % 2) if key == "NumberOfFrames" else struct.pack("<h", WORDS[value])
    path.write_bytes(data[: place + 6] + struct.pack("<H", len(text)) + text + data[place + 8 + length :])


def dicom_counts(folder: Path, key: str, value: str):
    write_frames(FRAMES, folder / "f.dcm", 1000, NumberOfEnergyWindows=1, NumberOfRotations=1)
    _tag(folder / "f.dcm", key, value)
    return lambda: mph.read_counts(folder / "f.dcm")


def dicom_volume(folder: Path, key: str, value: str):
    write_tomogram(mph.Volume(VOLUME.array * 3, VOLUME.grid), folder / "f.dcm", Units="BQML", SliceVector=None)
    _tag(folder / "f.dcm", key, value)
    return lambda: mph.read_volume(folder / "f.dcm", "activity")


def raw(folder: Path, key: str, value: str):
    FRAMES.tofile(folder / "f.raw")
    shape = [2, 3, 4]
    shape[int(key)] = float(value) if value else shape[int(key)]
    return lambda: mph.read_counts(folder / "f.raw", shape=shape, type="uint16")


def npy(folder: Path, key: str, value: str):
    np.save(folder / "f.npy", FRAMES)
    data = (folder / "f.npy").read_bytes()
    new = f"({value or 2}, 3, 4), }}"
    (folder / "f.npy").write_bytes(data.replace(b"(2, 3, 4), }" + b" " * (len(new) - 12), new.encode()))
    return lambda: mph.read_counts(folder / "f.npy")


KEYS = [
    *((interfile, key) for key in (
        "matrix size [1]", "matrix size [2]", "number of bytes per pixel", "total number of images",
        "number of energy windows", "number of detector heads", "data offset in bytes", "data starting block",
        "number of images this frame group", "number of images in time window",
    )),
    *((reader, key) for reader in (metaimage, metaimage_counts)
      for key in ("DimSize", "HeaderSize", "ElementNumberOfChannels", "NDims")),
    *((nrrd, key) for key in ("dimension", "sizes", "line skip", "byte skip")),
    *((nifti, key) for key in ("dim[0]", "dim[1]", "vox_offset")), (packed_nifti, "dim"),
    *((analyze, key) for key in ("dim[0]", "dim[1]")),
    *((dicom_counts, f"NumberOf{key}") for key in ("Frames", "EnergyWindows", "Detectors", "Rotations")),
    *((dicom_volume, f"NumberOf{key}") for key in ("Frames", "Slices")),
    *((reader, key) for reader in (dicom_counts, dicom_volume) for key in ("Rows", "Columns")),
    *((raw, key) for key in "012"), (npy, "shape"),
]  # fmt: skip
MEANT = {  # -1: from the end of the file; 0 in a tag of DICOM: not stated
    *((name, "-1") for name in ("HeaderSize", "byte skip")),
    *((f"NumberOf{name}", "2.5") for name in ("EnergyWindows", "Detectors", "Rotations", "Slices")),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("reader", "key"), KEYS, ids=lambda x: getattr(x, "__name__", x))
def test_a_number_that_drives_a_loop_or_memory_is_refused_at_once(tmp_path, reader, key):
    reader(tmp_path, key, "")()
    for value in VALUES:
        if (key, value) in MEANT:
            continue
        read = reader(tmp_path, key, value)
        tracemalloc.start()
        begin = time.process_time()
        try:
            with pytest.raises(mph.InputError) as error:
                read()
            seconds, peak = time.process_time() - begin, tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert "\n" not in str(error.value) and len(str(error.value)) < 400 + len(str(tmp_path)), value
        assert seconds < SECONDS and peak < BYTES, (value, seconds, peak)


def test_bytes_and_lines_before_the_numbers_may_be_more_than_the_headers(tmp_path):
    (tmp_path / "f.nhdr").write_text(NRRD.replace("byte skip: 0", "byte skip: 5000"))
    (tmp_path / "f.raw").write_bytes(bytes(5000) + FRAMES.tobytes())
    np.testing.assert_array_equal(mph.read_volume(tmp_path / "f.nhdr", "activity").array, FRAMES.transpose(2, 1, 0))


def test_an_hdf5_array_without_its_numbers_is_refused_at_once(tmp_path):
    with h5py.File(tmp_path / "f.h5", "w") as file:
        file.create_dataset("array", (999999999999, 3, 4), "u2", chunks=(64, 3, 4)).attrs["quantity"] = "activity"
        file["affine"] = np.eye(4)
    refused(lambda: mph.read_counts(tmp_path / "f.h5"), "needs .* of memory")
    refused(lambda: mph.read_volume(tmp_path / "f.h5"), "needs .* of memory")


@pytest.mark.parametrize("form", ["Interfile", "DICOM"])
def test_an_energy_window_upside_down_is_refused(tmp_path, form):
    if form == "Interfile":
        (tmp_path / "f.hdr").write_text(INTERFILE.replace(":= 151", ":= 15.1"))
        FRAMES.tofile(tmp_path / "f.sin")
        read = functools.partial(mph.read_counts, tmp_path / "f.hdr")
    else:
        limits = set_tags(Dataset(), EnergyWindowLowerLimit=130, EnergyWindowUpperLimit=15.1)
        window = set_tags(Dataset(), EnergyWindowRangeSequence=[limits])
        write_frames(FRAMES, tmp_path / "f.dcm", 1000, EnergyWindowInformationSequence=[window])
        read = functools.partial(mph.read_counts, tmp_path / "f.dcm")
    refused(read, "energy window from 130 to 15.1 keV: expected the lower level first")
