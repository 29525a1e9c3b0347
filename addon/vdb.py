"""OpenVDB files: volumes of ours to the last bit, and grids of other programs.

Files of ours hold every voxel's float32 value, the float64 affine, the quantity, the unit and where the volume came from.
The transform is OpenVDB's own, in which an integer index is the voxel's CENTRE: that is how Houdini, EmberGen and Blender 5
place grids. Blender 4.5 draws them half a voxel farther along every index axis, so the files that a scene draws are
shifted back there, and say so in their metadata; what is written for others is not. Of other programs' files the transform
counts.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, InputWarning
from ..core.files import replacing
from ..core.geometry.grid import Grid
from ..core.memory import require
from ..core.validation import freeze, positive
from ..core.version import VERSION
from ..core.volumes.volume import AIR_HU, UNITS, Volume
from .vdb_length import missing_bytes

SMOKE = "smoke for display"
"""Name of a grid that only Blender's solid viewport uses."""

_SLAB = 64  # layers handed over at once, whole leaves of 8: what is copied for OpenVDB stays small

_NOTE = (
    "Written for a Blender that draws index i over [i, i + 1]: the centre of voxel i is where this transform carries "
    "i {back:+g} along every axis. File > Export > Volume of mphDRR writes files for other programs."
)

_NUMBERS = ("float", "double", "half", "int32", "int64", "bool")
"""Value types of grids that can become a volume."""

BACKGROUND = {"hu": AIR_HU}
"""What voxels that take no room in a file hold, where it is not 0: what is drawn around a CT is air, not water."""


def write_vdb(
    volumes: Volume | Sequence[Volume],
    path: str | Path,
    provenance: dict[str, Any] | None = None,
    *,
    smoke_above: float | None = None,
    center_shift: float = 0.0,
) -> None:
    """Write volumes as sparse float grids, each named after its quantity; voxels of 0 (-1000 HU) take no room.

    Other programs find each voxel's centre where their transforms carry its integer index. The metadata hold the exact
    affine, so that `read_vdb` gives the same volume whatever `center_shift` was.

    Parameters
    ----------
    volumes
        One, or several of different quantities, such as activity and mu; their grids need not be the same.
    path
        The file.
    provenance
        What the volumes were made from; kept as JSON in the metadata.
    smoke_above
        Also write a grid `SMOKE` of the first volume's values above this one, less it: Blender's solid viewport draws
        what surrounds values below 0 black. `read_vdb` does not see it.
    center_shift
        Voxels by which the transforms are shifted along every index axis, for files that a Blender draws which places them
        otherwise (`compat.VDB_CENTER_SHIFT`). For other programs such a file lies that much off.

    Raises
    ------
    InputError
        Nothing to write, two volumes of one quantity, or the file cannot be written.
    """
    several = [volumes] if isinstance(volumes, Volume) else list(volumes)
    path = Path(path)
    names = [volume.quantity for volume in several]
    if not names or len(set(names)) < len(names):
        found = ", ".join(names) or "none"
        raise InputError(f"{path}: expected volumes of different quantities, got {found}")
    grids = [_grid_of(volume, provenance or {}, center_shift) for volume in several]
    if smoke_above is not None:
        shown = several[0]
        above = freeze(np.maximum(shown.array - np.float32(smoke_above), 0))
        grids.append(_grid_of(Volume(above, shown.grid), {}, center_shift))
        grids[-1].name = SMOKE
    with replacing(path) as temporary:
        openvdb().write(str(temporary), grids=grids)


def read_vdb(path: str | Path, quantity: str | None = None, grid: str | None = None, *, unit: float = 1.0) -> Volume:
    """Read a grid as a volume: one of ours the same to the last bit, any other program's by its transform.

    Another program's grid becomes a volume on the box around its active voxels; outside of it a volume is 0, whatever the
    grid's background. Grids of float, double, half, int and bool give all their values in the box, active or not, in
    float32; a level set gives the share of each voxel that lies inside it (0 to 1).

    Parameters
    ----------
    path
        The file.
    quantity
        What the values are, one of `UNITS`; of several grids, the one of that quantity. Default: what the file
        says, and ``"activity"`` where it says nothing.
    grid
        The grid's name; needed where a file holds several and `quantity` does not tell which.
    unit
        Length in mm of the file's unit, for files of other programs: 1000 for one in metres.

    Raises
    ------
    InputError
        No such file, not OpenVDB, damaged; no such grid, or several and none chosen; a grid of vectors or points, one
        without active voxels, a frustum; values that are not finite; too large for the memory.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if quantity is not None and quantity not in UNITS:
        raise InputError(f"quantity {quantity!r}: expected one of {', '.join(UNITS)}")
    unit = positive(unit, "unit of the file's lengths", "mm")
    if missing := missing_bytes(path):
        raise InputError(f"{path}: is cut off, {missing} bytes are missing at its end")
    try:
        name = _chosen(_described(path), quantity, grid)
        return _volume_of(openvdb().read(str(path), name), quantity, unit)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except MemoryError:
        raise
    except Exception as error:  # whatever OpenVDB raises on a damaged file
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise InputError(f"{path}: cannot be read as an OpenVDB volume ({reason})") from error


def provenance_of(path: Path) -> dict[str, Any]:
    """What a file of ours was made from, of its first volume; nothing of other programs' and of damaged files."""
    try:
        grids = _described(path).values()
    except Exception:  # whatever OpenVDB raises; reading it says what is wrong
        return {}
    found = next((grid.metadata["mphdrr_provenance"] for grid in grids if "mphdrr_provenance" in grid.metadata), "{}")
    provenance: dict[str, Any] = json.loads(found)
    return provenance


