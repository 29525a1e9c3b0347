"""The datablocks of a scanner: made outside the scene, so that a failure leaves nothing behind, and replaced there."""

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
    """The datablocks of a scanner that is not in the scene yet: `cameras` by module number, `rings`, a `roi` if any."""

    def __init__(self, system: Scanner, parts: Sequence[ModulePart]) -> None:
        self.cameras: dict[int, bpy.types.Object] = {}
        self.rings: list[bpy.types.Collection] = []
        self._named: list[tuple[bpy.types.ID, str]] = []  # names are free only after the old scanner has gone
        self._materials = {
            kind: collimators.part_material(kind) for kind in ("ROI", *(part.kind.upper() for part in parts))
        }
        try:
            self._make_cameras(system)
            self._make_parts(system, parts)
            self.roi = self._make_roi(system)
        except BaseException:
            bpy.data.batch_remove([datablock for datablock, _ in self._named])
            objects.remove_unused(self._materials.values())
            raise

    def _make_cameras(self, system: Scanner) -> None:
        rings, poses, fields = system.rings(), system.poses(), system.fields()
        for ring in range(int(rings.max()) + 1):
            collection = self._keep(bpy.data.collections.new(ids.ring_name(ring)), ids.ring_name(ring))
            collection.mphdrr_scanner.is_ring = True
            self.rings.append(collection)
        for number, ring, pose, matrix, field in zip(
            system.numbers.tolist(), rings.tolist(), poses, cameras.matrices_of(poses), fields.tolist(), strict=True
        ):
            name = ids.module_name(number, len(system), system.word)
            data = self._keep(bpy.data.cameras.new(name), name)
            cameras.set_up_camera(data, tuple(field), float(np.linalg.norm(pose[:3, 3])))
            camera = self._keep(bpy.data.objects.new(name, data), name)
            self.cameras[number] = camera
            objects.set_world_matrix(camera, matrix)
            camera.lock_scale = (True, True, True)  # or its collimator would grow with it
            self.rings[ring].objects.link(camera)
        module_values.write_modules(list(self.cameras.values()), system)

    def _make_parts(self, system: Scanner, parts: Sequence[ModulePart]) -> None:
        for part in parts:
            name = ids.part_name(ids.module_name(part.number, len(system), system.word), part.kind)
            child = self._keep(new_part(self.cameras[part.number], name, part), name)
            self._keep(child.data, name)
            self.rings[child.parent.mphdrr_module.ring].objects.link(child)

    def _make_roi(self, system: Scanner) -> bpy.types.Object | None:
        roi = pinholes.new_roi(system, self._materials["ROI"])
        if roi is not None:
            self._keep(roi.data, "ROI")
            self._keep(roi, "ROI")
        return roi

    def _keep(self, datablock: Any, name: str) -> Any:
        self._named.append((datablock, name))
        return datablock

    def name_and_link(self, collection: bpy.types.Collection) -> None:
        """Put everything into the scanner's collection, once the old scanner's names are free."""
        for datablock, name in self._named:
            if datablock.name != name:
                datablock.name = name
        for ring in self.rings:
            collection.children.link(ring)
        if self.roi is not None:
            collection.objects.link(self.roi)


def new_part(camera: bpy.types.Object, name: str, built: ModulePart) -> bpy.types.Object:
    """A part of a module, parented to its camera. Its mesh is its own, so that it can be reshaped."""
    part = built.kind.upper()
    item = bpy.data.objects.new(name, collimators.new_mesh(name, built.solid, collimators.part_material(part)))
    item.parent = camera
    item.lock_scale = (True, True, True)  # moving it moves the module (`grabbing.py`)
    item.mphdrr_module.part, item.mphdrr_module.number = part, camera.mphdrr_module.number
    return item


