"""Operators that project a volume into the scanner's modules, as a job, load settings, and show or export the run."""

import math
from pathlib import Path
from typing import Any

import bpy
from bpy.props import EnumProperty, FloatProperty, StringProperty
from bpy_extras.io_utils import ImportHelper

from ..addon.blender import choices, decimals, file_properties, ids, jobs, reports, storage
from ..addon.pictures import images
from ..addon.runs import projection_properties, rendering, runs
from ..addon.scanner import scanner
from ..core.errors import InputError
from ..core.runs import EXPORT_FORMATS, FORMATS
from ..core.runs.presets import PRESETS


class MPHDRR_OT_render_projections(projection_properties.ProjectionSettings, jobs.JobOperator, bpy.types.Operator):
    """Project the volume into every module: exact line integrals or SPECT counts, stored as images and as a file beside
    the .blend. The settings are the panel's, unless a script gives others.
    """

    volume: StringProperty(name="Volume", description="Name of the volume object to project", options={"SKIP_SAVE"})
    mu: StringProperty(
        name="Attenuation", description="Name of the volume object of attenuation coefficients", options={"SKIP_SAVE"}
    )
    opening_angle: FloatProperty(
        name="Opening Angle", description="Full angle of the knife edge's cone, instead of the scanner's",
        subtype="ANGLE", default=math.pi / 2, min=0.01, max=3.1, options={"SKIP_SAVE"},
    )  # fmt: skip

    def job(self, context: bpy.types.Context) -> jobs.Job:
        collection = scanner.required_scanner(context.scene)
        has_angle = self.properties.is_property_set("opening_angle")
        angle = self.opening_angle if has_angle else collection.mphdrr_scanner.opening_angle
        recipe = projection_properties.settings_recipe(
            lambda name: self._setting(context.scene, name),
            self.properties.is_property_set,
            {projection_properties.OPENING_ANGLE: math.degrees(decimals.typed(angle))},
            collection,
        )
        return rendering.render_job(context, recipe, self.volume, self.mu)

    def _setting(self, scene: bpy.types.Scene, name: str) -> Any:
        """Return a setting of the operator if a script gives it, else the panel's.

        A given attenuation coefficient replaces the panel's material.
        """
        coefficient = name.replace("_material", "_mu")
        if not self.properties.is_property_set(name) and self.properties.is_property_set(coefficient):
            return "NUMBER"
        return self.setting_getter(scene.mphdrr_projections)(name)


class MPHDRR_OT_use_preset(reports.Reported, bpy.types.Operator):
    """Count photons, with isotope, aperture and crystal chosen together; time, noise, attenuation and the detector's
    intrinsic blur stay as they are.
    """

    bl_label = "Physics Preset"

    preset: EnumProperty(
        name="Preset",
        description="Isotope with aperture and crystal",
        items=choices.items({}, ((preset.name, preset.label, preset.text) for preset in PRESETS.values())),
    )

    def act(self, context: bpy.types.Context) -> None:
        projection_properties.use_preset(context.scene.mphdrr_projections, self.preset)


class MPHDRR_OT_load_recipe(reports.Reported, ImportHelper, bpy.types.Operator):
    """Set the panel to the settings of a recipe (.toml) or a run (.h5, .npz, .pt): model, detector, noise, modules and, if
    the scene has objects of their names, volumes. By default the recipe of the last run.
    """

    filter_glob: file_properties.shown_files((".toml", *FORMATS))

    def act(self, context: bpy.types.Context) -> str:
        filepath = self.filepath or context.scene.mphdrr_projections.run_file
        if not filepath:
            raise InputError("no file given: set filepath to a recipe (.toml) or a run (.h5, .npz, .pt)")
        rendering.load_recipe(context.scene, Path(storage.absolute(filepath)))
        return f"Set the panel as {bpy.path.basename(filepath)} says"


class ShowPicture(reports.Reported):
    """Base class of the operators that show a picture in an Image Editor."""

    bl_options = set()
    picture = ids.MOSAIC  # name of Blender's image

    def act(self, context: bpy.types.Context) -> None:
        if not images.show_below(bpy.data.images[self.picture], context):
            raise InputError("no window with a 3D view to open an Image Editor in")


class MPHDRR_OT_show_projections(ShowPicture, bpy.types.Operator):
    """Show the mosaic of the last run in an Image Editor, opened below the 3D view if there is none."""

    poll = reports.needs(images.PROJECTED)


class MPHDRR_OT_export_dataset(jobs.ExportJob, bpy.types.Operator):
    """Write the shown run, with geometry, volume and provenance, as .h5, .npz or .pt (PyTorch), or its counts as DICOM."""

    bl_label = "Export mphDRR Dataset"

    endings = EXPORT_FORMATS
    filter_glob: file_properties.shown_files(EXPORT_FORMATS)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the changes of the scene since the run, beside the file browser."""
        for line in runs.change_lines(context.scene):
            self.layout.label(text=line, icon="ERROR")

    def job(self, context: bpy.types.Context) -> jobs.Job:
        path = self.required_file("set filepath to a name ending in .h5, .npz, .pt or .dcm")
        return rendering.export_job(context.scene, path)
