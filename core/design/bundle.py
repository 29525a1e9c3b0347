"""Least squares of modules' places and tilts, and of points, from where the modules see the points.

Reference: B. Triggs, P. McLauchlan, R. Hartley, A. Fitzgibbon, "Bundle adjustment: a modern synthesis", Vision Algorithms:
Theory and Practice, Lecture Notes in Computer Science 1883 (2000) 298-372; on gauges its section 9.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Bools, Floats, Indexes
from ..geometry.frames import cross_matrix, module_frames, rotations
from ..geometry.system import PinholeSystem
from .solvers import scipy_module

LENGTH, OFFSET = "collimator_length", "detector_offset"
FARTHEST = 6.0  # standard deviations that a module's numbers may be from the nominal ones
_LOSSES = (300.0, 30.0, 3.0)
"""Standard deviations above which robust fits count residuals by their size, one after the other."""
_GAUGE_SD = 5e-3  # mm that the pinholes, as a whole, may be away from the nominal ones


class Moved(NamedTuple):
    """Modules and points somewhere."""

    centers: Floats  # (M, 3), world mm
    tilt: Floats  # (M, 3), rad
    aimed: Floats  # (M, 3, 3): the frames without tilt
    frames: Floats  # (M, 3, 3)
    length: Floats  # (M,), mm
    offset: Floats  # (M, 2), mm along u and v: how far pixels lie from where the views have them on the crystal
    points: Floats  # (K, 3), world mm

    def seen(self) -> Floats:
        """Where the modules see the points (K, M, 2), mm on the crystals, point-inverted."""
        local = np.einsum("mij,kmj->kmi", self.frames, self.points[:, None] - self.centers)
        return self.length[:, None] * local[..., :2] / local[..., 2:] + self.offset


@dataclass(frozen=True)
class Bundle:
    """M modules that see K points.

    The numbers x are of each module its shift along its nominal u, v and k, the change of its tilt, and those of its length
    and its offset where these are fitted, in units of `sd`; then the points' shifts, mm.
    """

    system: PinholeSystem  # nominal
    points: Floats  # (K, 3), world mm: known, or where the fit begins
    fits_points: bool
    fit: tuple[str, ...]
    sd: Floats  # (P,), mm and rad: how far a module's numbers may be from the nominal ones
    places: Floats  # (K, M, 2), mm on the crystals: where the points are seen
    whitening: Floats  # (K, M, 2, 2): makes their errors ones of variance 1
    used: Bools  # (K, M)
    pairs: Indexes  # (D, 2): points whose distance is known
    distances: Floats  # (D,), mm
    distance_sd: float

    def start(self) -> Floats:
        """The nominal numbers."""
        return np.zeros(len(self.sd) * len(self.system) + 3 * len(self.points) * self.fits_points)

    def of_modules(self, x: Floats) -> Floats:
        """The modules' numbers (M, P) in x."""
        return x[: len(self.sd) * len(self.system)].reshape(len(self.system), -1)

    def moved(self, x: Floats) -> Moved:
        """Modules and points with the numbers x."""
        own = self.sd * self.of_modules(x)
        system = self.system
        centers = system.centers + np.einsum("mij,mi->mj", system.frames(), own[:, :3])
        tilt, aimed = system.tilt + own[:, 3:6], module_frames(centers)
        length = system.collimator_length + (own[:, 6] if LENGTH in self.fit else 0.0)
        offset = own[:, -2:] if OFFSET in self.fit else np.zeros((len(system), 2))
        points = self.points + (x[own.size :].reshape(-1, 3) if self.fits_points else 0.0)
        return Moved(centers, tilt, aimed, rotations(tilt).swapaxes(1, 2) @ aimed, length, offset, points)

    def gauge(self) -> Floats:
        """Shifts (G, M, 3), world mm, of all pinholes together that images do not tell: 3 shifts, 3 turns, a scale."""
        if not self.fits_points:
            return np.zeros((0, len(self.system), 3))
        told = self.used.any(axis=0)[:, None]
        apart = self.system.centers - np.average(self.system.centers, axis=0, weights=told[:, 0])
        turns = [np.cross(axis, apart) for axis in np.eye(3)]
        scale = [] if len(self.pairs) else [apart]
        ways = told * np.array([*(np.broadcast_to(axis, apart.shape) for axis in np.eye(3)), *turns, *scale])
        return ways / np.sqrt(np.maximum((ways**2).sum((1, 2), keepdims=True), 1e-12))  # 0 of a turn about two pinholes

    def residuals(self, x: Floats) -> Floats:
        """In units of their standard deviations: of places, distances, what is thought of the numbers, and the gauge."""
        now = self.moved(x)
        off = np.einsum("nij,nj->ni", self.whitening[self.used], (now.seen() - self.places)[self.used])
        apart = np.linalg.norm(now.points[self.pairs[:, 0]] - now.points[self.pairs[:, 1]], axis=1)
        gauge = (self.gauge() * (now.centers - self.system.centers)).sum((1, 2))
        of_distances = (apart - self.distances) / self.distance_sd
        return np.concatenate([off.ravel(), of_distances, self.of_modules(x).ravel(), gauge / _GAUGE_SD])

    def jacobian(self, x: Floats) -> Any:
        """The residuals' derivatives by x, a sparse matrix."""
        now, n_m, n_p, n = self.moved(x), len(self.system), len(self.sd), len(x)
        k, m = np.nonzero(self.used)
        nominal = self.system.frames()
        local = np.einsum("nij,nj->ni", now.frames[m], now.points[k] - now.centers[m])
        slopes = local[:, :2] / local[:, 2:]
        by_local = np.concatenate([np.broadcast_to(np.eye(2), (len(k), 2, 2)), -slopes[..., None]], axis=2)
        by_local = (now.length[m] / local[:, 2])[:, None, None] * by_local
        by_turn = by_local @ cross_matrix(local) @ (now.frames @ now.aimed.swapaxes(1, 2))[m]
        back = now.frames @ nominal.swapaxes(1, 2)
        by_shift = by_turn @ (_aiming(now) @ now.aimed @ nominal.swapaxes(1, 2))[m] - by_local @ back[m]
        parts = [by_shift, by_turn @ _left_jacobian(now.tilt)[m]]
        parts += [slopes[..., None]] * (LENGTH in self.fit)
        parts += [np.broadcast_to(np.eye(2), (len(k), 2, 2))] * (OFFSET in self.fit)
        white = self.whitening[self.used]
        of_places = _placed(white @ (self.sd * np.concatenate(parts, axis=2)), m * n_p, n)
        of_gauge = np.zeros((len(self.gauge()), n_m, n_p))
        of_gauge[..., :3] = self.sd[:3] * np.einsum("mij,gmj->gmi", nominal, self.gauge()) / _GAUGE_SD
        sparse = scipy_module("sparse")
        rows = [of_places, sparse.eye(n_m * n_p, n), _placed(of_gauge.reshape(1, -1, n_m * n_p), np.zeros(1, int), n)]
        if self.fits_points:
            rows[0] = rows[0] + _placed(white @ by_local @ now.frames[m], n_m * n_p + 3 * k, n)
            first, second = n_m * n_p + 3 * self.pairs.T
            between = now.points[self.pairs[:, 0]] - now.points[self.pairs[:, 1]]
            slopes = (between / np.linalg.norm(between, axis=1, keepdims=True) / self.distance_sd)[:, None]
            rows.insert(1, _placed(slopes, first, n) - _placed(slopes, second, n))
        return sparse.vstack(rows, "csr")

    def solved(self, x: Floats, robust: bool = False) -> Floats:
        """The numbers with the least sum of squares, or, `robust`, with one that large residuals hardly move."""
        most = np.full(len(x), np.inf)
        self.of_modules(most)[:] = FARTHEST
        lsmr = {"atol": 1e-8, "btol": 1e-8, "maxiter": 3000, "regularize": False}
        for scale in _LOSSES if robust else (1.0,):
            accuracy = 1e-10 if not robust else 1e-6 if scale == _LOSSES[-1] else 1e-3
            found = scipy_module("optimize").least_squares(
                self.residuals, x, self.jacobian, (-most, most), x_scale="jac", loss=self._loss if robust else "linear",
                f_scale=scale, xtol=accuracy, ftol=accuracy, max_nfev=100, tr_solver="lsmr", tr_options=lsmr,
            )  # fmt: skip
            x = np.asarray(found.x)
        return x

    def _loss(self, z: Floats) -> Floats:
        """Of squared residuals, SciPy's "soft_l1" of the places, with two derivatives: the others are taken as they are."""
        places, root = np.arange(len(z)) < 2 * self.used.sum(), np.sqrt(1 + z)
        return np.stack([np.where(places, 2 * root - 2, z), np.where(places, 1 / root, 1.0), places * -0.5 / root**3])

    def off(self, x: Floats) -> Floats:
        """Distances (K, M) of spots from where x has them, in standard deviations."""
        return np.linalg.norm(np.einsum("kmij,kmj->kmi", self.whitening, self.moved(x).seen() - self.places), axis=2)

    def covariance(self, x: Floats) -> tuple[Floats, Floats]:
        """The modules' numbers' covariances (M, P, P) at x, in the units of x, and the spots' leverages (K, M)."""
        J = self.jacobian(x)
        C = np.linalg.inv((J.T @ J).toarray())
        n_m, n_p, n = len(self.system), len(self.sd), 2 * int(self.used.sum())
        leverages = np.zeros(self.used.shape)
        leverages[self.used] = np.asarray(J[:n].multiply(J[:n] @ C).sum(axis=1)).reshape(-1, 2).sum(axis=1)
        of_modules = C[: n_m * n_p, : n_m * n_p].reshape(n_m, n_p, n_m, n_p)
        return of_modules[np.arange(n_m), :, np.arange(n_m)], leverages


