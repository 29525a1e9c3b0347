"""Measured counts of a real or another simulator's scanner become a run of the scene's scanner."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy

from ...core import InputError, ProjectionRun
from ...core.geometry.system import chosen_modules
from ...core.progress import Progress, stages_of
from ...core.runs.measured import recipe_counts
from ...core.runs.mosaic import caption
from ..blender import jobs
from ..phantoms import phantoms
from ..pictures import images
from ..scanner import scanner
from . import rendering, runs

_OF_FRAMES = (
    *("detector.rows", "detector.columns", "detector.plane", "detector.magnification", "detector.pitch"),
    *("frames.times", "frames.starts"),
)


def importing(context: bpy.types.Context, paths: list[Path], given: Mapping[str, Any]) -> jobs.Job:
    """The job that reads measured counts as the run of the scene's scanner.

    `given` are entries of a recipe: of its table ``counts``, the time, the pixel size, the modules. The rest of the model,
    such as isotope, aperture and attenuation, which a reconstruction needs, is the panel's. Raises InputError where there
    is no scanner.
    """
    if not paths:
        raise InputError("no file given: set filepath to a file with counts")
    scene = context.scene
    collection = scanner.required_scanner(scene)
    recipe = runs.panel_recipe(scene)
    if (mu := rendering.attenuating(context, recipe)) is not None:
        phantoms.require_current(mu)
    recipe = recipe.updated(
        {**dict.fromkeys(_OF_FRAMES), "model.time": None, "attenuation.object": mu and mu.name}
        | {"model.kind": "emission", "counts.files": [str(path) for path in paths]}
        | dict(given)
    )
    system = chosen_modules(scanner.read_scanner(collection), recipe["system.modules"], "modules")
    path, display = rendering.run_path(scene), scene.mphdrr_display.display()
    scene_uid, scanner_uid = scene.session_uid, collection.session_uid

    def work(progress: Progress) -> tuple[ProjectionRun, images.Pictures]:
        stages = stages_of(progress)
        run = recipe_counts(recipe, system, stages)
        return run, rendering.kept(run, path, display, stages)

    def finish(result: tuple[ProjectionRun, images.Pictures]) -> jobs.Finishing:
        run, made = result
        scene = jobs.require_scene(scene_uid, "the projections are")
        owner = jobs.find_by_uid(bpy.data.collections, scanner_uid)
        state = runs.state_of(system, run.recipe, None, None) | {"measured": caption(run)}
        images.show_below((yield from rendering.storing(scene, run, path, state, owner, made)), bpy.context)
        return (
            f"Imported {float(run.projections.sum(dtype=float)):.6g} counts of {len(run.views)} modules: {caption(run)}"
        )

    return jobs.Job("Importing counts", work, finish, lambda: path.unlink(missing_ok=True))
