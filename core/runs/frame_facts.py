"""Frames of counts with the facts that their file states, as readers of the formats return them."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Array, ArrayLike
from ..errors import InputError
from ..memory import require
from ..validation import shape_text

_FINE = 0.05  # step of stored numbers up to which whole counts can be told from others


class FileFrames(NamedTuple):
    """Frames of a file, with what the file says of them."""

    array: Array
    """Counts (frames, rows, columns); two axes for a single frame."""
    kind: str = ""
    """Composition of the frames, such as "2 energy windows"."""
    facts: Mapping[str, Sequence[float]] = {}
    """Values of each frame, or of equal blocks of frames: exposure `time`, s; number of the energy `window`, with its `low`
    and `high` energies, keV; `start`, s after any moment. And `pixel`: sizes along a row and down the columns, mm."""


def require_memory(shape: Sequence[int], itemsize: int) -> None:
    """Raise `InputError` unless there is memory for the numbers, their float32 images, and masks for the checks."""
    require((itemsize + 9.0) * math.prod(map(int, shape)), f"counts of {shape_text(tuple(shape))}")


def file_numbers(path: Path, kind: np.dtype[Any], shape: tuple[int, ...], skip: int = 0) -> Array:
    """Return all numbers of a file after its first `skip` bytes."""
    needed, size = skip + kind.itemsize * math.prod(shape), path.stat().st_size
    if needed != size:
        behind = f" behind {skip} bytes" if skip else ""
        expected = f"{shape_text(shape)} numbers of {kind.itemsize} bytes{behind}"
        raise InputError(f"expected {needed} bytes ({expected}), {path.name} has {size}")
    require_memory(shape, kind.itemsize)
    return np.fromfile(path, kind, offset=skip).reshape(shape)


def rescaled(frames: Array, slope: ArrayLike, intercept: float) -> Array:
    """Return slope x frames + intercept; `slope` is one number or one of each frame.

    Whole counts that were stored in fine steps become whole again, if all numbers are what would be stored for some: nearest
    to a whole number, or the largest, at which programs cut off, within two steps of one.
    """
    slopes = np.asarray(slope, np.float64)
    if not (slopes != 0).all():
        raise InputError("its numbers are to be multiplied by 0; expected another factor")
    if (slopes == 1).all() and intercept == 0:
        return frames
    values = frames * np.broadcast_to(slopes, len(frames))[:, None, None] + intercept
    whole_counts, step = np.rint(values), float(np.abs(slopes).max())
    steps = np.where((frames == frames.max()) & (values > 0.5), 2.0, 0.5) * (step if step <= _FINE else 0.0)
    rounding = 1e-9 * (step + np.abs(values)) + steps
    return np.asarray(whole_counts if (np.abs(values - whole_counts) <= rounding).all() else values)
