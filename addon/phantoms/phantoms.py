"""Phantoms in the scene: volumes that keep their settings and are voxelized again when these change.

The object's matrix is the phantom's pose. The voxels are in its own frame, so that moving the object moves the phantom. A
phantom may have children that go with it: a volume of its other quantity, and an outline.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import bmesh
import bpy
import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Mesh, Phantom, memory
from ...core.geometry.frames import affine_matrix
from ...core.geometry.grid import Grid, grid_around
from ...core.progress import Progress, part_of, stages_of
from ..blender import jobs, objects, storage
from ..blender.reports import Need
from ..volumes import meshes, vdb, volumes
from ..volumes.stored_volumes import StoredVolume, move_grid, store_volume
from .phantom_properties import FILE, PhantomSettings

_OUTLINE = "mphdrr_outline"  # custom property of an outline's object


@dataclass(frozen=True)
class PhantomJob:
    """A phantom's settings copied out of Blender, so that a worker thread can voxelize it."""

    phantom: Phantom  # the phantom, a beating one in its first state
    n_states: int  # number of states, one for each frame
    grid: Grid  # grid of the voxels, in the phantom's frame
    settings: dict[str, Any]  # settings that JSON can hold

    @cached_property
    def states(self) -> Sequence[Phantom]:
        """The phantom in each frame."""
        phantom: Any = self.phantom
        return (phantom,) if self.n_states == 1 else phantom.beating(self.n_states)

    def voxelize(
        self,
        quantities: Sequence[str],
        poses: Sequence[NDArray[np.float64]],
        folder: Path,
        progress: Progress | None = None,
        baked: bool = False,
    ) -> list[StoredVolume]:
        """Voxelize the phantom for each quantity at its world-from-phantom pose (4, 4), mm, and store the volumes.

        The grid turns with the phantom or, if `baked`, grid and object are along the world's axes.
        """
        title, count = self.phantom.title, len(quantities) * self.n_states
        for quantity in quantities:
            if all(getattr(shape, quantity) is None for shape in self.phantom.shapes):
                raise InputError(f"the {title} has no {quantity}")
        if count > 1:
            shape = " x ".join(map(str, self.grid.shape))
            memory.require(4.0 * count * self.grid.n_voxels, f"{title}: {count} volumes of {shape} voxels")
        stages = stages_of(progress)
        voxelizing = stages("voxelizing")
        reports = (part_of(voxelizing, number, count) for number in range(count))
        stored = []
        for quantity, pose in zip(quantities, poses, strict=True):
            if baked:
                object_pose = affine_matrix(np.eye(3), pose[:3, 3])
                # The grid along the world's axes holds the whole phantom, with voxels as small as the phantom's own.
                corners = list(itertools.product(*zip(*self.phantom.box, strict=True))) @ pose[:3, :3].T + pose[:3, 3]
                grid = grid_around(corners, min(Grid(self.grid.shape, pose @ self.grid.affine).spacing))
                states = [phantom.voxelize(grid, pose, next(reports), quantity) for phantom in self.states]
                settings = self.settings | {"pose": pose.tolist()}
            else:
                object_pose, settings = pose, self.settings
                local_states = [phantom.voxelize(self.grid, None, next(reports), quantity) for phantom in self.states]
                states = [move_grid(volume, pose) for volume in local_states]
            stages("writing the voxels")
            stored.append(store_volume(states, folder, object_pose, settings))
        return stored


def copy_settings(settings: PhantomSettings) -> PhantomJob:
    """Return a copy of a phantom's settings for a worker thread; raise `InputError` where there is no such phantom."""
    phantom = settings.phantom()
    return PhantomJob(phantom, settings.n_states, settings.grid(phantom), settings.recipe())


def settings_of(item: bpy.types.Object | None) -> Any:
    """Return the settings from which a volume was made as a phantom; None where it is no phantom."""
    if item is None or not volumes.is_volume(item):
        return None
    properties = item.mphdrr_volume
    # Blender reads a kind of a later version as "": the voxels of such a phantom stay as they are.
    return None if properties.kind in ("VOLUME", "") else getattr(properties, properties.kind.lower())


ACTIVE: Need = (
    lambda context: settings_of(context.object) is not None,
    "No phantom is active: select one that was added with its settings",
)


