"""Core volumes <-> Blender's Volume objects.

The voxels are in .vdb files (`stored_volumes`), so that a saved .blend can be projected later. The affine in the file is
from voxel index to the object's own space, and the object's matrix is the pose: moving the object moves the volume.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import ArrayLike, NDArray

from ...core import InputError, Volume, memory
from ...core.geometry.frames import checked_affine
from ...core.progress import Progress, stages_of
from ..blender import compat, ids, jobs, objects, reports, storage
from . import vdb, volume_materials
from .stored_volumes import StoredVolume, moved, store_volume, write_states


def add_volume(
    volume: Volume | Sequence[Volume],
    name: str,
    pose: ArrayLike | None = None,
    provenance: dict[str, Any] | None = None,
    collection: bpy.types.Collection | None = None,
    frame_start: int = 1,
) -> bpy.types.Object:
    """Put a volume into the scene as a Volume object with a material; see `store_volume` for `volume` and `pose`.

    The states of something that changes, such as a beating heart, follow each other frame by frame from `frame_start` and
    begin again after the last one (`Volume.sequence_mode`). `volume_from_object` and projections take the state of the
    scene's current frame. Blender numbers the name if it is taken; the collection is by default the scene's own.
    """
    item = add_stored(store_volume(volume, storage.folder(), pose, provenance), name, collection)
    if item.data.is_sequence:
        item.data.frame_start = frame_start
    return item


def add_stored(stored: StoredVolume, name: str, collection: bpy.types.Collection | None = None) -> bpy.types.Object:
    """Put a stored volume into the scene; see `add_volume`."""
    item = bpy.data.objects.new(name, _volume_data(stored, name))
    (collection or bpy.context.scene.collection).objects.link(item)
    _describe(item, stored)
    return item


def adding(
    label: str,
    make: Callable[[Progress], Volume | Sequence[Volume]],
    name: str,
    finish: Callable[[bpy.types.Object, StoredVolume], str],
    pose: ArrayLike | None = None,
    provenance: dict[str, Any] | None = None,
    collection: bpy.types.Collection | None = None,
) -> jobs.Job:
    """The job that adds the volume, or its states, that ``make(progress)`` makes in a thread, and selects it alone.

    `finish` sets the rest of the new object and returns the line to report. The other arguments are those of `add_volume`;
    `make` may add to the `provenance`.
    """
    folder, home_uid = storage.folder(), 0 if collection is None else collection.session_uid

    def work(progress: Progress) -> StoredVolume:
        made = make(progress)
        stages_of(progress)("writing the voxels")
        return store_volume(made, folder, pose, provenance)

    def finished(stored: StoredVolume) -> str:
        item = add_stored(stored, name, jobs.find_by_uid(bpy.data.collections, home_uid))
        make_active(bpy.context, item)
        return finish(item, stored)

    return jobs.Job(label, work, finished)


def values_text(stored: StoredVolume) -> str:
    """Smallest and largest value as the window shows them, with their unit: "0 to 100 kBq/mL"."""
    unit, factor = volume_materials.shown_unit(stored.volume.quantity)
    return f"{factor * stored.low:.4g} to {factor * stored.high:.4g} {unit}".removesuffix(" 1")


def replace_stored(item: bpy.types.Object, stored: StoredVolume) -> None:
    """Give a Volume object the voxels and the pose of a stored volume.

    Its datablock stays, with what the user has set on it, unless it is of another quantity or other objects show it too.
    """
    old, settings = item.data, item.mphdrr_volume
    if old.users == 1 and settings.quantity == stored.volume.quantity:  # in place: what the user set on it stays
        _show(old, stored)
        _describe(item, stored)
        return
    item.data = data = _volume_data(stored, item.name)
    _describe(item, stored)
    if old.users == 0:
        name, materials = old.name, set(old.materials)
        bpy.data.volumes.remove(old)
        data.name = name
        objects.remove_unused(materials)


def make_active(context: bpy.types.Context, item: bpy.types.Object) -> None:
    """Select a new volume alone, and let EEVEE draw it."""
    if context.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    volume_materials.show_in_eevee(context.scene)
    for other in context.selected_objects:
        other.select_set(False)
    item.select_set(True)
    context.view_layer.objects.active = item


def volume_from_object(item: bpy.types.Object) -> Volume:
    """The exact volume that an object shows, in world mm, wherever the object has been moved, turned or scaled to."""
    return reader(item)()


def reader(item: bpy.types.Object, path: Path | None = None) -> Callable[[], Volume]:
    """A function that does what `volume_from_object` does but leaves bpy alone, to be called in a thread.

    `path` is the file of a state (`storage.state_files`); default: of the one at the current frame.
    """
    path, pose = source(item, path)
    return lambda: moved(vdb.read_vdb(path), pose)


def source(item: bpy.types.Object, path: Path | None = None) -> tuple[Path, NDArray[np.float64]]:
    """The file and the pose (4, 4), mm, of which `reader` makes a volume; raises InputError where there is none."""
    require_volume(item)
    if path is None and _state(item.data) is None:
        raise InputError(f"{item.name!r} has no state at frame {bpy.context.scene.frame_current}")
    pose, path = pose_of_object(item), path or file_of(item)
    if not path.is_file():
        raise InputError(f"{path}: no such file; the voxels of {item.name!r} are gone, so add the volume again")
    return path, pose


def require_volume(item: bpy.types.Object | None) -> None:
    """Raise `InputError` unless an object is one of our volumes."""
    if not is_volume(item):
        what = "nothing is chosen" if item is None else f"{item.name!r} is no mphDRR volume"
        raise InputError(f"{what}: add a phantom first, or choose one")


def file_of(item: bpy.types.Object) -> Path:
    """The .vdb with every voxel of a Volume object; of a sequence, that of the current frame."""
    path = storage.full_resolution_file(storage.absolute(item.data.filepath))
    return storage.frame_file(path, _state(item.data) or 1) if item.data.is_sequence else path


def content_of(item: bpy.types.Object) -> str:
    """A text that tells a volume's voxels, of all its states, from others."""
    return item.mphdrr_volume.content or bpy.path.basename(item.data.filepath)


