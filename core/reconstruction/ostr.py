"""Penalised likelihood of photons that pass, by ordered subsets of surrogates: OSTR."""

from typing import Any, Unpack

import numpy as np

from ..arrays import Array, ArrayLike
from ..errors import InputError
from ..progress import Progress, tell
from ..projector import Projector
from ..projector.subsets import access_order
from ..validation import real_array
from .arguments import argument
from .least_squares import LeastSquaresLoop, inverse
from .loop import IterativeOptions, plain, waiting
from .priors import Prior, penalty_of
from .result import Reconstruction


@argument("photons", float, "Of a pixel where nothing is between", "those of the run, or 1", above=0)
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

    Counts are Poisson-distributed, so a ray counts as much as photons pass on it, which `sirt` and `tv` do not know. Each
    update is a step for a subset of the views, ``x <- x + (A.T(passed - counts) - p' / n) / (A.T(A(1) c) + 2 p'' / n)``,
    with the photons that would pass x, the prior's derivatives, the number n of subsets, and the larger of both counts for
    the curvature c: that of a ray is nowhere larger on the way from x to what was measured.

    Parameters
    ----------
    A : Projector
        A projector of line integrals.
    images : array (M, n_v, n_u)
        Line integrals, ``log(photons / counts)``: the counts are made from them.
    subsets : int, optional
        By default about a fifth of the views' number. With 1 it ends at the maximum; with more it gets near it sooner.
    prior : Quadratic, RelativeDifference or TotalVariation, optional
        Their `edge` is of values, 1/mm: a thousandth of it would suit tissue.
    photons : number or array (M, n_v, n_u), optional
        Photons of a pixel where nothing is between. Without it 1: the prior's weight is then that for each photon.
    iterations, nonnegative, *options, **named
        See `sirt`.

    Returns
    -------
    Reconstruction
        `objective` is the penalised log-likelihood after each iteration, without terms that no volume changes.

    Raises
    ------
    InputError
        See `sirt`; a number of photons is not above 0, or the projector is of emission.

    References
    ----------
    H. Erdogan, J. A. Fessler, "Ordered subsets algorithms for transmission tomography", Physics in Medicine and Biology 44
    (1999) 2835-2851: separable paraboloidal surrogates; their precomputed curvature is `c` once the data are met.
    """
    loop = LeastSquaresLoop("OSTR", A, images, iterations, nonnegative, *options, **named)
    if A.model.takes == ("activity",):
        raise InputError(f"OSTR: expected a projector of line integrals, got one of {A.model.name}")
    blank = real_array(plain(1.0 if photons is None else photons), "photons", None, np.float32)
    if blank.shape not in ((), A.shape_out) or blank.min() <= 0:
        raise InputError(f"photons: expected more than 0, one number or images of {A.shape_out}")
    blank = np.broadcast_to(blank, A.shape_out)
    parts = A.subsets(max(1, len(A.views) // 5) if subsets is None else subsets)
    n = len(parts)
    counts = blank * np.exp(-loop.images)
    lengths = [np.asarray(part(loop.weights, loop.preparing())) for part in parts]
    is_seen = loop.adjoint(np.ones(A.shape_out, np.float32), loop.preparing()) > 0
    penalty = penalty_of(prior, A.grid, is_seen)

    def step(number: int, x: Array, progress: Progress | None) -> tuple[Array, float]:
        for k, s in enumerate(access_order(n)):
            part, asked = parts[s], waiting(progress, k, n + 1)
            measured = counts[part.which]
            passed = blank[part.which] * np.exp(-np.asarray(part(x, asked)))
            upwards: Array = np.asarray(part.T(passed - measured, asked)) * loop.weights
            scale: Array = np.asarray(part.T(lengths[s] * np.maximum(passed, measured), asked)) * loop.weights
            if penalty is not None:
                upwards = upwards - penalty.gradient(x) / n
                scale = scale + 2 * penalty.curvature(x) / n
            x = loop.bounded(x + upwards * inverse(scale))
        seen = loop.forward(x, waiting(progress, n, n + 1)).astype(np.float64)
        tell(progress, n + 1, n + 1)
        likely = -float(np.sum(blank * np.exp(-seen) + counts * seen))
        return x, likely if penalty is None else likely - penalty.value(x)

    kept = {"subsets": n, "nonnegative": nonnegative, "photons": float(blank.mean(dtype=float))}
    return loop.run(step, **kept, **({"prior": None} if prior is None else prior.record()))
