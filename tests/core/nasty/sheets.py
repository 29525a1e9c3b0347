"""Workbooks as plain data, and the three ways of writing them: by hand, by XlsxWriter and by openpyxl.

By hand means: the XML as Excel writes it, every stored value as given, and whatever else no library would write.
"""

from __future__ import annotations

import datetime
import io
import re
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, quoteattr

from openpyxl.comments import Comment
from openpyxl.utils import column_index_from_string, get_column_letter
from openpyxl.workbook import Workbook
from openpyxl.workbook.defined_name import DefinedName


@dataclass(frozen=True)
class Formula:
    """A formula and the value that the file stores for it; None stores nothing."""

    text: str  # without "="
    stored: Any = None
    attributes: str = ""  # of <f>, e.g. ' t="shared" si="0" ref="B3:B6"'


@dataclass(frozen=True)
class Raw:
    """A cell's XML, to be put in a row as it is."""

    xml: str


@dataclass(frozen=True)
class Error:
    """A typed error value, e.g. #N/A."""

    text: str


@dataclass(frozen=True)
class Rich:
    """The XML inside of a shared string's <si>."""

    xml: str


@dataclass
class Sheet:
    name: str
    cells: dict[str, Any] = field(default_factory=dict)
    formats: dict[str, str | int] = field(default_factory=dict)  # cell -> number format, an int if Excel's own
    merged: list[str] = field(default_factory=list)
    notes: dict[str, str] = field(default_factory=dict)
    state: str = "visible"
    hidden_rows: list[int] = field(default_factory=list)
    hidden_columns: list[str] = field(default_factory=list)
    table: str | None = None  # the range of an Excel table ("Format as Table")
    table_totals: bool = False
    after_data: str = ""  # XML behind <sheetData>
    row_order: Callable[[list[str]], list[str]] | None = None  # changes the order of the rows' XML

    def __getitem__(self, at: str) -> Any:
        return self.cells.get(at)

    def __setitem__(self, at: str, value: Any) -> None:
        self.cells[at] = value

    def put(self, at: str, rows: list[list[Any]]) -> None:
        """Write a block of values whose upper left cell is `at`; None leaves a cell as it is."""
        left, top = split(at)
        for i, row in enumerate(rows):
            for j, value in enumerate(row):
                if value is not None:
                    self.cells[f"{get_column_letter(left + j)}{top + i}"] = value

    def moved(self, down: int = 0, right: int = 0, below: int = 0) -> None:
        """Move the cells below a row; formulas that refer to cells are not adapted."""

        def at(cell: str) -> str:
            column, row = split(cell)
            return f"{get_column_letter(column + right)}{row + down}" if row > below else cell

        self.cells = {at(cell): value for cell, value in self.cells.items()}
        self.formats = {at(cell): value for cell, value in self.formats.items()}


@dataclass
class Book:
    sheets: list[Sheet]
    calculation: str = '<calcPr calcId="191029"/>'
    names: dict[str, str] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Sheet:
        return next(sheet for sheet in self.sheets if sheet.name == name)


def split(at: str) -> tuple[int, int]:
    """Return the (column, row) of a cell's name."""
    letters, digits = re.fullmatch(r"([A-Z]+)(\d+)", at).groups()  # type: ignore[union-attr]
    return column_index_from_string(letters), int(digits)


# By hand

_MAIN = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
_RELATIONS = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
_PACKAGE = "http://schemas.openxmlformats.org/package/2006"
_XML = '<?xml version="1.0" encoding="UTF-8" standalone="yes"?>\n'
_PART = "application/vnd.openxmlformats-officedocument.spreadsheetml."
WORKBOOK_TYPE = _PART + "sheet.main+xml"
Members = dict[str, bytes]
"""The files in a workbook's zip archive."""


