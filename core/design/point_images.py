"""Images of point sources through round holes of finite size, with the crystal's blur and its depth of interaction.

A point at depth h in front of a hole of diameter d_e casts the hole's shadow on a crystal at the distance l behind it. As
both planes are parallel, the shadow is a disc of diameter ``d_e (1 + l / h)`` around the point's central projection. Its
total is given by `sensitivity`; within the disc the photons are taken to be uniform, because their angles differ by d / h
only. A photon that is stopped at depth z in the crystal is recorded where a crystal at the distance l + z has it: the image
is the sum of discs at several depths.

A disc that is blurred by a Gaussian is a sum over its chords, whose ends the Gaussian blurs along v and whose places along
u: each term is a column times a row, and its mean over each pixel is in closed form. The chords stand at the nodes of
Gauss's quadrature with the weight ``sqrt(1 - x^2)``, closer together than the Gaussian is wide. A source of some extent and
the soft edge of a hole that photons penetrate blur as Gaussians of the same variance.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..arrays import ArrayLike, Floats
from ..errors import InputError
from ..geometry.views import Views
from ..models.emission import Emission
from ..models.model import with_image_axes
from ..physics.energy_window import FWHM_PER_SIGMA
from ..physics.performance import sensitivity
from ..validation import at_least_0, instance, one_for_all, real_array
from .solvers import scipy_module

_MAX_DIAMETER = 1000.0  # of a source, mm
_NODE_DISTANCE = 1.2  # largest distance of neighbouring chords, in standard deviations of the blur
_MIN_NODES, _MAX_NODES = 8, 256
_DEPTHS, _MAX_OPTICAL_DEPTH = 8, 10.0  # of the quadrature over the depth of interaction


class PixelLattice(NamedTuple):
    """Pixels of the modules on their crystals.

    Coordinates are mm along u and v from the crystal's centre, point-inverted through the pinhole.
    """

    first: Floats
    """Centre (M, 2) of pixel (0, 0)."""
    step: Floats
    """Steps (M, 2) from pixel to pixel along a row and along a column; negative on the real detector."""
    shape: tuple[int, int]
    """Numbers (n_v, n_u) of rows and columns."""

    @classmethod
    def from_views(cls, model: Emission, views: Views) -> "PixelLattice":
        """Return the lattice of the views of a model's modules."""
        frames = model.system.frames()
        center = np.einsum("mij,mj->mi", frames, views.detector_centers - views.sources)
        scale = (model.system.collimator_length / center[:, 2])[:, None]
        steps = views.u_steps, views.v_steps
        step = scale * np.stack([(frames[:, i] * steps[i]).sum(axis=1) for i in (0, 1)], axis=1)
        return cls(scale * center[:, :2] - step * (np.array(views.shape[::-1]) - 1) / 2, step, views.shape)


