"""Operators that reconstruct or back-project the shown run, as jobs, and that show slices of the last reconstruction."""

import bpy

from ..addon.blender import ids, jobs
from ..addon.blender.reports import Need, needs
from ..addon.reconstruction import backprojections, reconstruction_properties, reconstructions
from ..addon.runs import runs
from .render_projections import ShowPicture

_DONE: Need = (lambda _: ids.RECONSTRUCTION in bpy.data.images, "No reconstruction yet: reconstruct a run first")
_NOTHING = "Nothing to continue: the method has no iterations, or the file of the last one is not beside its voxels"
_RUN: Need = (lambda context: runs.shown_run(context.scene) is not None, "No run yet: render the projections first")


class MPHDRR_OT_reconstruct(reconstruction_properties.ReconstructionSettings, jobs.JobOperator, bpy.types.Operator):
    """Reconstruct the volume of the shown run's projections. It is in the scene from its first iterations on, the truth is
    hidden; Cancel asks whether to keep what there is. The settings are the panel's, unless a script gives others.
    """

    bl_label = "Reconstruct Projections"

    poll = needs(_RUN)

    def ask(self, context: bpy.types.Context) -> set[str] | None:
        """Choose a method that suits the run when the button is pressed; ask nothing."""
        if (are_counts := runs.holds_counts(context.scene)) is not None:
            reconstruction_properties.fit_method(context.scene.mphdrr_reconstruction, are_counts)
        return super().ask(context)

    def job(self, context: bpy.types.Context) -> jobs.Job:
        get = self.setting_getter(context.scene.mphdrr_reconstruction)
        recipe = reconstruction_properties.settings_recipe(get, self.properties.is_property_set)
        return reconstructions.reconstruct_job(context, recipe)


class MPHDRR_OT_continue_reconstruction(jobs.JobOperator, bpy.types.Operator):
    """Do ten more iterations of the last reconstruction, of the same run with the same settings, in the same volume."""

    poll = needs(_DONE, (reconstructions.resume_path, _NOTHING))

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return reconstructions.continue_job(context)


class MPHDRR_OT_backproject(reconstruction_properties.BackprojectionSettings, jobs.JobOperator, bpy.types.Operator):
    """Combine the shown run's projections along their rays in each voxel of a volume. It is no reconstruction: a value is
    that of whole rays, not of the voxel. Voxels are those of a reconstruction, with the panel's settings, unless a script
    gives others.
    """

    bl_label = "Back-Project Projections"

    poll = needs(_RUN)

    def job(self, context: bpy.types.Context) -> jobs.Job:
        get = self.setting_getter(context.scene.mphdrr_reconstruction)
        recipe = reconstruction_properties.voxels_recipe(get)
        return backprojections.backproject_job(context, recipe, get("how").lower())


class MPHDRR_OT_show_reconstruction(ShowPicture, bpy.types.Operator):
    """Show slices of the last reconstruction, beside the truth, in an Image Editor, opened below the 3D view if there is
    none.
    """

    bl_label = "Show Slices of Reconstructed Volume"

    picture = ids.RECONSTRUCTION
    poll = needs(_DONE)
