"""The index of an event set: a table (CSV) with a row for each event that was made, drawn from the recipe.

It only says sooner what the recipe says: rows that are missing, such as those of work that was killed, are drawn when asked
for. So works that write it at once need not wait for each other; the last one that ends finds what is missing.
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
"""In a row that was cut when a work was killed: what is written next puts it there."""


class Index:
    """The rows by event, lines as they are in the file: what they say is read when it is asked for."""

    def __init__(self, path: Path, recipe: EventRecipe) -> None:
        self.path, self._recipe = path, recipe

    @cached_property
    def columns(self) -> list[str]:
        """The same for all events of the recipe."""
        entries = self._recipe.phantoms
        files = ["file"] if any(entry["file"] is not None for entry in entries) else []
        return [*FIXED_COLUMNS, *files, *dict.fromkeys(f"phantom.{key}" for entry in entries for key in entry.settings)]

    def read(self) -> dict[int, str]:
        """The rows that are there, each a line as it is in the file; what is no row is left out."""
        try:
            # What no line end follows was cut; of a table that another work begins just now nothing may be there.
            heading, *lines = _lines(self.path.read_bytes().decode())[:-1] or [""]
        except FileNotFoundError:
            return {}
        except (OSError, UnicodeError) as error:
            remedy = f"mphdrr events check {self.path.parent} --repair writes it anew"
            raise InputError(f"{self.path}: cannot be read ({error}): {remedy}") from None
        if _CUT in heading:
            return {}
        names = _cells(heading)
        found = {int(first): line for line in lines if (first := line.partition(",")[0]).isdigit() and _CUT not in line}
        if names != self.columns:  # of an earlier version: the columns of what was drawn
            rows = {n: dict(zip(names, _cells(line), strict=False)) for n, line in found.items()}
            found = {n: csv_line([row.get(name, "") for name in self.columns]) for n, row in rows.items()}
        return found

    def is_current(self) -> bool:
        """Whether rows can be added to the file: its columns are these, or it is not there."""
        return not self.path.is_file() or self.path.read_bytes().startswith(self.text({}))

    def line(self, number: int) -> str:
        """The row of an event, as the recipe says."""
        row = plan(self._recipe, number).row()
        values = (row.get(name, "") for name in self.columns)
        return csv_line([escaped(value) if isinstance(value, str) else json.dumps(value) for value in values])

    def values(self, line: str) -> dict[str, Any]:
        """What a row says, by column; None where it is empty."""
        return {name: _value(name, text) for name, text in zip(self.columns, _cells(line), strict=True)}

    def text(self, lines: Mapping[int, str]) -> bytes:
        """The file with these rows, in order."""
        return "".join(f"{line}\n" for line in (csv_line(self.columns), *(lines[n] for n in sorted(lines)))).encode()

    def add(self, number: int) -> None:
        """Add the row of an event that was made, at the end of the file."""
        row = f"{self.line(number)}\n".encode()
        with refusing(self.path, "cannot be written"), open(self.path, "ab+") as file:
            if end := file.tell():
                file.seek(end - 1)
                before = b"" if file.read(1) == b"\n" else f"{_CUT}\n".encode()
            else:
                before = self.text({})
            file.write(before + row)

    def complete(self, made: Callable[[], Collection[int]], asked: Collection[int], anew: bool = False) -> None:
        """Have a row for each event that is made, in order; again until nobody adds others meanwhile.

        Rows of other events are kept where they were asked for. `anew`: all rows are drawn, whatever is there.
        """
        while True:
            there = {} if anew else self.read()
            wanted = {number for number in (*there, *made()) if number in asked}
            content = self.text({number: there.get(number) or self.line(number) for number in wanted})
            if self.path.is_file() and self.path.read_bytes() == content:
                return
            write_bytes(self.path, content)


def _lines(text: str) -> list[str]:
    """The rows of a table: lines, but for line ends within quotes; the last one is what no line end follows."""
    found = [""]
    for line in text.split("\n"):
        if found[-1].count('"') % 2:
            found[-1] += f"\n{line}"
        else:
            found.append(line)
    return found[1:]


def column(line: str, place: int) -> str:
    """One of the first cells of a row."""
    cells = line.split(",", place + 1)
    return unescaped(_cells(line)[place] if '"' in "".join(cells[: place + 1]) else cells[place])


def _cells(line: str) -> list[str]:
    return next(csv_lines(line), [])


def _value(name: str, text: str) -> Any:
    """What a cell holds."""
    if not text:
        return None
    if name in _TEXTS:
        return unescaped(text)
    try:
        return json.loads(text)
    except ValueError:
        return unescaped(text)
