"""Lines and cells of CSV tables, whose texts no spreadsheet runs as formulas."""

import csv
import io
import re
from collections.abc import Iterable, Iterator
from typing import Any

_FORMULA = re.compile(r"'*[=+\-@\t\r]")


def escaped(value: Any) -> Any:
    """Return `value` for a cell: with a leading apostrophe if it is a text that a spreadsheet would run as a formula."""
    return f"'{value}" if isinstance(value, str) and _FORMULA.match(value) else value


def unescaped(text: str) -> str:
    """Return the text of a cell that `escaped` made, without the apostrophe it added."""
    return text[1:] if text.startswith("'") and _FORMULA.match(text) else text


def csv_line(cells: Iterable[Any]) -> str:
    """Return the CSV line of these cells, without a line end."""
    text = io.StringIO()
    csv.writer(text, lineterminator="").writerow(cells)
    return text.getvalue()


def csv_lines(text: str) -> Iterator[list[str]]:
    """Return an iterator over the lines of a CSV table, each a list of its cells."""
    return csv.reader(io.StringIO(text, newline=""))