def state_text(item: bpy.types.Object) -> str:
    """Which state of a sequence the current frame shows: "3 of 8"."""
    state = _state(item.data)
    return "none" if state is None else f"{state - item.data.frame_offset} of {item.data.frame_duration}"


def file_state(item: bpy.types.Object) -> str:
    """What there is to say about a Volume object's file: its size, or that it is missing."""
    size = storage.file_size(file_of(item))
    if size is None:
        return "missing"
    shown = ", coarser copy shown" if ids.PREVIEW in item.data.filepath else ""
    kept = "" if bpy.data.filepath else ", until saved"
    return memory.readable_size(size) + shown + kept


def pose_of_object(item: bpy.types.Object) -> NDArray[np.float64]:
    """World-from-object matrix (4, 4).

    Blender keeps float32; the float64 pose that the object was given counts as long as it still rounds to Blender's.
    """
    shown = objects.world_matrix(item)
    exact = item.mphdrr_volume.exact_pose
    if exact:
        pose = np.array(json.loads(exact))
        if not pose_change(pose, shown):
            return pose
    return checked_affine(shown, f"{item.name}: its matrix")


def pose_change(old: NDArray[np.float64], new: NDArray[np.float64]) -> str:
    """Whether an object "turned" or "moved" between two poses (4, 4); "" for what may be Blender's float32."""
    if not np.allclose(old[:3, :3], new[:3, :3], rtol=0, atol=2e-6):
        return "turned"
    return "" if np.allclose(old[:3, 3], new[:3, 3], rtol=1e-6, atol=1e-6) else "moved"


def is_volume(item: bpy.types.Object | None) -> bool:
    """Whether an object is one of our volumes."""
    return item is not None and item.type == "VOLUME" and item.mphdrr_volume.is_volume


def quantity_of(item: bpy.types.Object) -> str:
    """What the voxels of one of our volumes hold."""
    return str(item.mphdrr_volume.quantity)


ACTIVE: reports.Need = (lambda context: is_volume(context.object), "No volume is active: select one first")


