"""OpenVDB files: our own volumes, exact to the last bit, and grids of other programs.

Our files hold every voxel's float32 value, the float64 affine, the quantity, the unit and the provenance. The transform is
OpenVDB's own, in which an integer index is the voxel's CENTRE: Houdini, EmberGen and Blender 5 place grids so. Blender 4.5
draws them half a voxel farther along every index axis. So the files that a scene draws are shifted back there, and their
metadata say so; files written for other programs are not shifted.
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

SMOKE = "smoke for display"  # name of the grid that only Blender's solid viewport uses
BACKGROUND = {"hu": AIR_HU}
"""Value of the voxels that are not stored, where it is not 0: around a CT there is air, not water."""
_NUMBER_TYPES = ("float", "double", "half", "int32", "int64", "bool")  # value types that can become a volume
_SLAB_LAYERS = 64  # layers copied to OpenVDB at a time, to keep the copy small
_NOTE = (
    "Written for a Blender that draws index i over [i, i + 1]: the centre of voxel i is where this transform carries "
    "i {back:+g} along every axis. File > Export > Volume of mphDRR writes files for other programs."
)
_MAGIC = 0x56444220  # " BDV", OpenVDB's io::OPENVDB_MAGIC
# A .vdb's header: length of its UUID, and bounds on the length of a text and on the number of entries or grids.
_UUID_CHARACTERS, _MAX_TEXT, _MAX_GRIDS = 36, 1 << 20, 10_000


def write_vdb(
    volume: Volume,
    path: str | Path,
    provenance: dict[str, Any] | None = None,
    *,
    smoke_above: float | None = None,
    center_shift: float = 0.0,
) -> None:
    """Write a volume as a sparse float grid named after its quantity; voxels of 0 (-1000 HU) take no room.

    The `provenance`, what the volume was made from, is kept as JSON. With `smoke_above`, a second grid `SMOKE` holds
    max(value - smoke_above, 0): Blender's solid viewport draws the surroundings of negative values black. The transform is
    shifted by `center_shift` voxels along every index axis, for the Blender that draws the file
    (`compat.VDB_CENTER_SHIFT`). `read_vdb` gives the same volume whatever the shift, without the smoke.
    """
    grids = [_make_grid(volume, provenance or {}, center_shift)]
    if smoke_above is not None:
        above = freeze(np.maximum(volume.array - np.float32(smoke_above), 0))
        grids.append(_make_grid(Volume(above, volume.grid), {}, center_shift))
        grids[-1].name = SMOKE
    with replacing(path) as temporary:
        openvdb().write(str(temporary), grids=grids)
        if _end_of_last_grid(temporary) != temporary.stat().st_size:  # OpenVDB does not report a failed write
            raise OSError("the disk is full, or has gone")


def read_vdb(path: str | Path, quantity: str | None = None, grid: str | None = None, *, unit: float = 1.0) -> Volume:
    """Read a grid as a volume: our own exactly, another program's by its transform.

    Another program's grid becomes a volume on the box around its active voxels, with all values in the box, active or not,
    in float32; outside of it a volume is 0, whatever the grid's background. A level set becomes the fraction (0 to 1) of
    each voxel that lies inside it. Raises `InputError` where the file or the grid cannot be read as a volume.

    Parameters
    ----------
    path
        The file.
    quantity
        Quantity of the values, one of `UNITS`; it also selects one of several grids. Default: the file's, or else activity.
    grid
        The grid's name; needed where a file holds several and `quantity` does not tell which.
    unit
        Length in mm of the file's unit, for files of other programs: 1000 for one in metres.
    """
    path = require_file(path)
    if quantity is not None and quantity not in UNITS:
        raise InputError(f"quantity {quantity!r}: expected one of {', '.join(UNITS)}")
    unit = positive(unit, "unit of the file's lengths", "mm")
    if (missing := _end_of_last_grid(path) - path.stat().st_size) > 0:
        raise InputError(f"{path}: is cut off, {missing} bytes are missing at its end")
    with reading(path, "an OpenVDB volume"):
        name = _choose_grid(_grids_by_name(path), quantity, grid)
        return _grid_to_volume(openvdb().read(str(path), name), quantity, unit)


def read_provenance(path: Path) -> dict[str, Any]:
    """Return the provenance of our file's first volume; empty for damaged files and those of other programs."""
    try:
        grids = _grids_by_name(path).values()
    except Exception:  # OpenVDB raises errors of any type; `read_vdb` reports them
        return {}
    texts = (grid.metadata.get("mphdrr_provenance") for grid in grids)
    return dict(json.loads(next(filter(None, texts), "{}")))


