"""The users' geometry workbook (.xlsx): the pinholes' coordinates and their dimensions.

quantities.py    what the columns are: one table of quantities, their headings, units and formulas
headings.py      what a heading says
book.py          the file, and the values of its cells
headed_table.py  the columns and rows under a sheet's headings
doubts.py        notes and columns that may give a table another meaning
recognition.py   which cells hold which quantity, by the headings
column_map.py    `ColumnMap`, which says it instead
layout.py        which cell holds which quantity of which module, either way
draft.py         a draft of a column map, and a preview of the cells
plausibility.py  whether the numbers are possible and agree with the formulas
reader.py        `read_system`

writer.py        `write_system`
new_workbook.py  a workbook in the users' layout
edit.py          a system's numbers put into the cells
rows.py          rows that move, are emptied or are added with the modules
recalculate.py   new values for the formulas that depend on changed cells

calculation.py   the values of formulas that refer to each other
formulas.py      the value of one formula
references.py    B3, Main!$B$3:$B$82 and A:C in formulas
cells.py         what a cell may hold, and how messages describe it
workbook_xml.py  the sheets of a workbook file
sheet_xml.py     the cells of a sheet; only the bytes of changed ones are replaced
xml_parts.py     XML that is changed in a few places
package.py       the zip archive
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
