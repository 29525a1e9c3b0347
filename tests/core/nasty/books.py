"""Sheets and files: which sheet is meant, and files that are no workbook, damaged, or odd but valid."""

from __future__ import annotations

import io
import re
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from .case import READ_OR_REFUSED, REFUSED, RIGHT, WARNED, Catalogue
from .scanners import (
    BIG,
    SCANNER,
    column_map,
    one_sheet,
    one_sheet_map,
    scanner,
    typed,
    users,
    users_map,
    with_cells,
)
from .sheets import Book, Formula, Sheet, members_of, zipped

CASES = Catalogue("books", place=("scanner.xlsx",), columns=users_map())
NO_WORKBOOK = "it has to be saved as .xlsx first"
DAMAGED = "the file is damaged"
OTHER = scanner(BIG.centers * 1.02, 4.2, 151.0, 121.0, 21.0)


def _named(book: Book, names: dict[str, str]) -> Book:
    for sheet in book.sheets:
        sheet.name = names.get(sheet.name, sheet.name)
    return book


def _copies(first: str, second: str, hidden: str = "") -> Book:
    """Two sheets with a whole table each, of two scanners."""
    book = one_sheet(BIG, sheet=first)
    book.sheets.append(one_sheet(OTHER, sheet=second).sheets[0])
    for sheet in book.sheets:
        if sheet.name == hidden:
            sheet.state = "hidden"
    return book


def _and_copy(name: str, of: Book, called: str, state: str = "visible") -> Book:
    """The users' workbook and sheet `name` of another, under another name."""
    made = users()
    made.sheets.append(replace(of[name], name=called, state=state))
    return made


def _d_in_coordinates(values: list[object]) -> Book:
    made = users()
    made["Coordinates"].put("Y1", [["d"], ["diameter of pinhole"], *[[v] for v in values]])
    return made


