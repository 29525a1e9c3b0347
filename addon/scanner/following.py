"""Modules follow their numbers: cameras are aimed, collimators and crystals reshaped, readouts calculated.

Everything is changed in place (vertices, properties, rotations). No datablock is made or removed: this also runs after
Blender has stored an undo step, and undo expects the datablocks that it stored. `module_edits.py` makes and removes modules.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import bpy
import numpy as np

from ...core.errors import InputError
from ...core.geometry.collimator import Construction, EdgePlace
from ...core.geometry.system import LENGTHS
from ...core.physics.performance import ModulePerformance, isocentre_performance
from ..blender import objects
from ..blender.decimals import typed
from . import cameras, collimators
from .module_values import TYPED, ModuleNumbers, are_aimed, numbers_of, system_of

PARTS = ("COLLIMATOR", "CRYSTAL")  # what hangs on a module's camera: `Object.mphdrr_module.part`
_KEY = "mphdrr_solid"  # custom property of a mesh or camera: the numbers that it was built from
_ConstructionNumbers = tuple[float, float, float, EdgePlace]
_writing = 0


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
    found = [o for o in collection.all_objects if o.mphdrr_module.is_module]
    return sorted(found, key=lambda o: (o.mphdrr_module.index, o.mphdrr_module.number, o.name))


def parts_of(
    collection: bpy.types.Collection, found: Sequence[bpy.types.Object]
) -> dict[bpy.types.Object, list[bpy.types.Object]]:
    """Each module's collimator and crystal."""
    # `Object.children` searches all objects: once for one module, but not once for each of eighty.
    items = found[0].children if len(found) == 1 else collection.all_objects
    parts: dict[bpy.types.Object, list[bpy.types.Object]] = {camera: [] for camera in found}
    for item in items:
        if item.mphdrr_module.part in PARTS and item.parent in parts:
            parts[item.parent].append(item)
    return parts


def construction(scanner: bpy.types.PropertyGroup) -> Construction:
    """How the scanner's collimators are built; raises `InputError` where they cannot be."""
    return Construction(*_construction_numbers(scanner))


def refresh(
    collection: bpy.types.Collection, changed: Sequence[bpy.types.Object] | None = None, aim: bool = True
) -> None:
    """Make a scanner's modules, and its totals, follow their places and numbers.

    `changed` are the camera objects that may have changed; by default all. `aim` lets the scanner keep them aimed.
    """
    scanner = collection.mphdrr_scanner
    if is_writing() or not scanner.is_scanner:
        return
    found = modules(collection)
    with writing():
        parts = parts_of(collection, found if changed is None else changed)
        rebuilt = _refresh_modules(parts, scanner, aim)
        if changed is None or rebuilt or scanner.count != len(found):
            _update_totals(scanner, [camera.mphdrr_module for camera in found])
            radius = max((camera.mphdrr_module.roi_radius for camera in found), default=0.0)
            for item in collection.objects:
                if item.mphdrr_module.part == "ROI" and radius > 0:
                    collimators.resize_sphere(item.data, radius)


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
    """Give all modules the scanner's number called `name` (or its "length_mode"): it was edited."""
    if not collection.mphdrr_scanner.is_scanner or is_writing():
        return
    with writing():
        for camera in modules(collection):
            setattr(camera.mphdrr_module, name, getattr(collection.mphdrr_scanner, name))
            if name == "collimator_length":
                camera.mphdrr_module.length_mode = TYPED
    refresh(collection)


def _refresh_modules(
    parts: dict[bpy.types.Object, list[bpy.types.Object]], scanner: bpy.types.PropertyGroup, aim: bool
) -> bool:
    """Make modules follow, all together, which is faster than one by one; returns whether a readout has changed."""
    cameras_, matrices = list(parts), objects.world_matrices(list(parts))
    may_aim = aim and scanner.keep_aimed
    off = ~are_aimed(matrices) & np.any(matrices[:, :3, 3], axis=1) & may_aim
    to_aim = []
    for m, (camera, place) in enumerate(zip(cameras_, matrices[:, :3, 3], strict=True)):
        module = camera.mphdrr_module
        if np.any(np.array(module.placed, np.float32) != place.astype(np.float32)):
            if off[m] and module.built and is_free(camera):  # it is not new
                to_aim.append(m)
            module.placed = place
    for m, matrix in zip(to_aim, cameras.camera_matrices(matrices[to_aim, :3, 3]), strict=True):
        objects.set_world_matrix(cameras_[m], matrix)
        matrices[m] = objects.world_matrix(cameras_[m])
    built_as, intrinsic_fwhm = _construction_numbers(scanner), typed(scanner.intrinsic_fwhm)
    found, changed = numbers_of(cameras_, matrices), []
    for camera, numbers, aimed in zip(cameras_, found, are_aimed(matrices).tolist(), strict=True):
        module = camera.mphdrr_module
        built = repr((*numbers._replace(center=numbers.center.tolist()), aimed, *built_as, intrinsic_fwhm))
        if module.built != built:
            module.built, module.finding, module.aimed = built, "", aimed
            module.collimator_length, module.pinhole_distance = numbers.collimator_length, numbers.pinhole_distance
            changed.append((module, numbers))
    _update_readouts(changed, intrinsic_fwhm)
    for camera, numbers in zip(cameras_, found, strict=True):
        # Even where nothing has changed: an undo may have restored the numbers and not the meshes.
        problem = "" if camera.mphdrr_module.problem else _rebuild(camera, numbers, built_as, parts[camera])
        if problem:
            camera.mphdrr_module.problem = problem
    return bool(changed)


