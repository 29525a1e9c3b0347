"""Photons that really fly, without any weight: from a place, through voxels of water, through round holes onto planes.

Written apart from the product, whose tables of coefficients and of scattering functions it reads, but none of its laws of
drawing: free paths by Woodcock's tracking, angles by rejection, energies by Compton's formula.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erf

import numpy as np

from mphdrr.core.physics.photon_scattering import Scatterer

ELECTRON = 510.99895
WATER = Scatterer("water")
ENERGIES = np.linspace(20, 1000, 491)
COEFFICIENTS = np.array([WATER.coefficients(float(energy)) for energy in ENERGIES]).T  # total, incoherent, coherent
ROOTS = np.linspace(0, np.sqrt(1000 / 12.39842), 4000)
INCOHERENT = WATER.incoherent_function(ROOTS**2)
COHERENT = WATER.coherent_function(ROOTS**2)
UNTIL = np.concatenate([[0], np.cumsum((COHERENT[1:] + COHERENT[:-1]) / 2 * np.diff(ROOTS**4))])  # over x^2


@dataclass
class Photons:
    """Photons that left a body: places, mm, directions, energies, keV, and numbers of their collisions."""

    places: np.ndarray
    directions: np.ndarray
    energies: np.ndarray
    orders: np.ndarray


def sphere(n, rng):
    """Return n directions to all sides."""
    cosine, azimuth = rng.uniform(-1, 1, n), rng.uniform(0, 2 * np.pi, n)
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=1)


def left(density, spacing, places, energies, rng, lowest=30.0, directions=None):
    """Return the photons that leave voxels of water, centred, of those that begin at `places`, by default to all sides."""
    n, half = np.array(density.shape), np.array(density.shape) * spacing / 2
    directions = sphere(len(places), rng) if directions is None else directions
    orders, gone = np.zeros(len(places), int), []
    most = density.max()
    while len(places):
        total, incoherent, coherent = (np.interp(energies, ENERGIES, row) for row in COEFFICIENTS)
        before, places = places, places + directions * (-np.log(1 - rng.random(len(places))) / (most * total))[:, None]
        inside = (np.abs(places) < half).all(axis=1)
        out = ~inside
        gone.append((before[out], directions[out], energies[out], orders[out]))
        index = np.clip(((places + half) / spacing).astype(int), 0, n - 1)
        met = inside & (rng.random(len(places)) * most < density[tuple(index.T)])
        which = rng.random(len(places)) * total
        compton, rayleigh = met & (which < incoherent), met & (which >= incoherent) & (which < incoherent + coherent)
        cosine = np.ones(len(places))
        cosine[compton] = compton_cosines(energies[compton], rng)
        cosine[rayleigh] = rayleigh_cosines(energies[rayleigh], rng)
        energies = np.where(compton, energies / (1 + energies / ELECTRON * (1 - cosine)), energies)
        hit = compton | rayleigh
        directions[hit] = turned(directions[hit], cosine[hit], rng)
        orders = orders + hit
        keep = inside & (~met | hit) & (energies > lowest)
        places, directions, energies, orders = places[keep], directions[keep], energies[keep], orders[keep]
    return Photons(*(np.concatenate(part) for part in zip(*gone, strict=True)))


def compton_cosines(energies, rng):
    """Return a cosine for each energy by Klein and Nishina's law and water's incoherent scattering function."""
    result, open_ = np.ones(len(energies)), np.arange(len(energies))
    while len(open_):
        energy, cosine = energies[open_], rng.uniform(-1, 1, len(open_))
        ratio = 1 / (1 + energy / ELECTRON * (1 - cosine))
        law = ratio**2 * (ratio + 1 / ratio - 1 + cosine**2) / 2
        bound = np.interp(np.sqrt(energy / 12.39842 * np.sqrt((1 - cosine) / 2)), ROOTS, INCOHERENT) / INCOHERENT.max()
        accepted = rng.random(len(open_)) < law * bound
        result[open_[accepted]] = cosine[accepted]
        open_ = open_[~accepted]
    return result


def rayleigh_cosines(energies, rng):
    """Return a cosine for each energy by Thomson's law and water's squared form factor."""
    result, open_ = np.ones(len(energies)), np.arange(len(energies))
    while len(open_):
        square = (energies[open_] / 12.39842) ** 2
        sought = rng.random(len(open_)) * np.interp(square, ROOTS**4, UNTIL)
        cosine = 1 - 2 * np.interp(sought, UNTIL, ROOTS**4) / square
        accepted = 2 * rng.random(len(open_)) < 1 + cosine**2
        result[open_[accepted]] = cosine[accepted]
        open_ = open_[~accepted]
    return result


def turned(directions, cosines, rng):
    """Return unit vectors turned by angles of these cosines, to random sides."""
    side = np.cross(directions, np.eye(3)[np.argmin(np.abs(directions), axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other, azimuth = np.cross(directions, side), rng.uniform(0, 2 * np.pi, len(directions))
    around = np.cos(azimuth)[:, None] * side + np.sin(azimuth)[:, None] * other
    return cosines[:, None] * directions + np.sqrt(1 - cosines**2)[:, None] * around


def counted(energies, window, fwhm, reference):
    """Return the shares of photons that a window counts: a detector's lines have the FWHM fwhm sqrt(reference E)."""
    sigma = fwhm * np.sqrt(reference * energies) / np.sqrt(8 * np.log(2))
    low, high = ((np.asarray(end) - energies) / (sigma * np.sqrt(2)) for end in window)
    table = np.vectorize(erf, otypes=[float])
    return (table(high) - table(low)) / 2


def seen(photons, views, m, radius, length):
    """Return row, column and number of the photons that fly through a view's hole of this radius onto its pixels.

    The crystal is `length` mm behind the hole; the view's detector is its image on the object's side.
    """
    hole, steps = views.sources[m], (views.v_steps[m], views.u_steps[m])
    axis = np.cross(*steps) / np.linalg.norm(np.cross(*steps))
    ahead = (views.detector_centers[m] - hole) @ axis
    axis, ahead = axis * np.sign(ahead), abs(ahead)
    along = photons.directions @ axis
    t = ((hole - photons.places) @ axis) / along
    at = photons.places + t[:, None] * photons.directions - hole
    index = np.flatnonzero((t > 0) & (along < 0) & ((at**2).sum(axis=1) < radius**2))
    image = (at[index] - photons.directions[index] * (length / along[index])[:, None]) * -ahead / length
    middle = views.detector_centers[m] - hole
    pixels = [
        np.rint((image - middle) @ step / (step @ step) + (n - 1) / 2).astype(int)
        for step, n in zip(steps, views.shape, strict=True)
    ]
    on = np.all([(pixel >= 0) & (pixel < n) for pixel, n in zip(pixels, views.shape, strict=True)], axis=0)
    return pixels[0][on], pixels[1][on], index[on]
