"""Closed meshes of shapes."""

import numpy as np
from numpy.typing import NDArray

from ..arrays import Floats

Surface = tuple[Floats, NDArray[np.int32]]
"""Vertices (V, 3), mm, and triangles (F, 3), counter-clockwise as seen from outside."""


def lathe(radii: Floats, heights: Floats, a: float, b: float, n_sides: int = 64) -> Surface:
    """A profile turned about z in `n_sides` sides, stretched by `a` along x and by `b` along y.

    The profile's `radii` and `heights` (n,) run from bottom to top and begin and end on the axis.
    """
    angle = 2 * np.pi * (np.arange(n_sides) + 0.5) / n_sides
    circle = np.stack([a * np.cos(angle), b * np.sin(angle)], axis=1)
    sides = (radii[1:-1, None, None] * circle).reshape(-1, 2)
    sides = np.column_stack([sides, np.repeat(heights[1:-1], n_sides)])
    vertices = np.concatenate([[(0, 0, heights[0])], sides, [(0, 0, heights[-1])]])
    # Rings of vertices, of which the first and the last are a single one: there one of a quad's two triangles is empty.
    rings = np.arange(1 - n_sides, len(sides) + n_sides + 1).reshape(-1, n_sides).clip(0, len(sides) + 1)
    following = np.roll(rings, -1, axis=1)
    quads = np.stack([rings[:-1], following[:-1], following[1:], rings[1:]], axis=-1)
    faces = quads[..., [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return vertices, faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)].astype(np.int32)


def clipped(surface: Surface, normal: Floats, offset: float) -> Surface:
    """The part of a closed convex `surface` at ``normal . x <= offset``, closed by a fan around the middle of the cut."""
    vertices, faces = surface
    height = vertices @ normal - offset
    # A vertex in the plane would give slivers without area.
    height = np.where(np.abs(height) < 1e-9 * np.abs(vertices).max(), -1e-9 * np.abs(vertices).max(), height)
    below = (height <= 0)[faces]
    kept = below.sum(axis=1)
    cut = (kept == 1) | (kept == 2)
    if not cut.any():
        return vertices, faces[kept == 3]
    # Turned so that the corner that lies alone on its side comes first; the plane crosses the edges from there.
    alone = np.argmax(below[cut] == (kept[cut] == 1)[:, None], axis=1)
    a, b, c = np.take_along_axis(faces[cut], (alone[:, None] + np.arange(3)) % 3, axis=1).T
    edges = np.sort(np.concatenate([np.stack([a, b], axis=1), np.stack([a, c], axis=1)]), axis=1)
    edges, place = np.unique(edges, axis=0, return_inverse=True)
    first, last = edges.T
    share = height[first] / (height[first] - height[last])
    crossings = vertices[first] + share[:, None] * (vertices[last] - vertices[first])
    points = np.concatenate([vertices, crossings, crossings.mean(axis=0, keepdims=True)])
    to_b, to_c = len(vertices) + place.reshape(2, -1)
    middle = np.full_like(a, len(points) - 1)
    one, two = kept[cut] == 1, kept[cut] == 2
    triangles = np.concatenate(
        [
            faces[kept == 3],
            *(np.stack(corners, axis=1)[one] for corners in ((a, to_b, to_c), (middle, to_c, to_b))),
            *(np.stack(corners, axis=1)[two] for corners in ((to_b, b, c), (to_b, c, to_c), (middle, to_b, to_c))),
        ]
    )
    used, corners = np.unique(triangles, return_inverse=True)
    return points[used], corners.reshape(-1, 3).astype(np.int32)
