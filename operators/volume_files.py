"""Files of voxels: remove those that nothing needs, find those that are missing."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.props import StringProperty

from ..addon import ids, storage
from ..core.errors import InputError
from ..core.memory import readable_size


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
            self, event, title=f"Remove {_summary(unused)}?", confirm_text="Remove", icon="WARNING",
            message="Neither Undo nor other .blend files that use this folder will find them again.",
        )  # fmt: skip

    def execute(self, context: bpy.types.Context) -> set[str]:
        # Without a window Blender does not keep account of changes.
        if bpy.data.filepath and bpy.data.is_dirty and not bpy.app.background:
            self.report(
                {"ERROR"}, "the .blend has changes that are not saved, and as saved may need these files: save it"
            )
            return {"CANCELLED"}
        unused = storage.unused_volumes()
        summary = _summary(unused)
        try:
            for path in unused:
                path.unlink(missing_ok=True)
        except OSError as error:
            self.report({"ERROR"}, f"{path}: cannot be removed ({error.strerror or error})")
            return {"CANCELLED"}
        self.report({"INFO"}, f"Removed {summary}" if unused else "No file of voxels is unused")
        return {"FINISHED"}


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
        folder = Path(bpy.path.abspath(self.directory))
        try:
            if not self.directory or not folder.is_dir():
                raise InputError(f"{self.directory or 'no folder given'}: expected a folder to look in")
            found, missing = storage.relocate(folder)
        except InputError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if missing:
            self.report({"WARNING"}, f"{folder}: the files of {', '.join(missing)} are not there either")
        if found:
            self.report({"INFO"}, f"Found the files of {', '.join(found)}")
        return {"FINISHED"}


def _summary(files: list[Path]) -> str:
    size = readable_size(sum(path.stat().st_size for path in files))
    return f"{len(files)} unused file{'s' if len(files) != 1 else ''} of voxels ({size})"
