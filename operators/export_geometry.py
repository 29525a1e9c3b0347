"""File > Export > Pinhole Geometry: the scanner becomes a workbook."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.props import BoolProperty, StringProperty
from bpy_extras.io_utils import ExportHelper

from ..addon import geometry_file, ids, scanner, selection, storage
from ..addon.reports import warnings_reported
from ..core.errors import InputError

_SUFFIXES = (".xlsx", ".xlsm")


class MPHDRR_OT_export_geometry(ExportHelper, bpy.types.Operator):
    """``bpy.ops.mphdrr.export_geometry(filepath="scanner.xlsx")``."""

    bl_idname = ids.EXPORT_GEOMETRY
    bl_label = "Export Pinhole Geometry"
    bl_description = "Write the scanner as it stands in the scene to a workbook, into a copy of the one it came from"
    bl_options = {"REGISTER", "UNDO"}

    filename_ext = ".xlsx"
    filepath: StringProperty(name="File", description="Workbook to write", subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(default=";".join(f"*{s}" for s in _SUFFIXES), options={"HIDDEN"})
    use_template: BoolProperty(
        name="Keep Workbook",
        description="Write into a copy of the workbook that the scanner was imported from: its other sheets, formulas, "
        "charts and formats stay. Otherwise a new workbook is made",
        default=True,
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return selection.poll_scanner(cls, context)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        workbook = scanner.required_scanner(context.scene).mphdrr_scanner.workbook
        if not self.filepath and workbook:
            # Not the master record itself: whoever wants to replace that chooses its name.
            path = storage.absolute(workbook)
            self.filepath = str(path.with_stem(f"{path.stem.removesuffix('-edited')}-edited"))
        return super().invoke(context, event)

    def check(self, context: bpy.types.Context) -> bool:
        """Give a name without one of the suffixes the default one."""
        if Path(self.filepath).suffix.lower() in _SUFFIXES:
            return False
        self.filepath += self.filename_ext
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            if not self.filepath:
                raise InputError("no file given: set filepath to a name ending in .xlsx")
            path = storage.absolute(self.filepath)
            with warnings_reported(self):
                system = geometry_file.export_scanner(
                    scanner.required_scanner(context.scene), path, use_template=self.use_template
                )
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Wrote {len(system)} modules to {path}")
        return {"FINISHED"}


def draw_menu(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    """The entry of File > Export."""
    self.layout.operator(ids.EXPORT_GEOMETRY, text="Pinhole Geometry (.xlsx)")
