"""Images of point sources through whole round holes, in closed form.

A point at height h in front of a hole of diameter d_e throws the hole's image on a crystal at a distance l behind it. Both
planes are parallel, so that image is a disc, of diameter ``d_e (1 + l / h)``, around the point's central projection. A
pixel counts the share of the disc that lies in it: the difference of the disc's areas in the four quadrants that end at the
pixel's corners. The law of the total is that of `sensitivity`; within the disc the photons are taken to be even, as their
angles differ by d / h only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import Floats
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..physics.crystal import gaussian_blur, share_inside
from ..physics.performance import sensitivity
from ..projector.emission import Emission
from ..validation import instance, one_for_all, real_array

_FWHM_PER_SIGMA = float(2 * np.sqrt(2 * np.log(2)))


class Lattice(NamedTuple):
    """Where the modules' pixels lie on their crystals, mm along u and v from the middle, point-inverted."""

    first: Floats  # (M, 2): the centre of pixel 0, 0
    step: Floats  # (M, 2): from one pixel to the next along a row, and along a column; negative on the real detector
    shape: tuple[int, int]

    @classmethod
    def of(cls, system: PinholeSystem, views: Views) -> Lattice:
        """That of a system's views."""
        frames = system.frames()
        middle = np.einsum("mij,mj->mi", frames, views.detector_centers - views.sources)
        scale = (system.collimator_length / middle[:, 2])[:, None]
        steps = np.einsum("msi,mij->msj", frames[:, :2], np.stack([views.u_steps, views.v_steps], axis=2))
        step = scale * np.diagonal(steps, axis1=1, axis2=2)
        n_v, n_u = views.shape
        return cls(scale * middle[:, :2] - step * (np.array([n_u, n_v]) - 1) / 2, step, views.shape)

    def pixels(self, places: Floats) -> Floats:
        """Columns and rows (..., M, 2) of places on the crystals (..., M, 2), mm."""
        return (places - self.first) / self.step

    def places(self, pixels: Floats) -> Floats:
        """Places on the crystals (..., M, 2), mm, of columns and rows (..., M, 2)."""
        return self.first + self.step * pixels


def point_images(model: Emission, views: Views, points: ArrayLike, activity: ArrayLike = 1.0) -> Floats:
    """Expected counts (K, M, n_v, n_u) of K point sources, one in each acquisition, in closed form.

    The hole is round and as large as the model's effective diameter; the crystal's blur, its sides and its efficiency are
    the model's, whose activity decays and whose background counts as in a projection. Nothing attenuates.

    Parameters
    ----------
    model
        The modules, their physics and the time of an acquisition.
    views
        Theirs.
    points
        (K, 3), world mm. A module counts those that it sees (`seen`).
    activity
        In kBq, one number or (K,).
    """
    instance(model, Emission, "model")
    model.check(views)
    points = real_array(points, "points", (None, 3))
    system, lattice = model.system, Lattice.of(model.system, views)
    places, heights = projected(system.centers, system.frames(), system.collimator_length, points)
    radii = shadow_radii(model, heights)
    decays = 1000 * model.effective_time * one_for_all(activity, "activity", len(points))
    totals = decays[:, None] * sensitivity(system, points, optics=model.optics)
    n_v, n_u = views.shape
    first = np.zeros((len(points), 2))
    images = np.empty((len(points), len(system), n_v, n_u))
    for m in range(len(system)):
        discs = Discs.of(model, lattice, np.full(len(points), m), first, (n_v, n_u))
        images[:, m] = totals[:, m, None, None] * discs.shares(lattice.pixels(places)[:, m], radii[:, m])[0]
    return images + each_pixel(model.background)


def each_pixel(background: ArrayLike) -> Floats:
    """A model's background, (), (M,) or (M, n_v, n_u), with all three axes."""
    values = np.asarray(background, np.float64)
    return values.reshape(values.shape + (1,) * (3 - values.ndim))