def openvdb() -> Any:
    """Return OpenVDB's Python module, which comes with Blender."""
    try:
        import openvdb
    except ImportError:
        if not hasattr(bpy.utils, "expose_bundled_modules"):
            raise InputError("this Blender has no openvdb module: use 4.5 or later from blender.org") from None
        bpy.utils.expose_bundled_modules()  # only the bpy wheel needs this
        import openvdb
    return openvdb


def _make_grid(volume: Volume, provenance: dict[str, Any], shift: float) -> Any:
    """Return a volume as OpenVDB's grid with our metadata."""
    vdb = openvdb()
    grid = vdb.FloatGrid(BACKGROUND.get(volume.quantity, 0.0))
    array, affine = volume.array, volume.grid.affine
    mirrored = bool(np.linalg.det(affine[:3, :3]) < 0)
    if mirrored:  # Blender 4.5 draws nothing with a left-handed transform: reverse the first axis
        array = array[::-1]
    require(4.0 * array.size, f"writing {' x '.join(map(str, array.shape))} voxels")
    for first in range(0, len(array), _SLAB_LAYERS):
        # Copied, because OpenVDB takes neither strides nor read-only arrays.
        slab = np.array(array[first : first + _SLAB_LAYERS], np.float32, order="C")
        grid.copyFromArray(slab, ijk=(first, 0, 0), tolerance=0.0)
    grid.name = volume.quantity
    grid.gridClass = vdb.GridClass.FOG_VOLUME
    # OpenVDB's matrices act on row vectors.
    grid.transform = vdb.createLinearTransform(_transform(affine, volume.grid.shape, mirrored, shift).T.tolist())
    metadata = {
        "quantity": volume.quantity, "unit": volume.unit, "shape": json.dumps(volume.grid.shape),
        "affine": json.dumps(affine.tolist()), "mirrored": mirrored, "center_shift": shift,
        "provenance": json.dumps(provenance), "version": VERSION,
    } | ({"note": _NOTE.format(back=-shift)} if shift else {})  # fmt: skip
    for key, value in metadata.items():
        grid[f"mphdrr_{key}"] = value
    return grid


def _transform(affine: NDArray[np.float64], shape: Sequence[int], mirrored: bool, shift: float) -> NDArray[np.float64]:
    """Return the .vdb transform (4, 4), on column vectors, that draws voxels with this affine in their place."""
    volume_from_vdb = np.eye(4)
    if mirrored:
        volume_from_vdb[0, 0], volume_from_vdb[0, 3] = -1.0, shape[0] - 1
    return affine @ volume_from_vdb @ affine_matrix(np.eye(3), np.full(3, shift))


def _grids_by_name(path: Path) -> dict[str, Any]:
    """Return a file's grids, without voxels, by OpenVDB's unique names, such as "density[1]" for the second of that name."""
    grids = [grid for grid in openvdb().readAllGridMetadata(str(path)) if grid.name != SMOKE]
    names = [grid.name for grid in grids]
    numbered = [f"{name}[{names[:k].count(name)}]" if names.count(name) > 1 else name for k, name in enumerate(names)]
    return dict(zip(numbered, grids, strict=True))


def _choose_grid(grids: dict[str, Any], quantity: str | None, name: str | None) -> str:
    """Return the name of the grid to read; `InputError` where there is none or more than one."""
    if not grids:
        raise InputError("it holds no grid, or ends before the first")
    listed = ", ".join(f"{key!r} ({grid.valueTypeName})" for key, grid in grids.items())
    usable = [key for key, grid in grids.items() if grid.valueTypeName in _NUMBER_TYPES and name in (None, key)]
    if len(usable) > 1 and quantity is not None:
        usable = [key for key in usable if _grid_quantity(grids[key]) == quantity] or usable
    if not usable:
        raise InputError(f"it holds no grid of numbers{'' if name is None else f' {name!r}'}, but {listed}")
    if len(usable) > 1:
        raise InputError(f"it holds several grids: say which, of {listed}")
    return usable[0]


def _grid_quantity(grid: Any) -> str | None:
    """Return the quantity named in a grid's metadata, or by the grid's own name; None for another word."""
    word = grid.metadata.get("mphdrr_quantity", grid.name)
    return word if word in UNITS else None


