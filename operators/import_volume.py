"""File > Import > Volume for Projection, Volume Sequence: read CTs, SPECT images and OpenVDB grids as volumes."""

import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

from ..addon.blender import choices, decimals, file_properties, jobs, layouts, storage
from ..addon.volumes.volume_import import READ_ENDINGS, import_job, name_without_ending
from ..core.errors import InputError
from ..core.volumes.volume import UNITS

_SEQUENCE_ENDINGS = tuple(ending for ending in READ_ENDINGS if ending != ".dcm")  # of files that hold one volume each


class ReadVolumes(jobs.JobOperator):
    """Base class of the operators that read volumes, with the settings of reading."""

    quantity: EnumProperty(
        name="Values", description="Quantity of the voxels", default="AUTO",
        items=choices.items(choices.READ_AS, (
            ("AUTO", "As the File Says", "If a file does not say: activity in OpenVDB, CT numbers in others"),
            *((name, name.capitalize(), f"In {unit}") for name, unit in UNITS.items()),
        )),
    )  # fmt: skip
    center: BoolProperty(
        name="Centre at Isocentre",
        description="Move the volume's middle to the world's origin; leave it off for volumes that belong together",
        default=True,
    )
    attenuation: BoolProperty(name="CT to Attenuation", description="Convert CT numbers (HU) to attenuation (1/mm)")
    energy: FloatProperty(name="Energy (keV)", description="Energy of the photons in keV: 140.5 for Tc-99m",
                          default=140.5, min=10.0, max=1000.0)  # fmt: skip
    grid: StringProperty(name="Grid", description="Grid of an OpenVDB file that holds several", options={"SKIP_SAVE"})
    unit: FloatProperty(name="Unit (mm)", description="Length in mm of the unit of another program's OpenVDB file",
                        default=1.0, min=1e-6)  # fmt: skip

    first_properties: tuple[str, ...] = ("name",)  # properties of a derived class, drawn first

    def draw(self: Any, context: bpy.types.Context) -> None:
        layout = layouts.labelled(self.layout)
        layouts.draw_all(layout, self, *self.first_properties, "quantity", "center", "attenuation")
        row = layout.row()
        row.enabled = self.attenuation
        row.prop(self, "energy")
        layouts.draw_all(layout.column(heading="OpenVDB", align=True), self, "grid", "unit")

    def import_job(self, paths: Sequence[Path], name: str, frame_start: int = 1) -> jobs.Job:
        quantity = None if self.quantity == "AUTO" else self.quantity
        energy = decimals.typed(self.energy) if self.attenuation else None
        settings = {"center": self.center, "grid": self.grid or None, "unit": decimals.typed(self.unit)}
        return import_job(paths, name, quantity=quantity, energy=energy, frame_start=frame_start, **settings)


class MPHDRR_OT_import_volume(ReadVolumes, bpy.types.Operator):
    """Read a CT, an image or an OpenVDB grid as a volume to project; for a DICOM series choose the folder."""

    asks_for = "filepath"

    filepath: file_properties.file_property("File of the volume, or folder of a DICOM series")
    filter_glob: file_properties.shown_files(READ_ENDINGS)
    name: StringProperty(name="Name", description="The object's name. Empty: the file's", options={"SKIP_SAVE"})

    def job(self, context: bpy.types.Context) -> jobs.Job:
        path = self.required_file("set filepath to a volume's file, or to the folder of a DICOM series")
        return self.import_job([path], self.name)


class MPHDRR_OT_import_volume_sequence(ReadVolumes, bpy.types.Operator):
    """Read several files, in the order of their numbers, as one volume that plays over the frames."""

    asks_for = "files"

    directory: file_properties.DIRECTORY
    files: file_properties.files_property("Files with one volume for each frame")
    filter_glob: file_properties.shown_files(_SEQUENCE_ENDINGS)
    name: StringProperty(name="Name", description="Empty: the common part of the files'", options={"SKIP_SAVE"})
    frame_start: IntProperty(name="First Frame", description="Frame that shows the first file", default=1)

    first_properties = ("name", "frame_start")

    def job(self, context: bpy.types.Context) -> jobs.Job:
        folder = storage.absolute(self.directory)
        names = {file.name for file in self.files if file.name}
        # Names are sorted by the numbers in them, so that "beat2" comes before "beat10".
        parts = {n: [(int(p) if p.isdecimal() else -1, p.lower()) for p in re.split(r"(\d+)", n)] for n in names}
        paths = [folder / name for name in sorted(names, key=parts.__getitem__)]
        if len(paths) < 2:
            raise InputError(f"{folder}: expected two files or more, one for each frame; choose them all")
        for path in paths:
            if not path.name.lower().endswith(_SEQUENCE_ENDINGS):
                endings = ", ".join(_SEQUENCE_ENDINGS)
                raise InputError(f"{path}: expected a name ending in {endings}; a DICOM series is one volume")
        common = re.sub(r"[\d _.-]*$", "", os.path.commonprefix([name_without_ending(path) for path in paths]))  # noqa: RUF071
        return self.import_job(paths, self.name or common, self.frame_start)
