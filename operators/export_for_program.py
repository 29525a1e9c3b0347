"""File > Export > Pinhole Geometry for Programs: the scanner as another program's file."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path

import bpy
from bpy.props import EnumProperty, StringProperty
from bpy_extras.io_utils import ExportHelper

from ..addon import design, ids, scanner, selection, storage
from ..addon.decimals import typed
from ..addon.reports import warnings_reported
from ..core.errors import InputError
from ..core.exchange import FORMAT_NUMBERS, FORMATS, write_geometry

_ITEMS = tuple((f.name, f.name, f.title, FORMAT_NUMBERS[f.name]) for f in FORMATS.values())


class MPHDRR_OT_export_for_program(ExportHelper, bpy.types.Operator):
    """``bpy.ops.mphdrr.export_for_program(format="astra", filepath="scanner.npz")``."""

    bl_idname = ids.EXPORT_FOR_PROGRAM
    bl_label = "Export Geometry for a Program"
    bl_description = (
        "Write the scanner as it stands in the scene for another program: cameras of reconstruction codes, solids to "
        "print, Monte Carlo simulations. Images are those of the Projections panel"
    )

    filename_ext = ""
    filepath: StringProperty(
        name="File", description="File to write, or new folder for formats of several files", subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )  # fmt: skip
    format: EnumProperty(name="Format", description="What is written", items=_ITEMS)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return selection.poll_scanner(cls, context)

    def check(self, context: bpy.types.Context) -> bool:
        """Give the name the ending of the format."""
        path, suffixes = Path(self.filepath), FORMATS[self.format].suffixes
        if not path.name or path.name.lower().endswith(suffixes or ()):
            return False
        known = {suffix for format in FORMATS.values() for suffix in format.suffixes}
        stem = path.with_suffix("") if path.suffix.lower() in known else path
        new = str(stem) + (suffixes[0] if suffixes else "")
        changed = new != self.filepath
        self.filepath = new
        return changed

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            if not self.filepath:
                raise InputError("no file given: set filepath")
            path, format = storage.absolute(self.filepath), FORMATS[self.format]
            collection = scanner.required_scanner(context.scene)
            images = getattr(context.scene, ids.SCENE_PROJECTIONS)
            built = asdict(design.construction(collection.mphdrr_scanner))
            built["opening_degrees"] = typed(math.degrees(built.pop("opening_angle")))
            with warnings_reported(self):
                system = scanner.read_scanner(collection, aimed=True)
                views = system.views(
                    (images.height, images.width), images.detector.lower(), magnification=typed(images.magnification)
                )
                options = {name: value for name, value in built.items() if name in format.options}
                write_geometry(system, path, format.name, views=views, **options)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self.report({"INFO"}, f"Wrote {len(system)} modules to {path}")
        return {"FINISHED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.prop(self, "format")
        format = FORMATS[self.format]
        column = layout.column(align=True)
        for line in (format.title, f"Ending {', '.join(format.suffixes)}" if format.suffixes else "A new folder"):
            column.label(text=line, icon="DOT")


def draw_menu(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    self.layout.operator(ids.EXPORT_FOR_PROGRAM, text="Pinhole Geometry for Programs")
