"""Exchange of the scanner's geometry with other programs: cameras, solids, Monte Carlo simulations, DiffDRR's interface.

`write_geometry` writes a scanner in a format of `FORMATS`, and `read_geometry` reads mphDRR's own JSON format. A `Format`
(`format.py`) is a name, a title, file endings and a function that writes. The Monte Carlo formats share `monte_carlo.py`,
the scanner as placed solids. `diffdrr` is DiffDRR's interface to mphDRR's projector.

To add a format, write its `Format` in a module here, and append it to the list `_FORMATS` below. The command line, Blender's
menu and `docs/geometry-export.md`, which refers to the command's help, follow from the list.
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

# Blender stores a menu's choice as its position in the list: add formats at the end, and put None where one is removed.
_FORMATS = (
    *(ASTRA, RTK, OPENCV, KORNIA, PYTORCH3D, NERF, LEAP, None, None),
    *(STL, STL_PARTS, THREE_MF, GLB, GATE9, GATE10, MPHDRR),
)
FORMATS: dict[str, Format] = {format.name: format for format in _FORMATS if format}
"""Formats by name."""
FORMAT_NUMBERS: dict[str, int] = {format.name: number for number, format in enumerate(_FORMATS) if format}
"""Positions of the formats in Blender's menu, by name."""


def write_geometry(system: Scanner, path: AnyPath, format: str, *, views: Views | None = None, **options: Any) -> None:
    """Write the scanner's geometry for another program.

    Parameters
    ----------
    system
        Scanner to export.
    path
        File to write; for formats of several files a folder, which must be new or empty.
    format
        Name of a format in `FORMATS`.
    views
        Views of the images to describe; default ``system.views()``. Formats of solids ignore them.
    options
        Options of the format, listed in ``FORMATS[format].options``.

    Raises
    ------
    InputError
        The format, an option or the path is not valid, or the format cannot represent the geometry; an existing file then
        stays as it is.
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
