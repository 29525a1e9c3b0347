"""Operators that load the example, and that choose its workbook in the file browser."""

from collections.abc import Sequence

import bpy
from bpy.props import EnumProperty

from ..addon import example
from ..addon.blender import choices, jobs
from ..addon.blender.reports import Reported, needs
from ..addon.scanner import scanner
from ..core.example import EXAMPLE
from .import_geometry import ask_to_replace, draw_losses


class MPHDRR_OT_load_example(jobs.JobOperator, bpy.types.Operator):
    """Load the bundled scanner of 80 modules with a phantom, and show what every module, or every X-ray tube, sees of it."""

    example: EnumProperty(
        name="Example", description="Example to load", items=choices.items({}, example.EXAMPLES), options={"SKIP_SAVE"}
    )

    poll = needs((lambda context: not jobs.is_running(), "Another job is running: wait for it or cancel it"))

    def ask(self, context: bpy.types.Context) -> set[str] | None:
        """Ask whether to drop the changes of an example that is already in the scene."""
        self._losses = scanner.losses_of(context.scene, EXAMPLE.stem)
        return ask_to_replace(self, context) if self._losses else None

    def draw(self, context: bpy.types.Context) -> None:
        if self._losses:  # empty in the panel of the last operation
            draw_losses(self.layout, self._losses)

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return example.example_job(context, self.example == "XRAY", self.confirmed)

    _losses: Sequence[str] = ()


class MPHDRR_OT_browse_example(Reported, bpy.types.Operator):
    """Choose the bundled workbook, a scanner of 80 modules in 4 rings."""

    bl_label = "Example Workbook"
    bl_options = {"INTERNAL"}

    poll = needs((lambda context: getattr(context.space_data, "type", "") == "FILE_BROWSER", "Only in a file browser"))

    def act(self, context: bpy.types.Context) -> None:
        params = context.space_data.params
        params.directory, params.filename = bytes(EXAMPLE.parent), EXAMPLE.name
