"""Modules made, removed and renumbered in the scene, by operators (undo steps), not by handlers."""

import json
import re
from collections.abc import Sequence
from typing import Literal

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core import InputError, PinholeSystem, ring_order
from ...core.geometry.frames import affine_matrix, rotations
from ...core.geometry.module_parts import ModulePart
from ...core.geometry.scanner import Scanner
from ...core.scanner_kinds import SCANNERS
from ..blender import ids, objects, updates
from . import cameras, collimators, following, module_values, pinholes, scanner
from .scanner_parts import clear, new_part, parts_and_others

_WORDS = (*(kind.word for kind in SCANNERS.values()), *(part.capitalize() for part in collimators.PARTS))
_OURS = re.compile(rf"({'|'.join(dict.fromkeys(_WORDS))}) \d+(\.\d+)?")  # a name that the extension gave


def copied_cameras(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Cameras with another camera's module number: Blender copied them. "Module 07.001" is the copy of "Module 07"."""
    seen: set[int] = set()
    copied = []
    for camera in sorted(scanner.modules(collection), key=lambda o: (len(o.name), o.name)):
        number = camera.mphdrr_module.number
        if number in seen:
            copied.append(camera)
        seen.add(number)
    return copied


def orphan_parts(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Parts whose camera was deleted."""
    there = set(scanner.modules(collection))  # Blender takes long to say which collections an object is in
    return [
        item
        for item in collection.all_objects
        if item.mphdrr_module.part in collimators.PARTS
        and item.parent not in there
        and not (item.parent is not None and item.parent.mphdrr_module.is_module and item.parent.users_collection)
    ]


def bare_cameras(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Modules without parts, of a kind that has some: copies whose original was deleted."""
    parts = following.parts_of(collection, scanner.modules(collection))
    bare = [camera for camera, own in parts.items() if not own]
    return bare if bare and module_values.kind_of(collection).parts is not Scanner.parts else []


def untidy_text(collection: bpy.types.Collection) -> str:
    """What `tidy` would put in order, in words; empty where all is in order."""
    copied = copied_cameras(collection)
    bare = [camera for camera in bare_cameras(collection) if camera not in copied]
    found = (
        ("copied camera{}", copied),
        ("bare camera{}", bare),
        ("part{} without a camera", orphan_parts(collection)),
    )
    return ", ".join(f"{len(items)} {text.format('s' * (len(items) > 1))}" for text, items in found if items)


def tidy(collection: bpy.types.Collection) -> tuple[list[int], int]:
    """Make modules of copied cameras, and remove parts without a camera.

    Returns the new modules' numbers, and how many parts were removed. Where a shape cannot be built nothing is changed.
    """
    copied, orphans, numbers = copied_cameras(collection), orphan_parts(collection), []
    for camera in (*copied, *bare_cameras(collection)):
        _solids(collection, camera)  # refuses what cannot be, before anything is changed
    objects.remove_objects(orphans)
    for camera in copied:
        adopt(collection, camera)
        numbers.append(camera.mphdrr_module.number)
    for camera in bare_cameras(collection):
        _add_parts(collection, camera)
    make_single_users(collection)
    following.refresh(collection)
    collection.mphdrr_scanner.untidy = untidy_text(collection)
    return numbers, len(orphans)


def adopt(collection: bpy.types.Collection, camera: bpy.types.Object, module: Scanner | None = None) -> None:
    """Make the copy of a module's camera a module of its own: `module`, or what its place and values make of it."""
    found = [o for o in scanner.modules(collection) if o != camera]
    number = max(o.mphdrr_module.number for o in found) + 1
    if not following.parts_of(collection, [camera])[camera]:
        _add_parts(collection, camera)
    camera.mphdrr_module.number = number
    module_values.remember([camera], module or _read(collection, camera))
    camera.mphdrr_module.number, camera.mphdrr_module.added = number, True
    camera.mphdrr_module.index = max(o.mphdrr_module.index for o in found) + 1
    camera.name = ids.module_name(number, len(found) + 1, module_values.kind_of(collection).word)
    if camera.data.users > 1:
        camera.data = camera.data.copy()
    camera.data.name = camera.name
    for part in following.parts_of(collection, [camera])[camera]:
        part.name, part.mphdrr_module.number = ids.part_name(camera.name, part.mphdrr_module.part), number
        if part.data.users == 1:
            part.data.name = part.name


def _read(collection: bpy.types.Collection, camera: bpy.types.Object) -> Scanner:
    """A module as it stands now, or, while that is impossible, as it was imported."""
    try:
        return scanner.read_module(collection, camera)
    except InputError:
        return module_values.imported(module_values.kind_of(collection), (camera.mphdrr_module.exact,))


def _solids(collection: bpy.types.Collection, camera: bpy.types.Object) -> Sequence[ModulePart]:
    """A module's parts; raises InputError where they cannot be built."""
    construction = pinholes.construction(collection.mphdrr_scanner, module_values.kind_of(collection))
    return _read(collection, camera).parts(construction)


def _add_parts(collection: bpy.types.Collection, camera: bpy.types.Object) -> None:
    for built in _solids(collection, camera):
        item = new_part(camera, ids.part_name(camera.name, built.kind), built)
        item.hide_viewport, item.hide_render = camera.hide_viewport, camera.hide_render
        for home in camera.users_collection:
            home.objects.link(item)


def duplicate(
    collection: bpy.types.Collection, modules: Sequence[bpy.types.Object], count: int, angle: float, follow_ring: bool
) -> list[bpy.types.Object]:
    """Make `count` copies of each module, `angle` radians apart about the world's z axis; returns their camera objects.

    With `follow_ring` a copy's z and distance from the z axis are those of the ring at its azimuth, linear between
    neighbours and constant beyond the arc's ends; it keeps its tilt. Raises InputError, and leaves the scene as it was,
    where a module already stands in a copy's place or its shapes cannot be built.
    """
    taken = [_place(o) for o in scanner.modules(collection)]
    angles = np.linspace(angle, count * angle, count)
    copies: list[tuple[bpy.types.Object, Scanner]] = []
    for camera in modules:
        _solids(collection, camera)
        module = scanner.read_module(collection, camera)
        poses = _along_ring(collection, camera, module, angles, follow_ring)
        for pose in poses:
            if np.linalg.norm(np.array(taken) - pose[:3, 3], axis=1).min() < 1e-3:
                raise InputError(
                    f"a copy of module {camera.mphdrr_module.number} would stand in the place of another module: "
                    "choose another angle or count"
                )
            taken.append(pose[:3, 3])
            copies.append((camera, module_values.with_design(camera, module.at_poses(pose[None]))))
    made = []
    for camera, module in copies:
        copy = camera.copy()
        copy.data = camera.data.copy()
        copy.animation_data_clear()
        for home in camera.users_collection:
            home.objects.link(copy)
        objects.set_world_matrix(copy, cameras.matrices_of(module.poses())[0])
        adopt(collection, copy, module)
        made.append(copy)
    following.refresh(collection)
    return made


def _place(camera: bpy.types.Object) -> NDArray[np.float64]:
    return objects.world_matrix(camera)[:3, 3]


def _along_ring(
    collection: bpy.types.Collection,
    camera: bpy.types.Object,
    module: Scanner,
    angles: NDArray[np.float64],
    follow_ring: bool,
) -> NDArray[np.float64]:
    """Poses (N, 4, 4) at `angles` (N,) about z from a module's, turned as the direction to the isocentre is."""
    pose = module.poses()[0]
    x, y, height = pose[:3, 3]
    azimuth, radius = np.arctan2(y, x), np.hypot(x, y)
    if follow_ring:
        ring = [_place(o) for o in scanner.modules(collection) if o.mphdrr_module.ring == camera.mphdrr_module.ring]
        places = np.array(ring)
        # Azimuths relative to the module, so that an arc across +-pi stays in one piece.
        others = _wrapped(np.arctan2(places[:, 1], places[:, 0]) - azimuth)
        order = np.argsort(others)
        radius, height = (
            np.interp(_wrapped(angles), others[order], values[order])
            for values in (np.hypot(*places[:, :2].T), places[:, 2])
        )
    to = azimuth + angles
    there = np.column_stack(np.broadcast_arrays(radius * np.cos(to), radius * np.sin(to), height))
    before, after = module.aimed(pose[None, :3, 3]), module.aimed(there)
    if before is None or after is None:
        turns = rotations(angles[:, None] * [0.0, 0.0, 1.0])
    else:
        turns = after[:, :3, :3] @ before[:, :3, :3].transpose(0, 2, 1)
    return affine_matrix(turns @ pose[:3, :3], there)


def _wrapped(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    return (angles + np.pi) % (2 * np.pi) - np.pi


def remove(collection: bpy.types.Collection, modules: Sequence[bpy.types.Object]) -> None:
    """Remove modules with their parts and projections in the scene; other objects parented to them stay where they are."""
    if len(modules) >= len(scanner.modules(collection)):
        raise InputError("a scanner needs at least one module: keep one, or press Remove Scanner")
    for scene in bpy.data.scenes:
        updates.FUNCTIONS["modules_removed"](scene, list(modules))
    children = [child for camera in modules for child in camera.children]
    parts = [child for child in children if child.mphdrr_module.part in (*collimators.PARTS, "PLANE")]
    for child in children:
        if child not in parts:
            objects.unparent(child)
    objects.remove_objects([*parts, *modules])
    following.refresh(collection)


def remove_scanner(scene: bpy.types.Scene, collection: bpy.types.Collection) -> None:
    """Remove a scanner, with its projections in the scene; the user's objects in it move to the scene's collection."""
    updates.FUNCTIONS["modules_removed"](scene, scanner.modules(collection))
    _, others = parts_and_others(collection)
    objects.remove_objects([item for item in others if item.mphdrr_module.part != "NONE"])  # copies
    clear(scene, collection, {})
    bpy.data.collections.remove(collection)
    objects.remove_unused(bpy.data.materials.get(name) for name, _ in collimators.LOOKS.values())


def renumber(collection: bpy.types.Collection, order: Literal["RINGS", "LIST"] = "RINGS") -> int:
    """Number a scanner's modules 1, 2, ... in the order of `ring_order` or the present one; returns how many changed.

    They are listed, projected and exported in that order from now on. Names that the user gave stay. Raises InputError
    where the scanner is untidy, or its numbers are impossible; it stays as it was.
    """
    untidy = untidy_text(collection)
    if untidy:
        raise InputError(f"scanner '{collection.name}': {untidy}: press Tidy Modules in the Design panel first")
    system, found = scanner.read_scanner(collection), scanner.modules(collection)
    places = np.arange(len(found))
    if order == "RINGS":
        places = ring_order(system) if isinstance(system, PinholeSystem) else np.argsort(system.rings(), kind="stable")
    parts = following.parts_of(collection, found)
    names: list[tuple[bpy.types.ID, str]] = []
    with following.writing():
        for index, camera in enumerate(found[place] for place in places):
            camera.mphdrr_module.number, camera.mphdrr_module.index = index + 1, index
            name = ids.module_name(index + 1, len(found), system.word)
            names += [(camera, name), (camera.data, name)]
            for part in parts[camera]:
                part.mphdrr_module.number = index + 1
                part_name = ids.part_name(name, part.mphdrr_module.part)
                names += [(part, part_name), (part.data, part_name)]
        ordered = scanner.read_scanner(collection)
        if np.any(np.diff(places) < 0):
            collection.mphdrr_scanner.source = ""  # the workbook has another order
        collection.mphdrr_scanner.quick_ranges = json.dumps(scanner.quick_ranges(ordered))
    names = [(item, name) for item, name in names if item.name != name and _OURS.fullmatch(item.name)]
    for item, name in names:
        item.name = f"{name} renumbered"  # so that the new names are free
    for item, name in names:
        item.name = name
    following.refresh(collection)
    return int(np.count_nonzero(system.numbers[places] != ordered.numbers))


def can_become(collection: bpy.types.Collection, system: Scanner) -> bool:
    """Whether a scanner has the modules of another one, by their numbers, and only the user moves them."""
    found = scanner.modules(collection)
    numbers = sorted(camera.mphdrr_module.number for camera in found)
    is_kind = module_values.kind_of(collection) is type(system)
    return is_kind and numbers == sorted(system.numbers.tolist()) and all(map(following.is_free, found))


def become(collection: bpy.types.Collection, system: Scanner) -> None:
    """Give modules the places, directions and values that `system` has by their numbers, in float64.

    They are those of no workbook then. Raises InputError, and leaves the scanner as it was, unless it `can_become` this.
    """
    if not can_become(collection, system):
        raise InputError(f"scanner '{collection.name}' has other modules than the one that it is to become")
    cameras_ = {camera.mphdrr_module.number: camera for camera in scanner.modules(collection)}
    found = [cameras_[number] for number in system.numbers.tolist()]
    with following.writing():
        module_values.write_modules(found, system)
        for camera, matrix in zip(found, cameras.matrices_of(system.poses()), strict=True):
            objects.set_world_matrix(camera, matrix)
        if module_values.off_aim(collection, found):
            collection.mphdrr_scanner.keep_aimed = False
    scanner.remember_source(collection, system)
    following.refresh(collection, aim=False)


def move_to(collection: bpy.types.Collection, system: PinholeSystem) -> None:
    """Move and turn modules, with their lengths, to where `system` has those of their numbers.

    From then on the scanner does not keep its modules aimed, if one is tilted. Raises InputError, and moves none, where
    it lacks a module.
    """
    found = [scanner.module(collection, number) for number in system.numbers.tolist()]
    matrices, lengths = cameras.matrices_of(system.poses()), system.collimator_length.tolist()
    with following.writing():
        for camera, matrix, length in zip(found, matrices, lengths, strict=True):
            objects.set_world_matrix(camera, matrix)
            camera.mphdrr_module.collimator_length = length
            camera.mphdrr_module.length_mode = module_values.TYPED
        if module_values.off_aim(collection, found):
            collection.mphdrr_scanner.keep_aimed = False
    following.refresh(collection)


def make_single_users(collection: bpy.types.Collection) -> None:
    """Give every module a camera and meshes of its own, which can be reshaped."""
    for item in collection.all_objects:
        module = item.mphdrr_module
        if (module.is_module or module.part in collimators.PARTS) and item.data.users > 1:
            item.data = item.data.copy()