def _grid_to_volume(grid: Any, quantity: str | None, unit: float) -> Volume:
    """Return a grid as a volume: ours exactly if it is unchanged, else the box around the active voxels."""
    quantity = quantity or _grid_quantity(grid) or "activity"
    if not grid.transform.isLinear:
        raise InputError(f"the grid {grid.name!r} is a frustum, whose voxels are no parallelepipeds: resample it first")
    far = 2.0**20  # index units: far enough that subtracting the origin costs no digits
    origin, *ends = (np.array(grid.transform.indexToWorld(tuple(point))) for point in far * np.eye(4, 3, -1))
    transform = affine_matrix((np.array(ends) - origin).T / far, origin)  # on column vectors
    metadata = grid.metadata
    first, last = (np.array(corner) for corner in grid.evalActiveVoxelBoundingBox())
    if {"mphdrr_shape", "mphdrr_affine", "mphdrr_mirrored", "mphdrr_center_shift"} <= metadata.keys():
        shape, affine = json.loads(metadata["mphdrr_shape"]), np.array(json.loads(metadata["mphdrr_affine"]))
        original = _transform(affine, shape, metadata["mphdrr_mirrored"], metadata["mphdrr_center_shift"])
        is_inside = (first.min() >= 0 and np.all(last < shape)) or grid.activeVoxelCount() == 0
        # The metadata outlive what other programs do to the transform and the voxels.
        if is_inside and np.allclose(transform, original, rtol=0, atol=1e-9 * np.abs(original).max()):
            array = _dense_values(grid, np.zeros(3, int), shape)
            array = array[::-1].copy() if metadata["mphdrr_mirrored"] else array
            return Volume(freeze(array), Grid(shape, affine), quantity)
    if np.any(last < first):
        raise InputError(f"the grid {grid.name!r} has no active voxels")
    affine = np.diag([unit, unit, unit, 1.0]) @ _voxel_center_transform(grid, transform)
    affine[:3, 3] += affine[:3, :3] @ first
    n_x, n_y, n_z = (int(n) for n in last - first + 1)
    array = _dense_values(grid, first, (n_x, n_y, n_z))
    if grid.gridClass == openvdb().GridClass.LEVEL_SET:
        # Signed distances in the file's unit; inside a voxel the surface is taken for a plane.
        size = np.cbrt(abs(np.linalg.det(transform[:3, :3])))
        array = np.clip(0.5 - array / np.float32(size), 0.0, 1.0)
    return Volume(freeze(array), Grid((n_x, n_y, n_z), affine), quantity)


def _voxel_center_transform(grid: Any, transform: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix (4, 4) from an index to the voxel's centre: the transform without the shift for Blender 4.5."""
    metadata = grid.metadata
    shift = metadata.get("mphdrr_center_shift", 0.0)
    if not shift or "mphdrr_affine" not in metadata:
        return transform
    original, current = np.array(json.loads(metadata["mphdrr_affine"]))[:3, :3], transform[:3, :3]
    # A resampled grid has other voxel sizes or shears; absolute values allow for the reversed axis of a mirrored grid.
    original_metric, current_metric = np.abs(original.T @ original), np.abs(current.T @ current)
    if not np.allclose(current_metric, original_metric, rtol=0, atol=1e-6 * original_metric.max()):
        warn(
            f"the grid {grid.name!r} was written for Blender 4.5, half a voxel off for other programs, and one of them has "
            "resampled it: it may lie that much off",
            4,
        )
        return transform
    return transform @ affine_matrix(np.eye(3), np.full(3, -shift))


def _dense_values(grid: Any, first: NDArray[Any], shape: Sequence[int]) -> NDArray[np.float32]:
    """Return the values of a grid, active or not, in a box of a `shape` whose first voxel is `first`."""
    require(4.0 * np.prod(shape, dtype=float), f"the volume of {' x '.join(map(str, shape))} voxels")
    array = np.zeros(shape, np.float32)
    grid.copyToArray(array, ijk=tuple(int(i) for i in first))
    return array


def _end_of_last_grid(path: Path) -> int:
    """Return the byte position at which the last grid of a file ends; 0 where the file has no offsets that tell it.

    OpenVDB itself reads past a missing end and takes what it finds for values. Its `io::Archive` is a header, the file's
    metadata, then each grid after a descriptor with the offsets at which its parts begin and end.
    """
    with open(path, "rb") as file:

        def read_numbers(types: str) -> tuple[int, ...]:
            """Read numbers of the given `struct` types."""
            return struct.unpack(f"<{types}", file.read(struct.calcsize(f"<{types}")))

        def read_count(limit: int) -> int:
            """Read a number of items; refuse one above `limit`."""
            (number,) = read_numbers("I")
            if number > limit:
                raise struct.error("another layout")
            return number

        def skip_texts() -> None:
            """Move past three texts at the present position."""
            # Metadata have a name, type and value; a grid has a name, type and instance parent.
            for _ in range(3):
                file.seek(read_count(_MAX_TEXT), 1)

        end = 0
        try:
            magic, _version, _major, _minor, has_offsets = read_numbers("qIIIB")
            if magic != _MAGIC or not has_offsets:
                return 0
            file.seek(_UUID_CHARACTERS, 1)
            for _ in range(read_count(_MAX_GRIDS)):
                skip_texts()
            for _ in range(read_count(_MAX_GRIDS)):
                skip_texts()
                _begin, _blocks, end = read_numbers("qqq")
                file.seek(max(end, 0))
        except struct.error:  # OpenVDB itself refuses a file that is cut off in its header
            return 0
        return end
