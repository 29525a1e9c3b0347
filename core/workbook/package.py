"""The zip archive that a workbook is: its members as bytes, a few of them replaced, all others as they were."""

from __future__ import annotations

import copy
import io
import posixpath
import re
import warnings
import zipfile
from collections.abc import Callable

from ..errors import InputError
from .xml_parts import elements, spliced, utf8

_CONTENT_TYPES = "[Content_Types].xml"


class Package:
    """The members of a workbook file.

    Parameters
    ----------
    content
        The file's bytes.
    name
        How messages call the file.
    """

    def __init__(self, content: bytes, name: str) -> None:
        self.name = name
        self.content = content
        self._archive = zipfile.ZipFile(io.BytesIO(content))
        self._members = {info.filename: info for info in self._archive.infolist()}
        self._by_folded_name = {name.casefold(): name for name in self._members}
        self._replaced: dict[str, bytes] = {}
        self._removed: set[str] = set()

    @property
    def names(self) -> list[str]:
        """The members' names in the archive's order."""
        return list(self._members)

    def read(self, name: str) -> bytes:
        """A member's bytes; `InputError` where it is missing or damaged."""
        name = self._by_folded_name.get(name.casefold(), name)
        if name in self._replaced:
            return self._replaced[name]
        try:
            return self._archive.read(self._members[name])
        except KeyError as error:
            raise InputError(f"{self.name}: not a whole .xlsx workbook (it has no {name})") from error
        except (zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError, OSError) as error:
            raise InputError(f"{self.name}: its part {name} cannot be read ({error})") from error
        except Exception as error:  # zlib.error and its like, which have no common name
            raise InputError(f"{self.name}: its part {name} is damaged ({error})") from error

    def replace(self, name: str, data: bytes) -> None:
        """Give a member other bytes."""
        self._replaced[self._by_folded_name[name.casefold()]] = data

    def relations(self, part: str) -> list[tuple[str, str, str]]:
        """(id, last word of the type, member) of what `part` ("" for the package) refers to inside the package."""
        folder, base = posixpath.split(part)
        name = posixpath.join(folder, "_rels", f"{base}.rels")
        if name.casefold() not in self._by_folded_name:
            return []
        return [
            (e.attributes.get("Id", ""), _kind(e.attributes), _member(folder, e.attributes.get("Target", "")))
            for e in elements(utf8(self.read(name), name)[0], name)
            if e.name == "Relationship" and e.attributes.get("TargetMode") != "External"
        ]

    def content_type(self, part: str) -> str:
        """The content type of a member."""
        suffix = part.rpartition(".")[2].casefold()
        found = ""
        for e in elements(utf8(self.read(_CONTENT_TYPES), _CONTENT_TYPES)[0], _CONTENT_TYPES):
            if e.name == "Override" and e.attributes.get("PartName", "").lstrip("/").casefold() == part.casefold():
                return e.attributes.get("ContentType", "")
            if e.name == "Default" and e.attributes.get("Extension", "").casefold() == suffix:
                found = e.attributes.get("ContentType", "")
        return found

    def remove(self, part: str, owner: str) -> None:
        """Take out `part`, the relationship that `owner` has to it, and its content type."""
        folder, base = posixpath.split(owner)
        rels = posixpath.join(folder, "_rels", f"{base}.rels")
        same = part.casefold()
        self._cut(rels, "Relationship", lambda of: _member(folder, of.get("Target", "")).casefold() == same)
        self._cut(_CONTENT_TYPES, "Override", lambda of: of.get("PartName", "").lstrip("/").casefold() == same)
        self._removed.add(self._by_folded_name[part.casefold()])

    def _cut(self, name: str, element: str, is_meant: Callable[[dict[str, str]], bool]) -> None:
        data, back = utf8(self.read(name), name)
        cuts = [(e.start, e.end, b"") for e in elements(data, name) if e.name == element and is_meant(e.attributes)]
        self.replace(name, back(spliced(data, cuts)))

    def to_bytes(self) -> bytes:
        """The archive: the members that were not replaced have the bytes, order, dates and attributes they had."""
        if not self._replaced:
            return self.content
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w") as new, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # zipfile's, of names that are there twice
            new.comment = self._archive.comment
            for info in self._archive.infolist():
                if info.filename in self._removed:
                    continue
                data = self._replaced.get(info.filename)
                member = copy.copy(info)
                new.writestr(member, self._archive.read(info) if data is None else data)
                member.external_attr = info.external_attr  # zipfile makes 0 a file mode
        return out.getvalue()


def _kind(attributes: dict[str, str]) -> str:
    return attributes.get("Type", "").rpartition("/")[2]


def _member(folder: str, target: str) -> str:
    path = target[1:] if target.startswith("/") else posixpath.join(folder, target)
    return re.sub(r"^(\.\./)+", "", posixpath.normpath(path))
