"""The scanner in the scene: `PinholeSystem` to collection and back.

A scanner is a collection with a sub-collection per ring; a module is a camera object (`Object.mphdrr_module`)
whose children are its collimator and its crystal.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..core.errors import InputError, InputWarning
from ..core.geometry.collimator import OPENING_ANGLE, Construction, EdgePlace
from ..core.geometry.module_parts import module_parts
from ..core.geometry.system import PinholeSystem
from ..core.workbook import ColumnMap, QuantityCells, SystemSource
from . import cameras, design, ids
from .module_values import LENGTHS, TYPED, is_edited, is_moved, module_numbers, off_aim, remember
from .replacement import clear, losses, modules_text
from .scanner_parts import NewScanner


def build_scanner(
    scene: bpy.types.Scene,
    system: PinholeSystem,
    name: str = "",
    *,
    plate_thickness: float = 2.0,
    wall_thickness: float = 2.0,
    opening_angle: float = OPENING_ANGLE,
    edge_at: EdgePlace = "middle",
    shape: tuple[int, int] = (256, 256),
    replace: bool = False,
) -> bpy.types.Collection:
    """Put a scanner into the scene; one of the same name is replaced.

    Parameters
    ----------
    scene
        Also gets millimetres as its units and `shape` as its render resolution.
    system
        The modules.
    name
        Name of the scanner's collection; by default that of the workbook's file.
    plate_thickness, wall_thickness
        Of the aperture plates and the collimators' walls, mm.
    opening_angle, edge_at
        Full angle of the holes' double cone, rad, and where in the plate its edge is: "middle", or the face in "front",
        towards the ROI, or "back".
    shape
        Pixels (n_v, n_u) of the cameras' pictures.
    replace
        Replace a scanner of the same name even where `losses` names something. Objects that are not the
        scanner's are never deleted: they move to the scene's own collection.

    Returns
    -------
    bpy.types.Collection
        The scanner's collection.

    Raises
    ------
    InputError
        Something would be lost and `replace` is False, or the collimator cannot be built so. The scene is as it
        was.
    """
    name = name or default_name(system)
    old = find_scanner(scene, name)
    lost = losses(old) if old is not None and not replace else []
    if lost:
        raise InputError(
            f"scanner '{name}' has changed since it was imported ({'; '.join(lost)}): set replace=True to drop this"
        )
    construction = Construction(plate_thickness, wall_thickness, opening_angle, edge_at)
    parts = module_parts(system, construction)

    new = NewScanner()
    try:
        new.make(system, parts)
    except BaseException:
        new.discard()
        raise
    hidden: set[int] = set()
    if old is None:
        collection = bpy.data.collections.new(name)
        scene.collection.children.link(collection)
    else:
        collection = old
        hidden = {o.mphdrr_module.number for o in modules(old) if not o.mphdrr_module.visible}
        clear(scene, old, new.cameras)
    new.name_and_link(collection)
    for camera in new.cameras.values():
        if camera.mphdrr_module.number in hidden:
            set_visible(camera, False)

    properties = collection.mphdrr_scanner
    properties.scanner_name = name
    properties.plate_thickness, properties.wall_thickness = plate_thickness, wall_thickness
    properties.opening_angle, properties.edge_at = opening_angle, edge_at.upper()
    properties.is_scanner = True
    _write_source(properties, system)
    refresh_scanner(collection)

    _prepare_scene(scene, system, shape)
    if scene.camera is None:
        scene.camera = new.cameras[int(np.asarray(system.numbers)[0])]
    state = scene.mphdrr_geometry
    state.scanner = collection
    state.active_index = collection.all_objects.find(new.cameras[int(np.asarray(system.numbers)[0])].name)
    return collection


def remember_source(collection: bpy.types.Collection, system: PinholeSystem) -> None:
    """Take `system`, which has the scanner's modules in their order, for what it was imported as: it has been saved."""
    with design.writing():
        for m, camera in enumerate(modules(collection)):
            remember(camera, system, m)
    _write_source(collection.mphdrr_scanner, system)


