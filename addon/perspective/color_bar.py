"""The colour bar of a volume with slices, or in perspective, in the 3D views: what colours mean, numbers and their unit."""

import itertools

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ..blender import windows
from ..volumes import slices, volume_materials, volumes
from . import frustums

_LEFT, _BOTTOM, _WIDTH, _HEIGHT, _LETTERS = 90, 60, 14, 180, 12  # at a resolution scale of 1, pixels
_MARKS = (0.0, 0.25, 0.5, 0.75, 1.0)


def place() -> tuple[float, float, float, float]:
    """Left, bottom, width and height of the bar in a 3D view's region, pixels."""
    scale = bpy.context.preferences.system.ui_scale
    return scale * _LEFT, scale * _BOTTOM, scale * _WIDTH, scale * _HEIGHT


def marks(item: bpy.types.Object) -> tuple[str, list[str]]:
    """What is written above a volume's bar, and beside it, from its lower end to the upper."""
    settings = item.mphdrr_volume
    title = f"{settings.quantity}, {settings.unit}".removesuffix(", 1")
    low, high = settings.display_low, settings.display_high
    return title, [f"{low + share * (high - low):.4g}" for share in _MARKS]


def _shown(context: bpy.types.Context) -> bpy.types.Object | None:
    """The volume whose bar is drawn: the active one, or another with slices that are seen, or of a frustum that is."""
    for item in (slices.active_sliced_volume(context), *volumes.volume_objects(context.scene)):
        if item is not None and any(plane.visible_get() for plane in slices.planes_of(item)):
            return item
    return next(iter(frustums.seen_volumes(context.scene)), None)


def draw() -> None:
    """Draw the bar; Blender calls this for every 3D view."""
    context = bpy.context
    item = _shown(context) if context.space_data.overlay.show_overlays else None
    if item is None:
        return
    left, bottom, width, height = place()
    colors = slices.color_table(item.mphdrr_volume.quantity, volume_materials.item_ramp(item))
    colors[:, 3] = 1.0
    up = bottom + height * np.linspace(0.0, 1.0, len(colors))
    corners = np.stack([np.column_stack([np.full(len(up), x), up]) for x in (left, left + width)], axis=1)
    shader = gpu.shader.from_builtin("SMOOTH_COLOR")
    shape = {"pos": corners.reshape(-1, 2).tolist(), "color": colors.repeat(2, axis=0).tolist()}
    batch_for_shader(shader, "TRI_STRIP", shape).draw(shader)
    letters = height / _HEIGHT * _LETTERS
    title, texts = marks(item)
    ups = [bottom + share * height - 0.35 * letters for share in (*_MARKS, 1.0 + 1.8 * letters / height)]
    lefts = [*(left + 1.5 * width for _ in texts), left]
    windows.draw_texts(zip((*texts, title), lefts, ups, itertools.repeat((1.0,) * 4)), letters)
