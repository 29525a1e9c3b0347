"""The datablocks of a scanner, made outside the scene so that a failure leaves nothing behind."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bpy

from ..core.geometry.module_parts import ModulePart
from ..core.geometry.system import PinholeSystem
from . import cameras, collimators, ids
from .module_values import write_module


class NewScanner:
    """The datablocks of a scanner that is not in the scene yet: `cameras` by module number, `rings` and the `roi` sphere.

    `parts` are the modules' collimators and crystals, as of `module_parts`.
    """

    def __init__(self, system: PinholeSystem, parts: Sequence[ModulePart]) -> None:
        self.cameras: dict[int, bpy.types.Object] = {}
        self.rings: list[bpy.types.Collection] = []
        self._named: list[tuple[bpy.types.ID, str]] = []  # names are free only after the old scanner has gone
        self._materials = {part: collimators.part_material(part) for part in collimators.LOOKS}
        try:
            self._make_cameras(system)
            self._make_parts(system, parts)
            self.roi = self._make_roi(float(system.roi_radius.max()))
        except BaseException:
            bpy.data.batch_remove([datablock for datablock, _ in self._named])
            bpy.data.batch_remove([m for m in self._materials.values() if m.users == 0])
            raise

    def _make_cameras(self, system: PinholeSystem) -> None:
        rings = system.rings()
        for ring in range(int(rings.max()) + 1):
            collection = self._keep(bpy.data.collections.new(ids.ring_name(ring)), ids.ring_name(ring))
            collection.mphdrr_scanner.is_ring = True
            self.rings.append(collection)
        matrices = cameras.camera_matrices(system.centers)
        for m, number in enumerate(system.numbers.tolist()):
            name = ids.module_name(number, len(system))
            data = self._keep(bpy.data.cameras.new(name), name)
            cameras.set_up_camera(data, system, m)
            camera = self._keep(bpy.data.objects.new(name, data), name)
            self.cameras[number] = camera
            cameras.set_world_matrix(camera, matrices[m])
            camera.lock_scale = (True, True, True)  # or its collimator would grow with it
            write_module(camera, system, m, int(rings[m]))
            self.rings[rings[m]].objects.link(camera)

    def _make_parts(self, system: PinholeSystem, parts: Sequence[ModulePart]) -> None:
        for part in parts:
            camera, kind = self.cameras[part.number], part.kind.upper()
            name = ids.part_name(ids.module_name(part.number, len(system)), kind)
            mesh = self._keep(collimators.new_mesh(name, part.solid, self._materials[kind]), name)
            child = self._keep(new_part(camera, kind, name, mesh), name)
            self.rings[camera.mphdrr_module.ring].objects.link(child)

    def _make_roi(self, radius: float) -> bpy.types.Object:
        mesh = self._keep(collimators.new_sphere("ROI", radius, self._materials["ROI"]), "ROI")
        roi = self._keep(bpy.data.objects.new("ROI", mesh), "ROI")
        roi.mphdrr_module.part = "ROI"
        roi.hide_select = True
        # Circles: the solid viewport draws no volume behind or inside a transparent surface. Renders show the sphere.
        roi.display_type, roi.display_bounds_type = "BOUNDS", "SPHERE"
        roi.lock_location = roi.lock_rotation = roi.lock_scale = (True, True, True)
        roi.visible_shadow = False
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
        collection.objects.link(self.roi)


def new_part(camera: bpy.types.Object, part: str, name: str, mesh: bpy.types.Mesh) -> bpy.types.Object:
    """A module's collimator or crystal, parented to its camera. Its mesh is its own, so that it can be reshaped."""
    item = bpy.data.objects.new(name, mesh)
    item.parent = camera
    item.lock_location = item.lock_rotation = item.lock_scale = (True, True, True)
    item.mphdrr_module.part, item.mphdrr_module.number = part, camera.mphdrr_module.number
    return item
