"""Core volumes <-> Blender's Volume objects.

The voxels lie in a .vdb (see `vdb`), so that a saved .blend can be projected again after it is opened. The object's
matrix carries the pose: the affine in the file is from voxel index to the object's own space, so that moving the object
moves the phantom.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InputError
from ..core.frames import checked_affine
from ..core.grid import Grid
from ..core.volume import UNITS, Volume
from . import compat, ids, storage, volume_materials
from .cameras import world_matrix
from .vdb import read_vdb, write_vdb

MAX_SHOWN_VOXELS = 256**3
"""More non-zero voxels than this are shown as a coarser copy: Blender's window would hang on them."""


def add_volume(
    volume: Volume,
    name: str,
    pose: ArrayLike | None = None,
    provenance: dict[str, Any] | None = None,
    collection: bpy.types.Collection | None = None,
) -> bpy.types.Object:
    """Put a volume into the scene as a Volume object with a material.

    Parameters
    ----------
    volume
        In world mm.
    name
        The object's name (Blender numbers it if it is taken).
    pose
        Rigid world-from-object matrix (4, 4): where the object's origin and axes shall be; the voxels stay where they
        are. Default: the origin at the grid's middle, axes along the world's.
    provenance
        What the volume was made from, kept in the file.
    collection
        Default: the scene's own.
    """
    data = _volume_data(volume, name, _pose_of(volume, pose), provenance)
    item = bpy.data.objects.new(name, data)
    (collection or bpy.context.scene.collection).objects.link(item)
    _describe(item, volume, _pose_of(volume, pose))
    return item


def replace_volume(
    item: bpy.types.Object, volume: Volume, pose: ArrayLike | None = None, provenance: dict[str, Any] | None = None
) -> None:
    """Give a Volume object other voxels (and pose, see `add_volume`); the old datablocks are removed."""
    old = item.data
    data = _volume_data(volume, item.name, _pose_of(volume, pose), provenance)
    item.data = data
    _describe(item, volume, _pose_of(volume, pose))
    if old.users == 0:
        materials = [m for m in old.materials if m]
        name = old.name
        bpy.data.volumes.remove(old)
        data.name = name
        for material in materials:
            if material.users == 0:
                bpy.data.materials.remove(material)


def volume_from_object(item: bpy.types.Object) -> Volume:
    """The exact volume that an object shows, in world mm, wherever the object has been moved, turned or scaled to.

    Raises
    ------
    InputError
        The object is not a volume of ours, or its file is gone.
    """
    return reader(item)()


def reader(item: bpy.types.Object) -> Callable[[], Volume]:
    """A function that does what `volume_from_object` does but leaves bpy alone, to be called in a thread.

    Raises
    ------
    InputError
        The object is not a volume of ours, or its file is gone.
    """
    if item is None or item.type != "VOLUME" or not getattr(item, ids.OBJECT_VOLUME).is_volume:
        what = "nothing is chosen" if item is None else f"{item.name!r} is no mphDRR volume"
        raise InputError(f"{what}: add a phantom first, or choose one")
    path, pose = file_of(item), pose_of_object(item)
    if not path.is_file():
        raise InputError(f"{path}: no such file; the voxels of {item.name!r} are gone, so add the volume again")

    def read() -> Volume:
        volume = read_vdb(path)
        return Volume(volume.array, Grid(volume.grid.shape, pose @ volume.grid.affine), volume.quantity)

    return read


def file_of(item: bpy.types.Object) -> Path:
    """The .vdb with every voxel of a Volume object."""
    return storage.full_resolution(storage.absolute(item.data.filepath))


def pose_of_object(item: bpy.types.Object) -> NDArray[np.float64]:
    """World-from-object matrix (4, 4).

    Blender keeps float32; the float64 pose that the object was given counts as long as it still rounds to Blender's.
    """
    shown = world_matrix(item)
    exact = getattr(item, ids.OBJECT_VOLUME).exact_pose
    if exact:
        pose = np.array(json.loads(exact))
        if np.allclose(pose[:3, :3], shown[:3, :3], rtol=0, atol=2e-6) and np.allclose(
            pose[:3, 3], shown[:3, 3], rtol=1e-6, atol=1e-6
        ):
            return pose
    return checked_affine(shown, f"{item.name}: its matrix")


def is_volume(item: bpy.types.Object | None) -> bool:
    """Whether an object is one of our volumes."""
    return item is not None and item.type == "VOLUME" and getattr(item, ids.OBJECT_VOLUME).is_volume


