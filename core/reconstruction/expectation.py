"""Maximum likelihood by expectation maximisation: MLEM and its ordered-subsets form OSEM."""

from typing import Any, Unpack

import numpy as np

from ..arrays import Array, ArrayLike
from ..errors import warn
from ..progress import Progress, tell
from ..projector import Projector
from ..projector.subsets import access_order
from .arguments import argument
from .counts import NEGLIGIBLE, CountLoop
from .loop import IterativeOptions, fixed_progress
from .priors import Prior
from .result import Reconstruction

_SMALLEST_DIVISOR = 0.1
"""Lower bound of the divisor ``sensitivity + prior gradient``, as a share of the sensitivity."""
_MAX_BOUNDED_SHARE = 0.05
"""Share of the voxels at the divisor's lower bound above which volumes oscillate from iteration to iteration."""


@argument("iterations", int, "Number of passes over all images", "what suits the method", least=1, slider=100)
@argument(
    "background",
    float,
    "Expected counts of each pixel that do not come from the volume, such as scatter",
    least=0,
    slider=100,
)
def mlem(
    A: Projector,
    counts: ArrayLike,
    iterations: int = 50,
    background: ArrayLike = 0.0,
    *options: Any,
    scatter: str = "none",
    prior: Prior | None = None,
    **named: Unpack[IterativeOptions],
) -> Reconstruction:
    """Reconstruct the activity of maximum likelihood (MLEM): ``x <- x / A.T(1) * A.T(counts / (A x + background))``.

    Parameters
    ----------
    A : Projector
        A projector of emission, from the volume's grid to the counts' images.
    counts : array or tensor (M, n_v, n_u)
        Measured counts, 0 or more; expected counts, which may be fractions, are allowed too.
    iterations : int
        Number of iterations of this call. Without a prior the log-likelihood never falls from one to the next.
    background : float, array (M,) or (M, n_v, n_u)
        Expected counts that do not come from the volume, such as scatter.
    *options, **named
        See `IterativeOptions`. Without `start` every voxel begins with 1; voxels that are 0 in `start` stay 0.
    prior : Quadratic, RelativeDifference or TotalVariation, optional
        Penalty on noise, applied one step late (Green 1990): the prior's gradient at the volume before the update is added
        to the sensitivity in the divisor. The divisor is at least a tenth of the sensitivity, so that the volume stays
        positive and no update is more than ten times as large as without a prior. The penalised likelihood may fall;
        `bsrem` maximises it.
    scatter : str
        "body": photons that are scattered in the body of `A.model.mu` are expected besides the background. They are
        simulated (`scatter_images`) from the volume after 1, 2, 4, 8 and so on iterations, until the modules' totals change
        by less than 1 %, so that the objective is of another background after each of them. The model needs `mu`,
        `isotope` and `energy_fwhm`. "none": the background holds all.

    Returns
    -------
    Reconstruction
        `objective` is the log-likelihood minus the prior's penalty after each iteration, without the terms that do not
        depend on the volume. Voxels that no pixel sees are 0. Pixels with counts but without any expected counts are
        ignored.

    Raises
    ------
    InputError
        Counts, background, start or mask have a wrong shape or grid, or are negative or not finite; `prior` is no prior, or
        its anatomy has another grid; `start` is a reconstruction from other data, another model or other arguments; the
        model lacks what `scatter` needs.

    Warns
    -----
    InputWarning
        The iterations ended before the estimate of scatter was final, or the background holds images, perhaps of scatter.

    References
    ----------
    L. A. Shepp, Y. Vardi, "Maximum likelihood reconstruction for emission tomography", IEEE Transactions on Medical Imaging
    1 (1982) 113-122.

    P. J. Green, "Bayesian reconstructions from emission tomography data using a modified EM algorithm", IEEE Transactions on
    Medical Imaging 9 (1990) 84-93.
    """
    return _em(CountLoop("MLEM", A, counts, iterations, 1, prior, background, *options, scatter=scatter, **named))


@argument("subsets", int, "Number of subsets of the modules; each update of an iteration uses one subset",
          "about a fifth of the number of modules", least=1, slider=80)  # fmt: skip
def osem(
    A: Projector,
    counts: ArrayLike,
    iterations: int = 10,
    subsets: int | None = None,
    prior: Prior | None = None,
    background: ArrayLike = 0.0,
    *options: Any,
    scatter: str = "none",
    **named: Unpack[IterativeOptions],
) -> Reconstruction:
    """Reconstruct the activity of approximately maximum likelihood by an MLEM update for each subset of the views (OSEM).

    The parameters are those of `mlem`. At first OSEM is faster by a factor of about the number of subsets. It ends near the
    maximum of the likelihood, not at it, and the likelihood may fall. `subsets` is by default about a fifth of the number of
    views, so that each subset sees the object from five or more directions. A voxel that a subset does not see keeps its
    value in that update.

    References
    ----------
    H. M. Hudson, R. S. Larkin, "Accelerated image reconstruction using ordered subsets of projection data", IEEE
    Transactions on Medical Imaging 13 (1994) 601-609.
    """
    return _em(CountLoop("OSEM", A, counts, iterations, subsets, prior, background, *options, scatter=scatter, **named))


def _em(loop: CountLoop) -> Reconstruction:
    """Run the expectation-maximisation updates of all subsets in each iteration and return the reconstruction."""
    n, penalty = len(loop.subsets), loop.penalty
    loop.values = np.where(loop.visible, loop.values, np.float32(0))
    bounded_share = 0.0  # largest share of the voxels in which the prior pulls the divisor below its lower bound

    def step(number: int, x: Array, progress: Progress | None) -> tuple[Array, float]:
        """Return the next volume after `x`, and its objective, in iteration `number`."""
        nonlocal bounded_share
        for k, s in enumerate(access_order(n)):
            projector, data = loop.subsets[s]
            subset_progress = fixed_progress(progress, k, n)
            factor = projector.T(data.ratio(loop.images(s, x, subset_progress)), subset_progress)
            divisor = loop.sensitivities[s]
            if penalty is not None:
                penalised, lower_bound = divisor + penalty.gradient(x) / n, _SMALLEST_DIVISOR * divisor
                bounded_share = max(bounded_share, float(np.mean((penalised < lower_bound)[loop.visible])))
                divisor = np.maximum(penalised, lower_bound)
            factor = np.divide(factor, divisor, out=np.ones_like(x), where=loop.sensitivities[s] > NEGLIGIBLE)
            x = np.multiply(x, factor, out=factor)
            tell(progress, k + 1, n)
        return x, loop.objective(x, fixed_progress(progress, n, n))

    result = loop.run(step)
    if bounded_share > _MAX_BOUNDED_SHARE:
        warn(f"prior: too strong for one step late in {bounded_share:.0%} of the voxels: take less weight, or bsrem")
    return result
