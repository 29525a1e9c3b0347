"""The loop of all iterative reconstructions: start and resume, log, callback, progress, cancelling and stopping."""

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import is_tensor, to_numpy
from ..errors import InputError, naming, warn
from ..progress import Cancelled, Progress, part_of
from ..projector import Projector
from ..validation import freeze, instance, real_array, whole_number
from ..volumes.volume import Volume
from .result import Array, Callback, Reconstruction
from .stopping import StoppingRule, StopWhen, inside

Start = Volume | Reconstruction | ArrayLike | None

Step = Callable[[int, Array, Progress | None], tuple[Array, float]]
"""One iteration: ``values, objective = step(number, values, progress)``.

`number` counts from 0, those before a resume included. The values given are read-only, those returned new. `progress` is the
iteration's own: call it as ``progress(done, total)``, the last time with done = total.
"""

Objective = Callable[[Array, Progress | None], float]
"""Of any volume, by the data and settings of a call: ``objective(values, progress)``."""


class Loop:
    """The iterations of one call of an algorithm. Arguments are checked when it is made.

    ::

        loop = Loop("SIRT", A, iterations, start, mask, callback, progress, stop, default=0.0, negative=True)
        weights = A.T(...)                              # what the algorithm prepares

        def step(number, values, progress):
            ...
            return new_values, objective

        return loop.run(step, {"relaxation": relaxation}, objective)

    Parameters
    ----------
    method : str
        The algorithm's name, for settings and messages. A `Reconstruction` of this method is resumed; of another, its
        volume is the start of a new one.
    A, iterations, start, mask, callback, progress, stop
        Of the algorithm's caller.
    default : float
        The value that voxels begin with where there is no `start`.
    negative : bool
        Whether values may be below 0.
    quantity : str
        Of the resulting volume, unless `start` has one.

    Attributes
    ----------
    values : array (n_x, n_y, n_z)
        To begin with, float32; 0 outside the mask.
    mask : array of bool, or None
    state : dict of arrays
        What an algorithm needs besides the values to be resumed. `run` keeps it with the result; a resumed one finds here
        what its last iteration had put in, else it is empty. Steps replace its arrays, and do not change their numbers.
    """

    def __init__(
        self,
        method: str,
        A: Projector,
        iterations: int,
        start: Start = None,
        mask: ArrayLike | None = None,
        callback: Callback | None = None,
        progress: Progress | None = None,
        stop: StoppingRule | None = None,
        *,
        default: float = 1.0,
        negative: bool = False,
        quantity: str = "activity",
    ) -> None:
        instance(A, Projector, method)
        self._begun = time.monotonic()
        self._method, self._A, self._callback, self._progress, self._stop = method, A, callback, progress, stop
        for name, function in (("callback", callback), ("progress", progress)):
            if function is not None and not callable(function):
                raise InputError(f"{name}: expected a function, got {type(function).__name__}")
        self._iterations = whole_number(iterations, "iterations")
        if stop is not None:
            if not isinstance(stop, StoppingRule):
                instance(stop, StopWhen, "stop")  # the rule that users know
            stop.check(A.shape_in)
        self.mask = None if mask is None else inside(mask, "mask", A.shape_in)
        if self.mask is not None and not self.mask.any():
            warn(f"mask: 0 of {self.mask.size} voxels are inside: the volume will be 0", 4)
        self.state: dict[str, Array] = {}
        self._objective: list[float] = []
        self._resumed: Mapping[str, Any] = {}  # the settings of what is resumed
        if isinstance(start, Reconstruction):
            if start.settings.get("method") == method:
                self.state, self._objective = dict(start.state), [float(number) for number in start.objective]
                self._resumed = start.settings
            start = start.volume
        self._quantity = start.quantity if isinstance(start, Volume) else quantity
        self.values = self._first_values(start, default, negative)

    @property
    def done(self) -> int:
        """Iterations done, those before a resume included."""
        return len(self._objective)

    def inside(self, seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Those of the voxels `seen` that are in the mask, too."""
        return seen if self.mask is None else seen & self.mask

    def preparing(self) -> Progress | None:
        """The progress callback for what is prepared before the first iteration: it only asks whether to go on."""
        return waiting(self._progress, 0, self._iterations)

    def run(self, step: Step, settings: Mapping[str, Any], objective: Objective | None = None) -> Reconstruction:
        """Do the iterations; `settings` are the algorithm's arguments, and what its data are known by.

        Where a reconstruction is resumed, they and the objective of its volume must be what they were, else `InputError`. A
        `Cancelled` of progress or callback takes along what was done before, as its `reconstruction`.
        """
        result = self._result(settings, "cancelled")
        try:
            if self._objective:
                asked = {} if objective is None else {"objective": objective(self.values, self.preparing())}
                self._require_as_before({**settings, **asked})
            for i in range(self._iterations):
                values, reached = step(self.done, self.values, part_of(self._progress, i, self._iterations))
                self.values = self._only_inside(values)
                self._objective.append(float(reached))
                result = self._result(settings, "cancelled")
                if self._callback is not None and self._callback(self.done, self.values):
                    return self._result(settings, "callback")
                seconds = time.monotonic() - self._begun
                reason = self._stop and self._stop.reason(self._objective, self.values, seconds)
                if reason:
                    return self._result(settings, reason)
        except Cancelled as cancelled:
            cancelled.reconstruction = result
            raise
        return self._result(settings, "iterations")

    def _require_as_before(self, settings: Mapping[str, Any]) -> None:
        known = {**settings, **self._resumed, "objective": self._objective[-1]}
        said = [f"{key} {known[key]}, now {new}" for key, new in settings.items() if not _same(new, known[key])]
        if said:
            raise InputError(
                "start: this reconstruction is of other images, views or mask, or another model or other settings "
                f"({'; '.join(said)}): give its volume (--start) to begin with that"
            )

    def _result(self, settings: Mapping[str, Any], stopped: str) -> Reconstruction:
        volume = Volume(self.values, self._A.grid, self._quantity)
        known = {"method": self._method, **settings, "iterations": self.done, "stopped": stopped}
        return Reconstruction(volume, np.array(self._objective), known, dict(self.state))

    def _first_values(self, start: Volume | ArrayLike | None, default: float, negative: bool) -> Array:
        if start is None:
            return self._only_inside(np.full(self._A.shape_in, default, np.float32))
        with naming("start"):
            array = self._A._check(start) if isinstance(start, Volume) else plain(start)
        values = real_array(array, "start", self._A.shape_in, np.float32)
        if not negative and values.min() < 0:
            raise InputError(f"start: expected 0 or more, got {values.min():g}")
        return self._only_inside(values)

    def _only_inside(self, values: Array) -> Array:
        values = np.asarray(values, np.float32)
        if self.mask is not None:
            values = np.where(self.mask, values, np.float32(0))
        return freeze(np.ascontiguousarray(values))


def _same(one: Any, other: Any) -> bool:
    """Whether settings are equal, numbers but for the rounding by which backends differ."""
    return bool(one == other) or (type(one) is type(other) is float and math.isclose(one, other, rel_tol=1e-7))


def waiting(progress: Progress | None, done: int, total: int) -> Progress | None:
    """The progress callback of a part of a step: it says again how far the whole is, so that the part can be cancelled."""
    return None if progress is None else lambda *_: progress(done, total)


def plain(numbers: Any) -> Any:
    """A torch tensor, on any device, as a numpy array; anything else as it is."""
    return to_numpy(numbers, None) if is_tensor(numbers) else numbers
