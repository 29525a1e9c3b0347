"""Intersections of lines with simple solids, and the distance of points from an ellipse.

A line is ``starts + t directions``, both (n, N) for N lines in n dimensions. An interval is the two values of t at which a
line enters and leaves the solid; the entry is ``>=`` the exit where the line misses it.
"""

import numpy as np

from ..arrays import Array, Floats

Interval = tuple[Floats, Floats]
"""Values of t, (1, N) each or (m, N) for m parts, at which lines enter and leave a solid."""


def ball_interval(starts: Floats, directions: Floats) -> Interval:
    """Return the interval of t inside the unit ball of n dimensions, for lines (n, N)."""
    a = np.einsum("in,in->n", directions, directions)
    b = np.einsum("in,in->n", starts, directions)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # Solved around the line's point closest to the centre, so that no large squares cancel.
        t_closest = -b / a
        closest = starts + directions * t_closest
        half = np.sqrt((1.0 - np.einsum("in,in->n", closest, closest)) / a)
        enter, leave = t_closest - half, t_closest + half
    no_root = np.isnan(enter)
    if no_root.any():
        # The line misses the ball, or its direction is 0 in these dimensions and all of it lies inside or outside.
        fixed_inside = no_root & (a == 0) & (np.einsum("in,in->n", starts, starts) < 1)
        enter[no_root], leave[no_root] = np.inf, -np.inf
        enter[fixed_inside], leave[fixed_inside] = -np.inf, np.inf
    return enter[None], leave[None]


def slab_interval(start: Floats, direction: Floats, half: float) -> Interval:
    """Return the interval of t in which one coordinate (N,) of the lines is between -half and half."""
    return intersect(side_interval(-start - half, -direction), side_interval(start - half, direction))


def side_interval(start: Floats, direction: Floats) -> Interval:
    """Return the interval of t in which ``start + t direction <= 0``, (N,) each."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        crossing = -start / direction
    enter = np.where(direction < 0, crossing, np.where((direction > 0) | (start <= 0), -np.inf, np.inf))
    leave = np.where(direction > 0, crossing, np.where((direction < 0) | (start <= 0), np.inf, -np.inf))
    return enter[None], leave[None]


def intersect(a: Interval, b: Interval) -> Interval:
    """Return the intersection of two intervals: the later entry and the earlier exit."""
    return np.maximum(a[0], b[0]), np.minimum(a[1], b[1])


def cone_interval(starts: Floats, directions: Floats, radius: float, slope: float, half: float) -> Interval:
    """Return the interval of t inside the cone ``x^2 + y^2 <= (radius + slope z)^2``, ``-half <= z <= half``."""
    # Within the height the quadric x^2 + y^2 <= (radius + slope z)^2 is convex: a line is inside between its two roots,
    # beyond them, or on one side of a single root. The line is cut to the height first, which excludes the other half of
    # the double cone. Infinite ends become finite, because the mean of two ends is needed.
    first, last = (np.clip(end, -1e30, 1e30) for end in slab_interval(starts[2], directions[2], half))
    r, dr = radius + slope * starts[2], slope * directions[2]
    a = directions[0] ** 2 + directions[1] ** 2 - dr**2
    b = starts[0] * directions[0] + starts[1] * directions[1] - r * dr
    c = starts[0] ** 2 + starts[1] ** 2 - r**2
    root = np.sqrt(np.maximum(b**2 - a * c, 0.0))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # Both roots without cancellation; where a is 0, one of them is at infinity. Where the quadric has no roots, these
        # numbers split the line anywhere: only the sign in the middle of each piece decides.
        q = -(b + np.copysign(root, b))
        roots = np.sort(np.nan_to_num(np.stack([q / a, c / q]), nan=np.inf, posinf=np.inf, neginf=-np.inf), axis=0)
    edges = np.sort(np.clip(np.concatenate([first, roots, last]), first, last), axis=0)
    center = (edges[:-1] + edges[1:]) / 2
    inside = ((a * center + 2 * b) * center + c < 0) & (edges[1:] > edges[:-1])
    enter = np.where(inside, edges[:-1], np.inf).min(axis=0)
    leave = np.where(inside, edges[1:], -np.inf).max(axis=0)
    return enter[None], leave[None]


def ellipse_distance(points: Array, radii: tuple[float, ...]) -> Array:
    """Return a lower bound (N,) of the signed distance of `points` (n, N) from an ellipse or ellipsoid, negative inside.

    The bound is exact to first order near the surface. With k(x) = |x / radii| and g = |x / radii^2|: k is convex, so that
    outside the distance is at least (k - 1) / |grad k| = (k - 1) k / g; a step h changes k^2 by at most 2 g h + h^2 / r^2,
    where r is the smallest radius, which gives the bound inside.
    """
    inverse = (1 / np.array(radii)).astype(points.dtype)[:, None]
    scaled = points * inverse
    k2 = np.einsum("in,in->n", scaled, scaled)
    scaled *= inverse
    g = np.sqrt(np.einsum("in,in->n", scaled, scaled))
    depth = 1 - k2
    inside = depth / (g + np.sqrt(g * g + np.maximum(depth, 0) * inverse.max() ** 2))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        outside = (k2 - np.sqrt(k2)) / g
    return np.where(depth > 0, -inside, outside)
