"""The mosaic's tiles: which module's image and number is where, and a frame around the active module's image."""

from collections.abc import Sequence
from typing import Any

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ..core.errors import InputError
from ..core.runs.display import Display
from ..core.runs.mosaic import as_seen
from . import ids, images, scanner, selection

_ACTIVE = (1.0, 1.0, 1.0, 1.0)  # the frame's colour
_WIDTH = 2.0  # of its lines, in pixels of the screen


def pick(context: bpy.types.Context, x: float, y: float) -> str | None:
    """Make the module active whose image is at a place of the Image Editor's region; None where there is none."""
    image = context.space_data.image
    tiles = images.tiles(image)
    if tiles is None:
        return None
    found = _tile_at(image, tiles, *context.region.view2d.region_to_view(x, y))
    if found is None:
        return None
    collection = images.scanner_of(image)
    if collection not in scanner.scanners(context.scene):
        raise InputError("the scanner of these projections is not in the scene: render them again")
    camera = scanner.module(collection, tiles["numbers"][found[0]])
    if not camera.visible_get():
        raise InputError(f"{camera.name} is hidden: show it in the Modules panel")
    selection.select(context, [camera])
    return camera.name


def value_at(image: bpy.types.Image | None, across: float, up: float) -> tuple[str, float] | None:
    """The exact number under a place (0 to 1, from the bottom left) of a projection, its picture or the mosaic.

    With what it is: "mphDRR 07, column 12, row 34", counted as in the arrays. None where there is no projection.
    """
    if image is None or not (0 <= across < 1 and 0 <= up < 1):
        return None
    name, tiles = image.name.removesuffix(ids.picture_name("")), images.tiles(image)
    if tiles is not None:
        found = _tile_at(image, tiles, across, up)
        if found is None:
            return None
        name = images.projection_name(tiles["numbers"][found[0]], tiles["numbers"])
        within = found[1:]
    exact = bpy.data.images.get(name)
    if exact is None or not images.is_exact(exact):
        return None
    shown = images.tiles(bpy.data.images.get(ids.MOSAIC)) or {}
    values, whole = images.projection_array(exact), images.is_exact(image)
    rows, columns = values.shape
    part = as_seen(Display(half=bool(shown.get("half")) and not whole).part(values))
    if tiles is None:
        down, right = int((1 - up) * part.shape[0]), int(across * part.shape[1])
    else:  # a tile's pixel is a block of the image's, or the other way round
        down, right = (_index(*place) for place in zip(within, part.shape, tiles["tile"], strict=True))
    row = rows - 1 - down - (rows - part.shape[0]) // 2
    column = columns - 1 - right - (columns - part.shape[1]) // 2
    return f"{name}, column {column}, row {row}", float(part[down, right])


def set_window(settings: bpy.types.PropertyGroup, end: str, value: float, window: Sequence[float]) -> None:
    """Make a number the "low" or "high" end of the display's window, the one now shown (`window`) being the other.

    Raises InputError, and changes nothing, where that is no window.
    """
    low, high = window if settings.automatic else (settings.low, settings.high)
    low, high = (value, high) if end == "low" else (low, value)
    Display(settings.colors.lower(), settings.scale.lower(), low, high)
    settings.low, settings.high, settings.automatic = low, high, False


def _tile_at(
    image: bpy.types.Image, tiles: dict[str, Any], across: float, up: float
) -> tuple[int, float, float] | None:
    """Which of the mosaic's images is at a place (0 to 1), and where in it, in its rows and columns from the top left."""
    width, height = image.size
    place = np.array([(1.0 - up) * height, across * width])
    corners = np.reshape(tiles["corners"], (-1, 2))
    found = np.flatnonzero(((place >= corners) & (place < corners + tiles["tile"])).all(axis=1))
    if not len(found):
        return None
    down, right = place - corners[found[0]]
    return int(found[0]), float(down), float(right)


def _index(place: float, pixels: int, of_tile: int) -> int:
    """Which of an image's pixels is at a place in its tile, in pixels of that."""
    if pixels >= of_tile:
        return int(place) * (pixels // of_tile)
    return int(place) // (of_tile // pixels)


def active_tile(context: bpy.types.Context, image: bpy.types.Image | None) -> int | None:
    """Which of the mosaic's images is the active module's; None where it is of another scanner, or has none."""
    shown = images.tiles(image)
    camera = selection.active_module(context) if shown is not None else None
    if shown is None or camera is None or camera.mphdrr_module.number not in shown["numbers"]:
        return None
    if scanner.scanner_of(context.scene, camera) != images.scanner_of(image):
        return None
    return int(shown["numbers"].index(camera.mphdrr_module.number))


def draw() -> None:
    """Draw the frame; Blender calls this for every Image Editor."""
    context = bpy.context
    image = context.space_data.image
    index, tiles = active_tile(context, image), images.tiles(image)
    if index is None or tiles is None:
        return
    row, column = np.reshape(tiles["corners"], (-1, 2))[index]
    (rows, columns), (width, height) = tiles["tile"], image.size
    to_region = context.region.view2d.view_to_region
    left, top = to_region(column / width, 1.0 - row / height, clip=False)
    right, bottom = to_region((column + columns) / width, 1.0 - (row + rows) / height, clip=False)
    shader = gpu.shader.from_builtin("POLYLINE_UNIFORM_COLOR")
    shader.uniform_float("viewportSize", gpu.state.viewport_get()[2:])
    shader.uniform_float("lineWidth", _WIDTH)
    shader.uniform_float("color", _ACTIVE)
    corners = [(left, top, 0), (right, top, 0), (right, bottom, 0), (left, bottom, 0), (left, top, 0)]
    batch_for_shader(shader, "LINE_STRIP", {"pos": corners}).draw(shader)
