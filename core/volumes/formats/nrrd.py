"""NRRD, by pynrrd."""

from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError, first_line
from ...files import require_file
from ...geometry.frames import affine_matrix
from ..volume import Volume
from .contents import Contents, refuse_several_files, require_voxels, warn_of_assumed

# Signs that turn a space's axes to right, anterior, superior, which are assumed for a space without a name.
_SPACES: dict[str | None, tuple[int, int, int]] = {
    **dict.fromkeys((None, "right-anterior-superior", "ras", "3d-right-handed"), (1, 1, 1)),
    **dict.fromkeys(("left-anterior-superior", "las"), (-1, 1, 1)),
    **dict.fromkeys(("left-posterior-superior", "lps"), (-1, -1, 1)),
}
# Units of length. An empty one is unknown and, like a missing one, taken as mm.
_MILLIMETRES = {
    **dict.fromkeys(("", "mm", "millimeter", "millimeters", "millimetre", "millimetres"), 1.0),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 10.0),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1000.0),
    **dict.fromkeys(("um", "µm", "micron", "microns", "micrometer", "micrometers"), 0.001),
}
# Kinds of a spatial axis; "???" and "none" say nothing.
_SPATIAL = ("domain", "space", "none", "???")
_UNITS = {
    **dict.fromkeys(("hounsfield", "hounsfield unit", "hounsfield units", "hu"), "HU"),
    **dict.fromkeys(("mm-1", "mm^-1"), "1/mm"),
}
# Fields about the values or their places, by the names that pynrrd understands.
_SYNONYMS = {
    "axismins": "axis mins", "axismaxs": "axis maxs", "centers": "centerings", "oldmin": "old min", "oldmax": "old max",
    "lineskip": "line skip", "byteskip": "byte skip", "datafile": "data file",
}  # fmt: skip
_FIELDS = (
    "space", "space dimension", "space units", "space origin", "space directions", "spacings", "units", "kinds",
    "sample units", *_SYNONYMS.values(),
)  # fmt: skip
_SAME = 1e-6  # relative difference of two statements of a length that rounded decimals explain


def read(path: Path) -> Contents:
    """Read .nrrd, or .nhdr and the file beside it."""
    import nrrd

    header: dict[str, Any] = {}  # with one name for each field
    for name, value in nrrd.read_header(str(path)).items():
        known = _SYNONYMS.get(name.lower(), name.lower())
        if known in _FIELDS and name != name.lower():  # pynrrd would ignore it
            raise InputError(f"field {name!r}: expected it in small letters, {known!r}")
        header[known if known in _FIELDS else name] = value
    for name in ("type", "sizes"):
        if name not in header:
            raise InputError(f"it has no field {name}: it is damaged or ends early")
    kind = header["type"]
    if kind == "block":
        raise InputError("expected real numbers, found blocks of bytes")
    require_voxels(header["sizes"], np.dtype(np.float64 if kind == "double" else np.float32))
    # Whole numbers between "old min" and "old max" encode others.
    ends = [header[name] for name in ("old min", "old max") if np.isfinite(float(header.get(name, np.nan)))]
    if ends and kind not in ("float", "double"):
        raise InputError("old min and old max: quantized values are not read; unquantize them (unu unquantize)")
    beside = header.get("data file", "")
    refuse_several_files("data file:", beside)
    if beside and (path.parent / beside).exists():
        require_file(path.parent / beside)
    affine = _affine(header, path)
    try:
        array, _ = nrrd.read(str(path))
    except Exception as error:  # pynrrd says little or nothing of missing data
        sizes = " x ".join(map(str, header["sizes"]))
        raise InputError(f"its data are damaged or end early; expected {sizes} voxels ({first_line(error)})") from error
    unit = header.get("unit") or header.get("sample units")
    return Contents(array, affine, header.get("quantity"), _UNITS.get(unit.lower(), unit) if unit else None)


def write(volume: Volume, temporary: Path) -> None:
    """Write .nrrd with the exact affine."""
    import nrrd

    affine = volume.grid.affine
    header = {
        "space": "right-anterior-superior",
        "space directions": affine[:3, :3].T,
        "space origin": affine[:3, 3],
        "space units": ["mm"] * 3,
        "encoding": "gzip",
        "quantity": volume.quantity,
        "unit": volume.unit,
    }
    if volume.note:
        header["note"] = volume.note
    nrrd.write(str(temporary), volume.array, header, compression_level=1)


