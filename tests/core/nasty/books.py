"""Files that are odd but valid, damaged, or no workbook."""

from __future__ import annotations

import io
import re
import warnings
import zipfile
from collections.abc import Callable

from .layouts import SCANNER, USERS, Draft, laid_out
from .sheets import Members, members_of, zipped

SHEET, TEXTS, RELATIONS = "xl/worksheets/sheet2.xml", "xl/sharedStrings.xml", "xl/_rels/workbook.xml.rels"
BOOK, TYPES = "xl/workbook.xml", "[Content_Types].xml"
KIND = "application/vnd.openxmlformats-officedocument.spreadsheetml.sheet.main+xml"
LAUGHS = b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY x "123"><!ENTITY y "&x;&x;&x;&x;">]>\n'
LATER = b'<extLst><ext xmlns:x14="http://a" uri="{1}"><x14:a/></ext></extLst></worksheet>'
ALTERNATIVES = (
    b'<mc:AlternateContent xmlns:mc="http://schemas.openxmlformats.org/markup-compatibility/2006">'
    b'<mc:Choice Requires="x15"><c r="B4"><v>155.0</v></c></mc:Choice>'
    b'<mc:Fallback><c r="B4"><v>255.0</v></c></mc:Fallback></mc:AlternateContent>'
)
STRICT = {
    b"http://schemas.openxmlformats.org/spreadsheetml/2006/main": b"http://purl.oclc.org/ooxml/spreadsheetml/main",
    b"http://schemas.openxmlformats.org/officeDocument/2006/": b"http://purl.oclc.org/ooxml/officeDocument/",
    b"<workbook ": b'<workbook conformance="strict" ',
}


def _of(member: str, change: Callable[[bytes], bytes]) -> Callable[[Members], Members]:
    """Return a change of the members whose names begin so."""
    return lambda members: {name: change(v) if name.startswith(member) else v for name, v in members.items()}


def _without(member: str) -> Callable[[Members], Members]:
    return lambda members: {name: content for name, content in members.items() if name != member}


def _renamed(change: Callable[[str], str]) -> Callable[[Members], Members]:
    return lambda members: {change(name): content for name, content in members.items()}


def _replaced(member: str, old: bytes, new: bytes) -> Callable[[Members], Members]:
    return _of(member, lambda content: content.replace(old, new))


def _recoded(encoding: str, declared: str) -> Callable[[Members], Members]:
    def change(members: Members) -> Members:
        """Store the three main members in another encoding."""
        changed = dict(members)
        for name in (TEXTS, SHEET, BOOK):
            text = members[name].decode().replace('encoding="UTF-8"', f'encoding="{declared}"' if declared else "")
            changed[name] = text.encode(encoding)
        return changed

    return change


def _prefixed(content: bytes) -> bytes:
    """Give elements a prefix, as ClosedXML and the Open XML SDK write them."""
    text = re.sub(rb"<(/?)(?![?!])(\w+)", rb"<\1x:\2", content)
    return text.replace(b"xmlns=", b"xmlns:x=", 1)


def _strict(members: Members) -> Members:
    """Write Strict Open XML: the same elements in other name spaces."""
    for old, new in STRICT.items():
        members = _replaced("", old, new)(members)
    return members


def _entities(content: bytes) -> bytes:
    return LAUGHS + content.split(b"?>\n", 1)[1]


def _inlined(members: Members) -> Members:
    """Write texts in their cells, as Apache POI does while streaming."""
    texts = re.findall(rb"<si>(.*?)</si>", members[TEXTS])
    change = _of("xl/worksheets/", lambda v: re.sub(rb't="s"><v>(\d+)</v>', lambda m: _inline(texts[int(m[1])]), v))
    members = _of(RELATIONS, lambda v: re.sub(rb'<Relationship [^>]*sharedStrings.xml"/>', b"", v))(change(members))
    return _without(TEXTS)(_of(TYPES, lambda v: re.sub(rb'<Override PartName="/xl/sharedS[^>]*/>', b"", v))(members))


def _inline(text: bytes) -> bytes:
    return b't="inlineStr"><is>' + text + b"</is>"


def _strings(members: Members) -> Members:
    """Write texts as t=str, as SheetJS does."""
    texts = re.findall(rb"<si><t[^>]*>(.*?)</t></si>", members[TEXTS])
    return _of("xl/w", lambda v: re.sub(rb't="s"><v>(\d+)<', lambda m: b't="str"><v>%b<' % texts[int(m[1])], v))(
        members
    )


def _exchanged(members: Members) -> Members:
    for old, new in ((b"sheet1.xml", b"#"), (b"sheet2.xml", b"sheet1.xml"), (b"#", b"sheet2.xml")):
        members = _replaced(RELATIONS, old, new)(members)
    return _of(
        BOOK, lambda v: v.replace(b'"Main"', b"#").replace(b'"Coordinates"', b'"Main"').replace(b"#", b'"Coordinates"')
    )(members)


