"""Least squares by iteration: SIRT and CGLS, and what they have in common with TV."""

from typing import Any, Unpack

import numpy as np

from ..arrays import Array, ArrayLike
from ..errors import InputError, warn
from ..progress import Progress, tell
from ..projector import Projector
from ..validation import instance, positive, real_array
from .arguments import argument
from .loop import IterativeOptions, Loop, plain, waiting
from .result import Reconstruction

_LEAN = 0.05
"""Cosine between a gradient of CGLS and its first, 0 in exact numbers: below it volumes are within 1e-3 of theirs."""
_DONE = 1e-6
"""The share of the first gradient that is left at the least squares in single precision."""
_LEANS = "CGLS: from iteration {} on rounding puts its volumes up to a few percent beside those of exact numbers"


@argument("relaxation", float, "Length of the steps, less than 2", above=0, slider=1.9)
@argument("nonnegative", bool, "Values below 0 become 0")
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

    R is 1 by the pixels' sums of weights, ``A(1)``, C 1 by the voxels', ``A.T(1)``. Early iterations are smooth, later ones
    sharper and noisier. Slow and steady; for any projector.

    Parameters
    ----------
    A : Projector
        A projector of any model. Its background, if it has any, is taken off the images.
    images : array (M, n_v, n_u)
        Line integrals of `Transmission`, or counts of `Emission`.
    iterations : int
        Each takes one projection and one backprojection.
    relaxation : float
        Length of the steps, more than 0 and less than 2.
    nonnegative : bool
        Whether values below 0 become 0 after each step.
    *options, **named
        See `IterativeOptions`. Without `start` it begins with 0 everywhere.

    Returns
    -------
    Reconstruction
        `objective` is half the sum of squares of ``images - A x``, weighted with R, after each iteration; it never rises.
        Pixels whose rays miss the grid count nothing, voxels that no ray meets stay as they are. The volume is of mu for
        projectors of line integrals, else of activity, unless `start` is of another quantity.

    Raises
    ------
    InputError
        Images, start or mask have another shape, or are not finite; a number is out of its range.

    References
    ----------
    P. Gilbert, "Iterative methods for the three-dimensional reconstruction of an object from projections", Journal of
    Theoretical Biology 36 (1972) 105-117. J. Gregor, T. Benson, "Computational analysis and improvement of SIRT", IEEE
    Transactions on Medical Imaging 27 (2008) 918-924.
    """
    relaxation = positive(relaxation, "relaxation")
    if relaxation >= 2:
        raise InputError(f"relaxation: expected less than 2, got {relaxation:g}")
    loop = LeastSquaresLoop("SIRT", A, images, iterations, nonnegative, *options, **named)
    per_pixel = inverse(loop.forward(loop.weights, loop.preparing()))
    per_voxel = np.float32(relaxation) * inverse(loop.adjoint(np.ones(A.shape_out, np.float32), loop.preparing()))
    residual: Array | None = None

    def step(number: int, x: Array, progress: Progress | None) -> tuple[Array, float]:
        nonlocal residual
        if residual is None:
            residual = loop.images - loop.forward(x, waiting(progress, 0, 2))
        x = loop.bounded(x + per_voxel * loop.adjoint(per_pixel * residual, waiting(progress, 0, 2)))
        residual = loop.images - loop.forward(x, waiting(progress, 1, 2))
        tell(progress, 2, 2)
        return x, 0.5 * float(np.sum(per_pixel * np.square(residual, dtype=float)))

    return loop.run(step, relaxation=relaxation, nonnegative=nonnegative)


def cgls(
    A: Projector, images: ArrayLike, iterations: int = 10, *options: Any, **named: Unpack[IterativeOptions]
) -> Reconstruction:
    """Reconstruct a volume by least squares with conjugate gradients on the normal equations (CGLS).

    The fastest way to the least squares, whose values may be negative. It ends early where there is noise: about 5 to 20
    iterations are as sharp as hundreds of `sirt`.

    Its gradients are at right angles to each other. Rounding makes those that come late lean to the first, and from then on,
    often after 10 to 15 iterations, the volumes are not those of exact numbers, but a few percent beside them; they go on
    towards the same least squares. A warning says where (Paige 1980; in double precision the same happens later).

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
        Rounding turns it off the way of exact numbers: up to there it keeps to them within 1e-3.

    References
    ----------
    A. Bjorck, "Numerical Methods for Least Squares Problems", SIAM (1996), section 7.4. C. C. Paige, "Accuracy and
    effectiveness of the Lanczos algorithm for the symmetric eigenproblem", Linear Algebra and its Applications 34 (1980)
    235-258.
    """
    loop = LeastSquaresLoop("CGLS", A, images, iterations, False, *options, **named)

    def step(number: int, x: Array, progress: Progress | None) -> tuple[Array, float]:
        if not loop.state:
            residual: Array = loop.images - loop.forward(x, waiting(progress, 0, 2))
            direction = loop.adjoint(residual, waiting(progress, 0, 2))
            loop.state = {"residual": residual, "direction": direction, "gradient": _squares(direction)}
        residual, direction, before = (loop.state[name] for name in ("residual", "direction", "gradient"))
        first = loop.state.setdefault("first", direction)
        change = loop.forward(direction, waiting(progress, 0, 2))
        length = _squares(change)
        if length > 0:  # else the least squares are reached
            share = (before / length).astype(np.float32)
            x = x + share * direction
            residual = residual - share * change
            gradient = loop.adjoint(residual, waiting(progress, 1, 2))
            after = _squares(gradient)
            direction = gradient + (after / before).astype(np.float32) * direction
            loop.state |= {"residual": residual, "direction": direction, "gradient": after}
            first_squares = _squares(first)
            leans = float(np.vdot(first, gradient)) ** 2 > _LEAN**2 * after * first_squares
            if leans and after > _DONE**2 * first_squares:
                loop.state["first"] = np.zeros_like(first)  # the warning is given once
                warn(_LEANS.format(number + 1), 2)
        tell(progress, 2, 2)
        return x, 0.5 * float(_squares(residual))

    return loop.run(step)


class LeastSquaresLoop(Loop):
    """The iterations of a method that finds x with ``A x`` near images: a `Loop` that knows them and begins with 0.

    Parameters
    ----------
    method, A, images, iterations, nonnegative
        See `sirt`.
    options, named
        See `IterativeOptions`.

    Attributes
    ----------
    images : array (M, n_v, n_u)
        What was measured, without the model's background; 0 in pixels that are dead in the model, which so are left out.
    weights : array (n_x, n_y, n_z)
        1 inside the mask, else 0.
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
        super().__init__(
            method, A, iterations, *options, **named, default=0.0, negative=not nonnegative, quantity=quantity
        )
        self._nonnegative = nonnegative
        background = A.background.astype(np.float32)
        measured = real_array(plain(images), "images", A.shape_out, np.float32) - background
        self.images: Array = np.where(A.living, measured, np.float32(0))
        self.weights: Array = self.mask.astype(np.float32)

    def record(self) -> dict[str, Any]:
        """Return the model's name, and weighted sums of views, images and mask, which change with the order of the views."""
        all_of = {"views": self._A.views.projection_matrices(), "images": self.images, "mask": self.weights}
        sums = {name: numbers.sum(axis=(1, 2), dtype=float) for name, numbers in all_of.items()}
        known = {name: float(of_each @ np.linspace(1.0, 2.0, len(of_each))) for name, of_each in sums.items()}
        return {"model": self._A.model.name, **known}

    def forward(self, x: Array, progress: Progress | None) -> Array:
        """Return ``A x``, float32 (M, n_v, n_u)."""
        return np.asarray(self._A(x, progress), np.float32)

    def adjoint(self, y: Array, progress: Progress | None) -> Array:
        """Return ``A.T y`` inside the mask and 0 outside, float32 (n_x, n_y, n_z)."""
        return np.asarray(self._A.T(y, progress), np.float32) * self.weights

    def bounded(self, x: Array) -> Array:
        """Return ``max(x, 0)`` if the method allows no negative values, otherwise `x`."""
        return np.maximum(x, np.float32(0)) if self._nonnegative else x


def inverse(sums: Array) -> Array:
    """Return 1 divided by sums of weights; 0 where these are 0, or negligible beside the largest."""
    least = 1e-6 * sums.max(initial=0.0)
    return np.divide(1, sums, out=np.zeros_like(sums), where=sums > least)


def _squares(numbers: Array) -> Array:
    return np.asarray(np.sum(np.square(numbers, dtype=float)))
