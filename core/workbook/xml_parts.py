"""XML elements and the places of their bytes, so that a few can be replaced and all others kept."""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable
from typing import Any
from xml.parsers import expat

from ..errors import InputError

_START_TAG = re.compile(rb"""<(?:[^>"']|"[^"]*"|'[^']*')*>""")
_DECLARED = re.compile(rb"""<\?xml[^>]*?encoding\s*=\s*["']([\w.-]+)["']""")


class Element:
    """An element and the place of its bytes.

    Attributes
    ----------
    name : str
        Without prefix.
    namespace : str
    attributes : dict
        The key of one with a prefix is "namespace name".
    parent : Element or None
    start, inner, close, end : int
        The offsets of the start tag, of the content, of the end tag, and of what follows. In an empty element without
        end tag, the last three are the same.
    text : str
        Its own text, without that of elements inside.
    """

    __slots__ = ("attributes", "close", "end", "inner", "name", "namespace", "parent", "start", "text")

    def __init__(self, name: str, attributes: dict[str, str], parent: Element | None, start: int, inner: int) -> None:
        self.namespace, _, self.name = name.rpartition(" ")
        self.attributes, self.parent = attributes, parent
        self.start = start
        self.inner = self.close = self.end = inner
        self.text = ""


def utf8(data: bytes, name: str) -> tuple[bytes, Callable[[bytes], bytes]]:
    """A part as UTF-8 without byte order mark, and the function that brings new text back to the part's encoding."""
    declared = _DECLARED.match(data)
    encodings = {codecs.BOM_UTF8: "utf-8", codecs.BOM_UTF16_LE: "utf-16-le", codecs.BOM_UTF16_BE: "utf-16-be"}
    mark = next((mark for mark in encodings if data.startswith(mark)), b"")
    encoding = encodings.get(mark) or {b"<\0": "utf-16-le", b"\0<": "utf-16-be"}.get(data[:2])
    encoding = encoding or (declared[1].decode() if declared else "utf-8")
    try:
        text = data[len(mark) :].decode(encoding)
    except (LookupError, ValueError) as error:
        raise InputError(f"{name}: not readable XML ({error})") from error
    return text.encode(), lambda new: mark + new.decode().encode(encoding, "xmlcharrefreplace")


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
        element = Element(tag, attributes, opened[-1] if opened else None, at, match.end())
        found.append(element)
        opened.append(element)

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
        parser.Parse(data, True)
    except expat.ExpatError as error:
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
    for character, entity in (("&", "&amp;"), ("<", "&lt;"), (">", "&gt;"), ('"', "&quot;")):
        text = text.replace(character, entity)
    return text.encode()
