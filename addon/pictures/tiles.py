"""The mosaic's tiles: which module's image and number is where, and a frame around the active module's image."""

from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.errors import InputError
from ...core.runs.display import Display
from ..blender import ids, windows
from ..scanner import scanner, selection
from . import images

_ACTIVE = (1.0, 1.0, 1.0, 1.0)  # the frame's colour
_WIDTH = 2.0  # of its lines, in pixels of the screen


@dataclass(frozen=True)
class Picture:
    """Where a module's projection is shown: in the mosaic, or as an image of its own."""

    number: int
    """The module's."""
    name: str
    """The exact image's."""
    corner: tuple[int, int]
    """Row and column of its top left in the image, pixels of that."""
    size: tuple[int, int]
    """Its rows and columns, pixels of the image."""
    half: bool
    """Whether it shows the projection's middle half."""

    def places(self, pixels: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float64]:
        """Rows and columns (…, 2) in the image, from its top left, of columns and rows (…, 2) of a projection of that shape.

        Those of the projection count as in arrays: 0 is the centre of pixel 0. Those in the image are 0 at its corner.
        """
        step, edge = self._seen(shape)
        return self.corner + (edge - np.asarray(pixels, np.float64)[..., ::-1]) / step

    def pixels(self, places: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float64]:
        """The inverse of `places`: columns and rows (…, 2) of the projection."""
        step, edge = self._seen(shape)
        return np.asarray((edge - (np.asarray(places, np.float64) - self.corner) * step)[..., ::-1])

    def pixel(self, place: ArrayLike, shape: tuple[int, int]) -> tuple[int, int]:
        """Column and row of the projection's pixel that is at a row and column of the image."""
        column, row = np.ceil(self.pixels(place, shape) - 0.5).astype(int).tolist()  # at an edge, down and to the right
        return min(max(column, 0), shape[1] - 1), min(max(row, 0), shape[0] - 1)

    def _seen(self, shape: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """How many rows and columns a pixel of the image is high and wide (2,), and the row and column (2,) at its corner.

        Rows and columns decrease from the top left: whoever looks out of the pinhole, +v up, has +u to the left (`as_seen`).
        """
        part = Display(half=self.half).part(np.empty(shape, np.bool_)).shape
        # A picture's pixel is a block of the projection's, or the other way round; a last, smaller block is not shown.
        step = [n // size if n >= size else 1 / (size // n) for n, size in zip(part, self.size, strict=True)]
        return np.array(step), (np.array(shape) + part) / 2 - 0.5


def pictures(image: bpy.types.Image | None) -> list[Picture]:
    """The projections that an image shows: the mosaic's, or that of an exact image or a picture; else none."""
    if image is None or not images.is_ours(image):
        return []
    shown = images.tiles(image)
    of_run = images.tiles(bpy.data.images.get(ids.MOSAIC)) or {}
    half = bool(of_run.get("half"))
    if shown is not None:
        rows, columns = shown["tile"]
        names = (images.projection_name(number, shown["numbers"]) for number in shown["numbers"])
        found = zip(shown["numbers"], names, np.reshape(shown["corners"], (-1, 2)).tolist(), strict=True)
        return [Picture(number, name, (row, column), (rows, columns), half) for number, name, (row, column) in found]
    own = image.name.removesuffix(ids.picture_name(""))
    numbers = [n for n in of_run.get("numbers", ()) if images.projection_name(n, of_run["numbers"]) == own]
    columns, rows = image.size
    return [Picture(n, own, (0, 0), (rows, columns), half and not images.is_exact(image)) for n in numbers]


def picture_at(image: bpy.types.Image | None, across: float, up: float) -> tuple[Picture, tuple[float, float]] | None:
    """Which projection is at a place of an image (0 to 1, from the bottom left), and the image's row and column there."""
    if image is None or not (0 <= across < 1 and 0 <= up < 1):
        return None
    width, height = image.size
    row, column = (1.0 - up) * height, across * width
    for picture in pictures(image):
        (top, left), (rows, columns) = picture.corner, picture.size
        if 0 <= row - top < rows and 0 <= column - left < columns:
            return picture, (row, column)
    return None


def value_at(image: bpy.types.Image | None, across: float, up: float) -> tuple[str, float] | None:
    """The exact number under a place (0 to 1, from the bottom left) of a projection, its picture or the mosaic.

    With what it is: "mphDRR 07, column 12, row 34", counted as in the arrays. None where there is no projection.
    """
    found = picture_at(image, across, up)
    exact = None if found is None else bpy.data.images.get(found[0].name)
    if found is None or exact is None or not images.is_exact(exact):
        return None
    values = images.projection_array(exact)
    column, row = found[0].pixel(found[1], (values.shape[0], values.shape[1]))
    return f"{exact.name}, column {column}, row {row}", float(values[row, column])


def pick(context: bpy.types.Context, x: float, y: float) -> str | None:
    """Make the module active whose image is at a place of the Image Editor's region; None where there is none."""
    image = context.space_data.image
    found = picture_at(image, *context.region.view2d.region_to_view(x, y))
    if images.tiles(image) is None or found is None:
        return None
    return activate(context, found[0].number)


def activate(context: bpy.types.Context, number: int) -> str:
    """Make a module of the mosaic's scanner active, which has a frame around its image; returns its name."""
    collection = images.scanner_of(bpy.data.images[ids.MOSAIC])
    if collection not in scanner.scanners(context.scene):
        raise InputError("the scanner of these projections is not in the scene: render them again")
    camera = scanner.module(collection, number)
    if not camera.visible_get():
        raise InputError(f"{camera.name} is hidden: show it in the Modules panel")
    selection.select(context, [camera])
    return str(camera.name)


def set_window(settings: bpy.types.PropertyGroup, end: str, value: float, window: Sequence[float]) -> None:
    """Make a number the "low" or "high" end of the display's window, the one now shown (`window`) being the other.

    Raises InputError, and changes nothing, where that is no window.
    """
    low, high = window if settings.automatic else (settings.low, settings.high)
    low, high = (value, high) if end == "low" else (low, value)
    Display(settings.colors.lower(), settings.scale.lower(), low, high)
    settings.low, settings.high, settings.automatic = low, high, False


def active_tile(context: bpy.types.Context, image: bpy.types.Image | None) -> int | None:
    """Which of the mosaic's images is the active module's; None where it is of another scanner, or has none."""
    shown = images.tiles(image)
    camera = selection.active_module(context) if shown is not None else None
    if shown is None or camera is None or camera.mphdrr_module.number not in shown["numbers"]:
        return None
    if scanner.scanner_of(context.scene, camera) != images.scanner_of(image):
        return None
    return int(shown["numbers"].index(camera.mphdrr_module.number))


def frame(context: bpy.types.Context, picture: Picture, size: Sequence[int]) -> tuple[float, float, float, float]:
    """Left, bottom, right and top, in the Image Editor's region, of a picture in an image of that width and height."""
    to_region = context.region.view2d.view_to_region
    (row, column), (rows, columns), (width, height) = picture.corner, picture.size, size
    left, top = to_region(column / width, 1.0 - row / height, clip=False)
    right, bottom = to_region((column + columns) / width, 1.0 - (row + rows) / height, clip=False)
    return left, bottom, right, top


def draw() -> None:
    """Draw the frame; Blender calls this for every Image Editor."""
    context = bpy.context
    image = context.space_data.image
    index = active_tile(context, image)
    if index is None:
        return
    left, bottom, right, top = frame(context, pictures(image)[index], image.size)
    corners = [(left, top, 0), (right, top, 0), (right, bottom, 0), (left, bottom, 0), (left, top, 0)]
    windows.draw_lines(corners, _ACTIVE, _WIDTH, "LINE_STRIP")
