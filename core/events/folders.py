"""Folder of an event set: recipe, copies of the files that it names, requested events, index, and the events' files."""

import json
import os
import re
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from ..errors import InputError, warn
from ..files import AnyPath, ensure_folder, folder_path, refuse_links, remove_leftovers, write_bytes
from ..version import build
from .event_files import FileLocation, Header, read_header
from .event_maker import EventMaker
from .index import Index
from .inputs import Input
from .recipe import EventRecipe, read_recipe
from .store import Store

RECIPE, INDEX, INPUTS, REQUESTS = "recipe.toml", "index.csv", "inputs", "asked"
INPUT_LIST = "inputs.json"
_RANGE = re.compile(r"(\d+)-(\d+)")


class SetFolder:
    """Folder of an event set, whose files are read on first access."""

    def __init__(self, path: AnyPath) -> None:
        self.path = folder_path(path)
        self.recipe_path, self.inputs, self.requests_path = self.path / RECIPE, self.path / INPUTS, self.path / REQUESTS
        self.store = Store(self.path)

    def __reduce__(self) -> tuple[Any, ...]:
        return SetFolder, (self.path,)

    @cached_property
    def maker(self) -> EventMaker:
        """The maker of the set's events, with its scanner and views."""
        return EventMaker(self.recipe)

    @cached_property
    def index(self) -> Index:
        """The index of the set: its table of events."""
        return Index(self.path / INDEX, self.recipe)

    @cached_property
    def lines(self) -> dict[int, str]:
        """The lines of the index by event number, as they were on first access."""
        return self.index.read()

    def line(self, number: int) -> str:
        """Return an event's line of the index, drawn from the recipe where the index has none."""
        return self.lines.get(number) or self.index.line(number)

    @cached_property
    def locations(self) -> dict[int, FileLocation]:
        """The locations of the events' files by number, as they were on first access; packing a set changes them."""
        return self.store.locations()

    def valid_header(self, number: int, location: FileLocation | None) -> Header | None:
        """Read the header of an event's file; None where the file is missing, truncated, or that of another event."""
        try:
            header = None if location is None else read_header(location)
        except InputError:
            return None
        return header if header is not None and header.event == number else None

    def is_made(self, number: int, location: FileLocation) -> bool:
        """Return whether the file of an event is complete and of this recipe, by its header."""
        header = self.valid_header(number, location)
        return header is not None and header.recipe == self.recipe.fingerprint

    @cached_property
    def recipe(self) -> EventRecipe:
        """The set's recipe, which reads the set's copies of files; `InputError` where the folder has no recipe."""
        if not self.recipe_path.is_file():
            raise InputError(f"{self.path}: no event set: it holds no {RECIPE}")
        return read_recipe(self.recipe_path, self.copies())

    def copies(self) -> dict[str, Input]:
        """Return the set's copies of the files that the recipe names, by these names; none before the first are made."""
        path = self.inputs / INPUT_LIST
        try:
            entries = json.loads(path.read_text(encoding="utf-8"))
            return {
                name: Input(self.inputs / Path(entry["file"]).name, entry["what"], entry["sha256"], True)
                for name, entry in entries.items()
            }
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise InputError(f"{path}: cannot be read ({error})") from None

    def refuse_links(self) -> None:
        """Raise `InputError` if the index or one of the folders is a link: work on the set would change files beyond it."""
        refuse_links(self.path / INDEX, self.inputs, self.requests_path, self.store.events, self.store.shards)

    def prepare(self, recipe: EventRecipe, requested: Sequence[range], numbers: Sequence[int]) -> list[int]:
        """Prepare the folder for a recipe's events: store the recipe, copies of its files, and the requested events.

        Return those of the events `numbers` that are missing. `InputError` where the folder holds another recipe, events of
        another recipe, or files that are no event set.
        """
        ensure_folder(self.path)
        self.refuse_links()
        for folder in (self.path, self.inputs, self.store.events):
            remove_leftovers(folder)
        if not self.recipe_path.exists():
            # Names that begin with a dot are files that other processes are writing.
            if foreign_names := [name for name in os.listdir(self.path) if not name.startswith(".")]:
                content = f"holds {foreign_names[0]} and no {RECIPE}"
                raise InputError(f"{self.path}: {content}: choose a new folder for the event set")
            write_bytes(self.recipe_path, recipe.text.encode())
        stored, locations = read_recipe(self.recipe_path, self.copies()), self.store.locations()
        if stored.values != recipe.values:
            no_events = "" if locations else f", or remove {self.path}, which holds no events yet"
            raise InputError(f"{self.recipe_path}: another recipe: choose another folder for {recipe.name}{no_events}")
        ensure_folder(self.store.events)
        copies = self.copies()
        if set(copies) != set(recipe.files) or not locations:
            copies = self._copy_inputs(recipe, copies)
        vars(self)["recipe"] = EventRecipe(stored.text, stored.name, stored.folder, copies)
        if self.recipe.fingerprint != recipe.fingerprint:
            changed = "a file that it names has changed since the set was begun"
            advice = f"go on with these (mphdrr events make {self.path}), or choose another folder"
            raise InputError(f"{recipe.name}: {changed}; the set's own copies are in {self.inputs}: {advice}")
        self._add_requests(requested)
        if not self.index.is_current():
            self.complete_index()
        return self._missing_events(numbers, locations)

    def _missing_events(self, numbers: Sequence[int], locations: dict[int, FileLocation]) -> list[int]:
        """Return the events of `numbers` whose files are missing or incomplete; `InputError` for one of another recipe."""
        missing, has_warned = [], False
        for number in numbers:
            if (header := self.valid_header(number, locations.get(number))) is None:
                missing.append(number)
                continue
            if header.recipe != self.recipe.fingerprint:
                remedy = f"choose another folder, or `mphdrr events check {self.path} --repair` makes such events again"
                raise InputError(f"{self.store.event_path(number)}: an event of another recipe: {remedy}")
            if header.build != build() and not has_warned:
                has_warned = True
                builds = f"({header.build or 'of version 0.1'}, this is {build()})"
                differ = "events of the two may differ in their last digits, or by what was fixed in between"
                warn(f"{self.path}: event {number} was made by another build of mphDRR {builds}: {differ}")
        return missing

    def _copy_inputs(self, recipe: EventRecipe, earlier_copies: dict[str, Input]) -> dict[str, Input]:
        """Copy the files that the recipe names into the folder and return the copies; those with the same content stay."""
        ensure_folder(self.inputs)
        copies: dict[str, Input] = {}
        for name in recipe.files:
            original, earlier = recipe.input(name), earlier_copies.get(name)
            is_same = earlier is not None and earlier.path.is_file() and earlier.sha256 == original.sha256
            copies[name] = earlier if is_same and earlier is not None else original.copy_to(self.inputs)
        entries = {
            name: {"file": copy.path.name, "what": copy.content, "sha256": copy.sha256} for name, copy in copies.items()
        }
        write_bytes(self.inputs / INPUT_LIST, json.dumps(entries, indent=1, sort_keys=True).encode() + b"\n")
        paths = {copy.path for copy in copies.values()}
        for copy in earlier_copies.values():  # the recipe may have been changed before its first event
            if copy.path not in paths:
                copy.path.unlink(missing_ok=True)
        return copies

    @property
    def request_names(self) -> list[str]:
        """The names "FIRST-LAST" of empty files, one per range of requested events; processes add them independently."""
        names = os.listdir(self.requests_path) if self.requests_path.is_dir() else []
        return [name for name in names if _RANGE.fullmatch(name)]

    @property
    def requested(self) -> list[range]:
        """The ranges of requested events, in order."""
        ends = (map(int, name.split("-")) for name in self.request_names)
        ranges = [range(first, last + 1) for first, last in ends]
        if not ranges and (self.path / INDEX).exists():  # sets of earlier versions request what their index lists
            ranges = [range(n, n + 1) for n in self.index.read()]
        return _merge_ranges(ranges)

    def _add_requests(self, requested: Sequence[range]) -> None:
        """Store ranges of requested events; adjacent ranges become one."""
        earlier_names, ranges = self.request_names, _merge_ranges([*self.requested, *requested])
        ensure_folder(self.requests_path)
        for name in (names := [f"{span[0]}-{span[-1]}" for span in ranges]):
            (self.requests_path / name).touch()
        for name in set(earlier_names) - set(names):
            (self.requests_path / name).unlink(missing_ok=True)

    def requested_numbers(self) -> list[int]:
        """Return the numbers of the requested events, in order."""
        return [number for span in self.requested for number in span]

    def complete_index(self) -> None:
        """Complete the index: a row for each stored event that was requested."""
        self.index.complete(self.store.locations, frozenset(self.requested_numbers()))


def _merge_ranges(ranges: Sequence[range]) -> list[range]:
    """Return ranges in order, with those that touch or overlap merged."""
    merged: list[range] = []
    for span in sorted(ranges, key=lambda span: span.start):
        if merged and span.start <= merged[-1].stop:
            merged[-1] = range(merged[-1].start, max(merged[-1].stop, span.stop))
        else:
            merged.append(span)
    return merged
