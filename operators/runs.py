"""Operators on the scene's runs: show one, remove one, compare two, take efficiencies from a flood."""

from typing import Any

import bpy
from bpy.props import EnumProperty, IntProperty

from ..addon.blender import choices, file_properties, jobs, storage
from ..addon.blender.reports import Need, Reported, ask_to_remove, needs
from ..addon.pictures import images
from ..addon.runs import rendering, runs
from ..core import InputError, Progress, read_run
from ..core.runs.comparing import difference, difference_sheet
from ..core.runs.flood_files import write_flood
from ..core.runs.run import PHOTONS

_choices: list[tuple[str, str, str]] = []  # kept here, because Blender keeps no copies of an enumeration's texts


def _required_run(scene: bpy.types.Scene, index: int) -> bpy.types.PropertyGroup:
    """Return the run at an index of the scene's list; raise `InputError` if there is none."""
    scene_runs = scene.mphdrr_projections.runs
    if not 0 <= index < len(scene_runs):
        raise InputError(f"index {index}: the scene has {len(scene_runs)} runs, counted from 0")
    return scene_runs[index]


_LISTED: Need = (lambda context: context.scene.mphdrr_projections.runs, "No runs yet: render the projections first")


class MPHDRR_OT_show_run(jobs.JobOperator, bpy.types.Operator):
    """Show a run of the list: its images, the mosaic and the planes in the scene. Modules and volumes stay as they are."""

    bl_options = {"REGISTER", "UNDO", "INTERNAL"}  # internal, because it is called by a click in the list

    poll = needs(_LISTED)

    index: IntProperty(name="Index", description="Place of the run in the list, from 0", min=0, options={"SKIP_SAVE"})
    photons: EnumProperty(name="Photons", description="Photons that the images hold, of a run with scatter",
                          items=choices.items({}, ((name.upper(), label, "") for name, label in PHOTONS.items())),
                          default="ALL", options={"SKIP_SAVE"})  # fmt: skip

    def job(self, context: bpy.types.Context) -> jobs.Job:
        _required_run(context.scene, self.index)
        return rendering.show_run_job(context.scene, self.index, self.photons.lower())


class MPHDRR_OT_remove_run(Reported, bpy.types.Operator):
    """Remove a run from the list, and its file from the disk if it is in this .blend's own folder."""

    poll = needs(_LISTED)

    index: IntProperty(name="Index", description="Place of the run in the list, from 0", min=0, options={"SKIP_SAVE"})

    @classmethod
    def description(cls, context: bpy.types.Context, properties: Any) -> str:
        """Return the tooltip, with the size of the run's file."""
        size = runs.file_size_text(context.scene.mphdrr_projections.runs[properties.index : properties.index + 1])
        return f"{cls.bl_description}: {size}"

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        item = _required_run(context.scene, self.index)
        message = "Neither Undo nor the .blend as it was saved will find its file again."
        return ask_to_remove(self, context, event, f"Remove {item.name!r} ({runs.file_size_text([item])})?", message)

    def act(self, context: bpy.types.Context) -> str:
        _required_run(context.scene, self.index)
        return rendering.remove_run(context.scene, self.index)


def _other_runs(self: Any, context: bpy.types.Context | None) -> list[tuple[str, str, str]]:
    """Return the choices of runs that are not shown, by their indices in the list."""
    scene_runs = context.scene.mphdrr_projections.runs if context is not None else ()
    shown_run = runs.shown_run(context.scene) if context is not None else None
    _choices[:] = [(str(i), item.name, item.summary) for i, item in enumerate(scene_runs) if item != shown_run]
    return _choices


class MPHDRR_OT_flood_efficiency(jobs.ExportJob, bpy.types.Operator):
    """Calculate the efficiencies of pixels, and find dead and hot ones, from the shown run of an even source (import the
    flood as measured counts first). They are written to a file, which Efficiency under Physics then names.
    """

    bl_label = "Efficiencies from Flood"
    endings = (".npy",)
    filepath: file_properties.file_property("File of efficiencies to write")
    filter_glob: file_properties.shown_files(endings)

    poll = needs(_LISTED)

    order: IntProperty(
        name="Order", description="Largest power of the smooth trend that is divided out; 0: for a source so far away that "
        "there is none", default=2, min=0, soft_max=4,
    )  # fmt: skip

    def job(self, context: bpy.types.Context) -> jobs.Job:
        flood = storage.absolute(runs.required_run(context.scene, "take efficiencies from").file)
        path = self.required_file("expected a name ending in .npy")
        order, scene_uid = self.order, context.scene.session_uid

        def finish(lines: list[str]) -> str:
            """Set the written file as the modules' efficiencies, and return the lines to report."""
            scene = jobs.require_scene(scene_uid, "the efficiencies are")
            scene.mphdrr_projections.efficiency_of_modules = storage.stored_path(path)
            return " ".join(lines)

        return jobs.Job("Flood", lambda progress: write_flood(flood, path, order)[2], finish)


class MPHDRR_OT_compare_runs(jobs.JobOperator, bpy.types.Operator):
    """Draw the shown run minus another one, of the same modules, pixels and unit, as a mosaic: white where they are equal,
    red where the shown one has more, blue where it has less.
    """

    poll = needs(_LISTED)

    other: EnumProperty(name="Other", description="Run to subtract", items=_other_runs, options={"SKIP_SAVE"})

    def job(self, context: bpy.types.Context) -> jobs.Job:
        if (minuend := runs.shown_run(context.scene)) is None or not self.other:
            raise InputError("there is no other run to compare with: keep the shown one and render again")
        subtrahend = _required_run(context.scene, int(self.other))
        paths = [rendering.run_file_path(item.file) for item in (minuend, subtrahend)]
        names = f"{minuend.name!r} minus {subtrahend.name!r}"

        def work(progress: Progress) -> Any:
            """Return the difference of the two runs, its sheet and the modules' numbers."""
            first, second = map(read_run, paths)
            result = difference(first, second)
            return result, difference_sheet(first, result), first.system.numbers.tolist()

        def finish(results: Any) -> str:
            """Show the difference, and return the line to report."""
            result, sheet, numbers = results
            text = f"{names}: {result.text}"
            images.show_below(images.store_difference(sheet, numbers, result.unit, text), bpy.context)
            return text

        return jobs.Job("Comparing", work, finish)
