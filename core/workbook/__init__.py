"""Reader and writer of the users' geometry workbook (.xlsx): pinholes, and scanners of other kinds.

Begin with `read_system` and `write_system`, or `draft_column_map` for a workbook whose headings are not understood. The
columns are declared in `core.geometry.pinhole_columns`, or in the table of another kind of scanner.

- The file: `package` (zip and XML), `sheet_xml` and `workbook_xml` (cells, written back without touching other bytes),
  `formulas` and `calculation` (values of formulas), `book` (all this as sheets with values), `agreement` (equal values).
- Reading: `headings`, `headed_table` and `recognition` (meaning of the headings, and doubts about it), `column_map` and
  `draft` (meaning given by a person), `layout` (cells of each column), `reader`.
- Writing: `writer`, `edit` (changed cells, and rows that move with the modules), `new_workbook`.

To add a column, add a row to the table of `core.geometry.pinhole_columns`: nothing here. A function for formulas is a
line of a table in `formulas`, a word for a unit one in `headings`; the styles of a new workbook are in new_workbook.txt.
"""

from ..system_source import QuantityCells, SystemSource
from .column_map import ColumnMap, MappedColumn, MappedTable
from .draft import ColumnMapDraft, draft_column_map, preview_workbook
from .reader import kinds_in, read_scanner, read_system
from .writer import WrittenWorkbook, write_system
