"""Back-projections of the shown run in the scene, as volumes."""

import time
from typing import Any

import bpy

from ...core import Recipe, backproject_run, read_run
from ...core.progress import Progress, stages_of
from ...core.runs.reconstructing import reconstruction_grid
from ..blender import jobs, objects, storage
from ..runs import rendering, runs
from ..volumes import slices, stored_volumes, volumes
from .reconstruction_properties import HOW_LABELS


def backproject_job(context: bpy.types.Context, recipe: Recipe, how: str) -> jobs.Job:
    """Return the job that back-projects the scene's shown run onto the voxels of `recipe`, as a new volume with slices.

    `how` is one of the combinations in `core.perspective.backprojection`. Raises InputError where no run is shown.
    """
    scene, run_item = context.scene, runs.required_run(context.scene, "back-project")
    path, name = rendering.run_file_path(run_item.file), runs.subject_of(run_item)
    folder, uid = storage.folder(), scene.session_uid
    label, start = HOW_LABELS[how], time.perf_counter()

    def work(progress: Progress) -> stored_volumes.StoredVolume:
        """Back-project the run, and store the volume."""
        stages = stages_of(progress)
        stages("reading the run")
        run = read_run(path)
        volume = backproject_run(run, how, grid=reconstruction_grid(run, recipe), stages=stages)
        stages("writing the voxels")
        provenance: dict[str, Any] = {"back_projection_of": name, "how": how, **recipe.tables()}
        return stored_volumes.store_volume(volume, folder, None, provenance)

    def finish(stored: stored_volumes.StoredVolume) -> str:
        """Add the back-projection to the scene, and return the line to report."""
        scene = jobs.require_scene(uid, "the back-projection is")
        item = volumes.add_stored(stored, f"{name} {label}", scene.collection)
        objects.hide(runs.projected_volume(scene))
        volumes.make_active(bpy.context, item)
        slices.add_slices(item)  # as smoke it would be a cloud: few of its voxels are 0
        seconds = time.perf_counter() - start
        return f"Back-projected {item.name!r}: {volumes.range_text(stored.low, stored.high, '1')}, in {seconds:.1f} s"

    return jobs.Job("Back-projecting", work, finish)
