"""Edits that add, remove and renumber modules in the scene, by operators (undo steps), not by handlers."""

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
_OUR_NAME = re.compile(rf"({'|'.join(dict.fromkeys(_WORDS))}) \d+(\.\d+)?")  # a name that no user has given


def copied_cameras(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Return cameras with the same module number as another camera: "Module 07.001", Blender's copy of "Module 07"."""
    numbers: set[int] = set()
    copied = []
    for camera in sorted(scanner.modules(collection), key=lambda o: (len(o.name), o.name)):
        number = camera.mphdrr_module.number
        if number in numbers:
            copied.append(camera)
        numbers.add(number)
    return copied


def orphan_parts(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Return parts whose camera was deleted."""
    cameras_ = set(scanner.modules(collection))  # quicker than each camera's `users_collection`
    return [
        item
        for item in collection.all_objects
        if item.mphdrr_module.part in collimators.PARTS
        and item.parent not in cameras_
        and not (item.parent is not None and item.parent.mphdrr_module.is_module and item.parent.users_collection)
    ]


def bare_cameras(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Return modules without parts, of a kind that has some: copies whose original was deleted."""
    parts = following.parts_of(collection, scanner.modules(collection))
    bare = [camera for camera, module_parts in parts.items() if not module_parts]
    return bare if bare and module_values.kind_of(collection).parts is not Scanner.parts else []


def untidy_text(collection: bpy.types.Collection) -> str:
    """Return in words what `tidy` would put in order; "" where there is nothing."""
    copied = copied_cameras(collection)
    bare = [camera for camera in bare_cameras(collection) if camera not in copied]
    kinds = (
        ("copied camera{}", copied),
        ("bare camera{}", bare),
        ("part{} without a camera", orphan_parts(collection)),
    )
    return ", ".join(f"{len(items)} {text.format('s' * (len(items) > 1))}" for text, items in kinds if items)


def tidy(collection: bpy.types.Collection) -> tuple[list[int], int]:
    """Make modules of copied cameras, and remove parts without a camera.

    Return the new modules' numbers and how many parts were removed. Where a part cannot be built, nothing is changed.
    """
    copied, orphans, numbers = copied_cameras(collection), orphan_parts(collection), []
    for camera in (*copied, *bare_cameras(collection)):
        _build_parts(collection, camera)  # raises `InputError` before anything is changed
    objects.remove_objects(orphans)
    for camera in copied:
        make_module(collection, camera)
        numbers.append(camera.mphdrr_module.number)
    for camera in bare_cameras(collection):
        _add_parts(collection, camera)
    make_single_users(collection)
    following.refresh(collection)
    collection.mphdrr_scanner.untidy = untidy_text(collection)
    return numbers, len(orphans)


def make_module(collection: bpy.types.Collection, camera: bpy.types.Object, module: Scanner | None = None) -> None:
    """Make a copied camera a module of its own: `module`, or the one that the camera's position and values describe."""
    other_cameras = [o for o in scanner.modules(collection) if o != camera]
    number = max(o.mphdrr_module.number for o in other_cameras) + 1
    if not following.parts_of(collection, [camera])[camera]:
        _add_parts(collection, camera)
    camera.mphdrr_module.number = number
    module_values.store_exact_values([camera], module or _read_or_imported(collection, camera))
    camera.mphdrr_module.number, camera.mphdrr_module.added = number, True
    camera.mphdrr_module.index = max(o.mphdrr_module.index for o in other_cameras) + 1
    camera.name = ids.module_name(number, len(other_cameras) + 1, module_values.kind_of(collection).word)
    if camera.data.users > 1:
        camera.data = camera.data.copy()
    camera.data.name = camera.name
    for part in following.parts_of(collection, [camera])[camera]:
        part.name, part.mphdrr_module.number = ids.part_name(camera.name, part.mphdrr_module.part), number
        if part.data.users == 1:
            part.data.name = part.name


def _read_or_imported(collection: bpy.types.Collection, camera: bpy.types.Object) -> Scanner:
    """Return a module as it stands now, or as it was imported while its present values are impossible."""
    try:
        return scanner.read_module(collection, camera)
    except InputError:
        return module_values.as_imported(module_values.kind_of(collection), (camera.mphdrr_module.exact,))


def _build_parts(collection: bpy.types.Collection, camera: bpy.types.Object) -> Sequence[ModulePart]:
    """Return the parts, with their meshes, of which a module consists; raise `InputError` where they cannot be built."""
    construction = pinholes.construction(collection.mphdrr_scanner, module_values.kind_of(collection))
    return _read_or_imported(collection, camera).parts(construction)


def _add_parts(collection: bpy.types.Collection, camera: bpy.types.Object) -> None:
    """Add a module's parts to the scene, as children of its camera."""
    for part in _build_parts(collection, camera):
        item = new_part(camera, ids.part_name(camera.name, part.kind), part)
        item.hide_viewport, item.hide_render = camera.hide_viewport, camera.hide_render
        objects.link_beside(item, camera)


def duplicate_modules(
    collection: bpy.types.Collection, modules: Sequence[bpy.types.Object], count: int, angle: float, follow_ring: bool
) -> list[bpy.types.Object]:
    """Make `count` copies of each module, `angle` radians apart about the world's z axis, and return their camera objects.

    With `follow_ring` a copy's z and distance from the z axis are those of the ring at its azimuth, linear between
    neighbours and constant beyond the arc's ends; it keeps its tilt. Raises InputError, and leaves the scene as it was,
    where a module already stands in a copy's place or its parts cannot be built.
    """
    positions = [_position(o) for o in scanner.modules(collection)]
    angles = np.linspace(angle, count * angle, count)
    copies: list[tuple[bpy.types.Object, Scanner]] = []
    for camera in modules:
        _build_parts(collection, camera)
        module = scanner.read_module(collection, camera)
        poses = _copied_poses(collection, camera, module, angles, follow_ring)
        for pose in poses:
            if np.linalg.norm(np.array(positions) - pose[:3, 3], axis=1).min() < 1e-3:
                place, advice = "in the place of another module", "choose another angle or count"
                raise InputError(f"a copy of module {camera.mphdrr_module.number} would stand {place}: {advice}")
            positions.append(pose[:3, 3])
            copies.append((camera, module_values.with_formula_values(camera, module.at_poses(pose[None]))))
    copies_ = []
    for camera, module in copies:
        copy = camera.copy()
        copy.data = camera.data.copy()
        copy.animation_data_clear()
        objects.link_beside(copy, camera)
        objects.set_world_matrix(copy, cameras.camera_matrices(module.poses())[0], ("scale",))
        make_module(collection, copy, module)
        copies_.append(copy)
    following.refresh(collection)
    return copies_


def _position(camera: bpy.types.Object) -> NDArray[np.float64]:
    """Return the position (3,) of a camera, world mm."""
    return objects.world_matrix(camera)[:3, 3]


def _copied_poses(
    collection: bpy.types.Collection,
    camera: bpy.types.Object,
    module: Scanner,
    angles: NDArray[np.float64],
    follow_ring: bool,
) -> NDArray[np.float64]:
    """Return poses (N, 4, 4) of copies at `angles` (N,) about z from a module, which keep its tilt from the aim."""
    pose = module.poses()[0]
    x, y, z = pose[:3, 3]
    azimuth, radius = np.arctan2(y, x), np.hypot(x, y)
    if follow_ring:
        ring = camera.mphdrr_module.ring
        ring_positions = np.array([_position(o) for o in scanner.modules(collection) if o.mphdrr_module.ring == ring])
        # Azimuths relative to the module, so that an arc across +-pi stays in one piece.
        azimuths = _wrap_angles(np.arctan2(ring_positions[:, 1], ring_positions[:, 0]) - azimuth)
        order = np.argsort(azimuths)
        radius, z = (
            np.interp(_wrap_angles(angles), azimuths[order], values[order])
            for values in (np.hypot(*ring_positions[:, :2].T), ring_positions[:, 2])
        )
    new_azimuths = azimuth + angles
    positions = np.column_stack(np.broadcast_arrays(radius * np.cos(new_azimuths), radius * np.sin(new_azimuths), z))
    old_aim, new_aims = module.aimed(pose[None, :3, 3]), module.aimed(positions)
    if old_aim is None or new_aims is None:
        turns = rotations(angles[:, None] * [0.0, 0.0, 1.0])
    else:
        turns = new_aims[:, :3, :3] @ old_aim[:, :3, :3].transpose(0, 2, 1)
    return affine_matrix(turns @ pose[:3, :3], positions)


def _wrap_angles(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angles shifted to [-pi, pi)."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


def remove_modules(collection: bpy.types.Collection, modules: Sequence[bpy.types.Object]) -> None:
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
    _, user_objects = parts_and_others(collection)
    objects.remove_objects([item for item in user_objects if item.mphdrr_module.part != "NONE"])  # copied parts
    clear(scene, collection, {})
    bpy.data.collections.remove(collection)
    objects.remove_unused(bpy.data.materials.get(name) for name, _ in collimators.LOOKS.values())


def renumber(collection: bpy.types.Collection, order: Literal["RINGS", "LIST"] = "RINGS") -> int:
    """Renumber a scanner's modules 1, 2, ... in the order of `ring_order` or the present one; return how many have changed.

    They are listed, projected and exported in that order from now on. Names that the user gave stay. Raises InputError
    where the scanner is untidy, or its numbers are impossible; it stays as it was.
    """
    if untidy_items := untidy_text(collection):
        raise InputError(f"scanner '{collection.name}': {untidy_items}: press Tidy Modules in the Design panel first")
    system, camera_objects = scanner.read_scanner(collection), scanner.modules(collection)
    new_order = np.arange(len(camera_objects))
    if order == "RINGS":
        rings = system.rings()
        new_order = ring_order(system) if isinstance(system, PinholeSystem) else np.argsort(rings, kind="stable")
    module_parts = following.parts_of(collection, camera_objects)
    new_names: list[tuple[bpy.types.ID, str]] = []
    with following.writing():
        for index, camera in enumerate(camera_objects[m] for m in new_order):
            camera.mphdrr_module.number, camera.mphdrr_module.index = index + 1, index
            name = ids.module_name(index + 1, len(camera_objects), system.word)
            new_names += [(camera, name), (camera.data, name)]
            for part in module_parts[camera]:
                part.mphdrr_module.number = index + 1
                part_name = ids.part_name(name, part.mphdrr_module.part)
                new_names += [(part, part_name), (part.data, part_name)]
        renumbered = scanner.read_scanner(collection)
        if np.any(np.diff(new_order) < 0):
            collection.mphdrr_scanner.source = ""  # the workbook's rows are in another order
    renamings = [(data, name) for data, name in new_names if data.name != name and _OUR_NAME.fullmatch(data.name)]
    for datablock, name in renamings:
        datablock.name = f"{name} renumbered"  # frees the new names
    for datablock, name in renamings:
        datablock.name = name
    following.refresh(collection)
    return int(np.count_nonzero(system.numbers[new_order] != renumbered.numbers))


def has_modules_of(collection: bpy.types.Collection, system: Scanner) -> bool:
    """Return whether a scanner has the module numbers and the kind of `system`, and only the user moves its modules."""
    cameras_ = scanner.modules(collection)
    numbers = sorted(camera.mphdrr_module.number for camera in cameras_)
    is_kind = module_values.kind_of(collection) is type(system)
    return is_kind and numbers == sorted(system.numbers.tolist()) and all(map(objects.is_free, cameras_))


def set_modules(collection: bpy.types.Collection, system: Scanner) -> None:
    """Give modules the positions, directions and values that `system` has by their numbers, in float64.

    The scanner then belongs to no workbook. Raises InputError, and leaves the scanner as it was, unless it `has_modules_of`
    the system.
    """
    if not has_modules_of(collection, system):
        raise InputError(f"scanner '{collection.name}' has other modules than the one that it is to become")
    cameras_ = {camera.mphdrr_module.number: camera for camera in scanner.modules(collection)}
    ordered = [cameras_[number] for number in system.numbers.tolist()]
    with following.writing():
        module_values.write_modules(ordered, system)
        for camera, matrix in zip(ordered, cameras.camera_matrices(system.poses()), strict=True):
            objects.set_world_matrix(camera, matrix, ("scale",))
        if module_values.unaimed_numbers(collection, ordered):
            collection.mphdrr_scanner.keep_aimed = False
    scanner.store_saved_state(collection, system)
    following.refresh(collection, aim=False)


def move_modules(collection: bpy.types.Collection, system: PinholeSystem) -> None:
    """Move and turn modules, and set their lengths, to the values that `system` has by their numbers.

    If one is tilted, the scanner does not keep its modules aimed from then on. Raises InputError, and moves none, where the
    scanner lacks a module.
    """
    cameras_ = [scanner.module(collection, number) for number in system.numbers.tolist()]
    matrices, lengths = cameras.camera_matrices(system.poses()), system.collimator_length.tolist()
    with following.writing():
        for camera, matrix, length in zip(cameras_, matrices, lengths, strict=True):
            objects.set_world_matrix(camera, matrix, ("scale",))
            camera.mphdrr_module.collimator_length = length
            camera.mphdrr_module.length_mode = module_values.TYPED
        if module_values.unaimed_numbers(collection, cameras_):
            collection.mphdrr_scanner.keep_aimed = False
    following.refresh(collection)


def make_single_users(collection: bpy.types.Collection) -> None:
    """Give every module its own camera data and meshes, which can be reshaped."""
    for item in collection.all_objects:
        module = item.mphdrr_module
        if (module.is_module or module.part in collimators.PARTS) and item.data.users > 1:
            item.data = item.data.copy()
