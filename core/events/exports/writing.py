"""Writes an export into a folder: every file whole or not at all, and again where it stopped.

``export.json`` says what was asked for, ``events.csv`` which event each number is. A folder that holds the same export is
gone on with: files that are there stay, those of more events are added. Any other folder with something in it is refused.
"""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import InputError
from ...files import ensure_folder, final_name, is_leftover, write_bytes
from ...memory import readable_size
from ...progress import Progress, tell
from ..cells import csv_line, csv_lines, escaped, unescaped
from ..noise_choice import chosen_seed
from .layout import Chosen, Layout, Part, Row

REQUEST, TABLE = "export.json", "events.csv"
_FORMAT = "mphDRR export"


@dataclass(frozen=True)
class Plan:
    """What an export will write; nothing is written yet."""

    layout: Layout
    folder: Path
    rows: list[Row]
    parts: list[Part]
    """All parts of the export."""
    missing: list[Part]
    """What is not there yet."""
    changed: list[Path]
    """Files of an earlier export of fewer events that will have more in them."""
    request: dict[str, Any]

    @property
    def events(self) -> int:
        """How many events are to be written."""
        return sum(len(part.events) for part in self.missing)

    @property
    def size(self) -> int:
        """Bytes of all that is to be written; of compressed files the most that it can be."""
        return self.events * self.layout.event_bytes

    def says(self) -> str:
        """How much there is to do, in a line."""
        there = len(self.rows) - self.events
        most = "at most " if self.layout.packed else ""
        kept = f", {there} are there already" if there else ""
        each, size = readable_size(self.layout.event_bytes), readable_size(self.size)
        return f"{self.events} events of {most}{each}, {size} in all{kept}"

    def write(self, progress: Progress | None = None) -> None:
        """Write what is missing, and the tables; `progress` counts events."""
        self._require_room()
        for name in {str(Path(file).parent) for part in self.missing for file in part.files}:
            ensure_folder(self.folder / name)
        self._remove_leftovers()
        for path in self.changed:
            path.unlink(missing_ok=True)
        # First, so that whatever there is of an unfinished export is known to be of it.
        write_bytes(self.folder / REQUEST, json.dumps(self.request, indent=1).encode() + b"\n")
        for name, content in {TABLE: table(self.rows), **self.layout.tables(self.rows)}.items():
            write_bytes(self.folder / name, content)
        done = len(self.rows) - self.events

        def written() -> None:
            nonlocal done
            done += 1
            tell(progress, done, len(self.rows))

        for part in self.missing:
            self.layout.write(part, self.rows, self.folder, written)

    def _remove_leftovers(self) -> None:
        """Remove what a killed export was writing: readers of whole folders would find it."""
        known = {self.folder / file for part in self.parts for file in part.files}
        for path in (*self.folder.glob(".*"), *self.folder.glob("*/.*")):
            name = final_name(path.name)
            if name and is_leftover(path) and (path.with_name(name) in known or path.parent == self.folder):
                path.unlink(missing_ok=True)

    def _require_room(self) -> None:
        free = shutil.disk_usage(self.folder).free
        if not self.layout.packed and self.size > free:
            needed = f"the export needs {readable_size(self.size)}, but the disk has {readable_size(free)} left"
            raise InputError(f"{self.folder}: {needed}; choose another folder, or one split of the set")


def plan_export(layout: Layout, chosen: Chosen, folder: Path, program: str, options: dict[str, Any]) -> Plan:
    """What is to be written into `folder`, which is made; `InputError` if it holds something else."""
    rows = [
        {
            "i": i,
            "event": row["event"],
            "split": row["split"] or "all",
            "name": row["phantom"],
            "mirror": int(row["mirror"]),
            "size": row["size"],
            "noise_seed": "" if (seed := chosen_seed(row["noise_seed"], chosen.noise)) is None else seed,
        }
        for i, row in enumerate(chosen.events.index)
    ]
    request = {
        "format": _FORMAT,
        "version": 1,
        "program": program,
        "recipes": list(dict.fromkeys(event.recipe.fingerprint for event in chosen.events)),
        "models": list(chosen.models),
        "noise": chosen.noise,
        "level": chosen.level,
        "options": options,
    }
    folder = ensure_folder(folder)
    before = _require_same(folder, request, rows)
    parts, kept = layout.parts(rows), set(layout.parts(rows[:before]))
    missing = [part for part in parts if part not in kept or not all((folder / file).is_file() for file in part.files)]
    changed = [folder / file for part in kept.difference(parts) for file in part.files]
    return Plan(layout, folder, rows, parts, missing, changed, request)


def _require_same(folder: Path, request: dict[str, Any], rows: list[Row]) -> int:
    """How many events the same export had in the folder before; `InputError` if something else is in it."""
    if all(final_name(path.name) for path in folder.iterdir()):
        return 0
    try:
        asked = json.loads((folder / REQUEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        asked = {}
    if not isinstance(asked, dict) or asked.get("format") != _FORMAT:
        raise InputError(f"{folder}: expected a new folder, an empty one, or one with an export to go on with")
    changed = [name for name in request if asked.get(name) != request[name]]
    if changed:
        raise InputError(f"{folder}: holds an export of another {', '.join(changed)}; choose another folder")
    path = folder / TABLE
    before = _cells(path.read_text(encoding="utf-8")) if path.is_file() else []
    if _cells(table(rows).decode())[: len(before)] != before:
        raise InputError(f"{folder}: holds an export of other events (see {path.name}); choose another folder")
    return len(before)


def table(rows: list[Row]) -> bytes:
    """The events as CSV."""
    lines = [rows[0], *(map(escaped, row.values()) for row in rows)]
    return "".join(f"{csv_line(line)}\n" for line in lines).encode()


def _cells(text: str) -> list[list[str]]:
    """What the cells of a table say, without its heading."""
    return [[unescaped(cell) for cell in line] for line in csv_lines(text)][1:]
