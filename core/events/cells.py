"""CSV tables: their lines, and texts in cells, none that a spreadsheet would run as a formula."""

import csv
import io
import re
from collections.abc import Iterable, Iterator
from typing import Any

_FORMULA = re.compile(r"'*[=+\-@\t\r]")


def escaped(value: Any) -> Any:
    """`value` as a cell: a text that a spreadsheet would run begins with ' there; numbers stay as they are."""
    return f"'{value}" if isinstance(value, str) and _FORMULA.match(value) else value


def unescaped(text: str) -> str:
    """What a cell of `escaped` says."""
    return text[1:] if text.startswith("'") and _FORMULA.match(text) else text


def csv_line(cells: Iterable[Any]) -> str:
    """A line of a table, without its end."""
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow(cells)
    return text.getvalue()


def csv_lines(text: str) -> Iterator[list[str]]:
    """The cells of each line of a table."""
    return csv.reader(io.StringIO(text, newline=""))