def add_phantom_job(
    settings: PhantomSettings, name: str, pose: NDArray[np.float64] | None = None, attenuation: bool = False
) -> jobs.Job:
    """Return the job that adds a phantom to the scene, of an operator's settings or `phantom_properties.plain_settings`.

    The `pose` is its world-from-phantom matrix (4, 4), mm, by default the identity. With `attenuation`, the mu of a phantom
    of activity is added too, as a child.
    """
    phantom_job, folder, values = copy_settings(settings), storage.folder(), settings.values()
    kind, quantity = settings.identifier, values["quantity"]
    quantities = ["activity", "mu"] if attenuation and quantity == "activity" else [quantity]
    poses = [np.eye(4) if pose is None else pose] * len(quantities)

    def work(progress: Progress) -> list[StoredVolume]:
        """Voxelize the phantom for each quantity, and store the volumes."""
        return phantom_job.voxelize(quantities, poses, folder, progress)

    def finish(stored: list[StoredVolume]) -> str:
        """Add the phantom's objects to the scene, and return the line to report."""
        if kind == FILE and "text" not in values:
            values["text"] = bpy.data.texts.new(phantom_job.settings["file"])
            values["text"].from_string(phantom_job.settings["text"])
        collection = bpy.context.collection
        item = volumes.add_stored(stored[0], name, collection)
        store_settings(item, kind, values)
        for stored_child in stored[1:]:
            child = volumes.add_stored(stored_child, f"{item.name} {stored_child.volume.quantity}", collection)
            child.mphdrr_volume.with_parent = True
            child.parent = item
            child.matrix_basis.identity()
        volumes.make_active(bpy.context, item)
        grid = phantom_job.grid
        return f"Added {item.name!r}: {grid.shape[0]}^3 voxels of {grid.spacing[0]:.3g} mm"

    return jobs.Job("Making a phantom", work, finish)


adding = add_phantom_job  # the name in version 0.2.0, for scripts


def store_settings(item: bpy.types.Object, kind: str, values: Mapping[str, Any]) -> None:
    """Make a volume the phantom of a kind (`PhantomSettings.identifier`) with these settings; its voxels stay."""
    properties = item.mphdrr_volume
    properties.kind = "VOLUME"  # prevents that a change of a setting voxelizes again before all are set
    for key, value in values.items():
        setattr(getattr(properties, kind), key, value)
    properties.kind = kind.upper()
    properties.outdated, properties.message = False, ""


def update_phantom_job(item: bpy.types.Object, bake: bool = False) -> jobs.Job:
    """Return the job that voxelizes a phantom and its children again from the phantom's settings.

    With `bake`, the new grid is along the world's axes at the phantom's pose, and the phantom becomes an ordinary volume.
    """
    work, name, old_settings = make_voxelizer(item, bake), item.name, settings_of(item).values()

    def finish(stored: list[StoredVolume]) -> str:
        """Replace the phantom's voxels in the scene, and return the line to report."""
        item = bpy.data.objects.get(name)
        settings = settings_of(item)
        if item is None or settings is None:
            raise InputError(f"the phantom {name!r} is gone")
        has_changed = settings.values() != old_settings
        replace_voxels(item, stored, bake)
        if bake:
            return f"Applied the pose of {name!r}"
        item.mphdrr_volume.outdated = has_changed
        return f"Updated {name!r}" + ("; its settings have changed in the meantime" if has_changed else "")

    return jobs.Job("Making a phantom", work, finish)


def make_voxelizer(item: bpy.types.Object, bake: bool = False) -> Callable[[Progress | None], list[StoredVolume]]:
    """Return the work of `update_phantom_job` as a function that leaves bpy alone; its result is for `replace_voxels`."""
    if (settings := settings_of(item)) is None:
        raise InputError("no phantom is active: select one that was added with its settings")
    phantom_job, folder, items = copy_settings(settings), storage.folder(), with_children(item)
    quantities = [settings.quantity, *(volumes.quantity_of(child) for child in items[1:])]
    poses = [volumes.pose_of_object(member) for member in items]
    return lambda progress: phantom_job.voxelize(quantities, poses, folder, progress, bake)


