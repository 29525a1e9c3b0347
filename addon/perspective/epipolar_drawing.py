"""The picked pixel, its ray and epipolar lines, drawn over the pictures and in the 3D views; never rendered."""

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

_LINE, _FAINT = (0.2, 0.85, 1.0, 1.0), (0.2, 0.85, 1.0, 0.35)  # colours: in the ROI, and outside
_MARKER, _PIXEL = (0.45, 1.0, 0.3, 1.0), (1.0, 1.0, 1.0, 1.0)
_OUTLINE = (0.0, 0.0, 0.0, 0.6)
_WIDTH, _MARKER_WIDTH = 1.3, 1.5  # of lines, in pixels of the screen at a resolution scale of 1
_RADIUS = 8.0  # of a marker over a picture, in such pixels: a small source is seen within
_SHARE = 0.05  # of a plane's width, or of the ROI's radius: the radius of a marker in the scene
_BEFORE = 1.005  # of the way from the pinhole to a plane: where lines on it are drawn, so that it does not hide them

_angles = np.linspace(0.0, 2.0 * np.pi, 25)
_CIRCLE = np.stack([np.cos(_angles), np.sin(_angles)], axis=1).repeat(2, axis=0)[1:-1].reshape(-1, 2, 2)
_CROSS = np.array([[(-1, -1), (1, 1)], [(-1, 1), (1, -1)]], np.float64)
_SQUARE = np.array([[(-1, -1), (1, -1)], [(1, -1), (1, 1)], [(1, 1), (-1, 1)], [(-1, 1), (-1, -1)]], np.float64)
_Drawn = list[tuple[Floats, tuple[float, ...], float]]  # ends of lines, their colour and width


def draw_over_pictures() -> None:
    """Draw what the pictures' modules see; Blender calls this for every Image Editor."""
    context = bpy.context
    image, (found, _) = context.space_data.image, epipolar.shown(context.scene)
    shown = (
        [each for each in tiles.shown_pictures(image) if each.number in found.run.numbers] if found is not None else []
    )
    if found is None or not shown:
        return
    index = np.array([found.run.index(picture.number) for picture in shown])
    corners, (width, height) = np.array([picture.corner for picture in shown]), image.size
    # `view_to_region` rounds to pixels; this way around does not.
    region = context.region
    first = np.array(region.view2d.region_to_view(0, 0))
    last = np.array(region.view2d.region_to_view(region.width, region.height))

    def placed(pixels: Floats) -> Floats:
        """Places (P, …, 2) in the region of pixels (M, …, 2) of the modules whose pictures these are."""
        within = shown[0].image_positions(pixels[index], found.run.views.shape) - shown[0].corner
        at = within + corners.reshape(len(corners), *(1,) * (within.ndim - 2), 2)
        seen = np.stack([at[..., 1] / width, 1.0 - at[..., 0] / height], axis=-1)
        return np.asarray((seen - first) / (last - first) * [region.width, region.height])

    unit = context.preferences.system.ui_scale
    radius, others, own = unit * _RADIUS, index != found.index, index == found.index
    edges = placed(found.pixel + np.full((len(found.places), 1, 2), 0.5))[:, 0]
    half = np.maximum(np.abs(edges - placed(found.places)), radius)[:, None, None]
    gpu.state.blend_set("ALPHA")
    for of_own, ends, color, thick in _shapes(found, placed, radius, half):
        ends = ends[own if of_own else others]
        if color != _FAINT:
            _lines(ends, _OUTLINE, unit * (thick + 2.0))
        _lines(ends, color, unit * thick)
    gpu.state.blend_set("NONE")


def draw_in_scene() -> None:
    """Draw the ray with its marker, and on the planes what their modules see; Blender calls this for every 3D view."""
    context = bpy.context
    found, _ = epipolar.shown(context.scene)
    if found is None or not context.space_data.overlay.show_overlays:
        return
    unit = context.preferences.system.ui_scale
    gpu.state.blend_set("ALPHA")
    gpu.state.depth_test_set("LESS_EQUAL")
    for ends, color, width in _on_planes(context, found):
        _lines(ends, color, unit * width)
    whole, in_roi = found.ray[[0, 2]][None], found.ray[1:][None]
    back = np.array(context.region_data.view_matrix.inverted())
    radius = _SHARE * found.run.roi_radius[found.index]
    ring = found.marker + radius * _CIRCLE @ back[:3, :2].T
    _lines(in_roi, _LINE, unit * _MARKER_WIDTH)
    gpu.state.depth_test_set("NONE")  # also where a phantom hides it
    _lines(whole, _FAINT, unit * _WIDTH)
    _lines(ring, _MARKER, unit * _MARKER_WIDTH)
    gpu.state.blend_set("NONE")


def redraw(*_: Any) -> None:
    """Have the editors drawn again: the pixel or the marker was changed, perhaps by a script."""
    windows.redraw("VIEW_3D", "IMAGE_EDITOR")


def plane_pixel(
    context: bpy.types.Context, run: epipolar.RunViews, origin: Floats, direction: Floats
) -> tuple[int, int, int] | None:
    """The module's number, and column and row, of the pixel that a line of sight meets on the nearest plane it can see.

    `origin` and `direction` (3,) are world ones.
    """
    shown, index, picture = _planes(context, run)
    if picture is None:
        return None
    rows, columns = picture.size
    met = []
    for plane, i in zip(shown, index, strict=True):
        inverse = np.linalg.inv(np.array(plane.matrix_world, np.float64))
        start, way = inverse[:3, :3] @ origin + inverse[:3, 3], inverse[:3, :3] @ direction
        distance = -start[2] / way[2] if way[2] > 0 else -1.0  # seen from behind, it is not there
        right, up = (start + distance * way)[:2] + np.array([columns, rows]) / 2
        if distance > 0 and 0 <= right < columns and 0 < up <= rows:
            met.append((distance, run.numbers[i], *picture.pixel_at((rows - up, right), run.views.shape)))
    return min(met)[1:] if met else None


