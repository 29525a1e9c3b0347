"""File > Import > Pinhole Geometry: a workbook becomes a scanner."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.props import BoolProperty, FloatProperty, IntVectorProperty, StringProperty

from ..addon import ids, scanner
from ..addon.preferences import preferences
from ..addon.reports import warnings_reported
from ..core.errors import InputError
from ..core.system import PinholeSystem

_SUFFIXES = (".xlsx", ".xlsm")


class MPHDRR_OT_import_geometry(bpy.types.Operator):
    """``bpy.ops.mphdrr.import_geometry(filepath="scanner.xlsx")``."""

    bl_idname = ids.IMPORT_GEOMETRY
    bl_label = "Import Pinhole Geometry"
    bl_description = (
        "Read a workbook of pinhole modules and build the scanner: a camera, a collimator and a crystal each"
    )
    bl_options = {"REGISTER", "UNDO"}

    filepath: StringProperty(name="File", description="Workbook to read", subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(default=";".join(f"*{s}" for s in _SUFFIXES), options={"HIDDEN"})
    name: StringProperty(
        name="Name", description="Name of the scanner, which replaces one of the same name. Empty: the file's",
        options={"SKIP_SAVE"},
    )  # fmt: skip
    plate_thickness: FloatProperty(
        name="Plate (mm)", description="Thickness in mm of the aperture plate that holds the pinhole",
        default=2.0, min=0.01, soft_max=20.0,
    )  # fmt: skip
    wall_thickness: FloatProperty(
        name="Wall (mm)",
        description="Thickness in mm of the collimator's walls",
        default=2.0,
        min=0.01,
        soft_max=20.0,
    )
    image_size: IntVectorProperty(
        name="Image Size",
        description="Pixels of the cameras' pictures: columns, rows",
        size=2,
        default=(256, 256),
        min=1,
    )
    replace: BoolProperty(
        name="Replace Changed Scanner",
        description="Replace a scanner of the same name even if it has been changed since it was imported",
        options={"SKIP_SAVE"},
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        defaults = preferences(context)
        if defaults is not None:
            for name in ("plate_thickness", "wall_thickness"):
                if not self.properties.is_property_set(name):
                    setattr(self, name, getattr(defaults, name))
        if not self.filepath:
            context.window_manager.fileselect_add(self)
            return {"RUNNING_MODAL"}
        return self.execute(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            system = self._read()
            old = scanner.find_scanner(context.scene, self.name or scanner.default_name(system))
            if old is not None and not self.replace and self.options.is_invoke and not bpy.app.background:
                self._losses = scanner.losses(old)
                if self._losses:
                    return self._ask(context, old)
            collection = scanner.build_scanner(
                context.scene,
                system,
                self.name,
                plate_thickness=self.plate_thickness,
                wall_thickness=self.wall_thickness,
                shape=(self.image_size[1], self.image_size[0]),
                replace=self.replace,
            )
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        context.view_layer.update()  # so that scripts find the children's matrix_world in place
        if old is None:
            _frame(context, system)
        self.report({"INFO"}, f"Imported {len(system)} modules into '{collection.name}'")
        return {"FINISHED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        if self._losses:
            layout.label(text="Importing again drops these changes:", icon="ERROR")
            column = layout.column(align=True)
            for line in self._losses:
                column.label(text=line[:1].upper() + line[1:], icon="DOT")
            return
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(self, "name")
        column = layout.column(align=True)
        column.prop(self, "plate_thickness")
        column.prop(self, "wall_thickness")
        layout.prop(self, "image_size")

    _losses: tuple[str, ...] | list[str] = ()

    def _read(self) -> PinholeSystem:
        from ..core.workbook import read_system

        if not self.filepath:
            raise InputError("no file given: set filepath to a workbook (.xlsx)")
        with warnings_reported(self):
            return read_system(Path(bpy.path.abspath(self.filepath)))

    def _ask(self, context: bpy.types.Context, old: bpy.types.Collection) -> set[str]:
        self.replace = True  # the dialog's button runs execute again
        return context.window_manager.invoke_props_dialog(
            self, width=440, title=f"Replace '{old.name}'?", confirm_text="Replace"
        )


class MPHDRR_FH_workbook(bpy.types.FileHandler):
    """A workbook dropped on the viewport or the outliner is imported."""

    bl_idname = ids.FILE_HANDLER_WORKBOOK
    bl_label = "Pinhole Geometry (.xlsx)"
    bl_import_operator = ids.IMPORT_GEOMETRY
    bl_file_extensions = ";".join(_SUFFIXES)

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type in {"VIEW_3D", "OUTLINER"}


def draw_menu(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    """The entry of File > Import."""
    self.layout.operator(ids.IMPORT_GEOMETRY, text="Pinhole Geometry (.xlsx)")


def _frame(context: bpy.types.Context, system: PinholeSystem) -> None:
    """Look at the whole scanner in the 3D views: its size is far from that of Blender's default scene."""
    reach = float((system.pinhole_distance + system.collimator_length).max())
    for area in context.screen.areas if context.screen else ():
        space = area.spaces.active
        if space.type == "VIEW_3D" and space.region_3d is not None and space.region_3d.view_perspective != "CAMERA":
            space.region_3d.view_location = (0.0, 0.0, 0.0)
            space.region_3d.view_distance = 2.6 * reach
