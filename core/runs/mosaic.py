"""Pictures of projections: upright, as seen from the pinhole, alone or all in one with numbers and a colour bar.

`mosaic` puts arrays together, `draw_sheet` draws them with the numbers and the colour bar, `png_bytes` makes a PNG file.
"""

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
from .display import Display, number_text, unit_text

if TYPE_CHECKING:  # pages of figures read this file, and runs take a while
    from .run import ProjectionRun


def as_seen(images: ArrayLike) -> Array:
    """Return images (..., n_v, n_u) as pictures: row 0 at the top, +v up, and +u to the left as seen from the pinhole.

    (u, v, k) is right-handed and k points away from the pinhole into the scene, so whoever looks along k with +v up
    has +u to the left: a picture in this order is what a camera in the pinhole sees, not its mirror image.
    """
    return real_numbers(images, "images")[..., ::-1, ::-1]


COLUMNS = 20
"""Default number of images in a row."""
_PAGE, _NARROWEST, _WIDEST = 1.5, 1.0, 2.5
"""Columns of a sheet of one ring over its rows."""
_BORDER = 64
"""Grey between the images of a sheet, 0 to 255."""
_SMALLEST = 96
"""Smallest side of an image in a sheet, pixels."""
_SMALL_TEXT = 11.0
"""Smallest size of text, pixels."""