def volume_objects(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Our volumes in a scene, by name."""
    return sorted((item for item in scene.objects if is_volume(item)), key=lambda item: item.name)


def coarser(volume: Volume, factor: int = 2) -> Volume:
    """Means over blocks of `factor`^3 voxels, for display; voxels beyond the edge count as 0."""
    padding = [(0, -n % factor) for n in volume.grid.shape]
    array = np.pad(volume.array, padding) if any(p for _, p in padding) else volume.array
    a, b, c = (n // factor for n in array.shape)
    means = array.reshape(a, factor, b, factor, c, factor).mean(axis=(1, 3, 5), dtype=np.float32)
    blocks = np.diag([factor, factor, factor, 1.0])
    blocks[:3, 3] = (factor - 1) / 2  # the block's middle
    return Volume(means, Grid((a, b, c), volume.grid.affine @ blocks), volume.quantity)


@bpy.app.handlers.persistent
def after_load(*_: Any) -> None:
    """Rewrite volumes of a .blend that was saved by a Blender which draws voxels half a voxel elsewhere."""
    for item in bpy.data.objects:
        if not is_volume(item):
            continue
        settings = getattr(item, ids.OBJECT_VOLUME)
        if settings.center_shift != compat.VDB_CENTER_SHIFT:
            try:
                shown = _store(read_vdb(file_of(item)), {})
                item.data.filepath = storage.stored_path(shown)
                settings.center_shift = compat.VDB_CENTER_SHIFT
            except InputError as error:
                print(f"mphDRR: {item.name} is drawn half a voxel off: {error}")


def _pose_of(volume: Volume, pose: ArrayLike | None) -> NDArray[np.float64]:
    if pose is not None:
        return checked_affine(pose, "volume pose")
    middle = np.eye(4)
    middle[:3, 3] = volume.grid.center
    return middle


def _volume_data(
    volume: Volume, name: str, pose: NDArray[np.float64], provenance: dict[str, Any] | None
) -> bpy.types.Volume:
    """Volume datablock of `volume`, in the space of an object at `pose`."""
    local = Volume(volume.array, Grid(volume.grid.shape, np.linalg.inv(pose) @ volume.grid.affine), volume.quantity)
    path = _store(local, provenance)
    data = bpy.data.volumes.new(name)
    try:
        data.filepath = storage.stored_path(path)
        if not data.grids.load() or data.grids.error_message:
            raise InputError(
                f"{path}: Blender cannot load the volume ({data.grids.error_message or 'no reason given'})"
            )
        if volume.quantity not in data.grids:
            raise InputError(f"{path}: Blender finds no grid {volume.quantity!r} in it")
    except Exception:
        bpy.data.volumes.remove(data)
        raise
    maximum = float(np.abs(volume.array).max(initial=0.0)) or 1.0
    size = _extent(volume)
    data.render.precision = "FULL"
    data.render.space = "OBJECT"
    data.render.clipping = 0.0  # the default, 0.001, erases mu values and faint activity
    volume_materials.set_display(data, maximum, size)
    data.materials.append(volume_materials.new_material(f"{name} {volume.quantity}", volume.quantity, maximum, size))
    return data


def _store(local: Volume, provenance: dict[str, Any] | None) -> Path:
    """Write a volume, and a coarser copy if it is large, under names from their content; the path to show."""
    digest = hashlib.sha256(local.array.data)
    recipe = (local.grid.shape, local.grid.affine.tolist(), local.quantity, compat.VDB_CENTER_SHIFT, provenance or {})
    digest.update(json.dumps(recipe).encode())
    stem = f"{local.quantity}-{digest.hexdigest()[:16]}"
    path = storage.folder() / f"{stem}.vdb"
    if not path.exists():
        write_vdb(local, path, provenance)
    shown = local
    while np.count_nonzero(shown.array) > MAX_SHOWN_VOXELS:
        shown = coarser(shown)
    if shown is local:
        return path
    preview = path.with_name(stem + ids.PREVIEW_SUFFIX)
    if not preview.exists():
        write_vdb(shown, preview, {"coarser_copy_of": path.name})
    return preview


def _describe(item: bpy.types.Object, volume: Volume, pose: NDArray[np.float64]) -> None:
    from mathutils import Matrix

    item.matrix_world = Matrix(pose)
    settings = getattr(item, ids.OBJECT_VOLUME)
    settings.is_volume = True
    settings.quantity = volume.quantity
    settings.unit = UNITS[volume.quantity]
    settings.shape = volume.grid.shape
    settings.spacing = volume.grid.spacing
    settings.maximum = float(volume.array.max(initial=0.0))
    settings.exact_pose = json.dumps(pose.tolist())
    settings.center_shift = compat.VDB_CENTER_SHIFT


def _extent(volume: Volume) -> float:
    """Largest side, mm, of the box around the voxels that are not 0."""
    filled = volume.array != 0
    sides = []
    for axis, spacing in enumerate(volume.grid.spacing):
        used = np.flatnonzero(filled.any(axis=tuple(k for k in range(3) if k != axis)))
        sides.append(spacing * (used[-1] - used[0] + 1) if len(used) else spacing)
    return float(max(sides))
