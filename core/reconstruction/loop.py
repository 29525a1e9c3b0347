"""Loop of all iterative reconstructions: start and resume, record of the objective, callback, progress, stopping."""

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
from .stopping import StoppingRule, StopWhen, checked_mask

Start = Volume | Reconstruction | ArrayLike | None

Step = Callable[[int, Array, Progress | None], tuple[Array, float]]
"""Function that does one iteration: ``new_values, objective = step(number, values, progress)``.

`number` is the iteration's index from 0, iterations before a resume included. `values` are read-only; the returned values
are a new array. `progress` reports on this iteration alone: call it as ``progress(done, total)``, at last with done = total.
"""


class IterativeOptions(TypedDict, total=False):
    """Arguments that every iterative method takes after its own arguments, by name, or by position in this order.

    Attributes
    ----------
    start : Volume, Reconstruction, array or tensor, optional
        Initial volume on the projector's grid; by default the same value in all voxels. A `Reconstruction` by the same
        method is resumed: values and objective continue as without a break. All other arguments must then be the same as in
        its call, except `iterations`, which are done in addition. Of a reconstruction by another method only the volume is
        used.
    mask : array of bool, optional
        Voxels that are reconstructed, in the grid's shape; outside the mask the volume is 0.
    callback : callable, optional
        Function that is called after each iteration, see `Callback`.
    progress : callable, optional
        Called as ``progress(updates done, updates)``; an exception that it raises stops the reconstruction. A `Cancelled`
        carries the iterations that were finished as its attribute `reconstruction`.
    stop : StoppingRule, optional
        Rule that ends the reconstruction before the last iteration, such as `StopWhen`.
    """

    start: Start
    mask: ArrayLike | None
    callback: Callback | None
    progress: Progress | None
    stop: StoppingRule | None


