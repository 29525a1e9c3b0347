"""Picked pixel of the shown run: its ray, the ray's image in every module, and a marker that moves along the ray.

Everything is computed with the run's own views: modules that have moved since do not matter.
"""

import functools
import hashlib
from dataclasses import dataclass

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Views, epipolar_segments, points_at_depths, project_points, view_frames
from ..blender import ids
from ..blender.decimals import typed
from ..pictures import images

Floats = NDArray[np.float64]

_MIN_DEPTH = 0.01  # smallest depth of a ROI that reaches behind the pinhole, relative to the isocentre's depth
_runs: dict[int, "RunViews"] = {}  # views of the shown run, by the mosaic's `session_uid`


@dataclass(frozen=True, eq=False)
class RunViews:
    """Views of the shown run, with the modules that they belong to."""

    views: Views
    numbers: list[int]
    """Numbers (M,) of the modules."""
    roi_radius: Floats
    """Radii (M,) of the ROIs, mm."""
    name: str
    """Checksum that is equal for runs with the same views and modules."""

    def index(self, number: int) -> int:
        """Return the index of a module's view; raise `InputError` where the run has no such module."""
        if number not in self.numbers:
            raise InputError(f"module {number}: the shown run has none of this number")
        return self.numbers.index(number)

    def depths(self, index: int) -> tuple[float, float, float, float]:
        """Return depths in a module, mm: of its virtual detector, the isocentre, and the front and the back of its ROI."""
        axis = view_frames(self.views[index])[0, 2]
        source, center = self.views.sources[index], self.views.detector_centers[index]
        middle, radius = float(-axis @ source), float(self.roi_radius[index])
        return float(axis @ (center - source)), middle, max(middle - radius, _MIN_DEPTH * middle), middle + radius


@dataclass(frozen=True, eq=False)
class PickedPixel:
    """A picked pixel with its ray and their images; pixels are (column, row) as in arrays, 0 at the centre of pixel 0."""

    run: RunViews
    index: int
    """Index of the picked module in the run."""
    pixel: Floats
    """Picked pixel (2,)."""
    k: float
    """Magnification of the marker in the picked module: the virtual detector's depth over the marker's."""
    k_range: tuple[float, float]
    """Magnifications k at the front of the ROI and at its back."""
    depth: float
    """Depth of the marker, mm."""
    ray: Floats
    """Points (3, 3) of the ray, world mm: the pinhole, and the ends of the part within the ROI's depths."""
    marker: Floats
    """Position (3,) of the marker, world mm."""
    lines: Floats
    """Ends (M, 2, 2) of the ray's image in each view, from the pinhole to infinity; NaN where it is outside the image."""
    lines_in_roi: Floats
    """Ends (M, 2, 2) of the image of the ray's part within the ROI's depths; NaN where it is outside the image."""
    marker_pixels: Floats
    """Pixel (M, 2) of the marker in each view; NaN where it is outside the image."""
    epipoles: Floats
    """Pixel (M, 2) of the picked module's pinhole in each view; NaN where it is outside the image."""

    @property
    def seen_by(self) -> int:
        """Number of modules that have the marker in their images."""
        return int(np.isfinite(self.marker_pixels).all(axis=1).sum())


def run_views(scene: bpy.types.Scene) -> RunViews | None:
    """Return the views of the shown run; None where the scene has none, or its file kept no views."""
    mosaic = bpy.data.images.get(ids.MOSAIC)
    mosaic_tiles = images.tiles(mosaic)
    if mosaic is None or mosaic_tiles is None or not images.belong_to(scene):
        return None
    mosaic_uid = mosaic.session_uid
    if mosaic_uid not in _runs:
        _runs.clear()
        if (stored_views := images.mosaic_views(mosaic)) is None:
            return None
        views, roi_radius = stored_views
        arrays = (views.sources, views.detector_centers, views.u_steps, views.v_steps)
        content = repr((mosaic_tiles["numbers"], views.shape)).encode() + b"".join(array.tobytes() for array in arrays)
        _runs[mosaic_uid] = RunViews(views, mosaic_tiles["numbers"], roi_radius, hashlib.sha256(content).hexdigest())
    return _runs[mosaic_uid]


