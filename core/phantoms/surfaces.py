"""Closed meshes of shapes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Surface = tuple[NDArray[np.float64], NDArray[np.int32]]
"""Vertices (V, 3), mm, and triangles (F, 3), counter-clockwise as seen from outside."""


def lathe(radii: NDArray[np.float64], heights: NDArray[np.float64], a: float, b: float, n_sides: int = 64) -> Surface:
    """A profile turned about z in `n_sides` sides, stretched by `a` along x and by `b` along y.

    The profile's `radii` and `heights` (n,) run from bottom to top and begin and end on the axis.
    """
    angle = 2 * np.pi * (np.arange(n_sides) + 0.5) / n_sides
    circle = np.stack([a * np.cos(angle), b * np.sin(angle)], axis=1)
    rings = len(radii) - 2
    vertices = np.empty((rings * n_sides + 2, 3))
    vertices[1:-1, :2] = (radii[1:-1, None, None] * circle).reshape(-1, 2)
    vertices[1:-1, 2] = np.repeat(heights[1:-1], n_sides)
    vertices[0], vertices[-1] = (0, 0, heights[0]), (0, 0, heights[-1])
    here, following = np.arange(n_sides), np.roll(np.arange(n_sides), -1)
    bottom = np.stack([np.zeros_like(here), 1 + following, 1 + here], axis=1)
    last = 1 + (rings - 1) * n_sides
    top = np.stack([np.full_like(here, len(vertices) - 1), last + here, last + following], axis=1)
    faces = [bottom]
    for ring in range(rings - 1):
        low, high = 1 + ring * n_sides, 1 + (ring + 1) * n_sides
        faces.append(np.stack([low + here, low + following, high + following], axis=1))
        faces.append(np.stack([low + here, high + following, high + here], axis=1))
    return vertices, np.concatenate([*faces, top]).astype(np.int32)


def clipped(surface: Surface, normal: NDArray[np.float64], offset: float) -> Surface:
    """The part of a closed convex `surface` at ``normal . x <= offset``, closed by a fan around the middle of the cut."""
    vertices, faces = surface
    height = vertices @ normal - offset
    # A vertex in the plane would give slivers without area.
    height = np.where(np.abs(height) < 1e-9 * np.abs(vertices).max(), -1e-9 * np.abs(vertices).max(), height)
    if (height <= 0).all():
        return surface
    points, made = list(vertices), {}

    def crossing(i: int, j: int) -> int:
        key = (min(i, j), max(i, j))
        if key not in made:
            share = height[key[0]] / (height[key[0]] - height[key[1]])
            made[key] = len(points)
            points.append(vertices[key[0]] + share * (vertices[key[1]] - vertices[key[0]]))
        return made[key]

    kept = (height[faces] <= 0).sum(axis=1)
    triangles = [tuple(face) for face in faces[kept == 3]]
    rim = []
    for face in faces[(kept == 1) | (kept == 2)]:
        polygon, cut = [], {}
        for i, j in zip(face, np.roll(face, -1), strict=True):
            if height[i] <= 0:
                polygon.append(i)
            if (height[i] <= 0) != (height[j] <= 0):
                cut["leave" if height[i] <= 0 else "enter"] = crossing(i, j)
                polygon.append(crossing(i, j))
        triangles += [(polygon[0], polygon[k], polygon[k + 1]) for k in range(1, len(polygon) - 1)]
        rim.append((cut["enter"], cut["leave"]))
    if rim:
        points.append(np.mean([points[i] for i, _ in rim], axis=0))
        # The face's own edge runs from `leave` to `enter`: the lid's runs the other way.
        triangles += [(len(points) - 1, enter, leave) for enter, leave in rim]
    used, corners = np.unique(np.array(triangles, np.int32).reshape(-1, 3), return_inverse=True)
    return np.array(points)[used], corners.reshape(-1, 3).astype(np.int32)
