"""Core volumes as Blender's Volume objects, and back.

The voxels are in .vdb files (`stored_volumes`), so that a saved .blend can be projected later. The affine in the file leads
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
from ...core.errors import warn
from ...core.geometry.frames import checked_affine
from ...core.progress import Progress, stages_of
from ...core.runs.display import number_text
from ..blender import compat, ids, jobs, objects, reports, storage
from . import vdb, volume_materials
from .stored_volumes import StoredVolume, move_grid, store_volume, write_states

_MICROMETER = 1e-3  # mm


def add_volume(
    volume: Volume | Sequence[Volume],
    name: str,
    pose: ArrayLike | None = None,
    provenance: dict[str, Any] | None = None,
    collection: bpy.types.Collection | None = None,
    frame_start: int = 1,
) -> bpy.types.Object:
    """Put a volume into the scene as a Volume object with a material; see `store_volume` for `volume` and `pose`.

    The states of a changing body, such as a beating heart, follow each other frame by frame from `frame_start` and begin
    again after the last one (`Volume.sequence_mode`). `volume_from_object` and projections take the state of the scene's
    current frame. Blender numbers the name if it is taken; the collection is by default the scene's own.
    """
    item = add_stored(store_volume(volume, storage.folder(), pose, provenance), name, collection)
    if item.data.is_sequence:
        item.data.frame_start = frame_start
    return item


def add_stored(stored: StoredVolume, name: str, collection: bpy.types.Collection | None = None) -> bpy.types.Object:
    """Put a stored volume into the scene as a Volume object with a material."""
    _check_voxel_size(name, stored.volume.grid.spacing)
    item = bpy.data.objects.new(name, _volume_data(stored, name))
    (collection or bpy.context.scene.collection).objects.link(item)
    _set_properties(item, stored)
    if stored.volume.quantity == "hu":
        item.mphdrr_volume.look = "BONE"
    return item


def _check_voxel_size(name: str, spacing: NDArray[np.floating]) -> None:
    """Warn of voxels below a micrometre, as of meshes that were made in metres."""
    if np.min(spacing) < _MICROMETER:
        advice = "a unit of the scene is 1 mm, so scale by 1000 what was made in metres"
        warn(f"{name!r} has voxels of {np.min(spacing):.3g} mm, below a micrometre: {advice}")


def add_volume_job(
    label: str,
    make: Callable[[Progress], Volume | Sequence[Volume]],
    name: str,
    finish: Callable[[bpy.types.Object, StoredVolume], str],
    pose: ArrayLike | None = None,
    provenance: dict[str, Any] | None = None,
    collection: bpy.types.Collection | None = None,
    sources: Sequence[bpy.types.Object] = (),
) -> jobs.Job:
    """Return the job that makes a volume, or its states, in a worker thread, adds it to the scene, and selects it alone.

    ``make(progress)`` returns the volume and may add to the `provenance`. `finish` sets the rest of the new object and
    returns the line to report. The `sources`, objects that the volume is made from, are hidden then. The other arguments
    are those of `add_volume`.
    """
    source_uids = [source.session_uid for source in sources]
    folder, collection_uid = storage.folder(), 0 if collection is None else collection.session_uid

    def work(progress: Progress) -> StoredVolume:
        """Make the volume and store its voxels."""
        volume = make(progress)
        stages_of(progress)("writing the voxels")
        return store_volume(volume, folder, pose, provenance)

    def finished(stored: StoredVolume) -> str:
        """Add the volume to the scene, make it active, and return the line of `finish`."""
        item = add_stored(stored, name, jobs.find_by_uid(bpy.data.collections, collection_uid))
        objects.hide(*(jobs.find_by_uid(bpy.data.objects, uid) for uid in source_uids))
        make_active(bpy.context, item)
        return finish(item, stored)

    return jobs.Job(label, work, finished)


def values_text(stored: StoredVolume) -> str:
    """Return the range of a volume's values as the window shows it, with the unit: "0 to 100 kBq/mL"."""
    unit, factor = volume_materials.display_unit(stored.volume.quantity)
    return range_text(factor * stored.low, factor * stored.high, unit)


