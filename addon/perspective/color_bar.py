"""Colour bar of a volume with slices, or in perspective, in the 3D views: colours with their numbers and unit."""

import itertools

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader

from ...core.runs.display import Display, number_text
from ..blender import windows
from ..volumes import slices, volume_materials, volumes
from . import frustums

_LEFT, _BOTTOM, _WIDTH, _HEIGHT, _LETTERS = 90, 60, 14, 180, 12  # pixels at a resolution scale of 1


def rectangle() -> tuple[float, float, float, float]:
    """Return left, bottom, width and height of the bar in a 3D view's region, pixels."""
    scale = bpy.context.preferences.system.ui_scale
    return scale * _LEFT, scale * _BOTTOM, scale * _WIDTH, scale * _HEIGHT


def labels(item: bpy.types.Object) -> tuple[str, dict[str, float]]:
    """Return the title above a volume's bar, and the round numbers beside it with their places, from 0 to 1 upward."""
    settings = item.mphdrr_volume
    title = f"{settings.quantity}, {settings.unit}".removesuffix(", 1")
    low, high = settings.display_low, settings.display_high
    return title, {number_text(value): (value - low) / ((high - low) or 1.0) for value in Display().marks((low, high))}


def _bar_volume(context: bpy.types.Context) -> bpy.types.Object | None:
    """Return the volume whose bar is drawn: the active or another one with visible slices, or one with a visible frustum."""
    for item in (slices.active_sliced_volume(context), *volumes.volume_objects(context.scene)):
        if item is not None and any(plane.visible_get() for plane in slices.planes_of(item)):
            return item
    return next(iter(frustums.visible_volumes(context.scene)), None)


def draw() -> None:
    """Draw the colour bar; Blender calls this for every 3D view."""
    context = bpy.context
    item = _bar_volume(context) if context.space_data.overlay.show_overlays else None
    if item is None:
        return
    bar_left, bottom, width, height = rectangle()
    colors = slices.color_table(item.mphdrr_volume.quantity, volume_materials.item_ramp(item))
    colors[:, 3] = 1.0
    ys = bottom + height * np.linspace(0.0, 1.0, len(colors))
    corners = np.stack([np.column_stack([np.full(len(ys), x), ys]) for x in (bar_left, bar_left + width)], axis=1)
    shader = gpu.shader.from_builtin("SMOOTH_COLOR")
    shape = {"pos": corners.reshape(-1, 2).tolist(), "color": colors.repeat(2, axis=0).tolist()}
    batch_for_shader(shader, "TRI_STRIP", shape).draw(shader)
    letters = height / _HEIGHT * _LETTERS
    title, texts = labels(item)
    text_ys = [bottom + share * height - 0.35 * letters for share in (*texts.values(), 1.0 + 1.8 * letters / height)]
    text_xs = [*(bar_left + 1.5 * width for _ in texts), bar_left]
    windows.draw_texts(zip((*texts, title), text_xs, text_ys, itertools.repeat((1.0,) * 4)), letters)
