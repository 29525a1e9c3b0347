"""Least squares of modules' poses and of points, from where the modules see the points: SciPy's solver, a sparse Jacobian.

Reference: B. Triggs, P. McLauchlan, R. Hartley, A. Fitzgibbon, "Bundle adjustment: a modern synthesis", Vision Algorithms:
Theory and Practice, Lecture Notes in Computer Science 1883 (2000) 298-372; on gauges its section 9.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Floats
from ..geometry.frames import cross_matrix, rotations
from .solvers import scipy_module

_LOSS = 3.0  # standard deviations above which robust fits count a residual by its size, not its square


@dataclass(frozen=True)
class Bundle:
    """M modules that see K points, and what is measured of them."""

    centers: Floats  # (M, 3), world mm
    frames: Floats  # (M, 3, 3)
    length: Floats  # (M,), mm
    offset: Floats  # (M, 2), mm: how far the pixels lie from where the views have them, on the crystal, point-inverted
    points: Floats  # (K, 3), world mm
    sd: Floats  # (P,): the modules' numbers are so far from the nominal ones: places, turns, then length or offset or both
    fits_points: bool
    fits_length: bool
    places: Floats  # (K, M, 2), mm on the crystals: where the points are seen
    whitening: Floats  # (K, M, 2, 2): makes their errors ones of variance 1
    used: NDArray[np.bool_]  # (K, M)
    distances: tuple[NDArray[np.intp], Floats, float]  # pairs (D, 2) of points, their distances (D,) and SD, mm

    @property
    def n_modules(self) -> int:
        """How many numbers of modules are fitted."""
        return len(self.centers) * len(self.sd)

    def moved(self, x: Floats) -> Bundle:
        """The modules and points whose numbers have changed by x: of modules in units of `sd`, of points in mm."""
        of_modules = self.sd * x[: self.n_modules].reshape(len(self.centers), -1)
        centers = self.centers + np.einsum("mij,mi->mj", self.frames, of_modules[:, :3])
        turned = rotations(of_modules[:, 3:6]).swapaxes(1, 2) @ self.frames
        extra = of_modules[:, 6:]
        length = self.length + extra[:, 0] if self.fits_length else self.length
        offset = self.offset + extra[:, -2:] if extra.shape[1] > 1 else self.offset
        points = self.points + x[self.n_modules :].reshape(-1, 3) if self.fits_points else self.points
        return replace(self, centers=centers, frames=turned, length=length, offset=offset, points=points)

    def seen(self) -> Floats:
        """Where the modules see the points (K, M, 2), mm on the crystals."""
        local = np.einsum("mij,kmj->kmi", self.frames, self.points[:, None] - self.centers)
        return self.length[:, None] * local[..., :2] / local[..., 2:] + self.offset

    def residuals(self, x: Floats) -> Floats:
        """Those of the places, of the distances, and of the numbers that are thought to be about the nominal ones."""
        now = self.moved(x)
        off = np.einsum("nij,nj->ni", self.whitening[self.used], (now.seen() - self.places)[self.used])
        pairs, lengths, sd = self.distances
        apart = np.linalg.norm(now.points[pairs[:, 0]] - now.points[pairs[:, 1]], axis=1)
        return np.concatenate([off.ravel(), (apart - lengths) / sd, x[: self.n_modules]])

    def jacobian(self, x: Floats) -> Any:
        """The residuals' derivatives by x, a sparse matrix."""
        sparse = scipy_module("sparse")
        now = self.moved(x)
        turns = self.sd[3:6] * x[: self.n_modules].reshape(len(self.centers), -1)[:, 3:6]
        back = now.frames @ self.frames.swapaxes(1, 2)
        k, m = np.nonzero(self.used)
        local = np.einsum("nij,nj->ni", now.frames[m], now.points[k] - now.centers[m])
        height = local[:, 2]
        slopes = local[:, :2] / height[:, None]
        by_local = np.concatenate([np.broadcast_to(np.eye(2), (len(k), 2, 2)), -slopes[:, :, None]], axis=2)
        by_local *= (now.length[m] / height)[:, None, None]
        by_turn = cross_matrix(local) @ back[m] @ _left_jacobian(turns)[m]
        blocks = [-by_local @ back[m], by_local @ by_turn]
        if self.fits_length:
            blocks.append(slopes[:, :, None])
        if len(self.sd) > 7 or (len(self.sd) > 6 and not self.fits_length):
            blocks.append(np.broadcast_to(np.eye(2), (len(k), 2, 2)))
        values = self.sd * np.concatenate(blocks, axis=2)
        columns = m[:, None] * len(self.sd) + np.arange(len(self.sd))
        if self.fits_points:
            values = np.concatenate([values, by_local @ now.frames[m]], axis=2)
            columns = np.concatenate([columns, self.n_modules + 3 * k[:, None] + np.arange(3)], axis=1)
        values = self.whitening[self.used] @ values
        rows = np.broadcast_to(np.arange(2 * len(k)).reshape(-1, 2, 1), values.shape)
        columns = np.broadcast_to(columns[:, None], values.shape)
        size = len(x)
        of_places = sparse.csr_matrix((values.ravel(), (rows.ravel(), columns.ravel())), (2 * len(k), size))
        return sparse.vstack([of_places, self._of_distances(now.points, size), sparse.eye(self.n_modules, size)], "csr")

    def _of_distances(self, points: Floats, size: int) -> Any:
        pairs, _, sd = self.distances
        between = points[pairs[:, 0]] - points[pairs[:, 1]]
        slopes = between / np.linalg.norm(between, axis=1, keepdims=True) / sd
        columns = self.n_modules + 3 * pairs[:, :, None] + np.arange(3)
        values = np.stack([slopes, -slopes], axis=1)
        rows = np.broadcast_to(np.arange(len(pairs))[:, None, None], columns.shape)
        return scipy_module("sparse").csr_matrix((values.ravel(), (rows.ravel(), columns.ravel())), (len(pairs), size))

    def start(self) -> Floats:
        """All numbers as they are."""
        return np.zeros(self.n_modules + 3 * len(self.points) * self.fits_points)

    def solved(self, x: Floats, robust: bool = False) -> Floats:
        """The numbers with the least sum of squares, or, `robust`, with one that large residuals hardly move."""
        found = scipy_module("optimize").least_squares(
            self.residuals, x, self.jacobian, method="trf", tr_solver="lsmr", loss="soft_l1" if robust else "linear",
            f_scale=_LOSS if robust else 1.0, xtol=1e-10, ftol=1e-10, gtol=1e-10, max_nfev=100,
            tr_options={"atol": 1e-12, "btol": 1e-12, "maxiter": 5000, "regularize": False},
        )  # fmt: skip
        return np.asarray(found.x)

    def covariance(self, x: Floats) -> tuple[Floats, Floats]:
        """That of all numbers at x, in mm and rad of the modules as they are then; and the residuals' leverages (K, M)."""
        J = self.jacobian(x)
        C = np.linalg.inv((J.T @ J).toarray())
        n = 2 * int(self.used.sum())
        leverages = np.zeros(self.used.shape)
        leverages[self.used] = np.asarray(J[:n].multiply(J[:n] @ C).sum(axis=1)).reshape(-1, 2).sum(axis=1)
        # From turns and shifts along the nominal axes to those along the modules' axes now.
        n_m, n_p = len(self.centers), len(self.sd)
        turns = self.sd[3:6] * x[: self.n_modules].reshape(n_m, n_p)[:, 3:6]
        back = rotations(turns).swapaxes(1, 2)
        T = np.broadcast_to(np.eye(n_p), (n_m, n_p, n_p)).copy()
        T[:, :3, :3], T[:, 3:6, 3:6] = back, back @ _left_jacobian(turns)
        return changed(C, T * self.sd), leverages


def changed(covariance: Floats, blocks: Floats) -> Floats:
    """The covariance of all numbers after those of each module are multiplied by its matrix in `blocks` (M, P, P)."""
    n_m, n_p, _ = blocks.shape
    size = n_m * n_p
    rest = len(covariance) - size

    def rows(matrix: Floats) -> Floats:
        of_modules = blocks @ matrix[:size].reshape(n_m, n_p, -1)
        return np.concatenate([of_modules.reshape(size, -1), matrix[size:]]) if rest else of_modules.reshape(size, -1)

    return rows(rows(covariance).T)


def _left_jacobian(turns: Floats) -> Floats:
    """Matrices (M, 3, 3) from small changes of rotation vectors (M, 3) to the rotations that come after them, rad."""
    angle, cross = np.linalg.norm(turns, axis=1)[:, None, None], cross_matrix(turns)
    cubic = np.where(angle > 1e-4, (1 - np.sinc(angle / np.pi)) / np.maximum(angle, 1e-4) ** 2, 1 / 6)
    return np.eye(3) + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * cross + cubic * (cross @ cross)
