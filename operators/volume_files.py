"""Files of voxels: remove those that nothing needs, find those that are missing."""

from __future__ import annotations

import bpy
from bpy.props import StringProperty

from ..addon import ids, storage
from ..addon.reports import run_reported


class MPHDRR_OT_clean_volume_files(bpy.types.Operator):
    bl_idname = ids.CLEAN_VOLUME_FILES
    bl_label = "Clean Up Volume Files"
    bl_description = "Remove the files of voxels in this .blend's folder that none of its volumes needs any more"
    bl_options = {"REGISTER"}

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        unused = storage.unused_volumes()
        if not unused:
            return self.execute(context)
        return context.window_manager.invoke_confirm(
            self, event, title=f"Remove {storage.summary(unused)}?", confirm_text="Remove", icon="WARNING",
            message="Neither Undo nor other .blend files that use this folder will find them again.",
        )  # fmt: skip

    def execute(self, context: bpy.types.Context) -> set[str]:
        return run_reported(self, storage.remove_unused)


class MPHDRR_OT_find_volume_files(bpy.types.Operator):
    """``bpy.ops.mphdrr.find_volume_files(directory="...")``."""

    bl_idname = ids.FIND_VOLUME_FILES
    bl_label = "Find Missing Volume Files"
    bl_description = "Look for the missing files of voxels, by their names, in a folder and all below it"
    bl_options = {"REGISTER", "UNDO"}

    directory: StringProperty(name="Folder", description="Where to look", subtype="DIR_PATH", options={"SKIP_SAVE"})

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        return run_reported(self, lambda: storage.relocate(self.directory))
