"""Core volumes <-> Blender's Volume objects.

The voxels lie in a .vdb (see `vdb`), so that a saved .blend can be projected again after it is opened. The object's
matrix carries the pose: the affine in the file is from voxel index to the object's own space, so that moving the object
moves the phantom.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InputError
from ..core.geometry.frames import checked_affine
from ..core.geometry.grid import Grid
from ..core.memory import readable_size
from ..core.physics.maps import MAPS
from ..core.volumes.volume import UNITS, Volume
from . import compat, ids, storage, volume_materials
from .cameras import world_matrix
from .vdb import BACKGROUND, SMOKE, read_vdb, write_vdb

MAX_SHOWN_VOXELS = 256**3
"""More non-zero voxels than this are shown as a coarser copy: Blender's window would hang on them."""


@dataclass(frozen=True)
class StoredVolume:
    """A volume, or the states of one, whose voxels are in files, ready to be put into the scene.

    Attributes
    ----------
    states : tuple of Volume
        In world mm.
    pose : array (4, 4)
        World-from-object matrix.
    path : Path
        The .vdb that Blender shows, of the first state: every voxel, or a coarser copy.
    low, high : float
        Smallest and largest value.
    extent : float
        Largest side, mm, of the box around the voxels that are not empty.
    """

    states: tuple[Volume, ...]
    pose: NDArray[np.float64]
    path: Path
    low: float
    high: float
    extent: float

    @property
    def volume(self) -> Volume:
        """The first state, or the only one."""
        return self.states[0]


def store_volume(
    volume: Volume | Sequence[Volume],
    folder: Path,
    pose: ArrayLike | None = None,
    provenance: dict[str, Any] | None = None,
) -> StoredVolume:
    """Do of `add_volume`, or `add_volume_sequence`, what leaves bpy alone and takes long, for a job's thread.

    `folder` is `storage.folder()`.
    """
    states = (volume,) if isinstance(volume, Volume) else tuple(volume)
    if len({state.quantity for state in states}) != 1:
        found = ", ".join(state.quantity for state in states) or "none"
        raise InputError(f"volume sequence: expected volumes of one quantity, got {found}")
    pose = _pose_of(states[0], pose)
    to_object = np.linalg.inv(pose)
    local = [Volume(v.array, Grid(v.grid.shape, to_object @ v.grid.affine), v.quantity) for v in states]
    return StoredVolume(
        states,
        pose,
        _store(local, folder, provenance),
        min(float(v.array.min()) for v in states),
        max(float(v.array.max()) for v in states),
        max(_extent(v) for v in states),
    )


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
    return add_stored(store_volume(volume, storage.folder(), pose, provenance), name, collection)


def add_volume_sequence(
    volumes: Sequence[Volume],
    name: str,
    pose: ArrayLike | None = None,
    provenance: dict[str, Any] | None = None,
    collection: bpy.types.Collection | None = None,
    frame_start: int = 1,
) -> bpy.types.Object:
    """Put the states of something that changes into the scene, such as a beating heart: one for each Blender frame.

    From `frame_start` on the states follow each other, and begin anew after the last one (`Volume.sequence_mode`).
    `volume_from_object` and projections take the state of the scene's current frame.

    Parameters
    ----------
    volumes
        The states, in world mm, of one quantity.
    name, pose, provenance, collection
        See `add_volume`; the default pose is the middle of the first state's grid.
    frame_start
        Frame of the first state.

    Raises
    ------
    InputError
        No states, or states of several quantities.
    """
    item = add_stored(store_volume(tuple(volumes), storage.folder(), pose, provenance), name, collection)
    item.data.frame_start = frame_start
    return item


def add_stored(stored: StoredVolume, name: str, collection: bpy.types.Collection | None = None) -> bpy.types.Object:
    """Put a stored volume into the scene; see `add_volume`."""
    item = bpy.data.objects.new(name, _volume_data(stored, name))
    (collection or bpy.context.scene.collection).objects.link(item)
    _describe(item, stored)
    return item


def replace_volume(
    item: bpy.types.Object, volume: Volume, pose: ArrayLike | None = None, provenance: dict[str, Any] | None = None
) -> None:
    """Give a Volume object other voxels (and pose, see `add_volume`).

    Its datablock stays, with what the user has set on it; one of another quantity, or that other objects show too, is
    replaced, and removed if nothing else needs it.
    """
    replace_stored(item, store_volume(volume, storage.folder(), pose, provenance))


