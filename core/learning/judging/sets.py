"""The judge's sets of events: recipes to begin with, and what names a set."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ...errors import InputError, several
from ...events.event_set import EventSet
from ...events.templates import with_workbook
from ...example import EXAMPLE
from ...files import AnyPath
from ...validation import one_of

_FOLDER = Path(__file__).parents[1] / "templates"

SETS: Mapping[str, str] = MappingProxyType({
    "train": "to train and to tune with: Derenzo rods, mixtures of ellipsoids, cylinders and boxes",
    "derenzo": "a test: Derenzo rods of other sizes, in other poses",
    "unseen": "a test: textures, cold rods, spheres, a head, blobs",
    "pairs": "a test: Derenzo rods, one left out or added",
    "cardiac": "a test: a torso with and without a perfusion defect; 64³ voxels, all modules",
})  # fmt: skip
"""What each recipe is for, by name."""


def set_text(name: str, workbook: AnyPath = EXAMPLE) -> str:
    """The text of a recipe (TOML) of events, with a workbook's path as the recipe's folder sees it."""
    one_of(name, SETS, "set of events")
    return with_workbook((_FOLDER / f"{name}.toml").read_text(encoding="utf-8"), workbook)


def events_by_recipe(events: EventSet) -> dict[str, list[int]]:
    """The numbers of the events by their recipes' fingerprints: which events these are, wherever their files lie.

    An event follows from its recipe, with the contents of all files that this names, and its number.
    """
    found: dict[str, list[int]] = {}
    for event in events:
        found.setdefault(event.recipe.fingerprint, []).append(event.number)
    return {recipe: sorted(numbers) for recipe, numbers in sorted(found.items())}


def set_fingerprint(events: EventSet) -> str:
    """The name of a set of events: the first 16 digits of a SHA-256 of what `events_by_recipe` gives."""
    return short_hash(events_by_recipe(events))


def short_hash(record: Any) -> str:
    """16 digits of the SHA-256 of what JSON can hold."""
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()[:16]


def refuse_trained_on(method: str, trained_on: Mapping[str, list[int]], events: EventSet, name: str) -> None:
    """Raise `InputError` where a method was trained on events of a test; `trained_on` as of `events_by_recipe`."""
    tests = events_by_recipe(events)
    seen = [n for recipe, numbers in tests.items() for n in sorted({*numbers} & {*trained_on.get(recipe, ())})]
    if seen:
        raise InputError(f"{method}: it was trained on events of the test {name}: {several(seen)}; judge it on others")
