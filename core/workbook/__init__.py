"""The users' geometry workbook (.xlsx): the pinholes' coordinates and their dimensions.

Both ways:   quantities (the table of the columns), book, sheet_xml, workbook_xml and package (the file),
             calculation and formulas (the values of its formulas)
Reading:     headings, headed_table and recognition (what a workbook's headings say, and doubts), column_map and draft (what
             a person says), layout (which cells hold which quantity), reader
Writing:     writer, edit (the cells that change, and the rows that move with the modules)
"""

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
