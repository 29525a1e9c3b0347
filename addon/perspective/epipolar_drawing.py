"""Drawings of the picked pixel, its ray and epipolar lines, over the pictures and in the 3D views; never rendered."""

from collections.abc import Callable
from typing import Any

import bpy
import gpu
import numpy as np
from numpy.typing import NDArray

from ..blender import ids, windows
from ..pictures import images, planes, tiles
from . import epipolar

Floats = NDArray[np.float64]

_LINE, _FAINT = (0.2, 0.85, 1.0, 1.0), (0.2, 0.85, 1.0, 0.35)  # colours of a line inside and outside the ROI
_MARKER, _PIXEL = (0.45, 1.0, 0.3, 1.0), (1.0, 1.0, 1.0, 1.0)
_OUTLINE = (0.0, 0.0, 0.0, 0.6)
_WIDTH, _MARKER_WIDTH = 1.3, 1.5  # of lines, pixels at a resolution scale of 1
_RADIUS = 8.0  # of a marker over a picture, pixels at a resolution scale of 1; wide enough to show a small source
_MARKER_SHARE = 0.05  # radius of a marker in the scene, relative to a plane's width or the ROI's radius
_IN_FRONT = 1.005  # distance of lines from the pinhole relative to their plane's, so that it does not hide them

_angles = np.linspace(0.0, 2.0 * np.pi, 25)
_CIRCLE = np.stack([np.cos(_angles), np.sin(_angles)], axis=1).repeat(2, axis=0)[1:-1].reshape(-1, 2, 2)
_CROSS = np.array([[(-1, -1), (1, 1)], [(-1, 1), (1, -1)]], np.float64)
_SQUARE = np.array([[(-1, -1), (1, -1)], [(1, -1), (1, 1)], [(1, 1), (-1, 1)], [(-1, 1), (-1, -1)]], np.float64)
_Segments = list[tuple[Floats, tuple[float, ...], float]]  # ends (N, 2, 3) of lines, their colour and width


def draw_over_pictures() -> None:
    """Draw epipolar lines, marker and picked pixel over the pictures; Blender calls this for every Image Editor."""
    context = bpy.context
    image, (picked, _) = context.space_data.image, epipolar.picked_or_problem(context.scene)
    pictures = tiles.shown_pictures(image) if picked is not None else []
    if picked is None or not (pictures := [p for p in pictures if p.number in picked.run.numbers]):
        return
    index = np.array([picked.run.index(picture.number) for picture in pictures])
    corners, (width, height) = np.array([picture.corner for picture in pictures]), image.size
    # `view_to_region` rounds to pixels, but `region_to_view` does not, so that is inverted.
    region = context.region
    first = np.array(region.view2d.region_to_view(0, 0))
    last = np.array(region.view2d.region_to_view(region.width, region.height))

    def to_region(pixels: Floats) -> Floats:
        """Return positions (P, …, 2) in the region of the pixels (M, …, 2) of all modules, for the P shown pictures."""
        positions = pictures[0].image_positions(pixels[index], picked.run.views.shape) - pictures[0].corner
        image_positions = positions + corners.reshape(len(corners), *(1,) * (positions.ndim - 2), 2)
        view_positions = np.stack([image_positions[..., 1] / width, 1.0 - image_positions[..., 0] / height], axis=-1)
        return np.asarray((view_positions - first) / (last - first) * [region.width, region.height])

    unit = context.preferences.system.ui_scale
    radius, is_other, is_picked = unit * _RADIUS, index != picked.index, index == picked.index
    edges = to_region(picked.pixel + np.full((len(picked.marker_pixels), 1, 2), 0.5))[:, 0]
    half_pixel = np.maximum(np.abs(edges - to_region(picked.marker_pixels)), radius)[:, None, None]
    gpu.state.blend_set("ALPHA")
    for on_picked, ends, color, width_ in _shapes(picked, to_region, radius, half_pixel):
        ends = ends[is_picked if on_picked else is_other]
        if color != _FAINT:
            _draw_segments(ends, _OUTLINE, unit * (width_ + 2.0))
        _draw_segments(ends, color, unit * width_)
    gpu.state.blend_set("NONE")


