"""Read and write NRRD, by pynrrd."""

import re
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError, first_line
from ...geometry.frames import affine_matrix
from ...validation import whole_in_file
from ..volume import Volume
from .contents import VolumeFileContents, find_data_file, require_voxels, warn_of_assumptions

# Signs that convert a space's axes to right, anterior, superior. A space without a name is assumed to have these axes.
_SPACES: dict[str | None, tuple[int, int, int]] = {
    **dict.fromkeys((None, "right-anterior-superior", "ras", "3d-right-handed"), (1, 1, 1)),
    **dict.fromkeys(("left-anterior-superior", "las"), (-1, 1, 1)),
    **dict.fromkeys(("left-posterior-superior", "lps"), (-1, -1, 1)),
}
# Millimetres per unit of length. An empty or missing unit is taken as mm.
_MILLIMETRES = {
    **dict.fromkeys(("", "mm", "millimeter", "millimeters", "millimetre", "millimetres"), 1.0),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 10.0),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1000.0),
    **dict.fromkeys(("um", "µm", "micron", "microns", "micrometer", "micrometers"), 0.001),
}
# Kinds of an axis that are, or in the case of "none" and "???" may be, spatial.
_SPATIAL = ("domain", "space", "none", "???")
_UNITS = {
    **dict.fromkeys(("hounsfield", "hounsfield unit", "hounsfield units", "hu"), "HU"),
    **dict.fromkeys(("mm-1", "mm^-1"), "1/mm"),
}
# Field names that the format allows, and pynrrd's names for them.
_SYNONYMS = {
    "axismins": "axis mins", "axismaxs": "axis maxs", "centers": "centerings", "oldmin": "old min", "oldmax": "old max",
    "lineskip": "line skip", "byteskip": "byte skip", "datafile": "data file",
}  # fmt: skip
# Fields of the header that this reader uses, or that change the meaning of values or positions.
_FIELDS = (
    "space", "space dimension", "space units", "space origin", "space directions", "spacings", "units", "kinds",
    "sample units", *_SYNONYMS.values(),
)  # fmt: skip
_LONGEST_HEADER = 1 << 16  # bytes
_SAME = 1e-6  # relative difference of two lengths that is explained by rounded decimals


def read(path: Path) -> VolumeFileContents:
    """Read a .nrrd file, or a .nhdr file and the file with its voxels."""
    import nrrd

    header: dict[str, Any] = {}
    for name, value in nrrd.read_header(str(path)).items():
        field = _SYNONYMS.get(name.lower(), name.lower())
        if field in _FIELDS and name != name.lower():  # pynrrd would ignore it
            raise InputError(f"field {name!r}: expected it in small letters, {field!r}")
        header[field if field in _FIELDS else name] = value
    for name in ("type", "sizes"):
        if name not in header:
            raise InputError(f"it has no field {name}: it is damaged or ends early")
    with open(path, "rb") as file:  # pynrrd rounds sizes
        sizes_line = re.search(r"(?m)^sizes:(.*)", file.read(_LONGEST_HEADER).decode("latin-1"))
    for size in sizes_line[1].split() if sizes_line else ():
        whole_in_file(size, "sizes", 1)
    single = _single_axis(header)
    value_type = header["type"]
    if value_type == "block":
        raise InputError("expected real numbers, found blocks of bytes")
    require_voxels(header["sizes"], np.dtype(np.float64 if value_type == "double" else np.float32))
    # Whole numbers with an "old min" or "old max" encode real numbers between these.
    limits = [header[name] for name in ("old min", "old max") if np.isfinite(float(header.get(name, np.nan)))]
    if limits and value_type not in ("float", "double"):
        raise InputError("old min and old max: quantized values are not read; unquantize them (unu unquantize)")
    data_path = find_data_file(path, "data file:", header["data file"]) if header.get("data file") else path
    for name in ("line skip", "byte skip"):
        whole_in_file(header.get(name, 0), name, -(name == "byte skip"), data_path.stat().st_size)
    affine = _affine(header, path)
    try:
        with open(path, "rb") as file:
            own_header = nrrd.read_header(file)
            if data_path is not path:
                own_header["datafile"] = str(data_path.absolute())  # of both spellings pynrrd takes this one
            array = nrrd.read_data(own_header, file, str(path))
    except Exception as error:  # pynrrd's message says little or nothing about missing data
        sizes = " x ".join(map(str, header["sizes"]))
        raise InputError(f"its data are damaged or end early; expected {sizes} voxels ({first_line(error)})") from error
    array = array if single is None else array.squeeze(single)
    unit = header.get("unit") or header.get("sample units")
    return VolumeFileContents(array, affine, header.get("quantity"), _UNITS.get(unit.lower(), unit) if unit else None)