def volume_objects(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Our volumes in a scene, by name."""
    return sorted((item for item in scene.objects if is_volume(item)), key=lambda item: item.name)


def meant(context: bpy.types.Context) -> bpy.types.Object | None:
    """The volume that panels show: the active one, else the scene's only one."""
    if is_volume(context.object):
        return context.object
    known = volume_objects(context.scene)
    return known[0] if len(known) == 1 else None


def after_load(*_: Any) -> None:
    """Rewrite volumes of a .blend whose Blender draws voxels half a voxel elsewhere."""
    missing = storage.missing_volumes()
    for item in bpy.data.objects:
        if not is_volume(item):
            continue
        settings = item.mphdrr_volume
        if not settings.is_property_set("display_high"):  # made by an older version of this extension
            settings.extent = max(n * s for n, s in zip(settings.shape, settings.spacing, strict=True))
            usual = volume_materials.usual_range(settings.quantity, 0.0, settings.maximum)
            settings.display_low, settings.display_high = usual
        unit, factor = volume_materials.shown_unit(settings.quantity)
        if settings.unit != unit:  # as older versions showed it
            for name in ("minimum", "maximum", "display_low", "display_high"):
                setattr(settings, name, factor * getattr(settings, name))
            settings.unit = unit
        if settings.center_shift != compat.VDB_CENTER_SHIFT and item.data not in missing:
            settings.content = content_of(item)
            try:
                states = [vdb.read_vdb(path) for path in storage.state_files(item.data)]
                item.data.filepath = storage.stored_path(write_states(states, storage.folder()))
                settings.center_shift = compat.VDB_CENTER_SHIFT
                settings.display_high = settings.display_high  # which draws it: its surface was elsewhere, too
            except InputError as error:
                print(f"mphDRR: {item.name} is drawn half a voxel off: {error}")


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
    error = ""
    # A load that finds the file keeps the message of one that did not, as after a crash; unloading then drops it.
    data.grids.load()
    data.grids.unload()
    if not data.grids.load() or data.grids.error_message:
        error = f"Blender cannot load the volume ({data.grids.error_message or 'no reason given'})"
    elif stored.volume.quantity not in data.grids:
        error = f"Blender finds no grid {stored.volume.quantity!r} in it"
    if error:
        data.is_sequence, data.filepath = before
        raise InputError(f"{stored.path}: {error}")
    # What the solid viewport draws.
    data.grids.active_index = data.grids.find(vdb.SMOKE if vdb.SMOKE in data.grids else stored.volume.quantity)
    if len(stored.states) > 1:  # set after loading, which would look for frame 0 until the scene is evaluated
        data.is_sequence, data.frame_duration = True, len(stored.states)


def _state(data: bpy.types.Volume) -> int | None:
    """Number of the file that Blender shows at the current frame, by its own rule; None where it shows none."""
    count = data.frame_duration
    if not data.is_sequence:
        return 0
    frame = bpy.context.scene.frame_current - data.frame_start  # 0: the first
    if count == 0 or (data.sequence_mode == "CLIP" and not 0 <= frame < count):
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
    volume = stored.volume
    item.matrix_world = Matrix(stored.pose)
    settings = item.mphdrr_volume
    low, high = shown = settings.display_low, settings.display_high
    surface = (settings.surface - low) / ((high - low) or 1.0)  # share of the display range
    usual = volume_materials.usual_range(settings.quantity, settings.minimum, settings.maximum)
    unit, factor = volume_materials.shown_unit(volume.quantity)
    chosen = settings.is_volume and settings.quantity == volume.quantity and not np.allclose(shown, usual)
    settings.is_volume, settings.quantity, settings.unit = True, volume.quantity, unit
    settings.shape, settings.spacing = volume.grid.shape, volume.grid.spacing
    settings.minimum, settings.maximum = factor * stored.low, factor * stored.high
    settings.extent = stored.extent
    settings.exact_pose, settings.content = json.dumps(stored.pose.tolist()), stored.path.name
    settings.center_shift = compat.VDB_CENTER_SHIFT
    if not chosen:
        shown = volume_materials.usual_range(volume.quantity, factor * stored.low, factor * stored.high)
    if shown != (low, high):
        settings.surface = shown[0] + surface * (shown[1] - shown[0])
    settings.display_low, settings.display_high = shown
