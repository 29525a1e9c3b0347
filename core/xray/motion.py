"""Motion and change since a reference volume, from few views: the body's rigid motion, and the residual change."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..arrays import ArrayLike, Floats, Floats32
from ..errors import InputError, warn
from ..geometry.frames import affine_matrix, rotations
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..physics.crystal import gaussian_blur
from ..projector import Projector
from ..reconstruction.least_squares import sirt
from ..validation import freeze, instance, real_array, whole_number
from ..volumes.volume import LINE_INTEGRALS, Volume, require_quantity

_LEVELS = (4, 2, 1)
"""Block sizes, pixels, by which images are compared: coarse ones come first, to find motion that is larger than details."""
_MAX_DISTANCE = 0.1
"""Distance from the motion at which derivatives were computed, in voxels and pixels of a block, beyond which they are
computed anew: older ones add a bias, of blur and edges that are fitted where they no longer are."""
_SMOOTHING = 2.0
"""Standard deviation, pixels, of the Gaussian that smooths the derivatives by which residuals are weighted.

Details that voxels cannot hold then say little of the motion.
"""
_RAYS = 4
"""Rays per row and column of a pixel by which images are compared without blocks: one tells little of the pixel's mean."""
_REGIONS = 8
"""Regions per row and column of an image, within which residuals may be correlated, as those of voxels' errors are."""
_UNSHARPNESS = 1 / 12
"""Blur of voxels, as a share of the second differences: the means in the reference blur by half of it, rays by half."""
_SETTLED, _COARSE, _EXACT = 0.1, 0.02, 1e-4
"""Largest final step: as a share of the standard deviations; in voxels and pixels of a block; in voxels, without blocks."""
_MAX_CONDITION = 1e12
"""Condition number of the information matrix from which on the images do not determine all six numbers."""


@dataclass(frozen=True, eq=False)
class Motion:
    """A rigid motion of a body: a rotation about `center`, then a shift.

    Attributes
    ----------
    shift : array (3,)
        mm.
    rotation : array (3,)
        Rotation vector, rad: its direction is the axis, its length the angle.
    center : array (3,)
        Centre of the reference before the motion, world mm.
    covariance : array (6, 6)
        Covariance of shift and rotation, mm and rad, as the residuals of the images tell it, which contain noise and voxels'
        errors. Errors of the reference that its images do not show, such as its own motion, are not contained.
    settled : bool
        Whether the last step was small, so that the iterations converged.
    """

    shift: Floats
    rotation: Floats
    center: Floats
    covariance: Floats
    settled: bool = True

    @property
    def pose(self) -> Floats:
        """Transform (4, 4) from world points before the motion to world points after it."""
        return _pose(np.concatenate([self.shift, self.rotation]), self.center)

    def moved(self, volume: Volume) -> Volume:
        """Return a volume of the body after the motion: the same voxels on a moved grid."""
        return Volume(volume.array, _moved_grid(volume.grid, self.pose), volume.quantity, volume.note)


