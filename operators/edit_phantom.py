"""Operators on a phantom in the scene: make its voxels again, apply its pose, show its outline."""

import bpy

from ..addon.blender import jobs, reports
from ..addon.phantoms import phantoms


class _EditPhantom(jobs.JobOperator):
    """Base class of operators that make the active phantom's voxels again."""

    bake = False  # whether the pose becomes part of the voxels

    poll = reports.needs(phantoms.ACTIVE)

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return phantoms.update_phantom_job(context.object, self.bake)


class MPHDRR_OT_update_phantom(_EditPhantom, bpy.types.Operator):
    """Make the active phantom's voxels again from its settings; its place stays."""


class MPHDRR_OT_apply_phantom_pose(_EditPhantom, bpy.types.Operator):
    """Make the active phantom's voxels again on a grid along the world's axes; its settings are given up."""

    bl_label = "Apply Pose"

    bake = True


class MPHDRR_OT_show_phantom_outline(reports.Reported, bpy.types.Operator):
    """Show or hide the surfaces of the active phantom's shapes as wires that go with it."""

    bl_label = "Outline"

    poll = reports.needs(phantoms.ACTIVE)

    def act(self, context: bpy.types.Context) -> str:
        return phantoms.toggle_outline(context.object)
