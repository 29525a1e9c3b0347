"""Exports of the scanner's geometry: cameras, solids and Monte Carlo simulations for other programs.

To add a program, write a module here that offers a `Format`, and list it below. The command line, Blender's menu and
`docs/geometry-export.md`, which refers to the command's help, take it from the list.
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
from .mphdrr_json import MPHDRR, read_geometry
from .nerf import NERF
from .opencv import KORNIA, OPENCV
from .pytorch3d import PYTORCH3D
from .rtk import RTK
from .solids import GLB, STL, STL_PARTS, THREE_MF

__all__ = ["FORMATS", "FORMAT_NUMBERS", "Format", "read_geometry", "write_geometry"]

# Blender keeps a menu's choice as a number: never change one, and give a new format a number that no format has had.
# 7 and 8 belonged to PyTomography and STIR in version 0.1.0.
_NUMBERED = {
    0: ASTRA,
    1: RTK,
    2: OPENCV,
    3: KORNIA,
    4: PYTORCH3D,
    5: NERF,
    6: LEAP,
    9: STL,
    10: STL_PARTS,
    11: THREE_MF,
    12: GLB,
    13: GATE9,
    14: GATE10,
    15: MPHDRR,
}
FORMATS: dict[str, Format] = {format.name: format for format in _NUMBERED.values()}
FORMAT_NUMBERS: dict[str, int] = {format.name: number for number, format in _NUMBERED.items()}


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
        The file to write; for formats of several files a folder, which must be new or empty.
    format
        A name of `FORMATS`.
    views
        The images to describe; default ``system.views()``. Formats of solids ignore them.
    options
        The format's own: ``FORMATS[format].options``.

    Raises
    ------
    InputError
        The format, an option or the file's ending is unknown, the format cannot express the geometry, or the file cannot
        be written. An existing file is then left as it was.
    """
    instance(system, PinholeSystem, "write_geometry")
    if format not in FORMATS:
        raise InputError(f"format {format!r}: expected one of {', '.join(FORMATS)}")
    views = system.views() if views is None else views
    instance(views, Views, "views")
    if len(views) == 0:
        raise InputError("views: expected one or more, got none")
    FORMATS[format].save(system, views, path, options)
