"""Files with frames of counts, as scanners and simulators write them: numpy, HDF5, raw, DICOM, MetaImage, Interfile.

A file says at most what its frames are: which module each is of, and how it lies on the crystal, stands in none of them.
"""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Array, Floats
from ..errors import InputError, reading
from ..files import AnyPath, require_file
from ..hdf5 import datasets, opened, read_numbers
from ..memory import require
from ..progress import Progress, tell
from ..recording import recorded_warnings
from ..validation import one_of, shape_text, whole_shape
from ..volumes.formats import metaimage, numpy_files
from ..volumes.formats.dicom import TOMOGRAMS, decode_pixels, image_kind, is_dicom, require_grey

RAW_TYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64", "float32", "float64")
"""Types of the numbers in raw files."""
_NUMPY = (".npy", ".npz")
_HDF5 = (".h5", ".hdf5")
_META = (".mhd", ".mha")
_INTERFILE = (".hdr", ".h33", ".hs")
COUNTS_FORMATS = (*_NUMPY, *_HDF5, ".dcm", *_META, *_INTERFILE, ".raw", ".bin", ".dat")
"""Endings of files with counts; DICOM files may have any name, and so may raw ones."""
_SAME_SIZE = 1e-3  # relative; files round pixel sizes


class Counts(np.ndarray[Any, Any]):
    """Frames of counts (frames, rows, columns), with what their files say of them: an array like any other.

    Slices of it keep that; what is calculated from it is a plain array.

    Attributes
    ----------
    about : array (frames, 7)
        Of each frame its exposure, s, the size of its pixels along a row and down the columns, mm, the number of its energy
        window, its start, s after that of the first frame of all, and the lowest and highest energy of its window, keV; NaN
        where the file does not say it.
    kind : str
        What the frames are of, such as "2 energy windows".
    name : str
        Of the files.
    """

    about: Floats

    def __array_finalize__(self, source: Any) -> None:
        self.kind, self.name = getattr(source, "kind", ""), getattr(source, "name", "counts")
        is_same = isinstance(source, Counts) and source.shape == self.shape
        self.about = source.about if is_same else np.full((*self.shape[:1], 7), math.nan)

    def __getitem__(self, key: Any) -> Any:
        found = super().__getitem__(key)
        if isinstance(found, Counts) and found.ndim == 3:
            about = self.about[key[0] if isinstance(key, tuple) and key else key]
            found.about = about if about.shape == found.about.shape else found.about
        return found

    def __array_wrap__(self, array: Array, *_: Any) -> Any:  # type: ignore[override]
        return np.asarray(array)[()]

    def exposures(self, which: Any = slice(None)) -> list[float]:
        """The exposures, s, that the files say of the frames `which`, each once."""
        return [time for time in np.unique(self.about[which, 0]).tolist() if math.isfinite(time)]


@dataclass(frozen=True)
class Layout:
    """What the user says about a file."""

    dataset: str | None = None
    shape: tuple[int, int, int] | None = None
    type: str | None = None
    big_endian: bool = False

    @property
    def is_raw(self) -> bool:
        """Whether it describes raw numbers."""
        return self.shape is not None or self.type is not None or self.big_endian


