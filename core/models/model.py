"""The base class of all models of what a pixel measures, and the model of radiographs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import ArrayOrTensor, Floats, Floats32, is_tensor, namespace
from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..pinhole_response.pinhole_operator import PinholeOperator
from ..progress import Progress
from ..rays.bundles import Beam
from ..rays.ray_geometry import view_rays
from ..validation import all_above_0, freeze, none_below_0, positive, real_array, shape_text
from ..volumes.volume import LINE_INTEGRALS, Volume, require_quantity
from .pixel_points import TOLERANCE, offsets, points_needed, require_points, shadow_edges

# Differences between views and their system that are a file's rounding: mm, and the sine of an angle.
_SAME_PLACE, _SAME_DIRECTION = 1e-3, 1e-6


class Model(ABC):
    """Model of what a pixel measures: ``response(sum over rays of weight * integral of volume * voxel weight)``.

    It is linear in the volume. A model describes only rays and weights; backends and adjoints are the projector's.
    """

    name: str
    """Name of the model in the record of a run."""

    mu: Volume | None = None
    """Attenuation coefficients, 1/mm, between each point and the rays' source; None without attenuation."""

    takes: tuple[str, ...] = LINE_INTEGRALS
    """Quantities of the volumes that can be projected; arrays and tensors have no quantity and are not checked."""

    background: float | Floats = 0.0
    """Expected counts of each pixel besides the volume's: a number, one for each view (M,), or images (M, n_v, n_u)."""

    efficiency: float | Floats = 1.0
    """Share of its expected counts that each pixel detects, of the same shapes as `background`; 0 for dead pixels."""

    weights_voxels: bool = False
    """Whether each view has its own voxel weights (`voxel_weights`)."""

    has_times: bool = False
    """Whether images are counts of an acquisition; a dataclass with `time` and `start`, that has `effective_time`."""

    has_photons: bool = False
    """Whether images of mu are line integrals, through which the photons of an X-ray source pass (`intensity`)."""

    takes_ct_numbers: bool = False
    """Whether volumes may be CT numbers, or mu at any energy, which `in_model_quantity` converts."""

    ends_at_detector: bool = True
    """Whether rays end at the detector's plane, so that parts of the volume beyond it are not imaged."""

    photon_lines: tuple[tuple[float, float], ...] = ()
    """Detected photon lines of the isotope, () without one: energies, keV, in order, and detected photons per decay."""

    detected_energies: tuple[float, float] | None = None
    """Energies, keV, between which photons are detected; None if the model does not know them."""

    has_geometry_gradient: bool = False
    """Whether `by_depth` follows the modules of the model's `system`; then it also has `optics` and `crystal_pitch`."""

    def check(self, views: Views) -> None:  # noqa: B027  (most models have nothing to check)
        """Raise `InputError` if the model does not fit these views."""

    def caution(self, views: Views, grid: Grid) -> str | None:
        """Return a warning for users who project `grid` into `views`, or None."""
        return None

    def coefficient_warnings(self) -> Iterator[str]:
        """Yield a warning for each attenuation coefficient that looks wrong, such as one in 1/cm."""
        return iter(())

    def of_views(self, which: NDArray[np.integer]) -> Model:
        """Return the model of the views `which` alone, indices from 0."""
        return self

    def parts(self) -> tuple[Model, ...]:
        """Return the models whose images add up to the images of this one; it alone if it is computed as a whole."""
        return (self,)

    def image_warnings(self, volume: Volume, views: Views) -> Iterator[str]:
        """Yield a warning for each reason for which the images of a volume are probably not the intended ones."""
        return iter(())

    def mu_warnings(self, mu: Floats32) -> Iterator[str]:
        """Yield a warning if attenuation coefficients `mu` (n_x, n_y, n_z), 1/mm, in place of the model's look wrong."""
        return iter(())

    def in_model_quantity(self, volume: Volume, energy: float | None) -> Volume:
        """Return a volume in the quantity that the model images; `energy` is that of its mu, keV."""
        return volume

    def linear(self) -> Model:
        """Return the model of the images' line integrals, for reconstruction; it alone if images are linear in volumes."""
        return self

    def expected_images(
        self, A: Any, volume: Volume, progress: Progress | None = None, mu: Floats32 | None = None
    ) -> Floats32:
        """Return the expected images (M, n_v, n_u) of a volume by `A`, a `Projector` with this model, without background.

        `mu` (n_x, n_y, n_z), 1/mm, attenuates in place of the model's; `progress` is called after every view.
        """
        return np.asarray(A(volume, progress, mu))

    def coarse(self) -> Model:
        """Return a quick model of about the same counts, for comparisons of likelihoods."""
        return self

    def without_blur(self) -> Model:
        """Return the model with one ray for each pixel, through an ideal aperture."""
        return self

    def check_volume(self, volume: Volume) -> None:
        """Raise `InputError` if the model cannot project a volume of this quantity."""
        require_quantity(volume.quantity, self.takes, self.name)

    def record(self) -> dict[str, Any]:
        """Return the model's settings for the record of a run, by name, as JSON can hold them."""
        return {}

    def unit(self, volume: Volume) -> str:
        """Return the unit of the images of `volume`: that of its line integrals, as weights have no unit."""
        return f"{volume.unit} mm"

    @abstractmethod
    def beams(self, views: Views, m: int, grid: Grid) -> Iterator[Beam]:
        """Yield the rays of view m through `grid`, with their weights."""

    def voxel_weights(self, views: Views, m: int, grid: Grid) -> Floats:
        """Return the factors of the voxels in view m, ``grid.shape``; used if `weights_voxels`."""
        return np.ones(grid.shape)

    def by_depth(self, views: Views, grid: Grid) -> PinholeOperator | None:
        """Return the operator that projects without rays, or None if the model is computed by rays."""
        return None

    def by_rays(self) -> Model:
        """Return the model for backends that know rays alone; raise `InputError` if it must not be computed by rays."""
        return self

    def pixel_parts(self, views: Views, grid: Grid) -> int:
        """Return the number of parts along a pixel's side whose means `response` needs."""
        return 1

    def response(self, views: Views, m: int, parts: int) -> tuple[Floats, Floats] | None:
        """Return the detector's response in view m, from the means of pixels' parts to pixels; None if it is ideal.

        It is a matrix (n_v, n_v parts) along v, and one (n_u, n_u parts) along u.
        """
        return None


