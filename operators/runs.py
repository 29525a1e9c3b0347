"""The scene's runs: show one, remove one, compare two."""

from typing import Any

import bpy
from bpy.props import EnumProperty, IntProperty

from ..addon.blender import file_properties, jobs, storage
from ..addon.blender.reports import Need, Reported, ask_to_remove, needs
from ..addon.pictures import images
from ..addon.runs import rendering, runs
from ..core import InputError, Progress, read_run
from ..core.runs.comparing import difference, difference_sheet
from ..core.runs.flood_files import write_flood

_others: list[tuple[str, str, str]] = []  # Blender keeps no texts of such a list: they must live on here


def _required_run(scene: bpy.types.Scene, index: int) -> bpy.types.PropertyGroup:
    found = scene.mphdrr_projections.runs
    if not 0 <= index < len(found):
        raise InputError(f"index {index}: the scene has {len(found)} runs, counted from 0")
    return found[index]


_LISTED: Need = (lambda context: context.scene.mphdrr_projections.runs, "No runs yet: render the projections first")


class MPHDRR_OT_show_run(jobs.JobOperator, bpy.types.Operator):
    """Show a run of the list: its images, the mosaic and the planes in the scene. Modules and volumes stay as they are"""

    bl_options = {"REGISTER", "UNDO", "INTERNAL"}  # a click in the list

    poll = needs(_LISTED)

    index: IntProperty(name="Index", description="Place of the run in the list, from 0", min=0, options={"SKIP_SAVE"})

    def job(self, context: bpy.types.Context) -> jobs.Job:
        _required_run(context.scene, self.index)
        return rendering.show_run_job(context.scene, self.index)


class MPHDRR_OT_remove_run(Reported, bpy.types.Operator):
    """Remove a run from the list, and its file from the disk if it is in this .blend's own folder"""

    poll = needs(_LISTED)

    index: IntProperty(name="Index", description="Place of the run in the list, from 0", min=0, options={"SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        item = _required_run(context.scene, self.index)
        message = "Neither Undo nor the .blend as it was saved will find its file again."
        return ask_to_remove(self, context, event, f"Remove {item.name!r} ({runs.file_size_text([item])})?", message)

    def act(self, context: bpy.types.Context) -> str:
        _required_run(context.scene, self.index)
        return rendering.remove_run(context.scene, self.index)


def _other_runs(self: Any, context: bpy.types.Context | None) -> list[tuple[str, str, str]]:
    """The runs that are not shown, by their places in the list."""
    found = context.scene.mphdrr_projections.runs if context is not None else ()
    shown = runs.shown_run(context.scene) if context is not None else None
    _others[:] = [(str(i), item.name, item.summary) for i, item in enumerate(found) if item != shown]
    return _others


class MPHDRR_OT_flood_efficiency(jobs.ExportJob, bpy.types.Operator):
    """Find the efficiencies of pixels, and dead and hot ones, from the shown run of an even source (import the flood as
    measured counts first). They are written to a file, which Efficiency under Physics then names
    """

    bl_label = "Efficiencies from Flood"
    endings = (".npy",)
    filepath: file_properties.file_property("File of efficiencies to write")
    filter_glob: file_properties.shown_files(endings)

    poll = needs(_LISTED)

    order: IntProperty(
        name="Order", description="Largest power of the smooth trend that is taken off; 0: of a source so far away that it "
        "has none", default=2, min=0, soft_max=4,
    )  # fmt: skip

    def job(self, context: bpy.types.Context) -> jobs.Job:
        flood = storage.absolute(runs.required_run(context.scene, "take efficiencies from").file)
        path = self.required_file("expected a name ending in .npy")
        order, scene_uid = self.order, context.scene.session_uid

        def finish(lines: list[str]) -> str:
            scene = jobs.require_scene(scene_uid, "the efficiencies are")
            scene.mphdrr_projections.efficiency_of_modules = storage.stored_path(path)
            return " ".join(lines)

        return jobs.Job("Flood", lambda progress: write_flood(flood, path, order)[2], finish)


class MPHDRR_OT_compare_runs(jobs.JobOperator, bpy.types.Operator):
    """Draw the shown run minus another one, of the same modules, pixels and unit, as a mosaic: white where they are equal,
    red where the shown one has more, blue where it has less
    """

    poll = needs(_LISTED)

    other: EnumProperty(name="Other", description="What is subtracted", items=_other_runs, options={"SKIP_SAVE"})

    def job(self, context: bpy.types.Context) -> jobs.Job:
        shown = runs.shown_run(context.scene)
        if shown is None or not self.other:
            raise InputError("there is no other run to compare with: keep the shown one and render again")
        other = _required_run(context.scene, int(self.other))
        paths = [rendering.run_file_path(item.file) for item in (shown, other)]
        names = f"{shown.name!r} minus {other.name!r}"

        def work(progress: Progress) -> Any:
            one, two = map(read_run, paths)
            found = difference(one, two)
            return found, difference_sheet(one, found), one.system.numbers.tolist()

        def finish(result: Any) -> str:
            found, drawn, numbers = result
            text = f"{names}: {found.text}"
            images.show_below(images.store_difference(drawn, numbers, found.unit, text), bpy.context)
            return text

        return jobs.Job("Comparing", work, finish)
