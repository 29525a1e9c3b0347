"""A map of what the scanner does in every voxel, as a volume in the scene."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty

from ..addon import choices, ids, jobs, scanner, selection, storage, volume_materials, volumes
from ..addon.decimals import typed
from ..core.geometry.grid import Grid
from ..core.memory import require
from ..core.physics.maps import MAPS, within_roi
from ..core.progress import Progress

_DESCRIPTIONS = {
    "sensitivity": "Counts per decay of all modules together",
    "modules": "Number of modules that see a voxel",
    "resolution": "FWHM in mm that the projections hold, all modules together",
    "completeness": "Of the angular sampling (Tuy): 1 where every plane through the voxel meets a pinhole. Slow",
}
_ITEMS = choices.items(choices.MAPS, ((name, name.capitalize(), _DESCRIPTIONS[name]) for name in MAPS))
_BYTES = 40.0  # a voxel, while the map is made and put into the scene


class MPHDRR_OT_add_map(jobs.JobOperator, bpy.types.Operator):
    """``bpy.ops.mphdrr.add_map(quantity="sensitivity")``."""

    bl_idname = ids.ADD_MAP
    bl_label = "Add Map"
    bl_description = (
        "Calculate what the scanner, with ideal modules, does in every voxel around the isocentre, and show it as a "
        "volume, in place of the last map of this quantity"
    )
    bl_options = {"REGISTER", "UNDO"}

    quantity: EnumProperty(
        name="Quantity",
        description="What is mapped",
        items=_ITEMS,
    )
    voxels: IntProperty(
        name="Voxels", description="Voxels along each side of the map", default=64, min=2, soft_max=256, max=1024
    )
    side: FloatProperty(
        name="Side (mm)", description="Side of the map's cube in mm; 0 takes the diameter of the ROI", default=0.0,
        min=0.0, soft_max=500.0,
    )  # fmt: skip
    within_roi: BoolProperty(name="Within ROI", description="Leave out what lies outside the ROI sphere", default=True)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return selection.poll_scanner(cls, context)

    def job(self, context: bpy.types.Context) -> jobs.Job:
        scene, collection = context.scene, scanner.required_scanner(context.scene)
        system = scanner.read_scanner(collection)
        side = typed(self.side) or 2 * float(system.roi_radius.max())
        grid = Grid.centered((self.voxels,) * 3, side / self.voxels)
        require(_BYTES * grid.n_voxels, f"a map of {self.voxels}^3 voxels")
        quantity, only_roi = self.quantity, self.within_roi
        name, folder = f"{quantity.capitalize()} map", storage.folder()
        recipe: dict[str, Any] = {"map": quantity, "modules": len(system), "scanner": collection.name}

        def work(progress: Progress) -> volumes.StoredVolume:
            volume = MAPS[quantity](system, grid, progress=progress)
            return volumes.store_volume(within_roi(volume, system) if only_roi else volume, folder, provenance=recipe)

        def finish(stored: volumes.StoredVolume) -> Generator[None, None, str]:
            yield
            old = [o for o in volumes.volume_objects(scene) if getattr(o, ids.OBJECT_VOLUME).quantity == quantity]
            if old:
                item = old[0]
                volumes.replace_stored(item, stored)
            else:
                item = volumes.add_stored(stored, name, scene.collection)
                volume_materials.show_in_eevee(scene)
            values, high = stored.volume.array, stored.high
            low = float(values[values > 0].min(initial=high))
            settings = getattr(item, ids.OBJECT_VOLUME)
            settings.display_low, settings.display_high = low if low < high else 0.0, high
            return f"{name}: {low:.4g} to {high:.4g} {stored.volume.unit}".removesuffix(" 1")

        return jobs.Job(f"{name} of {len(system)} modules", work, finish)
