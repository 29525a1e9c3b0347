"""Modules follow their values: cameras are aimed, collimators and crystals reshaped, readouts calculated.

Everything is changed in place (vertices, properties, rotations). No datablock is made or removed: this also runs after
Blender has stored an undo step, and undo expects the datablocks that it stored. `module_edits.py` makes and removes modules.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from operator import attrgetter, itemgetter

import bpy
import numpy as np

from ...core.errors import InputError
from ...core.geometry.module_parts import ModulePart
from ...core.geometry.scanner import Scanner
from ...core.scanner_kinds import SCANNERS
from ..blender import objects
from . import cameras, collimators, pinholes
from .module_values import TYPED, Kind, designed, kind_of, placed, readings, together

_KEY = "mphdrr_solid"  # custom property of a mesh: the values that it was built from
_Parts = dict[bpy.types.Object, list[bpy.types.Object]]
"""Camera of each module -> what hangs on it."""
_Old = tuple[int, str, list[bpy.types.Object]]
"""Index of a module, its values, and its parts that were built from others."""
_writing = 0
_places: dict[int, bytes] = {}  # by the session's number of a camera: its world matrix when its module last followed


@contextmanager
def writing() -> Iterator[None]:
    """Within this block the extension itself writes properties: their edits rebuild nothing."""
    global _writing
    _writing += 1
    try:
        yield
    finally:
        _writing -= 1


def is_writing() -> bool:
    """Whether the extension itself is writing properties now."""
    return bool(_writing)


def modules(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """A scanner's camera objects, in the order of `read_scanner`'s system."""
    found = [(m.index, m.number, o.name, o) for o in collection.all_objects if (m := o.mphdrr_module).is_module]
    return [item for *_, item in sorted(found, key=itemgetter(0, 1, 2))]


def parts_of(collection: bpy.types.Collection, found: Sequence[bpy.types.Object]) -> _Parts:
    """What hangs on each module's camera: its collimator and its crystal."""
    # `Object.children` searches all objects: once for one module, but not once for each of eighty.
    items = found[0].children if len(found) == 1 else collection.all_objects
    parts: _Parts = {camera: [] for camera in found}
    for item in items:
        if item.mphdrr_module.part in collimators.PARTS and item.parent in parts:
            parts[item.parent].append(item)
    return parts


def refresh(
    collection: bpy.types.Collection, changed: Sequence[bpy.types.Object] | None = None, aim: bool = True
) -> None:
    """Make a scanner's modules, and its totals, follow their places and values.

    `changed` are the camera objects that may have changed; by default all. `aim` lets the scanner keep them aimed.
    """
    scanner = collection.mphdrr_scanner
    if is_writing() or not scanner.is_scanner or scanner.kind not in SCANNERS:
        return
    kind, found = kind_of(collection), modules(collection)
    with writing():
        parts = parts_of(collection, found if changed is None else changed)
        rebuilt = bool(parts) and _refresh_modules(kind, parts, scanner, aim)
        if changed is None or rebuilt or scanner.count != len(found):
            _update_totals(kind, scanner, [camera.mphdrr_module for camera in found])
            pinholes.resize_roi(collection, found)


def refresh_module(camera: bpy.types.Object) -> None:
    """Make one module follow: one of its numbers was edited."""
    if not camera.mphdrr_module.is_module or is_writing():
        return
    for collection in bpy.data.collections:
        if collection.mphdrr_scanner.is_scanner and camera.name in collection.all_objects:
            refresh(collection, [camera])


def length_typed(camera: bpy.types.Object) -> None:
    """Keep a module's `l` as the user has typed it, whatever the ROI."""
    if camera.mphdrr_module.is_module and not is_writing():
        with writing():
            camera.mphdrr_module.length_mode = TYPED
        refresh_module(camera)


def set_for_all(collection: bpy.types.Collection, name: str) -> None:
    """Give all modules the scanner's value called `name` (or its "length_mode"): it was edited."""
    if not collection.mphdrr_scanner.is_scanner or is_writing():
        return
    with writing():
        for camera in modules(collection):
            setattr(camera.mphdrr_module, name, getattr(collection.mphdrr_scanner, name))
            if any(column.field == name for column in designed(kind_of(collection))):
                camera.mphdrr_module.length_mode = TYPED
    refresh(collection)


def has_moved(camera: bpy.types.Object) -> bool:
    """Whether a module's camera stands elsewhere than when the module last followed."""
    return _places.get(camera.session_uid) != objects.world_matrix(camera).tobytes()


def _refresh_modules(kind: Kind, parts: _Parts, scanner: bpy.types.PropertyGroup, aim: bool) -> bool:
    """Make modules follow, all together, which is faster than one by one; returns whether a value has changed."""
    cameras_, matrices = list(parts), objects.world_matrices(list(parts))
    places = placed(kind, cameras_, matrices)
    to_aim = []
    for m, (camera, place) in enumerate(zip(cameras_, matrices[:, :3, 3], strict=True)):
        module = camera.mphdrr_module
        if np.any(np.array(module.placed, np.float32) != place.astype(np.float32)):
            if aim and scanner.keep_aimed and not places.aimed[m] and module.built and is_free(camera):
                to_aim.append(m)  # it is not new
            module.placed = place
    for m in to_aim:
        objects.set_world_matrix(cameras_[m], cameras.matrices_of(places.aims[m]))
        matrices[m] = objects.world_matrix(cameras_[m])
        places.moved[m] = places.aimed[m] = True
    _places.update(zip((camera.session_uid for camera in cameras_), map(np.ndarray.tobytes, matrices), strict=True))
    distances = np.linalg.norm(matrices[:, :3, 3], axis=1)
    changed = [
        _follow(
            found, [cameras_[m] for m in which], places.aimed[which].tolist(), distances[which].tolist(), parts, scanner
        )
        for which, found in readings(kind, cameras_, places)
    ]
    return any(changed)


