"""Where lines ``starts + t directions`` are inside simple solids, and how far points are from an ellipse.

Points and directions are (n, N); intervals are two arrays (1, N), from and to which t, with from ``>=`` to where a line
misses.
"""

import numpy as np

from ..arrays import Array, Floats

Real = Array
Points = Floats
Interval = tuple[Points, Points]


def in_unit_ball(starts: Points, directions: Points) -> Interval:
    """Inside the unit ball of n dimensions."""
    a = np.einsum("in,in->n", directions, directions)
    b = np.einsum("in,in->n", starts, directions)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # From the line's point nearest to the middle: no cancellation of large squares.
        nearest = -b / a
        miss = starts + directions * nearest
        half = np.sqrt((1.0 - np.einsum("in,in->n", miss, miss)) / a)
        enter, leave = nearest - half, nearest + half
    never = np.isnan(enter)
    if never.any():  # the line misses, or it is a point seen along the axis: all in or all out
        still = never & (a == 0) & (np.einsum("in,in->n", starts, starts) < 1)
        enter[never], leave[never] = np.inf, -np.inf
        enter[still], leave[still] = -np.inf, np.inf
    return enter[None], leave[None]


def between(start: Points, direction: Points, half: float) -> Interval:
    """Between -half and half of one coordinate (N,)."""
    return common(below(-start - half, -direction), below(start - half, direction))


def below(start: Points, direction: Points) -> Interval:
    """Where ``start + t direction <= 0``, (N,) each."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        crossing = -start / direction
    enter = np.where(direction < 0, crossing, np.where((direction > 0) | (start <= 0), -np.inf, np.inf))
    leave = np.where(direction > 0, crossing, np.where((direction < 0) | (start <= 0), np.inf, -np.inf))
    return enter[None], leave[None]


def common(one: Interval, other: Interval) -> Interval:
    """The intersection of two intervals."""
    return np.maximum(one[0], other[0]), np.minimum(one[1], other[1])


def in_cone(starts: Points, directions: Points, middle: float, slope: float, half: float) -> Interval:
    """Inside a cone of radius ``middle + slope z`` between ``z = -half`` and ``half``."""
    # Within the height the quadric x^2 + y^2 <= (middle + slope z)^2 is convex: a line is inside between two roots, beyond
    # them, or on one side of one. Cut to the height first, so that the other half of the double cone is no part.
    # Finite in place of infinity: the mean of two ends is wanted.
    first, last = (np.clip(end, -1e30, 1e30) for end in between(starts[2], directions[2], half))
    r, dr = middle + slope * starts[2], slope * directions[2]
    a = directions[0] ** 2 + directions[1] ** 2 - dr**2
    b = starts[0] * directions[0] + starts[1] * directions[1] - r * dr
    c = starts[0] ** 2 + starts[1] ** 2 - r**2
    root = np.sqrt(np.maximum(b**2 - a * c, 0.0))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # Both roots without cancellation; where a is 0 one of them is at infinity. Where there are none, these numbers
        # split the line anywhere: what counts is the sign in the middle of each piece.
        q = -(b + np.copysign(root, b))
        roots = np.sort(np.nan_to_num(np.stack([q / a, c / q]), nan=np.inf, posinf=np.inf, neginf=-np.inf), axis=0)
    edges = np.sort(np.clip(np.concatenate([first, roots, last]), first, last), axis=0)
    center = (edges[:-1] + edges[1:]) / 2
    inside = ((a * center + 2 * b) * center + c < 0) & (edges[1:] > edges[:-1])
    enter = np.where(inside, edges[:-1], np.inf).min(axis=0)
    leave = np.where(inside, edges[1:], -np.inf).max(axis=0)
    return enter[None], leave[None]


def ellipse_distance(points: Real, radii: tuple[float, ...]) -> Real:
    """Lower bound of the distance (N,) of `points` (n, N) from an ellipse or ellipsoid, exact to first order near it.

    With k(x) = |x / radii| and g = |x / radii^2|: k is convex, so that outside the distance is at least
    (k - 1) / |grad k| = (k - 1) k / g; a step h changes k^2 by at most 2 g h + h^2 / r^2, r being the smallest radius.
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