def losses(collection: bpy.types.Collection) -> list[str]:
    """The changes that replacing the scanner would undo, a phrase each; empty if it is as it was imported."""
    parts, others = parts_and_others(collection)
    found = [o for o in parts if o.mphdrr_module.is_module]
    added = [o.mphdrr_module.added for o in found]
    moved, edited = module_values.changes(found)
    by_others = [o.animation_data is not None or len(o.constraints) > 0 for o in found]
    lost = []
    for what, flags in (
        ("moved or turned", [is_moved and not is_new for is_moved, is_new in zip(moved, added, strict=True)]),
        ("with changed numbers", [is_edited and not is_new for is_edited, is_new in zip(edited, added, strict=True)]),
        ("added", added),
        ("with animation or constraints", by_others),
    ):
        numbers = [o.mphdrr_module.number for o, is_lost in zip(found, flags, strict=True) if is_lost]
        if numbers:
            lost.append(f"{modules_text(numbers)} {what}")
    gone = collection.mphdrr_scanner.n_modules - sum(not o.mphdrr_module.added for o in found)
    if gone > 0:
        lost.append(f"{gone} module{'s' * (gone > 1)} deleted or moved out")
    if collection.mphdrr_scanner.design and not collection.mphdrr_scanner.workbook:
        lost.append("a design that no workbook has")
    names = [o.name for o in others] + [c.name for c in _own_collections(collection)]
    if names:
        lost.append(f"yours, which will move to the scene's collection: {several(names, 6)}")
    return lost


def clear(scene: bpy.types.Scene, collection: bpy.types.Collection, replacements: dict[int, bpy.types.Object]) -> None:
    """Remove the scanner's objects and rings; `replacements` are the new cameras by module number.

    The user's objects move out of the scanner, and whatever referred to an old camera refers to the new one.
    """
    parts, others = parts_and_others(collection)
    homes = [collection, *_rings(collection)]
    for own in _own_collections(collection):
        for home in homes:
            if own.name in home.children:
                home.children.unlink(own)
        if own not in set(scene.collection.children_recursive):
            scene.collection.children.link(own)
    for item in others:
        for home in homes:
            if item.name in home.objects:
                home.objects.unlink(item)
        if not item.users_collection:
            scene.collection.objects.link(item)

    ours = set(parts)
    new_of = {o: replacements.get(o.mphdrr_module.number) for o in parts if o.mphdrr_module.is_module}
    for item in bpy.data.objects:
        if item.parent in ours and item not in ours and new_of.get(item.parent) is None:
            objects.unparent(item)

    datas = {o.data for o in parts}
    bpy.data.batch_remove([o for o in parts if o not in new_of])
    rings = set(homes[1:])
    for camera, users in bpy.data.user_map(subset=set(new_of)).items():
        new = new_of[camera]
        if new is not None:
            cameras.take_backgrounds(new.data, camera.data)
            if users - rings:
                camera.user_remap(new)
    bpy.data.batch_remove([*new_of, *rings])
    objects.remove_unused(datas)


def parts_and_others(collection: bpy.types.Collection) -> tuple[list[bpy.types.Object], list[bpy.types.Object]]:
    """The scanner's own objects, and the user's: other objects, and copies of the scanner's."""
    parts, others = [], []
    seen: set[tuple[str, int]] = set()
    for item in sorted(collection.all_objects, key=lambda o: o.name):  # "Module 07" before its copy "Module 07.001"
        module = item.mphdrr_module
        key = (module.part, module.number)
        if module.part == "NONE" or key in seen:
            others.append(item)
        else:
            seen.add(key)
            parts.append(item)
    return parts, others


def _rings(collection: bpy.types.Collection) -> list[bpy.types.Collection]:
    return [c for c in collection.children if c.mphdrr_scanner.is_ring]


def _own_collections(collection: bpy.types.Collection) -> list[bpy.types.Collection]:
    """The user's collections directly inside the scanner or one of its rings."""
    return [c for home in (collection, *_rings(collection)) for c in home.children if not c.mphdrr_scanner.is_ring]


def modules_text(numbers: Sequence[int]) -> str:
    """ "module 7", or "modules 7, 12"."""
    return f"module{'s' * (len(numbers) > 1)} {several(numbers, 6)}"