def range_text(low: float, high: float, unit: str) -> str:
    """Return a range of values with its unit as a text, which has no unit of 1."""
    return f"{number_text(low)} to {number_text(high)} {unit}".removesuffix(" 1")


def replace_stored(item: bpy.types.Object, stored: StoredVolume) -> None:
    """Give a Volume object the voxels and the pose of a stored volume.

    Its datablock stays, with the user's settings, unless it is of another quantity or other objects use it too.
    """
    old, settings = item.data, item.mphdrr_volume
    if old.users == 1 and settings.quantity == stored.volume.quantity:  # keeps the user's settings of the datablock
        _load_files(old, stored)
        _set_properties(item, stored)
        return
    item.data = data = _volume_data(stored, item.name)
    _set_properties(item, stored)
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
    for selected in context.selected_objects:
        selected.select_set(False)
    item.select_set(True)
    context.view_layer.objects.active = item


def volume_from_object(item: bpy.types.Object) -> Volume:
    """Return the exact volume of an object in world mm, with the object's position, rotation and scale."""
    return reader(item)()


def reader(item: bpy.types.Object, path: Path | None = None) -> Callable[[], Volume]:
    """Return a function that reads an object's volume in world mm without bpy, for a worker thread.

    `path` is the file of a state (`storage.state_files`), by default that of the current frame.
    """
    path, pose = file_and_pose(item, path)
    _check_voxel_size(item.name, item.mphdrr_volume.spacing * np.linalg.norm(pose[:3, :3], axis=0))
    return lambda: move_grid(vdb.read_vdb(path), pose)


def file_and_pose(item: bpy.types.Object, path: Path | None = None) -> tuple[Path, NDArray[np.float64]]:
    """Return the file with every voxel of a Volume object, and its pose (4, 4), mm; `InputError` where there is no file."""
    require_volume(item)
    objects.require_evaluated([item])
    if path is None and _frame_number(item.data) is None:
        raise InputError(f"{item.name!r} has no state at frame {bpy.context.scene.frame_current}")
    pose, path = pose_of_object(item), path or file_of(item)
    if not path.is_file():
        raise InputError(f"{path}: no such file; the voxels of {item.name!r} are gone, so add the volume again")
    return path, pose


def require_volume(item: bpy.types.Object | None) -> None:
    """Raise `InputError` unless an object is one of our volumes."""
    if not is_volume(item):
        problem = "nothing is chosen" if item is None else f"{item.name!r} is no mphDRR volume"
        raise InputError(f"{problem}: add a phantom first, or choose one")


def file_of(item: bpy.types.Object) -> Path:
    """Return the .vdb with every voxel of a Volume object; of a sequence, that of the current frame."""
    path = storage.full_resolution_file(storage.absolute(item.data.filepath))
    return storage.frame_file(path, _frame_number(item.data) or 1) if item.data.is_sequence else path


def content_key(item: bpy.types.Object) -> str:
    """Return a text that identifies the voxels of a volume, of all its states."""
    return item.mphdrr_volume.content or bpy.path.basename(item.data.filepath)


def state_text(item: bpy.types.Object) -> str:
    """Return the state of a sequence at the current frame in words: "3 of 8"."""
    state = _frame_number(item.data)
    return "none" if state is None else f"{state - item.data.frame_offset} of {item.data.frame_duration}"


def file_note(item: bpy.types.Object) -> str:
    """Return the size of a Volume object's file in words, or "missing"."""
    if (size := storage.file_size(file_of(item))) is None:
        return "missing"
    display_note = ", coarser copy shown" if ids.PREVIEW in item.data.filepath else ""
    storage_note = "" if bpy.data.filepath else ", until saved"
    return memory.readable_size(size) + display_note + storage_note


