"""When an iterative reconstruction ends before its last iteration."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Array, ArrayLike, Bools
from ..errors import InputError, warn
from ..validation import positive, real_numbers


class StoppingRule:
    """Says after each iteration whether a reconstruction ends there; `StopWhen` has the usual rules."""

    def check(self, shape: tuple[int, ...]) -> None:
        """Raise `InputError` unless the rule fits a volume of this shape; called before the first iteration."""

    def reason(self, objective: Sequence[float], values: Array, seconds: float) -> str | None:
        """Return the reason to stop, one word for ``settings["stopped"]``, or None to go on.

        Parameters
        ----------
        objective
            After each iteration so far.
        values
            The volume's values (n_x, n_y, n_z), read-only.
        seconds
            Since the reconstruction was called.
        """
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class StopWhen(StoppingRule):
    """Ends a reconstruction after the first iteration for which a rule holds; its ``settings["stopped"]`` says which.

    Attributes
    ----------
    change : float, optional
        The objective has changed by at most this share of its size since the iteration before, such as 1e-5.
    noise : float, optional
        The standard deviation of the values in `region` is at least this share of their mean, such as 0.15. While the
        likelihood grows, so does the noise: this ends before it is larger than wanted. A region of zeros has no noise:
        it ends nothing, and a warning says so.
    region : array of bool, optional
        It has the grid's shape: voxels of the same activity, some voxels away from edges, in which `noise` is measured.
    seconds : float, optional
        So many have passed since the call. An iteration that has begun is finished.

    Raises
    ------
    InputError
        No rule is given, a number is not above 0, or only one of `noise` and `region` is given.
    """

    change: float | None = None
    noise: float | None = None
    region: ArrayLike | None = None
    seconds: float | None = None

    def __post_init__(self) -> None:
        given = [name for name in ("change", "noise", "seconds") if getattr(self, name) is not None]
        if not given:
            raise InputError("stop: expected change, noise with region, or seconds")
        for name in given:
            object.__setattr__(self, name, positive(getattr(self, name), f"stop: {name}"))
        if (self.noise is None) != (self.region is None):
            raise InputError("stop: noise needs region, and region needs noise: the voxels in which it is measured")
        if self.region is not None:
            object.__setattr__(self, "region", real_numbers(self.region, "stop: region"))

    def check(self, shape: tuple[int, ...]) -> None:
        """Raise `InputError` unless `region` fits a volume of this shape."""
        if self.region is not None and not inside(self.region, "stop: region", shape).any():
            raise InputError("stop: region: expected voxels, got none")

    def reason(self, objective: Sequence[float], values: Array, seconds: float) -> str | None:
        """Return the name of a rule that the volume fulfils after an iteration, or None."""
        if self.change is not None and len(objective) > 1:
            last, before = objective[-1], objective[-2]
            if abs(last - before) <= self.change * abs(last):
                return "change"
        if self.noise is not None:
            chosen = values[self.region].astype(np.float64)  # type: ignore[index]
            if not chosen.any():
                if len(objective) == 1:
                    warn("stop: region: its voxels are all 0 after iteration 1: no noise ends it while they are")
            elif chosen.std() >= self.noise * chosen.mean():
                return "noise"
        if self.seconds is not None and seconds >= self.seconds:
            return "seconds"
        return None


def inside(mask: ArrayLike, name: str, shape: tuple[int, ...]) -> Bools:
    """Return `mask` as booleans of a volume's shape; raise `InputError` for another shape."""
    found = real_numbers(mask, name)
    if found.shape != shape or found.dtype != bool:
        got = f"{found.dtype} of {' x '.join(map(str, found.shape)) or 'no'}"
        raise InputError(f"{name}: expected booleans of {' x '.join(map(str, shape))} voxels, got {got}")
    return found
