"""OpenVDB files: our own volumes, exact to the last bit, and grids of other programs.

Our files hold every voxel's float32 value, the float64 affine, the quantity, the unit and where the volume came from. The
transform is OpenVDB's own, in which an integer index is the voxel's CENTRE: Houdini, EmberGen and Blender 5 place grids so.
Blender 4.5 draws them half a voxel farther along every index axis. So the files that a scene draws are shifted back there,
and say so in their metadata; files written for other programs are not shifted.
"""

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError, reading, warn
from ...core.files import replacing, require_file
from ...core.geometry.frames import affine_matrix
from ...core.geometry.grid import Grid
from ...core.memory import require
from ...core.validation import freeze, positive
from ...core.version import VERSION
from ...core.volumes.volume import AIR_HU, UNITS, Volume

SMOKE = "smoke for display"  # a grid that only Blender's solid viewport uses
BACKGROUND = {"hu": AIR_HU}
"""Value of the voxels that take no room in a file, where it is not 0: around a CT there is air, not water."""
_NUMBERS = ("float", "double", "half", "int32", "int64", "bool")  # value types that can become a volume
_SLAB = 64  # layers copied to OpenVDB at once: the copy stays small
_NOTE = (
    "Written for a Blender that draws index i over [i, i + 1]: the centre of voxel i is where this transform carries "
    "i {back:+g} along every axis. File > Export > Volume of mphDRR writes files for other programs."
)
_MAGIC = 0x56444220  # " BDV", OpenVDB's io::OPENVDB_MAGIC
_UUID_CHARACTERS, _LONGEST_TEXT, _MOST_GRIDS = 36, 1 << 20, 10_000  # of a .vdb's header


def write_vdb(
    volume: Volume,
    path: str | Path,
    provenance: dict[str, Any] | None = None,
    *,
    smoke_above: float | None = None,
    center_shift: float = 0.0,
) -> None:
    """Write a volume as a sparse float grid named after its quantity; voxels of 0 (-1000 HU) take no room.

    The `provenance`, what the volume was made from, is kept as JSON. With `smoke_above`, a grid `SMOKE` holds the values
    above that one, minus it: Blender's solid viewport draws the surroundings of values below 0 black. The transform is
    shifted by `center_shift` voxels along every index axis, for the Blender that draws the file
    (`compat.VDB_CENTER_SHIFT`). `read_vdb` gives the same volume whatever the shift, without the smoke.
    """
    grids = [_grid_of(volume, provenance or {}, center_shift)]
    if smoke_above is not None:
        above = freeze(np.maximum(volume.array - np.float32(smoke_above), 0))
        grids.append(_grid_of(Volume(above, volume.grid), {}, center_shift))
        grids[-1].name = SMOKE
    with replacing(path) as temporary:
        openvdb().write(str(temporary), grids=grids)
        if _end(temporary) != temporary.stat().st_size:  # OpenVDB does not say that a write failed
            raise OSError("the disk is full, or has gone")


def read_vdb(path: str | Path, quantity: str | None = None, grid: str | None = None, *, unit: float = 1.0) -> Volume:
    """Read a grid as a volume: our own exactly, another program's by its transform.

    Another program's grid becomes a volume on the box around its active voxels, with all values in the box, active or not,
    in float32; outside of it a volume is 0, whatever the grid's background. A level set gives the share (0 to 1) of each
    voxel that lies inside it. Raises `InputError` where the file or the grid cannot be read as a volume.

    Parameters
    ----------
    path
        The file.
    quantity
        What the values are, one of `UNITS`, and which of several grids. Default: what the file says, or else activity.
    grid
        The grid's name; needed where a file holds several and `quantity` does not tell which.
    unit
        Length in mm of the file's unit, for files of other programs: 1000 for one in metres.
    """
    path = require_file(path)
    if quantity is not None and quantity not in UNITS:
        raise InputError(f"quantity {quantity!r}: expected one of {', '.join(UNITS)}")
    unit = positive(unit, "unit of the file's lengths", "mm")
    if (missing := _end(path) - path.stat().st_size) > 0:
        raise InputError(f"{path}: is cut off, {missing} bytes are missing at its end")
    with reading(path, "an OpenVDB volume"):
        name = _chosen(_described(path), quantity, grid)
        return _volume_of(openvdb().read(str(path), name), quantity, unit)


