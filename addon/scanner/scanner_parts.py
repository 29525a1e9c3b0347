"""Datablocks of a scanner: made outside the scene, so that a failure leaves nothing behind, and replaced there."""

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np

from ...core.errors import several
from ...core.geometry.module_parts import ModulePart
from ...core.geometry.scanner import Scanner
from ..blender import ids, objects
from . import cameras, collimators, module_values, pinholes


class NewScanner:
    """Datablocks of a scanner that is not in the scene yet: `cameras` by module number, `rings`, and `roi` or None."""

    def __init__(self, system: Scanner, parts: Sequence[ModulePart]) -> None:
        self.cameras: dict[int, bpy.types.Object] = {}
        self.rings: list[bpy.types.Collection] = []
        self._named: list[tuple[bpy.types.ID, str]] = []  # names to give once the old scanner is gone
        kinds = ("ROI", *(part.kind.upper() for part in parts))
        self._materials = {kind: collimators.part_material(kind) for kind in kinds}
        try:
            self._make_cameras(system)
            self._make_parts(system, parts)
            self.roi = self._make_roi(system)
        except BaseException:
            bpy.data.batch_remove([datablock for datablock, _ in self._named])
            objects.remove_unused(self._materials.values())
            raise

    def _make_cameras(self, system: Scanner) -> None:
        """Make the rings' collections, and the modules' camera objects in them."""
        rings, poses, fields = system.rings(), system.poses(), system.fields()
        for ring in range(int(rings.max()) + 1):
            collection = self._keep(bpy.data.collections.new(ids.ring_name(ring)), ids.ring_name(ring))
            collection.mphdrr_scanner.is_ring = True
            self.rings.append(collection)
        for number, ring, pose, matrix, field in zip(
            system.numbers.tolist(), rings.tolist(), poses, cameras.camera_matrices(poses), fields.tolist(), strict=True
        ):
            name = ids.module_name(number, len(system), system.word)
            data = self._keep(bpy.data.cameras.new(name), name)
            cameras.set_up_camera(data, tuple(field), float(np.linalg.norm(pose[:3, 3])))
            camera = self._keep(bpy.data.objects.new(name, data), name)
            self.cameras[number] = camera
            objects.set_world_matrix(camera, matrix)
            camera.lock_scale = (True, True, True)  # scaling it would scale its collimator
            self.rings[ring].objects.link(camera)
        module_values.write_modules(list(self.cameras.values()), system)

    def _make_parts(self, system: Scanner, parts: Sequence[ModulePart]) -> None:
        """Make the modules' collimators and crystals."""
        for part in parts:
            name = ids.part_name(ids.module_name(part.number, len(system), system.word), part.kind)
            child = self._keep(new_part(self.cameras[part.number], name, part), name)
            self._keep(child.data, name)
            self.rings[child.parent.mphdrr_module.ring].objects.link(child)

    def _make_roi(self, system: Scanner) -> bpy.types.Object | None:
        """Make the ROI sphere of a system that has one."""
        if (roi := pinholes.new_roi(system, self._materials["ROI"])) is not None:
            self._keep(roi.data, "ROI")
            self._keep(roi, "ROI")
        return roi

    def _keep(self, datablock: Any, name: str) -> Any:
        """Note a datablock's name and return the datablock."""
        self._named.append((datablock, name))
        return datablock

    def name_and_link(self, collection: bpy.types.Collection) -> None:
        """Link all objects to the scanner's collection and give them their names, once the old scanner's names are free."""
        for datablock, name in self._named:
            if datablock.name != name:
                datablock.name = name
        for ring in self.rings:
            collection.children.link(ring)
        if self.roi is not None:
            collection.objects.link(self.roi)


def new_part(camera: bpy.types.Object, name: str, part: ModulePart) -> bpy.types.Object:
    """Return a new part of a module, parented to its camera, with a mesh of its own, so that it can be reshaped."""
    kind = part.kind.upper()
    item = bpy.data.objects.new(name, collimators.new_mesh(name, part.solid, collimators.part_material(kind)))
    item.parent = camera
    item.lock_scale = (True, True, True)  # but it can be moved, together with its module (`grabbing.py`)
    item.mphdrr_module.part, item.mphdrr_module.number = kind, camera.mphdrr_module.number
    return item