def _placed(values: Floats, first: Indexes, n: int) -> Any:
    """A sparse matrix (N R, n) of blocks `values` (N, R, C), one below the other, which begin at columns `first` (N,)."""
    rows, columns = np.arange(values[..., 0].size), first[:, None, None] + np.arange(values.shape[2])
    index = np.repeat(rows, values.shape[2]), np.broadcast_to(columns, values.shape).ravel()
    return scipy_module("sparse").csr_matrix((values.ravel(), index), (len(rows), n))


def _left_jacobian(turns: Floats) -> Floats:
    """Matrices (M, 3, 3) from small changes of rotation vectors (M, 3), rad, to the rotations that come after them."""
    angle, cross = np.linalg.norm(turns, axis=1)[:, None, None], cross_matrix(turns)
    cubic = np.where(angle > 1e-4, (1 - np.sinc(angle / math.pi)) / np.maximum(angle, 1e-4) ** 2, 1 / 6)
    return np.eye(3) + 0.5 * np.sinc(angle / (2 * math.pi)) ** 2 * cross + cubic * (cross @ cross)


def _aiming(now: Moved) -> Floats:
    """Matrices (M, 3, 3) from shifts of pinholes along aimed u, v and k, mm, to the turns that keep them aimed, rad."""
    turns = np.zeros_like(now.aimed)
    b = np.linalg.norm(now.centers, axis=1)
    z_v, z_k = now.aimed[:, 1:, 2].T
    turns[:, 0, 1], turns[:, 1, 0] = 1 / b, -1 / b
    turns[:, 2, 0] = np.where(np.abs(z_v) > 1e-9, -z_k / (b * np.where(z_v, z_v, 1.0)), 0.0)  # u stays horizontal
    return turns