def read_counts(
    path: AnyPath | Sequence[AnyPath],
    *,
    dataset: str | None = None,
    shape: tuple[int, int, int] | None = None,
    type: str | None = None,
    big_endian: bool = False,
    progress: Progress | None = None,
) -> Counts:
    """Read frames of counts (frames, rows, columns) as they are in a file, or in several, one after the other.

    Parameters
    ----------
    path
        .npy, .npz, .h5, nuclear medicine DICOM of several frames (.dcm), MetaImage (.mhd, .mha, as GATE 10 writes), the
        header of an Interfile pair (.hdr, as GATE 9 writes), or raw numbers. A file of one frame may have only two axes.
    dataset
        Name of the array in .npz and .h5, where they hold several of three axes.
    shape, type, big_endian
        Of raw files: (frames, rows, columns), one of uint8, int8, … float64, and the order of the bytes.
    progress
        Counts files.

    Returns
    -------
    Counts
        An array of three axes, frames, rows and columns, of the file's own type. `counts_run` checks its numbers, and
        compares its arguments with the exposure, pixel size and energy windows in the file.
    """
    layout = Layout(dataset, shape, type, big_endian)
    paths = [Path(path)] if isinstance(path, str | os.PathLike) else list(map(Path, path))
    if not paths:
        raise InputError("counts: expected a file, or several")
    found: list[Counts] = []
    for number, one in enumerate(paths, 1):
        found.append(_read(one, layout))
        first, last = found[0].shape[1:], found[-1].shape[1:]
        if first != last:
            size = f"{last[0]} x {last[1]} pixels, {paths[0]} of {first[0]} x {first[1]}"
            raise InputError(f"{one}: it holds frames of {size}; expected one size")
        tell(progress, number, len(paths))
    counts = found[0] if len(found) == 1 else np.concatenate(found).view(Counts)
    counts.about = np.concatenate([one.about for one in found])
    starts = counts.about[:, 4]  # until here after the day's beginning or that of an era
    starts -= np.min(starts, initial=np.inf, where=np.isfinite(starts))
    counts.kind = ", ".join(sorted({one.kind for one in found} - {""}))
    counts.name = ", ".join([*(one.name for one in paths[:3]), *(["…"] if len(paths) > 3 else [])])
    return counts


def _read(path: Path, layout: Layout) -> Counts:
    require_file(path)
    ending = path.suffix.lower()
    with reading(path, ending or "counts"):
        if layout.is_raw:
            return _counts(_raw(path, layout))
        if layout.dataset is not None and ending not in (".npz", *_HDF5):
            raise InputError("dataset (--dataset) names an array in .npz and .h5; this file has no names")
        return _reader(path, ending)(path, layout)


def _reader(path: Path, ending: str) -> Callable[[Path, Layout], Counts]:
    """What reads a file."""
    for endings, read in ((_NUMPY, _numpy), (_HDF5, _hdf5), (_META, _metaimage), (_INTERFILE, _interfile)):
        if ending in endings:
            return read
    if ending == ".dcm" or is_dicom(path):
        return _dicom
    header = path.with_suffix(".hdr")
    beside = f"its header {header.name}, which is beside it, or " if header.is_file() else ""
    raise InputError(
        f"expected {beside}a name ending in {', '.join(COUNTS_FORMATS)}; of raw numbers say the shape (--raw-shape "
        "FRAMES ROWS COLUMNS) and the type (--raw-type uint16)"
    )


