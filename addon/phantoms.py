"""Phantoms in the scene: volumes that know what they were made from, and are made anew when that changes.

The object's matrix is the phantom's pose; the voxels lie in its own frame, so that moving the object moves the phantom. A
phantom may have children that go with it: a volume of its other quantity, and an outline.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import bmesh
import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, InputWarning
from ..core.geometry.grid import Grid
from ..core.memory import require
from ..core.phantoms.kinds import KINDS
from ..core.phantoms.phantom import Phantom
from ..core.progress import Progress, part_of
from ..core.recording import recorded_warnings
from ..core.volumes.meshes.mesh import Mesh
from ..core.volumes.volume import Volume
from . import ids, meshes, storage, volumes
from .cameras import set_world_matrix, world_matrix
from .phantom_properties import PhantomSettings, identifier
from .vdb import provenance_of

_SKETCHED = 32  # voxels along each side of a sketch

ADDING = tuple((ids.ADD_PHANTOM + identifier(kind), kind.label) for kind in KINDS)
"""The operators that add a phantom, and what they add."""

BEATING = ids.ADD_PHANTOM + "torso"
"""The operator whose phantom can beat: its `frames`."""

_OUTLINE = "mphdrr_outline"  # custom property of the mesh that shows a phantom's surfaces


@dataclass(frozen=True)
class Recipe:
    """What a phantom's settings say, for a thread that leaves bpy alone.

    Attributes
    ----------
    phantom : Phantom
        What it is; of one that beats, the first state.
    n_states : int
        How many states there are, one for each frame.
    grid : Grid
        Its voxels, in its own frame.
    settings : dict
        As JSON can hold them.
    messages : tuple of str
        What the phantom's class warned of.
    """

    phantom: Phantom
    n_states: int
    grid: Grid
    settings: dict[str, Any]
    messages: tuple[str, ...]

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
    ) -> list[volumes.StoredVolume]:
        """A volume of each quantity in `folder`, its phantom at a world-from-phantom pose (4, 4), mm.

        Its grid turns with the phantom or, if `baked`, lies along the world's axes: then so does the object.

        Raises
        ------
        InputError
            No part of the phantom holds a quantity, or it does not fit into memory.
        """
        self._begin(quantities)
        count = len(quantities) * self.n_states
        reports = (part_of(progress, number, count) for number in range(count))
        stored = []
        for quantity, pose in zip(quantities, poses, strict=True):
            if baked:
                place = np.eye(4)
                place[:3, 3] = pose[:3, 3]
                grid = self._world_grid(pose)
                made = [phantom.voxelize(grid, pose, next(reports), quantity) for phantom in self.states]
                settings = self.settings | {"pose": pose.tolist()}
            else:
                place, settings = pose, self.settings
                own = [phantom.voxelize(self.grid, None, next(reports), quantity) for phantom in self.states]
                made = [_placed(volume, pose) for volume in own]
            stored.append(volumes.store_volume(made, folder, place, settings))
        return stored

    def sketch(
        self, quantities: Sequence[str], poses: Sequence[NDArray[np.float64]], folder: Path
    ) -> list[volumes.StoredVolume]:
        """What `voxelize` makes, of the first state, roughly and at once: few voxels, with the values at their centres.

        Raises
        ------
        InputError
            No part of the phantom holds a quantity.
        """
        self._begin(quantities)
        voxels = min(_SKETCHED, *self.grid.shape)
        grid = Grid.centered((voxels,) * 3, np.multiply(self.grid.shape, self.grid.spacing) / voxels, self.grid.center)
        points = np.moveaxis(np.indices(grid.shape), 0, -1).reshape(-1, 3) @ grid.affine[:3, :3].T + grid.affine[:3, 3]
        stored = []
        for quantity, pose in zip(quantities, poses, strict=True):
            values = self.phantom.values(points, quantity=quantity).astype(np.float32).reshape(grid.shape)
            stored.append(
                volumes.store_volume(_placed(Volume(values, grid, quantity), pose), folder, pose, {"sketch": 1})
            )
        return stored

    def _begin(self, quantities: Sequence[str]) -> None:
        """Say what there is to say of the settings; raise `InputError` where they make no volumes of these quantities."""
        title = self.phantom.title
        for quantity in quantities:
            if all(getattr(shape, quantity) is None for shape in self.phantom.shapes):
                raise InputError(f"the {title} has no {quantity}")
        count = len(quantities) * self.n_states
        if count > 1:
            shape = " x ".join(map(str, self.grid.shape))
            require(4.0 * count * self.grid.n_voxels, f"{title}: {count} volumes of {shape} voxels")
        for message in self.messages:
            warnings.warn(message, InputWarning, stacklevel=3)

    def _world_grid(self, pose: NDArray[np.float64]) -> Grid:
        """A grid along the world's axes that holds the phantom at a pose, with voxels as small as there."""
        corners = list(itertools.product(*zip(*self.phantom.box, strict=True))) @ pose[:3, :3].T + pose[:3, 3]
        low, high = corners.min(axis=0), corners.max(axis=0)
        spacing = min(Grid(self.grid.shape, pose @ self.grid.affine).spacing)
        n_x, n_y, n_z = (int(n) for n in np.ceil((high - low) / spacing) + 2)
        return Grid.centered((n_x, n_y, n_z), spacing, (low + high) / 2)


