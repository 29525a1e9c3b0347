"""File > Import > Pinhole Geometry: build the scanner of a workbook, with a dialog if the headings are not recognised."""

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import bpy
from bpy.props import BoolProperty, FloatProperty, IntVectorProperty, StringProperty

from ..addon.blender import file_properties, ids, layouts, reports
from ..addon.figures import studio
from ..addon.scanner import column_maps, scanner, scanner_files
from ..core import ColumnMap, InputError, PinholeSystem, kinds_in, read_scanner
from ..core.geometry.collimator import Construction
from ..core.geometry.scanner import Scanner
from . import column_map_dialog


def ask_to_replace(operator: bpy.types.Operator, context: bpy.types.Context) -> set[str]:
    """Open the dialog of an operator that asks whether to replace a scanner that has changed."""
    return context.window_manager.invoke_props_dialog(
        operator, width=440, title="Replace the Scanner?", confirm_text="Replace"
    )


def draw_losses(layout: bpy.types.UILayout, losses: Iterable[str]) -> None:
    """Draw the changes of the scanner that are lost if it is replaced."""
    layout.label(text="Importing again drops these changes:", icon="ERROR")
    column = layout.column(align=True)
    for line in losses:
        column.label(text=line[:1].upper() + line[1:], icon="DOT")


