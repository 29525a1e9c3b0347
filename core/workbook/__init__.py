"""The users' geometry workbook (.xlsx): the pinholes' coordinates and their dimensions.

book.py          the file: opened, refused, its cells as Python values
references.py    B3, Main!$B$3:$B$82, A:C in formulas
tables.py        Table1[v], Table1[[#This Row],[x]] in formulas
formulas.py      values of formulas
quantities.py    what the columns are: quantities, their headings and units
sheet_seen.py    a sheet's headings, and the columns and rows under them
doubts.py        what around a table may make its numbers mean something else
recognition.py   which cells hold which quantity, by the headings
column_map.py    `ColumnMap`: what a person says of that instead
layout.py        which cell holds a quantity of a module, either way
draft.py         a column map for a person to check, and a preview of the cells
checks.py        the sheet's own derived numbers against the formulas, and what scanners are like
reader.py        `read_system`, which joins these
source.py        `SystemSource`, where each number came from

writer.py        `write_system`: the system's numbers into a copy of a workbook
edit.py          the system's numbers put into the cells
rows.py          rows that move, are emptied or are added with the modules
recalculate.py   new values for formulas that depend on changed cells
workbook_xml.py  a workbook file as cells that can be changed
sheet_xml.py     a worksheet as cells that can be changed
xml_parts.py     XML that is changed in a few places
package.py       the zip archive's members
new_workbook.py  a workbook in the users' layout
"""

from __future__ import annotations

from ..system_source import QuantityCells, SystemSource
from .column_map import ColumnMap, MappedColumn, MappedTable
from .draft import ColumnMapDraft, draft_column_map, preview_workbook
from .reader import read_system
from .writer import WrittenWorkbook, write_system

__all__ = [
    "ColumnMap",
    "ColumnMapDraft",
    "MappedColumn",
    "MappedTable",
    "QuantityCells",
    "SystemSource",
    "WrittenWorkbook",
    "draft_column_map",
    "preview_workbook",
    "read_system",
    "write_system",
]
