"""Recovery of volumes whose files are gone, as after a crash that took the temporary folder, by making them again."""

from collections.abc import Generator
from typing import Any

import bpy

from ..core.errors import InputError, warn
from ..core.progress import Progress, part_of
from .blender import jobs, storage
from .phantoms import phantoms
from .scanner import maps
from .volumes import volumes


def missing_volumes(scene: bpy.types.Scene) -> tuple[list[bpy.types.Object], list[bpy.types.Object]]:
    """Return a scene's volumes whose files are missing: phantoms and maps, which can be made again, and all others."""
    missing = set(storage.missing_volumes())
    items = [item for item in volumes.volume_objects(scene) if item.data in missing]
    phantom_of = {item: phantoms.owning_phantom(item) for item in items}
    remakable = [item for item in items if phantom_of[item] is not None or maps.can_be_made_again(scene, item)]
    to_remake = dict.fromkeys(phantom_of[item] or item for item in remakable)
    return list(to_remake), [item for item in items if item not in remakable]


def remake_job(scene: bpy.types.Scene) -> jobs.Job:
    """Return the job that makes phantoms and maps without files again; a warning names all other volumes without files."""
    to_remake, irreplaceable = missing_volumes(scene)
    named_jobs: list[tuple[str, jobs.Job]] = []
    for item in to_remake:
        try:
            is_phantom = phantoms.settings_of(item) is not None
            job = phantoms.update_phantom_job(item) if is_phantom else maps.remake_map_job(scene, item)
            named_jobs.append((item.name, job))
        except InputError as error:
            warn(f"{item.name}: {error}")
    if irreplaceable:
        warn(advice(irreplaceable))
    if not named_jobs:
        raise InputError("no phantom or map misses its files, or none can be made again")

    def work(progress: Progress) -> list[Any]:
        """Do the work of each job, and return the results in order."""
        return [job.work(part_of(progress, k, len(named_jobs)) or progress) for k, (_, job) in enumerate(named_jobs)]

    def finish(results: list[Any]) -> Generator[None, None, str]:
        """Put the results of the jobs into the scene one by one, and return the line to report."""
        for (_, job), result in zip(named_jobs, results, strict=True):
            job.finish(result)
            yield
        return f"Made {', '.join(name for name, _ in named_jobs)} again"

    return jobs.Job("Making volumes again", work, finish)


def advice(items: list[bpy.types.Object]) -> str:
    """Return advice, in a line, on volumes without settings whose files are missing."""
    return f"{', '.join(item.name for item in items)}: find the voxel files in a folder, or import again"


def after_load(*_: Any) -> None:
    """Print which files are missing, and what the user can do."""
    for scene in bpy.data.scenes:
        to_remake, to_find = missing_volumes(scene)
        for items, action in (
            (to_remake, "press Make Again"),
            (to_find, "Find Missing Volume Files, or import again,"),
        ):
            if items:
                names = ", ".join(item.name for item in items)
                print(f"mphDRR: the voxel files of {names} are missing: {action} in the Phantom panel")