def provenance_of(path: Path) -> dict[str, Any]:
    """What our file's first volume was made from; empty for damaged files and those of other programs."""
    try:
        grids = _described(path).values()
    except Exception:  # whatever OpenVDB raises; `read_vdb` says what is wrong
        return {}
    texts = (grid.metadata.get("mphdrr_provenance") for grid in grids)
    return dict(json.loads(next(filter(None, texts), "{}")))


def openvdb() -> Any:
    """OpenVDB's Python module, which comes with Blender."""
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
    if mirrored:  # Blender 4.5 draws nothing with a left-handed transform: count voxels from the other end
        array = array[::-1]
    require(4.0 * array.size, f"writing {' x '.join(map(str, array.shape))} voxels")
    for first in range(0, len(array), _SLAB):
        # A copy, because OpenVDB takes neither strides nor read-only arrays.
        slab = np.array(array[first : first + _SLAB], np.float32, order="C")
        grid.copyFromArray(slab, ijk=(first, 0, 0), tolerance=0.0)
    grid.name = volume.quantity
    grid.gridClass = vdb.GridClass.FOG_VOLUME
    # OpenVDB's matrices act on row vectors.
    grid.transform = vdb.createLinearTransform(_drawn(affine, volume.grid.shape, mirrored, shift).T.tolist())
    known = {
        "quantity": volume.quantity, "unit": volume.unit, "shape": json.dumps(volume.grid.shape),
        "affine": json.dumps(affine.tolist()), "mirrored": mirrored, "center_shift": shift,
        "provenance": json.dumps(provenance), "version": VERSION,
    } | ({"note": _NOTE.format(back=-shift)} if shift else {})  # fmt: skip
    for key, value in known.items():
        grid[f"mphdrr_{key}"] = value
    return grid


def _drawn(affine: NDArray[np.float64], shape: Sequence[int], mirrored: bool, shift: float) -> NDArray[np.float64]:
    """The transform, on column vectors, of a .vdb that shows voxels with this affine in their place."""
    stored = np.eye(4)
    if mirrored:
        stored[0, 0], stored[0, 3] = -1.0, shape[0] - 1
    return affine @ stored @ affine_matrix(np.eye(3), np.full(3, shift))


def _described(path: Path) -> dict[str, Any]:
    """The grids of a file, without voxels, by the names that OpenVDB reads them by: those that recur have a number."""
    grids = [grid for grid in openvdb().readAllGridMetadata(str(path)) if grid.name != SMOKE]
    names = [grid.name for grid in grids]
    numbered = [f"{name}[{names[:k].count(name)}]" if names.count(name) > 1 else name for k, name in enumerate(names)]
    return dict(zip(numbered, grids, strict=True))


def _chosen(grids: dict[str, Any], quantity: str | None, name: str | None) -> str:
    if not grids:
        raise InputError("it holds no grid, or ends before the first")
    listed = ", ".join(f"{key!r} ({grid.valueTypeName})" for key, grid in grids.items())
    usable = [key for key, grid in grids.items() if grid.valueTypeName in _NUMBERS and name in (None, key)]
    if len(usable) > 1 and quantity is not None:
        usable = [key for key in usable if _quantity_of(grids[key]) == quantity] or usable
    if not usable:
        raise InputError(f"it holds no grid of numbers{'' if name is None else f' {name!r}'}, but {listed}")
    if len(usable) > 1:
        raise InputError(f"it holds several grids: say which, of {listed}")
    return usable[0]


def _quantity_of(grid: Any) -> str | None:
    """The quantity that a grid's metadata or name says it holds."""
    named = grid.metadata.get("mphdrr_quantity", grid.name)
    return named if named in UNITS else None