def openvdb() -> Any:
    """The module, which comes with Blender."""
    try:
        import openvdb
    except ImportError:
        if not hasattr(bpy.utils, "expose_bundled_modules"):
            raise InputError("this Blender has no openvdb module: use 4.5 or later from blender.org") from None
        bpy.utils.expose_bundled_modules()  # needed by the bpy wheel only
        import openvdb
    return openvdb


def _grid_of(volume: Volume, provenance: dict[str, Any], shift: float) -> Any:
    vdb = openvdb()
    grid = vdb.FloatGrid(BACKGROUND.get(volume.quantity, 0.0))
    array, affine = volume.array, volume.grid.affine
    mirrored = bool(np.linalg.det(affine[:3, :3]) < 0)
    if mirrored:  # 4.5 draws nothing where the transform is left-handed: the same voxels, counted from the other end
        array = array[::-1]
    require(4.0 * array.size, f"writing {' x '.join(map(str, array.shape))} voxels")
    for first in range(0, len(array), _SLAB):
        # A copy, because it takes neither strides nor read-only arrays.
        slab = np.array(array[first : first + _SLAB], np.float32, order="C")
        grid.copyFromArray(slab, ijk=(first, 0, 0), tolerance=0.0)
    grid.name = volume.quantity
    grid.gridClass = vdb.GridClass.FOG_VOLUME
    # OpenVDB's matrices act on row vectors.
    grid.transform = vdb.createLinearTransform(_drawn(affine, volume.grid.shape, mirrored, shift).T.tolist())
    grid["mphdrr_quantity"] = volume.quantity
    grid["mphdrr_unit"] = volume.unit
    grid["mphdrr_shape"] = json.dumps(volume.grid.shape)
    grid["mphdrr_affine"] = json.dumps(affine.tolist())
    grid["mphdrr_mirrored"] = mirrored
    grid["mphdrr_center_shift"] = shift
    if shift:
        grid["mphdrr_note"] = _NOTE.format(back=-shift)
    grid["mphdrr_provenance"] = json.dumps(provenance)
    grid["mphdrr_version"] = VERSION
    return grid


def _drawn(affine: NDArray[np.float64], shape: Sequence[int], mirrored: bool, shift: float) -> NDArray[np.float64]:
    """The transform, on column vectors, of a .vdb that shows voxels of this affine where they are."""
    stored = np.eye(4)
    if mirrored:
        stored[0, 0], stored[0, 3] = -1.0, shape[0] - 1
    centers = np.eye(4)
    centers[:3, 3] = shift
    return affine @ stored @ centers


def _described(path: Path) -> dict[str, Any]:
    """Every grid of a file, without its voxels, by a name that OpenVDB finds it by; names that recur get a number."""
    grids = [grid for grid in openvdb().readAllGridMetadata(str(path)) if grid.name != SMOKE]
    names = [grid.name for grid in grids]
    named: dict[str, Any] = {}
    for k, grid in enumerate(grids):
        recurs = names.count(grid.name) > 1
        named[f"{grid.name}[{names[:k].count(grid.name)}]" if recurs else grid.name] = grid
    return named


def _chosen(grids: dict[str, Any], quantity: str | None, name: str | None) -> str:
    """The name of the grid to read."""
    if not grids:
        raise InputError("it holds no grid, or ends before the first")
    listed = ", ".join(f"{key!r} ({grid.valueTypeName})" for key, grid in grids.items())
    if name is not None:
        if name not in grids:
            raise InputError(f"it holds no grid {name!r}; expected one of {listed}")
        if grids[name].valueTypeName not in _NUMBERS:
            raise InputError(f"the grid {name!r} holds {grids[name].valueTypeName}; expected numbers")
        return name
    usable = [key for key, grid in grids.items() if grid.valueTypeName in _NUMBERS]
    if len(usable) > 1 and quantity is not None:
        usable = [key for key in usable if _quantity_of(grids[key]) == quantity] or usable
    if not usable:
        raise InputError(f"it holds no grid of numbers, but {listed}")
    if len(usable) > 1:
        raise InputError(f"it holds several grids: say which, of {listed}")
    return usable[0]


