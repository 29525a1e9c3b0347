"""A scanner that follows its numbers: cameras, collimators and crystals rebuilt, readouts updated.

Everything happens in place (vertices, properties, rotations). No datablock is made or removed: this runs after Blender
has taken its undo steps, and undo expects to find what it left. `copies.py` makes and removes, as operators do.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

import bpy
import numpy as np

from ..core.errors import InputError
from ..core.geometry.collimator import Collimator, Construction, EdgePlace
from ..core.geometry.collimator_mesh import collimator_solid, crystal_solid
from . import cameras, collimators, readouts
from .decimals import typed
from .module_values import TYPED, ModuleNumbers, module_numbers, off_aim

_KEY = "mphdrr_solid"  # custom property of a mesh: the numbers that it was built with
_Shape = tuple[float, float, float, EdgePlace]
_writing = 0


@contextmanager
def writing() -> Iterator[None]:
    """Within this block properties are written by the extension: their edits rebuild nothing."""
    global _writing
    _writing += 1
    try:
        yield
    finally:
        _writing -= 1


def is_writing() -> bool:
    """Whether the extension itself is writing properties now."""
    return bool(_writing)


def type_length(camera: bpy.types.Object) -> None:
    """Let a module keep the `l` that it shows."""
    with writing():
        camera.mphdrr_module.length_mode = TYPED


def refresh(
    collection: bpy.types.Collection,
    modules: Sequence[bpy.types.Object],
    changed: Iterable[bpy.types.Object],
    totals: bool = False,
    aim: bool = True,
) -> None:
    """Make modules, and their scanner's totals, follow their places and numbers.

    Parameters
    ----------
    collection
        The scanner.
    modules
        All of its camera objects, in order.
    changed
        Those to look at. One that is as it was built costs next to nothing.
    totals
        Calculate the totals again even where no module has changed: after an undo.
    aim
        Aim modules that have been moved, if the scanner is set so.
    """
    if is_writing():
        return
    changed = list(changed)
    scanner = collection.mphdrr_scanner
    with writing():
        parts = parts_of(collection, changed)
        rebuilt = [_refresh_module(camera, scanner, parts[camera], aim) for camera in changed]
        if totals or any(rebuilt) or scanner.count != len(modules):
            readouts.update_scanner(scanner, [camera.mphdrr_module for camera in modules])
            _resize_roi(collection, modules)


def parts_of(
    collection: bpy.types.Collection, modules: Sequence[bpy.types.Object]
) -> dict[bpy.types.Object, list[bpy.types.Object]]:
    """Each module's collimator and crystal. (`Object.children` would look among all objects, once a module.)"""
    if len(modules) == 1:
        return {modules[0]: [c for c in modules[0].children if c.mphdrr_module.part in {"COLLIMATOR", "CRYSTAL"}]}
    parts: dict[bpy.types.Object, list[bpy.types.Object]] = {camera: [] for camera in modules}
    for item in collection.all_objects:
        if item.mphdrr_module.part in {"COLLIMATOR", "CRYSTAL"} and item.parent in parts:
            parts[item.parent].append(item)
    return parts


def _refresh_module(
    camera: bpy.types.Object, scanner: bpy.types.PropertyGroup, parts: Sequence[bpy.types.Object], aim: bool
) -> bool:
    """Make one module follow; says whether its readouts have changed."""
    module = camera.mphdrr_module
    place = cameras.world_matrix(camera)[:3, 3]
    if np.any(np.array(module.placed, np.float32) != place.astype(np.float32)):
        aim = aim and bool(module.built)  # otherwise it is seen for the first time
        module.placed = place
        if aim and scanner.keep_aimed and is_free(camera) and off_aim([camera]) and np.any(place):
            cameras.set_world_matrix(camera, cameras.camera_matrices(place[None])[0])
    numbers, aimed = module_numbers(camera), not off_aim([camera])
    shape = _construction_numbers(scanner)
    intrinsic_fwhm = typed(scanner.intrinsic_fwhm)
    built = repr((*numbers._replace(center=numbers.center.tolist()), aimed, *shape, intrinsic_fwhm))
    changed = module.built != built
    if changed:
        module.built, module.finding = built, ""
        module.collimator_length = numbers.collimator_length
        readouts.update_module(module, numbers, aimed, intrinsic_fwhm)
    # Also of a module that has not changed: an undo may have taken back its numbers and not its meshes.
    problem = "" if module.problem else _rebuild(camera, numbers, shape, parts)
    if problem:
        module.problem = problem
    return changed


def is_free(camera: bpy.types.Object) -> bool:
    """Whether nothing but the user turns the camera: no animation, no driver, no constraint."""
    data = camera.animation_data
    is_animated = data is not None and (data.action is not None or len(data.drivers) or len(data.nla_tracks))
    return not is_animated and not len(camera.constraints)


def construction(scanner: bpy.types.PropertyGroup) -> Construction:
    """How the scanner's collimators are built, or `InputError`."""
    return Construction(*_construction_numbers(scanner))


def _construction_numbers(scanner: bpy.types.PropertyGroup) -> _Shape:
    """The arguments of `Construction` as the scanner has them; they may be such that there is none."""
    lengths = typed(scanner.plate_thickness), typed(scanner.wall_thickness)
    return *lengths, typed(scanner.opening_angle), scanner.edge_at.lower()


def _rebuild(
    camera: bpy.types.Object,
    numbers: ModuleNumbers,
    shape: _Shape,
    parts: Sequence[bpy.types.Object],
) -> str:
    """Make the camera's view and the parts' meshes those of `numbers`; says why not, if there is no such shape."""
    _, _, d, l, side, thickness, _ = numbers
    if _differs(camera.data, (l, side)):
        cameras.set_field_of_view(camera.data, side, l)
        camera.data[_KEY] = repr((l, side))
    for part in parts:
        is_collimator = part.mphdrr_module.part == "COLLIMATOR"
        given = (d, l, side, *shape) if is_collimator else (l, side, thickness)
        if part.data.is_editmode or not _differs(part.data, given):
            continue
        try:
            solid = (
                collimator_solid(Collimator(d, l, side, Construction(*shape)))
                if is_collimator
                else crystal_solid(l, side, thickness)
            )
        except InputError as error:  # e.g. while d is typed before Ld: the last shape stays
            return f"module {numbers.number}: {error}"
        collimators.reshape_mesh(part.data, solid)
        part.data[_KEY] = repr(given)
    return ""


def _differs(data: bpy.types.ID, numbers: tuple[float | str, ...]) -> bool:
    """Whether a mesh or camera was built from other numbers than these.

    One that is shared, as a fresh copy's is, stays as it is until `copies.py` has given it its own.
    """
    return data.users == 1 and data.get(_KEY) != repr(numbers)


def _resize_roi(collection: bpy.types.Collection, modules: Sequence[bpy.types.Object]) -> None:
    radius = max((camera.mphdrr_module.roi_radius for camera in modules), default=0.0)
    for item in collection.objects:
        if item.mphdrr_module.part == "ROI" and radius > 0:
            collimators.resize_sphere(item.data, radius)