def draw_in_scene() -> None:
    """Draw the ray with its marker, and lines on the planes; Blender calls this for every 3D view."""
    context = bpy.context
    picked, _ = epipolar.picked_or_problem(context.scene)
    if picked is None or not context.space_data.overlay.show_overlays:
        return
    unit = context.preferences.system.ui_scale
    gpu.state.blend_set("ALPHA")
    gpu.state.depth_test_set("LESS_EQUAL")
    for ends, color, width in _plane_segments(context, picked):
        _draw_segments(ends, color, unit * width)
    ray, in_roi = picked.ray[[0, 2]][None], picked.ray[1:][None]
    camera_matrix = np.array(context.region_data.view_matrix.inverted())
    radius = _MARKER_SHARE * picked.run.roi_radius[picked.index]
    ring = picked.marker + radius * _CIRCLE @ camera_matrix[:3, :2].T
    _draw_segments(in_roi, _LINE, unit * _MARKER_WIDTH)
    gpu.state.depth_test_set("NONE")  # also draws lines that a phantom hides
    _draw_segments(ray, _FAINT, unit * _WIDTH)
    _draw_segments(ring, _MARKER, unit * _MARKER_WIDTH)
    gpu.state.blend_set("NONE")


def redraw(*_: Any) -> None:
    """Have the editors drawn again after a change of the pixel or the marker, perhaps by a script."""
    windows.redraw("VIEW_3D", "IMAGE_EDITOR")


def plane_pixel(
    context: bpy.types.Context, run: epipolar.RunViews, origin: Floats, direction: Floats
) -> tuple[int, int, int] | None:
    """Return (module number, column, row) of the pixel at which a line of sight meets the nearest plane that faces it.

    `origin` and `direction` (3,) are in world coordinates.
    """
    visible_planes, index, picture = _visible_planes(context, run)
    if picture is None:
        return None
    rows, columns = picture.size
    hits = []
    for plane, i in zip(visible_planes, index, strict=True):
        inverse = np.linalg.inv(np.array(plane.matrix_world, np.float64))
        start, ray = inverse[:3, :3] @ origin + inverse[:3, 3], inverse[:3, :3] @ direction
        distance = -start[2] / ray[2] if ray[2] > 0 else -1.0  # a plane seen from behind is invisible
        right, up = (start + distance * ray)[:2] + np.array([columns, rows]) / 2
        if distance > 0 and 0 <= right < columns and 0 < up <= rows:
            hits.append((distance, run.numbers[i], *picture.pixel_at((rows - up, right), run.views.shape)))
    return min(hits)[1:] if hits else None


def _visible_planes(
    context: bpy.types.Context, run: epipolar.RunViews
) -> tuple[list[bpy.types.Object], NDArray[np.intp], tiles.Picture | None]:
    """Return the visible planes, the indices of their modules in the run, and a picture with the layout of all of them."""
    names = [ids.picture_name(images.projection_name(number, run.numbers)) for number in run.numbers]
    index_by_name = {name: i for i, name in enumerate(names)}
    run_planes = [o for o in planes.planes(context.scene) if o.parent and o.data and o.data.name in index_by_name]
    visible = [plane for plane in run_planes if plane.visible_get()]
    picture = next(iter(tiles.shown_pictures(visible[0].data)), None) if visible else None
    return visible, np.array([index_by_name[plane.data.name] for plane in visible], np.intp), picture


