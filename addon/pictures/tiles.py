"""Tiles of the mosaic: positions of modules' images and of their pixels, and a frame around the active module's image."""

from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.errors import InputError
from ...core.runs.display import Display, unit_text
from ..blender import ids, windows
from ..scanner import scanner, selection
from . import images

_FRAME_COLOR = (1.0, 1.0, 1.0, 1.0)
_WIDTH = 2.0  # of the frame's lines, pixels


@dataclass(frozen=True)
class Picture:
    """Position of a module's projection in an image: in the mosaic, or in an image of its own."""

    number: int
    """Number of the module."""
    name: str
    """Name of the exact image."""
    corner: tuple[int, int]
    """Row and column of the picture's top left corner in the image, pixels."""
    size: tuple[int, int]
    """Numbers of the picture's rows and columns in the image, pixels."""
    share: tuple[float, float] = (1.0, 1.0)
    """Fractions of the projection's width and height, about its middle, that the picture shows."""

    def image_positions(self, pixels: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float64]:
        """Return rows and columns (…, 2) in the image, from its top left, of columns and rows (…, 2) of the projection.

        Columns and rows of the projection, of the given `shape`, count as in arrays: 0 is the centre of pixel 0. Rows and
        columns of the image are 0 at its corner.
        """
        step, corner_pixel = self._pixel_blocks(shape)
        return self.corner + (corner_pixel - np.asarray(pixels, np.float64)[..., ::-1]) / step

    def projection_pixels(self, positions: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float64]:
        """Return columns and rows (…, 2) of the projection at rows and columns `positions` (…, 2) in the image."""
        step, corner_pixel = self._pixel_blocks(shape)
        return np.asarray((corner_pixel - (np.asarray(positions, np.float64) - self.corner) * step)[..., ::-1])

    def pixel_at(self, position: ArrayLike, shape: tuple[int, int]) -> tuple[int, int]:
        """Return column and row of the projection's pixel at a position (row, column) in the image."""
        # An edge between pixels belongs to the lower right one.
        column, row = np.ceil(self.projection_pixels(position, shape) - 0.5).astype(int).tolist()
        return min(max(column, 0), shape[1] - 1), min(max(row, 0), shape[0] - 1)

    def _pixel_blocks(self, shape: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the size (2,) of a picture pixel in projection rows and columns, and the (row, column) of its corner.

        Rows and columns decrease from the top left: whoever looks out of the pinhole, +v up, has +u to the left
        (`as_seen`).
        """
        shown_shape = [round(n * share) for n, share in zip(shape, self.share[::-1], strict=True)]
        # A picture pixel is a block of projection pixels, or the other way round; a last, smaller block is not shown.
        step = [n // size if n >= size else 1 / (size // n) for n, size in zip(shown_shape, self.size, strict=True)]
        return np.array(step), (np.array(shape) + shown_shape) / 2 - 0.5


def shown_pictures(image: bpy.types.Image | None) -> list[Picture]:
    """Return the projections that an image shows: all of the mosaic, one of an exact image or a picture, else none."""
    if image is None or not images.is_ours(image):
        return []
    own_tiles = images.tiles(image)
    if own_tiles is not None:
        share = tuple(own_tiles.get("share", (1.0, 1.0)))
        rows, columns = own_tiles["tile"]
        names = (images.projection_name(number, own_tiles["numbers"]) for number in own_tiles["numbers"])
        entries = zip(own_tiles["numbers"], names, np.reshape(own_tiles["corners"], (-1, 2)).tolist(), strict=True)
        return [Picture(number, name, (row, column), (rows, columns), share) for number, name, (row, column) in entries]
    run_tiles = images.tiles(bpy.data.images.get(ids.MOSAIC)) or {}
    share = (1.0, 1.0) if images.is_exact(image) else images.shown_fraction()
    exact_name = image.name.removesuffix(ids.picture_name(""))
    numbers = [n for n in run_tiles.get("numbers", ()) if images.projection_name(n, run_tiles["numbers"]) == exact_name]
    columns, rows = image.size
    return [Picture(n, exact_name, (0, 0), (rows, columns), share) for n in numbers]


def picture_at(image: bpy.types.Image | None, x: float, y: float) -> tuple[Picture, tuple[float, float]] | None:
    """Return the projection at (x, y) of an image, 0 to 1 from the bottom left, and the image's (row, column) there."""
    if image is None or not (0 <= x < 1 and 0 <= y < 1):
        return None
    width, height = image.size
    row, column = (1.0 - y) * height, x * width
    for picture in shown_pictures(image):
        (top, left), (rows, columns) = picture.corner, picture.size
        if 0 <= row - top < rows and 0 <= column - left < columns:
            return picture, (row, column)
    return None


def value_at(image: bpy.types.Image | None, x: float, y: float) -> tuple[str, float] | None:
    """Return the label and the exact number at a position (x, y) of a projection, its picture or the mosaic.

    The position is 0 to 1 from the bottom left; a label is "mphDRR 07, column 12, row 34", counted as in the arrays. None
    where there is no projection.
    """
    hit = picture_at(image, x, y)
    exact = None if hit is None else bpy.data.images.get(hit[0].name)
    if hit is None or exact is None or not images.is_exact(exact):
        return None
    values = images.projection_array(exact)
    column, row = hit[0].pixel_at(hit[1], (values.shape[0], values.shape[1]))
    return f"{exact.name}, column {column}, row {row}", float(values[row, column])


def unit() -> str:
    """Return the unit of the shown run's images as people write it."""
    return unit_text((images.tiles(bpy.data.images.get(ids.MOSAIC)) or {}).get("unit", ""))


def pick_module(context: bpy.types.Context, x: float, y: float) -> str | None:
    """Make the module active whose image is at (x, y) of the Image Editor's region; return its name, None without one."""
    image = context.space_data.image
    hit = picture_at(image, *context.region.view2d.region_to_view(x, y))
    if images.tiles(image) is None or hit is None:
        return None
    return activate(context, hit[0].number)


def activate(context: bpy.types.Context, number: int) -> str:
    """Make a module of the mosaic's scanner active, which draws a frame around its image, and return its name."""
    collection = images.scanner_of(bpy.data.images[ids.MOSAIC])
    if collection not in scanner.scanners(context.scene):
        raise InputError("the scanner of these projections is not in the scene: render them again")
    camera = scanner.module(collection, number)
    if not camera.visible_get():
        raise InputError(f"{camera.name} is hidden: show it in the Modules panel")
    selection.select(context, [camera])
    return str(camera.name)


def set_window(settings: bpy.types.PropertyGroup, end: str, value: float, window: Sequence[float]) -> None:
    """Make a number the "low" or "high" end of the display's window; the other end stays as shown now (`window`).

    Raises InputError, and changes nothing, where the window would be invalid.
    """
    low, high = window if settings.automatic else (settings.low, settings.high)
    low, high = (value, high) if end == "low" else (low, value)
    Display(settings.colors.lower(), settings.scale.lower(), low, high)
    settings.low, settings.high, settings.automatic = low, high, False


def active_tile(context: bpy.types.Context, image: bpy.types.Image | None) -> int | None:
    """Return the index of the active module's image in the mosaic; None for another scanner's module or without image."""
    mosaic_tiles = images.tiles(image)
    camera = selection.active_module(context) if mosaic_tiles is not None else None
    if mosaic_tiles is None or camera is None or camera.mphdrr_module.number not in mosaic_tiles["numbers"]:
        return None
    if scanner.scanner_of(context.scene, camera) != images.scanner_of(image):
        return None
    return int(mosaic_tiles["numbers"].index(camera.mphdrr_module.number))


def frame(context: bpy.types.Context, picture: Picture, size: Sequence[int]) -> tuple[float, float, float, float]:
    """Return left, bottom, right and top of a picture in the Image Editor's region; `size`: its image (width, height)."""
    to_region = context.region.view2d.view_to_region
    (row, column), (rows, columns), (width, height) = picture.corner, picture.size, size
    left, top = to_region(column / width, 1.0 - row / height, clip=False)
    right, bottom = to_region((column + columns) / width, 1.0 - (row + rows) / height, clip=False)
    return left, bottom, right, top


def draw() -> None:
    """Draw the frame around the active module's image; Blender calls this for every Image Editor."""
    context = bpy.context
    image = context.space_data.image
    if (index := active_tile(context, image)) is None:
        return
    left, bottom, right, top = frame(context, shown_pictures(image)[index], image.size)
    corners = [(left, top, 0), (right, top, 0), (right, bottom, 0), (left, bottom, 0), (left, top, 0)]
    windows.draw_lines(corners, _FRAME_COLOR, _WIDTH, "LINE_STRIP")