def _sheets() -> None:
    # The users' own sheet beside their Coordinates: a person knows which is meant.
    for first, second, known in (("Geometry", "Geometry (2)", ()), ("Coordinates", "MDSL cloud import", (RIGHT,))):
        of = {"place": (first, second)}
        for hidden, truth, allowed, shown in (
            ("", BIG, known, first),
            (second, BIG, known, first),
            (first, OTHER, (), second),
        ):
            name = f"tables in {first!r} and {second!r}{f', {hidden!r} is hidden' if hidden else ''}"
            book, mapped = _copies(first, second, hidden), one_sheet_map(sheet=shown)
            CASES.add(name, book, truth, *allowed, REFUSED, **of, columns=mapped)
    for state in ("hidden", "veryHidden"):
        made = one_sheet(BIG)
        made.sheets[0].state = state
        made.add("Notes", {"A1": "see me"}, first=True)
        seen = {"place": "Geometry", "columns": one_sheet_map()}
        CASES.add(f"the only table is in a sheet that is {state}", made, BIG, RIGHT, WARNED, REFUSED, **seen)
    changed = users(scanner(SCANNER.centers * 1.02, 2.4, 76.0, 51.0, 11.0))
    for name in ("Main", "Coordinates"):
        made = users()
        made[name].state = "hidden"
        CASES.add(f"users' {name} is hidden", made, SCANNER, RIGHT, WARNED, REFUSED, place=name)
        old = _and_copy(name, users(OTHER), name + " old", "hidden")
        CASES.add(f"a hidden older {name} as well", old, SCANNER, REFUSED, place=name)
        again = _and_copy(name, changed, f"{name} (2)")
        CASES.add(f"a copy of {name} of other numbers", again, SCANNER, REFUSED, place=name)
    own = _and_copy("Main", changed, "Values")  # the users' own sheet in addition to the two
    CASES.add("'Values' is a copy of Main of other numbers", own, SCANNER, *READ_OR_REFUSED, place="Main")
    same = _and_copy("Coordinates", users(), "Coordinates (2)")
    CASES.add("a copy of Coordinates of the same numbers", same, SCANNER, *READ_OR_REFUSED, place="Coordinates")
    both = {"place": ("Main", "Coordinates")}
    CASES.add("d in Main and, another, in Coordinates", _d_in_coordinates([3.0] * 4), SCANNER, REFUSED, **both)
    linked = _d_in_coordinates([Formula(f"Main!P{row}", 2.3) for row in range(3, 7)])
    CASES.add("d in Main and, the same by formula, in Coordinates", linked, SCANNER, *READ_OR_REFUSED, **both)
    third = users()
    third.add("Design Table").put("A1", [["d", "R", "sensitivity"], [4.0, 90.0, 1e-4]])
    CASES.add("another d and R in Design Table", third, SCANNER, *READ_OR_REFUSED, place=("Main", "Design Table"))
    # Sheets that the users' workbook has in addition to the two.
    for name, cells in {
        "Theta": {"A1": "theta", "A2": 0.1, "B1": "sin", "B2": Formula("SIN(A2)", 0.09983341664682815)},
        "MDSL cloud import": {"A1": 277.0, "B1": 70.3, "C1": -70.0, "A2": 155.0, "B2": 158.4, "C2": -70.9},
        "Units": {"A1": "This sheet", "A2": "sensitivity", "B2": "cps/MBq", "A3": "rod", "B3": "cm"},
        "empty": {},
        "Größen & mehr": {"A1": "ä"},
        "=1+1'": {"A1": 1.0},
    }.items():
        made = users()
        made.add(name, cells, first=True)
        CASES.add(f"a sheet {name!r} before the users'", made, SCANNER, RIGHT)
    many = users()
    for n in range(40):
        many.add(f"plot {n}", {"A1": n, "A2": "counts"})
    CASES.add("forty more sheets", many, SCANNER, RIGHT)
    for main, coordinates, allowed in (
        ("Größen", "Lage", (RIGHT,)),
        (" Main ", "COORDINATES", (RIGHT,)),
        ("Coordinates", "Main", READ_OR_REFUSED),
        ("a" * 31, "b" * 31, (RIGHT,)),
    ):
        made = _named(typed(users()), {"Main": main, "Coordinates": coordinates})
        mapped = users_map(position={"sheet": coordinates}, dimensions={"sheet": main})
        CASES.add(f"sheets called {main!r} and {coordinates!r}", made, SCANNER, *allowed, columns=mapped)
    alike = {"place": ("eometry", "scanner.xlsx")}
    CASES.add("two sheets whose names differ in case alone", _copies("Geometry", "geometry"), None, REFUSED, **alike)
    equal = _copies("Geometry", "Other")
    equal.replace("xl/workbook.xml", 'name="Other"', 'name="Geometry"')
    CASES.add("two sheets of one name", equal, None, REFUSED, **alike)
    rings = Book([one_sheet(BIG[2 * n : 2 * n + 2], sheet=f"Ring {n + 1}").sheets[0] for n in range(2)])
    joined = "a map joins columns, not rows"
    CASES.add("a sheet for each ring", rings, BIG, REFUSED, place="Ring", unmappable=joined)
    split = one_sheet(BIG)
    other = split.add("Geometry part 2")
    for at in [f"{column}{row}" for column in "DEFGHI" for row in range(1, 6)]:
        other[at] = split.sheets[0].cells.pop(at)
    first = "a map's first table holds x1, y1 and z1"
    CASES.add("z1 in another sheet", split, BIG, *READ_OR_REFUSED, unmappable=first)
    three = users()
    crystal = three.add("Crystal", {f"A{row}": row - 2 for row in range(3, 7)})
    for at in [f"{column}{row}" for column in "ST" for row in range(1, 7)]:
        crystal[at] = three["Main"].cells.pop(at, None)
    rows = {"first_row": 3, "last_row": 6, "number": "A"}
    mapped = column_map(
        *(
            {"sheet": sheet, **rows, **joint, "columns": {q: (c, "mm") for q, c in columns.items()}}
            for sheet, joint, columns in (
                ("Coordinates", {}, {"x1": "B", "y1": "C", "z1": "D", "l": "G"}),
                ("Main", {"rows": "by number"}, {"d": "P", "R": "Q"}),
                ("Crystal", {"rows": "by number"}, {"Ld": "S", "Td": "T"}),
            )
        )
    )
    CASES.add("Ld and Td in a third sheet", typed(three), SCANNER, *READ_OR_REFUSED, columns=mapped)
    reference = users()
    reference.names |= {"x1": "Coordinates!$B$3:$B$6", "_xlnm.Print_Area": "Coordinates!$A$1:$D$4"}
    CASES.add("names and a print area", reference, SCANNER, RIGHT)


# Files

Change = Callable[[dict[str, bytes]], dict[str, bytes]]


