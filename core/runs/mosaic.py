"""Pictures of projections: upright, as seen from the pinhole, alone or all in one with numbers and a colour bar."""

import math
import struct
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..arrays import Array, ArrayLike, Bytes, Floats, Floats32, Integers
from ..errors import InputError
from ..files import AnyPath, write_bytes
from ..validation import real_numbers
from . import letters
from .display import Display, unit_text

if TYPE_CHECKING:  # pages of figures read this file, and runs take a while
    from .run import ProjectionRun


def as_seen(images: ArrayLike) -> Array:
    """Images (..., n_v, n_u) as pictures: row 0 at the top, +v up, and +u to the left as seen from the pinhole.

    (u, v, k) is right-handed and k points away from the pinhole into the scene, so whoever looks along k with +v up
    has +u to the left: a picture in this order is what a camera in the pinhole sees, not its mirror image.
    """
    return real_numbers(images, "images")[..., ::-1, ::-1]


COLUMNS = 20
"""Images in a row by default."""
_BORDER = 64
"""Grey between the images of a sheet, 0 to 255."""
_SMALLEST = 64
"""Pixels along a side of an image in a sheet, at least."""
_SMALL_TEXT = 11.0
"""The least size of text, pixels."""


def mosaic(images: ArrayLike, columns: int = COLUMNS) -> Array:
    """Pictures of all images (M, n_v, n_u) in one (rows * n_v, columns * n_u), row 0 at the top; empty places are 0.

    They follow each other row by row from the top left: 80 modules in 4 rings and 20 columns show a ring a row.
    """
    images = as_seen(images)
    if images.ndim != 3:
        raise InputError(f"mosaic: expected images of shape (M, n_v, n_u), got {images.shape}")
    if columns < 1:
        raise InputError(f"mosaic: expected 1 column or more, got {columns}")
    count, n_v, n_u = images.shape
    rows = -(-count // columns)
    sheet = np.zeros((rows * columns, n_v, n_u), images.dtype)
    sheet[:count] = images
    return sheet.reshape(rows, columns, n_v, n_u).swapaxes(1, 2).reshape(rows * n_v, columns * n_u)


@dataclass(frozen=True, eq=False)
class Sheet:
    """All projections of a run in one picture that says what it shows."""

    picture: Bytes
    """Colours (height, width, 3), row 0 at the top."""
    corners: Integers
    """Row and column (M, 2) of each image's top left pixel."""
    tile: tuple[int, int]
    """Rows and columns of an image in it."""
    window: tuple[float, float]
    """The numbers at the colour bar's lower and upper end."""
    summed: str
    """What the numbers in the images' corners are, "sum" or "mean"; see `totals`."""
    totals: Floats
    """These numbers (M,)."""
    maxima: Floats32
    """The largest numbers that are shown of each image (M,)."""
    half: bool
    """Whether the images' middle halves are shown."""
    share: tuple[float, float]
    """What is shown of the images' width and height."""


def totals(projections: Floats32, unit: str) -> tuple[str, Floats]:
    """What sums up each of the images (M, n_v, n_u): "sum" of counts and photons, "mean" of line integrals; and it (M,)."""
    name = "sum" if unit in ("counts", "photons") else "mean"
    return name, getattr(np, name)(projections, axis=(1, 2), dtype=np.float64)


def sheet(
    projections: Floats32,
    numbers: ArrayLike,
    rings: ArrayLike,
    unit: str,
    display: Display | None = None,
    pixels: float = 6e6,
) -> Sheet:
    """Draw the images (M, n_v, n_u) of modules with these `numbers` and `rings` (M,), a ring in a row, with a colour bar.

    The numbers may be texts. Rings follow each other in the order of their modules; one of more than `COLUMNS` modules
    takes several rows. Where the images have more than `pixels` together, they are shown smaller, as means over blocks of
    pixels; small ones are shown larger, so that the numbers do not hide them. The colour bar's ends are the window of
    `display`, which is by default that of all exact numbers. Each image has what `totals` says of the part that is shown in
    a corner if there is room.
    """
    display = display or Display()
    window = display.window(projections)
    shown = display.part(projections)
    word, values = totals(shown, unit)
    images = display.colored(sized(as_seen(shown), pixels), window)
    at = places(np.asarray(rings))
    n_v, n_u = tile = images.shape[1:3]
    size = max(_SMALL_TEXT, min(n_v, n_u) / 5.5)
    gap = round(size / 6)
    corners = gap + at * (np.array(tile) + gap)
    height, width = corners.max(axis=0) + tile + gap
    picture = np.full((height, width, 3), _BORDER, np.uint8)
    texts = [f"{word} {value:.4g}" for value in values]
    small = min(n_u / max(letters.width(text, 1.05) for text in texts), n_v / 5, 0.7 * size)
    for image, (row, column), number, text in zip(images, corners, np.asarray(numbers), texts, strict=True):
        picture[row : row + n_v, column : column + n_u] = image
        _write(picture, str(number), row + gap // 2, column + gap, size)
        if small >= _SMALL_TEXT:
            _write(picture, text, row + n_v - math.ceil(1.1 * small), column + gap, small)
    bar = _color_bar(display, window, unit, height, max(size, height / 25))
    whole = np.concatenate([picture, bar], axis=1)
    share = shown.shape[2] / projections.shape[2], shown.shape[1] / projections.shape[1]
    return Sheet(whole, corners, (n_v, n_u), window, word, values, shown.max(axis=(1, 2)), display.half, share)


def write_sheet(run: "ProjectionRun", path: AnyPath, display: Display | None = None) -> None:
    """Write all images of a run in one picture, a PNG; see `sheet`."""
    drawn = sheet(run.projections, labels(run), run.system.rings(), run.unit, display)
    write_png(_captioned(drawn.picture, caption(run)), path)


def labels(run: "ProjectionRun") -> list[str]:
    """What each image of a run is called in a sheet: its module's number, and that of its frame of measured counts."""
    numbers = run.system.numbers.tolist()
    frames = {number: k for k, number in enumerate(run.settings.get("frames") or (), 1)}
    return [f"{number} ({frames[number]})" if number in frames else str(number) for number in numbers]


def caption(run: "ProjectionRun") -> str:
    """A line about measured counts and how a sheet shows them; empty for other runs."""
    if not run.is_measured:
        return ""
    words = run.settings["orientation"]
    lay = words if isinstance(words, str) else "each its own way"
    side = "crystals seen from behind" if run.settings["detector"] == "real" else "what the pinholes see"
    times = np.unique(run.recipe["model.time"])
    seconds = " to ".join(f"{time:g}" for time in dict.fromkeys(times[[0, -1]]))
    counts = f"{run.settings['counts']}, {seconds} s, frames {lay}"
    return f"{counts}. Module (frame): {side}, +v at the top, +u at the left"


def _captioned(picture: Bytes, text: str) -> Bytes:
    """A picture with a line of text below, as large as fits."""
    if not text:
        return picture
    size = max(_SMALL_TEXT, min(picture.shape[0] / 25, 0.95 * picture.shape[1] / letters.width(text, 1.0)))
    strip = np.full((math.ceil(1.5 * size), *picture.shape[1:]), _BORDER, np.uint8)
    _write(strip, text, round(0.15 * size), round(0.5 * size), size, shade=1.0)
    return np.concatenate([picture, strip])


def smaller(images: Floats32, pixels: float) -> Floats32:
    """Images (M, n_v, n_u) of about so many `pixels` together: means over blocks, where blocks of a size fill an image."""
    needed = math.sqrt(images.size / pixels)
    common = math.gcd(*images.shape[1:])
    side = max(side for side in range(1, max(2, math.ceil(2 * needed))) if common % side == 0)
    return _means(images, side) if needed > 1 and side > 1 else images


def sized(images: Floats32, pixels: float) -> Floats32:
    """Images (M, n_v, n_u) with so many pixels that they can be looked at: up to about `pixels` together, not too few."""
    _, n_v, n_u = images.shape
    factor = min(int(np.ceil(np.sqrt(images.size / pixels))), n_v, n_u)
    if factor > 1:
        return _means(images, factor)
    factor = -(-_SMALLEST // max(n_v, n_u))
    return images.repeat(factor, axis=1).repeat(factor, axis=2) if factor > 1 else images


def _means(images: Floats32, side: int) -> Floats32:
    """Means over blocks of `side` pixels a side; pixels beyond the last block are left out."""
    count, n_v, n_u = images.shape
    rows, columns = n_v // side, n_u // side
    blocks = images[:, : rows * side, : columns * side].reshape(count, rows, side, columns, side)
    return blocks.mean(axis=(2, 4), dtype=np.float32)


def places(rings: Integers, columns: int = COLUMNS) -> Integers:
    """Row and column (M, 2) of each image, counted in images: a ring in a row, or in several of at most `columns`."""
    at = np.empty((len(rings), 2), np.int64)
    row = 0
    for ring in dict.fromkeys(rings.tolist()):
        members = np.flatnonzero(rings == ring)
        position = np.arange(len(members))
        at[members] = np.stack([row + position // columns, position % columns], axis=1)
        row += int(position[-1]) // columns + 1
    return at


def _color_bar(display: Display, window: tuple[float, float], unit: str, height: int, size: float) -> Bytes:
    """A colour bar (height, width, 3) with its numbers and, above, its unit."""
    unit = unit_text(unit)
    line, em = math.ceil(1.1 * size), round(size)
    top, bottom = 2 * line, height - line
    steps = next((n for n in (4, 2) if bottom - top >= n * line), 1)  # as many as have room
    marks = [(share, f"{display.value_at(share, window):.4g}") for share in np.linspace(1.0, 0.0, steps + 1).tolist()]
    columns = max(letters.width(unit, size), 1.5 * em + max(letters.width(text, size) for _, text in marks))
    bar = np.full((height, math.ceil(columns) + em, 3), _BORDER, np.uint8)
    _write(bar, unit, line // 3, em // 2, size, shade=1.0)
    ramp = [display.value_at(share, window) for share in np.linspace(1.0, 0.0, bottom - top)]
    bar[top:bottom, em // 2 : em // 2 + em] = display.colored(ramp, window)[:, None]
    for share, text in marks:
        middle = bottom - round(share * (bottom - top))
        _write(bar, text, min(max(middle - line // 2, top - line // 2), height - line), 2 * em, size, shade=1.0)
    return bar


def _write(picture: Bytes, text: str, row: int, column: int, size: float, shade: float = 0.5) -> None:
    """Write a line of text in white, on what is there, `shade` times as bright."""
    ink, _ = letters.lettered(text, size)
    place = picture[row : row + ink.shape[0], column : column + ink.shape[1]]
    ink = ink[: place.shape[0], : place.shape[1], None]
    place[:] = np.rint(255 * ink + (1 - ink) * shade * place)


def write_png(picture: ArrayLike, path: AnyPath) -> None:
    """Write a picture (`png`) to a file."""
    write_bytes(path, png(picture))


def png(picture: ArrayLike, level: int = -1) -> bytes:
    """A picture, row 0 at the top, as an 8-bit PNG: colours (height, width, 3) of uint8, or numbers (height, width).

    Colours may have a fourth number, their opacity. Of numbers, 0 is black, or the smallest if that is negative, and the
    largest is white. `level` is zlib's.
    """
    pixels = np.asarray(picture)
    if pixels.ndim == 2:
        low, high = float(pixels.min(initial=0.0)), float(pixels.max(initial=0.0))
        pixels = np.rint((pixels - low) / ((high - low) or 1.0) * 255).astype(np.uint8)[..., None]
    height, width, channels = pixels.shape
    header = struct.pack(">2I5B", width, height, 8, {1: 0, 3: 2, 4: 6}[channels], 0, 0, 0)  # 8 bits, grey or colours
    rows = zlib.compress(np.pad(pixels.reshape(height, -1), ((0, 0), (1, 0))).tobytes(), level)  # 0 before each: as is
    data = b"\x89PNG\r\n\x1a\n"
    for name, part in ((b"IHDR", header), (b"IDAT", rows), (b"IEND", b"")):
        data += struct.pack(">I", len(part)) + name + part + struct.pack(">I", zlib.crc32(name + part))
    return data
