"""The zip archive of a workbook file and the XML of its members: single elements are replaced, all other bytes are kept."""

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
"""Largest size of an unpacked member, bytes: a sheet of 100 000 rows of 20 columns takes 80 MiB."""
CONTENT_TYPES = "[Content_Types].xml"
_START_TAG = re.compile(rb"""<(?:[^>"']|"[^"]*"|'[^']*')*>""")


@dataclass(slots=True, eq=False)
class Element:
    """XML element with the offsets of its bytes in the member that it was parsed from."""

    name: str
    """Local name, without the prefix."""
    namespace: str
    attributes: dict[str, str]
    """Attribute -> value; the key of an attribute with a prefix is "namespace name"."""
    parent: Element | None
    start: int
    """Offset of the start tag."""
    inner: int
    """Offset of the content, which begins behind the start tag."""
    close: int
    """Offset of the end tag; in an empty element without end tag, equal to `inner`."""
    end: int
    """Offset of the first byte behind the element; in an empty element without end tag, equal to `inner`."""
    text: str = ""
    """Text directly inside the element, without the text of its children."""
    children: list[Element] = field(default_factory=list)


class Package:
    """Members of a workbook file, which is a zip archive; `name` is the file's name in messages."""

    def __init__(self, content: bytes, name: str) -> None:
        self.name, self.content = name, content
        self._archive = zipfile.ZipFile(io.BytesIO(content))
        self._members = {info.filename.casefold(): info for info in self._archive.infolist()}
        self.names = [info.filename for info in self._members.values()]

    def read(self, name: str) -> bytes:
        """Return the unpacked bytes of a member; raise `InputError` if it is missing, too large or damaged."""
        if (info := self._members.get(name.casefold())) is None:
            raise InputError(f"{self.name}: not a whole .xlsx workbook (it has no {name})")
        if info.file_size > MAX_PART_BYTES:
            size, limit = readable_size(info.file_size), readable_size(MAX_PART_BYTES)
            raise InputError(f"{self.name}: its part {name} unpacks to {size}, expected at most {limit}")
        try:
            with self._archive.open(info) as part:
                # No more is unpacked than the archive states; a longer member then fails the check of its CRC.
                return part.read(info.file_size + 1)
        except Exception as error:  # zlib.error, zipfile.BadZipFile and their like have no common base class
            raise InputError(f"{self.name}: its part {name} is damaged or cannot be read ({error})") from error

    def elements(self, name: str) -> list[Element]:
        """Return all XML elements of a member in document order."""
        return parse_elements(self.read(name), f"{self.name}: {name}")

    def relations(self, part: str) -> list[tuple[str, str, str]]:
        """Return (id, last word of the type, member) of each relationship of `part` that stays inside the package.

        `part` is a member's name, or "" for the relationships of the package itself.
        """
        name = relations_part(part)
        if name.casefold() not in self._members:
            return []
        return [
            (e.attributes.get("Id", ""), e.attributes.get("Type", "").rpartition("/")[2], _target(part, e.attributes))
            for e in self.elements(name)
            if e.name == "Relationship" and e.attributes.get("TargetMode") != "External"
        ]

    def content_type(self, part: str) -> str:
        """Return the content type that the package declares for a member, "" if it declares none."""
        types = {}
        for e in self.elements(CONTENT_TYPES):
            key = e.attributes.get("PartName", "").lstrip("/") or f".{e.attributes.get('Extension', '')}"
            types[key.casefold()] = e.attributes.get("ContentType", "")
        return types.get(part.casefold()) or types.get(f".{part.rpartition('.')[2].casefold()}", "")

    def replace_parts(self, parts: dict[str, bytes], removed: Iterable[str] = (), owner: str = "") -> bytes:
        """Return the bytes of the archive with new content for some members and without the `removed` ones.

        `parts` is member -> new bytes; members that the archive lacks are appended. `owner` is the member whose
        relationships name the removed ones. All other members keep their bytes, order, dates and attributes.
        """
        new_data = {part.casefold(): data for part, data in parts.items()}
        removed_keys = {part.casefold() for part in removed}
        if removed_keys:
            for name, element, target in (
                (relations_part(owner), "Relationship", lambda attributes: _target(owner, attributes)),
                (CONTENT_TYPES, "Override", lambda attributes: attributes.get("PartName", "").lstrip("/")),
            ):
                candidates = [e for e in self.elements(name) if e.name == element]
                changes = [(e.start, e.end, b"") for e in candidates if target(e.attributes).casefold() in removed_keys]
                new_data[name.casefold()] = splice(self.read(name), changes)
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w") as new_archive, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # zipfile warns of names that occur twice
            new_archive.comment = self._archive.comment
            for info in self._archive.infolist():
                if (key := info.filename.casefold()) in removed_keys:
                    continue
                member = copy.copy(info)
                new_archive.writestr(member, new_data[key] if key in new_data else self._archive.read(info))
                member.external_attr = info.external_attr  # zipfile replaces a file mode of 0
            for part in [part for part in new_data if part.casefold() not in self._members]:
                new_archive.writestr(zipfile.ZipInfo(part), new_data[part], zipfile.ZIP_DEFLATED)
        return out.getvalue()

    def append_element(self, name: str, parent: str, element: str, /, **attributes: str) -> bytes:
        """Return a member's XML with one more empty element at the end of the first element called `parent`.

        The new element is in the parent's namespace; "_" in the name of an attribute stands for ":".
        """
        data = self.read(name)
        parents = (e for e in self.elements(name) if e.name == parent and e.end > e.inner)
        if (container := next(parents, None)) is None:
            raise InputError(f"{self.name}: its part {name} has no {parent}, expected one that a sheet can be added to")
        pairs = {"xmlns": container.namespace, **{key.replace("_", ":"): value for key, value in attributes.items()}}
        text = b"".join(b' %b="%b"' % (key.encode(), escape_xml(value)) for key, value in pairs.items())
        return splice(data, [(container.close, container.close, b"<%b%b/>" % (element.encode(), text))])