@dataclass(frozen=True)
class Transmission(Model):
    """Line integral of the volume from source to target, value x mm: a digitally reconstructed radiograph.

    Attributes
    ----------
    pixel_points : int or None
        Number of points of each pixel's area whose line integrals are averaged. 1, the default: the pixel's centre, as in
        most programs for radiographs. None: as many as `tolerance` requires.
    tolerance : float
        Largest relative error of a single voxel's sum over the image, wherever the voxel lies, if the points are automatic.
    """

    pixel_points: int | None = 1
    tolerance: float = TOLERANCE

    name = "transmission"
    has_photons = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "pixel_points", require_points(self.pixel_points, "transmission: pixel_points"))
        object.__setattr__(self, "tolerance", positive(self.tolerance, "transmission: tolerance"))

    def record(self) -> dict[str, Any]:
        """Return the settings for the record of a run, by name."""
        return {"pixel_points": self.pixel_points, "tolerance": self.tolerance}

    def beams(self, views: Views, m: int, grid: Grid) -> Iterator[Beam]:
        """Yield the rays of view m to the pixels' centres, or to several points of each pixel with weights that sum to 1."""
        rays = view_rays(views, m, grid)
        if self.pixel_points == 1:
            yield Beam(rays)
            return
        n = self.pixel_points or points_needed(shadow_edges(views, m, grid), self.tolerance)
        weights = np.full((n, 1, 1), 1 / n)
        yield Beam(replace(rays, shifts=offsets(n)[:, ::-1]), lambda rows, columns, shifts: weights[shifts])