def pose_of_object(item: bpy.types.Object) -> NDArray[np.float64]:
    """Return an object's world-from-object matrix (4, 4), mm.

    Blender keeps float32; the stored float64 pose is returned as long as it rounds to Blender's.
    """
    matrix = objects.world_matrix(item)
    exact = item.mphdrr_volume.exact_pose
    if exact:
        pose = np.array(json.loads(exact))
        if not pose_change(pose, matrix):
            return pose
    return checked_affine(matrix, f"{item.name}: its matrix")


def pose_change(old: NDArray[np.float64], new: NDArray[np.float64]) -> str:
    """Return whether an object "turned" or "moved" between poses (4, 4); "" for a change as small as float32 rounding."""
    if not np.allclose(old[:3, :3], new[:3, :3], rtol=0, atol=2e-6):
        return "turned"
    return "" if np.allclose(old[:3, 3], new[:3, 3], rtol=1e-6, atol=1e-6) else "moved"


def is_volume(item: bpy.types.Object | None) -> bool:
    """Return whether an object is one of our volumes."""
    return item is not None and item.type == "VOLUME" and item.mphdrr_volume.is_volume


def quantity_of(item: bpy.types.Object) -> str:
    """Return the quantity of one of our volumes, such as "activity"."""
    return str(item.mphdrr_volume.quantity)


ACTIVE: reports.Need = (lambda context: is_volume(context.object), "No volume is active: select one first")


