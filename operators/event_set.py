"""Operators on event sets: write a recipe, try it on the phantom in the scene, make a set, open an event in the scene."""

import bpy
from bpy.props import EnumProperty
from bpy_extras.io_utils import ExportHelper

from ..addon.blender import choices, file_properties, jobs, reports
from ..addon.events import event_properties, event_sets
from ..core.events.templates import TEMPLATES


class MPHDRR_OT_new_event_recipe(reports.Reported, ExportHelper, bpy.types.Operator):
    """Write a recipe for events with comments in it, to be edited and tried. Its scanner is the scene's workbook, or the
    example if there is none.
    """

    filename_ext = ".toml"
    filter_glob: file_properties.shown_files((".toml",))
    like: EnumProperty(
        name="Like", description="Template of the recipe",
        items=choices.items({}, ((name, name.capitalize(), text) for name, text in TEMPLATES.items())),
    )  # fmt: skip

    def act(self, context: bpy.types.Context) -> str:
        return event_sets.write_recipe(context.scene, self.filepath, self.like)


class MPHDRR_OT_try_event(jobs.JobOperator, bpy.types.Operator):
    """Put the recipe's next event on the phantom in the scene: its kind, settings and pose. Makes a phantom if there is
    none. The number goes up by one; the same number is always the same phantom.
    """

    bl_label = "Another Phantom of the Recipe"

    recipe: event_properties.RECIPE
    number: event_properties.NEXT
    folder: event_properties.FOLDER

    def job(self, context: bpy.types.Context) -> jobs.Job:
        values = self.setting_values(context.scene.mphdrr_events, "recipe", "number", "folder")
        return event_sets.try_event_job(context, *values)


class MPHDRR_OT_make_event_set(jobs.JobOperator, bpy.types.Operator):
    """Make the recipe's events that a folder does not have yet. If it is cancelled, the finished events stay, and the next
    run continues from there.
    """

    recipe: event_properties.RECIPE
    folder: event_properties.FOLDER
    count: event_properties.COUNT

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return event_sets.make_set_job(*self.setting_values(context.scene.mphdrr_events, "recipe", "folder", "count"))


class MPHDRR_OT_open_event(jobs.JobOperator, bpy.types.Operator):
    """Open an event of a set in the scene, in place of the one opened before: its truth as a volume, its phantom with its
    pose and settings, hidden, and its projections as a run.
    """

    folder: event_properties.FOLDER
    opened: event_properties.OPENED
    model: event_properties.MODEL

    def job(self, context: bpy.types.Context) -> jobs.Job:
        values = self.setting_values(context.scene.mphdrr_events, "folder", "opened", "model")
        return event_sets.open_event_job(context, *values)