def source(collection: bpy.types.Collection) -> SystemSource | None:
    """The workbook that the scanner was read from or last written to, with its column map, whatever has changed since."""
    return _source_from_dict(json.loads(collection.mphdrr_scanner.source or "{}"))


def _write_source(properties: bpy.types.PropertyGroup, system: PinholeSystem) -> None:
    properties.n_modules = len(system)
    properties.quick_ranges = json.dumps(quick_ranges(system))
    source = _source_to_dict(system.source)
    properties.source = json.dumps(source)
    properties.workbook, properties.sha256 = source.get("path", ""), source.get("sha256", "")


def default_name(system: PinholeSystem) -> str:
    """Name of a system's scanner when none is given: its workbook's, without the suffix."""
    return Path(_source_to_dict(system.source).get("path", "")).stem or ids.SCANNER


def quick_ranges(system: PinholeSystem) -> list[tuple[int, int]]:
    """Up to three ranges (first, last) of module numbers, each of half the rings: 1-40, 21-60, 41-80 of 4 x 20."""
    rings, numbers = system.rings(), np.asarray(system.numbers)
    n_rings = int(rings.max()) + 1
    width = max(1, n_rings // 2)
    ranges = []
    for start in sorted({0, (n_rings - width) // 2, n_rings - width}):
        inside = (rings >= start) & (rings < start + width)
        first, last = int(numbers[inside].min()), int(numbers[inside].max())
        if np.array_equal(inside, (numbers >= first) & (numbers <= last)):
            ranges.append((first, last))
    return ranges


def _prepare_scene(scene: bpy.types.Scene, system: PinholeSystem, shape: tuple[int, int]) -> None:
    units = scene.unit_settings
    units.system, units.scale_length, units.length_unit = "METRIC", 0.001, "MILLIMETERS"
    cameras.set_render_shape(scene, shape)
    reach = 2.0 * float(system.pinhole_distance.max() + system.collimator_length.max())
    for screen in bpy.data.screens:
        for area in screen.areas:
            for space in area.spaces:
                if space.type == "VIEW_3D":
                    space.clip_start = max(space.clip_start, 1.0)
                    space.clip_end = max(space.clip_end, 10.0 * reach)


def scanners(scene: bpy.types.Scene) -> list[bpy.types.Collection]:
    """The scanners in the scene."""
    return [c for c in scene.collection.children_recursive if c.mphdrr_scanner.is_scanner]


def find_scanner(scene: bpy.types.Scene, name: str) -> bpy.types.Collection | None:
    """The scanner that was imported under that name, or whose collection is called so."""
    found = scanners(scene)
    by_name = [c for c in found if c.mphdrr_scanner.scanner_name == name] or [c for c in found if c.name == name]
    return by_name[0] if by_name else None


def active_scanner(scene: bpy.types.Scene) -> bpy.types.Collection | None:
    """The scanner that the panels work on: the chosen one while it is in the scene, else the first."""
    found = scanners(scene)
    chosen = scene.mphdrr_geometry.scanner
    return chosen if chosen in found else next(iter(found), None)


def required_scanner(scene: bpy.types.Scene) -> bpy.types.Collection:
    """The scanner that the panels work on, or `InputError`."""
    collection = active_scanner(scene)
    if collection is None:
        raise InputError("no scanner in the scene: import a workbook first")
    return collection


def modules(collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """The scanner's camera objects in the order of the system, which is that of `read_scanner`."""
    found = [o for o in collection.all_objects if o.mphdrr_module.is_module]
    return sorted(found, key=lambda o: (o.mphdrr_module.index, o.mphdrr_module.number, o.name))


def module(collection: bpy.types.Collection, number: int) -> bpy.types.Object:
    """The camera object of a module, or `InputError`."""
    for camera in collection.all_objects:
        if camera.mphdrr_module.is_module and camera.mphdrr_module.number == number:
            return camera
    raise InputError(f"scanner '{collection.name}' has no module {number}")


def scanner_of(camera: bpy.types.Object) -> bpy.types.Collection | None:
    """The scanner that an object belongs to."""
    for collection in bpy.data.collections:
        if collection.mphdrr_scanner.is_scanner and camera.name in collection.all_objects:
            return collection
    return None


def read_scanner(collection: bpy.types.Collection, *, aimed: bool = False) -> PinholeSystem:
    """The scanner as it stands in the scene now: the cameras' places, and the numbers in their properties.

    Numbers that nobody has changed come back exactly, in float64. A module is aimed at the isocentre wherever it
    is; a camera that looks elsewhere is named in an `InputWarning` (`aim_modules` turns it), or refused with
    `aimed`. The system has its source (the workbook) only while all is as it was imported.

    Raises
    ------
    InputError
        There is no module, two have one number, the numbers make no system, or, with `aimed`, a camera looks elsewhere.
    """
    found = modules(collection)
    if not found:
        raise InputError(f"collection '{collection.name}' has no pinhole modules: import a geometry first")
    by_number: dict[int, bpy.types.Object] = {}
    for camera in found:
        other = by_number.setdefault(camera.mphdrr_module.number, camera)
        if other is not camera:
            raise InputError(
                f"'{other.name}' and '{camera.name}' both have module number {camera.mphdrr_module.number}: "
                f"press Tidy Modules in the Design panel, or delete one"
            )
    off = off_aim(found)
    if off and aimed:
        raise InputError(
            f"scanner '{collection.name}': {modules_text(off)} not aimed at the isocentre, which the geometry cannot "
            "say: press Aim at Isocentre in the Design panel"
        )
    if off:
        warnings.warn(
            f"scanner '{collection.name}': {modules_text(off)} not aimed at the isocentre in the scene, but "
            "calculated as if aimed: press Aim at Isocentre in the Design panel",
            InputWarning,
            stacklevel=2,
        )
    numbers = [module_numbers(camera) for camera in found]
    as_imported = len(found) == collection.mphdrr_scanner.n_modules and not any(
        camera.mphdrr_module.added or is_moved(camera) or is_edited(camera) for camera in found
    )
    return PinholeSystem(
        centers=np.array([n.center for n in numbers]),
        **{name: np.array([getattr(n, name) for n in numbers]) for name in LENGTHS},
        numbers=np.array(list(by_number), dtype=np.int64),
        source=source(collection) if as_imported else None,
    )


def aim_modules(collection: bpy.types.Collection) -> list[int]:
    """Turn every camera that does not look at the isocentre; returns the numbers of those."""
    off = set(off_aim(modules(collection)))
    for camera in modules(collection):
        if camera.mphdrr_module.number in off:
            center = cameras.world_matrix(camera)[None, :3, 3]
            cameras.set_world_matrix(camera, cameras.camera_matrices(center)[0])
    return sorted(off)


def set_visible(camera: bpy.types.Object, visible: bool) -> None:
    """Show or hide a module with its collimator and crystal, in the viewport and in renders."""
    own = [c for c in camera.children if c.mphdrr_module.part != "NONE"]
    for item in (camera, *own):
        item.hide_viewport = item.hide_render = not visible


def show_modules(collection: bpy.types.Collection, first: int, last: int, mode: str = "ONLY") -> int:
    """Show modules first..last (their numbers, both included).

    Parameters
    ----------
    mode
        ``"SHOW"`` or ``"HIDE"`` those and leave the others, ``"ONLY"`` those, or ``"ALL"``.

    Returns
    -------
    int
        How many modules are visible now.

    Raises
    ------
    InputError
        No module has a number in that range.
    """
    found = modules(collection)
    inside = {o for o in found if mode == "ALL" or first <= o.mphdrr_module.number <= last}
    if not inside:
        numbers = [o.mphdrr_module.number for o in found] or [0]
        raise InputError(
            f"no module between {first} and {last}: '{collection.name}' has {min(numbers)} to {max(numbers)}"
        )
    # An object's children are looked up among all objects: once, not once a module.
    children: dict[bpy.types.Object, list[bpy.types.Object]] = {camera: [camera] for camera in found}
    for item in collection.all_objects:
        if item.parent in children and item.mphdrr_module.part != "NONE":
            children[item.parent].append(item)
    for camera, items in children.items():
        if camera not in inside and mode in {"SHOW", "HIDE"}:
            continue
        hide = mode == "HIDE" or camera not in inside
        for item in items:
            if item.hide_viewport != hide:
                item.hide_viewport = hide
            if item.hide_render != hide:
                item.hide_render = hide
    return sum(not camera.hide_viewport for camera in found)


def select_active(context: bpy.types.Context) -> None:
    """Select the camera of the module that is active in the list, as a click on it would."""
    collection = active_scanner(context.scene)
    index = context.scene.mphdrr_geometry.active_index
    if collection is None or context.mode != "OBJECT" or not 0 <= index < len(collection.all_objects):
        return
    camera = collection.all_objects[index]
    if camera.visible_get(view_layer=context.view_layer):
        for item in context.selected_objects:
            item.select_set(False, view_layer=context.view_layer)
        camera.select_set(True, view_layer=context.view_layer)
        context.view_layer.objects.active = camera


def refresh_module(camera: bpy.types.Object) -> None:
    """Make a module's camera, collimator, crystal and readouts follow its numbers (called when one is edited)."""
    collection = scanner_of(camera) if camera.mphdrr_module.is_module and not design.is_writing() else None
    if collection is not None:
        design.refresh(collection, modules(collection), [camera])


def refresh_scanner(collection: bpy.types.Collection) -> None:
    """Make all modules follow their places and numbers, and the scanner's totals follow them."""
    if collection.mphdrr_scanner.is_scanner and not design.is_writing():
        found = modules(collection)
        design.refresh(collection, found, found, totals=True)


def set_for_all(collection: bpy.types.Collection, name: str) -> None:
    """Give all modules the scanner's number called `name` (or its "length_mode")."""
    if not collection.mphdrr_scanner.is_scanner or design.is_writing():
        return
    value = getattr(collection.mphdrr_scanner, name)
    with design.writing():
        for camera in modules(collection):
            setattr(camera.mphdrr_module, name, value)
            if name == "collimator_length":
                camera.mphdrr_module.length_mode = TYPED
    refresh_scanner(collection)


def copy_numbers(
    collection: bpy.types.Collection, source: bpy.types.Object, targets: Iterable[bpy.types.Object]
) -> None:
    """Give modules the lengths of another, and where its `l` comes from."""
    with design.writing():
        for camera in targets:
            for name in (*LENGTHS, "length_mode"):
                setattr(camera.mphdrr_module, name, getattr(source.mphdrr_module, name))
    refresh_scanner(collection)


def _source_to_dict(source: SystemSource | None) -> dict[str, Any]:
    if source is None:
        return {}
    columns = "" if source.columns is None else source.columns.to_toml()
    return {**asdict(source), "path": str(source.path), "columns": columns}


def _source_from_dict(values: dict[str, Any]) -> SystemSource | None:
    if not values:
        return None
    cells = tuple(QuantityCells(**{**c, "rows": tuple(c["rows"])}) for c in values["cells"])
    columns = values.get("columns")  # files of earlier versions have none
    return SystemSource(
        **{
            **values,
            "path": Path(values["path"]),
            "numbers": tuple(values["numbers"]),
            "cells": cells,
            "columns": ColumnMap.from_toml(columns) if columns else None,
        }
    )