def _follow(
    found: Scanner | InputError, cameras_: Sequence[bpy.types.Object], aimed: Sequence[bool], distances: Sequence[float],
    parts: _Parts, scanner: bpy.types.PropertyGroup,
) -> bool:  # fmt: skip
    """Make cameras follow the modules that are `found`, or why there are none; returns whether a value has changed."""
    given = pinholes.settings(scanner)
    if isinstance(found, InputError):
        texts = [repr((str(found), given))] * len(cameras_)
    else:
        values = zip(*(getattr(found, name).tolist() for name in ("numbers", *found.columns.fields)), strict=True)
        texts = [repr((*row, is_aimed, given)) for row, is_aimed in zip(values, aimed, strict=True)]
    changed = [m for m, camera in enumerate(cameras_) if camera.mphdrr_module.built != texts[m]]
    for m in changed:
        module = cameras_[m].mphdrr_module
        module.built, module.finding, module.aimed = texts[m], "", aimed[m]
        module.pinhole_distance = distances[m]
        module.problem = str(found) if isinstance(found, InputError) else ""
        if isinstance(found, Scanner):
            for column in designed(type(found)):
                setattr(module, column.field, float(column.values(found)[m]))
    if changed:
        pinholes.write_readouts(found, [cameras_[m].mphdrr_module for m in changed], changed, scanner)
    if isinstance(found, Scanner):
        # Even where nothing has changed: an undo may have restored the values and not the meshes.
        _rebuild(found, cameras_, parts, scanner)
    return bool(changed)


def is_free(item: bpy.types.Object) -> bool:
    """Whether only the user moves an object: no animation, driver or constraint does."""
    data = item.animation_data
    animated = data is not None and (data.action is not None or len(data.drivers) or len(data.nla_tracks))
    return not animated and not len(item.constraints)


def _rebuild(
    found: Scanner, cameras_: Sequence[bpy.types.Object], parts: _Parts, scanner: bpy.types.PropertyGroup
) -> None:
    """Give the cameras' views and the parts' meshes the shapes of modules, or say at a module why it has none."""
    sizes = zip(*(getattr(found, name).tolist() for name in found.columns.scalars), strict=True)
    fields, given = found.fields().tolist(), pinholes.construction_values(scanner)
    old = []
    for m, (camera, size, field) in enumerate(zip(cameras_, sizes, fields, strict=True)):
        if camera.mphdrr_module.problem:
            continue
        if camera.data.users == 1 and not cameras.is_set_to(camera.data, tuple(field)):
            cameras.set_field_of_view(camera.data, tuple(field))
        text = repr((size, given))
        items = [item for item in parts[camera] if _differs(item.data, text)]
        if items:
            old.append((m, text, items))
    if old:
        _reshape(found, cameras_, old, scanner)


def _reshape(
    found: Scanner, cameras_: Sequence[bpy.types.Object], old: list[_Old], scanner: bpy.types.PropertyGroup
) -> None:
    """Reshape the `old` parts of modules."""

    def built(some: list[_Old]) -> Sequence[ModulePart]:
        chosen = found[np.array([m for m, _, _ in some])] if len(some) < len(found) else found
        return chosen.parts(pinholes.construction(scanner, type(found)))

    for some, parts in together(old, built):
        if isinstance(parts, InputError):  # e.g. while d is typed before Ld: the last shape stays
            cameras_[some[0][0]].mphdrr_module.problem = str(parts)
            continue
        solids = {(part.number, part.kind.upper()): part.solid for part in parts}
        for m, text, items in some:
            for item in items:
                solid = solids.get((int(found.numbers[m]), item.mphdrr_module.part))
                if solid is not None and not collimators.has_shape(item.data, solid):
                    collimators.reshape_mesh(item.data, solid)
                item.data[_KEY] = text


def reset_views(collection: bpy.types.Collection) -> list[int]:
    """Make the modules' cameras see what their projections show; returns the numbers of those that did not."""
    edited = [camera for camera in modules(collection) if not shows_its_field(camera)]
    for camera in edited:
        cameras.set_field_of_view(camera.data, cameras.field_of(camera.data))
    return [camera.mphdrr_module.number for camera in edited]


def shows_its_field(camera: bpy.types.Object) -> bool:
    """Whether a module's camera sees what its projection shows: its lens and sensor are not edited."""
    return bool(camera.mphdrr_module.problem) or cameras.has_field_of_view(camera.data)


def _differs(data: bpy.types.Mesh, text: str) -> bool:
    """Whether a mesh was built from other values. A shared one stays until `module_edits.py` has copied it."""
    return data.users == 1 and not data.is_editmode and data.get(_KEY) != text


def _update_totals(kind: Kind, scanner: bpy.types.PropertyGroup, modules: Sequence[bpy.types.PropertyGroup]) -> None:
    """Write the readouts of all modules together, and the values that they share."""
    scanner.count, scanner.findings = len(modules), ""
    pinholes.write_totals(scanner, [module for module in modules if not module.problem])
    names, mixed = (*kind.columns.scalars, "length_mode"), []
    for name, values in zip(
        names, zip(*map(attrgetter(*names), modules), strict=True), strict=False
    ):  # none without modules
        if getattr(scanner, name) != values[0]:  # writing has the scene calculated again
            setattr(scanner, name, values[0])
        if len(set(values)) > 1:
            mixed.append(name)
    scanner.mixed = " ".join(mixed)
