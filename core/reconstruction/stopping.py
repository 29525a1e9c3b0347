"""Stopping rules that end an iterative reconstruction before its last iteration."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import Array, ArrayLike, Bools
from ..errors import InputError, warn
from ..validation import positive, real_numbers


class StoppingRule:
    """Base class of stopping rules, which are asked after each iteration; `StopWhen` has the usual rules."""

    def check(self, shape: tuple[int, ...]) -> None:
        """Raise `InputError` unless the rule fits a volume of this shape; called before the first iteration."""

    def reason(self, objective: Sequence[float], values: Array, seconds: float) -> str | None:
        """Return the reason to stop, one word for ``settings["stopped"]``, or None to go on.

        Parameters
        ----------
        objective
            Objective after each iteration up to now.
        values
            The volume's values (n_x, n_y, n_z), read-only.
        seconds
            Time since the call of the reconstruction method.
        """
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class StopWhen(StoppingRule):
    """Rules that end a reconstruction after the first iteration that fulfils one; ``settings["stopped"]`` names the rule.

    Attributes
    ----------
    change : float, optional
        Relative change of the objective in one iteration at or below which the reconstruction ends, such as 1e-5.
    noise : float, optional
        Standard deviation by mean of the values in `region` from which on the reconstruction ends, such as 0.15: the noise
        grows with the likelihood. A region of zeros has no noise; then this rule ends nothing, and a warning says so.
    region : array of bool, optional
        Voxels in which `noise` is measured, in the grid's shape: voxels of equal activity, some voxels away from edges.
    seconds : float, optional
        Time, s, since the call after which the reconstruction ends; the current iteration is finished.

    Raises
    ------
    InputError
        There is no rule, a number is not above 0, or only one of `noise` and `region` is set.
    """

    change: float | None = None
    noise: float | None = None
    region: ArrayLike | None = None
    seconds: float | None = None

    def __post_init__(self) -> None:
        names = [name for name in ("change", "noise", "seconds") if getattr(self, name) is not None]
        if not names:
            raise InputError("stop: expected change, noise with region, or seconds")
        for name in names:
            object.__setattr__(self, name, positive(getattr(self, name), f"stop: {name}"))
        if (self.noise is None) != (self.region is None):
            raise InputError("stop: noise needs region, and region needs noise: the voxels in which it is measured")
        if self.region is not None:
            object.__setattr__(self, "region", real_numbers(self.region, "stop: region"))

    def check(self, shape: tuple[int, ...]) -> None:
        """Raise `InputError` unless `region` fits a volume of this shape."""
        if self.region is not None and not checked_mask(self.region, "stop: region", shape).any():
            raise InputError("stop: region: expected voxels, got none")

    def reason(self, objective: Sequence[float], values: Array, seconds: float) -> str | None:
        """Return the name of a rule that the volume fulfils after an iteration, or None."""
        if self.change is not None and len(objective) > 1:
            last, previous = objective[-1], objective[-2]
            if abs(last - previous) <= self.change * abs(last):
                return "change"
        if self.noise is not None:
            region_values = values[self.region].astype(np.float64)  # type: ignore[index]
            if not region_values.any():
                if len(objective) == 1:
                    warn("stop: region: its voxels are all 0 after iteration 1: no noise ends it while they are")
            elif region_values.std() >= self.noise * region_values.mean():
                return "noise"
        if self.seconds is not None and seconds >= self.seconds:
            return "seconds"
        return None


def checked_mask(mask: ArrayLike, name: str, shape: tuple[int, ...]) -> Bools:
    """Return `mask` as an array; raise `InputError` unless it has booleans in a volume's `shape`."""
    array = real_numbers(mask, name)
    if array.shape != shape or array.dtype != bool:
        got = f"{array.dtype} of {' x '.join(map(str, array.shape)) or 'no'}"
        raise InputError(f"{name}: expected booleans of {' x '.join(map(str, shape))} voxels, got {got}")
    return array
