"""A workbook's zip archive and the XML in it, of which a few bytes can be replaced and all others kept."""

from __future__ import annotations

import copy
import io
import posixpath
import re
import warnings
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any
from xml.parsers import expat
from xml.sax.saxutils import escape

from ..errors import InputError
from ..memory import readable_size

MAX_PART_BYTES = 128 * 2**20
"""The largest part, unpacked: a sheet of 100 000 rows of 20 columns takes 80 MiB."""
CONTENT_TYPES = "[Content_Types].xml"
_START_TAG = re.compile(rb"""<(?:[^>"']|"[^"]*"|'[^']*')*>""")


@dataclass(slots=True, eq=False)
class Element:
    """An XML element and the place of its bytes.

    `start`, `inner`, `close` and `end` are the offsets of the start tag, of the content, of the end tag, and of what
    follows; in an empty element without end tag, the last three are the same. The key of an attribute with a prefix is
    "namespace name"; `text` is without that of the `children`.
    """

    name: str
    namespace: str
    attributes: dict[str, str]
    parent: Element | None
    start: int
    inner: int
    close: int
    end: int
    text: str = ""
    children: list[Element] = field(default_factory=list)


class Package:
    """The members of a workbook file with these bytes; messages call it `name`."""

    def __init__(self, content: bytes, name: str) -> None:
        self.name = name
        self.content = content
        self._archive = zipfile.ZipFile(io.BytesIO(content))
        self._members = {info.filename.casefold(): info for info in self._archive.infolist()}
        self.names = [info.filename for info in self._members.values()]

    def read(self, name: str) -> bytes:
        """A member's bytes; `InputError` if it is missing or damaged."""
        info = self._members.get(name.casefold())
        if info is None:
            raise InputError(f"{self.name}: not a whole .xlsx workbook (it has no {name})")
        if info.file_size > MAX_PART_BYTES:
            size, most = readable_size(info.file_size), readable_size(MAX_PART_BYTES)
            raise InputError(f"{self.name}: its part {name} unpacks to {size}, expected at most {most}")
        try:
            with self._archive.open(info) as part:
                return part.read(info.file_size + 1)  # no more is unpacked than the archive says; then its CRC is wrong
        except Exception as error:  # zlib.error, zipfile.BadZipFile and their like have no common name
            raise InputError(f"{self.name}: its part {name} is damaged or cannot be read ({error})") from error

    def elements(self, name: str) -> list[Element]:
        """The XML elements of a member."""
        return elements(self.read(name), f"{self.name}: {name}")

    def relations(self, part: str) -> list[tuple[str, str, str]]:
        """(id, last word of the type, member) of what `part` ("" for the package) refers to inside the package."""
        name = relations_part(part)
        if name.casefold() not in self._members:
            return []
        return [
            (e.attributes.get("Id", ""), e.attributes.get("Type", "").rpartition("/")[2], _target(part, e.attributes))
            for e in self.elements(name)
            if e.name == "Relationship" and e.attributes.get("TargetMode") != "External"
        ]

    def content_type(self, part: str) -> str:
        """The content type of a member."""
        types = {}
        for e in self.elements(CONTENT_TYPES):
            key = e.attributes.get("PartName", "").lstrip("/") or f".{e.attributes.get('Extension', '')}"
            types[key.casefold()] = e.attributes.get("ContentType", "")
        return types.get(part.casefold()) or types.get(f".{part.rpartition('.')[2].casefold()}", "")

    def with_parts(self, parts: dict[str, bytes], removed: Iterable[str] = (), owner: str = "") -> bytes:
        """The archive with other bytes for `parts`, new ones last, without the `removed` members that `owner` refers to.

        All other members keep their bytes, order, dates and attributes.
        """
        new_data = {part.casefold(): data for part, data in parts.items()}
        gone = {part.casefold() for part in removed}
        if gone:
            for name, element, target in (
                (relations_part(owner), "Relationship", lambda attributes: _target(owner, attributes)),
                (CONTENT_TYPES, "Override", lambda attributes: attributes.get("PartName", "").lstrip("/")),
            ):
                named = [e for e in self.elements(name) if e.name == element]
                changes = [(e.start, e.end, b"") for e in named if target(e.attributes).casefold() in gone]
                new_data[name.casefold()] = spliced(self.read(name), changes)
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w") as new, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # zipfile's, about names that occur twice
            new.comment = self._archive.comment
            for info in self._archive.infolist():
                if (key := info.filename.casefold()) in gone:
                    continue
                member = copy.copy(info)
                new.writestr(member, new_data[key] if key in new_data else self._archive.read(info))
                member.external_attr = info.external_attr  # zipfile makes a file mode of 0
            for part in [part for part in new_data if part.casefold() not in self._members]:
                new.writestr(zipfile.ZipInfo(part), new_data[part], zipfile.ZIP_DEFLATED)
        return out.getvalue()

    def with_last(self, name: str, parent: str, element: str, /, **attributes: str) -> bytes:
        """A member's XML with one more element at the end of the first one called `parent`, and in its namespace."""
        data = self.read(name)
        found = next((e for e in self.elements(name) if e.name == parent and e.end > e.inner), None)
        if found is None:
            raise InputError(f"{self.name}: its part {name} has no {parent}, expected one that a sheet can be added to")
        given = {"xmlns": found.namespace, **{key.replace("_", ":"): value for key, value in attributes.items()}}
        text = b"".join(b' %b="%b"' % (key.encode(), escaped(value)) for key, value in given.items())
        return spliced(data, [(found.close, found.close, b"<%b%b/>" % (element.encode(), text))])


