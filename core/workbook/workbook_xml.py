"""Worksheets of a workbook file as cells that can be changed, and the bytes of the file with the changes."""

import itertools
import re
from functools import cached_property

from ..errors import InputError
from .formulas import referenced_areas, references_and_names
from .package import CONTENT_TYPES, Package, relations_part, set_attribute, splice
from .sheet_xml import MAIN, STRICT, Cell, Position, Reference, SheetXml, cell_name, parse_reference, shared_strings

CONTENT_TYPE_OF_SUFFIX = {
    ".xlsx": "application/vnd.openxmlformats-officedocument.spreadsheetml.sheet.main+xml",
    ".xlsm": "application/vnd.ms-excel.sheet.macroEnabled.main+xml",
}
_BEFORE_CALC_PR = (
    *("fileVersion", "fileSharing", "workbookPr", "workbookProtection", "bookViews", "sheets", "functionGroups"),
    *("externalReferences", "definedNames"),
)
"""Elements that the schema of a workbook part puts before "calcPr"."""
_RELATIONS = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
_WORKSHEET = "application/vnd.openxmlformats-officedocument.spreadsheetml.worksheet+xml"
Address = tuple[str, int, int]
"""Sheet, row and column of a cell, the latter two counted from 1."""


class WorkbookXml:
    """Worksheets of a workbook file, parsed when they are needed; `name` is the file's name in messages."""

    def __init__(self, content: bytes, name: str) -> None:
        self.name = name
        self.package = Package(content, name)
        documents = [member for _, kind, member in self.package.relations("") if kind == "officeDocument"]
        if not documents:
            raise InputError(f"{name}: not a whole .xlsx workbook (it does not say where its sheets are)")
        self._part = documents[0]
        elements = self.package.elements(self._part)
        if elements[0].namespace == STRICT:
            raise InputError(f"{name}: a 'Strict Open XML Spreadsheet', expected it saved as 'Excel Workbook (*.xlsx)'")
        self._elements = [e for e in elements if e.namespace == MAIN]
        relations = self.package.relations(self._part)
        self._related = {kind: member for _, kind, member in reversed(relations)}
        self.all_sheets: list[str] = []
        """Names of all sheets in the workbook's order, sheets of charts included."""
        self.hidden: set[str] = set()
        """Names of the sheets that are not shown."""
        self.parts: dict[str, str] = {}
        """Name of each worksheet, in the workbook's order -> its member of the package."""
        self._parsed: dict[str, SheetXml] = {}
        worksheets = {key: member for key, kind, member in relations if kind == "worksheet"}
        for e in self._elements:
            if e.name != "sheet":
                continue
            title = e.attributes.get("name", "")
            if title.casefold() in map(str.casefold, self.all_sheets):
                problem = f"has two sheets called {title}, expected one"
                raise InputError(f"{name}: {problem}; Excel or LibreOffice may repair it")
            self.all_sheets.append(title)
            if e.attributes.get("state", "visible") != "visible":
                self.hidden.add(title)
            key = next((value for attribute, value in e.attributes.items() if attribute.endswith(" id")), "")
            if key in worksheets:
                self.parts[title] = worksheets[key]
        self._title_of_folded = {title.casefold(): title for title in self.parts}
        self._extents: dict[tuple[str, int], Position] = {}

    def sheet(self, title: str) -> SheetXml:
        """Return a worksheet, parsed at the first call: users' workbooks have large sheets that are never needed."""
        if title not in self._parsed:
            self._parsed[title] = SheetXml(self.package.read(self.parts[title]), self._strings, title, self.name)
        return self._parsed[title]

    @cached_property
    def _strings(self) -> list[str]:
        """Shared strings, to which the cells of all sheets refer by index."""
        part = self._related.get("sharedStrings")
        return [] if part is None else shared_strings(self.package.elements(part))

    @property
    def suffix(self) -> str | None:
        """Ending that fits the file's content: ".xlsx", ".xlsm", or None for another kind of file."""
        content_type = self.package.content_type(self._part)
        return next((suffix for suffix, kind in CONTENT_TYPE_OF_SUFFIX.items() if kind == content_type), None)

    @cached_property
    def asks_for_calculation(self) -> bool:
        """Whether the file says that the formulas' stored values are not to be relied on.

        Raises `InputError` for a workbook that calculates with the displayed digits.
        """
        settings = [e.attributes for e in self._elements if e.name == "calcPr"]
        if any(a.get("fullPrecision") in ("0", "false") for a in settings):
            raise InputError('it calculates with displayed digits: switch off "Set precision as displayed", and save')
        is_asked = any(a.get(name) in ("1", "true") for a in settings for name in ("fullCalcOnLoad", "forceFullCalc"))
        return is_asked or any(a.get("calcCompleted") in ("0", "false") for a in settings)

    @cached_property
    def _number_formats(self) -> list[str]:
        """Number format of each style of cells, by the style's number."""
        from openpyxl.styles.numbers import BUILTIN_FORMATS

        elements = self.package.elements(self._related["styles"]) if "styles" in self._related else []
        declared = [e.attributes for e in elements if e.name == "numFmt"]
        custom_formats = {attributes.get("numFmtId"): attributes.get("formatCode", "") for attributes in declared}
        styles = [e for e in elements if e.name == "xf" and e.parent is not None and e.parent.name == "cellXfs"]
        ids = [e.attributes.get("numFmtId", "0") for e in styles]
        return [custom_formats[i] if i in custom_formats else BUILTIN_FORMATS.get(int(i), "") for i in ids]

    def number_format(self, cell: Cell) -> str:
        """Return the number format of a cell, such as ``0.00" mm"``."""
        style = int(cell.style or 0)
        return self._number_formats[style] if style < len(self._number_formats) else ""

    def comments(self, sheet: str) -> dict[Position, str]:
        """Return the comments on a sheet's cells: position -> text."""
        comments: dict[Position, str] = {}
        for member in self._related_members(sheet, "comments"):
            position = None
            for node in self.package.elements(member):
                if node.name == "comment" and (cell := parse_reference(node.attributes.get("ref", ""))) is not None:
                    position = cell.top, cell.left
                elif node.name == "t" and position is not None:
                    comments[position] = comments.get(position, "") + node.text
        return comments

    @cached_property
    def _names(self) -> dict[tuple[str | None, str], str]:
        """(sheet that the name is limited to, or None; case-folded defined name) -> formula."""
        names = {}
        for e in self._elements:
            if e.name == "definedName" and e.text.strip():
                scope = e.attributes.get("localSheetId", "")
                index = int(scope) if scope.isdigit() else -1
                sheet = self.all_sheets[index] if 0 <= index < len(self.all_sheets) else None
                names[sheet, e.attributes.get("name", "").casefold()] = f"={e.text.strip()}"
        return names

    @cached_property
    def tables(self) -> dict[str, Reference]:
        """Case-folded name of each Excel table -> its area."""
        areas = {}
        for title in self.parts:
            for member in self._related_members(title, "table"):
                attributes = self.package.elements(member)[0].attributes
                if (area := parse_reference(attributes.get("ref", ""))) is not None:
                    areas[attributes.get("displayName", "").casefold()] = area._replace(sheet=title)
        return areas

    def _related_members(self, sheet: str, kind: str) -> list[str]:
        """Return the members of the package that a worksheet refers to by a relationship of this kind."""
        return [member for _, relation, member in self.package.relations(self.parts[sheet]) if relation == kind]

    def find_title(self, name: str | None) -> str | None:
        """Return the name of a worksheet as the workbook writes it, for a name in any case; None without such a sheet."""
        return None if name is None else self._title_of_folded.get(name.casefold())

    def cell(self, address: Address) -> Cell:
        """Return the present content of a cell."""
        return self.sheet(address[0]).cell(address[1:])

    def set_cell(self, address: Address, cell: Cell) -> None:
        """Replace the content of a cell."""
        self.sheet(address[0]).cells[address[1:]] = cell

    @property
    def formulas(self) -> dict[Address, Cell]:
        """Cells of all sheets that have a formula or belong to an array formula."""
        return {
            (title, *position): cell
            for title in self.parts
            for position, cell in self.sheet(title).cells.items()
            if cell.formula is not None or cell.array is not None
        }

    @cached_property
    def was_never_calculated(self) -> bool:
        """Whether every formula stores 0 or nothing, as programs that cannot calculate, such as XlsxWriter, leave it."""
        return not any(cell.value or cell.value is False for cell in self.formulas.values())

    def defined_formula(self, sheet: str, name: str) -> str | None:
        """Return the formula that a defined name stands for on `sheet`; None if it is unknown or depends on the cell."""
        scope_text, _, plain_name = name.rpartition("!")
        scope, key = self.find_title(scope_text.strip("'")) if scope_text else sheet, plain_name.casefold()
        formula = self._names.get((scope, key)) or self._names.get((None, key))
        references = [text for text in references_and_names(formula or "") if parse_reference(text) is not None]
        # Main!$B$3 means the same cell everywhere, Main!B3 does not.
        cells = [text.rpartition("!")[2] for text in references]
        return formula if all(text.count("$") == len(re.findall(r"[A-Za-z]+|\d+", text)) for text in cells) else None

    def extent(self, sheet: str) -> Position:
        """Return the last row and the last column of `sheet` with content."""
        # The number of cells changes when rows are added; emptied cells only make the extent too large.
        key = sheet, len(self.sheet(sheet).cells)
        if key not in self._extents:
            filled = [position for position, cell in self.sheet(sheet).cells.items() if not cell.blank]
            rows, columns = {row for row, _ in filled}, {column for _, column in filled}
            self._extents[key] = max(rows, default=0), max(columns, default=0)
        return self._extents[key]

    def describe_ranges_ending_at(self, sheet: str, row: int) -> list[str]:
        """Return what refers to several rows of `sheet` of which `row` is the last: names, charts, tables, formulas."""

        def ends_there(area: Reference | None, host: str = "") -> bool:
            """Return whether an area ends at the row; `host` is the sheet of the formula, for an area without a sheet."""
            return area is not None and area.top < area.bottom == row and sheet == (self.find_title(area.sheet) or host)

        texts = [
            f"the name {name}"
            for (_, name), formula in self._names.items()
            if name != "_xlnm._filterdatabase" and any(map(ends_there, referenced_areas(formula)))
        ]
        for member in self.package.names:
            if member.startswith("xl/charts/") and member.endswith(".xml"):
                series = [parse_reference(e.text.strip()) for e in self.package.elements(member) if e.name == "f"]
                texts += [f"the chart {member}"] * any(map(ends_there, series))
        texts += [f"the table {name}" for name, area in self.tables.items() if ends_there(area)]
        return texts + [
            self.address_text(address)
            for address, cell in self.formulas.items()
            if any(ends_there(area, address[0]) for area in referenced_areas(cell.formula or ""))
        ]

    @staticmethod
    def address_text(address: Address) -> str:
        """Return the text of a cell's address, such as ``Coordinates!B3``."""
        return f"{address[0]}!{cell_name(address[1:])}"

    @property
    def changed_addresses(self) -> list[Address]:
        """Addresses of the cells that differ from the file."""
        return [(title, *position) for title, sheet in self._parsed.items() for position in sheet.changed_positions]

    def to_bytes(self) -> bytes:
        """Return the workbook with the changed cells; spreadsheet programs will recalculate it when they open it."""
        changed = {title: sheet for title, sheet in self._parsed.items() if sheet.changed_positions}
        if not changed:
            return self.package.content
        parts = {self.parts[title]: sheet.to_bytes() for title, sheet in changed.items()}
        parts[self._part] = self._part_with_calculation_on_load()
        is_chain_stale = "calcChain" in self._related and any(s.formulas_added_or_removed for s in changed.values())
        return self.package.replace_parts(parts, [self._related["calcChain"]] if is_chain_stale else [], self._part)

    def to_bytes_with_sheet(self, title: str, rows: str) -> bytes:
        """Return the workbook as it was read, with one more sheet behind the others; `rows` is the XML of its rows."""
        append, members = self.package.append_element, {name.casefold() for name in self.package.names}
        number = next(n for n in itertools.count(1) if f"xl/worksheets/sheet{n}.xml" not in members)
        part, key, kind = f"xl/worksheets/sheet{number}.xml", f"rIdSheet{number}", f"{_RELATIONS}/worksheet"
        ids = [int(e.attributes.get("sheetId", "0")) for e in self._elements if e.name == "sheet"]
        attributes = {"name": title, "sheetId": str(max(ids, default=0) + 1), "xmlns_r": _RELATIONS, "r_id": key}
        relations = relations_part(self._part)
        parts = {
            self._part: append(self._part, "sheets", "sheet", **attributes),
            relations: append(relations, "Relationships", "Relationship", Id=key, Type=kind, Target=f"/{part}"),
            CONTENT_TYPES: append(CONTENT_TYPES, "Types", "Override", PartName=f"/{part}", ContentType=_WORKSHEET),
            part: f'<worksheet xmlns="{MAIN}"><sheetData>{rows}</sheetData></worksheet>'.encode(),
        }
        return self.package.replace_parts(parts)

    def _part_with_calculation_on_load(self) -> bytes:
        """Return the XML of the workbook part that asks programs to calculate all formulas when they open the file."""
        root, data = self._elements[0], self.package.read(self._part)
        for e in root.children:
            if e.name == "calcPr" and e.namespace == MAIN:
                tag = set_attribute(data[e.start : e.inner], "fullCalcOnLoad", "1")
                return splice(data, [(e.start, e.inner, tag)])
        offset = max(e.end for e in root.children if e.namespace == MAIN and e.name in _BEFORE_CALC_PR)
        prefix = data[root.start + 1 : root.inner].split(b"workbook", 1)[0]
        return splice(data, [(offset, offset, b'<%bcalcPr fullCalcOnLoad="1"/>' % prefix)])