def members_of(book: Book) -> Members:
    """Return the files in the zip archive, as Excel lays them out."""
    strings: dict[str, int] = {}
    formats: dict[str | int, int] = {}
    parts: dict[str, str] = {}
    types: list[str] = []
    sheets, relations = [], []
    for n, sheet in enumerate(book.sheets, start=1):
        parts[f"xl/worksheets/sheet{n}.xml"] = _sheet_xml(sheet, n, strings, formats)
        types.append(_override(f"/xl/worksheets/sheet{n}.xml", "worksheet"))
        state = "" if sheet.state == "visible" else f' state="{sheet.state}"'
        sheets.append(f'<sheet name={quoteattr(sheet.name)} sheetId="{n}"{state} r:id="rId{n}"/>')
        relations.append(_relation(f"rId{n}", "worksheet", f"worksheets/sheet{n}.xml"))
        beside = []
        if sheet.table:
            parts[f"xl/tables/table{n}.xml"] = _table_xml(sheet, n)
            types.append(_override(f"/xl/tables/table{n}.xml", "table"))
            beside.append(_relation("rId1", "table", f"../tables/table{n}.xml"))
        if sheet.notes:
            parts[f"xl/comments{n}.xml"] = _notes_xml(sheet)
            types.append(_override(f"/xl/comments{n}.xml", "comments"))
            beside.append(_relation("rId2", "comments", f"../comments{n}.xml"))
        if beside:
            parts[f"xl/worksheets/_rels/sheet{n}.xml.rels"] = _relations(beside)
    n = len(book.sheets)
    relations += [
        _relation(f"rId{n + 1}", "styles", "styles.xml"),
        _relation(f"rId{n + 2}", "sharedStrings", "sharedStrings.xml"),
    ]
    names = "".join(f"<definedName name={quoteattr(k)}>{escape(v)}</definedName>" for k, v in book.names.items())
    names = f"<definedNames>{names}</definedNames>" if names else ""
    parts["xl/workbook.xml"] = (
        f'{_XML}<workbook xmlns="{_MAIN}" xmlns:r="{_RELATIONS}"><workbookPr defaultThemeVersion="166925"/>'
        f'<bookViews><workbookView activeTab="0"/></bookViews><sheets>{"".join(sheets)}</sheets>{names}'
        f"{book.calculation}</workbook>"
    )
    parts["xl/_rels/workbook.xml.rels"] = _relations(relations)
    parts["xl/styles.xml"] = _styles_xml(formats)
    items = "".join(f"<si>{xml}</si>" for xml in strings)
    parts["xl/sharedStrings.xml"] = f'{_XML}<sst xmlns="{_MAIN}" count="{len(strings)}">{items}</sst>'
    parts["_rels/.rels"] = _relations([_relation("rId1", "officeDocument", "xl/workbook.xml")])
    types += [
        f'<Override PartName="/xl/workbook.xml" ContentType="{WORKBOOK_TYPE}"/>',
        _override("/xl/styles.xml", "styles"),
        _override("/xl/sharedStrings.xml", "sharedStrings"),
    ]
    parts["[Content_Types].xml"] = (
        f'{_XML}<Types xmlns="{_PACKAGE}/content-types"><Default Extension="rels" '
        'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        f'<Default Extension="xml" ContentType="application/xml"/>{"".join(types)}</Types>'
    )
    first = ("[Content_Types].xml", "_rels/.rels", "xl/workbook.xml")
    ordered = {name: parts.pop(name).encode() for name in first}
    return ordered | {name: text.encode() for name, text in parts.items()}


def _relation(key: str, kind: str, target: str) -> str:
    return f'<Relationship Id="{key}" Type="{_RELATIONS}/{kind}" Target="{target}"/>'


def _relations(relations: list[str]) -> str:
    return f'{_XML}<Relationships xmlns="{_PACKAGE}/relationships">{"".join(relations)}</Relationships>'


def _override(part: str, kind: str) -> str:
    return f'<Override PartName="{part}" ContentType="{_PART}{kind}+xml"/>'