def relations_part(part: str) -> str:
    """The member that lists what a member refers to."""
    folder, base = posixpath.split(part)
    return posixpath.join(folder, "_rels", f"{base}.rels")


def _target(part: str, attributes: dict[str, str]) -> str:
    """The member that a relationship of `part` points to."""
    target = attributes.get("Target", "")
    path = target[1:] if target.startswith("/") else posixpath.join(posixpath.dirname(part), target)
    return re.sub(r"^(\.\./)+", "", posixpath.normpath(path))


def elements(data: bytes, name: str) -> list[Element]:
    """All elements of UTF-8 `data` in document order; `InputError`, which names `name`, if it is malformed."""
    parser = expat.ParserCreate("utf-8", " ")
    parser.buffer_text = True
    found: list[Element] = []
    opened: list[Element] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        at = parser.CurrentByteIndex
        match = _START_TAG.match(data, at)
        assert match is not None, "the parser has seen a whole tag here"
        namespace, _, local = tag.rpartition(" ")
        parent, inner = opened[-1] if opened else None, match.end()
        found.append(Element(local, namespace, attributes, parent, at, inner, inner, inner))
        opened.append(found[-1])
        if parent is not None:
            parent.children.append(found[-1])

    def end(_tag: str) -> None:
        element = opened.pop()
        if not data.endswith(b"/>", element.start, element.inner):
            element.close = parser.CurrentByteIndex
            element.end = data.index(b">", element.close) + 1

    def text(characters: str) -> None:
        opened[-1].text += characters

    def doctype(*_: Any) -> None:
        raise InputError(f"{name}: has a document type, expected none in a workbook")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = text, doctype
    try:
        data.decode()  # a byte order mark may tell the parser of another encoding
        parser.Parse(data, True)
    except (UnicodeDecodeError, expat.ExpatError) as error:
        raise InputError(f"{name}: not readable XML ({error})") from error
    return found


def spliced(data: bytes, changes: list[tuple[int, int, bytes]]) -> bytes:
    """`data` with the bytes from start to end replaced by others, for each of `changes`: (start, end, new bytes)."""
    pieces, at = [], 0
    for start, end, new in sorted(changes, key=lambda change: change[:2]):
        pieces += [data[at:start], new]
        at = end
    return b"".join([*pieces, data[at:]])


def with_attribute(tag: bytes, name: str, value: str | None) -> bytes:
    """A start tag with another value of an attribute without prefix; None removes the attribute."""
    attribute = re.compile(rb"""\s+%b\s*=\s*("[^"]*"|'[^']*')""" % name.encode())
    if value is None:
        return attribute.sub(b"", tag, count=1)
    new = b' %b="%b"' % (name.encode(), escaped(value))
    if attribute.search(tag):
        return attribute.sub(lambda _: new, tag, count=1)
    end = len(tag) - (2 if tag.endswith(b"/>") else 1)
    return tag[:end].rstrip() + new + tag[end:]


def escaped(text: str) -> bytes:
    """Text for an element or a quoted attribute."""
    return escape(text, {'"': "&quot;"}).encode("ascii", "xmlcharrefreplace")
