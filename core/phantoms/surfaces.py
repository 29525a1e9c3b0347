"""Closed triangle meshes of shapes: surfaces of revolution, and their cuts by planes."""

import numpy as np
from numpy.typing import NDArray

from ..arrays import Floats

Surface = tuple[Floats, NDArray[np.int32]]
"""Vertices (V, 3), mm, and triangles (F, 3), counter-clockwise as seen from outside."""


def revolve_profile(radii: Floats, heights: Floats, a: float, b: float, n_sides: int = 64) -> Surface:
    """Return the mesh of a profile revolved about z in `n_sides` sides, stretched by `a` along x and by `b` along y.

    `radii` and `heights` (n,) of the profile run from bottom to top; its first and last point lie on the axis.
    """
    angle = 2 * np.pi * (np.arange(n_sides) + 0.5) / n_sides
    circle = np.stack([a * np.cos(angle), b * np.sin(angle)], axis=1)
    sides = (radii[1:-1, None, None] * circle).reshape(-1, 2)
    sides = np.column_stack([sides, np.repeat(heights[1:-1], n_sides)])
    vertices = np.concatenate([[(0, 0, heights[0])], sides, [(0, 0, heights[-1])]])
    # Rings of vertex numbers. The first and the last ring are a single vertex, where one of a quad's two triangles is empty.
    rings = np.arange(1 - n_sides, len(sides) + n_sides + 1).reshape(-1, n_sides).clip(0, len(sides) + 1)
    next_rings = np.roll(rings, -1, axis=1)
    quads = np.stack([rings[:-1], next_rings[:-1], next_rings[1:], rings[1:]], axis=-1)
    faces = quads[..., [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return vertices, faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)].astype(np.int32)


def clip_surface(surface: Surface, normal: Floats, offset: float) -> Surface:
    """Return the part of a closed convex `surface` with ``normal . x <= offset``, mm, as a closed mesh.

    The cut is closed by a fan of triangles around the mean of its corners.
    """
    vertices, faces = surface
    height = vertices @ normal - offset
    # A vertex in the plane would give slivers without area: it is moved just below.
    height = np.where(np.abs(height) < 1e-9 * np.abs(vertices).max(), -1e-9 * np.abs(vertices).max(), height)
    below = (height <= 0)[faces]
    n_below = below.sum(axis=1)
    is_cut = (n_below == 1) | (n_below == 2)
    if not is_cut.any():
        return vertices, faces[n_below == 3]
    # The corners a, b, c of cut triangles are rotated so that a lies alone on its side: the plane crosses ab and ac.
    lone_corner = np.argmax(below[is_cut] == (n_below[is_cut] == 1)[:, None], axis=1)
    a, b, c = np.take_along_axis(faces[is_cut], (lone_corner[:, None] + np.arange(3)) % 3, axis=1).T
    edges = np.sort(np.concatenate([np.stack([a, b], axis=1), np.stack([a, c], axis=1)]), axis=1)
    edges, edge_index = np.unique(edges, axis=0, return_inverse=True)
    first, last = edges.T
    fraction = height[first] / (height[first] - height[last])
    crossings = vertices[first] + fraction[:, None] * (vertices[last] - vertices[first])
    points = np.concatenate([vertices, crossings, crossings.mean(axis=0, keepdims=True)])
    ab, ac = len(vertices) + edge_index.reshape(2, -1)
    center = np.full_like(a, len(points) - 1)
    one_below, two_below = n_below[is_cut] == 1, n_below[is_cut] == 2
    triangles = np.concatenate(
        [
            faces[n_below == 3],
            *(np.stack(corners, axis=1)[one_below] for corners in ((a, ab, ac), (center, ac, ab))),
            *(np.stack(corners, axis=1)[two_below] for corners in ((ab, b, c), (ab, c, ac), (center, ab, ac))),
        ]
    )
    used, corners = np.unique(triangles, return_inverse=True)
    return points[used], corners.reshape(-1, 3).astype(np.int32)
