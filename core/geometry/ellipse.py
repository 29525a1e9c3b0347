"""Ellipses around the isocentre, in the plane z = 0: points at azimuths, distances of points, and the least-squares fit."""

import math
from dataclasses import dataclass

import numpy as np

from ..arrays import Floats

_ITERATIONS = 100
# An ellipse has five parameters, so the residuals of five points or fewer do not tell how well it fits.
_MIN_POINTS = 6


@dataclass(frozen=True, eq=False)
class Ellipse:
    """Ellipse in the plane z = 0."""

    semi_axes: Floats  # (2,), mm
    center: Floats  # (2,), mm from the isocentre
    rotation: float  # angle from x to the first axis, rad

    @property
    def axes(self) -> Floats:
        """Unit vectors (2, 2) along the ellipse's axes, as columns."""
        cosine, sine = math.cos(self.rotation), math.sin(self.rotation)
        return np.array([[cosine, -sine], [sine, cosine]])

    @property
    def holds_isocentre(self) -> bool:
        """Whether the isocentre is inside the ellipse."""
        return bool(np.linalg.norm(self.center @ self.axes / self.semi_axes) < 1)

    def points_at(self, azimuths: Floats) -> Floats:
        """Return the points (..., 2), mm, where rays from the isocentre at `azimuths` (...), rad, cross the ellipse."""
        rays = np.stack([np.cos(azimuths), np.sin(azimuths)], axis=-1)
        # In units of the semi-axes the ellipse is a circle: |r ray - center| = 1.
        ray, center = rays @ self.axes / self.semi_axes, self.center @ self.axes / self.semi_axes
        squared, along = (ray**2).sum(axis=-1), ray @ center
        distance = (along + np.sqrt(along**2 + squared * (1 - center @ center))) / squared
        return distance[..., None] * rays

    def distances(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the signed distances (N,) of `points` (N, 2) from the ellipse, mm, positive outside.

        Further results are the normals (N, 2) and the eccentric angles (N,), rad, at the nearest points of the ellipse.
        """
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
    """Return the ellipse with the least sum of squared distances from `points` (N, 2), mm, by the Gauss-Newton method.

    The start is the direct fit of R. Halir and J. Flusser, "Numerically stable direct least squares fitting of ellipses",
    Proc. WSCG (1998) 125-132. Returns None for fewer than 6 points, and if the ellipse does not hold the isocentre.
    """
    ellipse = _direct_fit(points) if len(points) >= _MIN_POINTS else None
    if ellipse is None:
        return None
    for _ in range(_ITERATIONS):
        distance, normal, angle = ellipse.distances(points)
        on_circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        arm = on_circle * ellipse.semi_axes @ ellipse.axes.T  # from the centre to the nearest points
        d_rotation = normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]
        jacobian = [*(normal @ ellipse.axes * on_circle).T, *normal.T, d_rotation]
        step, *_ = np.linalg.lstsq(np.stack(jacobian, axis=1), distance, rcond=1e-9)
        improved = Ellipse(ellipse.semi_axes + step[:2], ellipse.center + step[2:4], ellipse.rotation + float(step[4]))
        if np.any(improved.semi_axes <= 0) or not (improved.distances(points)[0] ** 2).sum() < (distance**2).sum():
            break
        ellipse = improved
    # The rotation is brought within 45 degrees by exchanging the axes.
    quarters = round(ellipse.rotation / (math.pi / 2))
    axes = ellipse.semi_axes[::-1] if quarters % 2 else ellipse.semi_axes
    ellipse = Ellipse(axes, ellipse.center, ellipse.rotation - quarters * math.pi / 2)
    return ellipse if ellipse.holds_isocentre else None


def _direct_fit(points: Floats) -> Ellipse | None:
    """Return the ellipse of least algebraic distance from `points` (N, 2) by Halir and Flusser's method; None without one.

    A conic is ``a x^2 + b x y + c y^2 + d x + e y + f = 0``; it is an ellipse if ``4 a c - b^2 > 0``.
    """
    centroid = points.mean(axis=0)
    size = float(np.abs(points - centroid).max())
    x, y = (points - centroid).T / size
    quadratic, linear = np.stack([x * x, x * y, y * y], axis=1), np.stack([x, y, np.ones_like(x)], axis=1)
    try:
        reduction = -np.linalg.solve(linear.T @ linear, linear.T @ quadratic)
        scatter = quadratic.T @ (quadratic + linear @ reduction)
        _, vectors = np.linalg.eig(np.stack([scatter[2] / 2, -scatter[1], scatter[0] / 2]))
    except np.linalg.LinAlgError:  # all points on one line
        return None
    vectors = vectors.real
    discriminants = 4 * vectors[0] * vectors[2] - vectors[1] ** 2
    a_b_c = vectors[:, int(np.argmax(discriminants))]
    if discriminants.max() <= 0:
        return None
    matrix = np.array([[a_b_c[0], a_b_c[1] / 2], [a_b_c[1] / 2, a_b_c[2]]])
    d_e_f = reduction @ a_b_c
    center = -np.linalg.solve(2 * matrix, d_e_f[:2])
    eigenvalues, axes = np.linalg.eigh(matrix)
    squares = -(d_e_f[2] + d_e_f[:2] @ center / 2) / eigenvalues  # squared semi-axes
    if not np.all(squares > 0):
        return None
    rotation = math.atan2(axes[1, 0], axes[0, 0]) if np.ptp(squares) > 1e-12 * squares.max() else 0.0
    return Ellipse(size * np.sqrt(squares), centroid + size * center, rotation)