def recipe_of(settings: PhantomSettings) -> Recipe:
    """What settings say.

    Raises
    ------
    InputError
        There is no such phantom.
    """
    with recorded_warnings() as caught:
        phantom = settings.phantom()
    return Recipe(phantom, settings.n_states, settings.grid(phantom), settings.recipe(), tuple(caught))


def settings_of(item: bpy.types.Object | None) -> Any:
    """The settings that a volume was made from as a phantom; None where it is none."""
    if item is None or not volumes.is_volume(item):
        return None
    properties = getattr(item, ids.OBJECT_VOLUME)
    # A kind that only a later version knows is "": its voxels stay as they are.
    return None if properties.kind in ("VOLUME", "") else getattr(properties, properties.kind.lower())


def poll_phantom(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    """`poll` of operators that need an active phantom."""
    if settings_of(context.object) is None:
        operator.poll_message_set("No phantom is active: select one that was added with its settings")
        return False
    return True


def add(
    stored: Sequence[volumes.StoredVolume],
    name: str,
    kind: str,
    settings: dict[str, Any],
    collection: bpy.types.Collection,
) -> bpy.types.Object:
    """A phantom's volume in the scene; those of its other quantities become its children.

    `kind` is that of `VolumeProperties`; `settings` are its PropertyGroup's values by name.
    """
    item = volumes.add_stored(stored[0], name, collection)
    properties = getattr(item, ids.OBJECT_VOLUME)
    group = getattr(properties, kind.lower())
    for key, value in settings.items():
        setattr(group, key, value)
    properties.kind = kind  # last: until then a setting that changes makes nothing anew
    for other in stored[1:]:
        child = volumes.add_stored(other, f"{item.name} {other.volume.quantity}", collection)
        getattr(child, ids.OBJECT_VOLUME).with_parent = True
        child.parent = item
        child.matrix_basis.identity()
    return item


def root_of(item: bpy.types.Object) -> bpy.types.Object | None:
    """The phantom that a volume is, or belongs to as its other quantity; None where there is none."""
    if getattr(item, ids.OBJECT_VOLUME).with_parent and item.parent is not None:
        item = item.parent
    return None if settings_of(item) is None else item


def mu_energy(item: bpy.types.Object) -> float | None:
    """The photon energy, keV, at which a volume's mu holds: of a phantom, or of a CT that was converted; else None.

    Raises
    ------
    InputError
        The phantom's settings make no phantom.
    """
    root = root_of(item)
    if root is not None:
        return recipe_of(settings_of(root)).phantom.mu_energy
    path = volumes.file_of(item)
    energy = provenance_of(path).get("energy_keV") if path.is_file() else None
    return None if energy is None else float(energy)


def require_current(item: bpy.types.Object) -> None:
    """Raise `InputError` where a volume is of a phantom whose settings have changed since its voxels were made."""
    phantom = root_of(item)
    if phantom is not None and getattr(phantom, ids.OBJECT_VOLUME).outdated:
        raise InputError(f"{phantom.name!r} has changed since its voxels were made: press Update Phantom first")


def with_children(item: bpy.types.Object) -> list[bpy.types.Object]:
    """A phantom and the volumes of its other quantities."""
    children = [o for o in item.children if volumes.is_volume(o) and getattr(o, ids.OBJECT_VOLUME).with_parent]
    return [item, *sorted(children, key=lambda o: o.name)]


def remaking(item: bpy.types.Object, bake: bool = False) -> Callable[[Progress | None], list[volumes.StoredVolume]]:
    """What makes the voxels of a phantom and its children anew, for `replace`; leaves bpy alone.

    With `bake`, at its pose and on a grid along the world's axes.

    Raises
    ------
    InputError
        The object is no phantom, its settings make none, or its matrix is singular.
    """
    recipe, quantities, poses = _to_make(item)
    folder = storage.folder()
    return lambda progress: recipe.voxelize(quantities, poses, folder, progress, bake)


def sketch(item: bpy.types.Object) -> None:
    """Show a phantom and its children roughly as its settings are now, until they get their voxels by `replace`.

    Raises
    ------
    InputError
        The object is no phantom, its settings make none, or its matrix is singular.
    """
    recipe, quantities, poses = _to_make(item)
    replace(item, recipe.sketch(quantities, poses, storage.temporary_folder()), sketched=True)


def _to_make(item: bpy.types.Object) -> tuple[Recipe, list[str], list[NDArray[np.float64]]]:
    """A phantom's recipe, and the quantities and poses of its volumes."""
    settings = settings_of(item)
    if settings is None:
        raise InputError("no phantom is active: select one that was added with its settings")
    made = with_children(item)
    quantities = [settings.quantity, *(getattr(o, ids.OBJECT_VOLUME).quantity for o in made[1:])]
    return recipe_of(settings), quantities, [volumes.pose_of_object(o) for o in made]


def replace(
    item: bpy.types.Object, stored: Sequence[volumes.StoredVolume], baked: bool = False, sketched: bool = False
) -> None:
    """Give a phantom and its children what `remaking`, or a sketch, made.

    They stay where they are. If it was baked, they stand along the world's axes and are phantoms no more: their settings
    would not make these voxels.

    Raises
    ------
    InputError
        Children have come or gone in the meantime.
    """
    made = with_children(item)
    if len(made) != len(stored):
        raise InputError(f"the volumes of {item.name!r} are not those of before: try again")
    for volume_object, new in zip(made, stored, strict=True):
        basis = volume_object.matrix_basis.copy()
        getattr(volume_object, ids.OBJECT_VOLUME).sketched = sketched
        volumes.replace_stored(volume_object, new)
        if baked:
            set_world_matrix(volume_object, new.pose)
            if not np.allclose(world_matrix(volume_object), new.pose, rtol=1e-5, atol=1e-5):
                volume_object.parent = None  # sheared, which the object cannot undo
                set_world_matrix(volume_object, new.pose)
        else:
            volume_object.matrix_basis = basis  # which a matrix with shear would not survive
    properties = getattr(item, ids.OBJECT_VOLUME)
    properties.outdated, properties.message = sketched, ""
    if baked:
        remove_outline(item)
        properties.kind = "VOLUME"
        for child in made[1:]:
            getattr(child, ids.OBJECT_VOLUME).with_parent = False
    else:
        update_outline(item)


def outline_of(item: bpy.types.Object) -> bpy.types.Object | None:
    """The mesh that shows a phantom's surfaces, if it has one."""
    return next((child for child in item.children if _OUTLINE in child), None)


def show_outline(item: bpy.types.Object) -> bpy.types.Object:
    """Show the surfaces of a phantom's shapes as wires that go with it, made from its settings as they are now.

    Of one that moves they are those of its first state.

    Raises
    ------
    InputError
        The object is no phantom, or its settings make none.
    """
    settings = settings_of(item)
    if settings is None:
        raise InputError("no phantom is active: select one that was added with its settings")
    parts = recipe_of(settings).phantom.meshes()
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts[:-1], strict=True)])
    remove_outline(item)
    collection = item.users_collection[0] if item.users_collection else bpy.context.scene.collection
    outline = meshes.add_mesh(Mesh(vertices, faces), f"{item.name} outline", np.eye(4), collection)
    _merge_flat_faces(outline.data)
    outline[_OUTLINE] = True
    outline.display_type = "WIRE"
    outline.hide_render = outline.hide_select = True
    outline.parent = item
    return outline


def update_outline(item: bpy.types.Object) -> None:
    """Make the mesh that shows a phantom's surfaces anew, where it has one; raises as `show_outline` does."""
    if outline_of(item) is not None:
        show_outline(item)


def remove_outline(item: bpy.types.Object) -> None:
    """Remove the mesh that shows a phantom's surfaces; nothing where there is none."""
    outline = outline_of(item)
    if outline is not None:
        mesh = outline.data
        bpy.data.objects.remove(outline)
        if mesh.users == 0:
            bpy.data.meshes.remove(mesh)


def _merge_flat_faces(mesh: bpy.types.Mesh) -> None:
    """Leave no edges inside of flat faces: they would fill the picture with wires."""
    shape = bmesh.new()
    try:
        shape.from_mesh(mesh)
        bmesh.ops.dissolve_limit(shape, angle_limit=0.01, verts=shape.verts, edges=shape.edges)
        shape.to_mesh(mesh)
    finally:
        shape.free()


def _placed(volume: Volume, pose: NDArray[np.float64]) -> Volume:
    """A volume in an object's own space, in the world."""
    return Volume(volume.array, Grid(volume.grid.shape, pose @ volume.grid.affine), volume.quantity)
