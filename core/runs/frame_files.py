"""Files with frames of counts, as scanners and simulators write them: NumPy, HDF5, raw, DICOM, MetaImage, Interfile.

A file may hold exposures, pixel sizes and energy windows of its frames; none holds the module of a frame, or how the frame
lies on the crystal. To add a format, write its reader and add its endings to `_READERS`.
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
_SAME_SIZE = 1e-3  # relative tolerance of pixel sizes and times, which files round


class Counts(np.ndarray[Any, Any]):
    """Array of frames of counts (frames, rows, columns) with the facts that their files state.

    Slices keep these facts; arrays computed from it are plain.

    Attributes
    ----------
    about : array (frames, 7)
        Exposure, s; pixel size along a row and down the columns, mm; number of the energy window; start, s after that of
        the first frame; lowest and highest energy of the window, keV. NaN for a fact that the file does not state.
    kind : str
        Composition of the frames, such as "2 energy windows".
    name : str
        Names of the files.
    """

    about: Floats

    def __array_finalize__(self, source: Any) -> None:
        self.kind, self.name = getattr(source, "kind", ""), getattr(source, "name", "counts")
        is_same = isinstance(source, Counts) and source.shape == self.shape
        self.about = source.about if is_same else np.full((*self.shape[:1], 7), math.nan)

    def __getitem__(self, key: Any) -> Any:
        part = super().__getitem__(key)
        if isinstance(part, Counts) and part.ndim == 3:
            about = self.about[key[0] if isinstance(key, tuple) and key else key]
            part.about = about if about.shape == part.about.shape else part.about
        return part

    def __array_wrap__(self, array: Array, *_: Any) -> Any:  # type: ignore[override]
        return np.asarray(array)[()]

    def exposures(self, frames: Any = slice(None)) -> list[float]:
        """Return the different exposures, s, that the files state for these frames; `frames` is an index."""
        return [time for time in np.unique(self.about[frames, 0]).tolist() if math.isfinite(time)]


@dataclass(frozen=True)
class CountsLayout:
    """Description of a file's contents by the user, with the arguments of `read_counts`."""

    dataset: str | None = None
    """Name of the array in a file with several arrays."""
    shape: tuple[int, int, int] | None = None
    """Frames, rows and columns of a raw file."""
    type: str | None = None
    """Type of the numbers in a raw file, one of `RAW_TYPES`."""
    big_endian: bool = False
    """Whether the most significant byte of a raw file's numbers comes first."""

    @property
    def is_raw(self) -> bool:
        """Whether the description is that of raw numbers."""
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
        Files: .npy, .npz, .h5, nuclear medicine DICOM of several frames (.dcm), MetaImage (.mhd, .mha, as GATE 10 writes),
        the header of an Interfile pair (.hdr, as GATE 9 writes), or raw numbers. A file of one frame may have two axes.
    dataset
        Name of the array in .npz and .h5 files with several arrays of three axes.
    shape, type, big_endian
        Shape (frames, rows, columns), type (uint8, int8, … float64) and byte order of raw files.
    progress
        Called after each file.

    Returns
    -------
    Counts
        Array (frames, rows, columns) of the file's own type. `counts_run` checks its numbers, and compares its arguments
        with the exposure, pixel size and energy windows in the file.
    """
    layout = CountsLayout(dataset, shape, type, big_endian)
    paths = [Path(path)] if isinstance(path, str | os.PathLike) else list(map(Path, path))
    if not paths:
        raise InputError("counts: expected a file, or several")
    counts_of_files: list[Counts] = []
    for number, file in enumerate(paths, 1):
        counts_of_files.append(_read_file(file, layout))
        first_shape, last_shape = counts_of_files[0].shape[1:], counts_of_files[-1].shape[1:]
        if first_shape != last_shape:
            shapes_text = f"{last_shape[0]} x {last_shape[1]} pixels, {paths[0]} of {first_shape[0]} x {first_shape[1]}"
            raise InputError(f"{file}: it holds frames of {shapes_text}; expected one size")
        tell(progress, number, len(paths))
    counts = counts_of_files[0] if len(counts_of_files) == 1 else np.concatenate(counts_of_files).view(Counts)
    counts.about = np.concatenate([file_counts.about for file_counts in counts_of_files])
    starts = counts.about[:, 4]  # as read, from the beginning of the day or of an era
    starts -= np.min(starts, initial=np.inf, where=np.isfinite(starts))
    counts.kind = ", ".join(sorted({file_counts.kind for file_counts in counts_of_files} - {""}))
    counts.name = ", ".join([*(file.name for file in paths[:3]), *(["…"] if len(paths) > 3 else [])])
    return counts


def _read_file(path: Path, layout: CountsLayout) -> Counts:
    """Return the frames of one file; raise `InputError`, which names the file, if they cannot be read."""
    require_file(path)
    ending = path.suffix.lower()
    with reading(path, ending or "counts"):
        if layout.is_raw:
            return _checked_frames(_read_raw(path, layout))
        if layout.dataset is not None and ending not in (".npz", ".h5", ".hdf5"):
            raise InputError("dataset (--dataset) names an array in .npz and .h5; this file has no names")
        return _reader(path, ending)(path, layout)


def _reader(path: Path, ending: str) -> Callable[[Path, CountsLayout], Counts]:
    """Return the function that reads a file with this ending, in lower case."""
    if ending in _READERS:
        return _READERS[ending]
    if is_dicom(path):
        return _read_dicom
    header = path.with_suffix(".hdr")
    beside = f"its header {header.name}, which is beside it, or " if header.is_file() else ""
    raw = "of raw numbers say the shape (--raw-shape FRAMES ROWS COLUMNS) and the type (--raw-type uint16)"
    raise InputError(f"expected {beside}a name ending in {', '.join(COUNTS_FORMATS)}; {raw}")


def _checked_frames(array: Array, kind: str = "", **facts: Sequence[float]) -> Counts:
    """Return an array as frames (frames, rows, columns) with the `facts` of its file; raise `InputError` for another shape.

    Facts are `time` (s), `pixel` (sizes along a row and down the columns, mm), energy `window` (numbers) with `low` and
    `high` energies (keV), and `start` (s after any moment). Fewer values than frames are those of equal blocks of frames.
    """
    array = array[None] if array.ndim == 2 else array
    if array.ndim != 3 or not array.size:
        raise InputError(f"expected (frames, rows, columns), got shape {' x '.join(map(str, array.shape)) or '()'}")
    if array.dtype.kind not in "fiu":
        raise InputError(f"expected whole or real numbers, found {array.dtype}")
    counts = array.view(Counts)
    counts.kind, counts.about[:, 1:3] = kind, facts.get("pixel", math.nan)
    for column, name in ((0, "time"), (3, "window"), (4, "start"), (5, "low"), (6, "high")):
        values = np.array(facts.get(name) or [math.nan])
        counts.about[:, column] = values[np.arange(len(array)) * len(values) // len(array)]
    return counts


def _require_memory(shape: Sequence[int], itemsize: int) -> None:
    """Raise `InputError` unless there is memory for the numbers, their float32 images, and masks for the checks."""
    require((itemsize + 9.0) * math.prod(map(int, shape)), f"counts of {shape_text(tuple(shape))}")


def _read_raw(path: Path, layout: CountsLayout) -> Array:
    """Return the numbers of a raw file in the described shape (frames, rows, columns)."""
    if layout.shape is None or layout.type is None:
        shape, kind = "shape (--raw-shape FRAMES ROWS COLUMNS)", "type (--raw-type, uint16 or so)"
        raise InputError(f"raw numbers need their {shape if layout.shape is None else kind}")
    one_of(layout.type, RAW_TYPES, "raw type")
    type_ = np.dtype(layout.type).newbyteorder(">" if layout.big_endian else "<")
    return _file_numbers(path, type_, whole_shape(layout.shape, "raw shape (--raw-shape)", 3))


def _file_numbers(path: Path, kind: np.dtype[Any], shape: tuple[int, ...], skip: int = 0) -> Array:
    """Return all numbers of a file after its first `skip` bytes."""
    needed, size = skip + kind.itemsize * math.prod(shape), path.stat().st_size
    if needed != size:
        behind = f" behind {skip} bytes" if skip else ""
        expected = f"{shape_text(shape)} numbers of {kind.itemsize} bytes{behind}"
        raise InputError(f"expected {needed} bytes ({expected}), {path.name} has {size}")
    _require_memory(shape, kind.itemsize)
    return np.fromfile(path, kind, offset=skip).reshape(shape)


def _read_numpy(path: Path, layout: CountsLayout) -> Counts:
    """Return the frames of a .npy or .npz file."""
    arrays = numpy_files.load(path)
    return _checked_frames(arrays["" if path.suffix.lower() == ".npy" else _array_name(arrays, layout)])


def _read_hdf5(path: Path, layout: CountsLayout) -> Counts:
    """Return the frames of an HDF5 file."""
    import h5py

    with opened(path, whole=True) as file:
        arrays = datasets(file)
        if layout.dataset is not None and isinstance(file.get(layout.dataset), h5py.Dataset):
            arrays[layout.dataset.strip("/")] = file[layout.dataset]  # `datasets` has one of an array's names
        dataset = arrays[_array_name(arrays, layout)]
        _require_memory(dataset.shape, dataset.dtype.itemsize)
        return _checked_frames(read_numbers(dataset))


def _array_name(arrays: dict[str, Any], layout: CountsLayout) -> str:
    """Return the name of the array with the frames: the one that the user names, or the only one of three axes."""
    three_axes = [name for name, array in arrays.items() if array.ndim == 3]
    if layout.dataset is not None:
        name = layout.dataset.strip("/")
        if name not in arrays:
            raise InputError(f"no dataset {layout.dataset!r} in it; there are: {', '.join(arrays) or 'none'}")
        return name
    if len(three_axes) != 1:
        listed = ", ".join(f"{name} ({' x '.join(map(str, a.shape))})" for name, a in arrays.items()) or "none"
        raise InputError(f"{len(three_axes) or 'no'} arrays of three axes in it; say which (--dataset NAME): {listed}")
    return three_axes[0]


def _read_metaimage(path: Path, layout: CountsLayout) -> Counts:
    """Return the frames of a MetaImage file as GATE 10 writes projections: x along a row, y down the rows, a frame per z."""
    with recorded_warnings() as orientation_warnings:  # the user gives the orientation anyway
        contents = metaimage.read(path)
    affine = np.full((4, 4), math.nan) if contents.affine is None or orientation_warnings else contents.affine
    pixel = np.linalg.norm(affine[:3, :2], axis=0).tolist()
    return _checked_frames(np.ascontiguousarray(contents.array.transpose(2, 1, 0)), pixel=pixel)


def _read_interfile(path: Path, layout: CountsLayout) -> Counts:
    """Return the frames of an Interfile 3.3 header and the file of numbers that it names, as GATE 9 writes projections.

    Reference: A. Todd-Pokropek, T. D. Cradduck, F. Deconinck, "A file format for the exchange of nuclear medicine image
    data: a specification of Interfile version 3.3", Nuclear Medicine Communications 13 (1992) 673-699.
    """
    header = _interfile_header(path)

    def text(key: str, default: str = "") -> str:
        """Return the first value of a key as a text."""
        return header.get(key, [default])[0]

    def number(key: str, default: float | None = None) -> float:
        """Return the first value of a key as a finite number; raise `InputError` if it is none."""
        text_value = text(key, "" if default is None else str(default))
        try:
            value = float(text_value)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise InputError(f"{key} := {text_value}: expected a number" if text_value else f"it has no {key!r}")
        return value

    columns, rows = (int(number(f"matrix size [{i}]")) for i in (1, 2))
    n_bytes, form = int(number("number of bytes per pixel")), text("number format", "nothing").lower()
    letter = {"unsigned integer": "u", "signed integer": "i"}.get(form, "f" if form.endswith("float") else "")
    if letter + str(n_bytes) not in ("u1", "u2", "u4", "u8", "i1", "i2", "i4", "i8", "f4", "f8"):
        raise InputError(f"number format {form} of {n_bytes} bytes: expected integers, or floats of 4 or 8 bytes")
    byte_order = text("imagedata byte order").upper()
    if n_bytes > 1 and byte_order not in ("LITTLEENDIAN", "BIGENDIAN"):
        raise InputError(f"imagedata byte order {byte_order or 'missing'}: expected LITTLEENDIAN or BIGENDIAN")
    number_type = np.dtype((">" if byte_order == "BIGENDIAN" else "<") + letter + str(n_bytes))
    data_path, frame_size = _interfile_data(path, text("name of data file")), rows * columns * n_bytes
    offset = int(number("data offset in bytes", 2048 * number("data starting block", 0)))
    n_fitting = (data_path.stat().st_size - offset) // frame_size if frame_size else 0
    n_frames = int(number("total number of images", n_fitting))
    keys = (f"{name} (sec)" for name in ("time per projection", "image duration", "study duration"))
    times = next((list(map(float, header[key])) for key in keys if any(header.get(key, ()))), [])
    starts = [float(start) for start in header.get("image relative start time (sec)", ()) if start]
    starts = starts or [_seconds_of_day(start) for start in header.get("image start time", ()) if start]
    n_windows = int(number("number of energy windows", 1))
    pixel_size = [float(text(f"scaling factor (mm/pixel) [{i}]", "nan")) for i in (1, 2)]
    content = f"{n_windows} energy windows" if n_windows > 1 else ""
    frames = _file_numbers(data_path, number_type, (n_frames, rows, columns), offset)
    limits: Any = {"window": range(1, n_windows + 1)}
    for name, word in (("low", "lower"), ("high", "upper")):
        limits[name] = [float(text(f"energy window {word} level [{i}]", "nan")) for i in limits["window"]]
    return _checked_frames(frames, content, time=times, pixel=pixel_size, start=starts, **limits)


def _seconds_of_day(text: str) -> float:
    """Return the seconds since midnight of a time such as 14:05:30, or 140530.25 in DICOM."""
    digits = text.replace(":", "")
    return 3600.0 * int(digits[:2]) + 60.0 * int(digits[2:4] or 0) + float(digits[4:] or 0)


def _interfile_header(path: Path) -> dict[str, list[str]]:
    """Return the values of a header by its keys, in lower case; a repeated key has several."""
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
    """Return the file of numbers: at the header's path, or beside the header, since both may have been moved together."""
    for candidate in (path.parent / name, path.parent / Path(name.replace("\\", "/")).name):
        if name and candidate.exists():
            return require_file(candidate)
    raise InputError(f"its numbers are in {name or 'no file that it names'}, which is not beside it")


