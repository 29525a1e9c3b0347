"""Bundle adjustment: least squares of the modules' positions and tilts, and of points, from the images of the points.

Reference: B. Triggs, P. McLauchlan, R. Hartley, A. Fitzgibbon, "Bundle adjustment: a modern synthesis", Vision Algorithms:
Theory and Practice, Lecture Notes in Computer Science 1883 (2000) 298-372; on gauges its section 9.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..arrays import Bools, Floats, Indexes
from ..errors import InputError
from ..geometry.frames import cross_matrix, module_frames, rotations
from ..geometry.system import PinholeSystem
from .solvers import scipy_module

LENGTH, OFFSET = "collimator_length", "detector_offset"
MAX_DEVIATION = 6.0  # bound of a module's parameters, in standard deviations from the nominal ones
# Residuals above which the loss of consecutive robust fits grows linearly instead of quadratically, in standard deviations.
_LOSS_SCALES = (300.0, 30.0, 3.0)
_GAUGE_SD = 5e-3  # standard deviation, mm, of the pinholes as a whole from the nominal ones


class FittedGeometry(NamedTuple):
    """Modules and points for some values of the parameters."""

    centers: Floats
    """Pinhole centres (M, 3), world mm."""
    tilt: Floats
    """Tilts (M, 3), rotation vectors about u, v and k, rad."""
    aimed_frames: Floats
    """Frames (M, 3, 3), rows u, v, k, of the modules without tilt."""
    frames: Floats
    """Frames (M, 3, 3), rows u, v, k."""
    length: Floats
    """Collimator lengths l (M,), mm."""
    offset: Floats
    """Offsets (M, 2) of the pixels on the crystal from the nominal views, mm along u and v."""
    points: Floats
    """Points (K, 3), world mm."""

    def project_points(self) -> Floats:
        """Return the images (K, M, 2) of the points on the crystals, mm along u and v, point-inverted."""
        local = np.einsum("mij,kmj->kmi", self.frames, self.points[:, None] - self.centers)
        return self.length[:, None] * local[..., :2] / local[..., 2:] + self.offset


@dataclass(frozen=True)
class BundleAdjustment:
    """Least-squares problem of M modules that see K points.

    The unknowns x are, for each module, P parameters in units of `sd`: its shifts along its nominal u, v and k, the change
    of its tilt (3), and the changes of its length and its pixels' offset (2) if these are fitted; then the points' shifts,
    mm.
    """

    system: PinholeSystem
    """Nominal system."""
    points: Floats
    """Points (K, 3), world mm: their known positions, or the start of the fit."""
    fits_points: bool
    """Whether the points are unknowns."""
    fit: tuple[str, ...]
    """Further parameters that are fitted, of `LENGTH` and `OFFSET`."""
    sd: Floats
    """Prior standard deviations (P,) of a module's parameters from the nominal ones, mm and rad."""
    positions: Floats
    """Measured positions (K, M, 2) of the spots on the crystals, mm along u and v."""
    whitening: Floats
    """Matrices (K, M, 2, 2) that transform the errors of positions to unit variance."""
    used: Bools
    """Spots (K, M) that the fit uses."""
    pairs: Indexes
    """Pairs (D, 2) of points whose distance is known."""
    distances: Floats
    """Known distances (D,), mm."""
    distance_sd: float
    """Standard deviation of the known distances, mm."""

    def start(self) -> Floats:
        """Return the x of the nominal geometry: zeros."""
        return np.zeros(len(self.sd) * len(self.system) + 3 * len(self.points) * self.fits_points)

    def module_parameters(self, x: Floats) -> Floats:
        """Return the modules' parameters (M, P) in x, in units of `sd`; a view of x."""
        return x[: len(self.sd) * len(self.system)].reshape(len(self.system), -1)

    def geometry(self, x: Floats) -> FittedGeometry:
        """Return the modules and the points that the unknowns `x` describe."""
        changes = self.sd * self.module_parameters(x)
        system = self.system
        centers = system.centers + np.einsum("mij,mi->mj", system.frames(), changes[:, :3])
        tilt, aimed = system.tilt + changes[:, 3:6], module_frames(centers)
        length = system.collimator_length + (changes[:, 6] if LENGTH in self.fit else 0.0)
        offset = changes[:, -2:] if OFFSET in self.fit else np.zeros((len(system), 2))
        points = self.points + (x[changes.size :].reshape(-1, 3) if self.fits_points else 0.0)
        return FittedGeometry(centers, tilt, aimed, rotations(tilt).swapaxes(1, 2) @ aimed, length, offset, points)

    def gauge(self) -> Floats:
        """Return shifts (G, M, 3) of all pinholes that no image determines: 3 translations, 3 rotations, a scale.

        They are normalised directions in world coordinates. There are none if the points are known, and no scale if a
        distance is.
        """
        if not self.fits_points:
            return np.zeros((0, len(self.system), 3))
        is_used = self.used.any(axis=0)[:, None]
        arms = self.system.centers - np.average(self.system.centers, axis=0, weights=is_used[:, 0])
        turns = [np.cross(axis, arms) for axis in np.eye(3)]
        scale = [] if len(self.pairs) else [arms]
        shifts = is_used * np.array([*(np.broadcast_to(axis, arms.shape) for axis in np.eye(3)), *turns, *scale])
        # A rotation about the line through two pinholes moves neither of them: its shifts stay 0.
        return shifts / np.sqrt(np.maximum((shifts**2).sum((1, 2), keepdims=True), 1e-12))

    def residuals(self, x: Floats) -> Floats:
        """Return the whitened residuals: spot positions, point distances, priors of the modules' parameters, gauge."""
        trial = self.geometry(x)
        spots = np.einsum("nij,nj->ni", self.whitening[self.used], (trial.project_points() - self.positions)[self.used])
        lengths = np.linalg.norm(trial.points[self.pairs[:, 0]] - trial.points[self.pairs[:, 1]], axis=1)
        gauge = (self.gauge() * (trial.centers - self.system.centers)).sum((1, 2))
        distances = (lengths - self.distances) / self.distance_sd
        return np.concatenate([spots.ravel(), distances, self.module_parameters(x).ravel(), gauge / _GAUGE_SD])

    def jacobian(self, x: Floats) -> Any:
        """Return the derivatives of `residuals` by x, a sparse matrix (residuals, unknowns)."""
        # n_m modules with n_p parameters each, n unknowns.
        trial, n_m, n_p, n = self.geometry(x), len(self.system), len(self.sd), len(x)
        k, m = np.nonzero(self.used)
        nominal = self.system.frames()
        # Derivatives (spots, 2, ...) of the spots' positions: by the points in module coordinates, by a rotation of the
        # module about its aimed u, v and k, and by a shift of the pinhole, which also rotates the module, to keep it aimed.
        local = np.einsum("nij,nj->ni", trial.frames[m], trial.points[k] - trial.centers[m])
        slopes = local[:, :2] / local[:, 2:]
        d_local = np.concatenate([np.broadcast_to(np.eye(2), (len(k), 2, 2)), -slopes[..., None]], axis=2)
        d_local = (trial.length[m] / local[:, 2])[:, None, None] * d_local
        d_rotation = d_local @ cross_matrix(local) @ (trial.frames @ trial.aimed_frames.swapaxes(1, 2))[m]
        from_nominal = trial.frames @ nominal.swapaxes(1, 2)
        aiming = _aiming_rotations(trial) @ trial.aimed_frames @ nominal.swapaxes(1, 2)
        d_shift = d_rotation @ aiming[m] - d_local @ from_nominal[m]
        d_parameters = [d_shift, d_rotation @ _left_jacobian(trial.tilt)[m]]
        d_parameters += [slopes[..., None]] * (LENGTH in self.fit)
        d_parameters += [np.broadcast_to(np.eye(2), (len(k), 2, 2))] * (OFFSET in self.fit)
        whitening = self.whitening[self.used]
        spot_rows = _block_matrix(whitening @ (self.sd * np.concatenate(d_parameters, axis=2)), m * n_p, n)
        d_gauge = np.zeros((len(self.gauge()), n_m, n_p))
        d_gauge[..., :3] = self.sd[:3] * np.einsum("mij,gmj->gmi", nominal, self.gauge()) / _GAUGE_SD
        gauge_rows = _block_matrix(d_gauge.reshape(1, -1, n_m * n_p), np.zeros(1, int), n)
        sparse = scipy_module("sparse")
        rows = [spot_rows, sparse.eye(n_m * n_p, n), gauge_rows]
        if self.fits_points:
            rows[0] = rows[0] + _block_matrix(whitening @ d_local @ trial.frames[m], n_m * n_p + 3 * k, n)
            first, second = n_m * n_p + 3 * self.pairs.T
            vectors = trial.points[self.pairs[:, 0]] - trial.points[self.pairs[:, 1]]
            d_point = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True) / self.distance_sd)[:, None]
            rows.insert(1, _block_matrix(d_point, first, n) - _block_matrix(d_point, second, n))
        return sparse.vstack(rows, "csr")

    def solve(self, x: Floats, robust: bool = False) -> Floats:
        """Return the x of the least sum of squared residuals, from a start x; `robust`: of a sum insensitive to outliers."""
        if not np.isfinite(self.residuals(x)).all():
            raise InputError(
                "calibrate: points, distances or standard deviations are too large or too small to compute with"
            )
        bounds = np.full(len(x), np.inf)
        self.module_parameters(bounds)[:] = MAX_DEVIATION
        lsmr = {"atol": 1e-8, "btol": 1e-8, "maxiter": 3000, "regularize": False}
        loss, scales = (self._soft_loss, _LOSS_SCALES) if robust else ("linear", (1.0,))
        for scale in scales:
            accuracy = 1e-10 if not robust else 1e-6 if scale == scales[-1] else 1e-3
            result = scipy_module("optimize").least_squares(
                self.residuals, x, self.jacobian, (-bounds, bounds), x_scale="jac", loss=loss, f_scale=scale, xtol=accuracy,
                ftol=accuracy, max_nfev=100, tr_solver="lsmr", tr_options=lsmr,
            )  # fmt: skip
            x = np.asarray(result.x)
        return x

    def _soft_loss(self, z: Floats) -> Floats:
        """Return rho(z), rho' and rho'' (3, n) for SciPy, of squared residuals z: soft L1 for spots, else linear."""
        spots, root = np.arange(len(z)) < 2 * self.used.sum(), np.sqrt(1 + z)
        return np.stack([np.where(spots, 2 * root - 2, z), np.where(spots, 1 / root, 1.0), spots * -0.5 / root**3])

    def spot_deviations(self, x: Floats) -> Floats:
        """Return the distances (K, M) of all spots from their positions at x, in standard deviations."""
        errors = self.geometry(x).project_points() - self.positions
        return np.linalg.norm(np.einsum("kmij,kmj->kmi", self.whitening, errors), axis=2)

    def covariance(self, x: Floats) -> tuple[Floats, Floats]:
        """Return the covariances (M, P, P) of the modules' parameters at x, in units of `sd`, and leverages (K, M) of spots.

        The leverage of a spot is the trace of its 2 x 2 block of the hat matrix ``J C J^T``.
        """
        J = self.jacobian(x)
        C = np.linalg.inv((J.T @ J).toarray())
        n_m, n_p, n = len(self.system), len(self.sd), 2 * int(self.used.sum())
        leverages = np.zeros(self.used.shape)
        leverages[self.used] = np.asarray(J[:n].multiply(J[:n] @ C).sum(axis=1)).reshape(-1, 2).sum(axis=1)
        module_blocks = C[: n_m * n_p, : n_m * n_p].reshape(n_m, n_p, n_m, n_p)
        return module_blocks[np.arange(n_m), :, np.arange(n_m)], leverages


