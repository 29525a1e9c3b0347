"""The users' geometry workbook (.xlsx): the pinholes' coordinates and their dimensions.

quantities.py    the table of what the columns may hold: headings, units, formulas
headings.py      what texts say: headings, units in notes, number formats
book.py          the file, and the values of its cells
headed_table.py  a table as a sheet's headings describe it
doubts.py        what in a table or around it may give its numbers another meaning
recognition.py   which cells hold which quantity, by the headings
column_map.py    `ColumnMap`: the same, said by a person
layout.py        which cells hold which quantity of which module, either way
reader.py        `read_system`, from the layout to the numbers to the system
plausibility.py  whether the numbers are possible, plausible, and agree with the formulas
draft.py         a column map for a person to check, and a preview of the cells

writer.py        `write_system`
new_workbook.py  a workbook in the users' layout
edit.py          a system's numbers put into the cells
rows.py          rows that move, are emptied or are added with the modules
recalculate.py   new values for the formulas that depend on changed cells

calculation.py   the values of formulas that refer to each other
formulas.py      the value of one formula
references.py    B3, Main!$B$3:$B$82 and A:C in formulas
cells.py         what a cell may hold besides a number, and how messages describe it
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
