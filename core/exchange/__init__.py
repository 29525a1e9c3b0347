"""Exports of the scanner's geometry: cameras, solids and Monte Carlo simulations for other programs.

To add a program, write its `Format` in a module here, and list it below. The command line, Blender's menu and
`docs/geometry-export.md`, which refers to the command's help, take it from the list.
"""

from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files import AnyPath, new_folder, replacing, require_ending
from ..geometry.scanner import Scanner
from ..geometry.views import Views
from ..validation import instance, one_of
from .cameras import ASTRA, KORNIA, LEAP, NERF, OPENCV, PYTORCH3D, RTK
from .format import Format
from .gate9 import GATE9
from .gate10 import GATE10
from .mphdrr_json import MPHDRR, read_geometry
from .solids import GLB, STL, STL_PARTS, THREE_MF

__all__ = ["FORMATS", "FORMAT_NUMBERS", "Format", "read_geometry", "write_geometry"]

# Blender keeps a menu's choice by its place in the list: add formats at the end, and leave a None where one is removed.
_FORMATS = (
    *(ASTRA, RTK, OPENCV, KORNIA, PYTORCH3D, NERF, LEAP, None, None),
    *(STL, STL_PARTS, THREE_MF, GLB, GATE9, GATE10, MPHDRR),
)
FORMATS: dict[str, Format] = {format.name: format for format in _FORMATS if format}
FORMAT_NUMBERS: dict[str, int] = {format.name: number for number, format in enumerate(_FORMATS) if format}


def write_geometry(system: Scanner, path: AnyPath, format: str, *, views: Views | None = None, **options: Any) -> None:
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

    Notes
    -----
    Where the format cannot express a geometry, it is refused and an existing file stays.
    """
    instance(system, Scanner, "write_geometry")
    one_of(format, FORMATS, "format")
    views = system.views() if views is None else views
    instance(views, Views, "views")
    if len(views) == 0:
        raise InputError("views: expected one or more, got none")
    views.require_pinholes(f"format {format}")
    chosen, path = FORMATS[format], Path(path)
    for name in sorted(options.keys() - chosen.options.keys()):
        raise InputError(f"format {format}: no option {name!r}, it has {', '.join(chosen.options) or 'none'}")
    if chosen.suffixes:
        require_ending(path, chosen.suffixes)
    with replacing(path) if chosen.suffixes else new_folder(path) as temporary:
        chosen.write(system, views, temporary, **options)
