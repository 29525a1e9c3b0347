"""Images of point sources through round holes of finite size, in closed form.

A point at depth h in front of a hole of diameter d_e casts the hole's shadow on a crystal at the distance l behind it. As
both planes are parallel, the shadow is a disc of diameter ``d_e (1 + l / h)`` around the point's central projection. The
counts of a pixel are proportional to the fraction of the disc that lies in it: the difference of the disc's areas in the
four quadrants that end at the pixel's corners. The total is given by `sensitivity`; within the disc the photons are taken to
be uniform, because their angles differ by d / h only.
"""

import math
from typing import NamedTuple

import numpy as np

from ..arrays import ArrayLike, Floats
from ..geometry.views import Views
from ..models.emission import Emission
from ..models.model import with_image_axes
from ..physics.crystal import gaussian_blur
from ..physics.performance import sensitivity
from ..validation import instance, one_for_all, real_array

_FWHM_PER_SIGMA = 2 * math.sqrt(2 * math.log(2))


class PixelLattice(NamedTuple):
    """Pixels of the modules on their crystals, and the crystals' blur.

    Coordinates are mm along u and v from the crystal's centre, point-inverted through the pinhole.
    """

    first: Floats
    """Centre (M, 2) of pixel (0, 0)."""
    step: Floats
    """Steps (M, 2) from pixel to pixel along a row and along a column; negative on the real detector."""
    shape: tuple[int, int]
    """Numbers (n_v, n_u) of rows and columns."""
    sigma: Floats
    """Standard deviation (M,) of the crystal's blur, mm."""

    @classmethod
    def from_views(cls, model: Emission, views: Views) -> "PixelLattice":
        """Return the lattice of the views of a model's modules."""
        frames = model.system.frames()
        center = np.einsum("mij,mj->mi", frames, views.detector_centers - views.sources)
        scale = (model.system.collimator_length / center[:, 2])[:, None]
        steps = views.u_steps, views.v_steps
        step = scale * np.stack([(frames[:, i] * steps[i]).sum(axis=1) for i in (0, 1)], axis=1)
        first = scale * center[:, :2] - step * (np.array(views.shape[::-1]) - 1) / 2
        sigma = np.broadcast_to(model.optics.intrinsic_fwhm, len(views)) / _FWHM_PER_SIGMA
        return cls(first, step, views.shape, sigma)

    def blurs(self, shape: tuple[int, int]) -> tuple[Floats, Floats] | None:
        """Return matrices (M, n_v, n_v) and (M, n_u, n_u) that blur windows of `shape` along v and u; None without blur."""
        if not self.sigma.any():
            return None
        sigmas = self.sigma[:, None] / np.abs(self.step)
        along_u, along_v = (
            np.array([gaussian_blur(n, s) for s in row]) for n, row in zip(shape[::-1], sigmas.T, strict=True)
        )
        return along_v, along_u


def point_images(model: Emission, views: Views, points: ArrayLike, activity: ArrayLike = 1.0) -> Floats:
    """Return the expected counts (K, M, n_v, n_u) of K point sources, one per acquisition, in closed form.

    The hole is a disc of the model's effective diameter. Time, isotope, blur, efficiency and background are taken into
    account as in a projection. There is no attenuation, and modules detect only the points that they see (`seen`).

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
    """
    instance(model, Emission, "model")
    model.check(views)
    points = real_array(points, "points", (None, 3))
    system, lattice = model.system, PixelLattice.from_views(model, views)
    local = np.einsum("mij,kmj->kmi", system.frames(), points[:, None] - system.centers)
    depths = np.where(local[..., 2] > 0, local[..., 2], np.inf)  # points behind the pinhole are not seen
    length = system.collimator_length
    pixels = ((length / depths)[..., None] * local[..., :2] - lattice.first) / lattice.step
    radii = model.effective_diameter / 2 * (1 + length / depths)
    activities = one_for_all(activity, "activity", len(points))
    totals = 1000 * model.effective_time * activities[:, None] * sensitivity(system, points, optics=model.optics)
    pitch, blurs = np.abs(lattice.step), lattice.blurs(views.shape)
    fractions = [disc_fractions(uv, r, pitch, views.shape, blurs)[0] for uv, r in zip(pixels, radii, strict=True)]
    efficiency = with_image_axes(model.efficiency)
    background = np.where(efficiency > 0, with_image_axes(model.background), 0.0)
    return totals[..., None, None] * fractions * efficiency + background


def disc_fractions(
    pixels: Floats, radii: Floats, pitch: Floats, shape: tuple[int, int], blurs: tuple[Floats, Floats] | None
) -> tuple[Floats, Floats]:
    """Return the fractions (S, n_v, n_u) of S discs in the pixels of windows, and their derivatives (3, S, n_v, n_u).

    The discs have their centres at `pixels` (S, 2), column and row, and `radii` (S,), mm. The windows have the `shape`
    (n_v, n_u) and the pixel sizes `pitch` (S, 2), mm; `blurs` are the matrices of `PixelLattice.blurs`. A disc's fractions
    sum to 1 if the window contains all of it. The derivatives are by column, by row and, per mm, by radius.
    """
    u, v = ((np.arange(shape[1 - i] + 1) - 0.5 - pixels[:, i, None]) * pitch[:, i, None] for i in (0, 1))
    areas = np.diff(np.diff(quadrant_areas(u, v, radii), axis=2), axis=3) / (math.pi * radii[:, None, None] ** 2)
    if blurs is not None:
        areas = blurs[0] @ areas @ blurs[1].swapaxes(1, 2)
    fractions, (d_u, d_v, d_radius) = np.maximum(areas[0], 0), areas[1:]  # areas below 0 are rounding
    d_column, d_row = (-size[:, None, None] * d for size, d in zip(pitch.T, (d_u, d_v), strict=True))
    return fractions, np.stack([d_column, d_row, d_radius - 2 * fractions / radii[:, None, None]])


def quadrant_areas(u: Floats, v: Floats, radii: Floats) -> Floats:
    """Return the areas of discs in the quadrants left of `u` (S, n) and below `v` (S, m), and derivatives, (4, S, m, n).

    The discs are centred on 0 and have the `radii` (S,). The derivatives are by u and by v (lengths of chords) and by the
    radius (lengths of arcs).
    """
    u, v, radius = u[:, None, :], v[:, :, None], radii[:, None, None]
    half_u, half_v = (np.sqrt(np.maximum(radius**2 - x**2, 0)) for x in (u, v))

    def half_area(x: Floats, half: Floats) -> Floats:
        """Return the integral of the half chord from 0 to x; `half` is the half chord at x."""
        return (x * half + radius**2 * np.arcsin(x / radius)) / 2

    # The integral over x up to u of the chord's part below v. Its length is half + v where |x| is less than half_v;
    # elsewhere the whole chord, 2 half, lies below v, or nothing does.
    to_u, to_v = half_area(np.clip(u, -radius, radius), half_u), half_area(half_v, np.minimum(np.abs(v), radius))
    left_area = to_u + math.pi / 4 * radius**2
    area = left_area + np.sign(v) * (left_area - np.clip(to_u, -to_v, to_v) - to_v)
    area += np.clip(v, -radius, radius) * (np.clip(u, -half_v, half_v) + half_v)
    d_u, d_v = half_u + np.clip(v, -half_u, half_u), half_v + np.clip(u, -half_v, half_v)
    d_radius = (2 * area - u * d_u - v * d_v) / radius  # by Euler's theorem: areas are of degree 2 in all lengths
    return np.stack([area, d_u, d_v, d_radius])