def replace_stored(item: bpy.types.Object, stored: StoredVolume) -> None:
    """Give a Volume object the voxels of a stored volume; see `replace_volume`."""
    old, settings = item.data, getattr(item, ids.OBJECT_VOLUME)
    if old.users == 1 and settings.quantity == stored.volume.quantity:  # in place: what the user set on it stays
        _show(old, stored)
        for material in old.materials:
            if material is not None:
                volume_materials.resize(material, settings.extent, stored.extent)
        _describe(item, stored)
        return
    item.data = data = _volume_data(stored, item.name)
    _describe(item, stored)
    if old.users == 0:
        materials = [m for m in old.materials if m]
        name = old.name
        bpy.data.volumes.remove(old)
        data.name = name
        for material in materials:
            if material.users == 0:
                bpy.data.materials.remove(material)


def make_active(context: bpy.types.Context, item: bpy.types.Object) -> None:
    """Select a new volume alone, and let EEVEE draw it."""
    volume_materials.show_in_eevee(context.scene)
    for other in context.selected_objects:
        other.select_set(False)
    item.select_set(True)
    context.view_layer.objects.active = item


def show_range(item: bpy.types.Object) -> None:
    """Draw a volume in its display range (`VolumeProperties.display_low` and `display_high`)."""
    settings = getattr(item, ids.OBJECT_VOLUME)
    low, high = settings.display_low, max(settings.display_high, settings.display_low + 1e-30)
    for material in item.data.materials:
        if material is not None:
            volume_materials.set_range(material, low, high)
    volume_materials.set_display(item.data, low, high, settings.extent)


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
    _require_voxels(item)
    if _state(item.data) is None:
        raise InputError(f"{item.name!r} has no state at frame {bpy.context.scene.frame_current}")
    return _reader(item, file_of(item))


def state_readers(item: bpy.types.Object) -> list[Callable[[], Volume]]:
    """`reader` of every state of a sequence, in their order; of any other volume the one of it."""
    _require_voxels(item)
    data, path = item.data, storage.full_resolution(storage.absolute(item.data.filepath))
    if not data.is_sequence:
        return [_reader(item, path)]
    numbers = range(data.frame_offset + 1, data.frame_offset + 1 + data.frame_duration)
    return [_reader(item, storage.of_frame(path, number)) for number in numbers]


def _require_voxels(item: bpy.types.Object) -> None:
    """Refuse what is no volume of ours; give one that is sketched its voxels."""
    if item is None or item.type != "VOLUME" or not getattr(item, ids.OBJECT_VOLUME).is_volume:
        what = "nothing is chosen" if item is None else f"{item.name!r} is no mphDRR volume"
        raise InputError(f"{what}: add a phantom first, or choose one")
    if getattr(item, ids.OBJECT_VOLUME).sketched:
        from . import live_phantoms  # which imports this module

        live_phantoms.settle(item)


def _reader(item: bpy.types.Object, path: Path) -> Callable[[], Volume]:
    pose = pose_of_object(item)
    if not path.is_file():
        raise InputError(f"{path}: no such file; the voxels of {item.name!r} are gone, so add the volume again")

    def read() -> Volume:
        volume = read_vdb(path)
        return Volume(volume.array, Grid(volume.grid.shape, pose @ volume.grid.affine), volume.quantity)

    return read


def file_of(item: bpy.types.Object) -> Path:
    """The .vdb with every voxel of a Volume object; of a sequence, that of the current frame."""
    path = storage.full_resolution(storage.absolute(item.data.filepath))
    return storage.of_frame(path, _state(item.data) or 1) if item.data.is_sequence else path


def state_text(item: bpy.types.Object) -> str:
    """Which state of a sequence the current frame shows: "3 of 8"."""
    state = _state(item.data)
    return "none" if state is None else f"{state - item.data.frame_offset} of {item.data.frame_duration}"


def file_state(item: bpy.types.Object) -> str:
    """What there is to say about a Volume object's file: its size, or that it is missing."""
    size = storage.size_of(file_of(item))
    if size is None:
        return "missing"
    shown = ", coarser copy shown" if storage.is_preview(storage.absolute(item.data.filepath)) else ""
    kept = "" if bpy.data.filepath else ", until saved"
    return readable_size(size) + shown + kept


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


def quantity_of(item: bpy.types.Object) -> str:
    """What the voxels of one of our volumes hold."""
    return str(getattr(item, ids.OBJECT_VOLUME).quantity)