def _zip_comment(content: bytes) -> bytes:
    file = io.BytesIO(content)
    with zipfile.ZipFile(file, "a") as archive:
        archive.comment = b"made by a web shop's PK library"
    return file.getvalue()


def _zip64(members: Members) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            with archive.open(name, "w", force_zip64=True) as member:
                member.write(content)
    return file.getvalue()


def _twice(members: Members) -> bytes:
    file = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(file, "w") as archive:
        warnings.simplefilter("ignore")  # of the two names alike
        for name, content in [*members.items(), (SHEET, members[SHEET].replace(b"<v>155.0</v>", b"<v>156.0</v>"))]:
            archive.writestr(name, content)
    return file.getvalue()


def _flipped(content: bytes) -> bytes:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        info = archive.getinfo(SHEET)
    middle = info.header_offset + 60 + info.compress_size // 2
    return content[:middle] + bytes([content[middle] ^ 0x5A]) + content[middle + 1 :]


# Changes of the members of the users' workbook, which a person sees the same scanner in.
RIGHT: dict[str, Callable[[Members], Members]] = {
    "as it is": lambda members: members,
    "a prefix for the elements": _of("xl/", lambda v: _prefixed(v) if v.startswith(b"<?xml") and b"/main" in v else v),
    "UTF-8 with a byte order mark": _of("xl/", lambda v: b"\xef\xbb\xbf" + v),
    "UTF-8 without saying so": _recoded("utf-8", ""),
    "members in another order": lambda members: dict(reversed(members.items())),
    "targets from the root": _replaced(RELATIONS, b'Target="', b'Target="/xl/'),
    "indented XML": _of("xl/worksheets/s", lambda v: re.sub(rb"(</?row|<c |</?sheetData>)", rb"\n  \1", v)),
    "single quotes": _of("xl/worksheets/sheet1.xml", lambda v: v.replace(b'"', b"'")),
    "elements of later versions": _replaced(SHEET, b"</worksheet>", LATER),
    "drawings, media and a macro part": lambda members: {
        **members,
        "xl/media/image1.png": b"\x89PNG",
        "xl/vbaProject.bin": b"\xd0\xcf",
        "xl/externalLinks/externalLink1.xml": b'<externalLink xmlns="http://a"/>',
    },
    "folders as members": lambda members: {"xl/": b"", "xl/worksheets/": b"", "_rels/": b"", **members},
    "the sheets' relations exchanged": _exchanged,
    "Google Sheets": _of(BOOK, lambda v: re.sub(rb"<calcPr[^>]*/>| defaultThemeVersion=\S+\"", b"", v)),
    "Apache POI while streaming": _inlined,
    "SheetJS": _strings,
    "a stated size that is too small": _replaced(SHEET, b"<sheetData>", b'<dimension ref="A1:B2"/><sheetData>'),
    "dates from 1904, none used": _replaced(BOOK, b"<workbookPr ", b'<workbookPr date1904="1" '),
    "names and a print area": _replaced(
        BOOK,
        b"</sheets>",
        b'</sheets><definedNames><definedName name="x1">Coordinates!$B$3:$B$6</definedName>'
        b'<definedName name="_xlnm.Print_Area">Coordinates!$A$1:$D$4</definedName></definedNames>',
    ),
}
READ_OR_REFUSED: dict[str, Callable[[Members], Members]] = {
    "UTF-16": _recoded("utf-16", "UTF-16"),
    "Latin-1": _recoded("latin-1", "ISO-8859-1"),
    "Latin-1 said to be UTF-8": _recoded("latin-1", "UTF-8"),
    **{f"entities declared in {member}": _of(member, _entities) for member in (SHEET, BOOK, TEXTS)},
    "no types": _without(TYPES),
    "no root relations": _without("_rels/.rels"),
    "names with backslashes": _renamed(lambda name: name.replace("/", "\\")),
    "names in capitals": _renamed(lambda name: name.upper() if name.startswith("xl/worksheets/s") else name),
    "everything in a folder": _renamed(lambda name: f"scanner/{name}"),
    "no styles": _without("xl/styles.xml"),
    "broken styles": _of("xl/styles.xml", lambda v: b"<styleSheet"),
    "no cell styles": _of("xl/styles.xml", lambda v: re.sub(rb"<cellXfs.*</cellXfs>", b"", v)),
    "alternatives for a cell": _replaced(SHEET, b'<c r="B4"><v>155.0</v></c>', ALTERNATIVES),
    "a stated size that is nonsense": _replaced(SHEET, b"<sheetData>", b'<dimension ref="foo"/><sheetData>'),
}
# Changes of the file's bytes.
RIGHT_BYTES: dict[str, Callable[[Members], bytes]] = {
    "not compressed": lambda members: zipped(members, zipfile.ZIP_STORED),
    "compressed by lzma": lambda members: zipped(members, zipfile.ZIP_LZMA),
    "a comment of the archive": lambda members: _zip_comment(zipped(members)),
    "bytes behind the archive": lambda members: zipped(members) + b"\n" * 20,
    "64-bit sizes": _zip64,
}
FILES: dict[str, tuple[Callable[[Members], bytes], bool]] = {
    **{name: (lambda members, change=change: zipped(change(members)), True) for name, change in RIGHT.items()},
    **{name: (change, True) for name, change in RIGHT_BYTES.items()},
    **{name: (lambda m, change=change: zipped(change(m)), False) for name, change in READ_OR_REFUSED.items()},
    "bytes before the archive": (lambda members: b"#!/bin/sh\n" + zipped(members), False),
}
"""The bytes of a file of the members of the users' workbook, and whether it must be read."""
NAMES = {
    "scanner.xlsm": ("application/vnd.ms-excel.sheet.macroEnabled.main+xml", True),
    "größe.XLSX": (KIND, True),
    "scanner": (KIND, False),
    "scanner.xltx": (KIND.replace("sheet.main", "template.main"), False),
}
"""The type of a workbook called so, and whether it must be read."""

