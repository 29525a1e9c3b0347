"""Photons one by one from a point in water without end: what the dose's point kernel is compared with."""

from __future__ import annotations

import math

import numpy as np

_PHOTO = np.array([
    (3, 191.9), (5, 41.92), (8, 9.919), (10, 4.944), (15, 1.369), (20, 0.5439), (30, 0.1458), (40, 0.05679), (50, 0.02725),
    (60, 0.01493), (80, 0.00577), (100, 0.002762), (150, 7.308e-4), (200, 2.888e-4), (300, 8.159e-5), (700, 8.081e-6),
])  # fmt: skip
"""Energies, keV, and photoelectric coefficients of water, cm^2/g: W. T. Elam and others' tables, by XrayDB 4.5.8."""
_ELECTRONS = 3.3428e23  # per g of water
_RADIUS2 = 7.940788e-26  # cm^2, classical electron radius, squared
_LEAST = 1.0  # keV: what is left of a photon is absorbed where it is


def klein_nishina(energy):
    """Return the cross-section of free electrons, cm^2/g of water."""
    k = energy / 510.999
    log = np.log1p(2 * k)
    brackets = (1 + k) / k**2 * (2 * (1 + k) / (1 + 2 * k) - log / k) + log / (2 * k) - (1 + 3 * k) / (1 + 2 * k) ** 2
    return _ELECTRONS * 2 * math.pi * _RADIUS2 * brackets


def photoelectric(energy):
    """Return the photoelectric coefficient of water, cm^2/g."""
    return np.exp(np.interp(np.log(energy), *np.log(_PHOTO).T))


def scattered_share(energy, rng):
    """Return E' / E of photons after Compton scattering by free electrons, drawn by rejection as EGS does."""
    low = 1 / (1 + 2 * energy / 510.999)
    share, todo = np.empty(len(energy)), np.arange(len(energy))
    while len(todo):
        e0 = low[todo]
        log, square = -np.log(e0), (1 - e0**2) / 2
        a, b, c = rng.random((3, len(todo)))
        e = np.where(a * (log + square) < log, np.exp(-b * log), np.sqrt(e0**2 + (1 - e0**2) * b))
        t = (1 / e - 1) * 510.999 / energy[todo]  # 1 - cos
        taken = c < 1 - e * t * (2 - t) / (1 + e**2)
        share[todo[taken]] = e[taken]
        todo = todo[~taken]
    return share


def absorbed_within(energy, radii, n, seed=1):
    """Return the shares of the energy of n photons of an `energy`, keV, that are absorbed within `radii`, mm, of a point."""
    rng = np.random.default_rng(seed)
    path = -np.log1p(-(np.arange(n) + 0.5) / n)  # of the first flights, evenly spread
    place, direction = np.zeros((n, 3)), np.tile([0.0, 0.0, 1.0], (n, 1))
    energies, absorbed = np.full(n, float(energy)), np.zeros(len(radii))
    while len(energies):
        compton, photo = klein_nishina(energies), photoelectric(energies)
        place = place + direction * (10 * path / (compton + photo))[:, None]
        share = np.where(rng.random(len(energies)) * (compton + photo) < compton, scattered_share(energies, rng), 0.0)
        share[share * energies < _LEAST] = 0.0
        distance = np.linalg.norm(place, axis=1)
        absorbed += np.histogram(distance, [0, *radii], weights=energies * (1 - share))[0].cumsum()
        goes_on = (share > 0) & (distance < 3 * radii[-1])
        place, direction, energies, share = (x[goes_on] for x in (place, direction, energies, share))
        cosine = 1 - (1 / share - 1) * 510.999 / energies
        path = rng.exponential(size=len(energies))
        direction, energies = turned(direction, cosine, 2 * math.pi * rng.random(len(share))), energies * share
    return absorbed / (n * energy)


def turned(direction, cosine, azimuth):
    """Return directions (n, 3) after a deflection."""
    helper = np.where(np.abs(direction[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    u = np.cross(direction, helper)
    u /= np.linalg.norm(u, axis=1)[:, None]
    across = np.cos(azimuth)[:, None] * u + np.sin(azimuth)[:, None] * np.cross(direction, u)
    return cosine[:, None] * direction + np.sqrt(np.maximum(1 - cosine**2, 0))[:, None] * across
