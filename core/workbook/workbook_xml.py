"""A workbook file's sheets as cells that can be changed, and the file with the changes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property
from typing import Any

from ..errors import InputError
from .formulas import CellError, NotComputable, Surroundings, calculate, tokens_of
from .package import Package
from .references import Reference, reference
from .sheet_xml import MAIN, STRICT, At, Cell, SheetXml, Unreadable, shared_strings
from .tables import DataTable, data_table, named_part
from .xml_parts import Element, elements, spliced, utf8, with_attribute

KINDS = {
    ".xlsx": "application/vnd.openxmlformats-officedocument.spreadsheetml.sheet.main+xml",
    ".xlsm": "application/vnd.ms-excel.sheet.macroEnabled.main+xml",
}
_BEFORE_CALC_PR = (
    *("fileVersion", "fileSharing", "workbookPr", "workbookProtection", "bookViews", "sheets", "functionGroups"),
    *("externalReferences", "definedNames"),
)
Place = tuple[str, int, int]
"""Sheet, row, column."""


class _Sheets(Mapping[str, SheetXml]):
    """Sheets by name, each parsed when it is first asked for: users' workbooks carry large ones that nobody asks for."""

    def __init__(self, titles: Iterable[str], parsed: Callable[[str], SheetXml]) -> None:
        self._titles, self._parsed = dict.fromkeys(titles), parsed
        self._sheets: dict[str, SheetXml] = {}

    def __getitem__(self, title: str) -> SheetXml:
        if title not in self._sheets:
            if title not in self._titles:
                raise KeyError(title)
            self._sheets[title] = self._parsed(title)
        return self._sheets[title]

    def __iter__(self) -> Iterator[str]:
        return iter(self._titles)

    def __len__(self) -> int:
        return len(self._titles)

    def __contains__(self, title: object) -> bool:
        return title in self._titles