def _read_dicom(path: Path, layout: CountsLayout) -> Counts:
    """Return the frames of a nuclear medicine image (DICOM part 3, C.8.4.8): planar images or projections."""
    import pydicom

    dataset = pydicom.dcmread(path)
    if (modality := dataset.get("Modality")) != "NM":
        raise InputError(f"modality {modality or 'missing'}: expected nuclear medicine (NM) with a frame a module")
    if image_kind(dataset) in TOMOGRAMS or "SliceVector" in dataset:
        raise InputError("it holds a reconstructed tomogram; expected a frame a module")
    require_grey(dataset)
    shape = int(dataset.get("NumberOfFrames") or 1), int(dataset.Rows), int(dataset.Columns)
    _require_memory(shape, 4)
    frames = decode_pixels(dataset).reshape(shape)
    slope, intercept = float(dataset.get("RescaleSlope") or 1), float(dataset.get("RescaleIntercept") or 0)
    if (slope, intercept) != (1.0, 0.0):
        frames = frames * slope + intercept
    vector_sizes = {name: int(dataset.get(f"NumberOf{name.replace(' ', '')}s") or 1) for name in _VECTORS}
    content = ", ".join(f"{n} {name.lower()}s" for name, n in vector_sizes.items() if n > 1)
    pixel = [float(size) for size in dataset.get("PixelSpacing") or (math.nan, math.nan)][::-1]
    windows = _frame_parts(dataset, "Energy Window", vector_sizes["Energy Window"])
    low, high = ([_window_limit(dataset, number, word) for number in windows] for word in ("Lower", "Upper"))
    times, starts = _frame_durations(dataset), _frame_starts(dataset, len(frames))
    return _checked_frames(frames, content, time=times, pixel=pixel, window=windows, start=starts, low=low, high=high)