class MPHDRR_OT_import_geometry(bpy.types.Operator):
    """Read a workbook of pinhole modules and build the scanner: a camera, a collimator and a crystal each."""

    bl_label = "Import Pinhole Geometry"
    bl_options = {"REGISTER", "UNDO"}

    filepath: file_properties.file_property("Workbook to read")
    filter_glob: file_properties.shown_files(scanner_files.WORKBOOK_SUFFIXES)
    name: StringProperty(name="Name",
                         description="Name of the scanner, which replaces one of the same name. Empty: the file's",
                         options={"SKIP_SAVE"})  # fmt: skip
    columns: StringProperty(name="Column Map",
                            description="File (.toml) with the meaning of the columns. Empty: read the headings",
                            subtype="FILE_PATH", options={"SKIP_SAVE"})  # fmt: skip
    choose_columns: BoolProperty(
        name="Choose Columns",
        description="Set the meaning of the columns in a dialog. It opens by itself if the headings are not recognised",
        options={"SKIP_SAVE"},
    )
    chosen_columns: StringProperty(
        name="Columns", description="The dialog's map, TOML", options={"HIDDEN", "SKIP_SAVE"}
    )
    plate_thickness: FloatProperty(name="Plate (mm)",
                                   description="Thickness in mm of the aperture plate that holds the pinhole",
                                   default=2.0, min=0.01, soft_max=20.0)  # fmt: skip
    wall_thickness: FloatProperty(name="Wall (mm)", description="Thickness in mm of the collimator's walls",
                                  default=2.0, min=0.01, soft_max=20.0)  # fmt: skip
    image_size: IntVectorProperty(name="Image Size", description="Pixels of the cameras' pictures: columns, rows",
                                  size=2, default=(256, 256), min=1)  # fmt: skip
    replace: BoolProperty(
        name="Replace Changed Scanner",
        description="Replace a scanner of the same name even if it has been changed since it was imported",
        options={"SKIP_SAVE"},
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not self.filepath:
            context.window_manager.fileselect_add(self)
            return {"RUNNING_MODAL"}
        return self.execute(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        form = context.window_manager.mphdrr_columns
        try:
            if self._dialog == "COLUMNS":
                self.chosen_columns = column_maps.accept(form).to_toml()
            elif self.choose_columns and not self.chosen_columns:
                if not self._has_window():  # a script cannot answer
                    advice = "in a script set columns to a column map (.toml) instead"
                    raise InputError(f"choose_columns opens a dialog: {advice}")
                column_maps.fill(form, self._workbook(), self._columns())
                return self._ask_columns(context)
            with reports.warnings_reported(self):
                first_kind, *further_kinds = self._kinds()
                system = read_scanner(self._workbook(), first_kind, self._columns())
                self._further_scanners = [read_scanner(self._workbook(), kind) for kind in further_kinds]
        except InputError as error:
            if self._dialog_can_help(form, error):
                return self._ask_columns(context)
            column_maps.clear(form)
            self.report({"ERROR"}, reports.in_window(error))
            return {"CANCELLED"}
        if not self.replace and self._has_window():
            names = self.name or scanner.default_name(system), *map(self._scanner_name, self._further_scanners)
            self._losses = scanner.losses_of(context.scene, *names)
            if self._losses:
                self._dialog = "REPLACE"
                self.replace = True  # the dialog's button calls execute again
                return ask_to_replace(self, context)
        return reports.run_reported(self, lambda: self._build(context, system))

    def _build(self, context: bpy.types.Context, system: Scanner) -> str:
        """Build the workbook's scanners in the scene, `system` last; return the operator's message."""
        scene_camera = context.scene.camera
        for further in self._further_scanners:
            scanner.build_scanner(context.scene, further, self._scanner_name(further), replace=self.replace)
        context.scene.camera = scene_camera  # if it is none, the first camera of `system` becomes the scene's
        construction = Construction(self.plate_thickness, self.wall_thickness)
        shape = self.image_size[1], self.image_size[0]
        collection = scanner.build_scanner(
            context.scene, system, self.name, construction=construction, shape=shape, replace=self.replace
        )
        studio.light(context.scene)
        context.view_layer.update()  # so that scripts find the children's matrix_world in place
        self._dialog = ""
        column_maps.clear(context.window_manager.mphdrr_columns)
        additions = "".join(f" and {len(further)} of the kind {further.kind}" for further in self._further_scanners)
        return f"Imported {ids.counted(len(system), 'module')}{additions} into '{collection.name}'"

    def cancel(self, context: bpy.types.Context) -> None:
        column_maps.clear(context.window_manager.mphdrr_columns)

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        if self._dialog == "COLUMNS":
            column_map_dialog.draw(layout, context.window_manager.mphdrr_columns)
            return
        if self._dialog == "REPLACE":
            draw_losses(layout, self._losses)
            return
        if context.space_data.type == "FILE_BROWSER":  # otherwise this is the panel of the last operation
            layout.operator("mphdrr.browse_example", icon="FILE_FOLDER")
        names = ("name", "plate_thickness", "wall_thickness", "image_size", "columns", "choose_columns")
        layouts.draw_all(layouts.labelled(layout), self, *names)

    _dialog: Literal["", "COLUMNS", "REPLACE"] = ""  # the open dialog
    _losses: list[str] | tuple[str, ...] = ()  # changes of the scene's scanner that are lost if it is replaced
    _further_scanners: list[Scanner]  # the workbook's scanners beside the first

    def _scanner_name(self, further: Scanner) -> str:
        """Return the name in the scene of a further scanner of the workbook."""
        return f"{self.name} {further.kind}" if self.name else scanner.default_name(further)

    def _has_window(self) -> bool:
        """Return whether the operator can open a dialog: it was called in a window, not by a script."""
        return self.options.is_invoke and not bpy.app.background

    def _workbook(self) -> Path:
        """Return the path of the workbook; raise `InputError` if none is given."""
        if not self.filepath:
            raise InputError("no file given: set filepath to a workbook (.xlsx)")
        return Path(bpy.path.abspath(self.filepath))

    def _kinds(self) -> tuple[str, ...]:
        """Return the kinds of scanners in the workbook; with a column map it is read as pinholes."""
        return (kinds_in(self._workbook()) if self._columns() is None else ()) or (PinholeSystem.kind,)

    def _columns(self) -> ColumnMap | None:
        """Return the column map of the dialog or of the given file, if any."""
        if self.chosen_columns:
            return ColumnMap.from_toml(self.chosen_columns)
        return ColumnMap.read(bpy.path.abspath(self.columns)) if self.columns else None

    def _dialog_can_help(self, form: column_maps.ColumnMapProperties, error: InputError) -> bool:
        """Return whether the column map dialog can resolve the reader's refusal; if so, fill the dialog's settings."""
        if self._dialog == "COLUMNS":
            form.refusal = reports.in_window(error)
            return True
        try:
            return self._has_window() and column_maps.fill(form, self._workbook(), self._columns())
        except InputError:
            return False

    def _ask_columns(self, context: bpy.types.Context) -> set[str]:
        """Open the column map dialog."""
        self._dialog = "COLUMNS"
        texts = {"title": f"Columns of {self._workbook().name}", "confirm_text": "Import"}
        return context.window_manager.invoke_props_dialog(self, width=column_map_dialog.WIDTH, **texts)