_construction = lru_cache(maxsize=1)(lambda numbers: Construction(*numbers))


def is_free(item: bpy.types.Object) -> bool:
    """Whether only the user moves an object: no animation, driver or constraint does."""
    data = item.animation_data
    animated = data is not None and (data.action is not None or len(data.drivers) or len(data.nla_tracks))
    return not animated and not len(item.constraints)


def _construction_numbers(scanner: bpy.types.PropertyGroup) -> _ConstructionNumbers:
    """The arguments of `Construction`, which may refuse them."""
    lengths = typed(scanner.plate_thickness), typed(scanner.wall_thickness)
    return *lengths, typed(scanner.opening_angle), scanner.edge_at.lower()


def _rebuild(
    camera: bpy.types.Object, numbers: ModuleNumbers, built_as: _ConstructionNumbers, parts: Sequence[bpy.types.Object]
) -> str:
    """Give the camera's view and the parts' meshes the shape of `numbers`; returns why not, or an empty text."""
    l, side = numbers.collimator_length, numbers.detector_side
    given: dict[str, tuple[Any, ...]] = {
        "COLLIMATOR": (numbers.pinhole_diameter, l, side, *built_as),
        "CRYSTAL": (l, side, numbers.detector_thickness),
    }
    if _differs(camera.data, (l, side)):
        _set_view(camera.data, l, side)
    for item in parts:
        part = item.mphdrr_module.part
        if item.data.is_editmode or not _differs(item.data, given[part]):
            continue
        try:
            solid = collimators.part_solid(part, numbers, _construction(built_as))
        except InputError as error:  # e.g. while d is typed before Ld: the last shape stays
            return f"module {numbers.number}: {error}"
        collimators.reshape_mesh(item.data, solid)
        item.data[_KEY] = repr(given[part])
    return ""


def _set_view(camera: bpy.types.Camera, l: float, side: float) -> None:
    cameras.set_field_of_view(camera, side, l)
    camera[_KEY] = repr((l, side))


def shows_its_field(camera: bpy.types.Object) -> bool:
    """Whether a module's camera sees what its projection shows: its lens and sensor are not edited."""
    module = camera.mphdrr_module
    sizes = module.detector_side, module.collimator_length
    return bool(module.problem) or cameras.has_field_of_view(camera.data, *sizes)


def reset_views(collection: bpy.types.Collection) -> list[int]:
    """Make the modules' cameras see what their projections show; returns the numbers of those that did not."""
    edited = [camera for camera in modules(collection) if not shows_its_field(camera)]
    for camera in edited:
        _set_view(camera.data, camera.mphdrr_module.collimator_length, camera.mphdrr_module.detector_side)
    return [camera.mphdrr_module.number for camera in edited]


def _differs(data: bpy.types.ID, numbers: tuple[float | str, ...]) -> bool:
    """Whether a mesh or camera was built from other numbers. A shared one stays until `module_edits.py` has copied it."""
    return data.users == 1 and data.get(_KEY) != repr(numbers)


def _update_readouts(changed: Sequence[tuple[bpy.types.PropertyGroup, ModuleNumbers]], intrinsic_fwhm: float) -> None:
    """Write modules' readouts; where the numbers of one are impossible they are 0, and `problem` says why."""
    if not changed:
        return
    try:
        system = system_of([numbers for _, numbers in changed])  # refuses impossible ones
        sizes = (getattr(system, name) for name in LENGTHS if name != "roi_radius")
        at = isocentre_performance(system.pinhole_distance, *sizes, intrinsic_fwhm=intrinsic_fwhm)
        problem = ""
    except InputError as error:
        if len(changed) > 1:  # which one is it?
            for one in changed:
                _update_readouts([one], intrinsic_fwhm)
            return
        problem, at = str(error), ModulePerformance(*np.zeros((4, 1)))
    for (module, _), *values in zip(changed, *(readout.tolist() for readout in at), strict=True):
        module.problem = problem
        module.sensitivity, module.resolution = 1e6 * values[0], values[1]
        module.magnification, module.roi_seen = values[2:]


def _update_totals(scanner: bpy.types.PropertyGroup, modules: Sequence[bpy.types.PropertyGroup]) -> None:
    """Write the readouts of all modules together, and the numbers that they share."""
    good = [module for module in modules if not module.problem]
    scanner.count = len(modules)
    scanner.sensitivity = sum(module.sensitivity for module in good)
    scanner.resolution = sum(module.resolution for module in good) / max(1, len(good))
    scanner.n_covering = sum(module.sees_roi for module in good)
    scanner.findings = ""
    mixed = []
    for name in (*LENGTHS, "length_mode") if modules else ():
        setattr(scanner, name, getattr(modules[0], name))
        if len({getattr(module, name) for module in modules}) > 1:
            mixed.append(name)
    scanner.mixed = " ".join(mixed)
