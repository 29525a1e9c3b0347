"""Iterative least squares: SIRT and CGLS, and the loop that TV and OSTR share with them."""

from typing import Any, Unpack

import numpy as np

from ..arrays import Array, ArrayLike
from ..errors import InputError, warn
from ..progress import Progress, tell
from ..projector import Projector
from ..validation import instance, positive, real_array
from .arguments import argument
from .loop import IterativeOptions, Loop, fixed_progress, numpy_if_tensor
from .result import Reconstruction

_MAX_COSINE = 0.05
"""Cosine between a gradient of CGLS and the first gradient, 0 in exact arithmetic, above which rounding matters.

Below it the volumes are within 1e-3 of those of exact arithmetic.
"""
_CONVERGED = 1e-6
"""Ratio of the last and the first gradient at the least-squares solution in single precision."""
_ROUNDING_WARNING = "CGLS: from iteration {} on rounding changes the volumes by up to a few percent"


@argument("relaxation", float, "Length of the steps, less than 2", above=0, slider=1.9)
@argument("nonnegative", bool, "Set values below 0 to 0")
def sirt(
    A: Projector,
    images: ArrayLike,
    iterations: int = 100,
    relaxation: float = 1.0,
    nonnegative: bool = True,
    *options: Any,
    **named: Unpack[IterativeOptions],
) -> Reconstruction:
    """Reconstruct a volume by weighted least squares with SIRT: ``x <- x + relaxation C A.T(R (images - A x))``.

    R is ``1 / A(1)``, the inverse of each pixel's sum of weights, and C is ``1 / A.T(1)``, that of each voxel. Early
    iterations are smooth, later ones sharper and noisier. The method is slow and robust, and works with any projector.

    Parameters
    ----------
    A : Projector
        Projector of any model. The background of the model, if any, is subtracted from the images.
    images : array (M, n_v, n_u)
        Line integrals of `Transmission`, or counts of `Emission`.
    iterations : int
        Number of iterations of this call, of one projection and one backprojection each.
    relaxation : float
        Length of the steps, more than 0 and less than 2.
    nonnegative : bool
        Whether values below 0 are set to 0 after each step.
    *options, **named
        See `IterativeOptions`. Without `start` every voxel begins with 0.

    Returns
    -------
    Reconstruction
        `objective` is half the sum of squares of ``images - A x``, weighted with R, after each iteration; it never rises.
        Pixels whose rays miss the grid are ignored; voxels that no ray meets keep their values. The volume holds mu for
        projectors of line integrals, otherwise activity, unless `start` is a volume of another quantity.

    Raises
    ------
    InputError
        Images, start or mask have another shape, or are not finite; a number is out of range.

    References
    ----------
    P. Gilbert, "Iterative methods for the three-dimensional reconstruction of an object from projections", Journal of
    Theoretical Biology 36 (1972) 105-117. J. Gregor, T. Benson, "Computational analysis and improvement of SIRT", IEEE
    Transactions on Medical Imaging 27 (2008) 918-924.
    """
    if (relaxation := positive(relaxation, "relaxation")) >= 2:
        raise InputError(f"relaxation: expected less than 2, got {relaxation:g}")
    loop = LeastSquaresLoop("SIRT", A, images, iterations, nonnegative, *options, **named)
    R = safe_inverse(loop.forward(loop.weights, loop.preparing()))
    C = np.float32(relaxation) * safe_inverse(loop.adjoint(np.ones(A.shape_out, np.float32), loop.preparing()))
    residual: Array | None = None

    def step(number: int, x: Array, progress: Progress | None) -> tuple[Array, float]:
        """Return the next volume after `x`, and its objective, in iteration `number`."""
        nonlocal residual
        if residual is None:
            residual = loop.images - loop.forward(x, fixed_progress(progress, 0, 2))
        x = loop.bounded(x + C * loop.adjoint(R * residual, fixed_progress(progress, 0, 2)))
        residual = loop.images - loop.forward(x, fixed_progress(progress, 1, 2))
        tell(progress, 2, 2)
        return x, 0.5 * float(np.sum(R * np.square(residual, dtype=float)))

    return loop.run(step, relaxation=relaxation, nonnegative=nonnegative)