def _changed(book: Callable[[], Book], *changes: tuple[str, str, str]) -> Callable[[], Book]:
    """A book with texts replaced in its members."""

    def make() -> Book:
        made = book()
        for member, old, new in changes:
            made.replace(member, old, new, -1)
        return made

    return make


def _edited(change: Change, book: Callable[[], Book] = users) -> Callable[[], Book]:
    def make() -> Book:
        made = book()
        made.edit = change
        return made

    return make


def _bytes(
    change: Callable[[bytes], bytes], book: Callable[[], Book] = users, **options: int
) -> Callable[[Path], None]:
    """The file's bytes, changed."""

    def make(path: Path) -> None:
        path.write_bytes(change(zipped(members_of(book()), **options)))

    return make


def _of(member: str, change: Callable[[bytes], bytes]) -> Change:
    """A change of the members whose names begin so."""
    return lambda members: {k: change(v) if k.startswith(member) else v for k, v in members.items()}


def _without(member: str) -> Change:
    return lambda members: {k: v for k, v in members.items() if k != member}


def _renamed(change: Callable[[str], str]) -> Change:
    return lambda members: {change(k): v for k, v in members.items()}


def _recoded(encoding: str, declared: str, *names: str) -> Change:
    def change(members: dict[str, bytes]) -> dict[str, bytes]:
        out = dict(members)
        for name in names:
            text = members[name].decode().replace('encoding="UTF-8"', f'encoding="{declared}"' if declared else "")
            out[name] = text.encode(encoding)
        return out

    return change


def _prefixed(members: dict[str, bytes]) -> dict[str, bytes]:
    """Elements with a prefix, as ClosedXML and the Open XML SDK write them."""
    out = dict(members)
    for name, content in members.items():
        if name.startswith("xl/") and name.endswith(".xml"):
            text = content.decode()
            text = re.sub(r"<(/?)(?![?!])(\w+)", r"<\1x:\2", text).replace("xmlns=", "xmlns:x=", 1)
            out[name] = text.encode()
    return out


def _strict(members: dict[str, bytes]) -> dict[str, bytes]:
    """Strict Open XML: the same elements in other name spaces."""
    pairs = {
        "http://schemas.openxmlformats.org/spreadsheetml/2006/main": "http://purl.oclc.org/ooxml/spreadsheetml/main",
        "http://schemas.openxmlformats.org/officeDocument/2006/relationships": "http://purl.oclc.org/ooxml/officeDocument/relationships",
    }
    out = {}
    for name, content in members.items():
        text = content.decode()
        for old, new in pairs.items():
            text = text.replace(old, new)
        if name == "xl/workbook.xml":
            text = text.replace("<workbook ", '<workbook conformance="strict" ')
        out[name] = text.encode()
    return out