class MotionFinder:
    """Finds the motions of a body since a reference from successive sets of images, for motion as it happens.

    Images are nearly linear in a motion of a tenth of a voxel, so the derivatives of the set before are kept within it. Then
    a motion takes two or three projections, else 14 more for each block size. Parameters are those of `find_motion`.
    """

    def __init__(
        self, reference: Volume, views: Views, photons: ArrayLike | None = None, backend: str = "auto"
    ) -> None:
        instance(reference, Volume, "reference")
        require_quantity(reference.quantity, LINE_INTEGRALS, "find_motion")
        instance(views, Views, "views")
        self.reference, self.views, self._backend = reference, views, backend
        self._center = reference.grid.center
        self._photons = None if photons is None else real_array(photons, "photons", None)
        step = reference.grid.spacing.min()
        radius = np.linalg.norm(reference.grid.corners()[0] - self._center) / 2
        self._steps = np.array([step] * 3 + [step / radius] * 3)  # mm and rad that move the body by about a voxel
        array = np.asarray(reference.array, np.float32)
        blur = _second_differences(array)
        self._volumes = array - _UNSHARPNESS * blur, blur
        self._derivatives_at: dict[int, tuple[Floats, Floats, Floats]] = {}  # by block size; they begin with the motion

    def __call__(self, images: ArrayLike, start: Motion | None = None, iterations: int = 10) -> Motion:
        """Return the motion in `images`, see `find_motion`; `start` is a first guess, such as the motion before."""
        measured = real_array(images, "images", (len(self.views), *self.views.shape))
        photons = self._checked_photons(measured)
        motion = np.zeros(6) if start is None else np.concatenate([start.shift, start.rotation])
        levels = [level for level in _LEVELS if all(n % level == 0 for n in self.views.shape)]
        for level in levels if start is None else levels[-1:]:
            blocks = _block_means(measured, level)
            for _ in range(whole_number(iterations, "iterations")):
                derivatives, smoothed = self._derivatives(motion, level)
                rays = _RAYS if level == 1 else 1
                expected = _block_means(self._project(motion, level / rays), rays)
                if photons is None:
                    residual, weights = (blocks - expected).ravel(), np.ones(blocks.size)
                else:  # of transmitted photons, whose noise has no mean and a variance that does not depend on it
                    residual = -np.expm1(expected - blocks).ravel()
                    weights = (np.exp(-expected) * _block_means(photons, level)).ravel()
                rows = smoothed * weights
                information = rows @ derivatives.T
                if not np.linalg.cond(information) < _MAX_CONDITION:
                    reason = "these images do not show all of a motion"
                    raise InputError(f"find_motion: {reason}: expected more or other views")
                inverse = np.linalg.inv(information)
                step = inverse @ (rows @ residual)
                rest = residual - step @ derivatives
                motion = motion + self._steps * step[:6]
                covariance = (inverse @ _scatter(np.reshape(rows * rest, (-1, *blocks.shape))) @ inverse.T)[:6, :6]
                least = _COARSE * level if level > 1 else _EXACT
                settled = bool(np.all(np.abs(step[:6]) <= np.maximum(_SETTLED * np.sqrt(np.diag(covariance)), least)))
                if settled:
                    break
        if not settled:
            warn("find_motion: it has not settled: the motion may be too large, or the body changed", 2)
        covariance = covariance * np.outer(self._steps, self._steps)
        return Motion(freeze(motion[:3]), freeze(motion[3:]), self._center, freeze(covariance), settled)

    def _derivatives(self, motion: Floats, level: int) -> tuple[Floats, Floats]:
        """Return the derivatives (8, pixels) of the images, and smoothed ones, at or near a motion.

        Six are by the motion, in units of `_steps`. Two are by the reference's blur and by the variation of transmission
        within a pixel, which are fitted besides, since at sharp edges they are like motion.
        """
        computed_at, *derivatives = self._derivatives_at.get(level, (np.full(6, np.inf),) * 3)
        if np.abs((motion - computed_at) / self._steps).max() > _MAX_DISTANCE * level:
            ends = [[self._project(motion + sign * step, level) for sign in (1, -1)] for step in np.diag(self._steps)]
            slopes = np.gradient(self._project(motion, level), axis=(1, 2))
            images = [(upper - lower) / 2 for upper, lower in ends]
            images += [self._project(motion, level, self._volumes[1]), slopes[0] ** 2 + slopes[1] ** 2]
            along_v, along_u = (gaussian_blur(n, _SMOOTHING) for n in images[0].shape[1:])
            derivatives = [np.reshape(array, (len(images), -1)) for array in (images, along_v @ images @ along_u.T)]
            self._derivatives_at[level] = motion, *derivatives
        return derivatives[0], derivatives[1]

    def _checked_photons(self, images: Floats) -> Floats | None:
        """Return the number of photons of each pixel without a body, None if it is unknown."""
        if self._photons is None:
            return None
        if self._photons.shape not in ((), images.shape) or self._photons.min() <= 0:
            raise InputError(f"photons: expected more than 0, one number or images of {images.shape}")
        return np.broadcast_to(self._photons, images.shape)

    def _project(self, motion: Floats, level: float, array: Floats32 | None = None) -> Floats:
        """Return images (M, n_v, n_u) of the moved reference, or another array, with pixels `level` times as large."""
        grid = _moved_grid(self.reference.grid, _pose(motion, self._center))
        A = Projector(grid, _coarse_views(self.views, level), backend=self._backend)
        return np.asarray(A(self._volumes[0] if array is None else array), float)


