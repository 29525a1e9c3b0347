"""Event sets: a recipe written and tried on the phantom in the scene, a set made as a job, an event opened in the scene."""

import bpy
from bpy.props import EnumProperty
from bpy_extras.io_utils import ExportHelper

from ..addon.blender import choices, jobs
from ..addon.blender.file_properties import shown_files
from ..addon.blender.reports import Reported
from ..addon.events import event_sets
from ..addon.events.event_properties import COUNT, FOLDER, MODEL, NEXT, OPENED, RECIPE
from ..core.events.templates import TEMPLATES


class MPHDRR_OT_new_event_recipe(Reported, ExportHelper, bpy.types.Operator):
    """Write a recipe for events with comments in it, to be edited and tried. Its scanner is the scene's workbook, or the
    example's where there is none
    """

    filename_ext = ".toml"
    filter_glob: shown_files((".toml",))
    like: EnumProperty(
        name="Like", description="What the recipe begins with",
        items=choices.items({}, ((name, name.capitalize(), text) for name, text in TEMPLATES.items())),
    )  # fmt: skip

    def act(self, context: bpy.types.Context) -> str:
        return event_sets.write_recipe(context.scene, self.filepath, self.like)


class MPHDRR_OT_try_event(jobs.JobOperator, bpy.types.Operator):
    """Put the recipe's next event on the phantom in the scene: its kind, settings and pose. Makes a phantom where there is
    none. The number goes up by one; the same number always is the same phantom
    """

    bl_label = "Another Phantom of the Recipe"

    recipe: RECIPE
    number: NEXT
    folder: FOLDER

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return event_sets.trying(context, *self.given(context.scene.mphdrr_events, "recipe", "number", "folder"))


class MPHDRR_OT_make_event_set(jobs.JobOperator, bpy.types.Operator):
    """Make the events of the recipe in a folder, those that it does not have yet. Cancelled, it keeps what is made, and goes
    on from there the next time
    """

    recipe: RECIPE
    folder: FOLDER
    count: COUNT

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return event_sets.making(*self.given(context.scene.mphdrr_events, "recipe", "folder", "count"))


class MPHDRR_OT_open_event(jobs.JobOperator, bpy.types.Operator):
    """Open an event of a set in the scene, in place of the one opened before: its truth as a volume, its phantom at its pose
    with its settings, hidden, and its projections as a run
    """

    folder: FOLDER
    opened: OPENED
    model: MODEL

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return event_sets.opening(context, *self.given(context.scene.mphdrr_events, "folder", "opened", "model"))
