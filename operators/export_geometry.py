"""File > Export > Pinhole Geometry: write the scanner as a workbook, or as another program's file."""

from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty

from ..addon.blender import decimals, file_properties, jobs, reports, storage
from ..addon.scanner import scanner, scanner_files, selection
from ..core.exchange import FORMAT_NUMBERS, FORMATS

_FORMATS = tuple((f.name, f.name, f.title, FORMAT_NUMBERS[f.name]) for f in FORMATS.values())


class MPHDRR_OT_export_geometry(jobs.ExportJob, bpy.types.Operator):
    """Write the scanner as it stands in the scene to a workbook, into a copy of the one it came from."""

    bl_label = "Export Pinhole Geometry"
    bl_options = {"REGISTER", "UNDO"}  # with Undo, because the new workbook becomes the scanner's

    poll = reports.needs(selection.SCANNER)

    endings = scanner_files.WORKBOOK_SUFFIXES
    filepath: file_properties.file_property("Workbook to write")
    filter_glob: file_properties.shown_files(scanner_files.WORKBOOK_SUFFIXES)
    use_template: BoolProperty(
        name="Keep Workbook",
        description="Write into a copy of the workbook that the scanner was imported from: its other sheets, formulas, "
        "charts and formats stay. Otherwise a new workbook is made",
        default=True,
    )

    def ask(self, context: bpy.types.Context) -> set[str] | None:
        workbook = scanner.required_scanner(context.scene).mphdrr_scanner.workbook
        if not self.filepath and workbook:
            # The suggested name is not the workbook's own, which has to be typed to be overwritten.
            path = storage.absolute(workbook)
            self.filepath = str(path.with_stem(f"{path.stem.removesuffix('-edited')}-edited"))
        return super().ask(context)

    def job(self, context: bpy.types.Context) -> jobs.Job:
        path = self.required_file("set filepath to a name ending in .xlsx")
        return scanner_files.export_workbook_job(scanner.required_scanner(context.scene), path, self.use_template)


class MPHDRR_OT_export_for_program(jobs.ExportJob, bpy.types.Operator):
    """Write the scanner as it stands in the scene for another program: cameras for reconstruction codes, solids to print,
    Monte Carlo simulations. Images are those of the Projections panel.
    """

    bl_label = "Export Geometry for a Program"

    poll = reports.needs(selection.SCANNER)

    endings = ("",)
    filepath: file_properties.file_property("File to write, or new folder for formats of several files")
    format: EnumProperty(name="Format", description="Format of the file", items=_FORMATS)

    def check(self, context: bpy.types.Context) -> bool:
        """Give the file name the format's suffix; return whether it has changed."""
        path, suffixes = Path(self.filepath), FORMATS[self.format].suffixes
        if not path.name or path.name.lower().endswith(suffixes or ()):
            return False
        all_suffixes = {suffix for format in FORMATS.values() for suffix in format.suffixes}
        stem = path.with_suffix("") if path.suffix.lower() in all_suffixes else path
        old_path, self.filepath = self.filepath, str(stem) + (suffixes[0] if suffixes else "")
        return old_path != self.filepath

    def job(self, context: bpy.types.Context) -> jobs.Job:
        path, images = self.required_file("set filepath"), context.scene.mphdrr_projections
        shape, magnification = (images.height, images.width), decimals.typed(images.magnification)
        collection, detector = scanner.required_scanner(context.scene), images.detector.lower()
        return scanner_files.export_program_job(collection, path, self.format, shape, detector, magnification)

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.prop(self, "format")
        format = FORMATS[self.format]
        for line in (format.title, f"Suffix {', '.join(format.suffixes)}" if format.suffixes else "A new folder"):
            self.layout.label(text=line, icon="DOT")