def _counts(array: Array, kind: str = "", **known: Sequence[float]) -> Counts:
    """Checked frames, with an axis of frames also where there is only one, and what is `known` about them from the file.

    That is their `time` (s), `pixel` (along a row and down the columns, mm), energy `window` (number) with its `low` and
    `high` energy (keV), and `start` (s after any moment). Of these, fewer than frames are those of blocks of frames, which
    follow each other.
    """
    array = array[None] if array.ndim == 2 else array
    if array.ndim != 3 or not array.size:
        raise InputError(f"expected (frames, rows, columns), got shape {' x '.join(map(str, array.shape)) or '()'}")
    if array.dtype.kind not in "fiu":
        raise InputError(f"expected whole or real numbers, found {array.dtype}")
    counts = array.view(Counts)
    counts.kind, counts.about[:, 1:3] = kind, known.get("pixel", math.nan)
    for column, name in ((0, "time"), (3, "window"), (4, "start"), (5, "low"), (6, "high")):
        each = np.array(known.get(name) or [math.nan])
        counts.about[:, column] = each[np.arange(len(array)) * len(each) // len(array)]
    return counts


def _require_memory(shape: Sequence[int], itemsize: int) -> None:
    # The numbers, their float32 images, and the checks of them.
    require((itemsize + 9.0) * math.prod(map(int, shape)), f"counts of {shape_text(tuple(shape))}")


def _raw(path: Path, layout: Layout) -> Array:
    if layout.shape is None or layout.type is None:
        shape, kind = "shape (--raw-shape FRAMES ROWS COLUMNS)", "type (--raw-type, uint16 or so)"
        raise InputError(f"raw numbers need their {shape if layout.shape is None else kind}")
    one_of(layout.type, RAW_TYPES, "raw type")
    type_ = np.dtype(layout.type).newbyteorder(">" if layout.big_endian else "<")
    return _numbers(path, type_, whole_shape(layout.shape, "raw shape (--raw-shape)", 3))


def _numbers(path: Path, kind: np.dtype[Any], shape: tuple[int, ...], skip: int = 0) -> Array:
    """All numbers of a file behind its first `skip` bytes."""
    needed, size = skip + kind.itemsize * math.prod(shape), path.stat().st_size
    if needed != size:
        behind = f" behind {skip} bytes" if skip else ""
        what = f"{shape_text(shape)} numbers of {kind.itemsize} bytes{behind}"
        raise InputError(f"expected {needed} bytes ({what}), {path.name} has {size}")
    _require_memory(shape, kind.itemsize)
    return np.fromfile(path, kind, offset=skip).reshape(shape)


def _numpy(path: Path, layout: Layout) -> Counts:
    arrays = numpy_files.load(path)
    return _counts(arrays["" if path.suffix.lower() == ".npy" else _chosen(arrays, layout)])


def _hdf5(path: Path, layout: Layout) -> Counts:
    import h5py

    with opened(path, whole=True) as file:
        arrays = datasets(file)
        if layout.dataset is not None and isinstance(file.get(layout.dataset), h5py.Dataset):
            arrays[layout.dataset.strip("/")] = file[layout.dataset]  # of an array's names, the visit gives one
        dataset = arrays[_chosen(arrays, layout)]
        _require_memory(dataset.shape, dataset.dtype.itemsize)
        return _counts(read_numbers(dataset))


def _chosen(arrays: dict[str, Any], layout: Layout) -> str:
    """The name of the array that is meant: the one that is named, or the only one of three axes."""
    found = [name for name, array in arrays.items() if array.ndim == 3]
    if layout.dataset is not None:
        name = layout.dataset.strip("/")
        if name not in arrays:
            raise InputError(f"no dataset {layout.dataset!r} in it; there are: {', '.join(arrays) or 'none'}")
        return name
    if len(found) != 1:
        there = ", ".join(f"{name} ({' x '.join(map(str, a.shape))})" for name, a in arrays.items()) or "none"
        raise InputError(f"{len(found) or 'no'} arrays of three axes in it; say which (--dataset NAME): {there}")
    return found[0]


def _metaimage(path: Path, layout: Layout) -> Counts:
    """GATE 10's projections: x along a row, y down the rows, a frame in each z."""
    with recorded_warnings() as unsaid:  # that it does not say how it lies, which is asked anyway
        contents = metaimage.read(path)
    affine = np.full((4, 4), math.nan) if contents.affine is None or unsaid else contents.affine
    pixel = np.linalg.norm(affine[:3, :2], axis=0).tolist()
    return _counts(np.ascontiguousarray(contents.array.transpose(2, 1, 0)), pixel=pixel)


def _interfile(path: Path, layout: Layout) -> Counts:
    """An Interfile 3.3 header and the file of numbers that it names, as GATE 9's projections are.

    Reference: A. Todd-Pokropek, T. D. Cradduck, F. Deconinck, "A file format for the exchange of nuclear medicine image
    data: a specification of Interfile version 3.3", Nuclear Medicine Communications 13 (1992) 673-699.
    """
    header = _interfile_header(path)

    def text(key: str, default: str = "") -> str:
        return header.get(key, [default])[0]

    def number(key: str, default: float | None = None) -> float:
        found = text(key, "" if default is None else str(default))
        try:
            value = float(found)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"{key} := {found}: expected a number" if found else f"it has no {key!r}")
        return value

    columns, rows = (int(number(f"matrix size [{i}]")) for i in (1, 2))
    size, kind = int(number("number of bytes per pixel")), text("number format", "nothing").lower()
    letter = {"unsigned integer": "u", "signed integer": "i"}.get(kind, "f" if kind.endswith("float") else "")
    if letter + str(size) not in ("u1", "u2", "u4", "u8", "i1", "i2", "i4", "i8", "f4", "f8"):
        raise InputError(f"number format {kind} of {size} bytes: expected integers, or floats of 4 or 8 bytes")
    order = text("imagedata byte order").upper()
    if size > 1 and order not in ("LITTLEENDIAN", "BIGENDIAN"):
        raise InputError(f"imagedata byte order {order or 'missing'}: expected LITTLEENDIAN or BIGENDIAN")
    type_ = np.dtype((">" if order == "BIGENDIAN" else "<") + letter + str(size))
    data = _interfile_data(path, text("name of data file"))
    skip = int(number("data offset in bytes", 2048 * number("data starting block", 0)))
    frame = rows * columns * size
    count = int(number("total number of images", (data.stat().st_size - skip) // frame if frame else 0))
    keys = (f"{name} (sec)" for name in ("time per projection", "image duration", "study duration"))
    times = next((list(map(float, header[key])) for key in keys if any(header.get(key, ()))), [])
    starts = [float(each) for each in header.get("image relative start time (sec)", ()) if each]
    starts = starts or [_seconds_of_day(each) for each in header.get("image start time", ()) if each]
    windows = int(number("number of energy windows", 1))
    pixel = [float(text(f"scaling factor (mm/pixel) [{i}]", "nan")) for i in (1, 2)]
    kind = f"{windows} energy windows" if windows > 1 else ""
    frames = _numbers(data, type_, (count, rows, columns), skip)
    of_windows: Any = {"window": range(1, windows + 1)}
    for name, word in (("low", "lower"), ("high", "upper")):
        of_windows[name] = [float(text(f"energy window {word} level [{i}]", "nan")) for i in of_windows["window"]]
    return _counts(frames, kind, time=times, pixel=pixel, start=starts, **of_windows)


def _seconds_of_day(text: str) -> float:
    """Of a time such as 14:05:30, or DICOM's 140530.25."""
    digits = text.replace(":", "")
    return 3600.0 * int(digits[:2]) + 60.0 * int(digits[2:4] or 0) + float(digits[4:] or 0)


def _interfile_header(path: Path) -> dict[str, list[str]]:
    """Keys, in lower case, and their values: several where a key stands there several times."""
    lines = path.read_bytes()[: 1 << 20].decode("latin-1").splitlines()
    if not lines or not lines[0].lstrip("!").strip().upper().startswith("INTERFILE"):
        raise InputError("not an Interfile header: expected !INTERFILE in the first line")
    header: dict[str, list[str]] = {}
    for line in lines:
        key, assigned, value = line.partition(":=")
        if assigned and not line.lstrip().startswith(";"):
            key = " ".join(key.strip().lstrip("!").lower().replace("[", " [").split())
            header.setdefault(key, []).append(value.strip())
    return header


def _interfile_data(path: Path, name: str) -> Path:
    """The file of numbers: where the header says, or of that name beside it, since it may have been moved with it."""
    for found in (path.parent / name, path.parent / Path(name.replace("\\", "/")).name):
        if name and found.exists():
            return require_file(found)
    raise InputError(f"its numbers are in {name or 'no file that it names'}, which is not beside it")


def _dicom(path: Path, layout: Layout) -> Counts:
    """A nuclear medicine image of several frames (DICOM part 3, C.8.4.8): planar images or projections."""
    import pydicom

    data = pydicom.dcmread(path)
    if (modality := data.get("Modality")) != "NM":
        raise InputError(f"modality {modality or 'missing'}: expected nuclear medicine (NM) with a frame a module")
    if image_kind(data) in TOMOGRAMS or "SliceVector" in data:
        raise InputError("it holds a reconstructed tomogram; expected a frame a module")
    require_grey(data)
    shape = int(data.get("NumberOfFrames") or 1), int(data.Rows), int(data.Columns)
    _require_memory(shape, 4)
    array = decode_pixels(data).reshape(shape)
    slope, intercept = float(data.get("RescaleSlope") or 1), float(data.get("RescaleIntercept") or 0)
    if (slope, intercept) != (1.0, 0.0):
        array = array * slope + intercept
    several = {name: int(data.get(f"NumberOf{name.replace(' ', '')}s") or 1) for name in _VECTORS}
    kind = ", ".join(f"{n} {name.lower()}s" for name, n in several.items() if n > 1)
    pixel = [float(size) for size in data.get("PixelSpacing") or (math.nan, math.nan)][::-1]
    windows = _which(data, "Energy Window", several["Energy Window"])
    low, high = ([_dicom_energy(data, number, word) for number in windows] for word in ("Lower", "Upper"))
    times, starts = _dicom_times(data), _dicom_starts(data, len(array))
    return _counts(array, kind, time=times, pixel=pixel, window=windows, start=starts, low=low, high=high)


_VECTORS = ("Energy Window", "Detector", "Phase", "Rotation", "RR Interval", "Time Slot")
"""What a nuclear medicine image may have several of."""


def _dicom_times(data: Any) -> list[float]:
    """The durations of frames, s: of each by its rotation or phase, or of all."""
    for name in ("Rotation", "Phase"):
        parts = [_dicom_time(part) for part in data.get(f"{name}InformationSequence") or ()]
        if any(map(math.isfinite, parts)):
            return [parts[number - 1] for number in _which(data, name, len(parts))]
    return [_dicom_time(data)]


def _dicom_energy(data: Any, number: int, word: str) -> float:
    """The lower or the upper limit of the energy window of a number, keV; NaN of one that is not a single range."""
    windows = data.get("EnergyWindowInformationSequence") or ()
    ranges: Any = windows[number - 1].get("EnergyWindowRangeSequence") or () if 0 < number <= len(windows) else ()
    limit = ranges[0].get(f"EnergyWindow{word}Limit") if len(ranges) == 1 else None
    return math.nan if limit is None else float(limit)


def _dicom_starts(data: Any, count: int) -> list[float]:
    """When frames started, s of an era: the acquisition, and in it each phase and its frames (C.8.4.8, C.8.4.14).

    Nothing where the file says neither a time nor phases, and of rotations, whose views follow each other unsaid.
    """
    day, clock = str(data.get("AcquisitionDate") or ""), str(data.get("AcquisitionTime") or "")
    phases = data.get("PhaseInformationSequence") or ()
    if not (clock or phases) or data.get("RotationInformationSequence"):
        return []
    begun = 86400.0 * date.fromisoformat(day).toordinal() if day else 0.0
    begun += _seconds_of_day(clock) if clock else 0.0
    if not phases:
        return [begun]
    ends, firsts, apart = begun, [], []
    for phase in phases:
        duration, pause = _dicom_time(phase), float(phase.get("PauseBetweenFrames") or 0) / 1000
        firsts.append(ends + float(phase.get("PhaseDelay") or 0) / 1000)
        apart.append(duration + pause)
        ends = firsts[-1] + int(phase.get("NumberOfFramesInPhase") or 1) * apart[-1] - pause
    slices = data.get("TimeSliceVector")
    of_frames = zip(_which(data, "Phase", len(phases)), [1] * count if slices is None else list(slices), strict=False)
    return [firsts[phase - 1] + (number - 1) * apart[phase - 1] for phase, number in of_frames]


def _which(data: Any, name: str, count: int) -> list[int]:
    """Which of `count` windows, rotations or phases each frame is of; unsaid, those of blocks of frames."""
    vector = data.get(f"{name.replace(' ', '')}Vector") or np.arange(1, count + 1)
    return [int(number) for number in np.atleast_1d(vector)]


def _dicom_time(place: Any) -> float:
    return float(place.get("ActualFrameDuration") or math.nan) / 1000


def differs(recorded: float, other: float) -> bool:
    """Whether a length or time in a file, NaN where there is none, is more than its rounding from another."""
    return not (math.isnan(recorded) or math.isclose(recorded, other, rel_tol=_SAME_SIZE))