def replace_voxels(item: bpy.types.Object, stored: Sequence[StoredVolume], baked: bool = False) -> None:
    """Give a phantom and its children the voxels of a voxelizer; the objects stay where they are."""
    items = with_children(item)
    if len(items) != len(stored):
        raise InputError(f"the volumes of {item.name!r} are not those of before: try again")
    for volume_object, new in zip(items, stored, strict=True):
        basis = volume_object.matrix_basis.copy()
        volumes.replace_stored(volume_object, new)
        if not baked:
            volume_object.matrix_basis = basis  # a sheared world matrix would not set it back
            continue
        objects.set_world_matrix(volume_object, new.pose)
        if not np.allclose(objects.world_matrix(volume_object), new.pose, rtol=1e-5, atol=1e-5):
            volume_object.parent = None  # the object's own matrix cannot undo the parent's shear
            objects.set_world_matrix(volume_object, new.pose)
    properties = item.mphdrr_volume
    properties.outdated, properties.message = False, ""
    if not baked:
        update_outline(item)
        return
    remove_outline(item)
    properties.kind = "VOLUME"
    for child in items[1:]:
        child.mphdrr_volume.with_parent = False


def with_children(item: bpy.types.Object) -> list[bpy.types.Object]:
    """Return a phantom and the volumes of its other quantities."""
    children = [child for child in item.children if volumes.is_volume(child) and child.mphdrr_volume.with_parent]
    return [item, *sorted(children, key=lambda child: child.name)]


def mu_energy(item: bpy.types.Object) -> float | None:
    """Return the photon energy, keV, at which a phantom's or a converted CT's mu holds; None where it is unknown."""
    if (root := owning_phantom(item)) is not None:
        return copy_settings(settings_of(root)).phantom.mu_energy
    path = volumes.file_of(item)
    energy = vdb.read_provenance(path).get("energy_keV") if path.is_file() else None
    return None if energy is None else float(energy)


def require_current(item: bpy.types.Object) -> None:
    """Raise `InputError` for a volume of a phantom whose settings have changed since it was voxelized."""
    if (phantom := outdated_phantom(item)) is not None:
        raise InputError(f"{phantom.name!r} has changed since its voxels were made: press Update Phantom first")


def outdated_phantom(item: bpy.types.Object) -> bpy.types.Object | None:
    """Return the phantom of a volume if its settings have changed since it was voxelized, else None."""
    phantom = owning_phantom(item)
    return phantom if phantom is not None and phantom.mphdrr_volume.outdated else None


def owning_phantom(item: bpy.types.Object) -> bpy.types.Object | None:
    """Return the phantom that a volume is, or belongs to as another quantity; None where there is none."""
    if item.mphdrr_volume.with_parent and item.parent is not None:
        item = item.parent
    return None if settings_of(item) is None else item


def toggle_outline(item: bpy.types.Object) -> str:
    """Show the surfaces of a phantom, a beating one in its first state, as wires that go with it, or hide them."""
    if outline_of(item) is not None:
        remove_outline(item)
        return f"Removed the outline of {item.name!r}"
    _show_outline(item)
    return f"Added the outline of {item.name!r}"


def update_outline(item: bpy.types.Object) -> None:
    """Make a phantom's outline again, where it has one."""
    if outline_of(item) is not None:
        _show_outline(item)


def outline_of(item: bpy.types.Object) -> bpy.types.Object | None:
    """Return a phantom's outline, None where it has none."""
    return next((child for child in item.children if _OUTLINE in child), None)


def remove_outline(item: bpy.types.Object) -> None:
    """Remove a phantom's outline, if it has one."""
    if (outline := outline_of(item)) is not None:
        objects.remove_objects([outline])


def _show_outline(item: bpy.types.Object) -> None:
    """Add the outline of a phantom, in place of an existing one."""
    parts = copy_settings(settings_of(item)).phantom.meshes()
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts[:-1], strict=True)])
    remove_outline(item)
    collection = item.users_collection[0] if item.users_collection else bpy.context.scene.collection
    outline = meshes.add_mesh(Mesh(vertices, faces), f"{item.name} outline", np.eye(4), collection)
    edit_mesh = bmesh.new()
    try:  # edges inside flat faces would fill the picture with wires
        edit_mesh.from_mesh(outline.data)
        bmesh.ops.dissolve_limit(edit_mesh, angle_limit=0.01, verts=edit_mesh.verts, edges=edit_mesh.edges)
        edit_mesh.to_mesh(outline.data)
    finally:
        edit_mesh.free()
    outline[_OUTLINE] = True
    outline.display_type = "WIRE"
    outline.hide_render = outline.hide_select = True
    outline.parent = item
