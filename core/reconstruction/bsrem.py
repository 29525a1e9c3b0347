"""Penalised likelihood to its maximum, by relaxed steps of subsets: BSREM."""

from typing import Any, Unpack

import numpy as np

from ..arrays import Array, ArrayLike
from ..memory import require
from ..progress import Progress, tell
from ..projector import Projector
from ..projector.subsets import access_order
from ..validation import at_least_0
from .arguments import argument
from .counts import LEAST, CountLoop
from .loop import IterativeOptions, waiting
from .priors import Prior
from .result import Reconstruction

_LEAST_SHARE = np.float32(0.1)
"""An update leaves at least this share of a voxel's value, so that one bad step can be mended."""
_LIFT = 0.01
"""Voxels are moved as if they had so much of the mean activity more, so that those of 0 can grow."""
_NOTHING = 1e-6
"""Less than this share of the mean activity is 0."""
_ROUNDING = 2e-9
"""Changes of the objective by a smaller share are rounding."""
_LEAST_GAIN = 0.5
"""An iteration that gains less than this share of what one step of all views promises goes in circles: its steps are too
long."""
_MOST_HALVINGS = 20
"""After so many halvings nothing is gained by smaller steps."""


@argument("step_decay", float, "Steps are 1 / (1 + this times the number of iterations before)", least=0, slider=1)
def bsrem(
    A: Projector,
    counts: ArrayLike,
    iterations: int = 30,
    subsets: int | None = None,
    prior: Prior | None = None,
    step_decay: float = 0.0,
    background: ArrayLike = 0.0,
    *options: Any,
    **named: Unpack[IterativeOptions],
) -> Reconstruction:
    """Reconstruct the activity that maximises ``log-likelihood - prior`` (BSREM); converges to the maximum, unlike OSEM.

    Each iteration takes a step for each subset of the views, ``x <- x + step * x / (s + x c) * gradient``, with s the
    sensitivity and c the prior's curvature (and x lifted a little, so that zeros can grow). In the first iteration the
    subset's gradient stands for that of all. From the second on it is corrected by what it was at the iteration's beginning,
    where that of all views is known (Johnson & Zhang 2013, Twyman et al. 2023): so it ends at the maximum without the steps
    having to shrink, in tens of iterations instead of thousands. Each costs about two of `osem`.

    Parameters
    ----------
    A, counts, iterations, background
        See `mlem`.
    subsets : int, optional
        By default about a fifth of the views' number.
    prior : Quadratic, RelativeDifference or TotalVariation, optional
        Without one it ends at the maximum of the likelihood, as `mlem` does, but sooner.
    step_decay : float
        Steps are ``1 / (1 + step_decay n)`` in iteration n, counted from 0. Besides, an iteration in which the objective
        would fall, other than the first, is done again with half the step, and so are all that follow.
    *options, **named
        See `IterativeOptions`. Without `start` it begins with the mean activity; zeros in `start` may grow. With a prior,
        ``stop=StopWhen(change=1e-8)`` left no voxel further than 1 % of the mean activity from the maximum in our tests,
        1e-6 some as far as 10 %.

    Returns
    -------
    Reconstruction
        `objective` is the penalised log-likelihood after each iteration, without terms that no volume changes. Voxels that
        no pixel sees are 0.

    Raises
    ------
    InputError
        See `mlem`; and `step_decay` is negative.

    References
    ----------
    A. R. De Pierro, M. E. B. Yamagishi, "Fast EM-like methods for maximum a posteriori estimates in emission tomography",
    IEEE Transactions on Medical Imaging 20 (2001) 280-288.

    S. Ahn, J. A. Fessler, "Globally convergent image reconstruction for emission tomography using relaxed ordered subsets
    algorithms", IEEE Transactions on Medical Imaging 22 (2003) 613-626: bounds and scaling of the steps.

    R. Johnson, T. Zhang, "Accelerating stochastic gradient descent using predictive variance reduction", Advances in Neural
    Information Processing Systems 26 (2013) 315-323.

    R. Twyman et al., "An investigation of stochastic variance reduction algorithms for relative difference penalized 3D PET
    image reconstruction", IEEE Transactions on Medical Imaging 42 (2023) 29-41.
    """
    step_decay = at_least_0(step_decay, "step_decay")
    loop = CountLoop("BSREM", A, counts, iterations, subsets, prior, background, *options, **named)
    n, penalty, total = len(loop.parts), loop.penalty, loop.total
    require(8 * n * A.grid.n_voxels, f"the gradients of {n} subsets")
    # At the maximum no voxel gives more counts than there are.
    n_counts = loop.data.counts.sum(dtype=float)
    most = np.divide(np.float32(n_counts), total, out=np.zeros_like(total), where=loop.visible)
    mean = n_counts / max(float(total.sum(where=loop.visible, dtype=float)), float(LEAST))
    lift, nothing = np.float32(_LIFT * mean), np.float32(_NOTHING * mean)
    loop.values = np.minimum(loop.values if loop.is_given else np.float32(mean), most)

    def gradient(s: int, x: Array, asked: Progress | None) -> Array:
        part, own = loop.parts[s]
        return part.T(own.ratio(loop.images(s, x, asked)), asked) - loop.seen[s]

    def moved(x: Array, upwards: Array, scale: Array, size: float) -> Array:
        """Return the volume a step further along a gradient, within its bounds."""
        found = np.divide(x + lift, scale, out=np.zeros_like(x), where=loop.visible)
        found *= np.float32(size)
        found *= upwards
        found += x
        found = np.clip(found, _LEAST_SHARE * x, most)
        found[found < nothing] = 0
        return found

    def step(number: int, x: Array, progress: Progress | None) -> tuple[Array, float]:
        halvings = int(loop.state.get("halvings", np.zeros(()))[()])
        scale = total if penalty is None else total + (x + lift) * penalty.curvature(x)
        before, least_gain = -np.inf, 0.0
        at_start: list[Array] = []
        overall = np.zeros_like(x)
        if number:  # far from the maximum the plain steps, which are those of OSEM, get on faster
            before = loop.last
            at_start = [gradient(s, x, waiting(progress, s, 2 * n)) for s in range(n)]
            overall = np.sum(at_start, axis=0)
            whole = overall if penalty is None else overall - penalty.gradient(x)
            least_gain = _LEAST_GAIN * float(np.sum(whole * (moved(x, whole, scale, 1.0) - x), dtype=float))
        while True:
            size = 0.5**halvings / (1 + step_decay * number)
            found = x
            for k, s in enumerate(access_order(n)):
                asked = waiting(progress, n + k, 2 * n)
                if at_start and k == 0:  # the volume has not changed yet
                    upwards = overall
                else:
                    upwards = n * gradient(s, found, asked)
                    if at_start:
                        upwards += overall - n * at_start[s]
                if penalty is not None:
                    upwards = upwards - penalty.gradient(found)
                found = moved(found, upwards, scale, size)
            reached = loop.objective(found, waiting(progress, 2 * n - 1, 2 * n))
            rounding = _ROUNDING * abs(reached)
            if halvings < _MOST_HALVINGS and reached < before + size * least_gain - rounding:
                halvings += 1
            if reached >= before - rounding or halvings == _MOST_HALVINGS:
                break
        loop.state["halvings"] = np.array(float(halvings))
        tell(progress, 2 * n, 2 * n)
        return found, reached

    return loop.run(step, step_decay=step_decay)
