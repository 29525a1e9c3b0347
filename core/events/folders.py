"""The folder of an event set: recipe, copies of what it names, index, and a file for each event."""

import csv
import io
import json
import os
import re
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files import ensure_folder, folder_path, replacing
from .cells import escaped, unescaped
from .event_files import header
from .inputs import Input
from .planning import plan
from .recipe import EventRecipe, read_recipe

RECIPE, INDEX, INPUTS, EVENTS = "recipe.toml", "index.csv", "inputs", "events"
INPUT_LIST = "inputs.json"
_EVENT = re.compile(r"(\d{6,})\.h5")
_LEFTOVER = re.compile(r"\.[0-9a-f]{8}-.+")
"""Names of files that are being written (`files.replacing`)."""


class SetFolder:
    """Where everything of an event set is; nothing is read before it is asked for."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = folder_path(path)
        self.recipe_path, self.index_path = self.path / RECIPE, self.path / INDEX
        self.inputs, self.events = self.path / INPUTS, self.path / EVENTS

    def event_path(self, number: int) -> Path:
        """The file of an event."""
        return self.events / f"{number:06d}.h5"

    def numbers(self) -> list[int]:
        """Of the events that have a file, in order."""
        try:
            names = os.listdir(self.events)
        except FileNotFoundError:
            return []
        except OSError as error:
            raise InputError(f"{self.events}: {error.strerror or error}") from None
        found = (_EVENT.fullmatch(name) for name in names)
        return sorted(number for match in found if match and self.event_path(number := int(match[1])).name == match[0])

    def is_made(self, number: int, fingerprint: str) -> bool:
        """Whether an event's file is there, as long as it should be and of this recipe."""
        try:
            found = header(self.event_path(number))
        except InputError:
            return False
        return found.event == number and found.recipe == fingerprint

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

    def prepare(self, recipe: EventRecipe) -> EventRecipe:
        """Put a recipe and what it names into the folder, unless they are there; the recipe that reads these copies.

        `InputError` where the folder holds another recipe, events of another one, or files that are no event set.
        """
        ensure_folder(self.path)
        for folder in (self.path, self.inputs):  # of a work that was killed
            for path in folder.glob(".????????-*"):
                if is_leftover(path.name):
                    path.unlink(missing_ok=True)
        if not self.recipe_path.exists():
            if others := [name for name in os.listdir(self.path) if not _LEFTOVER.fullmatch(name)]:
                raise InputError(
                    f"{self.path}: holds {others[0]} and no {RECIPE}: choose a new folder for the event set"
                )
            _write_text(self.recipe_path, recipe.text)
        there = read_recipe(self.recipe_path, self.copies())
        if there.values != recipe.values:
            no_events = "" if self.numbers() else f", or remove {self.path}, which holds no events yet"
            raise InputError(f"{self.recipe_path}: another recipe: choose another folder for {recipe.name}{no_events}")
        ensure_folder(self.events)
        copies = self.copies()
        if set(copies) != set(recipe.files) or not self.numbers():
            copies = self._copy(recipe, copies)
        mine = EventRecipe(there.text, there.name, there.folder, copies)
        if mine.fingerprint != recipe.fingerprint:
            raise InputError(
                f"{recipe.name}: a file that it names has changed since the set was begun; the set's own copies are in "
                f"{self.inputs}: go on with these (mphdrr events make {self.path}), or choose another folder"
            )
        for number in self.numbers():
            try:
                found = header(self.event_path(number))
            except InputError:
                continue
            if found.recipe != mine.fingerprint:
                raise InputError(
                    f"{self.event_path(number)}: an event of another recipe: choose another folder, or "
                    f"`mphdrr events check {self.path} --repair` makes such events anew"
                )
        vars(self)["recipe"] = mine
        return mine

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
        _write_text(self.inputs / INPUT_LIST, json.dumps(listed, indent=1, sort_keys=True) + "\n")
        kept = {copy.path for copy in copies.values()}
        for copy in known.values():  # of a recipe that was changed before its first event
            if copy.path not in kept:
                copy.path.unlink(missing_ok=True)
        return copies

    def planned(self) -> list[int]:
        """The numbers of the events that were asked for, in order: those of the index."""
        return [row["event"] for row in self.rows()]

    def rows(self) -> list[dict[str, Any]]:
        """The rows of the index, one for each event that was asked for; empty where there is no index."""
        try:
            with open(self.index_path, newline="", encoding="utf-8") as file:
                rows = [{key: _value(key, text) for key, text in row.items()} for row in csv.DictReader(file)]
        except FileNotFoundError:
            return []
        except (OSError, ValueError, csv.Error) as error:
            raise InputError(
                f"{self.index_path}: cannot be read ({error}): mphdrr events check {self.path} --repair writes it anew"
            ) from None
        if not all(isinstance(row.get("event"), int) for row in rows):
            raise InputError(
                f"{self.index_path}: cannot be read: mphdrr events check {self.path} --repair writes it anew"
            )
        return rows

    def index_text(self, numbers: Iterable[int]) -> str:
        """The index of events, CSV: drawn from the recipe alone, so that all shards of a set write the same."""
        rows = [plan(self.recipe, number).row() for number in sorted(set(numbers))]
        columns = list(dict.fromkeys(key for row in rows for key in row))
        text = io.StringIO()
        writer = csv.DictWriter(text, columns, restval="", lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({key: escaped(v) if isinstance(v, str) else json.dumps(v) for key, v in row.items()})
        return text.getvalue()

    def write_index(self, numbers: Iterable[int]) -> None:
        """Write the index of these events unless it is there."""
        text = self.index_text(numbers)
        if not self.index_path.is_file() or self.index_path.read_bytes() != text.encode():
            _write_text(self.index_path, text)

    def remove_leftovers(self, number: int) -> None:
        """Remove what a write of this event has left that was interrupted."""
        for path in self.events.glob(f".????????-{self.event_path(number).name}"):
            path.unlink(missing_ok=True)


def _write_text(path: Path, text: str) -> None:
    """Write a file that other shards may write at the same time: what one begins another may remove (`prepare`)."""
    for attempt in range(3):
        try:
            with replacing(path) as temporary:
                temporary.write_text(text, encoding="utf-8", newline="")
            return
        except InputError:
            if attempt == 2:
                raise


def is_leftover(name: str) -> bool:
    """Whether a file's name is that of one that was being written."""
    return _LEFTOVER.fullmatch(name) is not None


def _value(key: str, text: str | None) -> Any:
    """What a cell of the index holds."""
    if not text:
        return None
    if key in ("phantom", "split", "file"):
        return unescaped(text)
    try:
        return json.loads(text)
    except ValueError:
        return unescaped(text)
