"""Modules follow their values: cameras are aimed, collimators and crystals reshaped, readouts calculated.

Everything is changed in place (vertices, properties, rotations). No datablock is made or removed: this also runs after
Blender has stored an undo step, and undo expects the datablocks that it stored. `module_edits.py` makes and removes
modules.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from operator import attrgetter, itemgetter

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError
from ...core.geometry.module_parts import ModulePart
from ...core.geometry.scanner import Scanner
from ...core.scanner_kinds import SCANNERS
from ..blender import objects
from . import cameras, collimators, pinholes
from .module_values import TYPED, ScannerType, formula_columns, kind_of, make_groups, read_in_groups, read_placement

_KEY = "mphdrr_solid"  # custom property of a mesh: the values that it was built from
_Parts = dict[bpy.types.Object, list[bpy.types.Object]]
"""Parts of each module, by its camera."""
_Outdated = tuple[int, str, list[bpy.types.Object]]
"""Index of a module, its values as a text, and those of its parts that were built from other values."""
_writing = 0
_last_matrices: dict[int, bytes] = {}  # each camera's world matrix when its module last followed, by `session_uid`


@contextmanager
def writing() -> Iterator[None]:
    """Mark a block in which the extension itself writes properties: their edits rebuild nothing."""
    global _writing
    _writing += 1
    try:
        yield
    finally:
        _writing -= 1


def is_writing() -> bool:
    """Return whether the extension itself is writing properties now."""
    return bool(_writing)


def modules(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Return a scanner's camera objects, in the order of `read_scanner`'s system."""
    keyed = [(m.index, m.number, o.name, o) for o in collection.all_objects if (m := o.mphdrr_module).is_module]
    return [item for *_, item in sorted(keyed, key=itemgetter(0, 1, 2))]


def parts_of(collection: bpy.types.Collection, cameras_: Sequence[bpy.types.Object]) -> _Parts:
    """Return the parts of each module, its collimator and its crystal, by its camera."""
    # `Object.children` searches all objects: quick enough for one module, too slow for each of eighty.
    items = cameras_[0].children if len(cameras_) == 1 else collection.all_objects
    parts: _Parts = {camera: [] for camera in cameras_}
    for item in items:
        if item.mphdrr_module.part in collimators.PARTS and item.parent in parts:
            parts[item.parent].append(item)
    return parts


def refresh(
    collection: bpy.types.Collection, changed: Sequence[bpy.types.Object] | None = None, aim: bool = True
) -> None:
    """Make a scanner's modules, and its totals, follow their positions and values.

    `changed` are the camera objects that may have changed; by default all. `aim` lets the scanner keep them aimed.
    """
    properties = collection.mphdrr_scanner
    if is_writing() or not properties.is_scanner or properties.kind not in SCANNERS:
        return
    scanner_kind, cameras_ = kind_of(collection), modules(collection)
    with writing():
        module_parts = parts_of(collection, cameras_ if changed is None else changed)
        is_rebuilt = bool(module_parts) and _refresh_modules(scanner_kind, module_parts, properties, aim)
        if changed is None or is_rebuilt or properties.count != len(cameras_):
            _update_totals(scanner_kind, properties, [camera.mphdrr_module for camera in cameras_])
            pinholes.resize_roi(collection, cameras_)


def refresh_module(camera: bpy.types.Object) -> None:
    """Make a module follow an edit of one of its numbers."""
    if not camera.mphdrr_module.is_module or is_writing():
        return
    for collection in bpy.data.collections:
        if collection.mphdrr_scanner.is_scanner and camera.name in collection.all_objects:
            refresh(collection, [camera])


def keep_typed_length(camera: bpy.types.Object) -> None:
    """Keep a module's `l` as the user has typed it, whatever the ROI."""
    if camera.mphdrr_module.is_module and not is_writing():
        with writing():
            camera.mphdrr_module.length_mode = TYPED
        refresh_module(camera)


