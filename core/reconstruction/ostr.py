"""Penalised likelihood of transmitted photons, maximised by ordered subsets of paraboloidal surrogates: OSTR."""

from typing import Any, Unpack

import numpy as np

from ..arrays import Array, ArrayLike
from ..errors import InputError
from ..progress import Progress, tell
from ..projector import Projector
from ..projector.subsets import access_order
from ..validation import real_array
from .arguments import argument
from .least_squares import LeastSquaresLoop, safe_inverse
from .loop import IterativeOptions, fixed_progress, numpy_if_tensor
from .priors import Prior, make_penalty
from .result import Reconstruction


@argument("photons", float, "Photons of a pixel without attenuation (blank scan)", "those of the run, or 1", above=0)
def ostr(
    A: Projector,
    images: ArrayLike,
    iterations: int = 30,
    subsets: int | None = None,
    prior: Prior | None = None,
    photons: ArrayLike | None = None,
    nonnegative: bool = True,
    *options: Any,
    **named: Unpack[IterativeOptions],
) -> Reconstruction:
    """Reconstruct the attenuation that maximises ``log-likelihood - prior`` of the transmitted photons (OSTR).

    Counts are Poisson-distributed, so a ray's weight is its number of transmitted photons; `sirt` and `tv` weight all rays
    alike. Each update is a step for a subset of the views,
    ``x <- x + (A.T(expected - counts) - p' / n) / (A.T(A(1) c) + 2 p'' / n)``, with the expected photons
    ``photons exp(-A x)``, the prior's derivatives p' and p'', the number n of subsets, and the curvature
    ``c = max(expected, counts)``, the upper bound of a ray's curvature between x and the measurement.

    Parameters
    ----------
    A : Projector
        A projector of line integrals.
    images : array (M, n_v, n_u)
        Line integrals, ``log(photons / counts)``; the counts are computed from them.
    subsets : int, optional
        Number of subsets; by default about a fifth of the number of views. With 1 the method converges to the maximum; with
        more it gets near the maximum sooner.
    prior : Quadratic, RelativeDifference or TotalVariation, optional
        Penalty on noise. A prior's `edge` is in the volume's unit, here 1/mm: for tissue, a thousandth of 1/mm is suitable.
    photons : float or array (M, n_v, n_u), optional
        Photons of a pixel without any attenuation. By default 1: the prior's weight is then relative to one photon.
    iterations, nonnegative, *options, **named
        See `sirt`.

    Returns
    -------
    Reconstruction
        `objective` is the penalised log-likelihood after each iteration, without the terms that do not depend on the volume.

    Raises
    ------
    InputError
        See `sirt`; a number of photons is not above 0, or the projector is of emission.

    References
    ----------
    H. Erdogan, J. A. Fessler, "Ordered subsets algorithms for transmission tomography", Physics in Medicine and Biology 44
    (1999) 2835-2851: separable paraboloidal surrogates; their precomputed curvature is the limit of `c` where the volume
    fits the data.
    """
    loop = LeastSquaresLoop("OSTR", A, images, iterations, nonnegative, *options, **named)
    if A.model.takes == ("activity",):
        raise InputError(f"OSTR: expected a projector of line integrals, got one of {A.model.name}")
    blank = real_array(numpy_if_tensor(1.0 if photons is None else photons), "photons", None, np.float32)
    if blank.shape not in ((), A.shape_out) or blank.min() <= 0:
        raise InputError(f"photons: expected more than 0, one number or images of {A.shape_out}")
    blank = np.broadcast_to(blank, A.shape_out)
    projectors = A.subsets(max(1, len(A.views) // 5) if subsets is None else subsets)
    n = len(projectors)
    counts = blank * np.exp(-loop.images)
    lengths = [np.asarray(projector(loop.weights, loop.preparing())) for projector in projectors]  # A(1), mm
    visible = loop.adjoint(np.ones(A.shape_out, np.float32), loop.preparing()) > 0
    penalty = make_penalty(prior, A.grid, visible)

    def step(number: int, x: Array, progress: Progress | None) -> tuple[Array, float]:
        """Return the next volume after `x`, and its objective, in iteration `number`."""
        for k, s in enumerate(access_order(n)):
            projector, subset_progress = projectors[s], fixed_progress(progress, k, n + 1)
            measured = counts[projector.which]
            expected = blank[projector.which] * np.exp(-np.asarray(projector(x, subset_progress)))
            gradient: Array = np.asarray(projector.T(expected - measured, subset_progress)) * loop.weights
            bounds = lengths[s] * np.maximum(expected, measured)
            curvature: Array = np.asarray(projector.T(bounds, subset_progress)) * loop.weights
            if penalty is not None:
                gradient = gradient - penalty.gradient(x) / n
                curvature = curvature + 2 * penalty.curvature(x) / n
            x = loop.bounded(x + gradient * safe_inverse(curvature))
        integrals = loop.forward(x, fixed_progress(progress, n, n + 1)).astype(np.float64)
        tell(progress, n + 1, n + 1)
        likelihood = -float(np.sum(blank * np.exp(-integrals) + counts * integrals))
        return x, likelihood if penalty is None else likelihood - penalty.value(x)

    settings = {"subsets": n, "nonnegative": nonnegative, "photons": float(blank.mean(dtype=float))}
    return loop.run(step, **settings, **({"prior": None} if prior is None else prior.record()))
