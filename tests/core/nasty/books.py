"""Sheets and files: which sheet is meant, and files that are no workbook, damaged, or odd but valid."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from .case import REFUSED, RIGHT, WARNED, Catalogue
from .scanners import BIG, SCANNER, column_map, one_sheet, one_sheet_map, scanner, typed, users, users_map
from .sheets import Book, Formula, Sheet, members_of, zipped

CASES = Catalogue("books")
FILE = ("scanner.xlsx",)
NO_WORKBOOK = "it has to be saved as .xlsx first"
DAMAGED = "the file is damaged"
OTHER = scanner(BIG.centers * 1.02, 4.2, 151.0, 121.0, 21.0)


def _named(book: Book, names: dict[str, str]) -> Book:
    for sheet in book.sheets:
        sheet.name = names.get(sheet.name, sheet.name)
    return book


def _copies(first: str, second: str, hidden: str = "", state: str = "hidden") -> Book:
    """Two sheets with a whole table each, of two scanners."""
    book = one_sheet(BIG, sheet=first)
    book.sheets.append(one_sheet(OTHER, sheet=second).sheets[0])
    for sheet in book.sheets:
        if sheet.name == hidden:
            sheet.state = state
    return book


def _sheets() -> None:
    for first, second in (
        *(("Geometry", "Geometry (2)"), ("Coordinates", "Coordinates old"), ("nominal", "measured")),
        *(("Coordinates", "MDSL cloud import"), ("Geometry", "Values")),
    ):
        # The users' own sheet beside their Coordinates: a person knows which is meant.
        known = (RIGHT,) if second == "MDSL cloud import" else ()
        CASES.add(
            f"tables in {first!r} and {second!r}",
            _copies(first, second),
            BIG,
            *known,
            REFUSED,
            place=(first, second),
            columns=one_sheet_map(sheet=first),
        )
        if not known:
            CASES.add(
                f"tables in {first!r} and {second!r}, the second is meant",
                _copies(first, second),
                OTHER,
                REFUSED,
                place=(first, second),
                columns=one_sheet_map(sheet=second),
            )
        for state in ("hidden", "veryHidden"):
            for hidden, truth, shown in ((first, OTHER, second), (second, BIG, first)):
                CASES.add(
                    f"tables in {first!r} and {second!r}, {hidden!r} is {state}",
                    _copies(first, second, hidden, state),
                    truth,
                    *(known if hidden == second else ()),
                    REFUSED,
                    place=(first, second),
                    columns=one_sheet_map(sheet=shown),
                )
    for state in ("hidden", "veryHidden"):
        made = one_sheet(BIG)
        made.sheets[0].state = state
        made.add("Notes", {"A1": "see me"}, first=True)
        CASES.add(
            f"the only table is in a sheet that is {state}",
            made,
            BIG,
            RIGHT,
            WARNED,
            REFUSED,
            place=("Geometry",),
            columns=one_sheet_map(),
        )
        for name in ("Main", "Coordinates"):
            made = users()
            made[name].state = state
            CASES.add(
                f"users' {name} is {state}", made, SCANNER, RIGHT, WARNED, REFUSED, place=(name,), columns=users_map()
            )
            made = users()
            copied = users(OTHER)[name]
            copied.name, copied.state = name + " old", state
            made.sheets.append(copied)
            CASES.add(f"a {state} older {name} as well", made, SCANNER, REFUSED, place=(name,), columns=users_map())
    for name in ("Main", "Coordinates"):
        for other in (f"{name} (2)", "Values"):
            made = users()
            copied = users(scanner(SCANNER.centers * 1.02, 2.4, 76.0, 51.0, 11.0))[name]
            copied.name = other
            made.sheets.append(copied)
            known = (RIGHT,) if other == "Values" else ()  # the users' own sheet in addition to the two
            CASES.add(
                f"{other!r} is a copy of {name} of other numbers",
                made,
                SCANNER,
                *known,
                REFUSED,
                place=(name, other),
                columns=users_map(),
            )
    same = users()
    copied = users()["Coordinates"]
    copied.name = "Coordinates (2)"
    same.sheets.append(copied)
    CASES.add(
        "a copy of Coordinates of the same numbers",
        same,
        SCANNER,
        RIGHT,
        REFUSED,
        place=("Coordinates",),
        columns=users_map(),
    )
    both = users()
    for i in range(4):
        both["Coordinates"].put("Y1", [["d"], ["diameter of pinhole"]])
        both["Coordinates"][f"Y{3 + i}"] = 3.0
    CASES.add(
        "d in Main and, another, in Coordinates",
        both,
        SCANNER,
        REFUSED,
        place=("Main", "Coordinates"),
        columns=users_map(),
    )
    linked = users()
    for i in range(4):
        linked["Coordinates"].put("Y1", [["d"], ["diameter of pinhole"]])
        linked["Coordinates"][f"Y{3 + i}"] = Formula(f"Main!P{3 + i}", 2.3)
    CASES.add(
        "d in Main and, the same by formula, in Coordinates",
        linked,
        SCANNER,
        RIGHT,
        REFUSED,
        place=("Main", "Coordinates"),
        columns=users_map(),
    )
    third = users()
    third.add("Design Table").put("A1", [["d", "R", "sensitivity"], [4.0, 90.0, 1e-4]])
    CASES.add(
        "another d and R in Design Table",
        third,
        SCANNER,
        RIGHT,
        REFUSED,
        place=("Main", "Design Table"),
        columns=users_map(),
    )
    # Sheets that the users' workbook has in addition to the two.
    for name, cells in {
        "Theta": {"A1": "theta", "A2": 0.1, "B1": "sin", "B2": Formula("SIN(A2)", 0.09983341664682815)},
        "Values": {"A1": "quantity", "B1": "value", "A2": "b", "B2": 250.0, "A3": "magnification", "B3": 3.2},
        "Design Table": {"A1": "case", "B1": "FWHM (mm)", "A2": "I", "B2": 4.4, "A3": "II", "B3": 5.1},
        "MDSL cloud import": {"A1": 277.0, "B1": 70.3, "C1": -70.0, "A2": 155.0, "B2": 158.4, "C2": -70.9},
        "Units": {"A1": "This sheet", "A2": "sensitivity", "B2": "cps/MBq", "A3": "rod", "B3": "cm"},
        "README": {"A1": "Made by J. Smith", "A2": "Do not sort the rows."},
        "Chart data": {"A1": "x", "B1": "y", "A2": 1.0, "B2": 2.0},
        "empty": {},
        "Größen & mehr": {"A1": "ä"},
        "a'b": {"A1": 1.0},
        "=1+1": {"A1": 1.0},
        "#REF!": {"A1": 1.0},
    }.items():
        for first in (True, False):
            made = users()
            made.add(name, cells, first)
            CASES.add(f"a sheet {name!r} {'before' if first else 'behind'} the users'", made, SCANNER, RIGHT)
    many = users()
    for n in range(40):
        many.add(f"plot {n}", {"A1": n, "A2": "counts"})
    CASES.add("forty more sheets", many, SCANNER, RIGHT)
    for names in (
        {"Main": "Größen", "Coordinates": "Lage"},
        {"Main": "main", "Coordinates": "COORDINATES"},
        {"Main": " Main ", "Coordinates": "Coordinates "},
        {"Main": "Coordinates", "Coordinates": "Main"},
        {"Main": "a" * 31, "Coordinates": "b" * 31},
    ):
        made = _named(typed(users()), names)
        mapped = users_map(position={"sheet": names["Coordinates"]}, dimensions={"sheet": names["Main"]})
        allowed = (RIGHT,) if names["Main"] != "Coordinates" else (RIGHT, REFUSED)
        CASES.add(
            f"sheets called {names['Main']!r} and {names['Coordinates']!r}",
            made,
            SCANNER,
            *allowed,
            place=FILE,
            columns=mapped,
        )
    alike = _copies("Geometry", "geometry")
    CASES.add("two sheets whose names differ in case alone", alike, None, REFUSED, place=("eometry",))
    alike = _copies("Geometry", "Other")
    alike.replace("xl/workbook.xml", 'name="Other"', 'name="Geometry"')
    CASES.add("two sheets of one name", alike, None, REFUSED, place=("Geometry", "scanner.xlsx"))
    rings = Book([])
    for n, half in enumerate((slice(0, 2), slice(2, 4)), start=1):
        rings.sheets.append(one_sheet(BIG[half], sheet=f"Ring {n}").sheets[0])
    CASES.add("a sheet for each ring", rings, BIG, REFUSED, place=("Ring",), unmappable="a map joins columns, not rows")
    split = one_sheet(BIG)
    other = split.add("Geometry part 2")
    for column in "DEFGHI":
        for row in range(1, 6):
            other[f"{column}{row}"] = split.sheets[0].cells.pop(f"{column}{row}")
    CASES.add(
        "z1 in another sheet",
        split,
        BIG,
        RIGHT,
        REFUSED,
        place=FILE,
        unmappable="a map's first table holds x1, y1 and z1",
    )
    three = users()
    crystal = three.add("Crystal")
    for column in "ST":
        for row in range(1, 7):
            crystal[f"{column}{row}"] = three["Main"].cells.pop(f"{column}{row}", None)
    for row in range(3, 7):
        crystal[f"A{row}"] = row - 2
    typed(three)
    mapped = column_map(
        {
            "sheet": "Coordinates",
            "first_row": 3,
            "last_row": 6,
            "number": "A",
            "columns": {"x1": ("B", "mm"), "y1": ("C", "mm"), "z1": ("D", "mm"), "l": ("G", "mm")},
        },
        {
            "sheet": "Main",
            "first_row": 3,
            "last_row": 6,
            "rows": "by number",
            "number": "A",
            "columns": {"d": ("P", "mm"), "R": ("Q", "mm")},
        },
        {
            "sheet": "Crystal",
            "first_row": 3,
            "last_row": 6,
            "rows": "by number",
            "number": "A",
            "columns": {"Ld": ("S", "mm"), "Td": ("T", "mm")},
        },
    )
    CASES.add("Ld and Td in a third sheet", three, SCANNER, RIGHT, REFUSED, place=FILE, columns=mapped)
    reference = users()
    reference.names["x1"] = "Coordinates!$B$3:$B$6"
    reference.names["_xlnm.Print_Area"] = "Coordinates!$A$1:$D$4"
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
    right = {
        "a prefix for the elements": _edited(_prefixed),
        "UTF-8 with a byte order mark": _edited(
            lambda m: {k: b"\xef\xbb\xbf" + v if k.startswith("xl/") else v for k, v in m.items()}
        ),
        "members in another order": _edited(lambda m: dict(reversed(m.items()))),
        "targets from the root": _changed(users, ("xl/_rels/workbook.xml.rels", 'Target="', 'Target="/xl/')),
        "other relations' names": _edited(
            lambda m: {
                k: v.replace(b'"rId1"', b'"R7a"') if k in ("xl/workbook.xml", "xl/_rels/workbook.xml.rels") else v
                for k, v in m.items()
            }
        ),
        "indented XML": _edited(
            lambda m: {
                k: re.sub(rb"(<row|<c |</row>|<sheetData>|</sheetData>)", rb"\n  \1", v)
                if "sheet" in k and k.startswith("xl/worksheets/s")
                else v
                for k, v in m.items()
            }
        ),
        "single quotes": _edited(
            lambda m: {k: v.replace(b'"', b"'") if k == "xl/worksheets/sheet1.xml" else v for k, v in m.items()}
        ),
        "elements of later versions": _changed(
            users,
            (
                "xl/worksheets/sheet2.xml",
                "</worksheet>",
                '<extLst><ext xmlns:x14="http://a" uri="{1}"><x14:a/></ext></extLst></worksheet>',
            ),
        ),
        "drawings and media": _edited(
            lambda m: {
                **m,
                "xl/media/image1.png": b"\x89PNG",
                "docProps/app.xml": b"<Properties/>",
                "customXml/item1.xml": b"<a/>",
            }
        ),
        "no styles": _edited(
            lambda m: {
                k: re.sub(rb'<Relationship [^>]*"styles.xml"/>', b"", v) for k, v in m.items() if k != "xl/styles.xml"
            }
        ),
        "a macro part": _edited(lambda m: {**m, "xl/vbaProject.bin": b"\xd0\xcf"}),
    }
    for name, make in right.items():
        allowed = (RIGHT, REFUSED) if name in ("no styles", "a byte order mark") else (RIGHT,)
        CASES.add(f"right: {name}", make, SCANNER, *allowed, place=FILE, unmappable=DAMAGED)
    for name, make in {
        "not compressed": _bytes(lambda b: b, compression=zipfile.ZIP_STORED),
        "compressed by bzip2": _bytes(lambda b: b, compression=zipfile.ZIP_BZIP2),
        "compressed by lzma": _bytes(lambda b: b, compression=zipfile.ZIP_LZMA),
        "a comment of the archive": _bytes(_zip_comment),
        "bytes before the archive": _bytes(lambda b: b"#!/bin/sh\n" + b),
        "bytes behind the archive": _bytes(lambda b: b + b"\n" * 20),
        "64-bit sizes": lambda path: _zip64(path),
        "folders as members": lambda path: _with_folders(path),
    }.items():
        CASES.add(
            f"right: {name}",
            make,
            SCANNER,
            *([RIGHT] if name != "bytes before the archive" else [RIGHT, REFUSED]),
            place=FILE,
            unmappable=DAMAGED,
        )
    for file in (
        "scanner.xlsm",
        "scanner.XLSX",
        "größe.xlsx",
        "scanner.tmp",
        "scanner",
        "scanner.xltx",
    ):
        make = users if file not in ("scanner.xlsm", "scanner.xltx") else _typed_as(file[-4:])
        CASES.add(
            f"called {file}",
            make,
            SCANNER,
            *([RIGHT] if "xlsx" in file.lower() or "xlsm" in file else [RIGHT, REFUSED]),
            place=(file,),
            file=file,
            unmappable=NO_WORKBOOK,
        )
    for name, codec, declared in (
        ("UTF-16", "utf-16", "UTF-16"),
        ("Latin-1", "latin-1", "ISO-8859-1"),
        ("UTF-8 without saying so", "utf-8", ""),
        ("ASCII", "ascii", "US-ASCII"),
        ("Latin-1 said to be UTF-8", "latin-1", "UTF-8"),
    ):

        def recoded(codec: str = codec, declared: str = declared) -> Book:
            made = users()
            made["Coordinates"]["X2"] = "Prüfer" if codec != "ascii" else "checker"
            made.edit = _recoded(codec, declared, "xl/sharedStrings.xml", "xl/worksheets/sheet2.xml", "xl/workbook.xml")
            return made

        CASES.add(
            f"XML in {name}",
            recoded,
            SCANNER,
            *([RIGHT] if "UTF-8 w" in name or name == "ASCII" else [RIGHT, REFUSED]),
            place=FILE,
            unmappable=DAMAGED,
        )
    laughs = '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY x "123"><!ENTITY y "&x;&x;&x;&x;">]>'
    for name, member in (
        ("sheet", "xl/worksheets/sheet2.xml"),
        ("workbook", "xl/workbook.xml"),
        ("texts", "xl/sharedStrings.xml"),
    ):
        CASES.add(
            f"entities declared in the {name}",
            _edited(
                lambda m, member=member: {
                    k: laughs.encode() + v.split(b"?>\n", 1)[1] if k == member else v for k, v in m.items()
                }
            ),
            SCANNER,
            RIGHT,
            REFUSED,
            place=FILE,
            unmappable=DAMAGED,
        )
    used = _edited(
        lambda m: {
            k: (laughs.encode() + v.split(b"?>\n", 1)[1]).replace(b"<v>155.0</v>", b"<v>&x;</v>")
            if k == "xl/worksheets/sheet2.xml"
            else v
            for k, v in m.items()
        }
    )
    CASES.add(
        "a number by an entity of its own",
        used,
        scanner(np.array([SCANNER.centers[0], [123.0, 158.4, -70.9], *SCANNER.centers[2:]])),
        REFUSED,
        WARNED,
        place=FILE,
        unmappable=DAMAGED,
    )

    # Strict Open XML is named.
    CASES.add("Strict Open XML", _edited(_strict), SCANNER, REFUSED, place=("Strict",), unmappable=NO_WORKBOOK)
    CASES.add(
        "Strict Open XML, one sheet",
        _edited(_strict, lambda: one_sheet(BIG)),
        BIG,
        REFUSED,
        place=("Strict",),
        unmappable=NO_WORKBOOK,
    )

    csv = "No.,x1,y1,z1,d,R,Ld,Td\n1,277,70.3,-70,2.3,75,50,10\n"
    ole = bytes.fromhex("d0cf11e0a1b11ae1")
    for name, content in {
        "an empty file": b"",
        "a csv file": csv.encode(),
        "an HTML page": b"<html><table><tr><td>x1</td></tr></table></html>",
        "SpreadsheetML 2003": b'<?xml version="1.0"?><Workbook xmlns="urn:schemas-microsoft-com:office:spreadsheet"/>',
        "a flat OpenDocument": b'<o:document xmlns:o="urn:oasis:names:tc:opendocument:xmlns:office:1.0"/>',
        "an old .xls": ole + bytes(600),
        "a protected workbook": ole + bytes(600) + "EncryptedPackage".encode("utf-16-le"),
        "zeros": bytes(5000),
        "a picture": b"\x89PNG\r\n\x1a\n" + bytes(100),
        "a Git LFS pointer": b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 25732\n",
        "a zip's first bytes": b"PK\x03\x04" + bytes(50),
        "an empty zip": zipped({}),
        "a Word document": zipped({"[Content_Types].xml": b"<Types/>", "word/document.xml": b"<w/>"}),
        "OpenDocument": zipped({"mimetype": b"application/vnd.oasis.opendocument.spreadsheet", "content.xml": b"<a/>"}),
        "a binary .xlsb": zipped({"[Content_Types].xml": b"<Types/>", "xl/workbook.bin": b""}),
        "a zip of the workbook": zipped({"scanner.xlsx": b"PK\x03\x04"}),
    }.items():
        CASES.add(
            f"no workbook: {name}", lambda path, content=content: path.write_bytes(content), None, REFUSED, place=FILE
        )
    for part in (0.02, 0.6, 0.99):
        CASES.add(
            f"cut off after {part:.0%}", _bytes(lambda b, part=part: b[: int(len(b) * part)]), None, REFUSED, place=FILE
        )
    CASES.add("a folder", lambda path: path.mkdir(), None, REFUSED, place=FILE)
    lock = b"\x06Someone" + b" " * 100
    CASES.add(
        "a lock file", lambda path: path.write_bytes(lock), None, REFUSED, place="lock file", file="~$scanner.xlsx"
    )
    CASES.add("no file", lambda path: None, None, REFUSED, place=FILE)
    CASES.add("a flipped byte", _bytes(_flipped), None, REFUSED, place=FILE)
    sheet = "xl/worksheets/sheet2.xml"
    for name, change in {
        "a sheet missing": lambda m: {k: v for k, v in m.items() if k != sheet},
        "the list of texts missing": lambda m: {k: v for k, v in m.items() if k != "xl/sharedStrings.xml"},
        "the workbook part missing": lambda m: {k: v for k, v in m.items() if k != "xl/workbook.xml"},
        "the relations missing": lambda m: {k: v for k, v in m.items() if k != "xl/_rels/workbook.xml.rels"},
        "a sheet cut off": lambda m: {**m, sheet: m[sheet][: len(m[sheet]) // 2]},
        "a sheet of zeros": lambda m: {**m, sheet: bytes(len(m[sheet]))},
        "a stray &": lambda m: {**m, sheet: m[sheet].replace(b"<sheetData>", b"& <sheetData>")},
        "a control character": lambda m: {**m, sheet: m[sheet].replace(b"<v>155.0</v>", b"<v>155.0\x01</v>")},
        "the texts cut short": lambda m: {
            **m,
            "xl/sharedStrings.xml": m["xl/sharedStrings.xml"].split(b"<si>")[0] + b"</sst>",
        },
    }.items():
        CASES.add(f"damaged: {name}", _edited(change), None, REFUSED, place=FILE)
    for name, change in {
        "no types": lambda m: {k: v for k, v in m.items() if k != "[Content_Types].xml"},
        "no root relations": lambda m: {k: v for k, v in m.items() if k != "_rels/.rels"},
        "names with backslashes": lambda m: {k.replace("/", "\\"): v for k, v in m.items()},
        "names in capitals": lambda m: {k.upper() if k.startswith("xl/worksheets/s") else k: v for k, v in m.items()},
        "names from the root": lambda m: {f"/{k}": v for k, v in m.items()},
        "everything in a folder": lambda m: {f"scanner/{k}": v for k, v in m.items()},
        "broken styles": lambda m: {**m, "xl/styles.xml": b"<styleSheet"},
        "no cell styles": lambda m: {**m, "xl/styles.xml": re.sub(rb"<cellXfs.*</cellXfs>", b"", m["xl/styles.xml"])},
    }.items():
        CASES.add(f"damaged: {name}", _edited(change), SCANNER, RIGHT, REFUSED, place=FILE, unmappable=DAMAGED)
    CASES.add("a sheet twice in the archive", lambda path: _twice(path), None, REFUSED, place=FILE)
    CASES.add(
        "a sheet listed twice",
        _changed(
            users, ("xl/_rels/workbook.xml.rels", 'Target="worksheets/sheet1.xml"', 'Target="worksheets/sheet2.xml"')
        ),
        None,
        REFUSED,
        place=FILE,
    )
    CASES.add(
        "the sheets' relations exchanged",
        _edited(
            lambda m: {
                k: v.replace(b"sheet1.xml", b"#").replace(b"sheet2.xml", b"sheet1.xml").replace(b"#", b"sheet2.xml")
                if k == "xl/_rels/workbook.xml.rels"
                else v
                for k, v in m.items()
            },
            lambda: _named(users(), {"Main": "Coordinates", "Coordinates": "Main"}),
        ),
        SCANNER,
        RIGHT,
    )
    alternate = users()
    alternate.replace(
        "xl/worksheets/sheet2.xml",
        '<c r="B4"><v>155.0</v></c>',
        '<mc:AlternateContent xmlns:mc="http://schemas.openxmlformats.org/markup-compatibility/2006">'
        '<mc:Choice Requires="x15"><c r="B4"><v>155.0</v></c></mc:Choice>'
        '<mc:Fallback><c r="B4"><v>255.0</v></c></mc:Fallback></mc:AlternateContent>',
    )
    CASES.add("alternatives for a cell", alternate, SCANNER, RIGHT, REFUSED, place=FILE, unmappable=DAMAGED)
    external = users()
    external.members["xl/externalLinks/externalLink1.xml"] = (
        b'<externalLink xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"/>'
    )
    CASES.add("a link to another workbook that is not used", external, SCANNER, RIGHT)


def _typed_as(kind: str) -> Callable[[], Book]:
    name = {
        "xlsm": "application/vnd.ms-excel.sheet.macroEnabled.main+xml",
        "xltx": "application/vnd.openxmlformats-officedocument.spreadsheetml.template.main+xml",
    }[kind]

    def make() -> Book:
        made = users()
        made.replace(
            "[Content_Types].xml", "application/vnd.openxmlformats-officedocument.spreadsheetml.sheet.main+xml", name
        )
        return made

    return make


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
    import warnings

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
    numbers = Book(
        [
            Sheet(
                "Export Summary",
                {
                    "A1": "This document was exported from Numbers.",
                    "A3": "Numbers Sheet Name",
                    "B3": "Excel Worksheet Name",
                    "A4": "Sheet 1",
                    "B4": "Sheet 1 - Table 1",
                },
            )
        ]
    )
    table = one_sheet(BIG, top=2, sheet="Sheet 1 - Table 1").sheets[0]
    table["A1"] = "Table 1"
    table.merged.append("A1:I1")
    numbers.sheets.append(table)
    CASES.add(
        "Numbers, with its title and summary",
        numbers,
        BIG,
        RIGHT,
        REFUSED,
        place=("Table 1",),
        columns=one_sheet_map("mm", 3, 6, sheet="Sheet 1 - Table 1"),
    )
    google = users()
    google.calculation = ""
    google.replace("xl/workbook.xml", '<workbookPr defaultThemeVersion="166925"/>', "<workbookPr/>")
    CASES.add("Google Sheets", google, SCANNER, RIGHT)
    pandas = one_sheet(BIG, number="", sheet="Sheet1")
    for i in range(4):
        pandas.sheets[0][f"A{2 + i}"] = i
    CASES.add(
        "pandas", pandas, BIG, RIGHT, REFUSED, place=("Sheet1",), columns=one_sheet_map(sheet="Sheet1"), numbered=False
    )
    multi = one_sheet(BIG, top=3, sheet="Sheet1")
    multi.sheets[0].put("B1", [["mm"] * 8])
    CASES.add(
        "pandas, columns of two levels, the first a unit",
        multi,
        BIG,
        RIGHT,
        REFUSED,
        place=("Sheet1",),
        columns=one_sheet_map("mm", 4, 7, sheet="Sheet1"),
    )
    matlab = one_sheet(BIG, sheet="Sheet1")
    matlab.sheets.append(Sheet("Sheet2"))
    matlab.sheets.append(Sheet("Sheet3"))
    CASES.add("MATLAB, with empty sheets", matlab, BIG, RIGHT)
    aspose = one_sheet(BIG)
    aspose.add("Evaluation Warning", {"A1": "Evaluation Only. Created with Aspose.Cells for .NET."})
    CASES.add("Aspose, with its warning", aspose, BIG, RIGHT)
    inline = one_sheet(BIG)

    def inlined(members: dict[str, bytes]) -> dict[str, bytes]:
        texts = re.findall(rb"<si>(.*?)</si>", members["xl/sharedStrings.xml"])
        sheet = members["xl/worksheets/sheet1.xml"]
        sheet = re.sub(rb't="s"><v>(\d+)</v>', lambda m: b't="inlineStr"><is>' + texts[int(m[1])] + b"</is>", sheet)
        rels = re.sub(rb'<Relationship [^>]*sharedStrings.xml"/>', b"", members["xl/_rels/workbook.xml.rels"])
        types = re.sub(rb'<Override PartName="/xl/sharedStrings.xml"[^>]*/>', b"", members["[Content_Types].xml"])
        out = {**members, "xl/worksheets/sheet1.xml": sheet, "xl/_rels/workbook.xml.rels": rels}
        out["[Content_Types].xml"] = types
        out.pop("xl/sharedStrings.xml")
        return out

    inline.edit = inlined
    CASES.add("Apache POI while streaming: texts in the cells", inline, BIG, RIGHT)
    sheetjs = one_sheet(BIG)
    sheetjs.edit = lambda members: {
        name: re.sub(
            rb't="s"><v>(\d+)</v>',
            lambda m: (
                b't="str"><v>'
                + re.findall(rb"<si><t[^>]*>(.*?)</t></si>", members["xl/sharedStrings.xml"])[int(m[1])]
                + b"</v>"
            ),
            content,
        )
        if name.endswith("sheet1.xml")
        else content
        for name, content in members.items()
    }
    CASES.add("SheetJS: texts as t=str", sheetjs, BIG, RIGHT)


_sheets()
_files()
_from_other_programs()
