"""The datablocks of a scanner, made outside the scene so that a failure leaves nothing behind."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ..core.collimator_mesh import Solid, collimator_solid, crystal_solid
from ..core.system import PinholeSystem
from . import cameras, collimators, ids
from .module_values import LENGTHS, write_module


class NewScanner:
    """Datablocks of a scanner that is not in the scene yet: `make`, then `name_and_link` or `discard`."""

    def __init__(self) -> None:
        self.cameras: dict[int, bpy.types.Object] = {}  # by module number
        self.rings: list[bpy.types.Collection] = []
        self.roi: bpy.types.Object | None = None
        self._named: list[tuple[bpy.types.ID, str]] = []  # names are free only after the old scanner has gone
        self._meshes: dict[tuple[str, bytes], bpy.types.Mesh] = {}  # modules of the same size share one
        self._materials = {
            "COLLIMATOR": collimators.collimator_material(),
            "CRYSTAL": collimators.crystal_material(),
            "ROI": collimators.roi_material(),
        }

    def make(self, system: PinholeSystem, solids: Sequence[tuple[Solid, Solid]]) -> None:
        """Make everything; `solids` has each module's collimator and crystal."""
        rings = system.rings()
        for ring in range(int(rings.max()) + 1):
            collection = self._keep(bpy.data.collections.new(ids.ring_name(ring)), ids.ring_name(ring))
            collection.mphdrr_scanner.is_ring = True
            self.rings.append(collection)
        matrices = cameras.camera_matrices(system.centers)
        for m, number in enumerate(np.asarray(system.numbers).tolist()):
            name = ids.module_name(number, len(system))
            data = self._keep(bpy.data.cameras.new(name), name)
            cameras.set_up_camera(data, system, m)
            camera = self._keep(bpy.data.objects.new(name, data), name)
            self.cameras[number] = camera
            camera.matrix_world = Matrix(matrices[m])
            camera.rotation_euler = cameras.euler_angles(matrices[m])
            write_module(camera, system, m, int(rings[m]))
            self.rings[rings[m]].objects.link(camera)
            for part, solid in zip(("COLLIMATOR", "CRYSTAL"), solids[m], strict=True):
                child_name = name.replace("Module", part.capitalize())
                child = self._keep(bpy.data.objects.new(child_name, self._mesh(part, child_name, solid)), child_name)
                child.parent = camera
                child.lock_location = child.lock_rotation = child.lock_scale = (True, True, True)
                child.mphdrr_module.part, child.mphdrr_module.number = part, number
                self.rings[rings[m]].objects.link(child)
        self._make_roi(float(system.roi_radius.max()))

    def _make_roi(self, radius: float) -> None:
        mesh = self._keep(collimators.new_sphere("ROI", radius, self._materials["ROI"]), "ROI")
        self.roi = self._keep(bpy.data.objects.new("ROI", mesh), "ROI")
        self.roi.mphdrr_module.part = "ROI"
        self.roi.hide_select = True
        # Circles: the solid viewport draws no volume behind or inside a transparent surface. Renders show the sphere.
        self.roi.display_type, self.roi.display_bounds_type = "BOUNDS", "SPHERE"
        self.roi.lock_location = self.roi.lock_rotation = self.roi.lock_scale = (True, True, True)
        self.roi.visible_shadow = False

    def _mesh(self, part: str, name: str, solid: Solid) -> bpy.types.Mesh:
        key = (part, np.round(solid[0], 6).tobytes())
        if key not in self._meshes:
            self._meshes[key] = self._keep(collimators.new_mesh(name, solid, self._materials[part]), name)
        return self._meshes[key]

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

    def discard(self) -> None:
        """Remove everything again."""
        bpy.data.batch_remove([datablock for datablock, _ in self._named])
        bpy.data.batch_remove([m for m in self._materials.values() if m.users == 0])


def module_solids(system: PinholeSystem, m: int, plate: float, wall: float) -> tuple[Solid, Solid]:
    """Collimator and crystal of module `m`, for a plate and walls of that thickness in mm."""
    d, length, side, thickness, _ = (float(getattr(system, name)[m]) for name in LENGTHS)
    return collimator_solid(d, length, side, plate, wall), crystal_solid(length, side, thickness)