@dataclass(frozen=True)
class SpotModel:
    """Physics of spots: the pixels, holes and crystals of M modules, and the extent of the source."""

    lattice: PixelLattice
    """Pixels of the modules."""
    length: Floats
    """Collimator lengths (M,), mm."""
    hole_radius: Floats
    """Radii (M,) of the holes, mm."""
    edge_variance: Floats
    """Variances (M,) of the Gaussians, in the hole's plane, that soften the holes' edges, mm^2."""
    source_variance: float
    """Variance of the source along each axis, mm^2."""
    attenuation: Floats
    """Attenuation coefficients (M,) of the crystals, 1/mm."""
    thickness: Floats
    """Thicknesses (M,) of the crystals, mm; 0 records photons where they enter."""

    @classmethod
    def from_model(cls, model: Emission, views: Views, source_diameter: float = 0.0) -> "SpotModel":
        """Return the model of spots of balls with this diameter, mm; 0 mm is a point."""
        n, system = len(views), model.system
        if (diameter := at_least_0(source_diameter, "source_diameter", "mm")) > _MAX_DIAMETER:
            raise InputError(f"source_diameter: expected at most {_MAX_DIAMETER:g} mm, got {diameter:g}")
        hole, reach = system.pinhole_diameter / 2, np.zeros(n)
        if model.edge == "path":  # transmission exp(-x / reach) at x beyond the rim
            reach = one_for_all(model.optics.tangent / 2 / model.aperture_mu, "edge", n)  # type: ignore[operator]
        second = hole**4 / 4 + reach * (hole**3 + 3 * hole**2 * reach + 6 * hole * reach**2 + 6 * reach**3)
        radius = hole + reach if model.edge == "path" else model.effective_diameter / 2
        edge_variance = np.maximum(second / (hole**2 + 2 * reach * (hole + reach)) - (hole + reach) ** 2 / 4, 0.0)
        depth = system.detector_thickness * (model.depth_layers > 1)
        return cls(PixelLattice.from_views(model, views), system.collimator_length, radius, edge_variance, diameter**2 / 20,
                   one_for_all(0.0 if model.optics.crystal_mu is None else model.optics.crystal_mu, "crystal_mu", n),
                   depth)  # fmt: skip

    def fractions(
        self,
        centers: Floats,
        radii: Floats,
        sigma: Floats,
        magnification: Floats,
        shape: tuple[int, int],
        first: Any = 0,
    ) -> tuple[Floats, Floats]:
        """Return the fractions (M, n_v, n_u) of each module's spot in the pixels of a window, and their derivatives.

        The derivatives (4, M, n_v, n_u) are by the centre along u and v, by the radius and by the crystal's blur, per mm.

        Parameters
        ----------
        centers
            Images (M, 2) of the sources on the crystals' fronts, mm along u and v.
        radii
            Radii (M,) of the hole's shadows, mm.
        sigma
            Standard deviations (M,) of the crystals' blur, mm.
        magnification
            Magnifications l / h (M,).
        shape
            Numbers (n_v, n_u) of the window's rows and columns.
        first
            Column and row (M, 2) of the windows' first pixels.
        """
        first_edge = self.lattice.first + self.lattice.step * (np.asarray(first) - 0.5)
        ends = [first_edge[:, i, None] + self.lattice.step[:, i, None] * np.arange(shape[1 - i] + 1) for i in (0, 1)]
        widening = magnification**2 * self.source_variance + (1 + magnification) ** 2 * self.edge_variance
        blur = np.sqrt(sigma**2 + widening)
        weights, scale = self._depths(centers)
        shares = weights, scale, (1 + magnification[:, None] * scale) / (1 + magnification[:, None])
        fractions, gradient = disc_fractions(ends, centers, radii, blur, shares)
        gradient[3] *= (sigma / np.maximum(blur, 1e-12))[:, None, None]
        return fractions, gradient

    def _depths(self, centers: Floats) -> tuple[Floats, Floats]:
        """Return weights (M, Q) of depths z in the crystals for photons towards `centers`, and ratios (M, Q) 1 + z / l."""
        if not self.thickness.any():
            return np.ones((len(centers), 1)), np.ones((len(centers), 1))
        nodes, weights = scipy_module("special").roots_legendre(_DEPTHS)
        rate = self.attenuation * np.sqrt(1 + (centers**2).sum(axis=1) / self.length**2)
        depths = np.minimum(self.thickness, _MAX_OPTICAL_DEPTH / rate)[:, None] * (nodes + 1) / 2
        weights = weights * np.exp(-rate[:, None] * depths)
        return weights / weights.sum(axis=1, keepdims=True), 1 + depths / self.length[:, None]


def point_images(
    model: Emission, views: Views, points: ArrayLike, activity: ArrayLike = 1.0, source_diameter: float = 0.0
) -> Floats:
    """Return the expected counts (K, M, n_v, n_u) of K point sources, one per acquisition, in closed form.

    The hole is a disc of the model's effective diameter; with edge "path" it has a soft edge. Time, isotope, blur, depth of
    interaction, efficiency and background are taken into account as in a projection. There is no attenuation, and modules
    detect only the points that they see (`seen`).

    Parameters
    ----------
    model
        Emission model with the modules, their physics and the time of an acquisition.
    views
        Views of the modules.
    points
        Positions (K, 3) of the sources, world mm.
    activity
        Activities of the sources, kBq, one number or (K,).
    source_diameter
        Diameter of the sources, balls, mm. A cube has the images of a ball 1.29 times as wide.

    Raises
    ------
    InputError
        If views, points and numbers do not go together, or SciPy is missing.
    """
    instance(model, Emission, "model")
    model.check(views)
    points = real_array(points, "points", (None, 3))
    system, spots = model.system, SpotModel.from_model(model, views, source_diameter)
    local = np.einsum("mij,kmj->kmi", system.frames(), points[:, None] - system.centers)
    depths = np.where(local[..., 2] > 0, local[..., 2], np.inf)  # points behind the pinhole are not seen
    magnification = system.collimator_length / depths
    sigma = np.broadcast_to(model.optics.intrinsic_fwhm, len(views)) / FWHM_PER_SIGMA
    activities = one_for_all(activity, "activity", len(points))
    totals = 1000 * model.effective_time * activities[:, None] * sensitivity(system, points, optics=model.optics)
    fractions = [
        spots.fractions(m[:, None] * xyz[:, :2], spots.hole_radius * (1 + m), sigma, m, views.shape)[0]
        for xyz, m in zip(local, magnification, strict=True)
    ]
    efficiency = with_image_axes(model.efficiency)
    background = np.where(efficiency > 0, with_image_axes(model.background), 0.0)
    return totals[..., None, None] * fractions * efficiency + background


