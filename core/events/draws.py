"""What a recipe draws: a constant, a range, a choice, or a list of these, each from random numbers of its own.

A draw is ``{ from = 1, to = 2 }``, evenly between both (whole numbers including both, where the setting is one), or
``{ one_of = [1, 5], odds = [3, 1] }``. The random numbers depend on seed, event and the setting's name alone: a setting that
is added or taken out changes no other.
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
    """The random numbers of one event."""

    seed: int
    event: int

    def bits(self, name: str) -> int:
        """64 random bits for a name: numpy keeps `SeedSequence` the same in all versions, on all machines."""
        sequence = np.random.SeedSequence(self.seed, spawn_key=(self.event, zlib.crc32(name.encode())))
        return int(sequence.generate_state(1, np.uint64)[0])

    def unit(self, name: str) -> float:
        """A number from 0 to below 1."""
        return (self.bits(name) >> 11) * 2.0**-53

    def normal(self, name: str) -> float:
        """A number of mean 0 and variance 1."""
        return _NORMAL.inv_cdf((self.bits(name) >> 11) * 2.0**-53 + 2.0**-54)

    def choice(self, name: str, odds: Sequence[float]) -> int:
        """An index, with these odds."""
        place, total = self.unit(name) * math.fsum(odds), 0.0
        for i, share in enumerate(odds):
            total += share
            if place < total:
                return i
        return max(i for i, share in enumerate(odds) if share > 0)

    def draw(self, value: Any, name: str, whole: bool = False) -> Any:
        """The value of a setting of this name; `value` is checked (`Drawn`)."""
        if isinstance(value, Mapping):
            if "one_of" in value:
                options = value["one_of"]
                picked = options[self.choice(name, value.get("odds", [1.0] * len(options)))]
                return self.draw(picked, f"{name}.", whole)
            low, high = value["from"], value["to"]
            if whole:
                return low + math.floor(self.unit(name) * (high - low + 1))
            return low + self.unit(name) * (high - low)
        if isinstance(value, list | tuple):
            return [self.draw(item, f"{name}[{i}]", whole) for i, item in enumerate(value)]
        return value


@dataclass(frozen=True)
class Drawn(Setting):
    """A setting whose value, or each of several, may be a draw. Its limits hold for what is drawn, not for a range."""

    def checked(self, value: Any) -> Any:
        """`value` as a recipe keeps it, with draws; `InputError` where it is not what is expected, or no draw."""
        if not isinstance(value, Mapping) or (self.sizes is not None and "one_of" not in value):
            return super().checked(value)
        return self._choice(value) if "one_of" in value else self._range(value)

    def checked_one(self, value: Any) -> Any:
        """Return one value, or a draw of one, as a recipe keeps it; raise `InputError` if it is not allowed."""
        return replace(self, sizes=None).checked(value) if isinstance(value, Mapping) else super().checked_one(value)

    def _choice(self, value: Mapping[str, Any]) -> Mapping[str, Any]:
        if unknown := set(value) - {"one_of", "odds"}:
            raise InputError(f"{self.key}: beside one_of expected odds, got {', '.join(sorted(unknown))}")
        options = value["one_of"]
        if not isinstance(options, list) or not options:
            raise InputError(f"{self.key}: expected a list of one or more after one_of, got {options!r}")
        if "odds" in value:
            check_odds(value["odds"], len(options), self.key)
        return {**value, "one_of": list(map(self.checked, options))}

    def _range(self, value: Mapping[str, Any]) -> Mapping[str, Any]:
        if set(value) != {"from", "to"} or self.kind is str:
            found = ", ".join(value) or "nothing"
            expected = "{ from = …, to = … } or { one_of = […] }"
            raise InputError(f"{self.key}: expected {expected}, got a table of {found}")
        number = Setting(f"{self.key}: from and to", int if self.kind is int else float, None, self.text)
        low, high = map(number.checked, (value["from"], value["to"]))
        if low > high:
            raise InputError(f"{self.key}: expected from {low:g} to no less, got {high:g}")
        return value


@dataclass(frozen=True)
class DrawnValues(Values):
    """Values of settings, some of which may be draws."""

    def drawn(self, key: str, dice: Dice, before: str = "") -> Any:
        """What is drawn of a setting, checked; `before` stands before its key in the name of its random numbers."""
        row = self.rows[key]
        return row.checked(dice.draw(self[key], before + key, row.kind is int))


def check_odds(odds: Any, count: int, name: str) -> None:
    """Raise `InputError` unless `odds` are `count` numbers of 0 or more, not all 0."""
    good = isinstance(odds, list) and len(odds) == count
    good = good and all(isinstance(n, int | float) and not isinstance(n, bool) and 0 <= n < math.inf for n in odds)
    if not good or not any(odds):
        raise InputError(f"{name}: expected {count} odds of 0 or more, not all 0, got {odds!r}")


def options(value: Any) -> list[Any]:
    """All that a draw of words, such as files' names, may give."""
    if isinstance(value, Mapping):
        return [found for option in value.get("one_of", ()) for found in options(option)]
    return [value]
