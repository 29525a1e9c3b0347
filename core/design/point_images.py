"""Images of point sources through whole round holes, in closed form.

A point at height h in front of a hole of diameter d_e throws the hole's image on a crystal at a distance l behind it. Both
planes are parallel, so that image is a disc, of diameter ``d_e (1 + l / h)``, around the point's central projection. A
pixel counts the share of the disc that lies in it: the difference of the disc's areas in the four quadrants that end at the
pixel's corners. The law of the total is that of `sensitivity`; within the disc the photons are taken to be even, as their
angles differ by d / h only.
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


class Lattice(NamedTuple):
    """Where the modules' pixels lie on their crystals, mm along u and v from the middle, point-inverted; and the blur."""

    first: Floats  # (M, 2): the centre of pixel 0, 0
    step: Floats  # (M, 2): from one pixel to the next along a row, and along a column; negative on the real detector
    shape: tuple[int, int]
    sigma: Floats  # (M,), mm, of the crystal's blur

    @classmethod
    def of(cls, model: Emission, views: Views) -> "Lattice":
        """That of the views of a model's modules."""
        frames = model.system.frames()
        middle = np.einsum("mij,mj->mi", frames, views.detector_centers - views.sources)
        scale = (model.system.collimator_length / middle[:, 2])[:, None]
        steps = views.u_steps, views.v_steps
        step = scale * np.stack([(frames[:, i] * steps[i]).sum(axis=1) for i in (0, 1)], axis=1)
        first = scale * middle[:, :2] - step * (np.array(views.shape[::-1]) - 1) / 2
        sigma = np.broadcast_to(model.optics.intrinsic_fwhm, len(views)) / _FWHM_PER_SIGMA
        return cls(first, step, views.shape, sigma)

    def blurs(self, shape: tuple[int, int]) -> tuple[Floats, Floats] | None:
        """Matrices (M, n_v, n_v) and (M, n_u, n_u) that blur windows of a `shape` along v and u; None without blur."""
        if not self.sigma.any():
            return None
        sigmas = self.sigma[:, None] / np.abs(self.step)
        along_u, along_v = (
            np.array([gaussian_blur(n, s) for s in each]) for n, each in zip(shape[::-1], sigmas.T, strict=True)
        )
        return along_v, along_u


def point_images(model: Emission, views: Views, points: ArrayLike, activity: ArrayLike = 1.0) -> Floats:
    """Expected counts (K, M, n_v, n_u) of K point sources, one in each acquisition, in closed form.

    The hole is round and as large as the model's effective diameter. Time, isotope, blur, efficiency and background count
    as in a projection; nothing attenuates, and modules count the points that they see (`seen`).

    Parameters
    ----------
    model
        The modules, their physics and the time of an acquisition.
    views
        Theirs.
    points
        (K, 3), world mm.
    activity
        In kBq, one number or (K,).
    """
    instance(model, Emission, "model")
    model.check(views)
    points = real_array(points, "points", (None, 3))
    system, lattice = model.system, Lattice.of(model, views)
    local = np.einsum("mij,kmj->kmi", system.frames(), points[:, None] - system.centers)
    heights = np.where(local[..., 2] > 0, local[..., 2], np.inf)  # behind the pinhole nothing is seen
    length = system.collimator_length
    pixels = ((length / heights)[..., None] * local[..., :2] - lattice.first) / lattice.step
    radii = model.effective_diameter / 2 * (1 + length / heights)
    activities = one_for_all(activity, "activity", len(points))
    totals = 1000 * model.effective_time * activities[:, None] * sensitivity(system, points, optics=model.optics)
    pitch, blurs = np.abs(lattice.step), lattice.blurs(views.shape)
    shares = [disc_shares(at, radius, pitch, views.shape, blurs)[0] for at, radius in zip(pixels, radii, strict=True)]
    efficiency = with_image_axes(model.efficiency)
    return totals[..., None, None] * shares * efficiency + np.where(
        efficiency > 0, with_image_axes(model.background), 0.0
    )


def disc_shares(
    pixels: Floats, radii: Floats, pitch: Floats, shape: tuple[int, int], blurs: tuple[Floats, Floats] | None
) -> tuple[Floats, Floats]:
    """What each pixel of windows of a `shape` counts of discs around `pixels` (S, 2), column and row, with `radii` (S,), mm.

    Pixels are `pitch` (S, 2) large, mm, and `blurs` are those of `Lattice`. Returns shares (S, n_v, n_u), which sum to 1
    where nothing is cut off, and their derivatives (3, S, n_v, n_u) by column, by row and, per mm, by radius.
    """
    u, v = ((np.arange(shape[1 - i] + 1) - 0.5 - pixels[:, i, None]) * pitch[:, i, None] for i in (0, 1))
    within = np.diff(np.diff(disc_in_quadrants(u, v, radii), axis=2), axis=3) / (math.pi * radii[:, None, None] ** 2)
    if blurs is not None:
        within = blurs[0] @ within @ blurs[1].swapaxes(1, 2)
    shares, (by_u, by_v, by_radius) = np.maximum(within[0], 0), within[1:]  # below 0 is rounding
    by_column, by_row = (-size[:, None, None] * by for size, by in zip(pitch.T, (by_u, by_v), strict=True))
    return shares, np.stack([by_column, by_row, by_radius - 2 * shares / radii[:, None, None]])


def disc_in_quadrants(u: Floats, v: Floats, radii: Floats) -> Floats:
    """Areas of discs around 0 with `radii` (S,) in the quadrants left of `u` (S, n) and below `v` (S, m), and derivatives.

    Returns (4, S, m, n): the areas, and their derivatives by u and v (lengths of chords) and by the radius (of arcs).
    """
    u, v, radius = u[:, None, :], v[:, :, None], radii[:, None, None]
    half_u, half_v = (np.sqrt(np.maximum(radius**2 - x**2, 0)) for x in (u, v))

    def half_area(x: Floats, half: Floats) -> Floats:
        return (x * half + radius**2 * np.arcsin(x / radius)) / 2

    # The integral over x up to u of the chord below v: it is half + v long where |x| is less than half_v, and elsewhere all
    # of the chord, 2 half, or nothing.
    to_u, to_v = half_area(np.clip(u, -radius, radius), half_u), half_area(half_v, np.minimum(np.abs(v), radius))
    left = to_u + math.pi / 4 * radius**2
    area = left + np.sign(v) * (left - np.clip(to_u, -to_v, to_v) - to_v)
    area += np.clip(v, -radius, radius) * (np.clip(u, -half_v, half_v) + half_v)
    by_u, by_v = half_u + np.clip(v, -half_u, half_u), half_v + np.clip(u, -half_v, half_v)
    by_radius = (2 * area - u * by_u - v * by_v) / radius  # areas are of degree 2 in all lengths (Euler)
    return np.stack([area, by_u, by_v, by_radius])
