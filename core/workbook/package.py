"""The zip archive that a workbook is. A copy with new bytes for a few members keeps all others as they were."""

from __future__ import annotations

import copy
import io
import posixpath
import re
import warnings
import zipfile
from collections.abc import Callable, Iterable

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
        The file's name in messages.
    """

    def __init__(self, content: bytes, name: str) -> None:
        self.name = name
        self.content = content
        self._archive = zipfile.ZipFile(io.BytesIO(content))
        self._members = {info.filename.casefold(): info for info in self._archive.infolist()}

    @property
    def names(self) -> list[str]:
        """The members' names in the archive's order."""
        return [info.filename for info in self._members.values()]

    def read(self, name: str) -> bytes:
        """A member's bytes; `InputError` if it is missing or damaged."""
        try:
            return self._archive.read(self._members[name.casefold()])
        except KeyError as error:
            raise InputError(f"{self.name}: not a whole .xlsx workbook (it has no {name})") from error
        except (zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError, OSError) as error:
            raise InputError(f"{self.name}: its part {name} cannot be read ({error})") from error
        except Exception as error:  # zlib.error and its like have no common name
            raise InputError(f"{self.name}: its part {name} is damaged ({error})") from error

    def relations(self, part: str) -> list[tuple[str, str, str]]:
        """(id, last word of the type, member) of what `part` ("" for the package) refers to inside the package."""
        name = _relations_part(part)
        if name.casefold() not in self._members:
            return []
        return [
            (e.attributes.get("Id", ""), e.attributes.get("Type", "").rpartition("/")[2], _target(part, e.attributes))
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

    def with_parts(self, parts: dict[str, bytes], removed: Iterable[str] = (), owner: str = "") -> bytes:
        """The archive with other bytes for `parts` and without the `removed` members that `owner` refers to.

        All other members keep their bytes, order, dates and attributes.
        """
        new_data = {part.casefold(): data for part, data in parts.items()}
        gone = {part.casefold() for part in removed}
        if gone:
            relations = _relations_part(owner)
            new_data[relations.casefold()] = self._without(
                relations, "Relationship", lambda attributes: _target(owner, attributes).casefold() in gone
            )
            new_data[_CONTENT_TYPES.casefold()] = self._without(
                _CONTENT_TYPES, "Override", lambda a: a.get("PartName", "").lstrip("/").casefold() in gone
            )
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
        return out.getvalue()

    def _without(self, name: str, element: str, is_meant: Callable[[dict[str, str]], bool]) -> bytes:
        data, to_encoding = utf8(self.read(name), name)
        cuts = [(e.start, e.end, b"") for e in elements(data, name) if e.name == element and is_meant(e.attributes)]
        return to_encoding(spliced(data, cuts))


def _relations_part(part: str) -> str:
    folder, base = posixpath.split(part)
    return posixpath.join(folder, "_rels", f"{base}.rels")


def _target(part: str, attributes: dict[str, str]) -> str:
    """The member that a relationship of `part` points to."""
    target = attributes.get("Target", "")
    path = target[1:] if target.startswith("/") else posixpath.join(posixpath.dirname(part), target)
    return re.sub(r"^(\.\./)+", "", posixpath.normpath(path))
