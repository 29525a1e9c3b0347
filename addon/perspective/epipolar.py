"""A picked pixel of the shown run: its ray, what every module sees of it, and of a marker that moves along it.

All of it is that of the run's own views: where modules have moved since, the run is not of the scene as it is now.
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

_LEAST = 0.01  # of the isocentre's depth: where a ROI begins that reaches behind the pinhole
_runs: dict[int, "RunViews"] = {}  # by the mosaic's session_uid: that of the shown run


@dataclass(frozen=True, eq=False)
class RunViews:
    """The views of the shown run and whose they are."""

    views: Views
    numbers: list[int]
    """The modules' (M,)."""
    roi_radius: Floats
    """(M,), mm."""
    name: str
    """The same for runs with the same views and modules."""

    def index(self, number: int) -> int:
        """Which of the views is a module's."""
        if number not in self.numbers:
            raise InputError(f"module {number}: the shown run has none of this number")
        return self.numbers.index(number)

    def depths(self, index: int) -> tuple[float, float, float, float]:
        """Depths in a module, mm: of its virtual detector, the isocentre, and the front and the back of its ROI."""
        axis = view_frames(self.views[index])[0, 2]
        source, center = self.views.sources[index], self.views.detector_centers[index]
        middle, radius = float(-axis @ source), float(self.roi_radius[index])
        return float(axis @ (center - source)), middle, max(middle - radius, _LEAST * middle), middle + radius


@dataclass(frozen=True, eq=False)
class Picked:
    """What there is to see of a picked pixel. Pixels are columns and rows as in arrays, 0 at the centre of pixel 0."""

    run: RunViews
    index: int
    """Which of the run's modules is picked."""
    pixel: Floats
    """(2,)."""
    k: float
    """Magnification of the marker in the picked module: the virtual detector's depth over the marker's."""
    k_range: tuple[float, float]
    """k at the front of the ROI, and at its back."""
    depth: float
    """The marker's, mm."""
    ray: Floats
    """World points (3, 3), mm: the pinhole, and where the ray enters the ROI's depths and leaves them."""
    marker: Floats
    """World point (3,), mm."""
    lines: Floats
    """Ends of the ray's image in each view (M, 2, 2), from the pinhole to infinity; NaN where none of it is in the image."""
    lines_in_roi: Floats
    """Ends of that part of it which is in the ROI's depths."""
    places: Floats
    """Where each view has the marker (M, 2); NaN where not in its image."""
    epipoles: Floats
    """Where each view has the picked module's pinhole (M, 2); NaN where not in its image."""

    @property
    def seen_by(self) -> int:
        """How many modules have the marker in their images."""
        return int(np.isfinite(self.places).all(axis=1).sum())


def run_views(scene: bpy.types.Scene) -> RunViews | None:
    """Those of the run that is shown; None where the scene has none, or its file kept no views."""
    mosaic = bpy.data.images.get(ids.MOSAIC)
    shown = images.tiles(mosaic)
    if mosaic is None or shown is None or not images.belong_to(scene):
        return None
    uid = mosaic.session_uid
    if uid not in _runs:
        _runs.clear()
        found = images.mosaic_views(mosaic)
        if found is None:
            return None
        views, roi_radius = found
        arrays = (views.sources, views.detector_centers, views.u_steps, views.v_steps)
        content = repr((shown["numbers"], views.shape)).encode() + b"".join(array.tobytes() for array in arrays)
        _runs[uid] = RunViews(views, shown["numbers"], roi_radius, hashlib.sha256(content).hexdigest())
    return _runs[uid]


def required_views(scene: bpy.types.Scene) -> RunViews:
    """The same as `run_views`; `InputError` where there are none."""
    run = run_views(scene)
    if run is not None:
        return run
    if not images.belong_to(scene):
        raise InputError("the projections are of another scene: render this one's first")
    raise InputError(
        "the shown run was kept by an earlier version, without its views: show it anew, or render it again"
    )


def picked(scene: bpy.types.Scene) -> Picked | None:
    """What there is to see; None where no pixel was picked in views such as those of the shown run.

    Raises InputError where the panel's module or pixel is none of the run's.
    """
    settings, run = scene.mphdrr_epipolar, run_views(scene)
    if run is None or settings.views != run.name:
        return None
    return _picked(run, settings.module, typed(settings.column), typed(settings.row), typed(settings.k))


def shown(scene: bpy.types.Scene) -> tuple[Picked | None, str]:
    """The same as `picked`, and what is wrong with the panel's module or pixel; "" where all is good."""
    try:
        return picked(scene), ""
    except InputError as error:
        return None, str(error)


def pick(scene: bpy.types.Scene, module: int, column: float, row: float, k: float = 0.0) -> Picked:
    """Pick a pixel of a module of the shown run, and put the marker at a magnification k.

    At 0 that is what it was if the same module was picked before, else the isocentre's.

    Raises InputError where there is no such module or pixel.
    """
    settings, run = scene.mphdrr_epipolar, required_views(scene)
    if not k:
        detector, middle, *_ = run.depths(run.index(module))
        k = settings.k if (settings.views, settings.module) == (run.name, module) else detector / middle
    _picked(run, module, column, row, k)  # refuses what cannot be
    settings.views, settings.module, settings.column, settings.row, settings.k = run.name, module, column, row, k
    found = picked(scene)
    assert found is not None
    return found


def clear(scene: bpy.types.Scene) -> None:
    """Forget the picked pixel."""
    scene.mphdrr_epipolar.views = ""


@functools.lru_cache(maxsize=1)
def _picked(run: RunViews, module: int, column: float, row: float, k: float) -> Picked:
    views, index = run.views, run.index(module)
    n_v, n_u = views.shape
    pixel = np.array([column, row])
    if not _within(pixel, views.shape):
        raise InputError(
            f"column {column:g}, row {row:g}: the images have columns 0 to {n_u - 1} and rows 0 to {n_v - 1}"
        )
    if not k > 0:
        raise InputError(f"k = {k:g}: expected more than 0")
    detector, _, near, far = run.depths(index)
    depth = detector / k
    ray = points_at_depths(views, index, pixel, np.array([0.0, near, far]))
    marker = points_at_depths(views, index, pixel, np.array(depth))
    places, epipoles = project_points(views, np.stack([marker, views.sources[index]])).swapaxes(0, 1)
    places[index] = pixel
    return Picked(
        run, index, pixel, k, (detector / near, detector / far), depth, ray, marker,
        epipolar_segments(views, index, pixel, 0.0), epipolar_segments(views, index, pixel, near, far),
        *(np.where(_within(each, views.shape)[:, None], each, np.nan) for each in (places, epipoles)),
    )  # fmt: skip


def _within(pixels: Floats, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Whether pixels (…, 2) are in an image, up to the edges of its outermost ones."""
    n_v, n_u = shape
    return np.asarray(((pixels >= -0.5) & (pixels <= [n_u - 0.5, n_v - 0.5])).all(axis=-1))
