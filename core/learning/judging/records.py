"""Records of the judge's work: every event's scores, in files that are complete at any time."""

import json
from pathlib import Path
from typing import Any

from ...errors import reading
from ...files import read_text, write_bytes

Key = tuple[str, int, float, int]
"""Fingerprint of the event's recipe, number of the event, level, and noise draw; -1 for several draws."""
_KEY = ("recipe", "event", "level", "draw")


class Records:
    """Scores of one method in one test: a line of JSON for each event, level and draw."""

    def __init__(self, path: Path) -> None:
        self.path, self._rows = path, dict[Key, dict[str, Any]]()
        if path.exists():
            with reading(path, "scores"):
                for line in read_text(path).splitlines():
                    row = json.loads(line)
                    self._rows[tuple(row[name] for name in _KEY)] = row  # type: ignore[index]

    def __contains__(self, key: Key) -> bool:
        return key in self._rows

    def __getitem__(self, key: Key) -> dict[str, Any]:
        return self._rows[key]

    def add(self, key: Key, scores: dict[str, Any]) -> None:
        """Add scores; on return they are on the disk."""
        self._rows[key] = {**dict(zip(_KEY, key, strict=True)), **scores}
        write_bytes(self.path, "".join(f"{json.dumps(row)}\n" for row in self._rows.values()).encode())


def read_json(path: Path) -> dict[str, Any]:
    """Return the content of a JSON file, or an empty dictionary if there is no file."""
    if not path.exists():
        return {}
    with reading(path, "JSON"):
        return json.loads(read_text(path))


def write_json(path: Path, values: Any) -> None:
    """Write JSON values to a file."""
    write_bytes(path, (json.dumps(values, indent=1) + "\n").encode())