_VECTORS = ("Energy Window", "Detector", "Phase", "Rotation", "RR Interval", "Time Slot")
"""Properties of frames of which a nuclear medicine image may have several values."""


def _frame_durations(data: Any) -> list[float]:
    """Return the exposures of frames, s: those of each frame's rotation or phase, or one for all frames."""
    for name in ("Rotation", "Phase"):
        durations = [_frame_duration(part) for part in data.get(f"{name}InformationSequence") or ()]
        if any(map(math.isfinite, durations)):
            return [durations[number - 1] for number in _frame_parts(data, name, len(durations))]
    return [_frame_duration(data)]


def _window_limit(data: Any, number: int, word: str) -> float:
    """Return the "Lower" or "Upper" limit of the energy window `number`, keV; NaN if the window is not a single range."""
    windows = data.get("EnergyWindowInformationSequence") or ()
    ranges: Any = windows[number - 1].get("EnergyWindowRangeSequence") or () if 0 < number <= len(windows) else ()
    limit = ranges[0].get(f"EnergyWindow{word}Limit") if len(ranges) == 1 else None
    return math.nan if limit is None else float(limit)


def _frame_starts(data: Any, count: int) -> list[float]:
    """Return the starts of frames, s of an era, from those of the acquisition, its phases and frames (C.8.4.8, C.8.4.14).

    The list is empty if the file states neither a time nor phases, and for rotations, whose views have no stated starts.
    """
    day, clock = str(data.get("AcquisitionDate") or ""), str(data.get("AcquisitionTime") or "")
    phases = data.get("PhaseInformationSequence") or ()
    if not (clock or phases) or data.get("RotationInformationSequence"):
        return []
    start = 86400.0 * date.fromisoformat(day).toordinal() if day else 0.0
    start += _seconds_of_day(clock) if clock else 0.0
    if not phases:
        return [start]
    phase_end, phase_starts, frame_steps = start, [], []
    for phase in phases:
        duration, pause = _frame_duration(phase), float(phase.get("PauseBetweenFrames") or 0) / 1000
        phase_starts.append(phase_end + float(phase.get("PhaseDelay") or 0) / 1000)
        frame_steps.append(duration + pause)
        phase_end = phase_starts[-1] + int(phase.get("NumberOfFramesInPhase") or 1) * frame_steps[-1] - pause
    slices = data.get("TimeSliceVector")
    numbers = [1] * count if slices is None else list(slices)  # of the frames in their phases
    frames = zip(_frame_parts(data, "Phase", len(phases)), numbers, strict=False)
    return [phase_starts[phase - 1] + (number - 1) * frame_steps[phase - 1] for phase, number in frames]


