"""OSEM volumes after several numbers of iterations, for many scans of one scanner: inputs and baselines of networks."""

from collections.abc import Sequence

import numpy as np

from ..arrays import Array
from ..progress import Progress, tell
from ..projector import Projector
from ..projector.subsets import in_access_order
from .counts import NEGLIGIBLE, CountData


class Snapshots:
    """OSEM with subsets and sensitivities that are computed once: the updates of `osem`, without objective and options.

    The initial volume is uniform and has as many expected counts as were measured, so that the result is proportional to
    counts and background.

    Parameters
    ----------
    A : Projector
        Projector of emission.
    subsets : int
        Number of subsets, see `osem`.
    """

    def __init__(self, A: Projector, subsets: int) -> None:
        self._A, self._subsets = A, in_access_order(A.subsets(subsets))
        self._sensitivities = [np.asarray(B.T(np.ones(B.shape_out, np.float32))) for B in self._subsets]
        total = np.sum(self._sensitivities, axis=0)
        self._uniform = (total > NEGLIGIBLE) / total.sum(dtype=float)  # uniform volume with one expected count

    def __call__(
        self, counts: Array, numbers: Sequence[int], background: Array | float = 0.0, progress: Progress | None = None
    ) -> Array:
        """Return the volumes (n, n_x, n_y, n_z) after each of n `numbers` of iterations, in ascending order.

        `counts` are measured images (M, n_v, n_u), float32; `background` are the expected counts of each pixel that do not
        come from the volume, the model's background included.
        """
        data = CountData(counts, np.broadcast_to(np.float32(background), counts.shape)).without_dead_pixels(self._A)
        subset_data = [data[projector.which] for projector in self._subsets]
        x, volumes = (data.counts.sum(dtype=float) * self._uniform).astype(np.float32), []
        for number in range(1, max(numbers) + 1):
            for projector, measured, sensitivity in zip(self._subsets, subset_data, self._sensitivities, strict=True):
                factor = projector.T(measured.ratio(np.asarray(projector(x))))
                x = x * np.divide(factor, sensitivity, out=np.ones_like(x), where=sensitivity > NEGLIGIBLE)
            volumes += [x] * (number in numbers)
            tell(progress, number, max(numbers))
        return np.stack(volumes)
