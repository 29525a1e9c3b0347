"""mphDRR's own JSON file of a geometry. It holds every digit and can be read back."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from .format import Format

_KIND = "mphDRR geometry"
_VERSION = 1
_CONVENTIONS = {
    "lengths": "mm",
    "world": "right-handed, origin at the isocentre, +z along the patient",
    "frame": "rows u, v, k in the world; k from the pinhole to the isocentre, v up, u = v x k",
    "pixel": "row i, column j lies at detector_center + (j - (columns - 1)/2) u_step + (i - (rows - 1)/2) v_step",
    "projection_matrix": "3 x 4, homogeneous world point to (column, row, 1) times depth; 0 is the centre of pixel 0",
}
# Names in the file -> fields of PinholeSystem and of Views.
_MODULE = {
    "number": "numbers",
    "pinhole_center": "centers",
    "pinhole_diameter": "pinhole_diameter",
    "collimator_length": "collimator_length",
    "detector_side": "detector_side",
    "detector_thickness": "detector_thickness",
    "roi_radius": "roi_radius",
}
_VIEW = {"source": "sources", "detector_center": "detector_centers", "u_step": "u_steps", "v_step": "v_steps"}


def _rows(columns: dict[str, Any]) -> list[dict[str, Any]]:
    lists = (values.tolist() for values in columns.values())
    return [dict(zip(columns, row, strict=True)) for row in zip(*lists, strict=True)]


def _write(system: PinholeSystem, views: Views, path: Path) -> None:
    modules = {name: getattr(system, field) for name, field in _MODULE.items()} | {"frame": system.frames()}
    images = {name: getattr(views, field) for name, field in _VIEW.items()}
    images["projection_matrix"] = views.projection_matrices()
    document = {
        "kind": _KIND,
        "version": _VERSION,
        "conventions": _CONVENTIONS,
        "modules": _rows(modules),
        "rows": views.shape[0],
        "columns": views.shape[1],
        "views": _rows(images),
    }
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def read_geometry(path: str | os.PathLike[str]) -> tuple[PinholeSystem, Views]:
    """Read what `write_geometry` wrote in the format ``"mphdrr"``, bit for bit.

    Raises
    ------
    InputError
        The file cannot be read, is not such a file, or describes an impossible system.
    """
    try:
        document = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise InputError(f"{path}: not JSON ({error})") from error
    if not isinstance(document, dict) or document.get("kind") != _KIND:
        raise InputError(f"{path}: not a file of the format mphdrr ({_KIND})")
    if document.get("version") != _VERSION:
        raise InputError(f"{path}: version {document.get('version')!r}; this mphDRR reads {_VERSION}")
    try:
        system: dict[str, Any] = {
            field: [module[name] for module in document["modules"]] for name, field in _MODULE.items()
        }
        views: dict[str, Any] = {field: [view[name] for view in document["views"]] for name, field in _VIEW.items()}
        shape = (document["rows"], document["columns"])
    except KeyError as error:
        raise InputError(f"{path}: incomplete, {error} is missing") from error
    except TypeError as error:
        raise InputError(f"{path}: expected lists of modules and views ({error})") from error
    try:
        return PinholeSystem(**system), Views(**views, shape=shape)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


MPHDRR = Format("mphdrr", "mphDRR: JSON of modules, frames and views, every digit", (".json",), _write)
