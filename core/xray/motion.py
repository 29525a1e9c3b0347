"""Motion and change since a reference volume, from few views: where the body is now, and what in it is not as it was."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..arrays import ArrayLike, Floats
from ..errors import InputError, warn
from ..geometry.frames import affine_matrix, rotations
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..projector import Projector
from ..reconstruction.least_squares import sirt
from ..validation import freeze, instance, real_array, whole_number
from ..volumes.volume import LINE_INTEGRALS, Volume, require_quantity

_LEVELS = ((4, 4), (2, 2), (2, 1))
"""Pixels are joined to squares of the first number to be compared, of the second to be projected: coarse ones first, to find
motion that is larger than details. The last take their derivatives from those before, as they are many projections."""
_FAR = 1.0
"""Voxels from where derivatives were taken, beyond which they are taken anew."""
_SETTLED, _FINE = 0.1, 0.02
"""A step is small where it is less than these shares of the standard deviations, or of a voxel."""
_EXACT = 1e-12
"""Variance of line integrals, below which they are as exact as they can be computed."""
_BLIND = 1e12
"""Condition number of what images say of six numbers, from which on they do not say all."""


@dataclass(frozen=True, eq=False)
class Motion:
    """A rigid motion of a body: turned about `center`, then shifted.

    Attributes
    ----------
    shift : array (3,)
        mm.
    rotation : array (3,)
        Rotation vector, rad: its direction is the axis, its length the angle.
    center : array (3,)
        The reference's middle before, world mm.
    covariance : array (6, 6)
        Of shift and rotation, mm and rad: that of noise, made larger where what is left over is more than noise. The
        standard deviations of the rotation are up to a third too small.
    settled : bool
        Whether the last step was small.
    """

    shift: Floats
    rotation: Floats
    center: Floats
    covariance: Floats
    settled: bool = True

    @property
    def pose(self) -> Floats:
        """World now from world before, (4, 4)."""
        return _pose(np.concatenate([self.shift, self.rotation]), self.center)

    def moved(self, volume: Volume) -> Volume:
        """A volume of the body before, where it is now: the same voxels on a moved grid."""
        return Volume(volume.array, _moved(volume.grid, self.pose), volume.quantity, volume.note)


class MotionFinder:
    """Finds the motions of a body since a reference, one set of images after the other: for motion as it happens.

    Images are nearly linear in a motion of less than a voxel: the derivatives of the one before are kept as long as they are
    right. Then a motion takes two or three projections, else about ten. Parameters are those of `find_motion`.
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
        self._steps = np.array([step] * 3 + [step / radius] * 3)
        self._known: dict[int, tuple[Floats, Floats]] = {}  # by level: where derivatives were taken, and they

    def __call__(self, images: ArrayLike, start: Motion | None = None, iterations: int = 10) -> Motion:
        """The motion in `images`, see `find_motion`; `start` is a first guess, such as the motion before."""
        seen = real_array(images, "images", (len(self.views), *self.views.shape))
        noise = self._noise(seen)
        motion = np.zeros(6) if start is None else np.concatenate([start.shift, start.rotation])
        levels = [pair for pair in _LEVELS if all(n % pair[0] == 0 for n in self.views.shape)] or [(1, 1)]
        for level, width in levels if start is None else levels[-1:]:
            own, variances = _joined(seen, level), _joined(noise, level).ravel() / level**2
            for _ in range(whole_number(iterations, "iterations")):
                slopes = self._slopes(motion, level)
                left = (own - _joined(self._project(motion, width), level // width)).ravel()
                unexplained = max(0.0, float(np.mean(left**2 - variances)))
                of_each = 1 / np.maximum(variances + unexplained, _EXACT)
                information = (slopes * of_each) @ slopes.T
                if not np.linalg.cond(information) < _BLIND:
                    unseen = "these images do not show all of a motion"
                    raise InputError(f"find_motion: {unseen}: expected more or other views")
                inverse = np.linalg.inv(information)
                step = inverse @ (slopes @ (of_each * left))
                motion = motion + self._steps * step
                variance = float(of_each @ left**2) / max(1, left.size - 6)
                enough = np.maximum(_SETTLED * np.sqrt(variance * np.diag(inverse)), _FINE * level)
                settled = bool(np.all(np.abs(step) <= enough))
                if settled:
                    break
        if not settled:
            warn("find_motion: it has not settled: the motion may be too large, or the body changed", 2)
        covariance = variance * inverse * np.outer(self._steps, self._steps)
        return Motion(freeze(motion[:3]), freeze(motion[3:]), self._center, freeze(covariance), settled)

    def _slopes(self, motion: Floats, level: int) -> Floats:
        """Derivatives (6, pixels) of the images by the six numbers in units of their steps, near a motion."""
        place, slopes = self._known.get(level, (np.full(6, np.inf), np.zeros((6, 0))))
        if np.abs((motion - place) / self._steps).max() > _FAR:
            ends = [[self._project(motion + sign * by, level) for sign in (1, -1)] for by in np.diag(self._steps)]
            slopes = np.stack([(after - before).ravel() / 2 for after, before in ends])
            self._known[level] = motion, slopes
        return slopes

    def _noise(self, images: Floats) -> Floats:
        """Variances of the images by the photons that pass, 0 where their number is not known."""
        if self._photons is None:
            return np.zeros(images.shape)
        if self._photons.shape not in ((), images.shape) or self._photons.min() <= 0:
            raise InputError(f"photons: expected more than 0, one number or images of {images.shape}")
        return np.exp(images) / self._photons

    def _project(self, motion: Floats, level: int) -> Floats:
        """Images (M, n_v, n_u) of the moved reference, of pixels `level` times as large."""
        grid = _moved(self.reference.grid, _pose(motion, self._center))
        A = Projector(grid, _coarser(self.views, level), backend=self._backend)
        return np.asarray(A(self.reference.array), float)


def find_motion(
    reference: Volume,
    images: ArrayLike,
    views: Views,
    photons: ArrayLike | None = None,
    start: Motion | None = None,
    iterations: int = 10,
    backend: str = "auto",
) -> Motion:
    """How a body has moved since a reference volume was made of it, from its images now.

    By Gauss-Newton on the difference of the images and those of the moved reference, from coarse pixels to fine ones, with
    derivatives that are differences of projections. For many sets of images, such as those of a film, make a `MotionFinder`.

    Parameters
    ----------
    reference
        The body before, such as a reconstruction: of mu, on any grid.
    images
        Line integrals now, (M, n_v, n_u).
    views
        Theirs.
    photons
        Photons of a pixel where nothing is between, one number or images: pixels then count by the photons that pass.
        Without it all count alike.
    start
        A first guess, within a voxel or so; without it the reference is taken to be where it was, within a few.
    iterations
        At most so many on each of the levels of pixels.

    Returns
    -------
    Motion

    Raises
    ------
    InputError
        Images or photons of another shape, a volume of CT numbers, views that do not show all six numbers.

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
    """What has changed since a reference, besides its motion: `sirt` of what the moved reference does not explain.

    The volume is on the moved reference's grid. Few iterations show where and about how much; `options` are those of
    `sirt`, such as a mask.
    """
    instance(reference, Volume, "reference")
    now = reference if motion is None else motion.moved(reference)
    A = Projector(now.grid, views)
    left = real_array(images, "images", A.shape_out) - A(now)
    found = sirt(A, left, iterations, nonnegative=False, **options)
    return Volume(found.volume.array, now.grid, now.quantity)


def _pose(motion: Floats, center: Floats) -> Floats:
    (rotation,) = rotations(motion[None, 3:])
    return affine_matrix(rotation, center + motion[:3] - rotation @ center)


def _moved(grid: Grid, pose: Floats) -> Grid:
    return Grid(grid.shape, pose @ grid.affine)


def _coarser(views: Views, level: int) -> Views:
    n_v, n_u = views.shape
    size = n_v // level, n_u // level
    return replace(views, u_steps=level * views.u_steps, v_steps=level * views.v_steps, shape=size)


def _joined(images: Floats, level: int) -> Floats:
    """Means of squares of pixels of images (..., n_v, n_u)."""
    *first, n_v, n_u = images.shape
    return images.reshape(*first, n_v // level, level, n_u // level, level).mean(axis=(-3, -1))
