"""What a recipe draws: a constant, a range, a choice, or a list of these, each from random numbers of its own.

A draw is ``{ from = 1, to = 2 }``, evenly between both (whole numbers including both, where the setting is one), or
``{ one_of = [1, 5], odds = [3, 1] }``. The random numbers depend on seed, event and the setting's name alone: a setting that
is added or taken out changes no other.
"""

import math
import statistics
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InputError
from ..validation import real_array

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
        """The value of a setting of this name; `value` is checked (`check_draw`)."""
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


def check_draw(value: Any, name: str, whole: bool = False) -> None:
    """Raise `InputError` where a table in `value` is no draw, or draws what is no number; `name` says whose value it is."""
    if isinstance(value, list | tuple):
        for item in value:
            check_draw(item, name, whole)
    if not isinstance(value, Mapping):
        return
    if "one_of" in value:
        _check_choice(value, name, whole)
        return
    if set(value) != {"from", "to"}:
        found = ", ".join(value) or "nothing"
        raise InputError(f"{name}: expected {{ from = …, to = … }} or {{ one_of = […] }}, got a table of {found}")
    low, high = value["from"], value["to"]
    kind = "whole numbers" if whole else "numbers"
    for number in (low, high):
        if (
            isinstance(number, bool)
            or not isinstance(number, int if whole else int | float)
            or not math.isfinite(number)
        ):
            raise InputError(f"{name}: expected {kind} after from and to, got {number!r}")
    if low > high:
        raise InputError(f"{name}: expected from {low:g} to no less, got {high:g}")


def check_number(value: Any, name: str) -> None:
    """Raise `InputError` unless `value` is a number or a draw of numbers."""
    check_draw(value, name)
    if isinstance(value, Mapping):
        for option in value.get("one_of", ()):
            check_number(option, name)
    else:
        real_array(value, name, ())


def _check_choice(value: Mapping[str, Any], name: str, whole: bool) -> None:
    if unknown := set(value) - {"one_of", "odds"}:
        raise InputError(f"{name}: beside one_of expected odds, got {', '.join(sorted(unknown))}")
    options = value["one_of"]
    if not isinstance(options, list) or not options:
        raise InputError(f"{name}: expected a list of one or more after one_of, got {options!r}")
    for option in options:
        check_draw(option, name, whole)
    if "odds" in value:
        check_odds(value["odds"], len(options), name)


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
