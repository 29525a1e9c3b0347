"""Photons one by one from a small cube through a knife-edged plate into a crystal: what images are compared with."""

from __future__ import annotations

import math

import numpy as np

import mphdrr.core as mph

from .test_emission import one_module

_STEPS = 48  # through half a plate


def module(**changes):
    """Return one module with a hole of 2.3 mm that looks along -x."""
    return one_module(**{"pinhole_diameter": 2.3, **changes})


def voxel(system, place, size):
    """Return a grid around a voxel of a `size`, mm, at (u, v, depth) before the pinhole, along the world's axes."""
    affine = np.diag([size, size, size, 1.0])
    affine[:3, 3] = system.centers[0] + np.asarray(place) @ system.frames()[0] - 2 * size
    return mph.Grid((5, 5, 5), affine)


def image_of_voxel(system, place, pixels, size=0.3, backend="auto", **model):
    """Return the projector's image of one decay a second in a `voxel`."""
    A = mph.Projector(
        voxel(system, place, size), system.views((pixels, pixels), "virtual"),
        mph.Emission(system, **{"hole": "depth", "within_crystal": True, **model}), backend, double=True,
    )  # fmt: skip
    x = np.zeros(A.shape_in)
    x[2, 2, 2] = size**-3
    return A(x)[0]


def traced_image(system, place, pixels, size=0.3, n=2**18, edge_mu=None, plate=20.0, crystal_mu=None):
    """Return the image of a decay a second in a `voxel` by n evenly spread photons; the cone's half angle is 45 degrees."""
    d, l, side, thickness = (
        float(each[0])
        for each in (system.pinhole_diameter, system.collimator_length, system.detector_side, system.detector_thickness)
    )
    random = (0.5 + np.arange(n)[:, None] / 1.13272432 ** np.arange(1, 8)) % 1
    cube = (random[:, :3] - 0.5) * size @ system.frames()[0].T
    start, height = cube[:, :2] + place[:2], cube[:, 2] + place[2]
    radius, area = d / 2 * np.sqrt(random[:, 3]), np.full(n, math.pi * d**2 / 4 / n)
    beyond = np.zeros(n, bool)
    if edge_mu is not None:  # half of them beyond the rim
        beyond = np.arange(n) % 2 == 1
        most = min(8 / edge_mu, plate)
        radius = np.where(beyond, d / 2 + most * random[:, 3] ** 2, radius)
        area = 2 * np.where(beyond, 2 * math.pi * radius * 2 * random[:, 3] * most / n, area)
    angle = 2 * math.pi * random[:, 4]
    hole = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    slope = (start - hole) / height[:, None]
    secant = np.sqrt(1 + (slope**2).sum(-1))
    weight = area / (4 * math.pi * height**2 * secant**3)
    if edge_mu is not None:
        face, (x, y), (a, b) = min(plate / 2, 12 / edge_mu), hole[beyond].T, slope[beyond].T
        inside = np.zeros(len(x))
        for step in range(-_STEPS, _STEPS):
            z = (step + random[beyond, 5]) * (face / _STEPS)
            inside += (x - z * a) ** 2 + (y - z * b) ** 2 > (d / 2 + np.abs(z)) ** 2
        thick = np.array([inside * face / _STEPS, np.full(len(x), plate)]) * secant[beyond]
        weight[beyond] *= -np.diff(np.exp(-edge_mu * thick), axis=0)[0]
    depth = np.zeros(n)
    if crystal_mu is not None:
        stopped = -np.expm1(-crystal_mu * thickness * secant)
        weight *= stopped
        depth = -np.log1p(-random[:, 6] * stopped) / (crystal_mu * secant)
    place_u, place_v = (slope * (l + depth)[:, None] - hole).T
    edges = np.linspace(-side / 2, side / 2, pixels + 1)
    return np.histogram2d(place_v, place_u, [edges, edges], weights=weight)[0]


def misplaced(found, expected):
    """Return the sum of absolute differences, by all counts."""
    return np.abs(found - expected).sum() / expected.sum()


def in_blocks(image, n):
    """Return the image on pixels `n` times as wide."""
    rows, columns = image.shape
    return image.reshape(rows // n, n, columns // n, n).sum(axis=(1, 3))