def disc_fractions(
    ends: Sequence[Floats], centers: Floats, radii: Floats, blur: Floats, layers: tuple[Floats, Floats, Floats]
) -> tuple[Floats, Floats]:
    """Return the fractions (S, n_v, n_u) of S blurred discs in pixels, and their derivatives (4, S, n_v, n_u).

    The derivatives are by the centre along both axes, by the radius and by the blur, per mm. A disc's fractions sum to 1 if
    the pixels contain all of it.

    Parameters
    ----------
    ends
        Ends of the pixels along u (S, n_u + 1) and v (S, n_v + 1), mm, ascending or descending.
    centers, radii, blur
        Centres (S, 2), radii (S,) and standard deviations (S,) of the blur, mm. Below 1/98 of the radius the blur is that,
        and the disc as much smaller.
    layers
        Weights (S, Q) of Q discs, and the factors (S, Q) of their centres and of their radii.
    """
    finest = math.pi * radii / (_NODE_DISTANCE * _MAX_NODES)
    sigma = np.maximum(blur, finest)
    radii = np.sqrt(radii**2 - 4 * (sigma**2 - np.minimum(blur, sigma) ** 2))  # of the same variance in all
    n = int(np.clip(math.pi * (radii / sigma).max() / _NODE_DISTANCE, _MIN_NODES, _MAX_NODES))
    angles = np.arange(1, n + 1) * math.pi / (n + 1)
    weights, scale, widening = (x[..., None] for x in layers)  # (S, Q, 1)
    weights = (2 / (n + 1)) * np.sin(angles) ** 2 * weights
    cosines, sines = widening * np.cos(angles), widening * np.sin(angles)
    places = scale * centers[:, 0, None, None] + radii[:, None, None] * cosines
    scale = np.broadcast_to(scale, places.shape)
    w, scale, cosines, half, u = (
        x.reshape(len(radii), -1, 1) for x in (weights, scale, cosines, radii[:, None, None] * sines, places)
    )
    sigma = sigma[:, None, None]
    t, below, density = _normal((ends[0][:, None] - u) / sigma)
    column, d_u, blurred_u = np.diff(below), -np.diff(density) / sigma, -np.diff(t * density) / sigma
    v = ends[1][:, None] - scale * centers[:, 1, None, None]
    (t, below, density), (t_low, below_low, density_low) = (_normal((v + s * half) / sigma) for s in (1, -1))
    integral = sigma * (t * below + density - t_low * below_low - density_low)
    row = w / (2 * half) * np.diff(integral)
    d_v = -w / (2 * half) * np.diff(below - below_low)
    d_half = w / (2 * half) * np.diff(below + below_low) - row / half
    blurred_v = w / (2 * half) * np.diff(density - density_low)
    sign = np.sign(ends[0][:, -1] - ends[0][:, 0]) * np.sign(ends[1][:, -1] - ends[1][:, 0])

    def product(rows: Floats, columns: Floats) -> Floats:
        """Return the sums over the chords of rows (S, n, n_v) times columns (S, n, n_u)."""
        return sign[:, None, None] * (rows.swapaxes(1, 2) @ columns)

    d_radius = product(half * d_half, column) / radii[:, None, None] + product(cosines * row, d_u)
    gradient = [product(scale * row, d_u), product(scale * d_v, column), d_radius]
    fractions = np.maximum(product(row, column), 0)  # below 0 is rounding
    return fractions, np.stack([*gradient, product(row, blurred_u) + product(blurred_v, column)])


def _normal(t: Floats) -> tuple[Floats, Floats, Floats]:
    """Return t, the normal distribution function at t, and its density."""
    return t, scipy_module("special").ndtr(t), np.exp(-0.5 * t**2) / math.sqrt(2 * math.pi)