def mosaic(images: ArrayLike, columns: int = COLUMNS) -> Array:
    """Return the pictures of all images (M, n_v, n_u) in one (rows * n_v, columns * n_u), row 0 at the top.

    They follow each other row by row from the top left: of 80 modules in 4 rings, 20 columns show a ring in each row. Empty
    places are 0.
    """
    images = as_seen(images)
    if images.ndim != 3:
        raise InputError(f"mosaic: expected images of shape (M, n_v, n_u), got {images.shape}")
    if columns < 1:
        raise InputError(f"mosaic: expected 1 column or more, got {columns}")
    n_images, n_v, n_u = images.shape
    rows = -(-n_images // columns)
    canvas = np.zeros((rows * columns, n_v, n_u), images.dtype)
    canvas[:n_images] = images
    return canvas.reshape(rows, columns, n_v, n_u).swapaxes(1, 2).reshape(rows * n_v, columns * n_u)


@dataclass(frozen=True, eq=False)
class MosaicSheet:
    """Picture of all projections of a run, with their numbers and a colour bar."""

    picture: Bytes
    """Colours (height, width, 3), row 0 at the top."""
    corners: Integers
    """Row and column (M, 2) of each image's top left pixel."""
    tile: tuple[int, int]
    """Height and width of an image in the picture, pixels."""
    window: tuple[float, float]
    """Numbers at the lower and the upper end of the colour bar."""
    summed: str
    """Kind of the numbers in the images' corners, "sum" or "mean", see `image_totals`."""
    totals: Floats
    """Numbers (M,) in the images' corners."""
    maxima: Floats32
    """Largest numbers (M,) of the images, or of their middle halves."""
    half: bool
    """Whether totals and maxima are those of the middle halves, which are shown."""
    share: tuple[float, float]
    """Shown fractions of the images' width and height."""


def image_totals(projections: Floats32, unit: str) -> tuple[str, Floats]:
    """Return "sum" for counts and photons or "mean" for line integrals, and this number (M,) of each image (M, n_v, n_u)."""
    name = "sum" if unit in ("counts", "photons") else "mean"
    return name, getattr(np, name)(projections, axis=(1, 2), dtype=np.float64)


def draw_sheet(
    projections: Floats32,
    numbers: ArrayLike,
    rings: ArrayLike,
    unit: str,
    display: Display | None = None,
    pixels: float = 6e6,
) -> MosaicSheet:
    """Draw the images of modules in one picture, each ring in a row or several, with the modules' numbers and a colour bar.

    Parameters
    ----------
    projections
        Images (M, n_v, n_u). If they have more than `pixels` pixels together, means over blocks are drawn; small images
        are enlarged, so that the numbers do not hide them.
    numbers, rings
        Number, or text, and ring of each module (M,). Rings are drawn in the order of their modules, in rows of
        `sheet_columns`.
    unit
        Unit of the images, for the colour bar. Where there is room, each image has its total (`image_totals`) in a corner:
        that of the middle half if the display shows this, else that of the whole image.
    display
        Colours and window; the automatic window is that of all images before they are reduced.
    pixels
        Largest number of pixels of all images together.
    """
    display = display or Display()
    window = display.window(projections)
    visible = display.part(projections, in_mosaic=True)
    counted = display.part(projections)  # an automatic part changes no number
    word, values = image_totals(counted, unit)
    images = display.colored(fit_images(as_seen(visible), pixels), window)
    tiles = tile_places(np.asarray(rings), sheet_columns(np.asarray(rings)))
    n_v, n_u = tile = images.shape[1:3]
    size = max(_SMALL_TEXT, min(n_v, n_u) / 5)
    gap = round(size / 6)
    corners = gap + tiles * (np.array(tile) + gap)
    height, width = corners.max(axis=0) + tile + gap
    picture = np.full((max(height, math.ceil(5 * size)), width, 3), _BORDER, np.uint8)  # room for the colour bar
    is_tall = tiles[:, 0].max() > 0  # the word stands once, below the colour bar, where there is room
    texts = [f"{'' if is_tall else word} {number_text(value)}".strip() for value in values]
    small = min(n_u / max(letters.width(total_text, 1.05) for total_text in texts), n_v / 5, size)
    for image, (row, column), number, total_text in zip(images, corners, np.asarray(numbers), texts, strict=True):
        picture[row : row + n_v, column : column + n_u] = image
        _write(picture, str(number), row + gap // 2, column + gap, size)
        if small >= _SMALL_TEXT:
            _write(picture, total_text, row + n_v - math.ceil(1.1 * small), column + gap, small)
    note = f"tile: {word}" if is_tall and small >= _SMALL_TEXT else ""
    bar = _color_bar(display, window, unit, note, len(picture), max(0.9 * size, height / 25))
    with_bar = np.concatenate([picture, bar], axis=1)
    share = visible.shape[2] / projections.shape[2], visible.shape[1] / projections.shape[1]
    maxima = counted.max(axis=(1, 2))
    return MosaicSheet(with_bar, corners, (n_v, n_u), window, word, values, maxima, display.region == "half", share)


def write_sheet(run: "ProjectionRun", path: AnyPath, display: Display | None = None) -> None:
    """Write the sheet of all images of a run (`draw_sheet`) as a PNG file."""
    sheet = draw_sheet(run.projections, module_labels(run), run.system.rings(), run.unit, display)
    write_png(_captioned(sheet.picture, counts_caption(run)), path)


def module_labels(run: "ProjectionRun") -> list[str]:
    """Return the labels of a run's images in a sheet: the module's number, with the frame's number for measured counts."""
    numbers = run.system.numbers.tolist()
    frames = {number: k for k, number in enumerate(run.settings.get("frames") or (), 1)}
    return [f"{number} ({frames[number]})" if number in frames else str(number) for number in numbers]


def counts_caption(run: "ProjectionRun") -> str:
    """Return a line about measured counts and how a sheet shows them; an empty text for other runs."""
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
    """Return a picture with a line of text below it, as large as fits."""
    if not text:
        return picture
    size = max(_SMALL_TEXT, min(picture.shape[0] / 25, 0.95 * picture.shape[1] / letters.width(text, 1.0)))
    strip = np.full((math.ceil(1.5 * size), *picture.shape[1:]), _BORDER, np.uint8)
    _write(strip, text, round(0.15 * size), round(0.5 * size), size, shade=1.0)
    return np.concatenate([picture, strip])


def block_means(images: Floats32, pixels: float) -> Floats32:
    """Return images (M, n_v, n_u) as means over blocks, about `pixels` together, if such blocks fill the images."""
    needed = math.sqrt(images.size / pixels)
    common = math.gcd(*images.shape[1:])
    side = max(side for side in range(1, max(2, math.ceil(2 * needed))) if common % side == 0)
    return _means(images, side) if needed > 1 and side > 1 else images


def fit_images(images: Floats32, pixels: float) -> Floats32:
    """Return images (M, n_v, n_u) in a size to look at: about `pixels` together at most, enlarged if they are small."""
    _, n_v, n_u = images.shape
    factor = min(int(np.ceil(np.sqrt(images.size / pixels))), n_v, n_u)
    if factor > 1:
        return _means(images, factor)
    factor = -(-_SMALLEST // max(n_v, n_u))
    return images.repeat(factor, axis=1).repeat(factor, axis=2) if factor > 1 else images


def _means(images: Floats32, side: int) -> Floats32:
    """Return the means of images over blocks of `side` x `side` pixels; pixels beyond the last block are left out."""
    n_images, n_v, n_u = images.shape
    rows, columns = n_v // side, n_u // side
    blocks = images[:, : rows * side, : columns * side].reshape(n_images, rows, side, columns, side)
    return blocks.mean(axis=(2, 4), dtype=np.float32)


def sheet_columns(rings: Integers) -> int:
    """Return the number of images in a row of a sheet, of modules in `rings` (M,).

    Of several rings each takes a row, or as many equal ones as rows of at most `COLUMNS` need. A single ring fills a page of
    `_PAGE`, without empty places if a shape between `_NARROWEST` and `_WIDEST` allows it: 24 images stand as 4 rows of 6.
    """
    counts = np.unique(rings, return_counts=True)[1]
    n_images = int(counts.max())
    if len(counts) > 1:
        return -(-n_images // -(-n_images // COLUMNS))
    page_columns = math.sqrt(_PAGE * n_images)
    full = [n for n in range(1, n_images + 1) if n_images % n == 0 and _NARROWEST <= n**2 / n_images <= _WIDEST]
    nearly_full = -(-n_images // max(1, round(n_images / page_columns)))
    return min(full, key=lambda n: abs(n - page_columns), default=nearly_full)


def tile_places(rings: Integers, columns: int = COLUMNS) -> Integers:
    """Return row and column (M, 2) of each image, in images: a ring takes a row, or several of at most `columns` images."""
    tiles = np.empty((len(rings), 2), np.int64)
    row = 0
    for ring in dict.fromkeys(rings.tolist()):
        members = np.flatnonzero(rings == ring)
        position = np.arange(len(members))
        tiles[members] = np.stack([row + position // columns, position % columns], axis=1)
        row += int(position[-1]) // columns + 1
    return tiles


def _color_bar(display: Display, window: tuple[float, float], unit: str, note: str, height: int, size: float) -> Bytes:
    """Return a colour bar (height, width, 3) with its numbers, its unit above it and a note below it."""
    unit = unit_text(unit)
    line, em = math.ceil(1.1 * size), round(size)
    top, bottom = 2 * line, height - (3 * line // 2 if note else 0) - line
    values = display.marks(window, min(5, max(1, (bottom - top) // line)))  # as many steps as there is room for
    marks = [(float(display.shares(value, window)), number_text(value)) for value in values]
    widths = [1.5 * em + letters.width(text, size) for _, text in marks]
    columns = max(letters.width(unit, size), letters.width(note, size), *widths)
    bar = np.full((height, math.ceil(columns) + em, 3), _BORDER, np.uint8)
    _write(bar, unit, line // 3, em // 2, size, shade=1.0)
    _write(bar, note, height - line, em // 2, size, shade=1.0)
    ramp = [display.value_at(share, window) for share in np.linspace(1.0, 0.0, bottom - top)]
    bar[top:bottom, em // 2 : em // 2 + em] = display.colored(ramp, window)[:, None]
    for share, text in marks:
        middle = bottom - round(share * (bottom - top))
        _write(bar, text, min(max(middle - line // 2, top - line // 2), height - line), 2 * em, size, shade=1.0)
    return bar


def _write(picture: Bytes, text: str, row: int, column: int, size: float, shade: float = 0.5) -> None:
    """Write a line of white text into a picture, which gets darker by the factor `shade` behind the text."""
    ink, _ = letters.text_ink(text, size)
    area = picture[row : row + ink.shape[0], column : column + ink.shape[1]]
    ink = ink[: area.shape[0], : area.shape[1], None]
    area[:] = np.rint(255 * ink + (1 - ink) * shade * area)


def write_png(picture: ArrayLike, path: AnyPath) -> None:
    """Write a picture to a file, see `png_bytes`."""
    write_bytes(path, png_bytes(picture))


def png_bytes(picture: ArrayLike, level: int = -1) -> bytes:
    """Return a picture, row 0 at the top, as the bytes of an 8-bit PNG file.

    The picture is colours (height, width, 3) of uint8, which may have opacity as a fourth number, or real numbers (height,
    width), drawn in grey: 0, or the smallest number if that is negative, is black, and the largest is white. `level` is the
    compression level of zlib.
    """
    pixels = np.asarray(picture)
    if pixels.ndim == 2:
        low, high = float(pixels.min(initial=0.0)), float(pixels.max(initial=0.0))
        pixels = np.rint((pixels - low) / ((high - low) or 1.0) * 255).astype(np.uint8)[..., None]
    height, width, channels = pixels.shape
    header = struct.pack(">2I5B", width, height, 8, {1: 0, 3: 2, 4: 6}[channels], 0, 0, 0)  # 8 bits, grey or colours
    rows = zlib.compress(np.pad(pixels.reshape(height, -1), ((0, 0), (1, 0))).tobytes(), level)  # 0: unfiltered row
    data = b"\x89PNG\r\n\x1a\n"
    for name, chunk in ((b"IHDR", header), (b"IDAT", rows), (b"IEND", b"")):
        data += struct.pack(">I", len(chunk)) + name + chunk + struct.pack(">I", zlib.crc32(name + chunk))
    return data
