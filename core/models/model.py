"""What a pixel measures: which rays it takes, with which weights."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import ArrayOrTensor, Floats, is_tensor, namespace
from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..pinhole_response.pinhole_operator import PinholeOperator
from ..rays.bundles import Beam
from ..rays.ray_geometry import view_rays
from ..validation import all_above_0, freeze, none_below_0, positive, real_array, shape_text
from ..volumes.volume import LINE_INTEGRALS, Volume, require_quantity
from .pixel_points import TOLERANCE, offsets, points_needed, require_points, shadow_edges

# Views may differ from their system by a file's rounding (mm; sine of an angle).
_SAME_PLACE = 1e-3
_SAME_DIRECTION = 1e-6


class Model(ABC):
    """What a pixel measures: ``response(sum over rays of weight * integral of volume * voxel weight)``.

    It is linear in the volume. A model describes only rays and weights; backends and adjoints are the operator's.
    """

    name: str
    """What a run's record calls it."""

    mu: Volume | None = None
    """Attenuation coefficients between each point and the rays' source, 1/mm."""

    takes: tuple[str, ...] = LINE_INTEGRALS
    """Quantities of volumes that can be projected; arrays and tensors have none and are not checked."""

    background: float | Floats = 0.0
    """What each pixel measures besides the volume: a number, one for each view (M,), or images (M, n_v, n_u)."""

    efficiency: float | Floats = 1.0
    """The share of what each pixel would count that it does count, formed like `background`; 0 of dead ones."""

    weights_voxels: bool = False
    """Whether each view has its own voxel weights (`voxel_weights`)."""

    has_times: bool = False
    """Whether images are counts of an acquisition: a dataclass with the fields `time` and `start`, and `effective_time`."""

    has_geometry_gradient: bool = False
    """Whether `by_depth` follows the modules of `system`; such a model also has `optics` and `crystal_pitch`."""

    def check(self, views: Views) -> None:  # noqa: B027  (most models have nothing to check)
        """Raise `InputError` where the model is not for these views."""

    def caution(self, views: Views, grid: Grid) -> str | None:
        """A warning for users who project `grid` into `views`, if there is one."""
        return None

    def coefficient_warnings(self) -> Iterator[str]:
        """Yield a warning for each attenuation coefficient that looks wrong, such as one in 1/cm."""
        return iter(())

    def of_views(self, which: NDArray[np.integer]) -> Model:
        """The model of the views `which` (indices) alone."""
        return self

    def parts(self) -> tuple[Model, ...]:
        """Models whose images add up to this one's: itself alone, if it is computed as a whole."""
        return (self,)

    def check_volume(self, volume: Volume) -> None:
        """Raise `InputError` where the model is not for such a volume."""
        require_quantity(volume.quantity, self.takes, self.name)

    def record(self) -> dict[str, Any]:
        """The model's own settings, for a run's record: anything JSON can hold."""
        return {}

    def unit(self, volume: Volume) -> str:
        """Unit of the images of `volume`: of its line integrals, where the weights have none."""
        return f"{volume.unit} mm"

    @abstractmethod
    def beams(self, views: Views, m: int, grid: Grid) -> Iterator[Beam]:
        """The rays of view m through `grid`, from the detector's side."""

    def voxel_weights(self, views: Views, m: int, grid: Grid) -> Floats:
        """Factors of the voxels in view m, ``grid.shape``; used if `weights_voxels`."""
        return np.ones(grid.shape)

    def by_depth(self, views: Views, grid: Grid) -> PinholeOperator | None:
        """What projects in place of rays, if the model is of that kind."""
        return None

    def by_rays(self) -> Model:
        """The model for what can only be done with rays; `InputError` where it is not to take any."""
        return self

    def response(self, views: Views, m: int) -> tuple[Floats, Floats] | None:
        """The detector's response in view m: matrices (n_v, n_v) along v and (n_u, n_u) along u, None if ideal."""
        return None