def relations_part(part: str) -> str:
    """Return the name of the member that lists the relationships of the member `part`."""
    folder, base = posixpath.split(part)
    return posixpath.join(folder, "_rels", f"{base}.rels")


def _target(part: str, attributes: dict[str, str]) -> str:
    """Return the member that a relationship of `part` with these attributes points to."""
    target = attributes.get("Target", "")
    path = target[1:] if target.startswith("/") else posixpath.join(posixpath.dirname(part), target)
    return re.sub(r"^(\.\./)+", "", posixpath.normpath(path))


def parse_elements(data: bytes, name: str) -> list[Element]:
    """Return all elements of the UTF-8 XML `data` in document order.

    Raises `InputError`, in which the document is called `name`, if the XML is malformed or has a document type.
    """
    parser = expat.ParserCreate("utf-8", " ")
    parser.buffer_text = True
    parsed: list[Element] = []
    open_elements: list[Element] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        """Add an element at its start tag."""
        offset = parser.CurrentByteIndex
        match = _START_TAG.match(data, offset)
        assert match is not None, "the parser has seen a whole tag at this offset"
        namespace, _, local_name = tag.rpartition(" ")
        parent, inner = open_elements[-1] if open_elements else None, match.end()
        parsed.append(Element(local_name, namespace, attributes, parent, offset, inner, inner, inner))
        open_elements.append(parsed[-1])
        if parent is not None:
            parent.children.append(parsed[-1])

    def end(_tag: str) -> None:
        """Set the end of the innermost open element at its end tag."""
        element = open_elements.pop()
        if not data.endswith(b"/>", element.start, element.inner):
            element.close = parser.CurrentByteIndex
            element.end = data.index(b">", element.close) + 1

    def text(characters: str) -> None:
        """Add text to the innermost open element."""
        open_elements[-1].text += characters

    def doctype(*_: Any) -> None:
        """Refuse a document type, whose entities could expand without bound."""
        raise InputError(f"{name}: has a document type, expected none in a workbook")

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = text, doctype
    try:
        data.decode()  # refuses other encodings, which a byte order mark could select in the parser
        parser.Parse(data, True)
    except (UnicodeDecodeError, expat.ExpatError) as error:
        raise InputError(f"{name}: not readable XML ({error})") from error
    return parsed


def splice(data: bytes, changes: list[tuple[int, int, bytes]]) -> bytes:
    """Return `data` with the bytes from `start` to `end` replaced, for each of `changes`: (start, end, new bytes)."""
    pieces, offset = [], 0
    for start, end, new in sorted(changes, key=lambda change: change[:2]):
        pieces += [data[offset:start], new]
        offset = end
    return b"".join([*pieces, data[offset:]])


def set_attribute(tag: bytes, name: str, value: str | None) -> bytes:
    """Return a start tag with a new value of the attribute `name`, which has no prefix; None removes the attribute."""
    attribute = re.compile(rb"""\s+%b\s*=\s*("[^"]*"|'[^']*')""" % name.encode())
    if value is None:
        return attribute.sub(b"", tag, count=1)
    new = b' %b="%b"' % (name.encode(), escape_xml(value))
    if attribute.search(tag):
        return attribute.sub(lambda _: new, tag, count=1)
    end = len(tag) - (2 if tag.endswith(b"/>") else 1)
    return tag[:end].rstrip() + new + tag[end:]


def escape_xml(text: str) -> bytes:
    """Return a text as ASCII bytes for an element or a quoted attribute, with other characters as references."""
    return escape(text, {'"': "&quot;"}).encode("ascii", "xmlcharrefreplace")
