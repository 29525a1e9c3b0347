"""Reconstruct the shown run, as a job; show what came of the last one."""

from typing import Any

import bpy

from ..addon import ids, images, jobs, reconstructions, runs
from ..addon.reconstruction_properties import ReconstructionSettings, settings_recipe
from ..addon.reports import polled


class MPHDRR_OT_reconstruct(ReconstructionSettings, jobs.JobOperator, bpy.types.Operator):
    """Find the volume that the shown run's projections are of. It is in the scene from its first iterations on; Cancel takes
    it away again, Finish Now keeps what there is. The settings are what the panel says now, unless a script gives others
    """

    bl_idname = ids.RECONSTRUCT
    bl_label = "Reconstruct Projections"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        is_met = runs.shown(context.scene) is not None
        return polled(cls, is_met, "No run yet: render the projections first")  # type: ignore[arg-type]

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return reconstructions.reconstructing(
            context, settings_recipe(lambda name: self._setting(context.scene, name), self.properties.is_property_set)
        )

    def _setting(self, scene: bpy.types.Scene, name: str) -> Any:
        """A setting given to the operator, else the panel's."""
        return getattr(self if self.properties.is_property_set(name) else scene.mphdrr_reconstruction, name)


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
