"""Event sets of the judge: recipes for them, and names that identify sets."""

import hashlib
import json
from collections.abc import Collection, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ...errors import InputError, several
from ...events.event_set import Event, EventSet
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
"""Purpose of each recipe, by name."""


def set_text(name: str, workbook: AnyPath = EXAMPLE) -> str:
    """Return the text of an event recipe (TOML) with the path of a workbook, relative to the recipe's folder."""
    one_of(name, SETS, "set of events")
    return with_workbook((_FOLDER / f"{name}.toml").read_text(encoding="utf-8"), workbook)


def events_by_recipe(events: EventSet) -> dict[str, list[int]]:
    """Return the numbers of the events by their recipes' fingerprints, which identifies them wherever their files are.

    An event follows from its recipe, including the contents of all files that it names, and its number.
    """
    numbers_by_recipe: dict[str, list[int]] = {}
    for event in events:
        numbers_by_recipe.setdefault(event.recipe.fingerprint, []).append(event.number)
    return {recipe: sorted(numbers) for recipe, numbers in sorted(numbers_by_recipe.items())}


def set_fingerprint(events: EventSet) -> str:
    """Return the name of a set of events: 16 digits of a SHA-256 of `events_by_recipe`."""
    return short_hash(events_by_recipe(events))


def short_hash(record: Any) -> str:
    """Return 16 digits of the SHA-256 of JSON values."""
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()[:16]


def truths_of(events: EventSet) -> list[str]:
    """Return a hash of each event's truth: phantom, with the contents of its files, gates, size, mirroring and pose.

    It is the same whatever is measured of the truth: scanner, time, noise, voxels and `augmentation.activity` are left out.
    """
    return [_truth_hash(event) for event in events]


def _truth_hash(event: Event) -> str:
    """Return the hash of an event's truth, the placement rounded: its last digits differ between machines."""
    planned = event.planned
    files = [planned.recipe.input(name).sha256 for name in (planned.file, planned.mu_file) if name is not None]
    phantom = [files, planned.entry["center"]] if files else event.settings
    return short_hash([phantom, planned.entry["gates"], (planned.placement.round(6) + 0.0).tolist()])


def refuse_trained_on(
    method: str, trained_on: Mapping[str, list[int]], truths: Collection[str], events: EventSet, name: str
) -> None:
    """Raise `InputError` if a method was trained on events of a test, or on other events with their truths.

    `trained_on` is in the form of `events_by_recipe`, and `truths` in that of `truths_of`; earlier models state none.
    """
    hashes = truths_of(events) if truths else [""] * len(events)
    hits = [
        event.number for event, truth in zip(events, hashes, strict=True)
        if event.number in trained_on.get(event.recipe.fingerprint, ()) or truth in truths
    ]  # fmt: skip
    if hits:
        raise InputError(f"{method}: it was trained on events of the test {name}: {several(hits)}; judge it on others")
