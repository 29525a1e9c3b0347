"""File > Import > Volume for Projection: a CT, a SPECT image or an OpenVDB grid becomes a volume, as a job."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path
from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, StringProperty

from ..addon import ids, jobs, storage, vdb, volumes
from ..addon.phantom_properties import typed
from ..core.errors import InputError
from ..core.hounsfield import hu_to_mu
from ..core.progress import Progress
from ..core.rearranging import centered
from ..core.volume import UNITS, Volume
from ..core.volume_io import READ_FORMATS, read_volume

_SUFFIXES = (*READ_FORMATS, ".vdb")


class MPHDRR_OT_import_volume(jobs.JobOperator, bpy.types.Operator):
    """``bpy.ops.mphdrr.import_volume(filepath="ct.nii.gz", attenuation=True)``."""

    bl_idname = ids.IMPORT_VOLUME
    bl_label = "Import Volume"
    bl_description = (
        "Read a CT, an image or an OpenVDB grid as a volume to project; of a DICOM series choose the folder"
    )
    bl_options = {"REGISTER", "UNDO"}

    filepath: StringProperty(
        name="File",
        description="File, or folder of a DICOM series, to read",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )
    filter_glob: StringProperty(default=";".join(f"*{s}" for s in _SUFFIXES), options={"HIDDEN"})
    name: StringProperty(name="Name", description="The object's name. Empty: the file's", options={"SKIP_SAVE"})
    quantity: EnumProperty(
        name="Values", description="What the voxels hold",
        items=(
            ("AUTO", "As the File Says", "Files that say nothing: OpenVDB's hold activity, others CT numbers"),
            *((name, name.capitalize(), f"In {unit}") for name, unit in UNITS.items()),
        ),
        default="AUTO",
    )  # fmt: skip
    center: BoolProperty(
        name="Centre at Isocentre",
        description="Move the volume's middle to the world's origin; leave it off for volumes that belong together",
        default=True,
    )
    attenuation: BoolProperty(
        name="CT to Attenuation",
        description="Convert CT numbers (HU) to attenuation coefficients (1/mm)",
        default=False,
    )
    energy: FloatProperty(
        name="Energy (keV)", description="Of the photons that are attenuated, in keV: 140.5 is Tc-99m's", default=140.5,
        min=10.0, max=1000.0,
    )  # fmt: skip
    grid: StringProperty(
        name="Grid", description="Of an OpenVDB file that holds several, the one to read", options={"SKIP_SAVE"}
    )
    unit: FloatProperty(
        name="Unit (mm)", description="Length in mm of an OpenVDB file's unit, if another program wrote it", default=1.0,
        min=1e-6,
    )  # fmt: skip

    def ask(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str] | None:
        if self.filepath:
            return None
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(self, "name")
        layout.prop(self, "quantity")
        layout.prop(self, "center")
        layout.prop(self, "attenuation")
        row = layout.row()
        row.enabled = self.attenuation
        row.prop(self, "energy")
        column = layout.column(heading="OpenVDB", align=True)
        column.prop(self, "grid")
        column.prop(self, "unit")

    def job(self, context: bpy.types.Context) -> jobs.Job:
        if not self.filepath:
            raise InputError("no file given: set filepath to a volume's file, or to the folder of a DICOM series")
        path = Path(bpy.path.abspath(self.filepath))
        quantity = None if self.quantity == "AUTO" else self.quantity
        center, energy = self.center, typed(self.energy) if self.attenuation else None
        grid, unit, name, folder = self.grid or None, typed(self.unit), self.name or _name(path), storage.folder()

        def work(progress: Progress) -> volumes.StoredVolume:
            progress(0, 4)
            if path.suffix.lower() == ".vdb":
                volume = vdb.read_vdb(path, quantity, grid, unit=unit)
            else:
                volume = read_volume(path, quantity, progress=lambda done, total: progress(done, 4 * total))
            progress(1, 4)
            provenance: dict[str, Any] = {"file": path.name, "read_as": volume.quantity}
            if energy is not None:
                volume = hu_to_mu(volume, energy)
                provenance["energy_keV"] = energy
            progress(2, 4)
            if center:
                provenance["moved_mm"] = (-volume.grid.center).tolist()
                volume = centered(volume)
            stored = volumes.store_volume(volume, folder, None, provenance)
            progress(4, 4)
            return stored

        def finish(stored: volumes.StoredVolume) -> Generator[None, None, str]:
            yield
            item = volumes.add_stored(stored, name, bpy.context.collection)
            volumes.make_active(bpy.context, item)
            moved = ", its middle moved to the isocentre" if center else ""
            return f"Imported {item.name!r}: {_described(stored.volume, stored.low, stored.high)}{moved}"

        return jobs.Job("Importing a volume", work, finish)


class MPHDRR_FH_volume(bpy.types.FileHandler):
    """A volume's file dropped on the viewport is imported."""

    bl_idname = ids.FILE_HANDLER_VOLUME
    bl_label = "Volume for Projection"
    bl_import_operator = ids.IMPORT_VOLUME
    # The last suffix is what Blender compares. Most files in .hdr are pictures of surroundings, no Analyze images.
    bl_file_extensions = ";".join(sorted({"." + suffix.rsplit(".", 1)[1] for suffix in _SUFFIXES} - {".hdr"}))

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"


def draw_menu(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    """The entry of File > Import."""
    self.layout.operator(ids.IMPORT_VOLUME, text="Volume for Projection (.nii, DICOM, .nrrd, .vdb, ...)")


def _name(path: Path) -> str:
    suffix = next((s for s in sorted(_SUFFIXES, key=len, reverse=True) if path.name.lower().endswith(s)), "")
    return path.name[: len(path.name) - len(suffix)] or path.name


def _described(volume: Volume, low: float, high: float) -> str:
    voxels = " x ".join(map(str, volume.grid.shape))
    return f"{voxels} voxels of {volume.quantity}, {low:.4g} to {high:.4g} {volume.unit}"
