"""Volumes whose files are gone, as after a crash that took the temporary folder: those with a recipe are made again."""

from collections.abc import Generator
from typing import Any

import bpy

from ..core.errors import InputError, warn
from ..core.progress import Progress, part_of
from .blender import jobs, storage
from .phantoms import phantoms
from .scanner import maps
from .volumes import volumes


def missing(scene: bpy.types.Scene) -> tuple[list[bpy.types.Object], list[bpy.types.Object]]:
    """A scene's volumes whose files are missing: phantoms and maps, which can be made again, and the others."""
    gone = set(storage.missing_volumes())
    found = [item for item in volumes.volume_objects(scene) if item.data in gone]
    phantom = {item: phantoms.owning_phantom(item) for item in found}
    known = [item for item in found if phantom[item] is not None or maps.can_be_made_again(scene, item)]
    again = dict.fromkeys(phantom[item] or item for item in known)
    return list(again), [item for item in found if item not in known]


def remaking(scene: bpy.types.Scene) -> jobs.Job:
    """The job that makes the volumes with a recipe again, with which the others are named in a warning."""
    again, others = missing(scene)
    made: list[tuple[str, jobs.Job]] = []
    for item in again:
        try:
            job = (
                phantoms.update_phantom_job(item)
                if phantoms.settings_of(item) is not None
                else maps.remake_map_job(scene, item)
            )
            made.append((item.name, job))
        except InputError as error:
            warn(f"{item.name}: {error}")
    if others:
        warn(what_to_do(others))
    if not made:
        raise InputError("no phantom or map misses its files, or none can be made again")

    def work(progress: Progress) -> list[Any]:
        return [job.work(part_of(progress, k, len(made)) or progress) for k, (_, job) in enumerate(made)]

    def finish(results: list[Any]) -> Generator[None, None, str]:
        for (_, job), result in zip(made, results, strict=True):
            job.finish(result)
            yield
        return f"Made {', '.join(name for name, _ in made)} again"

    return jobs.Job("Making volumes again", work, finish)


def what_to_do(others: list[bpy.types.Object]) -> str:
    """What the user can do about volumes without a recipe, in one line."""
    return f"{', '.join(item.name for item in others)}: find the voxel files in a folder, or import again"


def after_load(*_: Any) -> None:
    """Say which files are missing, and what to do."""
    for scene in bpy.data.scenes:
        again, others = missing(scene)
        for found, todo in ((again, "press Make Again"), (others, "Find Missing Volume Files, or import again,")):
            if found:
                names = ", ".join(item.name for item in found)
                print(f"mphDRR: the voxel files of {names} are missing: {todo} in the Phantom panel")
