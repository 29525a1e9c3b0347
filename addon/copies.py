"""Modules made and removed in the scene: duplicates, copied cameras, and what is left of deleted ones.

Everything here makes or removes datablocks: it is for operators, which are undo steps, not for handlers.
"""

from __future__ import annotations

from collections.abc import Sequence

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.geometry.collimator import Collimator
from ..core.geometry.collimator_mesh import Solid, collimator_solid, crystal_solid
from . import cameras, collimators, design, ids, scanner
from .module_values import add_module, module_numbers
from .scanner_parts import new_part

_PARTS = ("COLLIMATOR", "CRYSTAL")


def copied_cameras(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Cameras with the number of another: copies that Blender made. "Module 07" comes before "Module 07.001"."""
    seen: set[int] = set()
    copies = []
    for camera in sorted(scanner.modules(collection), key=lambda o: (len(o.name), o.name)):
        number = camera.mphdrr_module.number
        if number in seen:
            copies.append(camera)
        seen.add(number)
    return copies


def leftovers(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Collimators and crystals whose camera has gone."""
    return [
        item
        for item in collection.all_objects
        if item.mphdrr_module.part in _PARTS
        and not (item.parent is not None and item.parent.mphdrr_module.is_module and item.parent.users_collection)
    ]


def bare_cameras(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Modules with neither collimator nor crystal: copies whose original has gone."""
    parts = design.parts_of(collection, scanner.modules(collection))
    return [camera for camera, own in parts.items() if not own]


def untidy_text(collection: bpy.types.Collection) -> str:
    """What `tidy` would do, in words; empty where all is in order."""
    copies = copied_cameras(collection)
    bare = [camera for camera in bare_cameras(collection) if camera not in copies]
    left = leftovers(collection)
    texts = (
        f"{len(copies)} copied camera{'s' * (len(copies) > 1)}" if copies else "",
        f"{len(bare)} bare camera{'s' * (len(bare) > 1)}" if bare else "",
        f"{len(left)} part{'s' * (len(left) > 1)} without a camera" if left else "",
    )
    return ", ".join(text for text in texts if text)


def tidy(collection: bpy.types.Collection) -> tuple[list[int], int]:
    """Make modules of copied cameras, and remove parts without a camera: the new numbers, and how many parts.

    Raises
    ------
    InputError
        The shapes of a copy cannot be built: its numbers, or its original's, have to be cured first.
    """
    copies, left, numbers = copied_cameras(collection), leftovers(collection), []
    for camera in {*copies, *bare_cameras(collection)}:
        _solids(collection, camera)  # what cannot be built is said before anything is changed
    _remove(left)
    for camera in copies:
        adopt(collection, camera)
        numbers.append(camera.mphdrr_module.number)
    for camera in bare_cameras(collection):
        _add_parts(collection, camera)
    make_single_users(collection)
    scanner.refresh_scanner(collection)
    collection.mphdrr_scanner.untidy = untidy_text(collection)
    return numbers, len(left)


def adopt(
    collection: bpy.types.Collection, camera: bpy.types.Object, center: NDArray[np.float64] | None = None
) -> None:
    """Make the copy of a module's camera a module with a free number, a collimator and a crystal.

    `center` is its pinhole, (3,) in mm, to more digits than Blender keeps.
    """
    found = [o for o in scanner.modules(collection) if o != camera]
    number = max(o.mphdrr_module.number for o in found) + 1
    own = design.parts_of(collection, [camera])[camera]
    if not own:
        _add_parts(collection, camera)
        own = design.parts_of(collection, [camera])[camera]
    add_module(camera, number, max(o.mphdrr_module.index for o in found) + 1, center)
    camera.name = ids.module_name(number, len(found) + 1)
    if camera.data.users > 1:
        camera.data = camera.data.copy()
    camera.data.name = camera.name
    for part in own:
        part.name, part.mphdrr_module.number = ids.part_name(camera.name, part.mphdrr_module.part), number
        if part.data.users == 1:
            part.data.name = part.name


def _solids(collection: bpy.types.Collection, camera: bpy.types.Object) -> tuple[Solid, Solid]:
    _, _, d, l, side, thickness, _ = module_numbers(camera)
    body = Collimator(d, l, side, design.construction(collection.mphdrr_scanner))
    return collimator_solid(body), crystal_solid(l, side, thickness)


def _add_parts(collection: bpy.types.Collection, camera: bpy.types.Object) -> None:
    for part, solid in zip(_PARTS, _solids(collection, camera), strict=True):
        name = ids.part_name(camera.name, part)
        item = new_part(camera, part, name, collimators.new_mesh(name, solid, collimators.part_material(part)))
        item.hide_viewport, item.hide_render = camera.hide_viewport, camera.hide_render
        for home in camera.users_collection:
            home.objects.link(item)


def duplicate(
    collection: bpy.types.Collection, modules: Sequence[bpy.types.Object], count: int, angle: float, follow_ring: bool
) -> list[bpy.types.Object]:
    """Copy modules along their ring.

    Parameters
    ----------
    collection
        The scanner.
    modules
        The camera objects to copy.
    count
        How many copies of each.
    angle
        From one to the next, radians about the world's z axis.
    follow_ring
        Keep to the ring's arc: the copy's distance from the z axis, and its z, are those of the ring at its azimuth,
        linear between neighbours and beyond the arc's ends as at the end. Otherwise the copy is turned about z.

    Returns
    -------
    list
        The new camera objects.

    Raises
    ------
    InputError
        A copy would stand where a module stands already, or has no shape. The scene is as it was.
    """
    for camera in modules:
        _solids(collection, camera)
    taken = [module_numbers(o).center for o in scanner.modules(collection)]
    places = [
        (camera, place)
        for camera in modules
        for place in _along_ring(collection, camera, np.linspace(angle, count * angle, count), follow_ring)
    ]
    for camera, place in places:
        if np.linalg.norm(np.array(taken) - place, axis=1).min() < 1e-3:
            raise InputError(
                f"a copy of module {camera.mphdrr_module.number} would stand in the place of another module: "
                "choose another angle or count"
            )
        taken.append(place)
    made = []
    for camera, place in places:
        copy = camera.copy()
        copy.data = camera.data.copy()
        copy.animation_data_clear()
        for home in camera.users_collection:
            home.objects.link(copy)
        cameras.set_world_matrix(copy, cameras.camera_matrices(place[None])[0])
        adopt(collection, copy, place)
        made.append(copy)
    scanner.refresh_scanner(collection)
    return made


def _along_ring(
    collection: bpy.types.Collection, camera: bpy.types.Object, angles: NDArray[np.float64], follow_ring: bool
) -> NDArray[np.float64]:
    """Places (N, 3), mm, at `angles` (N,) about z from a module."""
    x, y, z = module_numbers(camera).center
    azimuth, radius, height = np.arctan2(y, x), np.hypot(x, y), z
    turned = azimuth + angles
    if follow_ring:
        ring = np.array(
            [
                module_numbers(o).center
                for o in scanner.modules(collection)
                if o.mphdrr_module.ring == camera.mphdrr_module.ring
            ]
        )
        # Azimuths from the module itself, so that an arc across +-pi stays in one piece.
        others = np.arctan2(ring[:, 1], ring[:, 0]) - azimuth
        others = (others + np.pi) % (2 * np.pi) - np.pi
        order = np.argsort(others)
        at = (angles + np.pi) % (2 * np.pi) - np.pi
        radius, height = (
            np.interp(at, others[order], values[order]) for values in (np.hypot(*ring[:, :2].T), ring[:, 2])
        )
    return np.column_stack(np.broadcast_arrays(radius * np.cos(turned), radius * np.sin(turned), height))


def remove(collection: bpy.types.Collection, modules: Sequence[bpy.types.Object]) -> None:
    """Remove modules with their collimators and crystals; what else hangs on them stays where it is.

    Raises
    ------
    InputError
        No module would be left.
    """
    if len(modules) >= len(scanner.modules(collection)):
        raise InputError("a scanner needs at least one module: leave one, or delete the scanner's collection")
    parts = [o for camera in modules for o in camera.children if o.mphdrr_module.part in _PARTS]
    for camera in modules:
        for child in camera.children:
            if child not in parts:
                matrix = cameras.world_matrix(child)
                child.parent = None
                cameras.set_world_matrix(child, matrix)
    _remove([*parts, *modules])
    scanner.refresh_scanner(collection)


def _remove(items: Sequence[bpy.types.Object]) -> None:
    datas = {item.data for item in items if item.data is not None}
    bpy.data.batch_remove(list(items))
    bpy.data.batch_remove([data for data in datas if data.users == 0])


def make_single_users(collection: bpy.types.Collection) -> None:
    """Give every module a camera and meshes of its own, which it can reshape."""
    for item in collection.all_objects:
        module = item.mphdrr_module
        if (module.is_module or module.part in _PARTS) and item.data.users > 1:
            item.data = item.data.copy()
