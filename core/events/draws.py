"""Draws in recipes: a constant, a range, a choice, or a list of these, each with random numbers of its own.

A draw is a range ``{ from = 1, to = 2 }``, uniformly distributed (for settings of whole numbers both ends are included), or
a choice ``{ one_of = [1, 5], odds = [3, 1] }``. The random numbers depend on the seed, the event's number and the setting's
name alone: a setting that is added or removed leaves the draws of all others as they are.
"""

import math
import statistics
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import InputError
from ..recipes.settings import Setting
from ..recipes.values import Values

_NORMAL = statistics.NormalDist()


@dataclass(frozen=True)
class Dice:
    """Random numbers of one event of a set, each a function of the seed, the event's number and a name."""

    seed: int
    """Seed of the set."""
    event: int
    """Number of the event."""

    def bits(self, name: str) -> int:
        """Return 64 random bits for a name; NumPy guarantees that `SeedSequence` gives the same in all versions."""
        sequence = np.random.SeedSequence(self.seed, spawn_key=(self.event, zlib.crc32(name.encode())))
        return int(sequence.generate_state(1, np.uint64)[0])

    def unit(self, name: str) -> float:
        """Return a random number for a name, uniform in [0, 1)."""
        return (self.bits(name) >> 11) * 2.0**-53

    def normal(self, name: str) -> float:
        """Return a random number for a name, normal with mean 0 and variance 1."""
        return _NORMAL.inv_cdf((self.bits(name) >> 11) * 2.0**-53 + 2.0**-54)

    def choice(self, name: str, odds: Sequence[float]) -> int:
        """Return a random index for a name, with probabilities proportional to `odds`."""
        point, total = self.unit(name) * math.fsum(odds), 0.0
        for i, weight in enumerate(odds):
            total += weight
            if point < total:
                return i
        return max(i for i, weight in enumerate(odds) if weight > 0)

    def draw(self, value: Any, name: str, is_integer: bool = False) -> Any:
        """Return `value`, checked by `DrawnSetting`, with its draws replaced by random values that belong to a name."""
        if isinstance(value, Mapping):
            if "one_of" in value:
                options = value["one_of"]
                picked = options[self.choice(name, value.get("odds", [1.0] * len(options)))]
                return self.draw(picked, f"{name}.", is_integer)
            low, high = value["from"], value["to"]
            if is_integer:
                return low + math.floor(self.unit(name) * (high - low + 1))
            return low + self.unit(name) * (high - low)
        if isinstance(value, list | tuple):
            return [self.draw(item, f"{name}[{i}]", is_integer) for i, item in enumerate(value)]
        return value


@dataclass(frozen=True)
class DrawnSetting(Setting):
    """A setting whose value, or each of whose values, may be a draw. Its limits hold for drawn values, not range ends."""

    def checked(self, value: Any) -> Any:
        """Return `value` as a recipe keeps it, draws included; `InputError` where it is neither a value nor a draw."""
        if not isinstance(value, Mapping) or (self.sizes is not None and "one_of" not in value):
            return super().checked(value)
        return self._checked_choice(value) if "one_of" in value else self._checked_range(value)

    def checked_one(self, value: Any) -> Any:
        """Return one value, or a draw of one, as a recipe keeps it; raise `InputError` if it is not allowed."""
        return replace(self, sizes=None).checked(value) if isinstance(value, Mapping) else super().checked_one(value)

    def _checked_choice(self, value: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return a choice ``{ one_of = […], odds = […] }`` with checked options; `InputError` where it is none."""
        if unknown := set(value) - {"one_of", "odds"}:
            raise InputError(f"{self.key}: beside one_of expected only odds, got {', '.join(sorted(unknown))}")
        options = value["one_of"]
        if not isinstance(options, list) or not options:
            raise InputError(f"{self.key}: expected a list of one option or more as one_of, got {options!r}")
        if "odds" in value:
            check_odds(value["odds"], len(options), self.key)
        return {**value, "one_of": list(map(self.checked, options))}

    def _checked_range(self, value: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return a range ``{ from = …, to = … }`` of numbers as it is; `InputError` where it is none."""
        if set(value) != {"from", "to"} or self.kind is str:
            keys = ", ".join(value) or "nothing"
            expected = "{ from = …, to = … } or { one_of = […] }"
            raise InputError(f"{self.key}: expected {expected}, got a table of {keys}")
        number = Setting(f"{self.key}: from and to", int if self.kind is int else float, None, self.text)
        low, high = map(number.checked, (value["from"], value["to"]))
        if low > high:
            raise InputError(f"{self.key}: expected from {low:g} to no less, got {high:g}")
        return value


@dataclass(frozen=True)
class DrawnValues(Values):
    """Values of settings by key, some of which may be draws."""

    def drawn(self, key: str, dice: Dice, prefix: str = "") -> Any:
        """Draw the value of a setting and check it; `prefix` precedes the key in the name of its random numbers."""
        row = self.rows[key]
        return row.checked(dice.draw(self[key], prefix + key, row.kind is int))


def check_odds(odds: Any, count: int, name: str) -> None:
    """Raise `InputError` unless `odds` are `count` numbers of 0 or more, not all 0."""
    valid = isinstance(odds, list) and len(odds) == count
    valid = valid and all(isinstance(n, int | float) and not isinstance(n, bool) and 0 <= n < math.inf for n in odds)
    if not valid or not any(odds):
        raise InputError(f"{name}: expected {count} odds of 0 or more, not all 0, got {odds!r}")


def possible_values(value: Any) -> list[Any]:
    """Return all values that a constant or a choice of words, such as file names, may give."""
    if isinstance(value, Mapping):
        return [possible for option in value.get("one_of", ()) for possible in possible_values(option)]
    return [value]