def losses(collection: bpy.types.Collection) -> list[str]:
    """Return the changes that replacing the scanner would undo, a phrase each; empty if it is as it was imported."""
    parts, user_objects = parts_and_others(collection)
    cameras_ = [o for o in parts if o.mphdrr_module.is_module]
    added = [o.mphdrr_module.added for o in cameras_]
    moved, edited = module_values.changed_modules(cameras_)
    is_animated = [o.animation_data is not None or len(o.constraints) > 0 for o in cameras_]
    result = []
    for description, flags in (
        ("moved or turned", [is_moved and not is_new for is_moved, is_new in zip(moved, added, strict=True)]),
        ("with changed numbers", [is_edited and not is_new for is_edited, is_new in zip(edited, added, strict=True)]),
        ("added", added),
        ("with animation or constraints", is_animated),
    ):
        numbers = [o.mphdrr_module.number for o, is_lost in zip(cameras_, flags, strict=True) if is_lost]
        if numbers:
            result.append(f"{modules_text(numbers)} {description}")
    n_missing = collection.mphdrr_scanner.n_modules - sum(not o.mphdrr_module.added for o in cameras_)
    if n_missing > 0:
        result.append(f"{ids.counted(n_missing, 'module')} deleted or moved out")
    if collection.mphdrr_scanner.design and not collection.mphdrr_scanner.workbook:
        result.append("a design that no workbook has")
    names = [o.name for o in user_objects] + [c.name for c in _user_collections(collection)]
    if names:
        result.append(f"yours, which will move to the scene's collection: {several(names, 6)}")
    return result


def clear(scene: bpy.types.Scene, collection: bpy.types.Collection, replacements: dict[int, bpy.types.Object]) -> None:
    """Remove the scanner's objects and rings; `replacements` are the new cameras by module number.

    The user's objects move out of the scanner, and references to an old camera become references to the new one.
    """
    parts, user_objects = parts_and_others(collection)
    owners = [collection, *_rings(collection)]
    for user_collection in _user_collections(collection):
        for owner in owners:
            if user_collection.name in owner.children:
                owner.children.unlink(user_collection)
        if user_collection not in set(scene.collection.children_recursive):
            scene.collection.children.link(user_collection)
    for item in user_objects:
        for owner in owners:
            if item.name in owner.objects:
                owner.objects.unlink(item)
        if not item.users_collection:
            scene.collection.objects.link(item)

    scanner_objects = set(parts)
    replacement_of = {o: replacements.get(o.mphdrr_module.number) for o in parts if o.mphdrr_module.is_module}
    for item in bpy.data.objects:
        if item.parent in scanner_objects and item not in scanner_objects and replacement_of.get(item.parent) is None:
            objects.unparent(item)

    datablocks = {o.data for o in parts}
    bpy.data.batch_remove([o for o in parts if o not in replacement_of])
    rings = set(owners[1:])
    for camera, users in bpy.data.user_map(subset=set(replacement_of)).items():
        if (new := replacement_of[camera]) is not None:
            cameras.copy_backgrounds(new.data, camera.data)
            if users - rings:
                camera.user_remap(new)
    bpy.data.batch_remove([*replacement_of, *rings])
    objects.remove_unused(datablocks)


def parts_and_others(collection: bpy.types.Collection) -> tuple[list[bpy.types.Object], list[bpy.types.Object]]:
    """Return the scanner's own objects, and the user's: other objects, and copies of the scanner's."""
    parts, user_objects = [], []
    keys: set[tuple[str, int]] = set()
    for item in sorted(collection.all_objects, key=lambda o: o.name):  # "Module 07" before its copy "Module 07.001"
        module = item.mphdrr_module
        key = (module.part, module.number)
        if module.part == "NONE" or key in keys:
            user_objects.append(item)
        else:
            keys.add(key)
            parts.append(item)
    return parts, user_objects


def _rings(collection: bpy.types.Collection) -> list[bpy.types.Collection]:
    """Return the collections of a scanner's rings."""
    return [c for c in collection.children if c.mphdrr_scanner.is_ring]


def _user_collections(collection: bpy.types.Collection) -> list[bpy.types.Collection]:
    """Return the user's collections directly inside the scanner or one of its rings."""
    return [c for owner in (collection, *_rings(collection)) for c in owner.children if not c.mphdrr_scanner.is_ring]


def modules_text(numbers: Sequence[int]) -> str:
    """Return "module 7", or "modules 7, 12"."""
    return f"module{'s' * (len(numbers) > 1)} {several(numbers, 6)}"
