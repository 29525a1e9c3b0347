"""Files with frames of counts, as scanners and simulators write them: NumPy, HDF5, raw, DICOM, MetaImage, Interfile.

A file may hold exposures, pixel sizes and energy windows of its frames; none holds the module of a frame, or how the frame
lies on the crystal. To add a format, write its reader and add its endings to `_READERS`.
"""

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Array, Floats
from ..errors import InputError, reading
from ..files import AnyPath, require_file
from ..hdf5 import datasets, opened, read_numbers
from ..progress import Progress, tell
from ..recording import recorded_warnings
from ..validation import one_of, whole_in_file, whole_shape
from ..volumes.formats import metaimage, numpy_files
from ..volumes.formats.dicom import is_dicom
from . import interfile, nuclear_medicine
from .frame_facts import FileFrames, file_numbers, require_memory
from .stated_times import aligned_starts

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
    paths = [Path(path)] if isinstance(path, str | os.PathLike) else list(map(Path, path))
    if not paths:
        raise InputError("counts: expected a file, or several")
    counts_of_files: list[Counts] = []
    for number, file in enumerate(paths, 1):
        counts_of_files.append(_read_file(file, dataset, shape, type, big_endian))
        first_shape, last_shape = counts_of_files[0].shape[1:], counts_of_files[-1].shape[1:]
        if first_shape != last_shape:
            shapes_text = f"{last_shape[0]} x {last_shape[1]} pixels, {paths[0]} of {first_shape[0]} x {first_shape[1]}"
            raise InputError(f"{file}: it holds frames of {shapes_text}; expected one size")
        tell(progress, number, len(paths))
    counts = counts_of_files[0] if len(counts_of_files) == 1 else np.concatenate(counts_of_files).view(Counts)
    counts.about = np.concatenate([file_counts.about for file_counts in counts_of_files])
    names = [file.name for file in paths]
    starts = aligned_starts([file_counts.about[:, 4] for file_counts in counts_of_files], names)
    counts.about[:, 4] = starts - np.min(starts, initial=np.inf, where=np.isfinite(starts))
    counts.kind = ", ".join(sorted({file_counts.kind for file_counts in counts_of_files} - {""}))
    counts.name = ", ".join([*names[:3], *(["…"] if len(names) > 3 else [])])
    return counts


def _read_file(path: Path, dataset: str | None, shape: Any, raw_type: str | None, big_endian: bool) -> Counts:
    """Return the frames of one file; raise `InputError`, which names the file, if they cannot be read."""
    require_file(path)
    ending = path.suffix.lower()
    with reading(path, ending or "counts"):
        if shape is not None or raw_type is not None or big_endian:
            return _checked_frames(FileFrames(_read_raw(path, shape, raw_type, big_endian)))
        if dataset is None:
            return _checked_frames(_reader(path, ending)(path))
        if ending not in (".npz", ".h5", ".hdf5"):
            raise InputError("dataset (--dataset) names an array in .npz and .h5; this file has no names")
        return _checked_frames(_READERS[ending](path, dataset.strip("/")))


def _reader(path: Path, ending: str) -> Callable[..., FileFrames]:
    """Return the function that reads a file with this ending, in lower case."""
    if ending in _READERS:
        return _READERS[ending]
    for is_of_format, reader in ((is_dicom, nuclear_medicine.read), (interfile.begins, interfile.read)):
        if is_of_format(path):
            return reader
    header = path.with_suffix(".hdr")
    beside = f"its header {header.name}, which is beside it, or " if header.is_file() else ""
    raw = "of raw numbers say the shape (--raw-shape FRAMES ROWS COLUMNS) and the type (--raw-type uint16)"
    raise InputError(f"expected {beside}a name ending in {', '.join(COUNTS_FORMATS)}; {raw}")