def projected(centers: Floats, frames: Floats, length: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Where points (K, 3) are seen on the crystals (K, M, 2), mm, point-inverted, and their heights (K, M), mm."""
    local = np.einsum("mij,kmj->kmi", frames, points[:, None] - centers)
    return length[:, None] * local[..., :2] / local[..., 2:], local[..., 2]


def shadow_radii(model: Emission, heights: Floats) -> Floats:
    """Radii (K, M), mm, of the holes' images on the crystals, of points at heights (K, M), mm."""
    return model.effective_diameter / 2 * (1 + model.system.collimator_length / heights)


class Discs(NamedTuple):
    """Windows of S images, in which discs are to be drawn."""

    first: Floats  # (S, 2): column and row of the window's first pixel
    pitch: Floats  # (S, 2), mm along u and v
    weights: Floats  # (S, n_v, n_u): the part of a pixel that can count, 0 beyond the image
    blurs: tuple[Floats, Floats] | None  # (S, n_v, n_v) along v and (S, n_u, n_u) along u

    @classmethod
    def of(cls, model: Emission, lattice: Lattice, modules: Floats, first: Floats, shape: tuple[int, int]) -> Discs:
        """Windows of a `shape` that begin at the columns and rows `first` (S, 2) of images of `modules` (S,)."""
        n_m = len(model.system)
        step, pitch = lattice.step[modules], np.abs(lattice.step[modules])
        shares, blurs = [], []
        sigma = np.broadcast_to(model.optics.intrinsic_fwhm, n_m)[modules] / _FWHM_PER_SIGMA
        for axis in (0, 1):
            n = shape[1 - axis]
            index = first[:, axis, None] + np.arange(n)
            share = ((index >= 0) & (index < lattice.shape[1 - axis])).astype(float)
            if model.within_crystal:
                place = lattice.first[modules, axis, None] + step[:, axis, None] * index
                side = model.system.detector_side[modules, None]
                share *= share_inside(place, pitch[:, axis, None], side)
            shares.append(share)
            blurs.append([gaussian_blur(n, s / p) for s, p in zip(sigma, pitch[:, axis], strict=True)])
        weights = shares[1][:, :, None] * shares[0][:, None, :]
        return cls(first, pitch, weights, (np.array(blurs[1]), np.array(blurs[0])) if sigma.any() else None)

    def shares(self, pixels: Floats, radii: Floats) -> tuple[Floats, Floats]:
        """What each pixel counts of discs around `pixels` (S, 2), column and row, with `radii` (S,), mm.

        Returns shares (S, n_v, n_u), which sum to 1 where nothing is cut off, and their derivatives (3, S, n_v, n_u) by
        column, by row and, per mm, by radius.
        """
        n_v, n_u = self.weights.shape[1:]
        offset = (pixels - self.first + 0.5) * self.pitch
        u, v = (
            np.arange(n + 1) * pitch[:, None] - middle[:, None]
            for n, pitch, middle in zip((n_u, n_v), self.pitch.T, offset.T, strict=True)
        )
        quadrants = disc_in_quadrants(u, v, radii)
        within = quadrants[..., 1:, 1:] - quadrants[..., 1:, :-1] - quadrants[..., :-1, 1:] + quadrants[..., :-1, :-1]
        radius = radii[:, None, None]
        shares = within / (np.pi * radius**2)
        shares[0] = np.maximum(shares[0], 0)  # rounding
        shares[1:3] *= -self.pitch.T[:, :, None, None]  # a disc moved forward is edges moved back
        shares[3] -= 2 * shares[0] / radius
        shares *= self.weights
        if self.blurs is not None:
            shares = self.blurs[0] @ shares @ self.blurs[1].swapaxes(1, 2)
            shares *= self.weights > 0
        return shares[0], shares[1:]


def disc_in_quadrants(u: Floats, v: Floats, radii: Floats) -> Floats:
    """Areas of discs around 0 with `radii` (S,) in the quadrants left of `u` (S, n) and below `v` (S, m), and derivatives.

    Returns (4, S, m, n): the areas, and their derivatives by u and v (lengths of chords) and by the radius (of arcs).
    """
    radius = radii[:, None]
    half_u, half_v = (np.sqrt(np.maximum(radius**2 - x**2, 0)) for x in (u, v))

    def below(x: Floats, half: Floats) -> Floats:
        """Half of the disc's area between 0 and x."""
        inside = np.clip(x, -radius, radius)
        return (inside * half + radius**2 * np.arcsin(inside / radius)) / 2

    # The integral over x up to u of the chord below v, half + clip(v, -half, half), which is half + v where |x| is less
    # than half_v, and beyond that all of the chord or nothing.
    to_u, to_v, quarter = below(u, half_u)[:, None], below(half_v, np.abs(v))[:, :, None], np.pi * radius[..., None] ** 2 / 4
    u, half_u, v, half_v = u[:, None], half_u[:, None], v[:, :, None], half_v[:, :, None]
    beyond = to_u + quarter - np.clip(to_u, -to_v, to_v) - to_v
    area = to_u + quarter + np.sign(v) * beyond + np.clip(v, -radius[..., None], radius[..., None]) * (np.clip(u, -half_v, half_v) + half_v)
    by_u, by_v = half_u + np.clip(v, -half_u, half_u), half_v + np.clip(u, -half_v, half_v)
    by_radius = (2 * area - u * by_u - v * by_v) / radius[..., None]  # areas are of degree 2 in all lengths (Euler)
    return np.stack(np.broadcast_arrays(area, by_u, by_v, by_radius))