def _volume_of(grid: Any, quantity: str | None, unit: float) -> Volume:
    quantity = quantity or _quantity_of(grid) or "activity"
    if not grid.transform.isLinear:
        raise InputError(f"the grid {grid.name!r} is a frustum, whose voxels are no parallelepipeds: resample it first")
    far = 2.0**20  # index units: far enough that subtracting the origin costs no digits
    origin, *ends = (np.array(grid.transform.indexToWorld(tuple(point))) for point in far * np.eye(4, 3, -1))
    drawn = affine_matrix((np.array(ends) - origin).T / far, origin)  # on column vectors
    known = grid.metadata
    first, last = (np.array(corner) for corner in grid.evalActiveVoxelBoundingBox())
    if {"mphdrr_shape", "mphdrr_affine", "mphdrr_mirrored", "mphdrr_center_shift"} <= known.keys():
        shape, affine = json.loads(known["mphdrr_shape"]), np.array(json.loads(known["mphdrr_affine"]))
        written = _drawn(affine, shape, known["mphdrr_mirrored"], known["mphdrr_center_shift"])
        inside = (first.min() >= 0 and np.all(last < shape)) or grid.activeVoxelCount() == 0
        # The metadata outlive what other programs do to the transform and the voxels.
        if inside and np.allclose(drawn, written, rtol=0, atol=1e-9 * np.abs(written).max()):
            array = _values(grid, np.zeros(3, int), shape)
            return Volume(
                freeze(array[::-1].copy() if known["mphdrr_mirrored"] else array), Grid(shape, affine), quantity
            )
    if np.any(last < first):
        raise InputError(f"the grid {grid.name!r} has no active voxels")
    affine = np.diag([unit, unit, unit, 1.0]) @ _centered(grid, drawn)
    affine[:3, 3] += affine[:3, :3] @ first
    n_x, n_y, n_z = (int(n) for n in last - first + 1)
    array = _values(grid, first, (n_x, n_y, n_z))
    if grid.gridClass == openvdb().GridClass.LEVEL_SET:
        # Signed distances in the file's unit; inside a voxel the surface is taken for a plane.
        size = np.cbrt(abs(np.linalg.det(drawn[:3, :3])))
        array = np.clip(0.5 - array / np.float32(size), 0.0, 1.0)
    return Volume(freeze(array), Grid((n_x, n_y, n_z), affine), quantity)


def _centered(grid: Any, drawn: NDArray[np.float64]) -> NDArray[np.float64]:
    """From an integer index to the voxel's centre: the transform, unless it is shifted for Blender 4.5."""
    known = grid.metadata
    shift = known.get("mphdrr_center_shift", 0.0)
    if not shift or "mphdrr_affine" not in known:
        return drawn
    before, now = np.array(json.loads(known["mphdrr_affine"]))[:3, :3], drawn[:3, :3]
    # Has it been resampled? Compare the voxels' sizes and shears; a mirrored grid has its first axis turned round.
    was, is_now = np.abs(before.T @ before), np.abs(now.T @ now)
    if not np.allclose(is_now, was, rtol=0, atol=1e-6 * was.max()):
        warn(
            f"the grid {grid.name!r} was written for Blender 4.5, half a voxel off for other programs, and one of them has "
            "resampled it: it may lie that much off",
            4,
        )
        return drawn
    return drawn @ affine_matrix(np.eye(3), np.full(3, -shift))


def _values(grid: Any, first: NDArray[Any], shape: Sequence[int]) -> NDArray[np.float32]:
    """The grid's values from the voxel `first` on, active or not."""
    require(4.0 * np.prod(shape, dtype=float), f"the volume of {' x '.join(map(str, shape))} voxels")
    array = np.zeros(shape, np.float32)
    grid.copyToArray(array, ijk=tuple(int(i) for i in first))
    return array


def _end(path: Path) -> int:
    """Where the last grid of a file ends; 0 where its layout does not say.

    OpenVDB itself reads past a missing end and takes what it finds for values. Its `io::Archive` is a header, the file's
    metadata, then each grid after a descriptor with the offsets at which its parts begin and end.
    """
    with open(path, "rb") as file:

        def numbers(kinds: str) -> tuple[int, ...]:
            return struct.unpack(f"<{kinds}", file.read(struct.calcsize(f"<{kinds}")))

        def count(most: int) -> int:
            (number,) = numbers("I")
            if number > most:
                raise struct.error("another layout")
            return number

        def skip_texts() -> None:  # name, type and value of metadata; name, type and instance parent of a grid
            for _ in range(3):
                file.seek(count(_LONGEST_TEXT), 1)

        end = 0
        try:
            magic, _version, _major, _minor, has_offsets = numbers("qIIIB")
            if magic != _MAGIC or not has_offsets:
                return 0
            file.seek(_UUID_CHARACTERS, 1)
            for _ in range(count(_MOST_GRIDS)):
                skip_texts()
            for _ in range(count(_MOST_GRIDS)):
                skip_texts()
                _begin, _blocks, end = numbers("qqq")
                file.seek(max(end, 0))
        except struct.error:  # OpenVDB itself refuses a file that is cut off in its header
            return 0
        return end