def _block_matrix(values: Floats, first: Indexes, n: int) -> Any:
    """Return a sparse matrix (N R, n) of blocks `values` (N, R, C), one below the other, at first columns `first` (N,)."""
    rows, columns = np.arange(values[..., 0].size), first[:, None, None] + np.arange(values.shape[2])
    index = np.repeat(rows, values.shape[2]), np.broadcast_to(columns, values.shape).ravel()
    return scipy_module("sparse").csr_matrix((values.ravel(), index), (len(rows), n))


def _left_jacobian(vectors: Floats) -> Floats:
    """Return the left Jacobian (M, 3, 3) of SO(3) at rotation vectors (M, 3), rad.

    It maps a small change of a rotation vector to the rotation vector of the rotation that follows the unchanged one.
    """
    angle, cross = np.linalg.norm(vectors, axis=1)[:, None, None], cross_matrix(vectors)
    cubic = np.where(angle > 1e-4, (1 - np.sinc(angle / math.pi)) / np.maximum(angle, 1e-4) ** 2, 1 / 6)
    return np.eye(3) + 0.5 * np.sinc(angle / (2 * math.pi)) ** 2 * cross + cubic * (cross @ cross)


def _aiming_rotations(geometry: FittedGeometry) -> Floats:
    """Return matrices (M, 3, 3) from a pinhole's shift along aimed u, v, k, mm, to the rotation that keeps it aimed, rad."""
    matrices = np.zeros_like(geometry.aimed_frames)
    b = np.linalg.norm(geometry.centers, axis=1)
    z_v, z_k = geometry.aimed_frames[:, 1:, 2].T
    matrices[:, 0, 1], matrices[:, 1, 0] = 1 / b, -1 / b
    matrices[:, 2, 0] = np.where(np.abs(z_v) > 1e-9, -z_k / (b * np.where(z_v, z_v, 1.0)), 0.0)  # u stays horizontal
    return matrices
