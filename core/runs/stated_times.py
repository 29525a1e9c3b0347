"""Durations, clock times and dates as files of counts state them."""

import math
import re
from datetime import date
from itertools import pairwise

import numpy as np

from ..arrays import Floats
from ..errors import InputError, expecting, warn

DAY = 86400.0
"""Length of a day, s."""
_HALF_DAY = DAY / 2
_FIRST_DATED = 1e9  # s; moments with a date are counted from the year 1, those without from midnight
_UNSTATED = ("", "unknown", "undefined", "none", "n/a", "nan", "-", "?")  # values of a key that say nothing
_DATE = re.compile(r"(\d{4})(\d\d)(\d\d)|(\d{4})[:./-](\d{1,2})[:./-](\d{1,2})")
_CLOCK = re.compile(
    r"(\d{1,2})(?::(\d{1,2})(?::(\d{1,2}(?:\.\d*)?))?)?\s*([ap]m)?|(\d\d)(\d\d)(\d\d(?:\.\d*)?)?|(\d\d)\.(\d\d)\.(\d\d)"
)


def stated_number(text: object, name: str, expected: str = "a number", default: float = math.nan) -> float:
    """Return the finite number that a file states, or `default` for a text that says nothing, such as "" and "unknown".

    `InputError` for other texts names the field `name` and what was `expected`.
    """
    words = str("" if text is None else text).strip()
    if words.lower() in _UNSTATED:
        return default
    refusal = f"{name} = {words}: expected {expected}"
    with expecting(refusal):
        number = float(words)
    if not math.isfinite(number):
        raise InputError(refusal)
    return number


def stated_duration(text: object, name: str) -> float:
    """Return the duration, s or another unit, that a file states; NaN where it says nothing or 0."""
    duration = stated_number(text, name, "a duration above 0")
    if duration < 0:
        raise InputError(f"{name} = {text}: expected a duration above 0")
    return duration or math.nan


def moment(day: object, clock: object, name: str) -> float:
    """Return the moment of a clock time such as "14:05:30", "140530.25" or "2:05 PM" on a day such as "2024:03:01", s.

    It is counted from the beginning of the year 1, or from midnight where the file states no day; NaN without a clock time.
    """
    day_text, clock_text = (str("" if text is None else text).strip() for text in (day, clock))
    day_text, clock_text = ("" if text.lower() in _UNSTATED else text for text in (day_text, clock_text))
    if not clock_text:
        return math.nan
    seconds = 0.0
    if day_text:
        refusal = f"{name}: date {day_text}: expected year, month and day, such as 2024:03:01"
        if (match := _DATE.fullmatch(day_text)) is None:
            raise InputError(refusal)
        with expecting(refusal):
            seconds = DAY * date(*map(int, filter(None, match.groups()))).toordinal()
    match = _CLOCK.fullmatch(clock_text.lower().replace(".m.", "m").replace("p.m", "pm").replace("a.m", "am"))
    numbers = [float(part) for part in (match.groups() if match else ()) if part and part[0].isdigit()]
    hours, minutes, rest = (*numbers, 0.0, 0.0, 0.0)[:3]
    half = match[4] if match else None
    is_possible = hours < 24 and minutes < 60 and rest < 61 if half is None else 1 <= hours <= 12 and minutes < 60
    if match is None or not (is_possible or numbers == [24.0, 0.0, 0.0]):
        raise InputError(f"{name}: time {clock_text}: expected hours, minutes and seconds, such as 14:05:30")
    hours = hours if half is None else hours % 12 + 12 * (half == "pm")
    return seconds + 3600.0 * hours + 60.0 * minutes + rest


def aligned_starts(starts: list[Floats], names: list[str]) -> Floats:
    """Return the moments, s, of the frames of several files one after the other; warn where a day has to be assumed.

    Raises `InputError` where some files state a date and others none, or where only dates could tell the order.
    """
    firsts = [float(np.min(of_file, initial=math.inf, where=np.isfinite(of_file))) for of_file in starts]
    stated = [k for k, first in enumerate(firsts) if math.isfinite(first)]
    dated = [k for k in stated if firsts[k] > _FIRST_DATED]
    if dated and len(dated) < len(stated):
        undated = next(k for k in stated if k not in dated)
        pair = f"{names[undated]}: its start has no date, that of {names[dated[0]]} has"
        raise InputError(f"{pair}; expected a date in both")
    days = dict.fromkeys(stated, 0.0)
    for previous, k in () if dated else pairwise(stated):
        gap = firsts[k] - firsts[previous]
        clocks = f"{_clock(firsts[previous])} and {_clock(firsts[k])}"
        pair = f"{names[previous]} and {names[k]} start at {clocks}, without a date"
        if gap > _HALF_DAY:
            raise InputError(f"{pair}: which is earlier? expected dates, or the files in the order of time")
        days[k] = days[previous] + DAY * (gap < -_HALF_DAY)
        if days[k] > days[previous] == 0:
            warn(f"{pair}: the later one is taken to be of the next day")
    return np.concatenate([of_file + days.get(k, 0.0) for k, of_file in enumerate(starts)])


def _clock(seconds: float) -> str:
    """Return a time of the day such as "14:05:30"."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60:02d}:{minutes % 60:02d}:{rest:02d}"
