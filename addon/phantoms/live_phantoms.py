"""Phantoms follow their settings: small ones at once, others, in a window, once the settings rest; large ones on Update."""

import bpy

from ...core.errors import InputError
from ...core.recording import recorded_warnings
from ..blender import jobs, timers, windows
from . import phantoms

QUICK_VOXELS = 64**3
"""Up to so many voxels, of all its states, a phantom is made again at every edit."""
RESTED_VOXELS = 128**3
"""Up to so many it is made again by a job when its settings rest."""
_REST = 0.5  # s without an edit
_edited = ""  # name of the phantom that `_rested` is about


def settings_changed(item: bpy.types.ID) -> None:
    """A phantom's setting was edited: make its voxels again, or mark them as outdated and say what is wrong."""
    global _edited
    settings = phantoms.settings_of(item) if isinstance(item, bpy.types.Object) else None
    if settings is None:  # it is being added
        return
    properties = item.mphdrr_volume
    properties.outdated, properties.message = True, ""
    with recorded_warnings() as caught:
        try:
            make = phantoms.remaking(item)
            if settings.n_voxels <= QUICK_VOXELS and not jobs.is_running():
                phantoms.replace(item, make(None))
            else:
                phantoms.update_outline(item)
        except InputError as error:
            properties.message = str(error)
            return
    properties.message = next(iter(caught), "")
    if properties.outdated and settings.n_voxels <= RESTED_VOXELS and windows.has_window():
        _edited = item.name
        timers.cancel(_rested)
        timers.schedule(_rested, _REST)


def _rested() -> float | None:
    """Press Update Phantom for the phantom that was edited last; later, if a job is running."""
    if jobs.is_running() or bpy.app.is_job_running("RENDER"):
        return _REST
    item = bpy.data.objects.get(_edited)
    if item is not None and phantoms.settings_of(item) is not None and item.mphdrr_volume.outdated:
        window = bpy.context.window_manager.windows[0]
        with bpy.context.temp_override(window=window, object=item):
            bpy.ops.mphdrr.update_phantom("INVOKE_DEFAULT")
    return None
