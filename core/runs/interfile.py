"""Read Interfile 3.3: a header of ``key := value`` lines, as GATE 9, SIMIND and STIR write, and the numbers beside it.

Reference: A. Todd-Pokropek, T. D. Cradduck, F. Deconinck, "A file format for the exchange of nuclear medicine image data: a
specification of Interfile version 3.3", Nuclear Medicine Communications 13 (1992) 673-699. STIR numbers the values of time
frames: ``image duration (sec)[2]``.
"""

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from ..validation import whole_in_file
from ..volumes.formats.contents import find_data_file
from .frame_facts import FileFrames, file_numbers, rescaled
from .stated_times import DAY, moment, stated_duration, stated_number

_LONGEST_HEADER = 1 << 20  # bytes
_NUMBER_TYPES = ("u1", "u2", "u4", "u8", "i1", "i2", "i4", "i8", "f4", "f8")
_MILLIMETRES = {"mm/pixel": 1.0, "mmpixel": 1.0, "mm": 1.0, "cm/pixel": 10.0, "cmpixel": 10.0, "cm": 10.0}
_FACTOR = re.compile(
    r"quantification units|(data |image )?((re)?scal\w+|slope) (slope|factor)|(data )?rescale slope|scale factor"
)
_OFFSET = re.compile(r"(data )?rescale (offset|intercept)|(data|image) (scale|scaling) offset")
_EXPOSURES = ("time per projection (sec)", "image duration (sec)", "study duration (sec)")
_UNITS_OF_COUNTS = ("counts", "count", "cnts")  # words that some programs write as quantification units


def begins(path: Path) -> bool:
    """Return whether the file at `path` begins as an Interfile header does."""
    with open(path, "rb") as file:
        return bool(re.match(rb"(\xef\xbb\xbf)?[\s!]*interfile", file.read(64).lower()))


