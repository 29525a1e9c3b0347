"""Index of an event set: a table (CSV) with a row for each event that was made, drawn from the recipe.

The index only saves time, since the recipe determines its rows: a missing row, such as that of a killed process, is drawn on
access. So processes that add rows at the same time need not wait for each other; the last one completes the table.
"""

import json
from collections.abc import Callable, Collection, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

from ..errors import InputError, refusing
from ..files import write_bytes
from .cells import csv_line, csv_lines, escaped, unescaped
from .planning import FIXED_COLUMNS, plan
from .recipe import EventRecipe

_TEXTS = ("phantom", "split", "file")
_CUT = "\0"
"""Mark of a row that was cut when a process was killed; the next process that adds a row appends it."""


class Index:
    """Index of an event set: one line of CSV per event, parsed only on access."""

    def __init__(self, path: Path, recipe: EventRecipe) -> None:
        self.path, self._recipe = path, recipe

    @cached_property
    def columns(self) -> list[str]:
        """The columns of the table, which are the same for all events of the recipe."""
        entries = self._recipe.phantoms
        files = ["file"] if any(entry["file"] is not None for entry in entries) else []
        return [*FIXED_COLUMNS, *files, *dict.fromkeys(f"phantom.{key}" for entry in entries for key in entry.settings)]

    def read(self) -> dict[int, str]:
        """Read the lines of the file by event number, unparsed; cut lines and others that are no rows are left out."""
        try:
            # A last line without a line end was cut; a file that another process begins just now may be empty.
            heading, *lines = _split_lines(self.path.read_bytes().decode())[:-1] or [""]
        except FileNotFoundError:
            return {}
        except (OSError, UnicodeError) as error:
            remedy = f"mphdrr events check {self.path.parent} --repair writes it again"
            raise InputError(f"{self.path}: cannot be read ({error}): {remedy}") from None
        if _CUT in heading:
            return {}
        names = _split_cells(heading)
        rows = {int(cell): line for line in lines if (cell := line.partition(",")[0]).isdigit() and _CUT not in line}
        if names != self.columns:  # earlier versions had other columns
            cells = {n: dict(zip(names, _split_cells(line), strict=False)) for n, line in rows.items()}
            rows = {n: csv_line([row.get(name, "") for name in self.columns]) for n, row in cells.items()}
        return rows

    def is_current(self) -> bool:
        """Return whether rows can be added to the file: it does not exist, or has the present columns."""
        return not self.path.is_file() or self.path.read_bytes().startswith(self.content({}))

    def line(self, number: int) -> str:
        """Draw an event from the recipe and return its line of the table."""
        row = plan(self._recipe, number).row()
        values = (row.get(name, "") for name in self.columns)
        return csv_line([escaped(value) if isinstance(value, str) else json.dumps(value) for value in values])

    def values(self, line: str) -> dict[str, Any]:
        """Return the values of a line by column; None for an empty cell."""
        return {name: _parse_cell(name, text) for name, text in zip(self.columns, _split_cells(line), strict=True)}

    def content(self, lines: Mapping[int, str]) -> bytes:
        """Return the content of a file with these lines: first the columns' names, then the events by number."""
        return "".join(f"{line}\n" for line in (csv_line(self.columns), *(lines[n] for n in sorted(lines)))).encode()

    def add(self, number: int) -> None:
        """Append the row of an event that was made to the file."""
        row = f"{self.line(number)}\n".encode()
        with refusing(self.path, "cannot be written"), open(self.path, "ab+") as file:
            if end := file.tell():
                file.seek(end - 1)
                prefix = b"" if file.read(1) == b"\n" else f"{_CUT}\n".encode()
            else:
                prefix = self.content({})
            file.write(prefix + row)

    def complete(self, stored: Callable[[], Collection[int]], requested: Collection[int], redraw: bool = False) -> None:
        """Write a file with a row for each requested event that is stored or has a row, in order of the event numbers.

        Repeat this until no other process has added rows meanwhile. `redraw`: ignore the present rows and draw all.
        """
        while True:
            lines = {} if redraw else self.read()
            numbers = {number for number in (*lines, *stored()) if number in requested}
            content = self.content({number: lines.get(number) or self.line(number) for number in numbers})
            if self.path.is_file() and self.path.read_bytes() == content:
                return
            write_bytes(self.path, content)


def _split_lines(text: str) -> list[str]:
    """Split a CSV text at line ends outside quotes; the last item is the text after the last line end."""
    rows = [""]
    for line in text.split("\n"):
        if rows[-1].count('"') % 2:
            rows[-1] += f"\n{line}"
        else:
            rows.append(line)
    return rows[1:]


def column(line: str, position: int) -> str:
    """Return the cell at a position of a line, which is quick for the first cells."""
    cells = line.split(",", position + 1)
    return unescaped(_split_cells(line)[position] if '"' in "".join(cells[: position + 1]) else cells[position])


def _split_cells(line: str) -> list[str]:
    """Return the cells of a line."""
    return next(csv_lines(line), [])


def _parse_cell(name: str, text: str) -> Any:
    """Return the value of a cell in the column `name`: None, a text, or the value of its JSON."""
    if not text:
        return None
    if name in _TEXTS:
        return unescaped(text)
    try:
        return json.loads(text)
    except ValueError:
        return unescaped(text)
