"""Maximum likelihood by expectation maximisation: MLEM and OSEM."""

from typing import Any, Unpack

import numpy as np

from ..arrays import Array, ArrayLike
from ..errors import warn
from ..progress import Progress, tell
from ..projector import Projector
from ..projector.subsets import access_order
from .arguments import argument
from .counts import LEAST, CountLoop
from .loop import IterativeOptions, waiting
from .priors import Prior
from .result import Reconstruction

_LEAST_SHARE = 0.1
"""A prior leaves at least this share of the sensitivity everywhere."""
_TOO_LATE = 0.05
"""Factor of the one-step-late update below which, in a larger share of voxels, volumes swing between iterations."""


@argument("iterations", int, "How often all images are used", "what suits the method", least=1, slider=100)
@argument(
    "background",
    float,
    "Counts expected in each pixel besides those of the volume, such as scatter",
    least=0,
    slider=100,
)
def mlem(
    A: Projector,
    counts: ArrayLike,
    iterations: int = 50,
    background: ArrayLike = 0.0,
    *options: Any,
    prior: Prior | None = None,
    **named: Unpack[IterativeOptions],
) -> Reconstruction:
    """Reconstruct the activity of maximum likelihood (MLEM): ``x <- x / A.T(1) * A.T(counts / (A x + background))``.

    Parameters
    ----------
    A : Projector
        A projector of emission, from the volume's grid to the counts' images.
    counts : array or tensor (M, n_v, n_u)
        Measured counts, 0 or more; expected means may be fractions.
    iterations : int
        How many are done in this call. The log-likelihood never falls from one to the next.
    background : number, array (M,) or (M, n_v, n_u)
        Counts expected besides those of the volume, such as scatter.
    *options, **named
        See `IterativeOptions`. Without `start` it begins with 1 everywhere; what is 0 in `start` stays 0.
    prior : Quadratic, RelativeDifference or TotalVariation, optional
        Penalises noise, one step late: its gradient at the volume before the update is added to the sensitivity that divides
        (Green 1990). Where the sum is below a tenth of the sensitivity it is that tenth, so that the volume stays positive
        and a strong prior's update goes at most ten times as far. The penalised likelihood may fall; `bsrem` makes it as
        large as it can be.

    Returns
    -------
    Reconstruction
        `objective` is the log-likelihood after each iteration, without terms that no volume changes, less the prior's
        penalty. Voxels that no pixel sees are 0. Pixels with counts which neither the volume nor the background can have
        caused are left out.

    Raises
    ------
    InputError
        Counts, background, start or mask have another shape or grid, or are negative or not finite; `prior` is none, or its
        anatomy has another grid; `start` is to be resumed with other data, another model or other arguments.

    References
    ----------
    L. A. Shepp, Y. Vardi, "Maximum likelihood reconstruction for emission tomography", IEEE Transactions on Medical Imaging
    1 (1982) 113-122.

    P. J. Green, "Bayesian reconstructions from emission tomography data using a modified EM algorithm", IEEE Transactions on
    Medical Imaging 9 (1990) 84-93.
    """
    return _em(CountLoop("MLEM", A, counts, iterations, 1, prior, background, *options, **named))


@argument("subsets", int, "Of the modules: each of an iteration's updates uses one of them",
          "about a fifth of the modules' number", least=1, slider=80)  # fmt: skip
def osem(
    A: Projector,
    counts: ArrayLike,
    iterations: int = 10,
    subsets: int | None = None,
    prior: Prior | None = None,
    background: ArrayLike = 0.0,
    *options: Any,
    **named: Unpack[IterativeOptions],
) -> Reconstruction:
    """Reconstruct the activity of approximately maximum likelihood by an MLEM update for each subset of the views (OSEM).

    It is faster than `mlem`, whose parameters it takes, by about the number of subsets at first; it ends beside the maximum
    of the likelihood, which may fall. `subsets` is by default about a fifth of the views' number, so that each sees the
    object from five sides or more. A voxel that a subset does not see keeps its value in that update.

    References
    ----------
    H. M. Hudson, R. S. Larkin, "Accelerated image reconstruction using ordered subsets of projection data", IEEE
    Transactions on Medical Imaging 13 (1994) 601-609.
    """
    return _em(CountLoop("OSEM", A, counts, iterations, subsets, prior, background, *options, **named))


def _em(loop: CountLoop) -> Reconstruction:
    n, penalty = len(loop.parts), loop.penalty
    loop.values = np.where(loop.visible, loop.values, np.float32(0))
    too_late = 0.0  # largest share of the voxels in which the prior outweighs the counts

    def step(number: int, x: Array, progress: Progress | None) -> tuple[Array, float]:
        nonlocal too_late
        for k, s in enumerate(access_order(n)):
            part, own = loop.parts[s]
            asked = waiting(progress, k, n)
            factor = part.T(own.ratio(loop.images(s, x, asked)), asked)
            divisor = loop.seen[s]
            if penalty is not None:
                late, least = divisor + penalty.gradient(x) / n, _LEAST_SHARE * divisor
                too_late = max(too_late, float(np.mean((late < least)[loop.visible])))
                divisor = np.maximum(late, least)
            factor = np.divide(factor, divisor, out=np.ones_like(x), where=loop.seen[s] > LEAST)
            x = np.multiply(x, factor, out=factor)
            tell(progress, k + 1, n)
        return x, loop.objective(x, waiting(progress, n, n))

    result = loop.run(step)
    if too_late > _TOO_LATE:
        warn(f"prior: too strong for one step late in {too_late:.0%} of the voxels: take less weight, or bsrem")
    return result
