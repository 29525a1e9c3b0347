"""A map of what the scanner does in every voxel, as a volume in the scene."""

from __future__ import annotations

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty

from ..addon import ids, jobs, maps, selection
from ..addon.decimals import typed


class MPHDRR_OT_add_map(jobs.JobOperator, bpy.types.Operator):
    """``bpy.ops.mphdrr.add_map(quantity="sensitivity")``."""

    bl_idname = ids.ADD_MAP
    bl_label = "Add Map"
    bl_description = (
        "Calculate what the scanner, with ideal modules, does in every voxel around the isocentre, and show it as a "
        "volume, in place of the last map of this quantity"
    )
    bl_options = {"REGISTER", "UNDO"}

    quantity: EnumProperty(name="Quantity", description="What is mapped", items=maps.QUANTITIES)
    voxels: IntProperty(name="Voxels", description="Along each side", default=64, min=2, soft_max=256, max=1024)
    side: FloatProperty(
        name="Side (mm)", description="Of the map's cube; 0 takes the diameter of the ROI", min=0.0, soft_max=500.0
    )
    within_roi: BoolProperty(name="Within ROI", description="Leave out what lies outside the ROI sphere", default=True)

    poll = classmethod(selection.poll_scanner)

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return maps.mapping(context.scene, self.quantity, self.voxels, typed(self.side), self.within_roi)
