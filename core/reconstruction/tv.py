"""Least squares with total variation, minimised by a primal-dual algorithm: TV."""

from typing import Any, Unpack

import numpy as np

from ..arrays import Array, ArrayLike
from ..geometry.grid import Grid
from ..memory import require
from ..progress import Progress, tell
from ..projector import Projector
from ..validation import positive
from .least_squares import LeastSquaresLoop, safe_inverse
from .loop import IterativeOptions, fixed_progress
from .result import Reconstruction


def tv(
    A: Projector,
    images: ArrayLike,
    weight: float,
    iterations: int = 200,
    nonnegative: bool = True,
    *options: Any,
    **named: Unpack[IterativeOptions],
) -> Reconstruction:
    """Reconstruct the volume that minimises ``||A x - images||^2 / 2 + weight TV(x)``: uniform areas with sharp edges.

    The total variation TV is the sum over voxels of the gradient's length: the root of the squared differences to the next
    voxel along each axis, divided by the axis's spacing in units of the smallest spacing. Only differences between voxels in
    the mask that rays meet are taken into account. The method is for few or noisy views.

    Parameters
    ----------
    weight : float
        Weight of the total variation, more than 0, in units of squared image values by volume values; too large a weight
        makes the volume uniform.
    A, images, iterations, nonnegative, *options, **named
        See `sirt`.

    Returns
    -------
    Reconstruction
        `objective` is the minimised function after each iteration. It falls, with small rises in between.

    Raises
    ------
    InputError
        See `sirt`.

    References
    ----------
    A. Chambolle, T. Pock, "A first-order primal-dual algorithm for convex problems with applications to imaging", Journal of
    Mathematical Imaging and Vision 40 (2011) 120-145, with the step sizes of T. Pock, A. Chambolle, "Diagonal
    preconditioning for first order primal-dual algorithms in convex optimization", ICCV (2011) 1762-1769. E. Y. Sidky,
    J. H. Jorgensen, X. Pan, "Convex optimization problem prototyping for image reconstruction in computed tomography with
    the Chambolle-Pock algorithm", Physics in Medicine and Biology 57 (2012) 3065-3091.
    """
    loop = LeastSquaresLoop("TV", A, images, iterations, nonnegative, *options, **named)
    weight = positive(weight, "weight")
    require(4 * (30 * A.grid.n_voxels + 5 * int(np.prod(A.shape_out))), "the arrays of tv")
    closeness = A.grid.spacing.min() / A.grid.spacing
    pixel_steps = safe_inverse(loop.forward(loop.weights, loop.preparing()))  # dual step lengths of the images
    sensitivity = loop.adjoint(np.ones(A.shape_out, np.float32), loop.preparing())
    visible = (sensitivity > 0).astype(np.float32)
    pairs = (_gradient(visible, np.ones(3, np.float32)) == 0) * visible  # 1 where a voxel and the next one are visible
    # The gradient is scaled so that it has the same weight in a voxel as the voxel's rays.
    scale = float(sensitivity.mean()) / max(float(loop.weights.mean()), 1e-6) / float(2 * closeness.sum()) or 1.0
    factors = (scale * closeness).astype(np.float32)
    voxel_steps = safe_inverse(sensitivity + np.float32(2 * factors.sum()) * loop.weights)  # primal step lengths
    gradient_step = np.float32(1 / (2 * factors.max()))  # dual step length of the gradient
    radius = np.float32(weight / scale)

    def step(number: int, x: Array, progress: Progress | None) -> tuple[Array, float]:
        """Return the next volume after `x`, and its objective, in iteration `number`."""
        # The state's keys are those of resumable files: images A x ("seen"), extrapolated images and volume ("ahead",
        # "beyond"), and the dual variables of images and of the volume's gradient ("misfit", "slopes").
        keys = ("seen", "ahead", "beyond", "misfit", "slopes")
        if not loop.state:
            images = loop.forward(x, fixed_progress(progress, 0, 2))
            duals = np.zeros_like(images), np.zeros((3, *x.shape), np.float32)
            loop.state = dict(zip(keys, (images, images, x, *duals), strict=True))
        images, extrapolated_images, extrapolated_x, image_dual, gradient_dual = (loop.state[key] for key in keys)
        image_dual = (image_dual + pixel_steps * (extrapolated_images - loop.images)) / (1 + pixel_steps)
        gradient_dual = pairs * (gradient_dual + gradient_step * _gradient(extrapolated_x, factors))
        gradient_dual /= np.maximum(1, np.sqrt(np.sum(gradient_dual**2, axis=0)) / radius)
        descent = loop.adjoint(image_dual, fixed_progress(progress, 0, 2)) + _gradient_adjoint(gradient_dual, factors)
        new_x = loop.bounded(x - voxel_steps * descent)
        new_images = loop.forward(new_x, fixed_progress(progress, 1, 2))
        extrapolations = 2 * new_images - images, 2 * new_x - x
        loop.state = dict(zip(keys, (new_images, *extrapolations, image_dual, gradient_dual), strict=True))
        tell(progress, 2, 2)
        squared_error = float(np.sum(np.square(new_images - loop.images, dtype=float)))
        return new_x, 0.5 * squared_error + weight * total_variation(new_x, A.grid, pairs)

    return loop.run(step, weight=weight, nonnegative=nonnegative)


def total_variation(x: Array, grid: Grid, pairs: Array | float = 1.0) -> float:
    """Return the isotropic total variation of `x` (n_x, n_y, n_z), in its unit: the sum of the gradients' lengths.

    Differences to the next voxel along an axis are divided by its spacing in units of the smallest. `pairs`, (3, n_x, n_y,
    n_z) or a number, multiplies them: 0 leaves a difference out.
    """
    slopes = pairs * _gradient(x.astype(np.float64), grid.spacing.min() / grid.spacing)
    return float(np.sum(np.sqrt(np.sum(slopes**2, axis=0))))


def _gradient(x: Array, factors: Array) -> Array:
    """Return the differences (3, ...) to the next voxel along each axis times the axis's factor; 0 in the last voxel."""
    ends = [np.take(x, [-1], axis) for axis in range(3)]
    return np.stack([f * np.diff(x, axis=axis, append=ends[axis]) for axis, f in enumerate(factors)])


def _gradient_adjoint(slopes: Array, factors: Array) -> Array:
    """Return the adjoint of `_gradient` applied to `slopes` (3, n_x, n_y, n_z), an array (n_x, n_y, n_z)."""
    inner = [np.delete(slopes[axis], -1, axis) for axis in range(3)]
    return -sum(f * np.diff(inner[axis], axis=axis, prepend=0, append=0) for axis, f in enumerate(factors))