def set_for_all(collection: bpy.types.Collection, name: str) -> None:
    """Give all modules the scanner's edited value `name`, which may be "length_mode"."""
    if not collection.mphdrr_scanner.is_scanner or is_writing():
        return
    with writing():
        for camera in modules(collection):
            setattr(camera.mphdrr_module, name, getattr(collection.mphdrr_scanner, name))
            if any(column.field == name for column in formula_columns(kind_of(collection))):
                camera.mphdrr_module.length_mode = TYPED
    refresh(collection)


def has_moved(camera: bpy.types.Object) -> bool:
    """Return whether a module's camera has moved since the module last followed."""
    return _last_matrices.get(camera.session_uid) != objects.world_matrix(camera).tobytes()


def _refresh_modules(kind: ScannerType, parts: _Parts, scanner: bpy.types.PropertyGroup, aim: bool) -> bool:
    """Make modules follow, all together, which is faster than one by one; return whether a value has changed."""
    cameras_, matrices = list(parts), objects.world_matrices(list(parts))
    placement = read_placement(kind, cameras_, matrices)
    aim, to_aim = aim and scanner.keep_aimed, []
    for m, (camera, position) in enumerate(zip(cameras_, matrices[:, :3, 3], strict=True)):
        module = camera.mphdrr_module
        if np.any(np.array(module.placed, np.float32) != position.astype(np.float32)):
            if aim and not placement.aimed[m] and module.built and objects.is_moved_by_hand(camera):
                to_aim.append(m)  # `built` is empty for a new module, which keeps its direction
            module.placed = position
    for m in to_aim:
        aim_camera(cameras_[m], placement.aims[m])
        matrices[m] = objects.world_matrix(cameras_[m])
        placement.moved[m] = placement.aimed[m] = True
    _last_matrices.update(zip((o.session_uid for o in cameras_), map(np.ndarray.tobytes, matrices), strict=True))
    distances = np.linalg.norm(matrices[:, :3, 3], axis=1)
    changed = [
        _update_modules(
            system, [cameras_[m] for m in ms], placement.aimed[ms].tolist(), distances[ms].tolist(), parts, scanner
        )
        for ms, system in read_in_groups(kind, cameras_, placement)  # ms: indices of modules
    ]
    return any(changed)


def aim_camera(camera: bpy.types.Object, pose: NDArray[np.float64]) -> None:
    """Turn a module's camera to the direction of a pose (4, 4) at its position."""
    objects.set_world_matrix(camera, cameras.camera_matrices(pose), ("location", "scale"))


def _update_modules(
    system: Scanner | InputError, cameras_: Sequence[bpy.types.Object], aimed: Sequence[bool], distances: Sequence[float],
    parts: _Parts, scanner: bpy.types.PropertyGroup,
) -> bool:  # fmt: skip
    """Make cameras follow the modules of `system`, or show its error at them; return whether a value has changed."""
    settings = pinholes.readout_settings(scanner)
    if isinstance(system, InputError):
        texts = [repr((str(system), settings))] * len(cameras_)
    else:
        values = zip(*(getattr(system, name).tolist() for name in ("numbers", *system.columns.fields)), strict=True)
        texts = [repr((*row, is_aimed, settings)) for row, is_aimed in zip(values, aimed, strict=True)]
    changed = [m for m, camera in enumerate(cameras_) if camera.mphdrr_module.built != texts[m]]
    for m in changed:
        module = cameras_[m].mphdrr_module
        module.built, module.finding, module.aimed = texts[m], "", aimed[m]
        module.pinhole_distance = distances[m]
        module.problem = str(system) if isinstance(system, InputError) else ""
        if isinstance(system, Scanner):
            for column in formula_columns(type(system)):
                setattr(module, column.field, float(column.values(system)[m]))
    if changed:
        try:
            pinholes.write_readouts(system, [cameras_[m].mphdrr_module for m in changed], changed, scanner)
        except InputError as error:  # a driver or a script may have set the crystals' blur to NaN
            for m in changed:
                cameras_[m].mphdrr_module.problem = str(error)
    if isinstance(system, Scanner):
        # Even where nothing has changed: an undo may have restored the values and not the meshes.
        _rebuild(system, cameras_, parts, scanner)
    return bool(changed)