def _quantity_of(grid: Any) -> str | None:
    """What a grid says that it holds."""
    named = grid.metadata.get("mphdrr_quantity", grid.name)
    return named if named in UNITS else None


def _volume_of(grid: Any, quantity: str | None, unit: float) -> Volume:
    quantity = quantity or _quantity_of(grid) or "activity"
    if not grid.transform.isLinear:
        raise InputError(f"the grid {grid.name!r} is a frustum, whose voxels are no parallelepipeds: resample it first")
    drawn = _affine_of(grid.transform)
    first, last = (np.array(corner) for corner in grid.evalActiveVoxelBoundingBox())
    own = _own_lattice(grid, drawn)
    if own is not None:
        shape, affine, mirrored = own
        array = _values(grid, np.zeros(3, int), shape)
        return Volume(freeze(array[::-1].copy() if mirrored else array), Grid(shape, affine), quantity)
    if np.any(last < first):
        raise InputError(f"the grid {grid.name!r} has no active voxels")
    affine = np.diag([unit, unit, unit, 1.0]) @ _centered(grid, drawn)
    affine[:3, 3] += affine[:3, :3] @ first
    n_x, n_y, n_z = (int(n) for n in last - first + 1)
    array = _values(grid, first, (n_x, n_y, n_z))
    if grid.gridClass == openvdb().GridClass.LEVEL_SET:
        # Signed distances in the file's unit; the surface passes through voxels as a plane would.
        size = np.cbrt(abs(np.linalg.det(drawn[:3, :3])))
        array = np.clip(0.5 - array / np.float32(size), 0.0, 1.0)
    return Volume(freeze(array), Grid((n_x, n_y, n_z), affine), quantity)


def _own_lattice(
    grid: Any, drawn: NDArray[np.float64]
) -> tuple[tuple[int, int, int], NDArray[np.float64], bool] | None:
    """Shape, affine and whether it is stored mirrored, of a grid of ours that no other program has changed since."""
    known = grid.metadata
    if not {"mphdrr_shape", "mphdrr_affine", "mphdrr_mirrored", "mphdrr_center_shift"} <= known.keys():
        return None
    n_x, n_y, n_z = json.loads(known["mphdrr_shape"])
    shape = (n_x, n_y, n_z)
    affine = np.array(json.loads(known["mphdrr_affine"]))
    mirrored = bool(known["mphdrr_mirrored"])
    written = _drawn(affine, shape, mirrored, known["mphdrr_center_shift"])
    first, last = grid.evalActiveVoxelBoundingBox()
    inside = min(first) >= 0 and all(a < n for a, n in zip(last, shape, strict=True))
    # The metadata outlive what other programs do to the transform and the voxels.
    same = np.allclose(drawn, written, rtol=0, atol=1e-9 * np.abs(written).max())
    return (shape, affine, mirrored) if same and (inside or grid.activeVoxelCount() == 0) else None


def _centered(grid: Any, drawn: NDArray[np.float64]) -> NDArray[np.float64]:
    """From an integer index to the voxel's centre, of a grid whose transform is `drawn`.

    That is the transform itself, but for a grid of ours that was shifted for Blender 4.5 and has been moved since.
    """
    known = grid.metadata
    shift = known.get("mphdrr_center_shift", 0.0)
    if not shift or "mphdrr_affine" not in known:
        return drawn
    before, now = np.array(json.loads(known["mphdrr_affine"]))[:3, :3], drawn[:3, :3]
    # Voxels as large and as sheared as before; a mirrored grid is stored with its first axis turned round.
    was, is_now = np.abs(before.T @ before), np.abs(now.T @ now)
    if not np.allclose(is_now, was, rtol=0, atol=1e-6 * was.max()):
        warnings.warn(
            f"the grid {grid.name!r} was written for Blender 4.5, half a voxel off for other programs, and one of them has "
            "resampled it: it may lie that much off",
            InputWarning,
            stacklevel=4,
        )
        return drawn
    centers = np.eye(4)
    centers[:3, 3] = -shift
    return drawn @ centers


def _affine_of(transform: Any) -> NDArray[np.float64]:
    """A linear transform as a matrix (4, 4) on column vectors."""
    far = 2.0**20  # so that subtracting the origin costs no digits
    origin = np.array(transform.indexToWorld((0.0, 0.0, 0.0)))
    affine = np.eye(4)
    affine[:3, 3] = origin
    for axis in range(3):
        point = np.zeros(3)
        point[axis] = far
        affine[:3, axis] = (np.array(transform.indexToWorld(tuple(point))) - origin) / far
    return affine


def _values(grid: Any, first: NDArray[Any], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """The grid's values, from the voxel `first` on, active or not."""
    require(4.0 * np.prod(shape, dtype=float), f"the volume of {' x '.join(map(str, shape))} voxels")
    array = np.zeros(shape, np.float32)
    grid.copyToArray(array, ijk=tuple(int(i) for i in first))
    return array
