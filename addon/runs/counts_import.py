"""Import of measured counts, of a real scanner or another simulator, as a run of the scene's scanner."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy

from ...core import InputError, ProjectionRun
from ...core.geometry.system import chosen_modules
from ...core.progress import Progress, stages_of
from ...core.runs.measured import recipe_counts
from ...core.runs.mosaic import counts_caption
from ..blender import ids, jobs
from ..phantoms import phantoms
from ..pictures import images
from ..scanner import scanner
from . import rendering, runs

_UNSET_KEYS = (
    *("detector.rows", "detector.columns", "detector.plane", "detector.magnification", "detector.pitch"),
    *("frames.times", "frames.starts"),
)


def import_counts_job(context: bpy.types.Context, paths: list[Path], entries: Mapping[str, Any]) -> jobs.Job:
    """Return the job that reads measured counts as a run of the scene's scanner.

    `entries` are recipe entries of the table ``counts``, the time, the pixel size, the modules. The rest of the model, such
    as isotope, aperture and attenuation, which a reconstruction needs, is the panel's. Raises InputError without a scanner.
    """
    if not paths:
        raise InputError("no file given: set filepath to a file with counts")
    scene = context.scene
    collection = scanner.required_scanner(scene)
    recipe = runs.panel_recipe(scene)
    if (mu_item := rendering.attenuating_object(context, recipe)) is not None:
        phantoms.require_current(mu_item)
    recipe = recipe.updated(
        {**dict.fromkeys(_UNSET_KEYS), "model.time": None, "attenuation.object": mu_item and mu_item.name}
        | {"model.kind": "emission", "counts.files": [str(path) for path in paths]}
        | dict(entries)
    )
    system = chosen_modules(scanner.read_scanner(collection), recipe["system.modules"], "modules")
    path, display = rendering.new_run_path(scene), scene.mphdrr_display.display()
    scene_uid, scanner_uid = scene.session_uid, collection.session_uid

    def work(progress: Progress) -> tuple[ProjectionRun, images.Pictures]:
        """Read the counts as a run, write its file, and return it with its pictures."""
        stages = stages_of(progress)
        run = recipe_counts(recipe, system, stages)
        return run, rendering.write_and_draw(run, path, display, stages)

    def finish(result: tuple[ProjectionRun, images.Pictures]) -> jobs.Finishing:
        """Show the run at the scanner's modules, and return the line to report."""
        run, pictures = result
        scene = jobs.require_scene(scene_uid, "the projections are")
        owner = jobs.find_by_uid(bpy.data.collections, scanner_uid)
        state = runs.scene_state(system, run.recipe, None, None) | {"measured": counts_caption(run)}
        images.show_below((yield from rendering.store_and_show(scene, run, path, state, owner, pictures)), bpy.context)
        total = f"{float(run.projections.sum(dtype=float)):.6g} counts of {ids.counted(len(run.views), 'module')}"
        return f"Imported {total}: {counts_caption(run)}"

    return jobs.Job("Importing counts", work, finish, lambda: path.unlink(missing_ok=True))
