"""File > Import > Volume for Projection, Volume Sequence: CTs, SPECT images and OpenVDB grids become volumes, as a job."""

from __future__ import annotations

import itertools
import re
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
from bpy.props import BoolProperty, CollectionProperty, EnumProperty, FloatProperty, IntProperty, StringProperty

from ..addon import choices, ids, jobs, storage, vdb, volumes
from ..addon.decimals import typed
from ..core.errors import InputError
from ..core.memory import require
from ..core.physics.ct_numbers import hu_to_mu
from ..core.progress import Progress, part_of
from ..core.volumes.rearranging import centered
from ..core.volumes.volume import UNITS, Volume
from ..core.volumes.volume_files import READ_FORMATS, read_volume

_SUFFIXES = (*READ_FORMATS, ".vdb")
_STATES = tuple(suffix for suffix in _SUFFIXES if suffix != ".dcm")  # of files that hold one volume each


class ReadVolumes(jobs.JobOperator):
    """Mix into an operator that reads volumes: how it does."""

    quantity: EnumProperty(
        name="Values", description="What the voxels hold",
        items=choices.items(
            choices.READ_AS,
            (
                ("AUTO", "As the File Says", "Files that say nothing: OpenVDB's hold activity, others CT numbers"),
                *((name, name.capitalize(), f"In {unit}") for name, unit in UNITS.items()),
            ),
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

    if TYPE_CHECKING:  # of Blender
        layout: bpy.types.UILayout

    own_names: tuple[str, ...] = ("name",)
    """The operator's own properties, in the order of drawing."""

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        for name in (*self.own_names, "quantity", "center", "attenuation"):
            layout.prop(self, name)
        row = layout.row()
        row.enabled = self.attenuation
        row.prop(self, "energy")
        column = layout.column(heading="OpenVDB", align=True)
        column.prop(self, "grid")
        column.prop(self, "unit")

    def reading(self, paths: Sequence[Path], name: str, frame_start: int = 1) -> jobs.Job:
        """The job that reads files as a volume, or as the states of one from `frame_start` on."""
        quantity = None if self.quantity == "AUTO" else self.quantity
        center, energy = self.center, typed(self.energy) if self.attenuation else None
        grid, unit, folder, count = self.grid or None, typed(self.unit), storage.folder(), len(paths)

        def read(path: Path, progress: Progress | None) -> Volume:
            if path.suffix.lower() == ".vdb":
                return vdb.read_vdb(path, quantity, grid, unit=unit)
            return read_volume(path, quantity, progress=progress)

        def work(progress: Progress) -> volumes.StoredVolume:
            states: list[Volume] = []
            for path in paths:
                progress(len(states), count + 1)
                states.append(read(path, part_of(progress, len(states), count + 1)))
                if len(states) == 1 < count:
                    shape = " x ".join(map(str, states[0].grid.shape))
                    require(4.0 * (count - 1) * states[0].grid.n_voxels, f"{count} volumes of {shape} voxels")
            names = [path.name for path in paths]
            provenance: dict[str, Any] = {"file": names[0]} if count == 1 else {"files": names}
            provenance["read_as"] = states[0].quantity
            if energy is not None:
                states = [hu_to_mu(volume, energy) for volume in states]
                provenance["energy_keV"] = energy
            if center:  # all by as much as the first
                middle = states[0].grid.center
                provenance["moved_mm"] = (-middle).tolist()
                states = [centered(volume, volume.grid.center - middle) for volume in states]
            progress(count, count + 1)
            stored = volumes.store_volume(states, folder, None, provenance)
            progress(count + 1, count + 1)
            return stored

        def finish(stored: volumes.StoredVolume) -> Generator[None, None, str]:
            yield
            item = volumes.add_stored(stored, name, bpy.context.collection)
            item.data.frame_start = frame_start
            volumes.make_active(bpy.context, item)
            states = f"{count} states of " if count > 1 else ""
            moved = ", its middle moved to the isocentre" if center else ""
            return f"Imported {item.name!r}: {states}{_described(stored.volume, stored.low, stored.high)}{moved}"

        return jobs.Job("Importing a volume" if count == 1 else f"Importing {count} volumes", work, finish)


class MPHDRR_OT_import_volume(ReadVolumes, bpy.types.Operator):
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

    def ask(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str] | None:
        if self.filepath:
            return None
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def job(self, context: bpy.types.Context) -> jobs.Job:
        if not self.filepath:
            raise InputError("no file given: set filepath to a volume's file, or to the folder of a DICOM series")
        path = Path(bpy.path.abspath(self.filepath))
        return self.reading([path], self.name or _name(path))


class MPHDRR_OT_import_volume_sequence(ReadVolumes, bpy.types.Operator):
    """``bpy.ops.mphdrr.import_volume_sequence(directory="beats", files=[{"name": "1.nii"}, {"name": "2.nii"}])``."""

    bl_idname = ids.IMPORT_VOLUME_SEQUENCE
    bl_label = "Import Volume Sequence"
    bl_description = (
        "Read several files, in the order of the numbers in their names, as one volume that plays over the frames, such as "
        "the states of a beating heart"
    )
    bl_options = {"REGISTER", "UNDO"}

    directory: StringProperty(
        name="Folder", description="Where the files are", subtype="DIR_PATH", options={"SKIP_SAVE"}
    )
    files: CollectionProperty(
        name="Files", description="Of one volume for each frame", type=bpy.types.OperatorFileListElement,
        options={"SKIP_SAVE"},
    )  # fmt: skip
    filter_glob: StringProperty(default=";".join(f"*{s}" for s in _STATES), options={"HIDDEN"})
    name: StringProperty(
        name="Name", description="The object's name. Empty: what the files' names have in common", options={"SKIP_SAVE"}
    )
    frame_start: IntProperty(name="First Frame", description="Frame that shows the first file", default=1)

    own_names = ("name", "frame_start")

    def ask(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str] | None:
        if self.files:
            return None
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def job(self, context: bpy.types.Context) -> jobs.Job:
        folder = Path(bpy.path.abspath(self.directory))
        paths = [folder / name for name in sorted({file.name for file in self.files if file.name}, key=_by_number)]
        if len(paths) < 2:
            raise InputError(f"{folder}: expected two files or more, one for each frame; choose them all")
        for path in paths:
            if not path.name.lower().endswith(_STATES):
                raise InputError(
                    f"{path}: expected a name ending in {', '.join(_STATES)}; a DICOM series is one volume"
                )
        common = re.sub(r"[\d _.-]*$", "", _common([_name(path) for path in paths]))
        return self.reading(paths, self.name or common or _name(paths[0]), self.frame_start)


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
    """The entries of File > Import."""
    self.layout.operator(ids.IMPORT_VOLUME, text="Volume for Projection (.nii, DICOM, .nrrd, .vdb, ...)")
    self.layout.operator(ids.IMPORT_VOLUME_SEQUENCE, text="Volume Sequence (.nii, .nrrd, .vdb, ...)")


def _name(path: Path) -> str:
    suffix = next((s for s in sorted(_SUFFIXES, key=len, reverse=True) if path.name.lower().endswith(s)), "")
    return path.name[: len(path.name) - len(suffix)] or path.name


def _by_number(name: str) -> list[tuple[int, str]]:
    """What to sort names by so that "beat2" comes before "beat10"."""
    return [(int(part) if part.isdecimal() else -1, part.lower()) for part in re.split(r"(\d+)", name)]


def _common(names: Sequence[str]) -> str:
    """What names begin with, all of them."""
    return "".join(
        letters[0] for letters in itertools.takewhile(lambda ls: len(set(ls)) == 1, zip(*names, strict=False))
    )


def _described(volume: Volume, low: float, high: float) -> str:
    voxels = " x ".join(map(str, volume.grid.shape))
    return f"{voxels} voxels of {volume.quantity}, {low:.4g} to {high:.4g} {volume.unit}"
