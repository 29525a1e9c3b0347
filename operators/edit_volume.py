"""Operators on volumes: slices, attenuation and dose of the active one, files to clean up, to collect or to find again."""

import bpy
from bpy.props import EnumProperty, FloatProperty, FloatVectorProperty, StringProperty

from ..addon import preferences, recovery
from ..addon.blender import choices, decimals, jobs, storage
from ..addon.blender.reports import Need, Reported, ask_to_remove, needs
from ..addon.volumes import slices, volume_import, volume_materials, volumes
from ..core.errors import InputError
from ..core.physics.isotopes import ISOTOPES


class MPHDRR_OT_add_slices(Reported, bpy.types.Operator):
    """Show an axial, a coronal and a sagittal slice of the active volume as planes that go with it."""

    place: FloatVectorProperty(name="Place", description="Point where the slices meet, as shares of the grid's axes",
                               size=3, min=0.0, max=1.0, default=(0.5, 0.5, 0.5), options={"SKIP_SAVE"})  # fmt: skip

    poll = needs(volumes.ACTIVE)

    def act(self, context: bpy.types.Context) -> str:
        shape = context.object.mphdrr_volume.shape
        index = [min(int(share * n), n - 1) for share, n in zip(self.place, shape, strict=True)]
        return f"Added {len(slices.add_slices(context.object, index))} slices"


class MPHDRR_OT_remove_slices(Reported, bpy.types.Operator):
    """Remove the active volume's slice planes."""

    poll = needs(volumes.ACTIVE)

    def act(self, context: bpy.types.Context) -> None:
        slices.remove_slices(context.object)


def _active(quantity: str, problem: str) -> Need:
    """Return the need of an active volume of a quantity, with the tooltip's text where there is none."""
    return lambda context: volumes.is_volume(item := context.object) and volumes.quantity_of(item) == quantity, problem


class MPHDRR_OT_ct_to_attenuation(jobs.JobOperator, bpy.types.Operator):
    """Make a volume of attenuation coefficients (1/mm) from the active volume of CT numbers; the CT stays."""

    bl_label = "CT to Attenuation"
    dialog = {"confirm_text": "Convert"}

    energy: FloatProperty(
        name="Energy (keV)", description="Tc-99m: 140.5; a CT of 120 kV: about 70", default=140.5, min=10.0, max=1000.0
    )

    poll = needs(_active("hu", "No CT is active: select a volume of CT numbers (hu)"))

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return volume_import.attenuation_job(context.object, decimals.typed(self.energy))


class MPHDRR_OT_add_dose_map(jobs.JobOperator, bpy.types.Operator):
    """Make a volume of the absorbed dose rate (mGy/h) from the active volume of activity, as in water of density 1."""

    isotope: EnumProperty(name="Isotope", description="Isotope that decays",
                          items=choices.items({}, ((name, name, "") for name in ISOTOPES)),
                          default="Tc-99m")  # fmt: skip

    poll = needs(_active("activity", "No activity is active: select a volume of activity"))

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return volume_import.dose_job(context.object, self.isotope)


class MPHDRR_OT_clean_volume_files(Reported, bpy.types.Operator):
    """Remove the files of voxels and runs in this .blend's folder that no volume and no list of runs needs any more."""

    bl_label = "Clean Up Volume Files"
    bl_options = {"REGISTER"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not (unused := storage.unused_volumes()):
            return self.execute(context)
        message = "Neither Undo nor other .blend files that use this folder will find them again."
        return ask_to_remove(self, context, event, f"Remove {storage.summarize_unused(unused)}?", message)

    def act(self, context: bpy.types.Context) -> str:
        return storage.remove_unused()


class MPHDRR_OT_collect_files(Reported, bpy.types.Operator):
    """Copy every outside file that the scene uses, such as its workbook, into the folder beside the .blend, so that both can
    be moved together. Missing files are reported.
    """

    poll = needs((lambda context: bpy.data.filepath, "Save the .blend first: its folder is beside it"))

    def act(self, context: bpy.types.Context) -> str:
        return storage.collect_files()


class MPHDRR_OT_add_looks(Reported, bpy.types.Operator):
    """Put the looks of volumes into the Asset Browser, as a library of their own: dragged onto a volume, a look replaces its
    colours, also on its slices, and the display range stays.
    """

    bl_label = "Looks for Asset Browser"
    bl_options = {"REGISTER"}

    directory: StringProperty(
        name="Folder", description="Folder of the library to write; empty: the extension's own", subtype="DIR_PATH"
    )

    def act(self, context: bpy.types.Context) -> str:
        folder = storage.absolute(self.directory) if self.directory else preferences.own_folder("assets")
        if folder is None:
            raise InputError("no folder given: this is no installed extension, so it has none of its own")
        volume_materials.write_assets(folder)
        libraries = context.preferences.filepaths.asset_libraries
        if not any(storage.absolute(library.path) == folder for library in libraries):
            library = libraries.new(name="mphDRR", directory=str(folder))
            library.import_method = "APPEND"  # gives each volume a copy of the look, with a display range of its own
        return f"Looks are in the Asset Browser's library mphDRR: {folder}"


class MPHDRR_OT_remake_volumes(jobs.JobOperator, bpy.types.Operator):
    """Make the phantoms and maps again whose files of voxels are missing, as after a crash; they stay where they are."""

    bl_label = "Make Missing Volumes Again"

    poll = needs((lambda context: recovery.missing_volumes(context.scene)[0], "No phantom or map misses its file"))

    def job(self, context: bpy.types.Context) -> jobs.Job:
        return recovery.remake_job(context.scene)


class MPHDRR_OT_find_volume_files(Reported, bpy.types.Operator):
    """Look for the missing files of voxels, by their names, in a folder and all below it."""

    bl_label = "Find Missing Volume Files"

    directory: StringProperty(name="Folder", description="Folder to search", subtype="DIR_PATH", options={"SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def act(self, context: bpy.types.Context) -> str:
        return storage.relocate(self.directory)