@dataclass(frozen=True)
class Transmission(Model):
    """The line integral of the volume from source to target, value x mm: a digitally reconstructed radiograph.

    Attributes
    ----------
    pixel_points : int or None
        Points of each pixel's area whose line integrals are averaged. 1, the default: the pixel's centre, as in most
        programs for radiographs. None: as many as `tolerance` requires.
    tolerance : float
        With automatic points, the largest relative error of a single voxel's sum over the image, wherever it lies.
    """

    pixel_points: int | None = 1
    tolerance: float = TOLERANCE

    name = "transmission"

    def __post_init__(self) -> None:
        object.__setattr__(self, "pixel_points", require_points(self.pixel_points, "transmission: pixel_points"))
        object.__setattr__(self, "tolerance", positive(self.tolerance, "transmission: tolerance"))

    def record(self) -> dict[str, Any]:
        """The settings, for a run's record."""
        return {"pixel_points": self.pixel_points, "tolerance": self.tolerance}

    def beams(self, views: Views, m: int, grid: Grid) -> Iterator[Beam]:
        """The rays of `views`, or to more points of their pixels, weights summing to 1."""
        rays = view_rays(views, m, grid)
        if self.pixel_points == 1:
            yield Beam(rays)
            return
        n = self.pixel_points or points_needed(shadow_edges(views, m, grid), self.tolerance)
        weights = np.full((n, 1, 1), 1 / n)
        yield Beam(replace(rays, shifts=offsets(n)[:, ::-1]), lambda rows, columns, shifts: weights[shifts])


def intensity(line_integrals: ArrayOrTensor, photons: float) -> ArrayOrTensor:
    """Photons that pass where attenuation integrates to `line_integrals`: ``photons * exp(-line_integrals)``.

    The images of a volume of mu by `Transmission` become a radiograph's expected photons; `core.noise.sample_counts` draws
    from them.

    Parameters
    ----------
    line_integrals
        Line integrals of mu, without unit: an array, or a tensor (the result is then part of its graph).
    photons
        Per pixel, where nothing attenuates (I0).
    """
    if not is_tensor(line_integrals):
        kind = np.float32 if getattr(line_integrals, "dtype", None) == np.float32 else np.float64
        line_integrals = real_array(line_integrals, "line integrals", None, kind)
    return positive(photons, "photons") * namespace(line_integrals).exp(-line_integrals)


def checked_background(value: ArrayLike, name: str, n: int, pixels: tuple[int, int] | None = None) -> float | Floats:
    """Counts besides a volume's, or efficiencies: a number, or read-only those of `n` views (M,), or images (M, n_v, n_u).

    Parameters
    ----------
    value, name
        What to check, and how messages call it.
    n, pixels
        Number of views and their shape (n_v, n_u), if that is known.
    """
    array = none_below_0(value, name)
    real_array(array, name, None, np.float32)  # as which it is added
    if array.ndim == 2 or array.shape not in ((), (n,), (n, *(pixels or array.shape[1:3]))):
        images = "" if pixels is None else f" of {shape_text(pixels)}"
        expected = f"one number, {n} numbers (one for each view), or {n} images{images}"
        raise InputError(f"{name}: expected {expected}, got {shape_text(array.shape)}")
    return freeze(array) if array.ndim else float(array)


def checked_times(value: ArrayLike, name: str, n: int, is_positive: bool = True) -> float | Floats:
    """Times, s: a number, or read-only those of `n` views (M,)."""
    array = all_above_0(value, name, unit="s") if is_positive else real_array(value, name, None)
    if array.shape not in ((), (n,)):
        expected = f"one number, or {n} numbers (one for each view)"
        raise InputError(f"{name}: expected {expected}, got {shape_text(array.shape)}")
    return freeze(array) if array.ndim else float(array)


def each_pixel(values: float | Floats) -> Floats:
    """One number, those of views (M,), or images (M, n_v, n_u), with all three axes."""
    array = np.asarray(values, np.float64)
    return array.reshape(array.shape + (1,) * (3 - array.ndim))


def require_views_of(system: PinholeSystem, views: Views, name: str) -> None:
    """Raise `InputError` unless `views` are those of the system's modules, in their order; `name` is what asks."""
    if len(views) != len(system):
        raise InputError(f"{name}: {len(system)} modules but {len(views)} views; give the system whose views they are")
    views.require_pinholes(name)
    u, v, k = system.frames().transpose(1, 0, 2)
    moved = np.linalg.norm(views.sources - system.centers, axis=1) > _SAME_PLACE
    turned = np.zeros(len(views), dtype=bool)
    for steps, axis in ((views.u_steps, u), (views.v_steps, v)):
        sine = np.linalg.norm(np.cross(steps, axis), axis=1) / np.linalg.norm(steps, axis=1)
        turned |= sine > _SAME_DIRECTION
    behind = np.einsum("mi,mi->m", views.detector_centers - views.sources, k) <= 0
    for bad, why in (
        (moved, "its source is not the module's pinhole"),
        (turned, "its pixels do not lie along the module's u and v"),
        (behind, "its detector is not in front of the pinhole (see PinholeSystem.views)"),
    ):
        if bad.any():
            raise InputError(f"{name}: view {int(np.argmax(bad))}: {why}")