def _planes(
    context: bpy.types.Context, run: epipolar.RunViews
) -> tuple[list[bpy.types.Object], NDArray[np.intp], tiles.Picture | None]:
    """The planes that are shown, which of the run's modules each is of, and a picture as theirs all are."""
    names = [ids.picture_name(images.projection_name(number, run.numbers)) for number in run.numbers]
    places = {name: i for i, name in enumerate(names)}
    kept = [o for o in planes.planes(context.scene) if o.parent and o.data and o.data.name in places]
    shown = [plane for plane in kept if plane.visible_get()]
    picture = next(iter(tiles.shown_pictures(shown[0].data)), None) if shown else None
    return shown, np.array([places[plane.data.name] for plane in shown], np.intp), picture


def _on_planes(context: bpy.types.Context, found: epipolar.Picked) -> _Drawn:
    """What is drawn on the planes that are seen from where the view is: ends (N, 2, 3) of lines, world mm."""
    run = found.run
    shown, index, picture = _planes(context, run)
    if picture is None:
        return []
    matrices = np.array([plane.matrix_world for plane in shown], np.float64)
    view = context.region_data
    back = np.array(view.view_matrix.inverted())
    towards = back[:3, 3] - matrices[:, :3, 3] if view.is_perspective else back[:3, 2]
    seen = np.sum(towards * matrices[:, :3, 2], axis=1) < 0  # a plane's -z leads to the ROI
    rows, columns = picture.size
    radius = _SHARE * columns
    pinholes = np.array([plane.parent.matrix_world.translation for plane in shown], np.float64)[:, None, None]

    def local(pixels: Floats) -> Floats:
        """Places (P, …, 2) on the planes of pixels (M, …, 2) of their modules."""
        down, right = np.moveaxis(picture.image_positions(pixels[index], run.views.shape), -1, 0)
        return np.stack([right - columns / 2, rows / 2 - down], axis=-1)

    def world(chosen: NDArray[np.bool_], ends: Floats) -> Floats:
        """Ends (N, 2, 3) of lines (P, n, 2, 2) on planes, of the `chosen` ones."""
        points = np.einsum("pij,pnej->pnei", matrices[:, :3, :2], ends) + matrices[:, None, None, :3, 3]
        return ((1 - _BEFORE) * pinholes + _BEFORE * points)[chosen].reshape(-1, 2, 3)

    others, own = seen & (index != found.index), seen & (index == found.index)
    shapes = _shapes(found, local, radius, radius)
    return [(world(own if of_own else others, ends), color, width) for of_own, ends, color, width in shapes]


def _shapes(
    found: epipolar.Picked, placed: Callable[[Floats], Floats], radius: float, half: float | Floats
) -> list[tuple[bool, Floats, tuple[float, ...], float]]:
    """What is drawn: whether of the picked module or of all others, ends (P, n, 2, 2) of lines, their colour and width.

    ``placed(pixels)`` gives the places (P, …, 2) of pixels (M, …, 2) of the modules; marks have a `radius` there, and `half`
    (P, 1, 1, 2) is that of the picked pixel.
    """
    places, epipoles = (placed(pixels)[:, None, None] for pixels in (found.places, found.epipoles))
    faint, lines = (_open_at(placed(ends), places[:, 0, 0], radius) for ends in (found.lines, found.lines_in_roi))
    return [
        (False, faint, _FAINT, _WIDTH),
        (False, lines, _LINE, _WIDTH),
        (False, epipoles + radius * _CROSS, _LINE, _WIDTH),
        (False, places + radius * _CIRCLE, _MARKER, _MARKER_WIDTH),
        (True, places + half * _SQUARE, _PIXEL, _MARKER_WIDTH),
    ]


def _open_at(ends: Floats, places: Floats, radius: float) -> Floats:
    """The two parts (P, 2, 2, 2) of lines (P, 2, 2) outside circles around places (P, 2) on them, so that one sees what is
    there; NaN where there is none.
    """
    first, way = ends[:, 0], ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(way, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        at = np.sum((places - first) * way, axis=1) / length
        at = np.where(np.isfinite(at), at, np.inf)  # no circle: the first part is the whole line
        parts = np.array([[np.zeros_like(at), np.minimum(at - radius, length)], [np.maximum(at + radius, 0.0), length]])
        shares = np.where(parts[:, :1] < parts[:, 1:], parts / length, np.nan)  # (part, end, P)
    return np.asarray(first[:, None, None] + shares.transpose(2, 0, 1)[..., None] * way[:, None, None])


def _lines(ends: Floats, color: tuple[float, ...], width: float) -> None:
    """Draw lines between ends (…, 2, 2 or 3), but for those that are NaN."""
    ends = ends.reshape(-1, *ends.shape[-2:])
    ends = ends[np.isfinite(ends).all(axis=(1, 2))]
    if not len(ends):
        return
    points = np.zeros((2 * len(ends), 3), np.float32)
    points[:, : ends.shape[-1]] = ends.reshape(-1, ends.shape[-1])
    windows.draw_lines(points, color, width)
