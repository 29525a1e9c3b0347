"""The scanner's geometry as other programs' files.

A format is a module here that offers one `Format`; `FORMATS` lists them all.
"""

from __future__ import annotations

import os
from typing import Any

from ..errors import InputError
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..validation import instance
from .astra import ASTRA
from .format import Format
from .gate9 import GATE9
from .gate10 import GATE10
from .leap import LEAP
from .nerf import NERF
from .opencv import KORNIA, OPENCV
from .pytomography import PYTOMOGRAPHY
from .pytorch3d import PYTORCH3D
from .record import MPHDRR, read_geometry
from .rtk import RTK
from .solids import GLB, STL, STL_PARTS, THREE_MF
from .stir import STIR

__all__ = ["FORMATS", "Format", "read_geometry", "write_geometry"]

_FORMATS = (
    ASTRA,
    RTK,
    OPENCV,
    KORNIA,
    PYTORCH3D,
    NERF,
    LEAP,
    PYTOMOGRAPHY,
    STIR,
    STL,
    STL_PARTS,
    THREE_MF,
    GLB,
    GATE9,
    GATE10,
    MPHDRR,
)
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
    instance(system, PinholeSystem, "write_geometry")
    if format not in FORMATS:
        raise InputError(f"format {format!r}: expected one of {', '.join(FORMATS)}")
    views = system.views() if views is None else views
    if not isinstance(views, Views):
        raise InputError(f"views: expected Views, got {type(views).__name__}")
    if len(views) == 0:
        raise InputError("views: expected one or more, got none")
    FORMATS[format].write_whole(system, views, path, options)