def cgls(
    A: Projector, images: ArrayLike, iterations: int = 10, *options: Any, **named: Unpack[IterativeOptions]
) -> Reconstruction:
    """Reconstruct a volume by least squares with conjugate gradients on the normal equations (CGLS).

    This is the fastest method for the least-squares solution, whose values may be negative. With noise it should be ended
    early: about 5 to 20 iterations are as sharp as hundreds of `sirt`.

    In exact arithmetic its gradients are orthogonal. Rounding destroys this orthogonality, often after 10 to 15 iterations;
    from then on the volumes differ by a few percent from those of exact arithmetic, but still converge to the same
    least-squares solution. A warning names the iteration (Paige 1980; in double precision it happens later).

    Parameters
    ----------
    A, images, iterations, *options, **named
        See `sirt`.

    Returns
    -------
    Reconstruction
        `objective` is half the sum of squares of ``images - A x`` after each iteration; it never rises.

    Raises
    ------
    InputError
        See `sirt`.

    Warns
    -----
    InputWarning
        From the named iteration on, rounding changes the volumes; up to there they are exact within 1e-3.

    References
    ----------
    A. Bjorck, "Numerical Methods for Least Squares Problems", SIAM (1996), section 7.4. C. C. Paige, "Accuracy and
    effectiveness of the Lanczos algorithm for the symmetric eigenproblem", Linear Algebra and its Applications 34 (1980)
    235-258.
    """
    loop = LeastSquaresLoop("CGLS", A, images, iterations, False, *options, **named)

    def step(number: int, x: Array, progress: Progress | None) -> tuple[Array, float]:
        """Return the next volume after `x`, and its objective, in iteration `number`."""
        if not loop.state:
            residual: Array = loop.images - loop.forward(x, fixed_progress(progress, 0, 2))
            direction = loop.adjoint(residual, fixed_progress(progress, 0, 2))
            loop.state = {"residual": residual, "direction": direction, "gradient": _sum_of_squares(direction)}
        residual, direction, gradient_squares = (loop.state[name] for name in ("residual", "direction", "gradient"))
        first = loop.state.setdefault("first", direction)
        direction_images = loop.forward(direction, fixed_progress(progress, 0, 2))
        image_squares = _sum_of_squares(direction_images)
        if image_squares > 0:  # else the volume is the least-squares solution
            length = (gradient_squares / image_squares).astype(np.float32)
            x = x + length * direction
            residual = residual - length * direction_images
            gradient = loop.adjoint(residual, fixed_progress(progress, 1, 2))
            new_squares = _sum_of_squares(gradient)
            direction = gradient + (new_squares / gradient_squares).astype(np.float32) * direction
            loop.state |= {"residual": residual, "direction": direction, "gradient": new_squares}
            first_squares = _sum_of_squares(first)
            is_oblique = float(np.vdot(first, gradient)) ** 2 > _MAX_COSINE**2 * new_squares * first_squares
            if is_oblique and new_squares > _CONVERGED**2 * first_squares:
                loop.state["first"] = np.zeros_like(first)  # so that the warning is given once
                warn(_ROUNDING_WARNING.format(number + 1), 2)
        tell(progress, 2, 2)
        return x, 0.5 * float(_sum_of_squares(residual))

    return loop.run(step)


class LeastSquaresLoop(Loop):
    """Loop of a method that minimises a distance between ``A x`` and images: a `Loop` with the images, from 0 on.

    Parameters
    ----------
    method, A, images, iterations, nonnegative
        See `sirt`.
    options, named
        See `IterativeOptions`.

    Attributes
    ----------
    images : array (M, n_v, n_u)
        Measured images minus the model's background; 0 in pixels that are dead in the model.
    weights : array (n_x, n_y, n_z)
        1 inside the mask, 0 outside.
    """

    def __init__(
        self,
        method: str,
        A: Projector,
        images: ArrayLike,
        iterations: int,
        nonnegative: bool,
        *options: Any,
        **named: Any,
    ) -> None:
        instance(A, Projector, method)
        instance(nonnegative, bool, "nonnegative")
        quantity = "activity" if A.model.takes == ("activity",) else "mu"
        named |= {"default": 0.0, "negative": not nonnegative, "quantity": quantity}
        super().__init__(method, A, iterations, *options, **named)
        self._nonnegative = nonnegative
        background = A.background.astype(np.float32)
        measured = real_array(numpy_if_tensor(images), "images", A.shape_out, np.float32) - background
        self.images: Array = np.where(A.living, measured, np.float32(0))
        self.weights: Array = self.mask.astype(np.float32)

    def record(self) -> dict[str, Any]:
        """Return the model's name, and weighted sums of views, images and mask, which change with the order of the views."""
        arrays = {"views": self._A.views.projection_matrices(), "images": self.images, "mask": self.weights}
        sums = {name: numbers.sum(axis=(1, 2), dtype=float) for name, numbers in arrays.items()}
        checksums = {name: float(numbers @ np.linspace(1.0, 2.0, len(numbers))) for name, numbers in sums.items()}
        return {"model": self._A.model.name, **checksums}

    def forward(self, x: Array, progress: Progress | None) -> Array:
        """Return ``A x``, float32 (M, n_v, n_u)."""
        return np.asarray(self._A(x, progress), np.float32)

    def adjoint(self, y: Array, progress: Progress | None) -> Array:
        """Return ``A.T y`` inside the mask and 0 outside, float32 (n_x, n_y, n_z)."""
        return np.asarray(self._A.T(y, progress), np.float32) * self.weights

    def bounded(self, x: Array) -> Array:
        """Return ``max(x, 0)`` if the method allows no negative values, otherwise `x`."""
        return np.maximum(x, np.float32(0)) if self._nonnegative else x


def safe_inverse(sums: Array) -> Array:
    """Return ``1 / sums``; 0 where a sum is at most 1e-6 of the largest."""
    smallest = 1e-6 * sums.max(initial=0.0)
    return np.divide(1, sums, out=np.zeros_like(sums), where=sums > smallest)


def _sum_of_squares(numbers: Array) -> Array:
    """Return the sum of squares of all numbers, as a float64 array without axes."""
    return np.asarray(np.sum(np.square(numbers, dtype=float)))