def _sheet_xml(sheet: Sheet, n: int, strings: dict[str, int], formats: dict[str | int, int]) -> str:
    rows: dict[int, dict[int, str]] = {}
    for at, value in sheet.cells.items():
        if value is not None:
            column, row = split(at)
            rows.setdefault(row, {})[column] = _cell_xml(at, value, sheet.formats.get(at), strings, formats)
    lines = []
    for row in sorted(rows):
        hidden = ' hidden="1"' if row in sheet.hidden_rows else ""
        cells = "".join(xml for _, xml in sorted(rows[row].items()))
        lines.append(f'<row r="{row}"{hidden}>{cells}</row>')
    hidden_columns = "".join(
        f'<col min="{i}" max="{i}" width="0" hidden="1" customWidth="1"/>'
        for i in sorted(map(column_index_from_string, sheet.hidden_columns))
    )
    merged = "".join(f'<mergeCell ref="{area}"/>' for area in sheet.merged)
    return "".join(
        [
            f'{_XML}<worksheet xmlns="{_MAIN}" xmlns:r="{_RELATIONS}">',
            f"<cols>{hidden_columns}</cols>" if hidden_columns else "",
            f"<sheetData>{''.join(sheet.row_order(lines) if sheet.row_order else lines)}</sheetData>",
            sheet.after_data,
            f'<mergeCells count="{len(sheet.merged)}">{merged}</mergeCells>' if merged else "",
            '<tableParts count="1"><tablePart r:id="rId1"/></tableParts>' if sheet.table else "",
            "</worksheet>",
        ]
    )


def _cell_xml(
    at: str, value: Any, number_format: str | int | None, strings: dict[str, int], formats: dict[str | int, int]
) -> str:
    style = "" if number_format is None else f' s="{formats.setdefault(number_format, len(formats)) + 1}"'
    if isinstance(value, Raw):
        return value.xml
    if isinstance(value, Formula):
        kind, stored = _value_xml(value.stored)
        kind = kind.replace("inlineStr", "str").replace('t="s"', 't="str"')
        return f'<c r="{at}"{style}{kind}><f{value.attributes}>{escape(value.text)}</f>{stored}</c>'
    if isinstance(value, (str, Rich)):
        xml = value.xml if isinstance(value, Rich) else f'<t xml:space="preserve">{escape(value)}</t>'
        return f'<c r="{at}"{style} t="s"><v>{strings.setdefault(xml, len(strings))}</v></c>'
    kind, stored = _value_xml(value)
    return f'<c r="{at}"{style}{kind}>{stored}</c>'


def _value_xml(value: Any) -> tuple[str, str]:
    if value is None:
        return "", ""
    if isinstance(value, Error):
        return ' t="e"', f"<v>{value.text}</v>"
    if isinstance(value, bool):
        return ' t="b"', f"<v>{int(value)}</v>"
    if isinstance(value, str):
        return ' t="str"', f"<v>{escape(value)}</v>"
    if isinstance(value, datetime.date):
        return ' t="d"', f"<v>{value.isoformat()}</v>"
    return "", f"<v>{value!r}</v>"


def _styles_xml(formats: dict[str | int, int]) -> str:
    ids = {code: code if isinstance(code, int) else 164 + i for code, i in formats.items()}
    own = "".join(
        f'<numFmt numFmtId="{ids[code]}" formatCode={quoteattr(code)}/>' for code in formats if isinstance(code, str)
    )
    used = "".join(
        f'<xf numFmtId="{i}" fontId="0" fillId="0" borderId="0" xfId="0" applyNumberFormat="1"/>' for i in ids.values()
    )
    plain = '<xf numFmtId="0" fontId="0" fillId="0" borderId="0" xfId="0"/>'
    return (
        f'{_XML}<styleSheet xmlns="{_MAIN}">'
        + (f'<numFmts count="{len(formats)}">{own}</numFmts>' if formats else "")
        + '<fonts count="1"><font><sz val="11"/><name val="Calibri"/></font></fonts>'
        '<fills count="2"><fill><patternFill patternType="none"/></fill>'
        '<fill><patternFill patternType="gray125"/></fill></fills>'
        "<borders><border><left/><right/><top/><bottom/><diagonal/></border></borders>"
        f'<cellStyleXfs count="1">{plain.replace(" xfId=" + chr(34) + "0" + chr(34), "")}</cellStyleXfs>'
        f'<cellXfs count="{len(formats) + 1}">{plain}{used}</cellXfs>'
        '<cellStyles count="1"><cellStyle name="Normal" xfId="0" builtinId="0"/></cellStyles></styleSheet>'
    )


