"""Maximum likelihood by expectation maximisation: MLEM and OSEM."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from ..progress import Progress, part_of
from ..projector import Projector
from ..projector.subsets import access_order, balanced_subsets
from ..validation import whole_number
from ..volumes.volume import Volume
from .counts import CountData, starting_values
from .result import Callback, Reconstruction


def mlem(
    A: Projector,
    counts: ArrayLike,
    iterations: int = 50,
    background: ArrayLike = 0.0,
    start: Volume | ArrayLike | None = None,
    mask: ArrayLike | None = None,
    callback: Callback | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """The activity for which the counts are most likely, by MLEM: ``x <- x / A.T(1) * A.T(counts / (A x + background))``.

    Parameters
    ----------
    A : Projector
        Of emission: from the volume's grid to the counts' images.
    counts : array (M, n_v, n_u)
        Measured, 0 or more; expected means may be fractions.
    iterations : int
        The log-likelihood never falls from one to the next.
    background : number, array (M,) or (M, n_v, n_u)
        Counts expected besides those of the volume, such as scatter.
    start : Volume or array, optional
        Begin with this; by default with 1 everywhere. What is 0 stays 0. The last volume of a reconstruction goes on where
        that ended, with the same numbers as without a break.
    mask : array of bool, optional
        Of the grid's shape; outside it the volume is 0.
    callback
        See `Callback`.
    progress
        Called as ``progress(iterations done, iterations)``; what it raises stops the work.

    Returns
    -------
    Reconstruction
        `objective` is the log-likelihood after each iteration, without terms that no volume changes. Voxels that no pixel
        sees are 0.

    Raises
    ------
    InputError
        Counts, background, start or mask have another shape, or are negative or not finite.

    References
    ----------
    L. A. Shepp, Y. Vardi, "Maximum likelihood reconstruction for emission tomography", IEEE Transactions on Medical Imaging
    1 (1982) 113-122.
    """
    return _em(A, counts, iterations, 1, background, start, mask, callback, progress, "MLEM")


def osem(
    A: Projector,
    counts: ArrayLike,
    iterations: int = 10,
    subsets: int | None = None,
    background: ArrayLike = 0.0,
    start: Volume | ArrayLike | None = None,
    mask: ArrayLike | None = None,
    callback: Callback | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """As `mlem`, but each iteration updates the volume once for each subset of the views (OSEM).

    Faster by about the number of subsets at first; it ends beside the maximum of the likelihood, which may fall. `subsets`
    is by default about a fifth of the views' number, so that each sees the object from five sides or more.

    References
    ----------
    H. M. Hudson, R. S. Larkin, "Accelerated image reconstruction using ordered subsets of projection data", IEEE
    Transactions on Medical Imaging 13 (1994) 601-609.
    """
    if subsets is None and isinstance(A, Projector):
        subsets = max(1, len(A.views) // 5)
    return _em(A, counts, iterations, subsets, background, start, mask, callback, progress, "OSEM")


def _em(
    A: Projector,
    counts: ArrayLike,
    iterations: int,
    subsets: Any,
    background: ArrayLike,
    start: Volume | ArrayLike | None,
    mask: ArrayLike | None,
    callback: Callback | None,
    progress: Progress | None,
    name: str,
) -> Reconstruction:
    data = CountData.of(A, counts, background)
    iterations = whole_number(iterations, "iterations")
    if A.model.takes != ("activity",):
        raise InputError(f"{name}: expected a projector of emission, got one of {A.model.name}")
    x = starting_values(A, start, mask)
    if subsets == 1:
        steps = [(A, data)]
    else:
        views = balanced_subsets(A.views, subsets)
        steps = [(part, data[own]) for part, own in zip(A.subsets(len(views)), views, strict=True)]
    seen = [part.T(np.ones(part.shape_out, np.float32)) for part, _ in steps]
    objective: list[float] = []
    images = A(x) if len(steps) == 1 else None
    for i in range(iterations):
        done = part_of(progress, i, iterations)
        for k, s in enumerate(access_order(len(steps))):
            part, own = steps[s]
            back = part.T(own.ratio(part(x) if images is None or len(steps) > 1 else images))
            x = np.divide(x * back, seen[s], out=np.zeros_like(x), where=seen[s] > 0)
            if done is not None:
                done(k + 1, len(steps))
        images = A(x)
        objective.append(data.log_likelihood(images))
        if callback is not None and callback(i + 1, x):
            break
    settings = {"method": name, "iterations": len(objective), "subsets": len(steps)}
    return Reconstruction(Volume(x, A.grid, "activity"), np.array(objective), settings)
