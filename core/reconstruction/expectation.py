"""Maximum likelihood by expectation maximisation: MLEM and OSEM."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..errors import warn
from ..memory import require
from ..progress import Progress, tell
from ..projector import Projector
from ..projector.subsets import access_order, balanced_subsets
from .counts import LEAST, CountData
from .loop import Loop, Start, waiting
from .priors import Prior, penalty_of
from .result import Array, Callback, Reconstruction
from .stopping import StoppingRule

# Of the sensitivity: less than this share a prior leaves nowhere.
_LEAST_SHARE = 0.1
_TOO_LATE = 0.05
"""Of the voxels: where a prior goes below that share in more, volumes swing from iteration to iteration."""


def mlem(
    A: Projector,
    counts: ArrayLike,
    iterations: int = 50,
    background: ArrayLike = 0.0,
    start: Start = None,
    mask: ArrayLike | None = None,
    callback: Callback | None = None,
    progress: Progress | None = None,
    stop: StoppingRule | None = None,
    prior: Prior | None = None,
) -> Reconstruction:
    """The activity for which the counts are most likely, by MLEM: ``x <- x / A.T(1) * A.T(counts / (A x + background))``.

    Parameters
    ----------
    A : Projector
        Of emission: from the volume's grid to the counts' images.
    counts : array or tensor (M, n_v, n_u)
        Measured, 0 or more; expected means may be fractions.
    iterations : int
        To do in this call. The log-likelihood never falls from one to the next.
    background : number, array (M,) or (M, n_v, n_u)
        Counts expected besides those of the volume, such as scatter.
    start : Volume, array, tensor or Reconstruction, optional
        Begin with this; by default with 1 everywhere. What is 0 stays 0. A reconstruction by the same method goes on with
        the same numbers as without a break, its log too; the other arguments must be what they were.
    mask : array of bool, optional
        Of the grid's shape; outside it the volume is 0.
    callback
        See `Callback`.
    progress
        Called as ``progress(updates done, updates)``; what it raises stops the work. A `Cancelled` has what was done
        before as its `reconstruction`.
    stop : StoppingRule, optional
        Such as `StopWhen`; ends it earlier.
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
    loop = Loop("MLEM", A, iterations, start, mask, callback, progress, stop)
    return _em(loop, A, CountData.of("MLEM", A, counts, background), 1, prior)


def osem(
    A: Projector,
    counts: ArrayLike,
    iterations: int = 10,
    subsets: int | None = None,
    prior: Prior | None = None,
    background: ArrayLike = 0.0,
    start: Start = None,
    mask: ArrayLike | None = None,
    callback: Callback | None = None,
    progress: Progress | None = None,
    stop: StoppingRule | None = None,
) -> Reconstruction:
    """As `mlem`, but each iteration updates the volume once for each subset of the views (OSEM).

    Faster by about the number of subsets at first; it ends beside the maximum of the likelihood, which may fall. `subsets`
    is by default about a fifth of the views' number, so that each sees the object from five sides or more. A voxel that a
    subset does not see keeps its value in that update.

    References
    ----------
    H. M. Hudson, R. S. Larkin, "Accelerated image reconstruction using ordered subsets of projection data", IEEE
    Transactions on Medical Imaging 13 (1994) 601-609.
    """
    loop = Loop("OSEM", A, iterations, start, mask, callback, progress, stop)
    data = CountData.of("OSEM", A, counts, background)
    return _em(loop, A, data, usual_subsets(A) if subsets is None else subsets, prior)


def usual_subsets(A: Projector) -> int:
    """About a fifth of the views' number."""
    return max(1, len(A.views) // 5)


def _em(loop: Loop, A: Projector, data: CountData, subsets: Any, prior: Prior | None) -> Reconstruction:
    parts = subsets_of(A, data, subsets)
    n = len(parts)
    seen = sensitivities(A, parts, loop.preparing())
    total = sum(seen[1:], seen[0])
    visible = loop.inside(total > LEAST)
    penalty = penalty_of(prior, A.grid, visible)
    loop.values = np.where(visible, loop.values, np.float32(0))
    images: Array | None = None  # of the current volume, where they are known
    too_late = 0.0  # largest share of the voxels in which the prior outweighs the counts

    def step(number: int, x: Array, progress: Progress | None) -> tuple[Array, float]:
        nonlocal images, too_late
        for k, s in enumerate(access_order(n)):
            part, own = parts[s]
            asked = waiting(progress, k, n)
            factor = part.T(own.ratio(part(x, asked) if images is None or n > 1 else images), asked)
            divisor = seen[s]
            if penalty is not None:
                late, least = divisor + penalty.gradient(x) / n, _LEAST_SHARE * divisor
                too_late = max(too_late, float(np.mean((late < least)[visible])))
                divisor = np.maximum(late, least)
            factor = np.divide(factor, divisor, out=np.ones_like(x), where=seen[s] > LEAST)
            x = np.multiply(x, factor, out=factor)
            tell(progress, k + 1, n)
        return x, objective(x, waiting(progress, n, n))

    def objective(x: Array, asked: Progress | None) -> float:
        nonlocal images
        images = A(x, asked)
        likelihood = data.log_likelihood(images)
        return likelihood if penalty is None else likelihood - penalty.value(x)

    result = loop.run(step, {"subsets": n, **data.record(total, prior)}, objective)
    if too_late > _TOO_LATE:
        warn(f"prior: too strong for one step late in {too_late:.0%} of the voxels: take less weight, or bsrem")
    return result


def subsets_of(A: Projector, data: CountData, n: Any) -> list[tuple[Projector, CountData]]:
    """The projectors of `n` subsets, each with its counts. Raises InputError unless `n` is from 1 to their number."""
    views = balanced_subsets(A.views, n)
    if len(views) == 1:
        return [(A, data)]
    return [(part, data[own]) for part, own in zip(A.subsets(len(views)), views, strict=True)]


def sensitivities(A: Projector, parts: list[tuple[Projector, CountData]], progress: Progress | None) -> list[Array]:
    """Counts that one unit of activity in each voxel gives in each subset."""
    require(4 * A.grid.n_voxels * len(parts), f"the sensitivities of {len(parts)} subsets")
    return [part.T(np.ones(part.shape_out, np.float32), progress).astype(np.float32, copy=False) for part, _ in parts]