class WorkbookXml:
    """The worksheets of a workbook file.

    Parameters
    ----------
    content
        The file's bytes.
    name
        How messages call the file.

    Attributes
    ----------
    sheets : mapping
        Name -> `SheetXml`, in the workbook's order; charts' sheets are left out.
    """

    def __init__(self, content: bytes, name: str) -> None:
        self.name = name
        self.package = Package(content, name)
        found = [member for _, kind, member in self.package.relations("") if kind == "officeDocument"]
        if not found:
            raise InputError(f"{name}: not a whole .xlsx workbook (it does not say where its sheets are)")
        self._part = found[0]
        self._data, self._back = utf8(self.package.read(self._part), name)
        found_elements = elements(self._data, name)
        if found_elements[0].namespace == STRICT:
            raise InputError(f"{name}: a 'Strict Open XML Spreadsheet', expected it saved as 'Excel Workbook (*.xlsx)'")
        self._elements = [e for e in found_elements if e.namespace == MAIN]
        relations = self.package.relations(self._part)
        members = {key: (kind, member) for key, kind, member in relations}
        strings = [member for _, kind, member in relations if kind == "sharedStrings"]
        self._calc_chain = [member for _, kind, member in relations if kind == "calcChain"]
        texts = shared_strings(self.package.read(strings[0]), name) if strings else []
        self._styles = [member for _, kind, member in relations if kind == "styles"]
        self.all_sheets: list[str] = []
        self.hidden: set[str] = set()
        self.parts: dict[str, str] = {}
        for e in self._elements:
            if e.name != "sheet":
                continue
            title = e.attributes.get("name", "")
            if title.casefold() in map(str.casefold, self.all_sheets):
                raise InputError(
                    f"{name}: has two sheets called {title}, expected one; Excel or LibreOffice may repair it"
                )
            self.all_sheets.append(title)
            if e.attributes.get("state", "visible") != "visible":
                self.hidden.add(title)
            key = next((value for attribute, value in e.attributes.items() if attribute.endswith(" id")), "")
            kind, member = members.get(key, ("", ""))
            if kind == "worksheet":
                self.parts[title] = member
        self.sheets = _Sheets(self.parts, lambda t: SheetXml(self.package.read(self.parts[t]), texts, t, name))
        self._by_folded_name = {title.casefold(): title for title in self.sheets}
        self._extents: dict[tuple[str, int], tuple[int, int]] = {}

    @property
    def suffix(self) -> str | None:
        """ ".xlsx" or ".xlsm" by what is inside, None for anything else."""
        kind = self.package.content_type(self._part)
        return next((suffix for suffix, content_type in KINDS.items() if kind == content_type), None)

    @property
    def asks_for_calculation(self) -> bool:
        """Whether the formulas' stored values are, by what the file says, not to be relied on."""
        settings = [e.attributes for e in self._elements if e.name == "calcPr"]
        asked = any(a.get(name) in ("1", "true") for a in settings for name in ("fullCalcOnLoad", "forceFullCalc"))
        return asked or any(a.get("calcCompleted") in ("0", "false") for a in settings)

    @cached_property
    def _number_formats(self) -> list[str]:
        """The number format of each style of cells."""
        from openpyxl.styles.numbers import BUILTIN_FORMATS

        if not self._styles:
            return []
        parts = self._parts_of(self._styles[0])
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
        for _, kind, member in self.package.relations(self.parts[sheet]):
            if kind != "comments":
                continue
            at = None
            for e in self._parts_of(member):
                if e.name == "comment" and (cell := reference(e.attributes.get("ref", ""))) is not None:
                    at = cell.top, cell.left
                elif e.name == "t" and at is not None:
                    found[at] = found.get(at, "") + e.text
        return found

    @cached_property
    def _names(self) -> dict[tuple[str | None, str], str]:
        """(sheet or None, folded defined name) -> formula."""
        names = {}
        for e in self._elements:
            if e.name == "definedName" and e.text.strip():
                scope = e.attributes.get("localSheetId", "")
                at = int(scope) if scope.isdigit() else -1
                sheet = self.all_sheets[at] if 0 <= at < len(self.all_sheets) else None
                names[sheet, e.attributes.get("name", "").casefold()] = f"={e.text.strip()}"
        return names

    @cached_property
    def _tables(self) -> dict[str, DataTable]:
        """Folded name -> table."""
        tables = {}
        for title, part in self.parts.items():
            for _, kind, member in self.package.relations(part):
                if kind == "table" and (table := data_table(self._parts_of(member), title)) is not None:
                    tables[table.name.casefold()] = table
        return tables

    def meaning(self, place: Place, name: str) -> str | None:
        """The formula that a name, or a reference to a table's columns, stands for in a formula at `place`.

        None where it is unknown, or a name whose meaning depends on the place.
        """
        sheet, row, _ = place
        named = named_part(name)
        if named is not None and named[0] in self._tables:
            table = self._tables[named[0]]
            part = table.part(named[1], row if table.sheet == sheet else None)
            return None if part is None else f"={part}"
        own, _, plain = name.rpartition("!")
        scope = self.title(own.strip("'")) if own else sheet
        key = plain.casefold()
        formula = self._names.get((scope, key)) or self._names.get((None, key))
        return formula if formula is not None and _is_absolute(formula) else None

    def title(self, name: str | None) -> str | None:
        """A sheet's name as it is written in the workbook."""
        return None if name is None else self._by_folded_name.get(name.casefold())

    def between(self, name: str) -> list[str]:
        """The sheets that "Sheet" or "First:Last" means; none where there are no such."""
        first, _, last = name.partition(":")
        folded = [title.casefold() for title in self.all_sheets]
        if name.casefold() in folded or not last:
            titles = [name]
        elif {first.casefold(), last.casefold()} <= set(folded):
            i, j = sorted((folded.index(first.casefold()), folded.index(last.casefold())))
            titles = self.all_sheets[i : j + 1]
        else:
            return []
        return [title for found in titles if (title := self.title(found)) is not None]

    def cell(self, place: Place) -> Cell:
        """A cell as it is now."""
        return self.sheets[place[0]].cell(place[1:])

    def value(self, place: Place) -> Any:
        """A cell's value as it is now; `NotComputable` where it is of an unusual kind."""
        value = self.cell(place).value
        if isinstance(value, Unreadable):
            raise NotComputable(f"{self.text(place)} holds {value!r}")
        return value

    def calculated(
        self, place: Place, formula: str, value_of: Callable[[Place], Any]
    ) -> float | str | bool | CellError:
        """What `formula` at `place` gives; `value_of` gives the values of cells, or raises `NotComputable`."""
        sheet = place[0]

        def title(name: str | None) -> str:
            found = sheet if name is None else self.title(name)
            if found is None:
                raise NotComputable(f"there is no sheet {name}")
            return found

        surroundings = Surroundings(
            lambda name, row, column: value_of((title(name), row, column)),
            at=place[1:],
            extent=lambda name: self.extent(title(name)),
            name=lambda name: self.meaning(place, name),
        )
        return calculate(formula, surroundings)

    def extent(self, sheet: str) -> tuple[int, int]:
        """The last row and the last column of `sheet` with content."""
        key = sheet, len(self.sheets[sheet].cells)  # which grows where rows are added; emptied cells do no harm
        if key not in self._extents:
            self._extents[key] = self.sheets[sheet].extent
        return self._extents[key]

    @staticmethod
    def text(place: Place) -> str:
        """E.g. ``Coordinates!B3``."""
        from openpyxl.utils import get_column_letter

        return f"{place[0]}!{get_column_letter(place[2])}{place[1]}"

    @property
    def changed(self) -> list[Place]:
        """The cells that are not as they were read."""
        return [(title, *at) for title, sheet in self.sheets.items() for at in sheet.changed]

    def to_bytes(self) -> bytes:
        """The file: the same bytes if no cell has changed; else with the changes, to be recalculated when opened."""
        changed = {title: sheet for title, sheet in self.sheets.items() if sheet.changed}
        if not changed:
            return self.package.to_bytes()
        for title, sheet in changed.items():
            self.package.replace(self.parts[title], sheet.to_bytes())
        self.package.replace(self._part, self._back(self._recalculated_on_load()))
        if any(sheet.formulas_moved for sheet in changed.values()):
            while self._calc_chain:
                self.package.remove(self._calc_chain.pop(), self._part)
        return self.package.to_bytes()

    def _recalculated_on_load(self) -> bytes:
        root = self._elements[0]
        for e in self._elements:
            if e.name == "calcPr" and e.parent is root:
                tag = with_attribute(self._data[e.start : e.inner], "fullCalcOnLoad", "1")
                return spliced(self._data, [(e.start, e.inner, tag)])
        before = [e for e in self._elements if e.parent is root and e.name in _BEFORE_CALC_PR]
        prefix = self._data[root.start + 1 : root.inner].split(b"workbook", 1)[0]
        at = max(e.end for e in before)
        return spliced(self._data, [(at, at, b'<%bcalcPr fullCalcOnLoad="1"/>' % prefix)])

    def ranges_ending_at(self, sheet: str, last: int) -> list[str]:
        """What refers to several rows of `sheet`, `last` being the last of them.

        Defined names, charts, tables and the cells of formulas.
        """

        def ends_there(area: Reference | None, own: str) -> bool:
            if area is None or not area.top < area.bottom == last:
                return False
            return sheet in (self.between(area.sheet) if area.sheet else [own])

        found = [
            f"the name {name}"
            for (_, name), formula in self._names.items()
            if name != "_xlnm._filterdatabase" and any(ends_there(area, "") for area in areas_in(formula))
        ]
        for member in self.package.names:
            if member.startswith("xl/charts/") and member.endswith(".xml"):
                parts = self._parts_of(member)
                if any(e.name == "f" and ends_there(reference(e.text.strip()), "") for e in parts):
                    found.append(f"the chart {member}")
        found += [f"the table {table.name}" for table in self._tables.values() if ends_there(table.area, "")]
        for title, cells in self.sheets.items():
            for at, cell in cells.cells.items():
                if cell.formula is not None and any(ends_there(area, title) for area in areas_in(cell.formula)):
                    found.append(self.text((title, *at)))
        return found

    def _parts_of(self, member: str) -> list[Element]:
        return elements(utf8(self.package.read(member), self.name)[0], self.name)


def areas_in(formula: str) -> list[Reference]:
    """The areas that a formula names."""
    return [area for text in _operands(formula) if (area := reference(text)) is not None]


def _operands(formula: str) -> list[str]:
    try:
        tokens = tokens_of(formula)
    except NotComputable:
        return []
    return [token.value for token in tokens if token.type == "OPERAND" and token.subtype == "RANGE"]


def _is_absolute(formula: str) -> bool:
    """Whether the formula of a name means the same wherever the name is used: ``Main!$B$3``, not ``Main!B3``."""
    cells = [text.rpartition("!")[2] for text in _operands(formula) if reference(text) is not None]
    return all(text.count("$") == len(re.findall(r"[A-Za-z]+|\d+", text)) for text in cells)
