"""The scanner's geometry as other programs' files.

A format is a module here that offers one `Format`; `FORMATS` lists them all.
"""

from __future__ import annotations

import os
from typing import Any

from ..errors import InputError
from ..system import PinholeSystem
from ..views import Views
from .format import Format
from .solids import GLB, STL, STL_PARTS, THREE_MF

_FORMATS = (STL, STL_PARTS, THREE_MF, GLB)
FORMATS: dict[str, Format] = {f.name: f for f in _FORMATS}


def write_geometry(
    system: PinholeSystem,
    path: str | os.PathLike[str],
    format: str,
    *,
    views: Views | None = None,
    **options: Any,
) -> None:
    """Write the scanner's geometry for another program.

    Parameters
    ----------
    system
        The modules.
    path
        The file to write, or for formats of several files the folder: it is made, and must be empty or absent.
    format
        A name of `FORMATS`.
    views
        The images to describe; by default ``system.views()``. Formats of solids leave it aside.
    options
        Those of the format (`Format.write`).

    Raises
    ------
    InputError
        No such format, an option or suffix that it does not have, what it cannot express, or the file cannot be
        written (the old one then stays).
    """
    if format not in FORMATS:
        raise InputError(f"format {format!r}: expected one of {', '.join(FORMATS)}")
    FORMATS[format].write_whole(system, views if views is not None else system.views(), path, options)
