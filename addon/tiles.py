"""The mosaic's tiles: which module's image is where, and a frame around the active module's in the Image Editor."""

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ..core.errors import InputError
from . import images, scanner, selection

_ACTIVE = (1.0, 1.0, 1.0, 1.0)  # the frame's colour
_WIDTH = 2.0  # of its lines, in pixels of the screen


def pick(context: bpy.types.Context, x: float, y: float) -> str | None:
    """Make the module active whose image is at a place of the Image Editor's region; None where there is none."""
    image = context.space_data.image
    tiles = images.tiles(image)
    if tiles is None:
        return None
    across, up = context.region.view2d.region_to_view(x, y)
    width, height = image.size
    place = np.array([(1.0 - up) * height, across * width])
    corners = np.reshape(tiles["corners"], (-1, 2))
    found = np.flatnonzero(((place >= corners) & (place < corners + tiles["tile"])).all(axis=1))
    if not len(found):
        return None
    collection = images.scanner_of(image)
    if collection not in scanner.scanners(context.scene):
        raise InputError("the scanner of these projections is not in the scene: render them again")
    camera = scanner.module(collection, tiles["numbers"][found[0]])
    if not camera.visible_get():
        raise InputError(f"{camera.name} is hidden: show it in the Modules panel")
    selection.select(context, [camera])
    return camera.name


def _draw() -> None:
    """Draw the frame; Blender calls this for every Image Editor."""
    context = bpy.context
    image = context.space_data.image
    tiles = images.tiles(image)
    camera = selection.active_module(context) if tiles is not None else None
    if tiles is None or camera is None or camera.mphdrr_module.number not in tiles["numbers"]:
        return
    if scanner.scanner_of(context.scene, camera) != images.scanner_of(image):
        return
    row, column = np.reshape(tiles["corners"], (-1, 2))[tiles["numbers"].index(camera.mphdrr_module.number)]
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


def draw_frames() -> object:
    """Draw frames from now on; the result takes it back (`draw_no_frames`)."""
    return bpy.types.SpaceImageEditor.draw_handler_add(_draw, (), "WINDOW", "POST_PIXEL")


def draw_no_frames(handle: object) -> None:
    """Undo `draw_frames`."""
    bpy.types.SpaceImageEditor.draw_handler_remove(handle, "WINDOW")