class Loop:
    """Iterations of one call of a method, with checked arguments.

    ::

        loop = Loop("SIRT", A, iterations, *options, **named, default=0.0, negative=True)
        weights = A.T(...)                              # arrays that the method prepares

        def step(number, values, progress):
            ...
            return new_values, objective

        return loop.run(step, relaxation=relaxation)

    Parameters
    ----------
    method : str
        Name of the method in settings and messages. A `Reconstruction` of the same method is resumed; the volume of another
        method's reconstruction is the start of a new one.
    A : Projector
        Projector from the volume's grid to the images.
    iterations : int
        Number of iterations of this call.
    start, mask, callback, progress, stop
        See `IterativeOptions`.
    default : float
        Initial value of all voxels if there is no `start`.
    negative : bool
        Whether values may be below 0.
    quantity : str
        Quantity of the resulting volume, unless `start` is a volume.

    Attributes
    ----------
    values : array (n_x, n_y, n_z)
        Current values of the volume, float32; 0 outside the mask.
    has_start : bool
        Whether there is a `start`.
    mask : array of bool (n_x, n_y, n_z)
        Voxels that are reconstructed.
    state : dict of arrays
        Arrays by name that the method needs besides the values to be resumed. It is empty at first; in a resumed
        reconstruction it has the arrays of the last iteration. Steps replace the arrays, and never change them in place.
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
        self._start_time = time.monotonic()
        self._method, self._A, self._callback, self._progress, self._stop = method, A, callback, progress, stop
        for name, function in (("callback", callback), ("progress", progress)):
            if function is not None and not callable(function):
                raise InputError(f"{name}: expected a function, got {type(function).__name__}")
        self._iterations = whole_number(iterations, "iterations")
        if stop is not None:
            if not isinstance(stop, StoppingRule):
                instance(stop, StopWhen, "stop")  # the message names the rule that users know
            stop.check(A.shape_in)
        self.mask = np.ones(A.shape_in, bool) if mask is None else checked_mask(mask, "mask", A.shape_in)
        if not self.mask.any():
            warn(f"mask: 0 of {self.mask.size} voxels are inside: the volume will be 0", 4)
        self.state: dict[str, Array] = {}
        self._objective: list[float] = []
        self._resumed: Mapping[str, Any] = {}  # settings of the resumed reconstruction
        if isinstance(start, Reconstruction):
            if start.settings.get("method") == method:
                self.state, self._objective = dict(start.state), [float(number) for number in start.objective]
                self._resumed = start.settings
            start = start.volume
        self.has_start = start is not None
        self._quantity = start.quantity if isinstance(start, Volume) else quantity
        self.values = self._first_values(start, default, negative)

    @property
    def n_done(self) -> int:
        """Number of finished iterations, those before a resume included."""
        return len(self._objective)

    def preparing(self) -> Progress | None:
        """Return the progress callback for the work before the first iteration, during which the progress stays at 0."""
        return fixed_progress(self._progress, 0, self._iterations)

    def record(self) -> dict[str, Any]:
        """Return numbers that identify the data, as settings: a resumed reconstruction must have the same numbers."""
        return {}

    def objective(self, values: Array, progress: Progress | None) -> float | None:
        """Return the objective of a volume, or None if the method cannot compute it without a step."""
        return None

    def run(self, step: Step, **settings: Any) -> Reconstruction:
        """Do the iterations and return the reconstruction; `settings` are the arguments of the method.

        Raise `InputError` if a resumed reconstruction has other settings, another `record` of the data or another objective
        of its volume. A `Cancelled` that progress or callback raises gets the iterations that were finished as its attribute
        `reconstruction`.
        """
        settings |= self.record()
        result = self._result(settings, "cancelled")
        try:
            if self._objective:
                self._require_same(settings, self.objective(self.values, self.preparing()))
            for i in range(self._iterations):
                values, objective = step(self.n_done, self.values, part_of(self._progress, i, self._iterations))
                self.values = self._masked(values)
                self._objective.append(float(objective))
                result = self._result(settings, "cancelled")
                if self._callback is not None and self._callback(self.n_done, self.values):
                    return self._result(settings, "callback")
                seconds = time.monotonic() - self._start_time
                if reason := self._stop and self._stop.reason(self._objective, self.values, seconds):
                    return self._result(settings, reason)
        except Cancelled as cancelled:
            cancelled.reconstruction = result
            raise
        return self._result(settings, "iterations")

    def _require_same(self, settings: Mapping[str, Any], objective: float | None) -> None:
        """Raise `InputError` unless settings and objective are those of the resumed reconstruction."""
        last = self._objective[-1]
        expected = {**settings, **self._resumed, "objective": last}
        present = {**settings, "objective": last if objective is None else objective}
        changed = [f"{key} {expected[key]}, now {v}" for key, v in present.items() if not _are_equal(v, expected[key])]
        if changed:
            difference = f"other images, views or mask, or another model or other settings ({'; '.join(changed)})"
            advice = "give its volume (--start) to begin with that"
            raise InputError(f"start: this reconstruction is of {difference}: {advice}")

    def _result(self, settings: Mapping[str, Any], stopped: str) -> Reconstruction:
        """Return the reconstruction of the current values, with `settings` and the reason why it `stopped`."""
        volume = Volume(self.values, self._A.grid, self._quantity)
        settings = {"method": self._method, **settings, "iterations": self.n_done, "stopped": stopped}
        return Reconstruction(volume, np.array(self._objective), settings, dict(self.state))

    def _first_values(self, start: Volume | ArrayLike | None, default: float, negative: bool) -> Array:
        """Return the checked values of `start`, or `default` in all voxels, with 0 outside the mask."""
        if start is None:
            return self._masked(np.full(self._A.shape_in, default, np.float32))
        with naming("start"):
            array = self._A._check(start) if isinstance(start, Volume) else numpy_if_tensor(start)
        values = real_array(array, "start", self._A.shape_in, np.float32)
        if not negative and values.min() < 0:
            raise InputError(f"start: expected 0 or more, got {values.min():g}")
        sums = [float(np.abs(array).sum(dtype=float)) for array in (values[~self.mask], values)]
        if sums[0] > 0.01 * sums[1]:
            warn(f"start: {100 * sums[0] / sums[1]:.3g} % of its sum lies outside the mask, and is left out", 5)
        return self._masked(values)

    def _masked(self, values: Array) -> Array:
        """Return a read-only float32 copy of `values` with 0 outside the mask."""
        return freeze(np.ascontiguousarray(np.where(self.mask, np.asarray(values, np.float32), np.float32(0))))


def _are_equal(a: Any, b: Any) -> bool:
    """Return whether two settings are equal; floats may differ by rounding, as between backends."""
    return bool(a == b) or (type(a) is type(b) is float and math.isclose(a, b, rel_tol=1e-7))


def fixed_progress(progress: Progress | None, done: int, total: int) -> Progress | None:
    """Return a callback that calls ``progress(done, total)`` whatever its arguments, so that `progress` can cancel."""
    return None if progress is None else lambda *_: progress(done, total)


def numpy_if_tensor(numbers: Any) -> Any:
    """Return a torch tensor on any device as a numpy array; return anything else unchanged."""
    return to_numpy(numbers, None) if is_tensor(numbers) else numbers
