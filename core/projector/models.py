"""What a pixel measures: which rays it takes, with which weights."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..checks import positive, real_array
from ..errors import InputError
from ..grid import Grid
from ..views import Views
from ..volume import LINE_INTEGRALS, Volume, require_quantity
from .arrays import ArrayOrTensor, is_tensor, namespace
from .rays import Fan

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Beam:
    """One ray for every pixel of a view.

    Attributes
    ----------
    rays : Fan
        From the rays' source to the pixels: n_v lines of n_u rays.
    weights : array (n_v, n_u) or None
        What the ray's integral counts in its pixel; None: 1 everywhere.
    """

    rays: Fan
    weights: Array | None = None

    def transposed(self) -> Beam:
        """The same rays by columns: n_u lines of n_v rays."""
        return Beam(self.rays.transposed(), None if self.weights is None else self.weights.T)


class Model(ABC):
    """What a pixel measures: ``response(sum over beams of weight * integral along the ray of volume * voxel weight)``.

    Linear in the volume. The operator does the rest, so a model knows neither backends nor adjoints.
    """

    name: str
    """What a run's record calls it."""

    mu: Volume | None = None
    """What attenuates the rays between the point that is measured and their source, 1/mm."""

    takes: tuple[str, ...] = LINE_INTEGRALS
    """Quantities of volumes that it has a meaning for; arrays and tensors say none, so that theirs are the caller's."""

    weights_voxels: bool = False
    """Whether each view weights the voxels in its own way (`voxel_weights`)."""

    def check(self, views: Views) -> None:  # noqa: B027  (most have nothing to check)
        """Raise `InputError` where the model is not for these views."""

    def check_volume(self, volume: Volume) -> None:
        """Raise `InputError` where the model is not for such a volume."""
        require_quantity(volume.quantity, self.takes, self.name)

    def record(self) -> dict[str, Any]:
        """The model's own settings, for a run's record: anything JSON can hold."""
        return {}

    @abstractmethod
    def unit(self, volume: Volume) -> str:
        """Unit of the images of `volume`."""

    @abstractmethod
    def beams(self, views: Views, m: int, grid: Grid) -> Iterator[Beam]:
        """The rays of view m through `grid`, their sources on the detector's side of what is measured."""

    def voxel_weights(self, views: Views, m: int, grid: Grid) -> Array:
        """What the voxels are multiplied by before view m is taken, of ``grid.shape``; asked for if `weights_voxels`."""
        return np.ones(grid.shape)

    def response(self, views: Views, m: int) -> tuple[Array, Array] | None:
        """The detector's response in view m: matrices (n_v, n_v) along v and (n_u, n_u) along u, None if ideal."""
        return None


@dataclass(frozen=True)
class Transmission(Model):
    """The line integral of the volume from source to target, value x mm: a digitally reconstructed radiograph."""

    name = "transmission"

    def unit(self, volume: Volume) -> str:
        """Unit of the images of `volume`."""
        return f"{volume.unit} mm"

    def beams(self, views: Views, m: int, grid: Grid) -> Iterator[Beam]:
        """The rays of `views`, each counting 1."""
        yield Beam(view_rays(views, m))


def intensity(line_integrals: ArrayOrTensor, photons: float) -> ArrayOrTensor:
    """Photons that pass where attenuation integrates to `line_integrals`: ``photons * exp(-line_integrals)``.

    The images of a volume of mu by `Transmission` become a radiograph's expected photons; `core.noise.sample_counts` draws
    from them.

    Parameters
    ----------
    line_integrals
        Of mu, without unit: an array, or a tensor (the result is then part of its graph).
    photons
        Per pixel, where nothing attenuates (I0).

    Raises
    ------
    InputError
        `photons` is not a number above 0, or the line integrals are no real, finite numbers.
    """
    if not is_tensor(line_integrals):
        kind = np.float32 if getattr(line_integrals, "dtype", None) == np.float32 else np.float64
        line_integrals = real_array(line_integrals, "line integrals", None, kind)
    return positive(photons, "photons") * namespace(line_integrals).exp(-line_integrals)


def view_rays(views: Views, m: int) -> Fan:
    """The rays of view m, from its source to the pixels' centres: a line for every row."""
    n_v, n_u = views.shape
    u_step, v_step = views.u_steps[m], views.v_steps[m]
    corner = views.detector_centers[m] - (n_u - 1) / 2 * u_step - (n_v - 1) / 2 * v_step
    return Fan(views.sources[m], corner, v_step, u_step, views.shape)


def require_model(value: object) -> Model:
    """`value` if it is a model."""
    if not isinstance(value, Model):
        raise InputError(
            f"projector: expected model to be Transmission, Emission or another model, got {type(value).__name__}"
        )
    return value
