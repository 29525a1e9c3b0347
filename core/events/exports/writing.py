"""Writing of exports into a folder: every file whole or not at all, so that an interrupted export can be continued.

``export.json`` holds the request, ``events.csv`` the event of each running number. In a folder with the same export, present
files stay and those of further events are added. Any other folder that is not empty is refused.
"""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import InputError
from ...files import ensure_folder, final_name, is_leftover, refuse_links, write_bytes
from ...memory import readable_size
from ...progress import Progress, tell
from ..cells import csv_line, csv_lines, escaped, unescaped
from ..noise_choice import chosen_seed
from .layout import ExportLayout, ExportPart, Row

REQUEST, TABLE = "export.json", "events.csv"
_FORMAT = "mphDRR export"


@dataclass(frozen=True)
class ExportPlan:
    """Plan of an export that is to be written."""

    layout: ExportLayout
    """Layout of the program's files."""
    folder: Path
    """Folder of the export."""
    rows: list[Row]
    """Rows of events.csv, one for each event."""
    parts: list[ExportPart]
    """All parts of the export."""
    missing: list[ExportPart]
    """Parts that are not written yet."""
    changed: list[Path]
    """Files of an earlier export of fewer events that must be written again with more events."""
    request: dict[str, Any]
    """Content of export.json: program, recipes, models, noise and options of the export."""

    @property
    def events(self) -> int:
        """The number of events that are to be written."""
        return sum(len(part.events) for part in self.missing)

    @property
    def size(self) -> int:
        """The bytes that are to be written; an upper limit for compressed files."""
        return self.events * self.layout.event_bytes

    def summary(self) -> str:
        """Return one line on how many events, and how much data, are to be written."""
        n_written = len(self.rows) - self.events
        limit = "at most " if self.layout.compressed else ""
        note = f", {n_written} are there already" if n_written else ""
        event_size, size = readable_size(self.layout.event_bytes), readable_size(self.size)
        return f"{self.events} events of {limit}{event_size}, {size} in all{note}"

    def write(self, progress: Progress | None = None) -> None:
        """Write the missing parts and the tables; `progress` is called as ``progress(done, total)`` after each event."""
        self._require_room()
        for name in {str(Path(file).parent) for part in self.missing for file in part.files}:
            if name != ".":
                refuse_links(self.folder / name)
                ensure_folder(self.folder / name)
        self._remove_leftovers()
        for path in self.changed:
            path.unlink(missing_ok=True)
        # The request is written first: it identifies an unfinished export.
        write_bytes(self.folder / REQUEST, json.dumps(self.request, indent=1).encode() + b"\n")
        for name, content in {TABLE: events_table(self.rows), **self.layout.tables(self.rows)}.items():
            write_bytes(self.folder / name, content)
        n_written = len(self.rows) - self.events

        def report_event() -> None:
            """Report one further written event."""
            nonlocal n_written
            n_written += 1
            tell(progress, n_written, len(self.rows))

        for part in self.missing:
            self.layout.write(part, self.rows, self.folder, report_event)

    def _remove_leftovers(self) -> None:
        """Remove incomplete files of a killed export, which programs that read whole folders would find."""
        export_files = {self.folder / file for part in self.parts for file in part.files}
        for path in (*self.folder.glob(".*"), *self.folder.glob("*/.*")):
            name = final_name(path.name)
            if name and is_leftover(path) and (path.with_name(name) in export_files or path.parent == self.folder):
                path.unlink(missing_ok=True)

    def _require_room(self) -> None:
        """Raise `InputError` where uncompressed files exceed the free space of the disk."""
        free = shutil.disk_usage(self.folder).free
        if not self.layout.compressed and self.size > free:
            needed = f"the export needs {readable_size(self.size)}, but the disk has {readable_size(free)} left"
            raise InputError(f"{self.folder}: {needed}; choose another folder, or one split of the set")


def make_plan(layout: ExportLayout, folder: Path, program: str, options: dict[str, Any]) -> ExportPlan:
    """Make `folder` and return the plan of an export into it; `InputError` where it holds anything but the same export."""
    rows = [
        {
            "i": i,
            "event": row["event"],
            "split": row["split"] or "all",
            "name": row["phantom"],
            "mirror": int(row["mirror"]),
            "size": row["size"],
            "noise_seed": "" if (seed := chosen_seed(row["noise_seed"], layout.selection.noise)) is None else seed,
        }
        for i, row in enumerate(layout.selection.events.index)
    ]
    request = {
        "format": _FORMAT,
        "version": 1,
        "program": program,
        "recipes": list(dict.fromkeys(event.recipe.fingerprint for event in layout.selection.events)),
        "models": list(layout.selection.models),
        "noise": layout.selection.noise,
        "level": layout.selection.level,
        "options": options,
    }
    folder = ensure_folder(folder)
    n_earlier = _count_earlier_events(folder, request, rows)
    parts, old = layout.parts(rows), set(layout.parts(rows[:n_earlier]))
    missing = [part for part in parts if part not in old or not all((folder / file).is_file() for file in part.files)]
    changed = [folder / file for part in old.difference(parts) for file in part.files]
    return ExportPlan(layout, folder, rows, parts, missing, changed, request)


def _count_earlier_events(folder: Path, request: dict[str, Any], rows: list[Row]) -> int:
    """Return the number of events of the same export that the folder holds; `InputError` where it holds anything else."""
    if all(final_name(path.name) for path in folder.iterdir()):
        return 0
    try:
        earlier_request = json.loads((folder / REQUEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        earlier_request = {}
    if not isinstance(earlier_request, dict) or earlier_request.get("format") != _FORMAT:
        raise InputError(f"{folder}: expected a new or empty folder, or one with an export to continue")
    if changed := [name for name in request if earlier_request.get(name) != request[name]]:
        raise InputError(f"{folder}: holds an export that differs in {', '.join(changed)}; choose another folder")
    path = folder / TABLE
    earlier_rows = _table_cells(path.read_text(encoding="utf-8")) if path.is_file() else []
    if _table_cells(events_table(rows).decode())[: len(earlier_rows)] != earlier_rows:
        raise InputError(f"{folder}: holds an export of other events (see {path.name}); choose another folder")
    return len(earlier_rows)


def events_table(rows: list[Row]) -> bytes:
    """Return the rows of the events as a CSV file."""
    lines = [rows[0], *(map(escaped, row.values()) for row in rows)]
    return "".join(f"{csv_line(line)}\n" for line in lines).encode()


def _table_cells(text: str) -> list[list[str]]:
    """Return the cells of a CSV table, without its heading."""
    return [[unescaped(cell) for cell in line] for line in csv_lines(text)][1:]