def _frame_parts(data: Any, name: str, count: int) -> list[int]:
    """Return the number, 1 to `count`, of each frame's window, rotation or phase; without a vector, one for each block."""
    vector = data.get(f"{name.replace(' ', '')}Vector") or np.arange(1, count + 1)
    return [int(number) for number in np.atleast_1d(vector)]


def _frame_duration(place: Any) -> float:
    """Return the exposure, s, that a DICOM dataset states; NaN if it states none."""
    return float(place.get("ActualFrameDuration") or math.nan) / 1000


def differs(recorded: float, expected: float) -> bool:
    """Return whether a length or time in a file differs from `expected` by more than rounding; False for NaN in the file."""
    return not (math.isnan(recorded) or math.isclose(recorded, expected, rel_tol=_SAME_SIZE))


_READERS: dict[str, Callable[[Path, CountsLayout], Counts]] = {
    **dict.fromkeys((".npy", ".npz"), _read_numpy),
    **dict.fromkeys((".h5", ".hdf5"), _read_hdf5),
    ".dcm": _read_dicom,
    **dict.fromkeys((".mhd", ".mha"), _read_metaimage),
    **dict.fromkeys((".hdr", ".h33", ".hs"), _read_interfile),
}
"""Readers by the endings of their files, in lower case."""
COUNTS_FORMATS = (*_READERS, ".raw", ".bin", ".dat")
"""Endings of files with counts; DICOM files and raw files may have any name."""