def _files() -> None:
    damaged = {"unmappable": DAMAGED}
    sheet, texts, relations = "xl/worksheets/sheet2.xml", "xl/sharedStrings.xml", "xl/_rels/workbook.xml.rels"
    later = '<extLst><ext xmlns:x14="http://a" uri="{1}"><x14:a/></ext></extLst></worksheet>'
    media = {"xl/media/image1.png": b"\x89PNG", "customXml/item1.xml": b"<a/>", "xl/vbaProject.bin": b"\xd0\xcf"}
    for name, make in {
        "a prefix for the elements": _edited(_prefixed),
        "UTF-8 with a byte order mark": _edited(_of("xl/", lambda v: b"\xef\xbb\xbf" + v)),
        "members in another order": _edited(lambda m: dict(reversed(m.items()))),
        "targets from the root": _changed(users, (relations, 'Target="', 'Target="/xl/')),
        "indented XML": _edited(
            _of("xl/worksheets/s", lambda v: re.sub(rb"(</?row|<c |</?sheetData>)", rb"\n  \1", v))
        ),
        "single quotes": _edited(_of("xl/worksheets/sheet1.xml", lambda v: v.replace(b'"', b"'"))),
        "elements of later versions": _changed(users, (sheet, "</worksheet>", later)),
        "drawings, media and a macro part": _edited(lambda m: {**m, **media}),
        "not compressed": _bytes(lambda b: b, compression=zipfile.ZIP_STORED),
        "compressed by lzma": _bytes(lambda b: b, compression=zipfile.ZIP_LZMA),
        "a comment of the archive": _bytes(_zip_comment),
        "bytes behind the archive": _bytes(lambda b: b + b"\n" * 20),
        "64-bit sizes": _zip64,
        "folders as members": _with_folders,
    }.items():
        CASES.add(f"right: {name}", make, SCANNER, RIGHT, **damaged)
    for file, make, allowed in (
        ("scanner.xlsm", _typed_as("vnd.ms-excel.sheet.macroEnabled.main+xml"), (RIGHT,)),
        ("größe.XLSX", users, (RIGHT,)),
        ("scanner", users, READ_OR_REFUSED),
        (
            "scanner.xltx",
            _typed_as("vnd.openxmlformats-officedocument.spreadsheetml.template.main+xml"),
            READ_OR_REFUSED,
        ),
    ):
        CASES.add(f"called {file}", make, SCANNER, *allowed, place=file, file=file, unmappable=NO_WORKBOOK)
    for name, codec, declared, allowed in (
        ("UTF-16", "utf-16", "UTF-16", READ_OR_REFUSED),
        ("Latin-1", "latin-1", "ISO-8859-1", READ_OR_REFUSED),
        ("UTF-8 without saying so", "utf-8", "", (RIGHT,)),
        ("Latin-1 said to be UTF-8", "latin-1", "UTF-8", READ_OR_REFUSED),
    ):
        made = with_cells(users(), Coordinates_X2="Prüfer")
        made.edit = _recoded(codec, declared, texts, sheet, "xl/workbook.xml")
        CASES.add(f"XML in {name}", made, SCANNER, *allowed, **damaged)
    laughs = b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY x "123"><!ENTITY y "&x;&x;&x;&x;">]>'
    for member in (sheet, "xl/workbook.xml", texts):
        edit = _edited(_of(member, lambda v: laughs + v.split(b"?>\n", 1)[1]))
        CASES.add(f"entities declared in {member}", edit, SCANNER, *READ_OR_REFUSED, **damaged)
    used = _edited(_of(sheet, lambda v: (laughs + v.split(b"?>\n", 1)[1]).replace(b"<v>155.0</v>", b"<v>&x;</v>")))
    truth = scanner(np.array([SCANNER.centers[0], [123.0, 158.4, -70.9], *SCANNER.centers[2:]]))
    CASES.add("a number by an entity of its own", used, truth, REFUSED, WARNED, **damaged)
    # Strict Open XML is named.
    CASES.add("Strict Open XML", _edited(_strict), SCANNER, REFUSED, place="Strict", unmappable=NO_WORKBOOK)

    ole, none = bytes.fromhex("d0cf11e0a1b11ae1"), "not an .xlsx workbook"
    spreadsheet_ml = b'<?xml version="1.0"?><Workbook xmlns="urn:schemas-microsoft-com:office:spreadsheet"/>'
    for name, content, said in (
        ("an empty file", b"", "an empty file"),
        ("a csv file", b"No.,x1,y1,z1,d,R,Ld,Td\n1,277,70.3,-70,2.3,75,50,10\n", none),
        ("SpreadsheetML 2003", spreadsheet_ml, none),
        ("an old .xls", ole + bytes(600), "an old Excel .xls file"),
        ("a protected workbook", ole + bytes(600) + "EncryptedPackage".encode("utf-16-le"), "protected by a password"),
        ("zeros", bytes(5000), none),
        ("a Git LFS pointer", b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 25732\n", none),
        ("a zip's first bytes", b"PK\x03\x04" + bytes(50), none),
        ("an empty zip", zipped({}), "not a whole .xlsx workbook"),
        ("a Word document", zipped({"word/document.xml": b"<w/>"}), "not a whole .xlsx workbook"),
        ("OpenDocument", zipped({"mimetype": b"", "content.xml": b"<a/>"}), "an OpenDocument file"),
        ("a binary .xlsb", zipped({"xl/workbook.bin": b""}), "a binary .xlsb workbook"),
        ("a zip of the workbook", zipped({"scanner.xlsx": b"PK\x03\x04"}), "not a whole .xlsx workbook"),
    ):
        CASES.add(
            f"no workbook: {name}", lambda path, content=content: path.write_bytes(content), None, REFUSED, place=said
        )
    for part in (0.02, 0.6, 0.99):
        cut = _bytes(lambda b, part=part: b[: int(len(b) * part)])
        CASES.add(f"cut off after {part:.0%}", cut, None, REFUSED)
    CASES.add("a folder", lambda path: path.mkdir(), None, REFUSED, place="is a folder, expected an .xlsx workbook")
    lock, named = b"\x06Someone" + b" " * 100, {"place": "lock file", "file": "~$scanner.xlsx"}
    CASES.add("a lock file", lambda path: path.write_bytes(lock), None, REFUSED, **named)
    CASES.add("no file", lambda path: None, None, REFUSED, place="no such file")
    CASES.add("a flipped byte", _bytes(_flipped), None, REFUSED)
    for name, change in {
        "a sheet missing": _without(sheet),
        "the list of texts missing": _without(texts),
        "the workbook part missing": _without("xl/workbook.xml"),
        "the relations missing": _without(relations),
        "a sheet cut off": _of(sheet, lambda v: v[: len(v) // 2]),
        "a sheet of zeros": _of(sheet, lambda v: bytes(len(v))),
        "a stray &": _of(sheet, lambda v: v.replace(b"<sheetData>", b"& <sheetData>")),
        "a control character": _of(sheet, lambda v: v.replace(b"<v>155.0</v>", b"<v>155.0\x01</v>")),
        "the texts cut short": _of(texts, lambda v: v.split(b"<si>")[0] + b"</sst>"),
    }.items():
        CASES.add(f"damaged: {name}", _edited(change), None, REFUSED)
    for name, change in {
        "no types": _without("[Content_Types].xml"),
        "no root relations": _without("_rels/.rels"),
        "names with backslashes": _renamed(lambda k: k.replace("/", "\\")),
        "names in capitals": _renamed(lambda k: k.upper() if k.startswith("xl/worksheets/s") else k),
        "everything in a folder": _renamed(lambda k: f"scanner/{k}"),
        "no styles": _without("xl/styles.xml"),
        "broken styles": _of("xl/styles.xml", lambda v: b"<styleSheet"),
        "no cell styles": _of("xl/styles.xml", lambda v: re.sub(rb"<cellXfs.*</cellXfs>", b"", v)),
    }.items():
        CASES.add(f"damaged: {name}", _edited(change), SCANNER, *READ_OR_REFUSED, **damaged)
    before = _bytes(lambda b: b"#!/bin/sh\n" + b)
    CASES.add("bytes before the archive", before, SCANNER, *READ_OR_REFUSED, **damaged)
    CASES.add("a sheet twice in the archive", _twice, None, REFUSED)
    listed = _changed(users, (relations, 'Target="worksheets/sheet1.xml"', 'Target="worksheets/sheet2.xml"'))
    CASES.add("a sheet listed twice", listed, None, REFUSED)
    exchanged = _named(users(), {"Main": "Coordinates", "Coordinates": "Main"})
    for old, new in (("sheet1.xml", "#"), ("sheet2.xml", "sheet1.xml"), ("#", "sheet2.xml")):
        exchanged.replace(relations, old, new)
    CASES.add("the sheets' relations exchanged", exchanged, SCANNER, RIGHT)
    alternate = users()
    alternate.replace(
        sheet,
        '<c r="B4"><v>155.0</v></c>',
        '<mc:AlternateContent xmlns:mc="http://schemas.openxmlformats.org/markup-compatibility/2006">'
        '<mc:Choice Requires="x15"><c r="B4"><v>155.0</v></c></mc:Choice>'
        '<mc:Fallback><c r="B4"><v>255.0</v></c></mc:Fallback></mc:AlternateContent>',
    )
    CASES.add("alternatives for a cell", alternate, SCANNER, *READ_OR_REFUSED, **damaged)
    external = users()
    external.members["xl/externalLinks/externalLink1.xml"] = (
        b'<externalLink xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"/>'
    )
    CASES.add("a link to another workbook that is not used", external, SCANNER, RIGHT)


def _typed_as(kind: str) -> Book:
    made, own = users(), "vnd.openxmlformats-officedocument.spreadsheetml.sheet.main+xml"
    made.replace("[Content_Types].xml", f"application/{own}", f"application/{kind}")
    return made


def _zip_comment(content: bytes) -> bytes:
    file = io.BytesIO(content)
    with zipfile.ZipFile(file, "a") as archive:
        archive.comment = b"made by a web shop's PK library"
    return file.getvalue()


def _zip64(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members_of(users()).items():
            with archive.open(name, "w", force_zip64=True) as member:
                member.write(content)


def _with_folders(path: Path) -> None:
    path.write_bytes(zipped({"xl/": b"", "xl/worksheets/": b"", "_rels/": b"", **members_of(users())}))


def _twice(path: Path) -> None:
    members = members_of(users())
    second = members["xl/worksheets/sheet2.xml"].replace(b"<v>155.0</v>", b"<v>156.0</v>")
    with warnings.catch_warnings(), zipfile.ZipFile(path, "w") as archive:
        warnings.simplefilter("ignore")  # of the two names alike
        for name, content in members.items():
            archive.writestr(name, content)
        archive.writestr("xl/worksheets/sheet2.xml", second)


def _flipped(content: bytes) -> bytes:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        info = archive.getinfo("xl/worksheets/sheet2.xml")
    middle = info.header_offset + 60 + info.compress_size // 2
    return content[:middle] + bytes([content[middle] ^ 0x5A]) + content[middle + 1 :]


def _from_other_programs() -> None:
    """The habits of programs that write workbooks."""
    summary = {"A1": "This document was exported from Numbers.", "A3": "Numbers Sheet Name", "A4": "Sheet 1"}
    numbers = with_cells(one_sheet(BIG, top=2, sheet="Sheet 1 - Table 1"), A1="Table 1")
    numbers.sheets[0].merged.append("A1:I1")
    numbers.add("Export Summary", {**summary, "B3": "Excel Worksheet Name", "B4": "Sheet 1 - Table 1"}, first=True)
    mapped = one_sheet_map("mm", 3, 6, sheet="Sheet 1 - Table 1")
    name = "Numbers, with its title and summary"
    CASES.add(name, numbers, BIG, *READ_OR_REFUSED, place="Table 1", columns=mapped)
    google = users()
    google.calculation = ""
    google.replace("xl/workbook.xml", '<workbookPr defaultThemeVersion="166925"/>', "<workbookPr/>")
    CASES.add("Google Sheets", google, SCANNER, RIGHT)
    multi = one_sheet(BIG, top=3, sheet="Sheet1")
    multi.sheets[0].put("B1", [["mm"] * 8])
    mapped = one_sheet_map("mm", 4, 7, sheet="Sheet1")
    name = "pandas, columns of two levels, the first a unit"
    CASES.add(name, multi, BIG, *READ_OR_REFUSED, place="Sheet1", columns=mapped)
    matlab = one_sheet(BIG, sheet="Sheet1")
    matlab.sheets += [Sheet("Sheet2"), Sheet("Sheet3")]
    CASES.add("MATLAB, with empty sheets", matlab, BIG, RIGHT)
    aspose = one_sheet(BIG)
    aspose.add("Evaluation Warning", {"A1": "Evaluation Only. Created with Aspose.Cells for .NET."})
    CASES.add("Aspose, with its warning", aspose, BIG, RIGHT)
    text = rb't="s"><v>(\d+)</v>'

    def inlined(members: dict[str, bytes]) -> dict[str, bytes]:
        texts = re.findall(rb"<si>(.*?)</si>", members["xl/sharedStrings.xml"])
        sheet = members["xl/worksheets/sheet1.xml"]
        sheet = re.sub(text, lambda m: b't="inlineStr"><is>' + texts[int(m[1])] + b"</is>", sheet)
        rels = re.sub(rb'<Relationship [^>]*sharedStrings.xml"/>', b"", members["xl/_rels/workbook.xml.rels"])
        types = re.sub(rb'<Override PartName="/xl/sharedStrings.xml"[^>]*/>', b"", members["[Content_Types].xml"])
        out = {**members, "xl/worksheets/sheet1.xml": sheet, "xl/_rels/workbook.xml.rels": rels}
        return _without("xl/sharedStrings.xml")({**out, "[Content_Types].xml": types})

    def strings(members: dict[str, bytes]) -> dict[str, bytes]:
        texts = re.findall(rb"<si><t[^>]*>(.*?)</t></si>", members["xl/sharedStrings.xml"])
        told = _of("xl/worksheets/", lambda v: re.sub(text, lambda m: b't="str"><v>%b</v>' % texts[int(m[1])], v))
        return told(members)

    CASES.add("Apache POI while streaming: texts in the cells", _edited(inlined, one_sheet), BIG, RIGHT)
    CASES.add("SheetJS: texts as t=str", _edited(strings, one_sheet), BIG, RIGHT)


_sheets()
_files()
_from_other_programs()