def _checked_frames(frames: FileFrames) -> Counts:
    """Return frames (frames, rows, columns) with the facts of their file; raise `InputError` for another shape."""
    array = frames.array[None] if frames.array.ndim == 2 else frames.array
    if array.ndim != 3 or not array.size:
        raise InputError(f"expected (frames, rows, columns), got shape {' x '.join(map(str, array.shape)) or '()'}")
    if array.dtype.kind not in "fiu":
        raise InputError(f"expected whole or real numbers, found {array.dtype}")
    counts = array.view(Counts)
    counts.kind, counts.about[:, 1:3] = frames.kind, frames.facts.get("pixel", math.nan)
    for column, name in ((0, "time"), (3, "window"), (4, "start"), (5, "low"), (6, "high")):
        values = np.array(frames.facts.get(name) or [math.nan])
        counts.about[:, column] = values[np.arange(len(array)) * len(values) // len(array)]
    for low, high in counts.about[counts.about[:, 5] > counts.about[:, 6], 5:]:
        raise InputError(f"energy window from {low:g} to {high:g} keV: expected the lower level first")
    return counts


def _read_raw(path: Path, shape: Any, raw_type: str | None, big_endian: bool) -> Array:
    """Return the numbers of a raw file in the described `shape` (frames, rows, columns)."""
    if shape is None or raw_type is None:
        missing = "shape (--raw-shape FRAMES ROWS COLUMNS)" if shape is None else "type (--raw-type, uint16 or so)"
        raise InputError(f"raw numbers need their {missing}")
    one_of(raw_type, RAW_TYPES, "raw type")
    for size in (shape := whole_shape(shape, "raw shape (--raw-shape)", 3)):
        whole_in_file(size, "raw shape (--raw-shape)", 1, max(1, path.stat().st_size))
    number_type = np.dtype(raw_type).newbyteorder(">" if big_endian else "<")
    return file_numbers(path, number_type, shape)


def _read_numpy(path: Path, dataset: str | None = None) -> FileFrames:
    """Return the frames of a .npy or .npz file."""
    arrays = numpy_files.load(path)
    return FileFrames(arrays["" if path.suffix.lower() == ".npy" else _array_name(arrays, dataset)])


def _read_hdf5(path: Path, dataset: str | None = None) -> FileFrames:
    """Return the frames of an HDF5 file."""
    import h5py

    with opened(path, whole=True) as file:
        arrays = datasets(file)
        if dataset is not None and isinstance(file.get(dataset), h5py.Dataset):
            arrays[dataset] = file[dataset]  # `datasets` has one of an array's names
        array = arrays[_array_name(arrays, dataset)]
        require_memory(array.shape, array.dtype.itemsize)
        return FileFrames(read_numbers(array))


def _array_name(arrays: dict[str, Any], dataset: str | None) -> str:
    """Return the name of the array with the frames: the one that the user names, or the only one of three axes."""
    three_axes = [name for name, array in arrays.items() if array.ndim == 3]
    if dataset is not None:
        if dataset not in arrays:
            raise InputError(f"no dataset {dataset!r} in it; there are: {', '.join(arrays) or 'none'}")
        return dataset
    if len(three_axes) != 1:
        listed = ", ".join(f"{name} ({' x '.join(map(str, a.shape))})" for name, a in arrays.items()) or "none"
        raise InputError(f"{len(three_axes) or 'no'} arrays of three axes in it; say which (--dataset NAME): {listed}")
    return three_axes[0]


def _read_metaimage(path: Path) -> FileFrames:
    """Return the frames of a MetaImage file as GATE 10 writes projections: x along a row, y down the rows, a frame per z."""
    with recorded_warnings() as orientation_warnings:  # the user gives the orientation anyway
        contents = metaimage.read(path)
    affine = np.full((4, 4), math.nan) if contents.affine is None or orientation_warnings else contents.affine
    pixel = np.linalg.norm(affine[:3, :2], axis=0).tolist()
    return FileFrames(np.ascontiguousarray(contents.array.transpose(2, 1, 0)), facts={"pixel": pixel})


def differs(recorded: float, expected: float, is_rounded: bool = False) -> bool:
    """Return whether a length or time in a file differs from `expected` by more than rounding; False for NaN in the file.

    A number that `is_rounded` may differ by half a unit of its last digit, up to 1 %: 0.78 is 0.78125.
    """
    decimals = f"{recorded:.9g}".partition(".")[2]
    rounding = min(0.5 * 0.1 ** len(decimals), 0.01 * abs(expected)) if is_rounded else 0.0
    return not (math.isnan(recorded) or math.isclose(recorded, expected, rel_tol=_SAME_SIZE, abs_tol=rounding))


_READERS: dict[str, Callable[..., FileFrames]] = {
    **dict.fromkeys((".npy", ".npz"), _read_numpy),
    **dict.fromkeys((".h5", ".hdf5"), _read_hdf5),
    ".dcm": nuclear_medicine.read,
    **dict.fromkeys((".mhd", ".mha"), _read_metaimage),
    **dict.fromkeys((".hdr", ".h33", ".hs", ".h00"), interfile.read),
}
"""Readers by the endings of their files, in lower case."""
COUNTS_FORMATS = (*_READERS, ".raw", ".bin", ".dat")
"""Endings of files with counts; DICOM files, Interfile headers and raw files may have any name."""