def find_motion(
    reference: Volume,
    images: ArrayLike,
    views: Views,
    photons: ArrayLike | None = None,
    start: Motion | None = None,
    iterations: int = 10,
    backend: str = "auto",
) -> Motion:
    """Find the rigid motion of a body since a reference volume was made of it, from its present images.

    The difference between the images and those of the moved reference is minimised by Gauss-Newton steps, from coarse pixels
    to fine ones, with derivatives that are differences of projections. For many sets of images, such as those of a film,
    create a `MotionFinder`.

    Parameters
    ----------
    reference
        The body before the motion, such as a reconstruction: a volume of mu, on any grid.
    images
        Present line integrals, (M, n_v, n_u).
    views
        Views of the images.
    photons
        Number of photons of a pixel without a body, one number or images: pixels are then weighted by the number of
        transmitted photons. Without it all have the same weight.
    start
        A first guess, within about a voxel; without it, the body must be within a few voxels of the reference.
    iterations
        Largest number of steps at each pixel size.

    Returns
    -------
    Motion

    Raises
    ------
    InputError
        Images or photons have another shape, the volume holds CT numbers, or the views do not determine all six numbers.

    Warns
    -----
    InputWarning
        The steps have not become small.
    """
    return MotionFinder(reference, views, photons, backend)(images, start, iterations)


def find_change(
    reference: Volume,
    images: ArrayLike,
    views: Views,
    motion: Motion | None = None,
    iterations: int = 20,
    **options: Any,
) -> Volume:
    """Reconstruct the change of a body since a reference, besides its motion: `sirt` of the residual images.

    The volume is on the moved reference's grid. Few iterations show the place and roughly the size of a change; `options`
    are those of `sirt`, such as a mask.
    """
    instance(reference, Volume, "reference")
    present = reference if motion is None else motion.moved(reference)
    A = Projector(present.grid, views)
    residual = real_array(images, "images", A.shape_out) - A(present)
    result = sirt(A, residual, iterations, nonnegative=False, **options)
    return Volume(result.volume.array, present.grid, present.quantity)


def _pose(motion: Floats, center: Floats) -> Floats:
    """Return the transform (4, 4) of a motion, shift and rotation vector (6,), about a centre."""
    (rotation,) = rotations(motion[None, 3:])
    return affine_matrix(rotation, center + motion[:3] - rotation @ center)


def _moved_grid(grid: Grid, pose: Floats) -> Grid:
    """Return the grid transformed by a pose (4, 4)."""
    return Grid(grid.shape, pose @ grid.affine)


def _coarse_views(views: Views, level: float) -> Views:
    """Return views of the same size with pixels `level` times as large, half as large if it is 1 / 2."""
    n_v, n_u = views.shape
    size = round(n_v / level), round(n_u / level)
    return replace(views, u_steps=level * views.u_steps, v_steps=level * views.v_steps, shape=size)


def _block_means(images: Floats, level: int) -> Floats:
    """Return the means of images (..., n_v, n_u) over square blocks of `level` pixels."""
    *first, n_v, n_u = images.shape
    return images.reshape(*first, n_v // level, level, n_u // level, level).mean(axis=(-3, -1))


def _scatter(scores: Floats) -> Floats:
    """Return the covariance (k, k) of the sum of scores (k, M, n_v, n_u) that are correlated within regions of an image.

    It is the sum of the products of the regions' sums, see Liang and Zeger, Biometrika 73 (1986) 13.
    """
    for axis in (2, 3):
        n = scores.shape[axis]
        scores = np.add.reduceat(scores, np.unique(np.arange(_REGIONS) * n // _REGIONS), axis)
    sums = scores.reshape(len(scores), -1)
    n = sums.shape[1]
    return sums @ sums.T * n / max(1, n - len(sums))


def _second_differences(array: Floats32) -> Floats32:
    """Return the sum of the second differences along the axes."""
    total = np.zeros_like(array)
    for axis in range(3):
        steps = np.diff(np.moveaxis(array, axis, 0), axis=0)
        along = np.moveaxis(total, axis, 0)
        along[:-1] += steps
        along[1:] -= steps
    return total
