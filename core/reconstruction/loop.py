"""The loop of all iterative reconstructions: start and resume, log, callback, progress, cancelling and stopping."""

import math
import time
from collections.abc import Callable, Mapping
from typing import Any, TypedDict

import numpy as np

from ..arrays import Array, ArrayLike, is_tensor, to_numpy
from ..errors import InputError, naming, warn
from ..progress import Cancelled, Progress, part_of
from ..projector import Projector
from ..validation import freeze, instance, real_array, whole_number
from ..volumes.volume import Volume
from .result import Callback, Reconstruction
from .stopping import StoppingRule, StopWhen, inside

Start = Volume | Reconstruction | ArrayLike | None

Step = Callable[[int, Array, Progress | None], tuple[Array, float]]
"""Function that does one iteration: ``new_values, objective = step(number, values, progress)``.

`number` counts from 0, those before a resume included. The values given are read-only, those returned new. `progress` is the
iteration's own: call it as ``progress(done, total)``, the last time with done = total.
"""


class IterativeOptions(TypedDict, total=False):
    """The arguments that every iterative method takes after its own, by name, or by position in this order.

    Attributes
    ----------
    start : Volume, Reconstruction, array or tensor, optional
        What the volume begins with, on the projector's grid; by default the same value everywhere. A reconstruction by the
        same method goes on with the same numbers as without a break, its log too; all other arguments must be what they
        were, but for `iterations`, which are done in addition. Of one by another method the volume is taken.
    mask : array of bool, optional
        It has the grid's shape; outside it the volume is 0.
    callback : callable, optional
        See `Callback`.
    progress : callable, optional
        Called as ``progress(updates done, updates)``; what it raises stops the work. A `Cancelled` has what was done before
        as its `reconstruction`.
    stop : StoppingRule, optional
        A rule that ends the work before the last iteration, such as `StopWhen`.
    """

    start: Start
    mask: ArrayLike | None
    callback: Callback | None
    progress: Progress | None
    stop: StoppingRule | None


class Loop:
    """The iterations of one call of a method. Arguments are checked when it is made.

    ::

        loop = Loop("SIRT", A, iterations, *options, **named, default=0.0, negative=True)
        weights = A.T(...)                              # what the method prepares

        def step(number, values, progress):
            ...
            return new_values, objective

        return loop.run(step, relaxation=relaxation)

    Parameters
    ----------
    method : str
        The method's name, for settings and messages. A `Reconstruction` of this method is resumed; of another, its volume is
        the start of a new one.
    A : Projector
    iterations : int
        How many are done in this call.
    start, mask, callback, progress, stop
        See `IterativeOptions`.
    default : float
        The value that voxels begin with where there is no `start`.
    negative : bool
        Whether values may be below 0.
    quantity : str
        What the resulting volume is of, unless `start` is a volume.

    Attributes
    ----------
    values : array (n_x, n_y, n_z)
        To begin with, float32; 0 outside the mask.
    is_given : bool
        Whether there is a `start`.
    mask : array of bool
    state : dict of arrays
        What a method needs besides the values to be resumed. `run` keeps it with the result; a resumed one finds here
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
        self.mask = np.ones(A.shape_in, bool) if mask is None else inside(mask, "mask", A.shape_in)
        if not self.mask.any():
            warn(f"mask: 0 of {self.mask.size} voxels are inside: the volume will be 0", 4)
        self.state: dict[str, Array] = {}
        self._objective: list[float] = []
        self._resumed: Mapping[str, Any] = {}  # the settings of what is resumed
        if isinstance(start, Reconstruction):
            if start.settings.get("method") == method:
                self.state, self._objective = dict(start.state), [float(number) for number in start.objective]
                self._resumed = start.settings
            start = start.volume
        self.is_given = start is not None
        self._quantity = start.quantity if isinstance(start, Volume) else quantity
        self.values = self._first_values(start, default, negative)

    @property
    def done(self) -> int:
        """Iterations done, those before a resume included."""
        return len(self._objective)

    def preparing(self) -> Progress | None:
        """Return the progress callback for the work before the first iteration, during which the progress stays at 0."""
        return waiting(self._progress, 0, self._iterations)

    def record(self) -> dict[str, Any]:
        """Return numbers that identify the data, as settings: a resumed reconstruction must have the same numbers."""
        return {}

    def objective(self, values: Array, progress: Progress | None) -> float | None:
        """Return the objective of a volume, or None if the method cannot compute it without a step."""
        return None

    def run(self, step: Step, **settings: Any) -> Reconstruction:
        """Do the iterations; `settings` are the method's own arguments.

        Where a reconstruction is resumed, they, the `record` of the data and the objective of the volume must be what they
        were, else `InputError`. A `Cancelled` of progress or callback takes along what was done before, as its
        `reconstruction`.
        """
        settings |= self.record()
        result = self._result(settings, "cancelled")
        try:
            if self._objective:
                self._require_as_before(settings, self.objective(self.values, self.preparing()))
            for i in range(self._iterations):
                values, reached = step(self.done, self.values, part_of(self._progress, i, self._iterations))
                self.values = self._inside(values)
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

    def _require_as_before(self, settings: Mapping[str, Any], objective: float | None) -> None:
        last = self._objective[-1]
        known = {**settings, **self._resumed, "objective": last}
        asked = {**settings, "objective": last if objective is None else objective}
        changed = [f"{key} {known[key]}, now {new}" for key, new in asked.items() if not _same(new, known[key])]
        if changed:
            raise InputError(
                "start: this reconstruction is of other images, views or mask, or another model or other settings "
                f"({'; '.join(changed)}): give its volume (--start) to begin with that"
            )

    def _result(self, settings: Mapping[str, Any], stopped: str) -> Reconstruction:
        volume = Volume(self.values, self._A.grid, self._quantity)
        known = {"method": self._method, **settings, "iterations": self.done, "stopped": stopped}
        return Reconstruction(volume, np.array(self._objective), known, dict(self.state))

    def _first_values(self, start: Volume | ArrayLike | None, default: float, negative: bool) -> Array:
        if start is None:
            return self._inside(np.full(self._A.shape_in, default, np.float32))
        with naming("start"):
            array = self._A._check(start) if isinstance(start, Volume) else plain(start)
        values = real_array(array, "start", self._A.shape_in, np.float32)
        if not negative and values.min() < 0:
            raise InputError(f"start: expected 0 or more, got {values.min():g}")
        return self._inside(values)

    def _inside(self, values: Array) -> Array:
        return freeze(np.ascontiguousarray(np.where(self.mask, np.asarray(values, np.float32), np.float32(0))))


def _same(one: Any, other: Any) -> bool:
    """Return whether settings are equal; numbers may differ by the rounding of backends."""
    return bool(one == other) or (type(one) is type(other) is float and math.isclose(one, other, rel_tol=1e-7))


def waiting(progress: Progress | None, done: int, total: int) -> Progress | None:
    """Return the progress callback of a part of a step: it repeats the progress of the whole, and can cancel."""
    return None if progress is None else lambda *_: progress(done, total)


def plain(numbers: Any) -> Any:
    """Return a torch tensor on any device as a numpy array, and anything else unchanged."""
    return to_numpy(numbers, None) if is_tensor(numbers) else numbers
