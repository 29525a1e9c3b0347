"""Excel's tables, and what references to their columns mean: Table1[v], Table1[[#This Row],[x]:[z]]."""

from __future__ import annotations

import re
from typing import NamedTuple

from .references import Reference, reference
from .xml_parts import Element

_REFERENCE = re.compile(r"([^\s\[\]!']+)(?:\[(.*)\])?", re.DOTALL)
_BRACKETS = r"\[((?:[^\[\]']|'.)*)\]"
_SPECIFIER = re.compile(rf"\s*{_BRACKETS}(?:\s*:\s*{_BRACKETS})?\s*(?:,|$)", re.DOTALL)


class DataTable(NamedTuple):
    """A table on a sheet.

    Attributes
    ----------
    name, sheet : str
    area : Reference
        All of it in the workbook, with its rows of headers and totals.
    columns : tuple of str
        Their names, case folded.
    headers, totals : int
        How many rows of these there are.
    """

    name: str
    sheet: str
    area: Reference
    columns: tuple[str, ...]
    headers: int
    totals: int

    def part(self, specifiers: str, row: int | None) -> Reference | None:
        """The area that the text in the outer brackets means in `row` of this sheet; None where it means none."""
        found = _split(specifiers)
        if found is None:
            return None
        sheet, top, left, bottom, right = self.area
        rows = {
            "#all": (top, bottom),
            "#data": (top + self.headers, bottom - self.totals),
            "#headers": (top, top + self.headers - 1),
            "#totals": (bottom - self.totals + 1, bottom),
        }
        if row is not None and rows["#data"][0] <= row <= rows["#data"][1]:
            rows["#this row"] = row, row
        items = [first for first, _ in found if first.startswith("#")] or ["#data"]
        columns = [name for pair in found if not pair[0].startswith("#") for name in pair]
        if not set(items) <= set(rows) or not set(columns) <= set(self.columns):
            return None
        first, last = min(rows[item][0] for item in items), max(rows[item][1] for item in items)
        places = sorted(left + self.columns.index(name) for name in columns) or [left, right]
        return Reference(sheet, first, places[0], last, places[-1]) if first <= last else None


def data_table(parts: list[Element], sheet: str) -> DataTable | None:
    """The table of a table's part on `sheet`, None if it does not say where."""
    root = parts[0].attributes
    area = reference(root.get("ref", ""))
    if area is None:
        return None
    columns = tuple(e.attributes.get("name", "").casefold() for e in parts if e.name == "tableColumn")
    headers, totals = int(root.get("headerRowCount", 1)), int(root.get("totalsRowCount", 0))
    return DataTable(root.get("displayName", ""), sheet, area._replace(sheet=sheet), columns, headers, totals)


def named_part(text: str) -> tuple[str, str] | None:
    """The table's name, case folded, and the text in the outer brackets of a reference; None for anything else."""
    match = _REFERENCE.fullmatch(text)
    return None if match is None else (match[1].casefold(), match[2] or "")


def _split(specifiers: str) -> list[tuple[str, str]] | None:
    """(first, last) of each, the same where it is one alone."""
    if not specifiers.strip():
        return []
    if not specifiers.lstrip().startswith("["):
        specifiers = f"[{specifiers}]"
    found, at = [], 0
    while at < len(specifiers):
        match = _SPECIFIER.match(specifiers, at)
        if match is None:
            return None
        first, last = match[1], match[1] if match[2] is None else match[2]
        found.append((_plain(first), _plain(last)))
        at = match.end()
    return found


def _plain(name: str) -> str:
    return re.sub("'(.)", r"\1", name).strip().casefold()
