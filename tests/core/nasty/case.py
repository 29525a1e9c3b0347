"""A nasty workbook, and the judgement of what is read from it."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.core import InputError, InputWarning, PinholeSystem

from .sheets import Book, by_hand

RIGHT = "right"
"""The scanner, without a word."""
WARNED = "right, with a warning that names the place"
WARNED_OF = "whatever was read, with a warning that names the place"
REFUSED = "refused, naming the place"
READ_OR_REFUSED = (RIGHT, REFUSED)
DOUBTED = (REFUSED, WARNED_OF)

Made = Book | Callable[[Path], Any]


@dataclass(frozen=True)
class Case:
    """A workbook that is easily misread.

    Attributes
    ----------
    name : str
    make : callable
        Returns the book, which is then written by hand, or writes the file itself.
    truth : PinholeSystem or None
        The scanner that a person sees in it, or the one of the two that `columns` tells; None: nobody can tell.
    allowed : tuple of str
        The allowed outcomes.
    place : tuple of str
        A refusal or a warning must contain one of these: the cell, or the sheet.
    columns : str or None
        The TOML of the column map with which it must be read as `truth` if it is refused without.
    unmappable : str
        Why no column map reads it although a person does.
    numbered : bool
        Whether the modules' numbers are the truth's.
    file : str
        The file's name.
    """

    name: str
    make: Callable[..., Any]
    truth: PinholeSystem | None
    allowed: tuple[str, ...]
    place: tuple[str, ...] = ()
    columns: str | None = None
    unmappable: str = ""
    numbered: bool = True
    file: str = "scanner.xlsx"
    needs: tuple[str, ...] = ()  # modules without which it is skipped

    def __post_init__(self) -> None:
        refusable = REFUSED in self.allowed
        assert self.allowed and (RIGHT not in self.allowed or self.truth is not None), self.name
        assert not refusable or self.truth is None or self.columns or self.unmappable, f"{self.name}: no map"


@dataclass
class Catalogue:
    """Cases by name; the place and the map of those that say none, or why they have none."""

    topic: str
    place: str | tuple[str, ...] = ()
    columns: str | None = None
    unmappable: str = ""
    cases: dict[str, Case] = field(default_factory=dict)

    def add(self, name: str, make: Callable[..., Any] | Book, truth: PinholeSystem | None, *allowed: str, **more: Any):
        assert name not in self.cases, f"two cases are called {name}"
        more = {"place": self.place, "unmappable": self.unmappable, **more}
        if truth is not None and not more["unmappable"]:
            more.setdefault("columns", self.columns)
        build = make if callable(make) else lambda: make
        for key in ("place", "needs"):
            if isinstance(more.get(key), str):
                more[key] = (more[key],)
        self.cases[name] = Case(name, build, truth, allowed, **more)


def write(case: Case, folder: Path) -> Path:
    """The case's file in `folder`."""
    for module in case.needs:
        pytest.importorskip(module)
    path = folder / case.file
    if "path" in inspect.signature(case.make).parameters:
        case.make(path)
    else:
        by_hand(case.make(), path)
    return path


def sample(names: Iterable[str], every: int) -> list[Any]:
    """Parameters for pytest: every n-th name in the short run, the rest in the long run."""
    return [
        pytest.param(name, marks=() if i % every == 0 else pytest.mark.long, id=name) for i, name in enumerate(names)
    ]


@dataclass(frozen=True)
class Outcome:
    """The outcome of reading a file."""

    system: PinholeSystem | None
    refusal: str
    warnings: tuple[str, ...]


def read(path: Path, columns: str | None = None) -> Outcome:
    """The outcome of `read_system` for `path`; an exception other than `InputError` is passed on."""
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
    return Outcome(system, refusal, said)


def differences(system: PinholeSystem, truth: PinholeSystem, numbered: bool = True) -> str:
    """What is read wrong, "" if nothing is."""
    if len(system) != len(truth):
        return f"{len(system)} modules instead of {len(truth)}"
    names = ("centers", "pinhole_diameter", "collimator_length", "detector_side", "detector_thickness", "roi_radius")
    for name in names:
        found, expected = getattr(system, name), getattr(truth, name)
        scale = np.linalg.norm(truth.centers, axis=1).max() if name == "centers" else expected
        wrong = np.abs(found - expected) > 1e-9 * scale
        if wrong.any():
            at = np.unravel_index(np.argmax(wrong), wrong.shape)
            return f"{name}{list(map(int, at))} = {found[at]:.9g} instead of {expected[at]:.9g}"
    if numbered and not np.array_equal(system.numbers, truth.numbers):
        return f"numbers {system.numbers.tolist()} instead of {truth.numbers.tolist()}"
    return ""


def fault(case: Case, path: Path, mapped: bool = False) -> str:
    """What is wrong about how the file is read, "" if nothing is; `mapped`: with the map from the beginning."""
    outcome = read(path, case.columns if mapped else None)
    for message in (outcome.refusal, *outcome.warnings):
        if "\n" in message:
            return f"a message of several lines: {message!r}"
        if message and path.stem not in message:
            return f"a message without the file's name: {message}"
        if len(message) > 600:
            return f"a message of {len(message)} characters: {message}"
    found = verdict(case, outcome)
    if found not in case.allowed and not (found == WARNED and WARNED_OF in case.allowed):
        said = outcome.refusal or "; ".join(outcome.warnings) or "without a word"
        return f"{found}: {said}; expected {' or '.join(case.allowed)}"
    said = (outcome.refusal,) if outcome.refusal else outcome.warnings
    if case.place and said and not any(place in message for place in case.place for message in said):
        return f"{' or '.join(case.place)} is not named: {'; '.join(said)}"
    return mapped_fault(case, path) if outcome.refusal and case.columns and not mapped else ""


def verdict(case: Case, outcome: Outcome) -> str:
    """The outcome for the file."""
    if outcome.system is None:
        return REFUSED
    wrong = "nobody can tell what it means" if case.truth is None else None
    if case.truth is not None:
        wrong = differences(outcome.system, case.truth, case.numbered)
    if not wrong:
        return WARNED if outcome.warnings else RIGHT
    return WARNED_OF if outcome.warnings else f"silently wrong ({wrong})"


def mapped_fault(case: Case, path: Path) -> str:
    """What is wrong about how the file is read with the case's map."""
    assert case.columns is not None and case.truth is not None
    outcome = read(path, case.columns)
    if outcome.system is None:
        return f"refused with a map too: {outcome.refusal}"
    wrong = differences(outcome.system, case.truth, case.numbered)
    return f"wrong with a map: {wrong}" if wrong else ""
