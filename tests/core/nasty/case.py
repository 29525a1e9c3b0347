"""The judgement of how a nasty workbook is read."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core import InputError, InputWarning, PinholeSystem

from .layouts import Draft, map_of


def sample(values: Sequence[Any], every: int, names: Sequence[str] | None = None) -> list[Any]:
    """Return parameters for pytest: every n-th value in the short run, the rest in the long run."""
    return [
        pytest.param(value, marks=() if i % every == 0 else pytest.mark.long, id=name)
        for i, (value, name) in enumerate(zip(values, names or map(str, values), strict=True))
    ]


@dataclass(frozen=True)
class Outcome:
    """The outcome of reading a file."""

    system: PinholeSystem | None
    refusal: str
    warnings: tuple[str, ...]


def read(path: Path, columns: str | None = None) -> Outcome:
    """Return the outcome of `read_system` for `path`; an exception other than `InputError` is passed on."""
    options = {}
    if columns is not None:
        options["columns"] = path.with_suffix(".toml")
        options["columns"].write_text(columns, encoding="utf-8")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            system, refusal = mph.read_system(path, **options), ""
        except InputError as error:
            system, refusal = None, str(error)
    strange = [w for w in caught if not issubclass(w.category, (InputWarning, DeprecationWarning))]
    assert not strange, f"a warning that is none of ours: {strange[0].message}"
    said = tuple(str(w.message) for w in caught if issubclass(w.category, InputWarning))
    for message in (refusal, *said):
        assert "\n" not in message and len(message) <= 600, message
        assert not message or path.stem in message, f"a message without the file's name: {message}"
    return Outcome(system, refusal, said)


def differences(system: PinholeSystem, truth: PinholeSystem, numbered: bool = True) -> str:
    """Return what is read wrong, "" if nothing is."""
    if len(system) != len(truth):
        return f"{len(system)} modules instead of {len(truth)}"
    names = ("centers", "pinhole_diameter", "collimator_length", "detector_side", "detector_thickness", "roi_radius")
    for name in names:
        values, expected = getattr(system, name), getattr(truth, name)
        scale = np.linalg.norm(truth.centers, axis=1).max() if name == "centers" else expected
        wrong = np.abs(values - expected) > 1e-9 * scale
        if wrong.any():
            at = np.unravel_index(np.argmax(wrong), wrong.shape)
            return f"{name}{list(map(int, at))} = {values[at]:.9g} instead of {expected[at]:.9g}"
    if numbered and not np.array_equal(system.numbers, truth.numbers):
        return f"numbers {system.numbers.tolist()} instead of {truth.numbers.tolist()}"
    return ""


def fault(draft: Draft, path: Path, placed: bool = True) -> str:
    """Return what is wrong about how a draft's workbook is read, "" if nothing is; `placed`: it names the place."""
    outcome = read(path)
    said = [outcome.refusal] if outcome.system is None else list(outcome.warnings)
    if draft.plain and said:
        return f"plainly right, but {'; '.join(said)}"
    if outcome.system is not None and draft.truth is not None and draft.clear:
        if wrong := differences(outcome.system, draft.truth, draft.numbered):
            return f"read wrong: {wrong}; said: {said}"
    elif outcome.system is not None and not said:
        return "read without a word, though nobody can tell what it means"
    if said and placed and draft.places and not any(place in message for place in draft.places for message in said):
        return f"{' or '.join(draft.places)} is not named: {'; '.join(said)}"
    columns = map_of(draft)
    if columns is None:
        return ""
    mapped = read(path, columns)
    if draft.truth is None:
        silent = mapped.system is not None and not mapped.warnings
        return "read by a map without a word, though it holds no such numbers" if silent else ""
    if mapped.system is None:
        return f"refused with a map too: {mapped.refusal}"
    wrong = differences(mapped.system, draft.truth, draft.numbered)
    return f"wrong with a map: {wrong}" if wrong else ""
