"""Reconstruct or back-project the shown run, as jobs; show what came of the last reconstruction."""

from typing import Any

import bpy

from ..addon import backprojections, ids, images, jobs, reconstructions, runs
from ..addon.reconstruction_properties import (
    BackprojectionSettings,
    ReconstructionSettings,
    settings_recipe,
    voxels_recipe,
)
from ..addon.reports import polled


def _poll_run(operator: type[bpy.types.Operator], context: bpy.types.Context) -> bool:
    """`poll` of operators that need a run."""
    return polled(operator, runs.shown(context.scene) is not None, "No run yet: render the projections first")


class MPHDRR_OT_reconstruct(ReconstructionSettings, jobs.JobOperator, bpy.types.Operator):
    """Find the volume that the shown run's projections are of. It is in the scene from its first iterations on; Cancel takes
    it away again, Finish Now keeps what there is. The settings are what the panel says now, unless a script gives others
    """

    bl_idname = ids.RECONSTRUCT
    bl_label = "Reconstruct Projections"

    poll = classmethod(_poll_run)

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return reconstructions.reconstructing(
            context, settings_recipe(lambda name: self._setting(context.scene, name), self.properties.is_property_set)
        )

    def _setting(self, scene: bpy.types.Scene, name: str) -> Any:
        """A setting given to the operator, else the panel's."""
        return getattr(self if self.properties.is_property_set(name) else scene.mphdrr_reconstruction, name)


class MPHDRR_OT_backproject(BackprojectionSettings, jobs.JobOperator, bpy.types.Operator):
    """Put together what the shown run's modules say of each voxel along their rays, as a volume. It is no reconstruction: a
    value is that of whole rays, not of the voxel. Voxels are those of a reconstruction, as the panel says now, unless a
    script gives others
    """

    bl_idname = ids.BACKPROJECT
    bl_label = "Back-Project Projections"

    poll = classmethod(_poll_run)

    def job(self, context: bpy.types.Context) -> jobs.Job:
        def get(name: str) -> Any:
            """A setting given to the operator, else the panel's."""
            return getattr(self if self.properties.is_property_set(name) else context.scene.mphdrr_reconstruction, name)

        return backprojections.backprojecting(context, voxels_recipe(get), get("how").lower())


class MPHDRR_OT_show_reconstruction(bpy.types.Operator):
    """Show slices of the last reconstruction, beside the truth, in an Image Editor, opened below the 3D view if there is
    none
    """

    bl_idname = ids.SHOW_RECONSTRUCTION
    bl_label = "Show Slices of Reconstructed Volume"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return polled(cls, ids.RECONSTRUCTION in bpy.data.images, "No reconstruction yet: reconstruct a run first")

    def execute(self, context: bpy.types.Context) -> set[str]:
        if not images.show_below(bpy.data.images[ids.RECONSTRUCTION], context):
            self.report({"ERROR"}, "no window with a 3D view to open an Image Editor in")
            return {"CANCELLED"}
        return {"FINISHED"}