def volume_objects(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Return our volumes in a scene, by name."""
    return sorted((item for item in scene.objects if is_volume(item)), key=lambda item: item.name)


def panel_volume(context: bpy.types.Context) -> bpy.types.Object | None:
    """Return the volume that panels show: the active one, else the scene's only one."""
    if is_volume(context.object):
        return context.object
    scene_volumes = volume_objects(context.scene)
    return scene_volumes[0] if len(scene_volumes) == 1 else None


def after_load(*_: Any) -> None:
    """Bring volumes of older .blend files up to date, and rewrite those drawn half a voxel elsewhere by their Blender."""
    missing = storage.missing_volumes()
    for item in bpy.data.objects:
        if not is_volume(item):
            continue
        settings = item.mphdrr_volume
        if not settings.is_property_set("display_high"):  # made by an older version of this extension
            settings.extent = max(n * s for n, s in zip(settings.shape, settings.spacing, strict=True))
            usual_range = volume_materials.default_range(settings.quantity, 0.0, settings.maximum)
            settings.display_low, settings.display_high = usual_range
        unit, factor = volume_materials.display_unit(settings.quantity)
        if settings.unit != unit:  # an older version's unit
            for name in ("minimum", "maximum", "display_low", "display_high"):
                setattr(settings, name, factor * getattr(settings, name))
            settings.unit = unit
        if settings.center_shift != compat.VDB_CENTER_SHIFT and item.data not in missing:
            settings.content = content_key(item)
            try:
                states = [vdb.read_vdb(path) for path in storage.state_files(item.data)]
                item.data.filepath = storage.stored_path(write_states(states, storage.folder()))
                settings.center_shift = compat.VDB_CENTER_SHIFT
                settings.display_high = settings.display_high  # setting this draws the volume and its surface anew
            except InputError as error:
                print(f"mphDRR: {item.name} is drawn half a voxel off: {error}")


def _volume_data(stored: StoredVolume, name: str) -> bpy.types.Volume:
    """Return a new Volume datablock of a stored volume, with its material."""
    quantity = stored.volume.quantity
    data = bpy.data.volumes.new(name)
    data.sequence_mode = "REPEAT"
    try:
        _load_files(data, stored)
    except Exception:
        bpy.data.volumes.remove(data)
        raise
    data.render.precision = "FULL"
    data.render.space = "OBJECT"
    data.render.clipping = 0.0  # the default, 0.001, erases mu values and faint activity
    data.materials.append(volume_materials.new_material(f"{name} {quantity}", quantity, stored.extent))
    return data


def _load_files(data: bpy.types.Volume, stored: StoredVolume) -> None:
    """Make a datablock show a stored volume; where Blender cannot load the file, it keeps the previous one."""
    previous = data.is_sequence, data.filepath
    path = storage.adopt(stored.path)
    data.is_sequence, data.filepath = False, storage.stored_path(path)
    error = ""
    # A successful load keeps the error message of an earlier failed one, as after a crash; unloading drops it.
    data.grids.load()
    data.grids.unload()
    if not data.grids.load() or data.grids.error_message:
        error = f"Blender cannot load the volume ({data.grids.error_message or 'no reason given'})"
    elif stored.volume.quantity not in data.grids:
        error = f"Blender finds no grid {stored.volume.quantity!r} in it"
    if error:
        data.is_sequence, data.filepath = previous
        raise InputError(f"{path}: {error}")
    # The active grid is the one that the solid viewport draws.
    data.grids.active_index = data.grids.find(vdb.SMOKE if vdb.SMOKE in data.grids else stored.volume.quantity)
    if len(stored.states) > 1:  # set after loading: a sequence would look for frame 0 until the scene is evaluated
        data.is_sequence, data.frame_duration = True, len(stored.states)


def _frame_number(data: bpy.types.Volume) -> int | None:
    """Return the number in the name of the file that Blender shows at the current frame; None where it shows none."""
    n_states = data.frame_duration
    if not data.is_sequence:
        return 0
    frame = bpy.context.scene.frame_current - data.frame_start  # 0: the first
    if n_states == 0 or (data.sequence_mode == "CLIP" and not 0 <= frame < n_states):
        return None
    if data.sequence_mode == "EXTEND":
        frame = min(max(frame, 0), n_states - 1)
    elif data.sequence_mode == "REPEAT":
        frame %= n_states
    elif data.sequence_mode == "PING_PONG":
        frame %= max(1, 2 * n_states - 2)
        frame = min(frame, 2 * n_states - 2 - frame)
    return frame + 1 + data.frame_offset


def _set_properties(item: bpy.types.Object, stored: StoredVolume) -> None:
    """Set the pose and the `VolumeProperties` of a Volume object from a stored volume.

    A display range that the user has changed stays.
    """
    volume = stored.volume
    item.matrix_world = Matrix(stored.pose)
    settings = item.mphdrr_volume
    display_range = settings.display_low, settings.display_high
    usual_range = volume_materials.default_range(settings.quantity, settings.minimum, settings.maximum)
    unit, factor = volume_materials.display_unit(volume.quantity)
    is_same_kind = settings.is_volume and settings.quantity == volume.quantity
    is_typed = is_same_kind and not np.allclose(display_range, usual_range)
    settings.is_volume, settings.quantity, settings.unit = True, volume.quantity, unit
    settings.shape, settings.spacing = volume.grid.shape, volume.grid.spacing
    settings.minimum, settings.maximum = factor * stored.low, factor * stored.high
    settings.extent = stored.extent
    settings.exact_pose, settings.content = json.dumps(stored.pose.tolist()), stored.path.name
    settings.center_shift = compat.VDB_CENTER_SHIFT
    if not is_typed:
        display_range = volume_materials.default_range(volume.quantity, factor * stored.low, factor * stored.high)
    set_display_range(item, *display_range)


def set_display_range(item: bpy.types.Object, low: float, high: float) -> None:
    """Set the display range of a volume; the surface's value stays at its share of the range."""
    settings = item.mphdrr_volume
    share = (settings.surface - settings.display_low) / ((settings.display_high - settings.display_low) or 1.0)
    settings.surface = low + share * (high - low)
    settings.display_low, settings.display_high = low, high
