"""Operators that make a volume of closed mesh objects, and a mesh of a volume."""

import bpy
from bpy.props import EnumProperty, FloatProperty, IntProperty, StringProperty

from ..addon.blender import choices, jobs, reports
from ..addon.blender.decimals import typed
from ..addon.volumes import meshes, volumes


class MPHDRR_OT_voxelize_objects(jobs.JobOperator, bpy.types.Operator):
    """Make a volume of the selected closed meshes, modifiers included: a voxel gets the value times the share that they
    cover. An object's custom property 'activity' or 'mu' replaces the value; later names cover earlier ones.
    """

    bl_label = "Voxelize Meshes"
    dialog = {"confirm_text": "Voxelize", "width": 320}

    quantity: EnumProperty(
        name="Quantity",
        description="Quantity of the volume",
        items=choices.items(choices.QUANTITIES, (("activity", "Activity", "kBq/mL"), ("mu", "Attenuation", "1/mm"))),
    )
    value: FloatProperty(name="Value", description="Inside, in kBq/mL or 1/mm", default=100.0, min=0.0, precision=4)
    voxels: IntProperty(
        name="Voxels", description="Voxels along the longest side", default=128, min=2, soft_max=512, max=4096
    )
    voxel_size: FloatProperty(
        name="Voxel Size (mm)", description="0 takes it from the number of voxels", min=0.0, soft_max=10.0, precision=3
    )
    name: StringProperty(name="Name", description="The volume's name; empty: the mesh's")

    poll = reports.needs((lambda context: _chosen(context), "Select closed mesh objects first"))

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return meshes.voxelize_job(
            _chosen(context), typed(self.value), self.quantity, self.voxels, typed(self.voxel_size), self.name
        )


class MPHDRR_OT_mesh_from_volume(jobs.JobOperator, bpy.types.Operator):
    """Make a closed mesh of the active volume's surface of one value, for display and print."""

    dialog = {"confirm_text": "Make"}

    level: FloatProperty(
        name="Level",
        description="The surface's value, in the unit that the panel shows; 0: halfway from outside to the largest",
    )

    poll = reports.needs(volumes.ACTIVE)

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return meshes.mesh_job(context.object, typed(self.level) or None)


def _chosen(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the selected mesh objects and instanced collections, except the scanner's parts, sorted by name."""
    items = [item for item in context.selected_objects if item.type == "MESH" or item.instance_collection]
    return sorted((item for item in items if item.mphdrr_module.part == "NONE"), key=lambda item: item.name)
