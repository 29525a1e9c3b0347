"""Texts in cells of CSV tables: none that a spreadsheet would run as a formula."""

import re
from typing import Any

_FORMULA = re.compile(r"'*[=+\-@\t\r]")


def escaped(value: Any) -> Any:
    """`value` as a cell: a text that a spreadsheet would run begins with ' there; numbers stay as they are."""
    return f"'{value}" if isinstance(value, str) and _FORMULA.match(value) else value


def unescaped(text: str) -> str:
    """What a cell of `escaped` says."""
    return text[1:] if text.startswith("'") and _FORMULA.match(text) else text
