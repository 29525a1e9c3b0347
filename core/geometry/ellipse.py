"""Ellipses around the isocentre, in the plane z = 0: points at azimuths, distances, and the least-squares fit."""

import math
from dataclasses import dataclass

import numpy as np

from ..arrays import Floats

_ITERATIONS = 100
# An ellipse has five parameters, so five points or fewer say nothing about how well it fits.
_FEWEST_POINTS = 6


@dataclass(frozen=True, eq=False)
class Ellipse:
    """An ellipse: semi-axes (2,) and center (2,), mm, and the angle from x to the first axis, rad."""

    semi_axes: Floats
    center: Floats
    rotation: float

    @property
    def axes(self) -> Floats:
        """Unit vectors (2, 2) along its axes, as columns."""
        cosine, sine = math.cos(self.rotation), math.sin(self.rotation)
        return np.array([[cosine, -sine], [sine, cosine]])

    @property
    def holds_isocentre(self) -> bool:
        """Whether the isocentre is inside."""
        return bool(np.linalg.norm(self.center @ self.axes / self.semi_axes) < 1)

    def at(self, azimuths: Floats) -> Floats:
        """The points (..., 2), mm, where rays from the isocentre at `azimuths` cross it."""
        rays = np.stack([np.cos(azimuths), np.sin(azimuths)], axis=-1)
        # In units of the semi-axes it is a circle: |r ray - center| = 1.
        ray, center = rays @ self.axes / self.semi_axes, self.center @ self.axes / self.semi_axes
        squared, along = (ray**2).sum(axis=-1), ray @ center
        distance = (along + np.sqrt(along**2 + squared * (1 - center @ center))) / squared
        return distance[..., None] * rays

    def distances(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Signed distances (N,), mm, of points from it; normals (N, 2) and eccentric angles (N,) of the nearest points."""
        local = (points - self.center) @ self.axes
        a, b = self.semi_axes
        angle = np.arctan2(local[:, 1] / b, local[:, 0] / a)
        for _ in range(_ITERATIONS):  # Newton's method: the line to the nearest point is normal to the ellipse
            x, y = a * np.cos(angle), b * np.sin(angle)
            off_x, off_y = x - local[:, 0], y - local[:, 1]
            slope = a * a * np.sin(angle) ** 2 + b * b * np.cos(angle) ** 2
            step = (-off_x * y * a / b + off_y * x * b / a) / np.maximum(slope - off_x * x - off_y * y, 0.1 * slope)
            angle = angle - step
            if np.abs(step).max() < 1e-14:
                break
        closest = np.stack([a * np.cos(angle), b * np.sin(angle)], axis=1)
        normals = np.stack([np.cos(angle) / a, np.sin(angle) / b], axis=1)
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        return ((local - closest) * normals).sum(axis=1), normals @ self.axes.T, angle


def fit_ellipse(points: Floats) -> Ellipse | None:
    """The ellipse with the least squared distances from `points` (N, 2), by Gauss and Newton's method.

    It starts from the direct fit of R. Halir and J. Flusser, "Numerically stable direct least squares fitting of ellipses",
    Proc. WSCG (1998) 125-132. None for fewer than 6 points, and where the ellipse does not hold the isocentre.
    """
    ellipse = _direct_fit(points) if len(points) >= _FEWEST_POINTS else None
    if ellipse is None:
        return None
    for _ in range(_ITERATIONS):
        distance, normal, angle = ellipse.distances(points)
        on_circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        arm = on_circle * ellipse.semi_axes @ ellipse.axes.T  # from the centre to the nearest points
        by_rotation = normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]
        columns = [*(normal @ ellipse.axes * on_circle).T, *normal.T, by_rotation]
        step, *_ = np.linalg.lstsq(np.stack(columns, axis=1), distance, rcond=1e-9)
        better = Ellipse(ellipse.semi_axes + step[:2], ellipse.center + step[2:4], ellipse.rotation + float(step[4]))
        if np.any(better.semi_axes <= 0) or not (better.distances(points)[0] ** 2).sum() < (distance**2).sum():
            break
        ellipse = better
    quarters = round(ellipse.rotation / (math.pi / 2))
    axes = ellipse.semi_axes[::-1] if quarters % 2 else ellipse.semi_axes
    ellipse = Ellipse(axes, ellipse.center, ellipse.rotation - quarters * math.pi / 2)
    return ellipse if ellipse.holds_isocentre else None


def _direct_fit(points: Floats) -> Ellipse | None:
    """Halir and Flusser's fit: the least algebraic distance among the conics that are ellipses."""
    middle = points.mean(axis=0)
    size = float(np.abs(points - middle).max())
    x, y = (points - middle).T / size
    quadratic, linear = np.stack([x * x, x * y, y * y], axis=1), np.stack([x, y, np.ones_like(x)], axis=1)
    try:
        reduction = -np.linalg.solve(linear.T @ linear, linear.T @ quadratic)
        scatter = quadratic.T @ (quadratic + linear @ reduction)
        _, vectors = np.linalg.eig(np.stack([scatter[2] / 2, -scatter[1], scatter[0] / 2]))
    except np.linalg.LinAlgError:  # all on one line
        return None
    vectors = vectors.real
    is_ellipse = 4 * vectors[0] * vectors[2] - vectors[1] ** 2
    best = vectors[:, int(np.argmax(is_ellipse))]
    if is_ellipse.max() <= 0:
        return None
    matrix = np.array([[best[0], best[1] / 2], [best[1] / 2, best[2]]])
    gradient = reduction @ best
    center = -np.linalg.solve(2 * matrix, gradient[:2])
    values, axes = np.linalg.eigh(matrix)
    squares = -(gradient[2] + gradient[:2] @ center / 2) / values
    if not np.all(squares > 0):
        return None
    rotation = math.atan2(axes[1, 0], axes[0, 0]) if np.ptp(squares) > 1e-12 * squares.max() else 0.0
    return Ellipse(size * np.sqrt(squares), middle + size * center, rotation)
