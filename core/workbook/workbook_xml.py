"""The sheets of a workbook file as cells that can be changed, and the file with the changes."""

import itertools
import re
from functools import cached_property

from ..errors import InputError
from .formulas import areas_in, operands
from .package import CONTENT_TYPES, Package, relations_part, spliced, with_attribute
from .sheet_xml import MAIN, STRICT, At, Cell, Reference, SheetXml, cell_name, reference, shared_strings

KINDS = {
    ".xlsx": "application/vnd.openxmlformats-officedocument.spreadsheetml.sheet.main+xml",
    ".xlsm": "application/vnd.ms-excel.sheet.macroEnabled.main+xml",
}
_BEFORE_CALC_PR = (
    *("fileVersion", "fileSharing", "workbookPr", "workbookProtection", "bookViews", "sheets", "functionGroups"),
    *("externalReferences", "definedNames"),
)
_RELATIONS = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
_WORKSHEET = "application/vnd.openxmlformats-officedocument.spreadsheetml.worksheet+xml"
Place = tuple[str, int, int]
"""Sheet, row, column."""


class WorkbookXml:
    """The worksheets of a workbook file with these bytes; messages call it `name`.

    `parts` has the member of the package of each worksheet, in the workbook's order, `all_sheets` the names of all sheets,
    also of charts, and `hidden` those of the sheets that are not shown.
    """

    def __init__(self, content: bytes, name: str) -> None:
        self.name = name
        self.package = Package(content, name)
        found = [member for _, kind, member in self.package.relations("") if kind == "officeDocument"]
        if not found:
            raise InputError(f"{name}: not a whole .xlsx workbook (it does not say where its sheets are)")
        self._part = found[0]
        found_elements = self.package.elements(self._part)
        if found_elements[0].namespace == STRICT:
            raise InputError(f"{name}: a 'Strict Open XML Spreadsheet', expected it saved as 'Excel Workbook (*.xlsx)'")
        self._elements = [e for e in found_elements if e.namespace == MAIN]
        relations = self.package.relations(self._part)
        self._related = {kind: member for _, kind, member in reversed(relations)}
        self.all_sheets: list[str] = []
        self.hidden: set[str] = set()
        self.parts: dict[str, str] = {}
        self._parsed: dict[str, SheetXml] = {}
        worksheets = {key: member for key, kind, member in relations if kind == "worksheet"}
        for e in self._elements:
            if e.name != "sheet":
                continue
            title = e.attributes.get("name", "")
            if title.casefold() in map(str.casefold, self.all_sheets):
                twice = f"has two sheets called {title}, expected one"
                raise InputError(f"{name}: {twice}; Excel or LibreOffice may repair it")
            self.all_sheets.append(title)
            if e.attributes.get("state", "visible") != "visible":
                self.hidden.add(title)
            key = next((value for attribute, value in e.attributes.items() if attribute.endswith(" id")), "")
            if key in worksheets:
                self.parts[title] = worksheets[key]
        self._by_folded_name = {title.casefold(): title for title in self.parts}
        self._extents: dict[tuple[str, int], At] = {}

    def sheet(self, title: str) -> SheetXml:
        """A worksheet, parsed when it is first asked for: users' workbooks carry large ones that nobody needs."""
        if title not in self._parsed:
            self._parsed[title] = SheetXml(self.package.read(self.parts[title]), self._strings, title, self.name)
        return self._parsed[title]

    @cached_property
    def _strings(self) -> list[str]:
        part = self._related.get("sharedStrings")
        return [] if part is None else shared_strings(self.package.elements(part))

    @property
    def suffix(self) -> str | None:
        """ ".xlsx" or ".xlsm" by the content, None for anything else."""
        kind = self.package.content_type(self._part)
        return next((suffix for suffix, content_type in KINDS.items() if kind == content_type), None)

    @property
    def asks_for_calculation(self) -> bool:
        """Whether the file says that the formulas' stored values are not to be relied on."""
        settings = [e.attributes for e in self._elements if e.name == "calcPr"]
        asked = any(a.get(name) in ("1", "true") for a in settings for name in ("fullCalcOnLoad", "forceFullCalc"))
        return asked or any(a.get("calcCompleted") in ("0", "false") for a in settings)

    @cached_property
    def _number_formats(self) -> list[str]:
        """The number format of each style of cells."""
        from openpyxl.styles.numbers import BUILTIN_FORMATS

        parts = self.package.elements(self._related["styles"]) if "styles" in self._related else []
        named = [e.attributes for e in parts if e.name == "numFmt"]
        own = {attributes.get("numFmtId"): attributes.get("formatCode", "") for attributes in named}
        styles = [e for e in parts if e.name == "xf" and e.parent is not None and e.parent.name == "cellXfs"]
        ids = [e.attributes.get("numFmtId", "0") for e in styles]
        return [own[i] if i in own else BUILTIN_FORMATS.get(int(i), "") for i in ids]

    def number_format(self, cell: Cell) -> str:
        """The number format of a cell, such as ``0.00" mm"``."""
        style = int(cell.style or 0)
        return self._number_formats[style] if style < len(self._number_formats) else ""

    def comments(self, sheet: str) -> dict[At, str]:
        """The comments on a sheet's cells."""
        found: dict[At, str] = {}
        for member in self._related_to(sheet, "comments"):
            at = None
            for e in self.package.elements(member):
                if e.name == "comment" and (cell := reference(e.attributes.get("ref", ""))) is not None:
                    at = cell.top, cell.left
                elif e.name == "t" and at is not None:
                    found[at] = found.get(at, "") + e.text
        return found

    @cached_property
    def _names(self) -> dict[tuple[str | None, str], str]:
        """(sheet or None, case-folded defined name) -> formula."""
        names = {}
        for e in self._elements:
            if e.name == "definedName" and e.text.strip():
                scope = e.attributes.get("localSheetId", "")
                at = int(scope) if scope.isdigit() else -1
                sheet = self.all_sheets[at] if 0 <= at < len(self.all_sheets) else None
                names[sheet, e.attributes.get("name", "").casefold()] = f"={e.text.strip()}"
        return names

    @cached_property
    def tables(self) -> dict[str, Reference]:
        """Case-folded name of an Excel table -> its cells."""
        found = {}
        for title in self.parts:
            for member in self._related_to(title, "table"):
                attributes = self.package.elements(member)[0].attributes
                if (area := reference(attributes.get("ref", ""))) is not None:
                    found[attributes.get("displayName", "").casefold()] = area._replace(sheet=title)
        return found

    def _related_to(self, sheet: str, kind: str) -> list[str]:
        return [member for _, its, member in self.package.relations(self.parts[sheet]) if its == kind]

    def title(self, name: str | None) -> str | None:
        """A sheet's name as the workbook writes it, given in whatever case."""
        return None if name is None else self._by_folded_name.get(name.casefold())

    def cell(self, place: Place) -> Cell:
        """A cell as it is now."""
        return self.sheet(place[0]).cell(place[1:])

    def put(self, place: Place, cell: Cell) -> None:
        """Give a place another content."""
        self.sheet(place[0]).cells[place[1:]] = cell

    @property
    def formulas(self) -> dict[Place, Cell]:
        """The cells with formulas, or of array formulas, of all sheets."""
        return {
            (title, *at): cell
            for title in self.parts
            for at, cell in self.sheet(title).cells.items()
            if cell.formula is not None or cell.array is not None
        }

    @cached_property
    def never_calculated(self) -> bool:
        """Whether every formula stores 0 or nothing, as programs that cannot calculate, such as XlsxWriter, leave it."""
        return not any(cell.value or cell.value is False for cell in self.formulas.values())

    def meaning(self, sheet: str, name: str) -> str | None:
        """The formula that a defined name stands for on `sheet`; None if it is unknown or depends on the cell."""
        own, _, plain = name.rpartition("!")
        scope, key = self.title(own.strip("'")) if own else sheet, plain.casefold()
        formula = self._names.get((scope, key)) or self._names.get((None, key))
        areas = [text for text in operands(formula or "") if reference(text) is not None]
        cells = [text.rpartition("!")[2] for text in areas]  # Main!$B$3 means the same everywhere, Main!B3 does not
        return formula if all(text.count("$") == len(re.findall(r"[A-Za-z]+|\d+", text)) for text in cells) else None

    def extent(self, sheet: str) -> At:
        """The last row and the last column of `sheet` with content."""
        key = sheet, len(self.sheet(sheet).cells)  # which grows when rows are added; emptied cells do no harm
        if key not in self._extents:
            filled = [at for at, cell in self.sheet(sheet).cells.items() if not cell.blank]
            rows, columns = {row for row, _ in filled}, {column for _, column in filled}
            self._extents[key] = max(rows, default=0), max(columns, default=0)
        return self._extents[key]

    def ranges_ending_at(self, sheet: str, last: int) -> list[str]:
        """The names, charts, tables and formulas that refer to several rows of `sheet` of which `last` is the last."""

        def ends_there(area: Reference | None, own: str = "") -> bool:
            return area is not None and area.top < area.bottom == last and sheet == (self.title(area.sheet) or own)

        found = [
            f"the name {name}"
            for (_, name), formula in self._names.items()
            if name != "_xlnm._filterdatabase" and any(map(ends_there, areas_in(formula)))
        ]
        for member in self.package.names:
            if member.startswith("xl/charts/") and member.endswith(".xml"):
                series = [reference(e.text.strip()) for e in self.package.elements(member) if e.name == "f"]
                found += [f"the chart {member}"] * any(map(ends_there, series))
        found += [f"the table {name}" for name, area in self.tables.items() if ends_there(area)]
        return found + [
            self.text(place)
            for place, cell in self.formulas.items()
            if any(ends_there(area, place[0]) for area in areas_in(cell.formula or ""))
        ]

    @staticmethod
    def text(place: Place) -> str:
        """E.g. ``Coordinates!B3``."""
        return f"{place[0]}!{cell_name(place[1:])}"

    @property
    def changed(self) -> list[Place]:
        """The cells that are not as they were read."""
        return [(title, *at) for title, sheet in self._parsed.items() for at in sheet.changed]

    def to_bytes(self) -> bytes:
        """The workbook with the changed cells; spreadsheet programs will recalculate it when they open it."""
        changed = {title: sheet for title, sheet in self._parsed.items() if sheet.changed}
        if not changed:
            return self.package.content
        parts = {self.parts[title]: sheet.to_bytes() for title, sheet in changed.items()}
        parts[self._part] = self._recalculated_on_load()
        stale_chain = "calcChain" in self._related and any(s.formulas_added_or_removed for s in changed.values())
        return self.package.with_parts(parts, [self._related["calcChain"]] if stale_chain else [], self._part)

    def with_sheet(self, title: str, rows: str) -> bytes:
        """The workbook with one more sheet, last, that consists of these rows' XML."""
        add, taken = self.package.with_last, {name.casefold() for name in self.package.names}
        number = next(n for n in itertools.count(1) if f"xl/worksheets/sheet{n}.xml" not in taken)
        part, key, kind = f"xl/worksheets/sheet{number}.xml", f"rIdSheet{number}", f"{_RELATIONS}/worksheet"
        ids = [int(e.attributes.get("sheetId", "0")) for e in self._elements if e.name == "sheet"]
        named = {"name": title, "sheetId": str(max(ids, default=0) + 1), "xmlns_r": _RELATIONS, "r_id": key}
        relations = relations_part(self._part)
        parts = {
            self._part: add(self._part, "sheets", "sheet", **named),
            relations: add(relations, "Relationships", "Relationship", Id=key, Type=kind, Target=f"/{part}"),
            CONTENT_TYPES: add(CONTENT_TYPES, "Types", "Override", PartName=f"/{part}", ContentType=_WORKSHEET),
            part: f'<worksheet xmlns="{MAIN}"><sheetData>{rows}</sheetData></worksheet>'.encode(),
        }
        return self.package.with_parts(parts)

    def _recalculated_on_load(self) -> bytes:
        root, data = self._elements[0], self.package.read(self._part)
        for e in root.children:
            if e.name == "calcPr" and e.namespace == MAIN:
                tag = with_attribute(data[e.start : e.inner], "fullCalcOnLoad", "1")
                return spliced(data, [(e.start, e.inner, tag)])
        at = max(e.end for e in root.children if e.namespace == MAIN and e.name in _BEFORE_CALC_PR)
        prefix = data[root.start + 1 : root.inner].split(b"workbook", 1)[0]
        return spliced(data, [(at, at, b'<%bcalcPr fullCalcOnLoad="1"/>' % prefix)])
