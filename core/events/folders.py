"""The folder of an event set: recipe, copies of what it names, which events were asked for, index, and the events' files."""

import json
import os
import re
from collections.abc import Sequence
from functools import cached_property
from typing import Any

from ..errors import InputError, warn
from ..files import AnyPath, ensure_folder, folder_path, remove_leftovers, write_bytes
from ..version import build
from .event_files import Header, Place, header
from .event_maker import EventMaker
from .index import Index
from .inputs import Input
from .recipe import EventRecipe, read_recipe
from .store import Store

RECIPE, INDEX, INPUTS, ASKED = "recipe.toml", "index.csv", "inputs", "asked"
INPUT_LIST = "inputs.json"
_RANGE = re.compile(r"(\d+)-(\d+)")


class SetFolder:
    """Where everything of an event set is; nothing is read before it is asked for."""

    def __init__(self, path: AnyPath) -> None:
        self.path = folder_path(path)
        self.recipe_path, self.inputs, self.asked_path = self.path / RECIPE, self.path / INPUTS, self.path / ASKED
        self.store = Store(self.path)

    def __reduce__(self) -> tuple[Any, ...]:
        return SetFolder, (self.path,)

    @cached_property
    def maker(self) -> EventMaker:
        """What makes its events: it has scanner and views."""
        return EventMaker(self.recipe)

    @cached_property
    def index(self) -> Index:
        """Its table of events."""
        return Index(self.path / INDEX, self.recipe)

    @cached_property
    def lines(self) -> dict[int, str]:
        """The rows of the index by event, as they were when this was first asked for."""
        return self.index.read()

    def line(self, number: int) -> str:
        """A row of the index, drawn where the index has none."""
        return self.lines.get(number) or self.index.line(number)

    @cached_property
    def places(self) -> dict[int, Place]:
        """The events' files, as they were when this was first asked for: a set may be packed while it is read."""
        return self.store.places()

    def header(self, number: int, place: Place | None) -> Header | None:
        """The header of an event's file; None where it is not there, not as long as it should be, or another event."""
        try:
            found = None if place is None else header(place)
        except InputError:
            return None
        return found if found is not None and found.event == number else None

    def is_made(self, number: int, place: Place) -> bool:
        """Whether an event is as long as it should be and of this recipe."""
        found = self.header(number, place)
        return found is not None and found.recipe == self.recipe.fingerprint

    @cached_property
    def recipe(self) -> EventRecipe:
        """The set's recipe, with the copies of the files that it names; `InputError` where there is none."""
        if not self.recipe_path.is_file():
            raise InputError(f"{self.path}: no event set: it holds no {RECIPE}")
        return read_recipe(self.recipe_path, self.copies())

    def copies(self) -> dict[str, Input]:
        """The set's copies of the files that the recipe names, by their names there; empty where none are made yet."""
        path = self.inputs / INPUT_LIST
        try:
            listed = json.loads(path.read_text(encoding="utf-8"))
            return {
                name: Input(self.inputs / entry["file"], entry["what"], entry["sha256"], True)
                for name, entry in listed.items()
            }
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise InputError(f"{path}: cannot be read ({error})") from None

    def prepare(self, recipe: EventRecipe, asked: Sequence[range], mine: Sequence[int]) -> list[int]:
        """Put a recipe and what it names into the folder, unless they are there, and note which events are asked for.

        Gives those of the events `mine` that are missing. `InputError` where the folder holds another recipe, events of
        another one, or files that are no event set.
        """
        ensure_folder(self.path)
        for folder in (self.path, self.inputs, self.store.events):
            remove_leftovers(folder)
        if not self.recipe_path.exists():
            # Names with a dot are of files that other works have begun.
            if others := [name for name in os.listdir(self.path) if not name.startswith(".")]:
                found = f"holds {others[0]} and no {RECIPE}"
                raise InputError(f"{self.path}: {found}: choose a new folder for the event set")
            write_bytes(self.recipe_path, recipe.text.encode())
        there, places = read_recipe(self.recipe_path, self.copies()), self.store.places()
        if there.values != recipe.values:
            no_events = "" if places else f", or remove {self.path}, which holds no events yet"
            raise InputError(f"{self.recipe_path}: another recipe: choose another folder for {recipe.name}{no_events}")
        ensure_folder(self.store.events)
        copies = self.copies()
        if set(copies) != set(recipe.files) or not places:
            copies = self._copy(recipe, copies)
        vars(self)["recipe"] = EventRecipe(there.text, there.name, there.folder, copies)
        if self.recipe.fingerprint != recipe.fingerprint:
            changed = "a file that it names has changed since the set was begun"
            advice = f"go on with these (mphdrr events make {self.path}), or choose another folder"
            raise InputError(f"{recipe.name}: {changed}; the set's own copies are in {self.inputs}: {advice}")
        self._ask(asked)
        if not self.index.is_current():
            self.complete_index()
        return self._missing(mine, places)

    def _missing(self, mine: Sequence[int], places: dict[int, Place]) -> list[int]:
        """Which of some events are not there as they should be; `InputError` for one of another recipe."""
        missing, has_warned = [], False
        for number in mine:
            found = self.header(number, places.get(number))
            if found is None:
                missing.append(number)
                continue
            if found.recipe != self.recipe.fingerprint:
                remedy = f"choose another folder, or `mphdrr events check {self.path} --repair` makes such events anew"
                raise InputError(f"{self.store.event_path(number)}: an event of another recipe: {remedy}")
            if found.build != build() and not has_warned:
                has_warned = True
                builds = f"({found.build or 'of version 0.1'}, this is {build()})"
                differ = "events of the two may differ in their last digits, or by what was mended between"
                warn(f"{self.path}: event {number} was made by another build of mphDRR {builds}: {differ}")
        return missing

    def _copy(self, recipe: EventRecipe, known: dict[str, Input]) -> dict[str, Input]:
        """Copies of what the recipe names; those that hold the same already are kept."""
        ensure_folder(self.inputs)
        copies: dict[str, Input] = {}
        for name in recipe.files:
            wanted, there = recipe.input(name), known.get(name)
            same = there is not None and there.path.is_file() and there.sha256 == wanted.sha256
            copies[name] = there if same and there is not None else wanted.copy_to(self.inputs)
        listed = {
            name: {"file": copy.path.name, "what": copy.what, "sha256": copy.sha256} for name, copy in copies.items()
        }
        write_bytes(self.inputs / INPUT_LIST, json.dumps(listed, indent=1, sort_keys=True).encode() + b"\n")
        kept = {copy.path for copy in copies.values()}
        for copy in known.values():  # of a recipe that was changed before its first event
            if copy.path not in kept:
                copy.path.unlink(missing_ok=True)
        return copies

    @property
    def asked_names(self) -> list[str]:
        """The empty files whose names say which events were asked for, so that works add to them at once."""
        return (
            [name for name in os.listdir(self.asked_path) if _RANGE.fullmatch(name)] if self.asked_path.is_dir() else []
        )

    @property
    def asked(self) -> list[range]:
        """The events that were asked for, in order."""
        ends = (map(int, name.split("-")) for name in self.asked_names)
        found = [range(first, last + 1) for first, last in ends]
        if not found and (self.path / INDEX).exists():  # of an earlier version
            found = [range(n, n + 1) for n in self.index.read()]
        return _joined(found)

    def _ask(self, asked: Sequence[range]) -> None:
        """Note which events are asked for; ranges that touch become one."""
        before, whole = self.asked_names, _joined([*self.asked, *asked])
        ensure_folder(self.asked_path)
        for name in (names := [f"{part[0]}-{part[-1]}" for part in whole]):
            (self.asked_path / name).touch()
        for name in set(before) - set(names):
            (self.asked_path / name).unlink(missing_ok=True)

    def planned(self) -> list[int]:
        """The numbers of the events that were asked for, in order."""
        return [number for part in self.asked for number in part]

    def complete_index(self) -> None:
        """Have a row of the index for each event that is there."""
        self.index.complete(self.store.places, frozenset(self.planned()))


def _joined(ranges: Sequence[range]) -> list[range]:
    """Ranges in order, those that touch as one."""
    found: list[range] = []
    for part in sorted(ranges, key=lambda part: part.start):
        if found and part.start <= found[-1].stop:
            found[-1] = range(found[-1].start, max(found[-1].stop, part.stop))
        else:
            found.append(part)
    return found
