"""The users' geometry workbook (.xlsx): the pinholes' coordinates and their dimensions, and scanners of other kinds.

Which columns there are is declared in `core.geometry`: `pinhole_columns`, and the table of another kind.

Both ways:   book, sheet_xml, workbook_xml and package (the file), calculation and formulas (the values of its formulas),
             agreement (when a cell's value is right)
Reading:     headings, headed_table and recognition (what a workbook's headings say, and doubts), column_map and draft (what
             a person says), layout (which cells hold which column), reader
Writing:     writer, edit (the cells that change, and the rows that move with the modules)
"""

from ..system_source import QuantityCells, SystemSource
from .column_map import ColumnMap, MappedColumn, MappedTable
from .draft import ColumnMapDraft, draft_column_map, preview_workbook
from .reader import kinds_in, read_scanner, read_system
from .writer import WrittenWorkbook, write_system
