"""Phantoms follow their settings: small ones at once, larger ones in a window after a pause, the largest at Update."""

import bpy

from ...core.errors import InputError
from ...core.recording import recorded_warnings
from ..blender import jobs, timers, windows
from . import phantoms

QUICK_VOXELS = 64**3
"""Largest number of voxels, of all states, with which a phantom is voxelized again at every edit."""
RESTED_VOXELS = 128**3
"""Largest number of voxels with which a job voxelizes a phantom again once its settings rest."""
_PAUSE = 0.5  # s without an edit, after which settings are taken to rest
_edited_name = ""  # name of the phantom that was edited last


def settings_changed(item: bpy.types.ID) -> None:
    """Voxelize a phantom again after an edit of its settings, or mark its voxels as outdated and note what is wrong."""
    global _edited_name
    settings = phantoms.settings_of(item) if isinstance(item, bpy.types.Object) else None
    if settings is None:  # the phantom is being added
        return
    properties = item.mphdrr_volume
    properties.outdated, properties.message = True, ""
    with recorded_warnings() as warnings:
        try:
            voxelize = phantoms.make_voxelizer(item)
            if settings.n_voxels <= QUICK_VOXELS and not jobs.is_running():
                phantoms.replace_voxels(item, voxelize(None))
            else:
                phantoms.update_outline(item)
        except InputError as error:
            properties.message = str(error)
            return
    properties.message = next(iter(warnings), "")
    if properties.outdated and settings.n_voxels <= RESTED_VOXELS and windows.has_window():
        _edited_name = item.name
        timers.cancel(_update_edited)
        timers.schedule(_update_edited, _PAUSE)


def _update_edited() -> float | None:
    """Press Update Phantom for the phantom that was edited last; wait if a job is running."""
    if jobs.is_running() or bpy.app.is_job_running("RENDER"):
        return _PAUSE
    item = bpy.data.objects.get(_edited_name)
    if item is not None and phantoms.settings_of(item) is not None and item.mphdrr_volume.outdated:
        with bpy.context.temp_override(window=bpy.context.window_manager.windows[0], object=item):
            bpy.ops.mphdrr.update_phantom("INVOKE_DEFAULT")
    return None
