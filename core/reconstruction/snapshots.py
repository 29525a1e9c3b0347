"""Volumes on the way of OSEM, of many scans by one scanner: what networks begin with, and baselines are chosen from."""

from collections.abc import Sequence

import numpy as np

from ..arrays import Array
from ..progress import Progress, tell
from ..projector import Projector
from ..projector.subsets import in_access_order
from .counts import LEAST, CountData


class Snapshots:
    """OSEM whose subsets and sensitivities are made once: the numbers of `osem`, without its objective and options.

    It begins with the even volume that gives as many counts, so that twice the counts and background give twice the volume.

    Parameters
    ----------
    A : Projector
        Of emission.
    subsets : int
        See `osem`.
    """

    def __init__(self, A: Projector, subsets: int) -> None:
        self._A, self._parts = A, in_access_order(A.subsets(subsets))
        self._seen = [np.asarray(part.T(np.ones(part.shape_out, np.float32))) for part in self._parts]
        total = np.sum(self._seen, axis=0)
        self._even = (total > LEAST) / total.sum(dtype=float)  # of one count

    def __call__(
        self, counts: Array, after: Sequence[int], background: Array | float = 0.0, progress: Progress | None = None
    ) -> Array:
        """Return the volumes (len(after), n_x, n_y, n_z) after so many iterations, in growing order.

        Counts (M, n_v, n_u) and background, all that is expected besides the volume, are of the projector's shape, float32.
        """
        data = CountData(counts, np.broadcast_to(np.float32(background), counts.shape)).living(self._A)
        own = [data[part.which] for part in self._parts]
        x, found = (data.counts.sum(dtype=float) * self._even).astype(np.float32), []
        for number in range(1, max(after) + 1):
            for part, measured, seen in zip(self._parts, own, self._seen, strict=True):
                factor = part.T(measured.ratio(np.asarray(part(x))))
                x = x * np.divide(factor, seen, out=np.ones_like(x), where=seen > LEAST)
            found += [x] * (number in after)
            tell(progress, number, max(after))
        return np.stack(found)
