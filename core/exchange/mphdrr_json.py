"""Format of mphDRR: a JSON file of a geometry that holds every digit and can be read back."""

import json
from pathlib import Path
from typing import Any

from ..arrays import table_rows
from ..errors import InputError
from ..files import AnyPath, read_bytes
from ..geometry.scanner import Scanner
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..scanner_kinds import scanner_kind
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
_FILE_NAMES = {"centers": "pinhole_center"}
"""Names in the file of attributes of a scanner that are called otherwise there."""
_VIEW_FIELDS = {"source": "sources", "detector_center": "detector_centers", "u_step": "u_steps", "v_step": "v_steps"}


def _write(system: Scanner, views: Views, temporary: Path) -> None:
    """Write the modules' values and frames, and the views, into the file `temporary`."""
    modules = {"number": system.numbers, "frame": system.frames()}
    modules |= {_FILE_NAMES.get(name, name): values for name, values in system.filled().items()}
    images = {name: getattr(views, field) for name, field in _VIEW_FIELDS.items()}
    images["projection_matrix"] = views.projection_matrices()
    document = {
        "kind": _KIND,
        "version": _VERSION,
        "scanner": system.kind,
        "conventions": _CONVENTIONS,
        "modules": table_rows(modules),
        "rows": views.shape[0],
        "columns": views.shape[1],
        "views": table_rows(images),
    }
    temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def read_geometry(path: AnyPath) -> tuple[Scanner, Views]:
    """Read scanner and views, bit for bit, from a file that `write_geometry` wrote in the format ``"mphdrr"``.

    `InputError` for any other file.
    """
    content = read_bytes(path)
    try:
        document = json.loads(content)
        if not isinstance(document, dict) or document.get("kind") != _KIND:
            raise InputError(f"not a file of the format mphdrr ({_KIND})")
        if document.get("version") != _VERSION:
            raise InputError(f"version {document.get('version')!r}; this mphDRR reads {_VERSION}")
        modules = document["modules"]
        kind = scanner_kind(document.get("scanner", PinholeSystem.kind))
        arguments: dict[str, Any] = {"numbers": [entry["number"] for entry in modules]}
        for field, (column, *_) in kind.columns.fields.items():
            name = _FILE_NAMES.get(field, field)
            if not column.has_constant_blank or any(name in entry for entry in modules):
                arguments[field] = [entry[name] for entry in modules]
        views: Any = {field: [entry[name] for entry in document["views"]] for name, field in _VIEW_FIELDS.items()}
        return kind.of(arguments), Views(**views, shape=(document["rows"], document["columns"]))
    except InputError as error:
        reason = str(error)
    except (ValueError, RecursionError) as error:
        reason = f"not JSON ({error})"
    except KeyError as error:
        reason = f"incomplete, {error} is missing"
    except TypeError as error:
        reason = f"expected lists of modules and views ({error})"
    raise InputError(f"{path}: {reason}")


MPHDRR = Format("mphdrr", "mphDRR: JSON of modules, frames and views, every digit", (".json",), _write)