def _affine(header: dict[str, Any], path: Path) -> np.ndarray:
    """Index to world mm, with a warning of what the header does not say."""
    space = header.get("space")
    name = None if space is None else space.lower()
    if name not in _SPACES:
        expected = "right-anterior-superior, left-posterior-superior or another of 3-D"
        raise InputError(f"space {space!r}: expected {expected}")
    kinds = header.get("kinds", ["space"] * 3)
    if any(kind.lower() not in _SPATIAL for kind in kinds):
        raise InputError(f"kinds {' '.join(kinds)}: expected three axes of space or domain")
    assumed = [] if name else ["axes right, anterior, superior"]
    space_units, units = _scales(header, "space units"), _scales(header, "units")
    scale, first = np.ones(3) if space_units is None else space_units, None
    if "space directions" in header:
        if space_units is None and units is not None and np.ptp(units) == 0:
            scale = units
        elif units is not None and np.any(units != scale):
            raise InputError("units: the axes' own differ from the space's; expected space units alone")
        axes = scale[:, None] * _of_space(header, np.asarray(header["space directions"], np.float64))
    else:
        spacings, first, of_axes = _of_axes(header)
        assumed += of_axes
        own = scale if units is None else units
        axes, first = np.diag(spacings * own), None if first is None else first * own
    if "space origin" in header:
        origin = scale * np.asarray(header["space origin"], np.float64)
        if first is not None and np.any(np.abs(first - origin) > _SAME * np.abs(np.diag(axes))):
            raise InputError(f"axis mins and space origin say different places: {_text(first)} and {_text(origin)} mm")
    elif first is not None:
        origin = first
    else:
        assumed.append("the first voxel's centre at (0, 0, 0)")
        origin = np.zeros(3)
    warn_of_assumed(path, assumed)
    return np.diag([*map(float, _SPACES[name]), 1.0]) @ affine_matrix(axes, origin)


def _of_space(header: dict[str, Any], directions: np.ndarray) -> np.ndarray:
    """The directions as columns. The format allows no other lengths of the axes with them, so those must agree."""
    if directions.shape != (3, 3) or not np.isfinite(directions).all():
        raise InputError("space directions: expected a vector for each of three axes")
    if any(np.isfinite(_numbers(header, name)).any() for name in ("axis mins", "axis maxs")):
        raise InputError("axis mins or axis maxs beside space directions: expected space origin alone")
    spacings, lengths = _numbers(header, "spacings"), np.linalg.norm(directions, axis=1)
    if np.any(np.abs(spacings - lengths) > _SAME * lengths):
        raise InputError(f"spacings and space directions say different lengths: {_text(spacings)} and {_text(lengths)}")
    return directions.T


def _of_axes(header: dict[str, Any]) -> tuple[np.ndarray, np.ndarray | None, list[str]]:
    """The axes' own spacings, the centre of the first voxel (or None), and what has been assumed.

    "axis mins" and "axis maxs" are the outer faces of the first and last voxels of a cell-centred axis, and their
    centres on a node-centred one.
    """
    spacings, low, high = (_numbers(header, name) for name in ("spacings", "axis mins", "axis maxs"))
    assumed: list[str] = []
    if not np.isfinite(low).any():
        if np.isfinite(high).any():
            raise InputError("axis maxs: expected axis mins beside them")
        if np.isfinite(spacings).any():
            return _all_of(spacings, "spacings"), None, assumed
        return np.ones(3), None, ["voxels of 1 mm"]
    low = _all_of(low, "axis mins")
    centerings = header.get("centerings", ["???"] * 3)
    centerings = [c.lower() for c in (centerings.split() if isinstance(centerings, str) else centerings)]
    if len(centerings) != 3 or not set(centerings) <= {"cell", "node", "none", "???"}:
        raise InputError(f"centerings {' '.join(centerings)}: expected cell or node for each of three axes")
    if not set(centerings) <= {"cell", "node"}:
        assumed = ["axis mins at the first voxel's face (centerings: cell)"]
    node = np.array([c == "node" for c in centerings])
    if np.isfinite(high).any():
        steps = np.asarray(header["sizes"]) - node
        if np.any(steps < 1):
            raise InputError("axis maxs: an axis of one node has no spacing; expected spacings and axis mins")
        between = (_all_of(high, "axis maxs") - low) / steps
        if np.any(np.abs(spacings - between) > _SAME * np.abs(between)):
            lengths = f"{_text(spacings)} and {_text(between)}"
            raise InputError(f"spacings and axis mins and maxs say different lengths: {lengths}")
        spacings = between
    spacings = _all_of(spacings, "spacings")
    return spacings, low + np.where(node, 0.0, spacings / 2), assumed


def _numbers(header: dict[str, Any], name: str) -> np.ndarray:
    """A field's three numbers, with NaN for those that are missing."""
    numbers = np.asarray(header.get(name, [np.nan] * 3), np.float64)
    if numbers.shape != (3,):
        raise InputError(f"{name}: expected 3 numbers, got {_text(np.atleast_1d(numbers))}")
    return numbers


def _all_of(numbers: np.ndarray, name: str) -> np.ndarray:
    if not np.isfinite(numbers).all():
        raise InputError(f"{name}: expected 3 numbers, got {_text(numbers)}")
    return numbers


def _scales(header: dict[str, Any], name: str) -> np.ndarray | None:
    """A field's three units of length, in mm, or None if it is not there."""
    units = header.get(name)
    if units is None:
        return None
    if len(units) != 3 or any(unit.strip() not in _MILLIMETRES for unit in units):
        raise InputError(f"{name} {' '.join(units)}: expected mm, cm, m or um for each of three axes")
    return np.array([_MILLIMETRES[unit.strip()] for unit in units])


def _text(numbers: np.ndarray) -> str:
    return " ".join(f"{x:g}" for x in numbers.ravel())