def required_views(scene: bpy.types.Scene) -> RunViews:
    """Return the views of the shown run; raise `InputError` where there are none."""
    if (run := run_views(scene)) is not None:
        return run
    if not images.belong_to(scene):
        raise InputError("the projections are of another scene: render this one's first")
    advice = "show it anew, or render it again"
    raise InputError(f"the shown run was kept by an earlier version, without its views: {advice}")


def picked_pixel(scene: bpy.types.Scene) -> PickedPixel | None:
    """Return the picked pixel with its ray; None where none was picked in views equal to those of the shown run.

    Raises InputError where the panel's module or pixel is not in the run.
    """
    settings, run = scene.mphdrr_epipolar, run_views(scene)
    if run is None or settings.views != run.name:
        return None
    return _trace_pixel(run, settings.module, typed(settings.column), typed(settings.row), typed(settings.k))


def picked_or_problem(scene: bpy.types.Scene) -> tuple[PickedPixel | None, str]:
    """Return the picked pixel, and the problem of the panel's module or pixel in words; "" for none."""
    try:
        return picked_pixel(scene), ""
    except InputError as error:
        return None, str(error)


def pick_pixel(scene: bpy.types.Scene, module: int, column: float, row: float, k: float = 0.0) -> PickedPixel:
    """Pick a pixel of a module of the shown run, and put the marker at a magnification k.

    The default k is the previous one if the same module was picked before, else the isocentre's. Raises InputError where
    there is no such module or pixel.
    """
    settings, run = scene.mphdrr_epipolar, required_views(scene)
    if not k:
        detector, center_depth, *_ = run.depths(run.index(module))
        k = settings.k if (settings.views, settings.module) == (run.name, module) else detector / center_depth
    _trace_pixel(run, module, column, row, k)  # raises its errors before anything is changed
    settings.views, settings.module, settings.column, settings.row, settings.k = run.name, module, column, row, k
    result = picked_pixel(scene)
    assert result is not None
    return result


def clear(scene: bpy.types.Scene) -> None:
    """Forget the picked pixel."""
    scene.mphdrr_epipolar.views = ""


@functools.lru_cache(maxsize=1)
def _trace_pixel(run: RunViews, module: int, column: float, row: float, k: float) -> PickedPixel:
    """Return a pixel with its ray, and the images of the ray and the marker in all views."""
    views, index = run.views, run.index(module)
    n_v, n_u = views.shape
    pixel = np.array([column, row])
    if not _is_in_image(pixel, views.shape):
        limits = f"columns 0 to {n_u - 1} and rows 0 to {n_v - 1}"
        raise InputError(f"column {column:g}, row {row:g}: the images have {limits}")
    if not k > 0:
        raise InputError(f"k = {k:g}: expected more than 0")
    detector, _, near, far = run.depths(index)
    depth = detector / k
    ray = points_at_depths(views, index, pixel, np.array([0.0, near, far]))
    marker = points_at_depths(views, index, pixel, np.array(depth))
    marker_pixels, epipoles = project_points(views, np.stack([marker, views.sources[index]])).swapaxes(0, 1)
    marker_pixels[index] = pixel
    return PickedPixel(
        run, index, pixel, k, (detector / near, detector / far), depth, ray, marker,
        epipolar_segments(views, index, pixel, 0.0), epipolar_segments(views, index, pixel, near, far),
        *(np.where(_is_in_image(pixels, views.shape)[:, None], pixels, np.nan) for pixels in (marker_pixels, epipoles)),
    )  # fmt: skip


def _is_in_image(pixels: Floats, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return which pixels (…, 2) are in an image, up to the edges of its outermost pixels."""
    n_v, n_u = shape
    return np.asarray(((pixels >= -0.5) & (pixels <= [n_u - 0.5, n_v - 0.5])).all(axis=-1))
