"""File > Export > Volume: the active volume, where it stands in the world, for other programs."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path
from typing import Any

import bpy
from bpy.props import StringProperty

from ..addon import ids, jobs, phantoms, storage, vdb, volumes
from ..core.errors import InputError
from ..core.progress import Progress
from ..core.volumes.volume_files import VOLUME_FORMATS, write_volume

_SUFFIXES = (".vdb", *VOLUME_FORMATS)


class MPHDRR_OT_export_volume(jobs.JobOperator, bpy.types.Operator):
    """``bpy.ops.mphdrr.export_volume(filepath="heart.vdb")``."""

    bl_idname = ids.EXPORT_VOLUME
    bl_label = "Export Volume"
    bl_description = (
        "Write every voxel of the active volume, where it stands in the world, for other programs; the name's ending "
        "chooses: " + ", ".join(_SUFFIXES)
    )

    filepath: StringProperty(name="File", description="File to write", subtype="FILE_PATH", options={"SKIP_SAVE"})
    filter_glob: StringProperty(default=";".join(f"*{s}" for s in _SUFFIXES), options={"HIDDEN"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return volumes.poll_volume(cls, context)

    def ask(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str] | None:
        if self.filepath:
            return None
        self.filepath = bpy.path.clean_name(context.object.name) + _SUFFIXES[0]
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def job(self, context: bpy.types.Context) -> jobs.Job:
        item = context.object
        if not self.filepath or not self.filepath.lower().endswith(_SUFFIXES):
            raise InputError(f"{self.filepath or 'no file given'}: expected a name ending in {', '.join(_SUFFIXES)}")
        path, read = storage.absolute(self.filepath), volumes.reader(item)
        if path.resolve() == volumes.file_of(item).resolve():
            raise InputError(f"{path}: is the scene's own file of {item.name!r}; choose another name")
        phantoms.require_current(item)
        recipe: dict[str, Any] = {"object": item.name}
        phantom = phantoms.settings_of(item)
        if phantom is not None:
            recipe |= phantom.recipe()
        if item.data.is_sequence:
            recipe |= {"frame": context.scene.frame_current, "state": volumes.state_text(item)}

        def work(progress: Progress) -> Path:
            progress(0, 2)
            volume = read()
            progress(1, 2)
            if path.suffix.lower() == ".vdb":
                vdb.write_vdb(volume, path, recipe)
            else:
                write_volume(volume, path)
            progress(2, 2)
            return path

        def finish(written: Path) -> Generator[None, None, str]:
            yield
            return f"Wrote {written}"

        return jobs.Job("Exporting a volume", work, finish)


def draw_menu(self: bpy.types.Menu, context: bpy.types.Context) -> None:
    """The entry of File > Export."""
    self.layout.operator_context = "INVOKE_DEFAULT"
    self.layout.operator(ids.EXPORT_VOLUME, text="Volume (.vdb, .nii, .nrrd, ...)")