def can_be_projected(item: bpy.types.Object | None) -> bool:
    """Whether an object is a volume of matter or activity, not a map of the scanner."""
    return is_volume(item) and item is not None and quantity_of(item) not in MAPS


def poll_volume(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    """`poll` of operators that need an active volume."""
    if not is_volume(context.object):
        operator.poll_message_set("No volume is active: select one first")
        return False
    return True


def volume_objects(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Our volumes in a scene, by name."""
    return sorted((item for item in scene.objects if is_volume(item)), key=lambda item: item.name)


def coarser(volume: Volume, factor: int = 2) -> Volume:
    """Means over blocks of `factor`^3 voxels, for display; voxels beyond the edge are empty."""
    padding = [(0, -n % factor) for n in volume.grid.shape]
    array = (
        np.pad(volume.array, padding, constant_values=_empty(volume)) if any(p for _, p in padding) else volume.array
    )
    a, b, c = (n // factor for n in array.shape)
    means = array.reshape(a, factor, b, factor, c, factor).mean(axis=(1, 3, 5), dtype=np.float32)
    blocks = np.diag([factor, factor, factor, 1.0])
    blocks[:3, 3] = (factor - 1) / 2  # the block's middle
    return Volume(means, Grid((a, b, c), volume.grid.affine @ blocks), volume.quantity)


@bpy.app.handlers.persistent
def after_load(*_: Any) -> None:
    """Rewrite volumes of a .blend from a Blender which draws voxels half a voxel elsewhere; say which files are gone."""
    missing = storage.missing_volumes()
    if missing:
        names = ", ".join(sorted(data.name for data in missing))
        print(f"mphDRR: the voxel files of {names} are missing: Find Missing Volume Files in the Phantom panel")
    for item in bpy.data.objects:
        if not is_volume(item) or item.data in missing:
            continue
        settings = getattr(item, ids.OBJECT_VOLUME)
        if not settings.is_property_set("display_high"):  # made by an older version of this extension
            settings.extent = max(n * s for n, s in zip(settings.shape, settings.spacing, strict=True))
            settings.display_low, settings.display_high = volume_materials.usual_range(
                settings.quantity, 0.0, settings.maximum
            )
        if settings.center_shift != compat.VDB_CENTER_SHIFT:
            data = item.data
            path = storage.full_resolution(storage.absolute(data.filepath))
            count = data.frame_duration if data.is_sequence else 1
            try:
                states = [read_vdb(storage.of_frame(path, k + 1) if data.is_sequence else path) for k in range(count)]
                data.filepath = storage.stored_path(_store(states, storage.folder(), {}))
                settings.center_shift = compat.VDB_CENTER_SHIFT
            except InputError as error:
                print(f"mphDRR: {item.name} is drawn half a voxel off: {error}")


def _pose_of(volume: Volume, pose: ArrayLike | None) -> NDArray[np.float64]:
    if pose is not None:
        return checked_affine(pose, "volume pose")
    middle = np.eye(4)
    middle[:3, 3] = volume.grid.center
    return middle


def _volume_data(stored: StoredVolume, name: str) -> bpy.types.Volume:
    """Volume datablock of a stored volume, with its material."""
    quantity = stored.volume.quantity
    data = bpy.data.volumes.new(name)
    data.sequence_mode = "REPEAT"
    try:
        _show(data, stored)
    except Exception:
        bpy.data.volumes.remove(data)
        raise
    data.render.precision = "FULL"
    data.render.space = "OBJECT"
    data.render.clipping = 0.0  # the default, 0.001, erases mu values and faint activity
    data.materials.append(volume_materials.new_material(f"{name} {quantity}", quantity, stored.extent))
    return data


def _show(data: bpy.types.Volume, stored: StoredVolume) -> None:
    """Let a datablock show a stored volume; where Blender cannot load it, it shows what it did."""
    before = data.is_sequence, data.filepath
    data.is_sequence, data.filepath = False, storage.stored_path(stored.path)
    try:
        if not data.grids.load() or data.grids.error_message:
            raise InputError(
                f"{stored.path}: Blender cannot load the volume ({data.grids.error_message or 'no reason given'})"
            )
        if stored.volume.quantity not in data.grids:
            raise InputError(f"{stored.path}: Blender finds no grid {stored.volume.quantity!r} in it")
    except InputError:
        data.is_sequence, data.filepath = before
        raise
    # What the solid viewport draws.
    data.grids.active_index = data.grids.find(SMOKE if SMOKE in data.grids else stored.volume.quantity)
    if len(stored.states) > 1:  # set after loading, which would look for frame 0 until the scene is evaluated
        data.is_sequence, data.frame_duration = True, len(stored.states)


def _store(states: Sequence[Volume], folder: Path, provenance: dict[str, Any] | None) -> Path:
    """Write volumes, and coarser copies if they are large, under names from their content; the (first) path to show."""
    digest = hashlib.sha256()
    for state in states:
        digest.update(state.array.data)
        recipe = (
            state.grid.shape,
            state.grid.affine.tolist(),
            state.quantity,
            compat.VDB_CENTER_SHIFT,
            provenance or {},
        )
        digest.update(json.dumps(recipe).encode())
    stem = f"{states[0].quantity}-{digest.hexdigest()[:16]}"
    shown = list(states)
    while max(np.count_nonzero(state.array != _empty(state)) for state in shown) > MAX_SHOWN_VOXELS:
        shown = [coarser(state) for state in shown]
    low = min(float(state.array.min()) for state in shown)
    smoke_above = volume_materials.usual_range(states[0].quantity, low, 1.0)[0] if low < 0 else None
    if shown[0] is states[0]:
        return _write(states, folder, stem, provenance, smoke_above)
    _write(states, folder, stem, provenance)
    return _write(shown, folder, stem + ids.PREVIEW, {"coarser_copy_of": stem}, smoke_above)


def _write(
    states: Sequence[Volume],
    folder: Path,
    stem: str,
    provenance: dict[str, Any] | None,
    smoke_above: float | None = None,
) -> Path:
    paths = [folder / f"{stem}{f'_{k:04d}' if len(states) > 1 else ''}.vdb" for k in range(1, len(states) + 1)]
    for state, path in zip(states, paths, strict=True):
        if not path.exists():
            write_vdb(state, path, provenance, smoke_above=smoke_above, center_shift=compat.VDB_CENTER_SHIFT)
    return paths[0]


def _state(data: bpy.types.Volume) -> int | None:
    """Number of the file that Blender shows at the current frame, by its own rule; None where it shows none."""
    count = data.frame_duration
    if not data.is_sequence:
        return 0
    if count == 0:
        return None
    frame = bpy.context.scene.frame_current - data.frame_start  # 0: the first
    if data.sequence_mode == "CLIP" and not 0 <= frame < count:
        return None
    if data.sequence_mode == "EXTEND":
        frame = min(max(frame, 0), count - 1)
    elif data.sequence_mode == "REPEAT":
        frame %= count
    elif data.sequence_mode == "PING_PONG":
        frame %= max(1, 2 * count - 2)
        frame = min(frame, 2 * count - 2 - frame)
    return frame + 1 + data.frame_offset


def _describe(item: bpy.types.Object, stored: StoredVolume) -> None:
    from mathutils import Matrix

    volume = stored.volume
    item.matrix_world = Matrix(stored.pose)
    settings = getattr(item, ids.OBJECT_VOLUME)
    shown = settings.display_low, settings.display_high
    usual = volume_materials.usual_range(settings.quantity, settings.minimum, settings.maximum)
    chosen = settings.is_volume and settings.quantity == volume.quantity and not np.allclose(shown, usual)
    settings.is_volume = True
    settings.quantity = volume.quantity
    settings.unit = UNITS[volume.quantity]
    settings.shape = volume.grid.shape
    settings.spacing = volume.grid.spacing
    settings.minimum, settings.maximum = stored.low, stored.high
    settings.extent = stored.extent
    settings.exact_pose = json.dumps(stored.pose.tolist())
    settings.center_shift = compat.VDB_CENTER_SHIFT
    settings.display_low, settings.display_high = (
        shown if chosen else volume_materials.usual_range(volume.quantity, stored.low, stored.high)
    )


def _empty(volume: Volume) -> float:
    """The value of voxels that nobody sees."""
    return BACKGROUND.get(volume.quantity, 0.0)


def _extent(volume: Volume) -> float:
    filled = volume.array != _empty(volume)
    sides = []
    for axis, spacing in enumerate(volume.grid.spacing):
        used = np.flatnonzero(filled.any(axis=tuple(k for k in range(3) if k != axis)))
        sides.append(spacing * (used[-1] - used[0] + 1) if len(used) else spacing)
    return float(max(sides))