OLE = bytes.fromhex("d0cf11e0a1b11ae1")
NONE, NOT_WHOLE = "not an .xlsx workbook", "not a whole .xlsx workbook"
NO_WORKBOOKS: dict[str, tuple[bytes, str]] = {
    "an empty file": (b"", "an empty file"),
    "a csv file": (b"No.,x1,y1,z1,d,R,Ld,Td\n1,277,70.3,-70,2.3,75,50,10\n", NONE),
    "SpreadsheetML 2003": (
        b'<?xml version="1.0"?><Workbook xmlns="urn:schemas-microsoft-com:office:spreadsheet"/>',
        NONE,
    ),
    "an old .xls": (OLE + bytes(600) + "Workbook".encode("utf-16-le"), "an old Excel .xls file"),
    "a protected workbook": (OLE + bytes(600) + "EncryptedPackage".encode("utf-16-le"), "protected by a password"),
    "zeros": (bytes(5000), NONE),
    "a Git LFS pointer": (b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 25732\n", NONE),
    "a zip's first bytes": (b"PK\x03\x04" + bytes(50), NONE),
    "an empty zip": (zipped({}), NOT_WHOLE),
    "a Word document": (zipped({"word/document.xml": b"<w/>"}), NOT_WHOLE),
    "OpenDocument": (zipped({"mimetype": b"", "content.xml": b"<a/>"}), "an OpenDocument file"),
    "a binary .xlsb": (zipped({"xl/workbook.bin": b""}), "a binary .xlsb workbook"),
    "a zip of the workbook": (zipped({"scanner.xlsx": b"PK\x03\x04"}), NOT_WHOLE),
}
DAMAGED: dict[str, Callable[[Members], bytes]] = {
    **{
        f"cut off after {part:.0%}": lambda m, part=part: (content := zipped(m))[: int(len(content) * part)]
        for part in (0.02, 0.6, 0.99)
    },
    "a flipped byte": lambda members: _flipped(zipped(members)),
    "a sheet twice in the archive": _twice,
    **{
        name: lambda members, change=change: zipped(change(members))
        for name, change in {
            "a sheet missing": _without(SHEET),
            "the list of texts missing": _without(TEXTS),
            "the workbook part missing": _without(BOOK),
            "the relations missing": _without(RELATIONS),
            "a sheet cut off": _of(SHEET, lambda v: v[: len(v) // 2]),
            "a sheet of zeros": _of(SHEET, lambda v: bytes(len(v))),
            "a stray &": _replaced(SHEET, b"<sheetData>", b"& <sheetData>"),
            "a control character": _replaced(SHEET, b"<v>155.0</v>", b"<v>155.0\x01</v>"),
            "the texts cut short": _of(TEXTS, lambda v: v.split(b"<si>")[0] + b"</sst>"),
            "a sheet listed twice": _replaced(RELATIONS, b'Target="worksheets/sheet1', b'Target="worksheets/sheet2'),
            "two sheets of one name": _replaced(BOOK, b'name="Main"', b'name="Coordinates"'),
            "two names that differ in case": _replaced(BOOK, b'name="Main"', b'name="COORDINATES"'),
            "Strict Open XML": _strict,
            "a number by an entity": _of(SHEET, lambda v: _entities(v).replace(b"<v>155.0</v>", b"<v>&x;</v>")),
        }.items()
    },
}
WORDS = {"Strict Open XML": "Strict"}
"""Words of the refusal of a damaged file, beside its name."""


def users_file() -> tuple[Draft, Members]:
    """Return the users' workbook, with a letter beyond ASCII in it, and the members of its file."""
    draft = laid_out(USERS, SCANNER)
    draft.mappable = False  # no map helps where the file is damaged
    draft.book["Coordinates"]["X2"] = "Prüfer"
    return draft, members_of(draft.book)