def _single_axis(header: dict[str, Any]) -> int | None:
    """Return the axis of one element that a header has beside three others, and remove it from the header's fields."""
    sizes = list(header["sizes"])
    if len(sizes) != 4 or 1 not in sizes:
        return None
    kinds = [kind.lower() for kind in header.get("kinds", ["space"] * 4)]
    axis = max(range(4), key=lambda axis: (sizes[axis] == 1, kinds[axis] not in _SPATIAL, axis))
    for name in ("sizes", "kinds", "spacings", "axis mins", "axis maxs", "centerings", "units", "space directions"):
        if len(values := header.get(name, ())) == 4:
            header[name] = np.delete(np.asarray(values), axis, axis=0)
    return axis


def write(volume: Volume, temporary: Path) -> None:
    """Write a volume as .nrrd, with its exact affine, to the path `temporary`."""
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
    """Return the affine world-from-index, mm, in RAS; warn of assumptions about missing fields."""
    space = header.get("space")
    name = None if space is None else space.lower()
    if name not in _SPACES:
        expected = "right-anterior-superior, left-posterior-superior or another of 3-D"
        raise InputError(f"space {space!r}: expected {expected}")
    kinds = header.get("kinds", ["space"] * 3)
    if any(kind.lower() not in _SPATIAL for kind in kinds):
        raise InputError(f"kinds {' '.join(kinds)}: expected three axes of space or domain")
    assumptions = [] if name else ["axes right, anterior, superior"]
    space_units, units = _unit_lengths(header, "space units"), _unit_lengths(header, "units")
    # `first` is the first voxel's centre according to the axis mins, or None.
    scale, first = np.ones(3) if space_units is None else space_units, None
    if "space directions" in header:
        if space_units is None and units is not None and np.ptp(units) == 0:
            scale = units
        elif units is not None and np.any(units != scale):
            raise InputError("units: the axes' own differ from the space's; expected space units alone")
        axes = scale[:, None] * _space_axes(header, np.asarray(header["space directions"], np.float64))
    else:
        spacings, first, axis_assumptions = _axis_positions(header)
        assumptions += axis_assumptions
        axis_scale = scale if units is None else units
        axes, first = np.diag(spacings * axis_scale), None if first is None else first * axis_scale
    if "space origin" in header:
        origin = scale * np.asarray(header["space origin"], np.float64)
        if first is not None and np.any(np.abs(first - origin) > _SAME * np.abs(np.diag(axes))):
            raise InputError(f"axis mins and space origin say different places: {_text(first)} and {_text(origin)} mm")
    elif first is not None:
        origin = first
    else:
        assumptions.append("the first voxel's centre at (0, 0, 0)")
        origin = np.zeros(3)
    warn_of_assumptions(path, assumptions)
    return np.diag([*map(float, _SPACES[name]), 1.0]) @ affine_matrix(axes, origin)