def read(path: Path) -> FileFrames:
    """Read the frames of a header and of the file of numbers that it names; `InputError` for keys that cannot be applied."""
    header = _Header(path)
    columns, rows = (header.whole(f"matrix size [{axis}]") for axis in (1, 2))
    n_bytes, form = header.whole("number of bytes per pixel"), header.text("number format", "nothing").lower()
    letter = {"unsigned integer": "u", "signed integer": "i"}.get(form, "f" if form.endswith("float") else "")
    if letter + str(n_bytes) not in _NUMBER_TYPES:
        raise InputError(f"number format {form} of {n_bytes} bytes: expected integers, or floats of 4 or 8 bytes")
    byte_order = header.text("imagedata byte order").upper().replace(" ", "")
    if n_bytes > 1 and byte_order not in ("LITTLEENDIAN", "BIGENDIAN"):
        raise InputError(f"imagedata byte order {byte_order or 'missing'}: expected LITTLEENDIAN or BIGENDIAN")
    number_type = np.dtype((">" if byte_order == "BIGENDIAN" else "<") + letter + str(n_bytes))
    frame_size = rows * columns * n_bytes
    offset = header.whole("data offset in bytes", 2048 * header.whole("data starting block", 0))
    n_frames = header.whole("total number of images", max(1, (header.data_size - offset) // frame_size))
    frames = file_numbers(header.data_path, number_type, (n_frames, rows, columns), offset)
    n_windows = header.whole("number of energy windows", 1)
    if n_frames % n_windows:
        raise InputError(f"number of energy windows = {n_windows}: expected one that divides the {n_frames} images")
    sizes = [header.pixel_size(axis) for axis in (1, 2)]
    facts: dict[str, Sequence[float]] = {"pixel": sizes, "window": range(1, n_windows + 1)}
    for name, word in (("low", "lower"), ("high", "upper")):
        keys = [f"energy window {word} level [{window}]" for window in facts["window"]]
        facts[name] = [stated_number(header.text(key), key, "keV") for key in keys]
    facts["time"], facts["start"] = _times(header, n_frames)
    kind = f"{n_windows} energy windows" if n_windows > 1 else ""
    return FileFrames(rescaled(frames, *_scale(header, n_frames)), kind, facts)


class _Header:
    """Keys of a header, in lower case, with their values: a repeated key has several, and so has one with numbers in [ ]."""

    def __init__(self, path: Path) -> None:
        lines = path.read_bytes()[:_LONGEST_HEADER].decode("latin-1").removeprefix("\xef\xbb\xbf").lstrip().splitlines()
        if not lines or not lines[0].lstrip("! \t").upper().startswith("INTERFILE"):
            raise InputError("not an Interfile header: expected !INTERFILE in the first line")
        self.values: dict[str, list[str]] = {}
        for line in lines:
            key, assigned, value = line.partition(":=")
            key = " ".join(key.strip().lstrip("!").lower().replace("[", " [").split())
            if assigned and not line.lstrip().startswith(";"):
                self.values.setdefault(key, []).append(value.strip())
        self.data_path = find_data_file(path, "name of data file", self.text("name of data file"))
        self.data_size = max(1, self.data_path.stat().st_size)

    def all(self, key: str) -> list[str]:
        """Return the values of a key and of the key with numbers, ``key [1]``, ``key [2]``; empty ones are left out."""
        numbered = [f"{key} [{number}]" for number in range(1, len(self.values) + 1)]
        return [text for name in (key, *numbered) for text in self.values.get(name, ()) if text]

    def text(self, key: str, default: str = "") -> str:
        """Return the value of a key; raise `InputError` where it is repeated with other values."""
        values = list(dict.fromkeys(self.values.get(key, ())))
        if len(values) > 1:
            raise InputError(f"{key} = {values[0]} and {values[1]}: expected one value")
        return values[0] if values else default

    def pauses(self, key: str, n_groups: int) -> list[float]:
        """Return the pause, s, of each frame group; 0 for one that the header does not state."""
        return _in_blocks([stated_number(text, key, default=0.0) for text in self.all(key)] or [0.0], [], n_groups, key)

    def whole(self, key: str, default: int | None = None) -> int:
        """Return the whole number of a key, at most the bytes of the data; the default where the header says 0 or none."""
        text = self.text(key)
        if text.lower() != "nan" and math.isnan(stated_number(text, key, "a whole number")):
            if default is None:
                raise InputError(f"it has no {key!r}")
            return default
        number = whole_in_file(text, key, 1 if default is None else 0, self.data_size)
        return number if number or default is None else default

    def pixel_size(self, axis: int) -> float:
        """Return the size of a pixel along axis 1 or 2, mm; NaN where the header says none."""
        for key in self.values:
            if (match := re.fullmatch(rf"scaling factor( \((.*)\))? \[{axis}\]", key)) is not None:
                size = stated_duration(self.text(key), key)
                unit = (match[2] or "").replace(" ", "")
                if unit not in _MILLIMETRES and not math.isnan(size):
                    raise InputError(f"{key} = {self.text(key)}: expected its unit as (mm/pixel)")
                return size * _MILLIMETRES.get(unit, math.nan)
        return math.nan


def _scale(header: _Header, n_frames: int) -> tuple[Floats, float]:
    """Return the factor of each frame's numbers and the number to be added; several factors that differ are refused."""
    factors, offsets = _stated_scales(header, _FACTOR, 1.0), _stated_scales(header, _OFFSET, 0.0)
    if any(numbers != next(iter(factors.values())) for numbers in factors.values()):
        listed = " and ".join(f"{name} = {', '.join(map(str, numbers))}" for name, numbers in factors.items())
        raise InputError(f"{listed}: expected one factor of the counts")
    values = [number for numbers in offsets.values() for number in numbers] or [0.0]
    if len(set(values)) > 1:
        raise InputError(f"several rescale offsets ({', '.join(map(str, values))}): expected one")
    key, slopes = next(iter(factors.items()), ("", [1.0]))
    return np.array(_in_blocks(slopes, [], n_frames, key)), values[0]


def _stated_scales(header: _Header, pattern: re.Pattern[str], neutral: float) -> dict[str, list[float]]:
    """Return the numbers of the keys of a `pattern`, by key without [ ], unless all are `neutral`."""
    scales = {}
    for name in filter(pattern.fullmatch, dict.fromkeys(re.sub(r" \[\d+\]$", "", key) for key in header.values)):
        texts = ["1" if text.lower() in _UNITS_OF_COUNTS else text for text in header.all(name)]
        numbers = [stated_number(text, name, "a factor of the counts", neutral) for text in texts]
        if any(number != neutral for number in numbers):
            scales[name] = numbers
    return scales


def _in_blocks(values: list[float], sizes: list[int], n_frames: int, key: str) -> list[float]:
    """Return a value for each of `n_frames` from those of blocks, of stated `sizes` or of equal ones.

    Blocks of which the sizes add up to a part of the frames are repeated, as in each energy window.
    """
    if sizes and len(sizes) == len(values):
        if n_frames % sum(sizes) == 0:
            in_part = [value for value, size in zip(values, sizes, strict=True) for _ in range(size)]
            return in_part * (n_frames // len(in_part))
        raise InputError(f"groups of {' + '.join(map(str, sizes))} images: expected them to make up {n_frames} images")
    if not values or n_frames % len(values):
        raise InputError(f"{key}: {len(values)} values for {n_frames} images: expected one, or as many for each")
    return [value for value in values for _ in range(n_frames // len(values))]


def _times(header: _Header, n_frames: int) -> tuple[list[float], list[float]]:
    """Return the exposures of all frames, s, and their starts, s after any moment; NaN or empty if not stated."""
    is_gated = any(key.startswith(("gated", "gspect", "number of images in time window")) for key in header.values)
    is_gated |= "gated" in header.text("type of data").lower()
    size_key = "number of images in time window" if is_gated else "number of images this frame group"
    sizes = [whole_in_file(text, size_key, 1, n_frames) for text in header.all(size_key)]
    for key in _EXPOSURES[1:2] if is_gated else _EXPOSURES:
        durations = [stated_duration(text, key) for text in header.all(key)]
        if any(map(math.isfinite, durations)):
            break
    else:
        durations, key = [math.nan], _EXPOSURES[0]
    if is_gated:  # the duration is a gate's in one beat
        cycle_key = "number of cardiac cycles (acquired)"
        cycles = [stated_duration(text, cycle_key) for text in header.all(cycle_key)] or [math.nan]
        if len(cycles) not in (1, len(durations)) and len(durations) > 1:
            raise InputError(f"{cycle_key}: {len(cycles)} values beside {len(durations)} of {key}; expected as many")
        durations = np.multiply(durations, cycles).tolist()
    times = _in_blocks(durations, sizes, n_frames, key)
    return times, _starts(header, times, [] if is_gated else sizes)


def _starts(header: _Header, times: list[float], sizes: list[int]) -> list[float]:
    """Return the starts of the frames, s after any moment; empty where the header says none.

    Images of frame groups, of `sizes` in each energy window, follow each other with the stated pauses.
    """
    day, clock = header.text("study date"), header.text("study time")
    clocks = [moment(day, text, "image start time") for text in header.all("image start time")]
    begin = clocks[0] if clocks else moment(day, clock, "study time")
    relative_key = "image relative start time (sec)"
    relative = [stated_number(text, relative_key, "seconds") for text in header.all(relative_key)]
    n_frames = len(times)
    if relative:
        starts = _in_blocks(relative, sizes, n_frames, relative_key)
    elif len(clocks) > 1:
        starts = [clock + DAY * (clock < begin - DAY / 2) for clock in clocks]  # of the day after the first's
        return _in_blocks(starts, sizes, n_frames, "image start time")
    elif sizes and header.whole("number of detector heads", 1) == 1:
        between_images = header.pauses("pause between images (sec)", len(sizes))
        between_groups = header.pauses("pause between frame groups (sec)", len(sizes))
        starts, end = [], 0.0
        for group, size in enumerate(sizes):
            for _ in range(size):
                starts.append(end)
                end += times[len(starts) - 1] + between_images[group]
            end += between_groups[group] - between_images[group]
        starts = _in_blocks(starts, [1] * len(starts), n_frames, "")
    else:
        return [] if math.isnan(begin) else [begin]
    return [start + (0.0 if math.isnan(begin) else begin) for start in starts]
