"""Excel's tables, and references to their columns: Table1[v], Table1[[#This Row],[x]:[z]]."""

from __future__ import annotations

import re
from typing import NamedTuple

from .references import Reference, reference
from .xml_parts import Element

_REFERENCE = re.compile(r"([^\s\[\]!']+)(?:\[(.*)\])?", re.DOTALL)
_NAME = r"\[((?:[^\[\]']|'.)*)\]"
_SPECIFIER = re.compile(rf"\s*{_NAME}(?:\s*:\s*{_NAME})?\s*(?:,|$)", re.DOTALL)


class DataTable(NamedTuple):
    """A table on a sheet.

    Attributes
    ----------
    name : str
    area : Reference
        All of it, including its rows of headers and totals.
    columns : tuple of str
        Their names, case-folded.
    headers, totals : int
        The numbers of these rows.
    """

    name: str
    area: Reference
    columns: tuple[str, ...]
    headers: int
    totals: int

    def part(self, specifiers: str, row: int | None) -> Reference | None:
        """The area that the text in the outer brackets means in `row` of this sheet; None if it is not understood."""
        if specifiers.strip() and not specifiers.lstrip().startswith("["):
            specifiers = f"[{specifiers}]"
        if _SPECIFIER.sub("", specifiers).strip():
            return None
        found = [
            [_plain(name) for name in match.groups() if name is not None] for match in _SPECIFIER.finditer(specifiers)
        ]
        sheet, top, left, bottom, right = self.area
        rows = {
            "#all": (top, bottom),
            "#data": (top + self.headers, bottom - self.totals),
            "#headers": (top, top + self.headers - 1),
            "#totals": (bottom - self.totals + 1, bottom),
        }
        if row is not None and rows["#data"][0] <= row <= rows["#data"][1]:
            rows["#this row"] = row, row
        items = [names[0] for names in found if names[0].startswith("#")] or ["#data"]
        columns = [name for names in found if not names[0].startswith("#") for name in names]
        if not set(items) <= set(rows) or not set(columns) <= set(self.columns):
            return None
        first, last = min(rows[item][0] for item in items), max(rows[item][1] for item in items)
        places = sorted(left + self.columns.index(name) for name in columns) or [left, right]
        return Reference(sheet, first, places[0], last, places[-1]) if first <= last else None


def data_table(parts: list[Element], sheet: str) -> DataTable | None:
    """The table that a table's part describes on `sheet`, None if it does not say where."""
    root = parts[0].attributes
    area = reference(root.get("ref", ""))
    if area is None:
        return None
    columns = tuple(e.attributes.get("name", "").casefold() for e in parts if e.name == "tableColumn")
    headers, totals = int(root.get("headerRowCount", 1)), int(root.get("totalsRowCount", 0))
    return DataTable(root.get("displayName", ""), area._replace(sheet=sheet), columns, headers, totals)


def table_area(text: str, tables: list[DataTable], sheet: str, row: int) -> Reference | None:
    """The area that a reference to a table means in a formula in `row` of `sheet`; None for anything else."""
    match = _REFERENCE.fullmatch(text)
    table = next((t for t in tables if match is not None and t.name.casefold() == match[1].casefold()), None)
    if match is None or table is None:
        return None
    return table.part(match[2] or "", row if table.area.sheet == sheet else None)


def _plain(name: str) -> str:
    return re.sub("'(.)", r"\1", name).strip().casefold()