def _space_axes(header: dict[str, Any], directions: np.ndarray) -> np.ndarray:
    """Return the steps from voxel to voxel along each axis as columns, from the field "space directions" (rows).

    The format does not allow other statements of the axes' lengths beside it: they must agree.
    """
    if directions.shape != (3, 3) or not np.isfinite(directions).all():
        raise InputError("space directions: expected a vector for each of three axes")
    if any(_numbers(header, name) is not None for name in ("axis mins", "axis maxs")):
        raise InputError("axis mins or axis maxs beside space directions: expected space origin alone")
    _spacings(header, np.linalg.norm(directions, axis=1), "space directions")
    return directions.T


def _axis_positions(header: dict[str, Any]) -> tuple[np.ndarray, np.ndarray | None, list[str]]:
    """Return the axes' spacings (3,), the first voxel's centre (3,) or None, and assumptions, without space directions.

    On a cell-centred axis, "axis mins" and "axis maxs" are the outer faces of the first and last voxel; on a node-centred
    axis, they are these voxels' centres.
    """
    low, high = (_numbers(header, name) for name in ("axis mins", "axis maxs"))
    if low is None:
        if high is not None:
            raise InputError("axis maxs: expected axis mins beside them")
        spacings = _spacings(header)
        return (np.ones(3), None, ["voxels of 1 mm"]) if spacings is None else (spacings, None, [])
    centerings = header.get("centerings", ["???"] * 3)
    centerings = [c.lower() for c in (centerings.split() if isinstance(centerings, str) else centerings)]
    if len(centerings) != 3 or not set(centerings) <= {"cell", "node", "none", "???"}:
        raise InputError(f"centerings {' '.join(centerings)}: expected cell or node for each of three axes")
    assumptions = ["axis mins at the first voxel's face (centerings: cell)"] * (not set(centerings) <= {"cell", "node"})
    is_node = np.array([c == "node" for c in centerings])
    steps = None
    if high is not None:
        n_steps = np.asarray(header["sizes"]) - is_node
        if np.any(n_steps < 1):
            raise InputError("axis maxs: an axis of one node has no spacing; expected spacings and axis mins")
        steps = (high - low) / n_steps
    if (spacings := _spacings(header, steps, "axis mins and maxs")) is None:
        raise InputError("axis mins: expected spacings or axis maxs beside them")
    return spacings, low + np.where(is_node, 0.0, spacings / 2), assumptions


def _spacings(header: dict[str, Any], steps: np.ndarray | None = None, source: str = "") -> np.ndarray | None:
    """Return `steps`, the axes' spacings (3,) that follow from other fields, the `source`; if None, the field "spacings".

    `InputError` where both are stated and differ.
    """
    if (spacings := _numbers(header, "spacings")) is None or steps is None:
        return spacings if steps is None else steps
    if np.any(np.abs(spacings - steps) > _SAME * np.abs(steps)):
        raise InputError(f"spacings and {source} say different lengths: {_text(spacings)} and {_text(steps)}")
    return steps


def _numbers(header: dict[str, Any], name: str) -> np.ndarray | None:
    """Return the three numbers of a field, or None if they are missing or NaN."""
    numbers = np.asarray(header.get(name, np.nan), np.float64)
    if np.isnan(numbers).all():
        return None
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise InputError(f"{name}: expected 3 numbers, got {_text(numbers)}")
    return numbers


def _unit_lengths(header: dict[str, Any], name: str) -> np.ndarray | None:
    """Return the three units of length of a field, mm, or None if the field is missing."""
    if (units := header.get(name)) is None:
        return None
    if len(units) != 3 or any(unit.strip() not in _MILLIMETRES for unit in units):
        raise InputError(f"{name} {' '.join(units)}: expected mm, cm, m or um for each of three axes")
    return np.array([_MILLIMETRES[unit.strip()] for unit in units])


def _text(numbers: np.ndarray) -> str:
    """Return numbers as text for messages."""
    return " ".join(f"{x:g}" for x in numbers.ravel())