def _table_xml(sheet: Sheet, n: int) -> str:
    assert sheet.table is not None
    first, last = sheet.table.split(":")
    (left, top), (right, _) = split(first), split(last)
    names = [str(sheet[f"{get_column_letter(c)}{top}"] or f"Column{c}") for c in range(left, right + 1)]
    columns = "".join(f"<tableColumn id={quoteattr(str(i))} name={quoteattr(x)}/>" for i, x in enumerate(names, 1))
    totals = ' totalsRowCount="1"' if sheet.table_totals else ' totalsRowShown="0"'
    return (
        f'{_XML}<table xmlns="{_MAIN}" id="{n}" name="Table{n}" displayName="Table{n}" ref="{sheet.table}"{totals}>'
        f'<autoFilter ref="{sheet.table}"/><tableColumns count="{len(names)}">{columns}</tableColumns></table>'
    )


def _notes_xml(sheet: Sheet) -> str:
    notes = "".join(
        f'<comment ref="{at}" authorId="0"><text><t>{escape(text)}</t></text></comment>'
        for at, text in sheet.notes.items()
    )
    notes = f"<commentList>{notes}</commentList>"
    return f'{_XML}<comments xmlns="{_MAIN}"><authors><author>A</author></authors>{notes}</comments>'


def zipped(members: Members, compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression, compresslevel=1) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return file.getvalue()


def by_hand(book: Book, path: Path) -> None:
    path.write_bytes(zipped(members_of(book)))


# By other programs' libraries


def by_xlsxwriter(book: Book, path: Path, **options: Any) -> None:
    """Write with XlsxWriter, which asks for calculation on loading and stores 0 for a formula unless told its value."""
    import xlsxwriter

    with xlsxwriter.Workbook(path, {"strings_to_formulas": False, "strings_to_urls": False, **options}) as workbook:
        formats = {code: workbook.add_format({"num_format": code}) for s in book.sheets for code in s.formats.values()}
        for sheet in book.sheets:
            worksheet = workbook.add_worksheet(sheet.name)
            if sheet.state == "hidden":
                worksheet.hide()
            for at, text in sheet.notes.items():  # which lack in constant memory later on
                worksheet.write_comment(at, text)
            for at, value in sorted(sheet.cells.items(), key=lambda item: split(item[0])[::-1]):
                style = formats.get(sheet.formats.get(at, ""))
                if isinstance(value, Formula):
                    stored = 0 if value.stored is None else value.stored
                    stored = stored.text if isinstance(stored, Error) else stored
                    worksheet.write_formula(at, "=" + value.text, style, stored)
                elif isinstance(value, (str, float, int, bool)):
                    worksheet.write(at, value, style)
                elif value is not None:
                    raise TypeError(f"XlsxWriter does not write {value!r}")
            for area in sheet.merged:
                at = area.split(":")[0]
                worksheet.merge_range(area, sheet[at], formats.get(sheet.formats.get(at, "")))
            for row in sheet.hidden_rows:
                worksheet.set_row(row - 1, None, None, {"hidden": True})
        for name, formula in book.names.items():
            workbook.define_name(name, "=" + formula)


def openpyxl_workbook(book: Book) -> Workbook:
    """Return a book as openpyxl's, in which no formula has a stored value."""
    workbook = Workbook()
    workbook.remove(workbook.active)
    for sheet in book.sheets:
        worksheet = workbook.create_sheet(sheet.name)
        worksheet.sheet_state = sheet.state
        for at, value in sheet.cells.items():
            worksheet[at] = "=" + value.text if isinstance(value, Formula) else value
            if at in sheet.formats:
                worksheet[at].number_format = sheet.formats[at]
        for at, text in sheet.notes.items():
            worksheet[at].comment = Comment(text, "A")
        for area in sheet.merged:
            worksheet.merge_cells(area)
        for row in sheet.hidden_rows:
            worksheet.row_dimensions[row].hidden = True
        for letters in sheet.hidden_columns:
            worksheet.column_dimensions[letters].hidden = True
    for name, formula in book.names.items():
        workbook.defined_names[name] = DefinedName(name, attr_text=formula)
    return workbook