def _rebuild(
    system: Scanner, cameras_: Sequence[bpy.types.Object], parts: _Parts, scanner: bpy.types.PropertyGroup
) -> None:
    """Give the cameras' views and the parts' meshes the shapes of the modules of `system`."""
    sizes = zip(*(getattr(system, name).tolist() for name in system.columns.scalars), strict=True)
    fields, construction = system.fields().tolist(), pinholes.construction_values(scanner)
    outdated = []
    for m, (camera, size, field) in enumerate(zip(cameras_, sizes, fields, strict=True)):
        if camera.mphdrr_module.problem:
            continue
        if camera.data.users == 1 and not cameras.is_set_to(camera.data, tuple(field)):
            cameras.set_field_of_view(camera.data, tuple(field))
        text = repr((size, construction))
        if items := [item for item in parts[camera] if _is_outdated(item.data, text)]:
            outdated.append((m, text, items))
    if outdated:
        _reshape(system, cameras_, outdated, scanner)


def _reshape(
    system: Scanner, cameras_: Sequence[bpy.types.Object], outdated: list[_Outdated], scanner: bpy.types.PropertyGroup
) -> None:
    """Reshape the outdated parts of modules, or show at a module why its parts cannot be built."""

    def build(group: list[_Outdated]) -> Sequence[ModulePart]:
        """Return the parts of the modules of a group as they are to be."""
        subsystem = system[np.array([m for m, _, _ in group])] if len(group) < len(system) else system
        return subsystem.parts(pinholes.construction(scanner, type(system)))

    for group, parts in make_groups(outdated, build):
        if isinstance(parts, InputError):  # for example while d is typed before Ld: the last shape stays
            cameras_[group[0][0]].mphdrr_module.problem = str(parts)
            continue
        solids = {(part.number, part.kind.upper()): part.solid for part in parts}
        for m, text, items in group:
            for item in items:
                solid = solids.get((int(system.numbers[m]), item.mphdrr_module.part))
                if solid is not None and not collimators.has_shape(item.data, solid):
                    collimators.reshape_mesh(item.data, solid)
                item.data[_KEY] = text


def reset_views(collection: bpy.types.Collection) -> list[int]:
    """Reset edited cameras to the fields of their projections; return the numbers of their modules."""
    edited = [camera for camera in modules(collection) if not has_field_of_view(camera)]
    for camera in edited:
        cameras.set_field_of_view(camera.data, cameras.field_of(camera.data))
    return [camera.mphdrr_module.number for camera in edited]


def has_field_of_view(camera: bpy.types.Object) -> bool:
    """Return whether a module's camera sees exactly its projection's field: lens and sensor are not edited."""
    return bool(camera.mphdrr_module.problem) or cameras.has_field_of_view(camera.data)


def _is_outdated(data: bpy.types.Mesh, text: str) -> bool:
    """Return whether a mesh was built from other values; a shared mesh is left until `module_edits.py` has copied it."""
    return data.users == 1 and not data.is_editmode and data.get(_KEY) != text


def _update_totals(kind: ScannerType, scanner: bpy.types.PropertyGroup, modules: list[bpy.types.PropertyGroup]) -> None:
    """Write the readouts of all modules together, and the values that they share."""
    scanner.count, scanner.findings = len(modules), ""
    pinholes.write_totals(scanner, [module for module in modules if not module.problem])
    names, mixed = (*kind.columns.scalars, "length_mode"), []
    # Without modules, there are no columns of values.
    for name, values in zip(names, zip(*map(attrgetter(*names), modules), strict=True), strict=False):
        if getattr(scanner, name) != values[0]:  # writing makes Blender calculate the scene again
            setattr(scanner, name, values[0])
        if len(set(values)) > 1:
            mixed.append(name)
    scanner.mixed = " ".join(mixed)