def intensity(line_integrals: ArrayOrTensor, photons: float) -> ArrayOrTensor:
    """Return the expected photons of a radiograph, ``photons * exp(-line_integrals)``.

    `Transmission` gives the line integrals of a volume of mu; `sample_counts` draws counts with noise.

    Parameters
    ----------
    line_integrals
        Line integrals of mu, without unit: an array, or a tensor, of whose graph the result is then a part.
    photons
        Expected photons of a pixel without attenuation, I0.
    """
    if not is_tensor(line_integrals):
        dtype = np.float32 if getattr(line_integrals, "dtype", None) == np.float32 else np.float64
        line_integrals = real_array(line_integrals, "line integrals", None, dtype)
    return positive(photons, "photons") * namespace(line_integrals).exp(-line_integrals)


def checked_background(value: ArrayLike, name: str, n: int, pixels: tuple[int, int] | None = None) -> float | Floats:
    """Return a background or efficiencies: a number, or read-only one for each of `n` views (M,), or images (M, n_v, n_u).

    Parameters
    ----------
    value, name
        Numbers to check, and their name in messages.
    n, pixels
        Number of views, and rows and columns (n_v, n_u) of their images, where these are fixed.

    Raises
    ------
    InputError
        A number is negative, or the shape is another.
    """
    array = none_below_0(value, name)
    real_array(array, name, None, np.float32)  # it is added to images of float32, which must hold it
    if array.ndim == 2 or array.shape not in ((), (n,), (n, *(pixels or array.shape[1:3]))):
        images = "" if pixels is None else f" of {shape_text(pixels)}"
        expected = f"one number, {n} numbers (one for each view), or {n} images{images}"
        raise InputError(f"{name}: expected {expected}, got {shape_text(array.shape)}")
    return freeze(array) if array.ndim else float(array)


def checked_times(value: ArrayLike, name: str, n: int, is_positive: bool = True) -> float | Floats:
    """Return times, s: a number, or read-only one for each of `n` views (M,). Raise `InputError` for another shape."""
    array = all_above_0(value, name, unit="s") if is_positive else real_array(value, name, None)
    if array.shape not in ((), (n,)):
        expected = f"one number, or {n} numbers (one for each view)"
        raise InputError(f"{name}: expected {expected}, got {shape_text(array.shape)}")
    return freeze(array) if array.ndim else float(array)


def with_image_axes(values: float | Floats) -> Floats:
    """Return a number, numbers of views (M,) or images (M, n_v, n_u) as an array with all three axes of images."""
    array = np.asarray(values, np.float64)
    return array.reshape(array.shape + (1,) * (3 - array.ndim))


def require_views_of(system: PinholeSystem, views: Views, name: str) -> None:
    """Raise `InputError` unless `views` are those of the system's modules, in their order; `name` is the model's."""
    if len(views) != len(system):
        raise InputError(f"{name}: {len(system)} modules but {len(views)} views; give the system whose views they are")
    views.require_pinholes(name)
    u, v, k = system.frames().transpose(1, 0, 2)
    is_moved = np.linalg.norm(views.sources - system.centers, axis=1) > _SAME_PLACE
    is_turned = np.zeros(len(views), dtype=bool)
    for steps, axis in ((views.u_steps, u), (views.v_steps, v)):
        sine = np.linalg.norm(np.cross(steps, axis), axis=1) / np.linalg.norm(steps, axis=1)
        is_turned |= sine > _SAME_DIRECTION
    is_behind = np.einsum("mi,mi->m", views.detector_centers - views.sources, k) <= 0
    for is_wrong, reason in (
        (is_moved, "its source is not the module's pinhole"),
        (is_turned, "its pixels do not lie along the module's u and v"),
        (is_behind, "its detector is not in front of the pinhole (see PinholeSystem.views)"),
    ):
        if is_wrong.any():
            raise InputError(f"{name}: view {int(np.argmax(is_wrong))}: {reason}")