def _plane_segments(context: bpy.types.Context, picked: epipolar.PickedPixel) -> _Segments:
    """Return the lines to draw on the planes that face the viewer: ends (N, 2, 3), world mm, colours and widths."""
    run = picked.run
    visible_planes, index, picture = _visible_planes(context, run)
    if picture is None:
        return []
    matrices = np.array([plane.matrix_world for plane in visible_planes], np.float64)
    view = context.region_data
    camera_matrix = np.array(view.view_matrix.inverted())
    to_viewer = camera_matrix[:3, 3] - matrices[:, :3, 3] if view.is_perspective else camera_matrix[:3, 2]
    is_facing = np.sum(to_viewer * matrices[:, :3, 2], axis=1) < 0  # a plane's -z leads to the ROI
    rows, columns = picture.size
    radius = _MARKER_SHARE * columns
    pinholes = np.array([plane.parent.matrix_world.translation for plane in visible_planes], np.float64)[:, None, None]

    def local(pixels: Floats) -> Floats:
        """Return positions (P, …, 2) on the planes of the pixels (M, …, 2) of all modules."""
        rows_down, right = np.moveaxis(picture.image_positions(pixels[index], run.views.shape), -1, 0)
        return np.stack([right - columns / 2, rows / 2 - rows_down], axis=-1)

    def world(mask: NDArray[np.bool_], ends: Floats) -> Floats:
        """Return ends (N, 2, 3), world mm, of the lines (P, n, 2, 2) on the planes that are in the `mask` (P,)."""
        points = np.einsum("pij,pnej->pnei", matrices[:, :3, :2], ends) + matrices[:, None, None, :3, 3]
        return ((1 - _IN_FRONT) * pinholes + _IN_FRONT * points)[mask].reshape(-1, 2, 3)

    is_drawn = {True: is_facing & (index == picked.index), False: is_facing & (index != picked.index)}
    shapes = _shapes(picked, local, radius, radius)
    return [(world(is_drawn[on_picked], ends), color, width) for on_picked, ends, color, width in shapes]


def _shapes(
    picked: epipolar.PickedPixel, to_plane: Callable[[Floats], Floats], radius: float, half: float | Floats
) -> list[tuple[bool, Floats, tuple[float, ...], float]]:
    """Return the shapes to draw: whether on the picked module's picture or on others, line ends (P, n, 2, 2), colour, width.

    ``to_plane(pixels)`` returns positions (P, …, 2) of pixels (M, …, 2) of the modules; marks have the `radius` in these
    coordinates, and `half` (P, 1, 1, 2) is half the size of the picked pixel.
    """
    markers, epipoles = (to_plane(pixels)[:, None, None] for pixels in (picked.marker_pixels, picked.epipoles))
    faint, lines = (_cut_at(to_plane(ends), markers[:, 0, 0], radius) for ends in (picked.lines, picked.lines_in_roi))
    return [
        (False, faint, _FAINT, _WIDTH),
        (False, lines, _LINE, _WIDTH),
        (False, epipoles + radius * _CROSS, _LINE, _WIDTH),
        (False, markers + radius * _CIRCLE, _MARKER, _MARKER_WIDTH),
        (True, markers + half * _SQUARE, _PIXEL, _MARKER_WIDTH),
    ]


def _cut_at(ends: Floats, centers: Floats, radius: float) -> Floats:
    """Return the two parts (P, 2, 2, 2) of lines (P, 2, 2) outside circles around centres (P, 2) on them; NaN for no part.

    The gaps leave the pictures visible within the marks.
    """
    first, vector = ends[:, 0], ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(vector, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        s = np.sum((centers - first) * vector, axis=1) / length  # distance of the centre along the line
        s = np.where(np.isfinite(s), s, np.inf)  # without a circle, the first part is the whole line
        parts = np.array([[np.zeros_like(s), np.minimum(s - radius, length)], [np.maximum(s + radius, 0.0), length]])
        shares = np.where(parts[:, :1] < parts[:, 1:], parts / length, np.nan)  # (part, end, P)
    return np.asarray(first[:, None, None] + shares.transpose(2, 0, 1)[..., None] * vector[:, None, None])


def _draw_segments(ends: Floats, color: tuple[float, ...], width: float) -> None:
    """Draw lines between ends (…, 2, 2 or 3), except those that are NaN."""
    ends = ends.reshape(-1, *ends.shape[-2:])
    ends = ends[np.isfinite(ends).all(axis=(1, 2))]
    if not len(ends):
        return
    points = np.zeros((2 * len(ends), 3), np.float32)
    points[:, : ends.shape[-1]] = ends.reshape(-1, ends.shape[-1])
    windows.draw_lines(points, color, width)
