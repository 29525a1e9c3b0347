"""The example: the bundled scanner around a Derenzo phantom, projected and shown, in one step."""

from collections.abc import Generator
from typing import Any

import bpy
import numpy as np
from mathutils import Euler

from ..core.geometry.frames import euler_pose
from ..core.progress import Progress, part_of
from ..core.runs.files import write_run
from ..core.runs.recipe import Recipe
from ..core.runs.run_recipe import run_recipe
from ..core.workbook import read_system
from . import images, jobs, phantoms, rendering, scanner
from .cli.demo import EULER_DEGREES, EXAMPLE
from .phantom_properties import plain_settings

_VOXELS, _PIXELS = 128, 128
_VIEW = Euler((1.05, 0.0, 0.95))  # from above, into the opening of the rings
_STARTUP = ("Cube", "Light", "Camera")


def example_job(context: bpy.types.Context) -> jobs.Job:
    """The job that puts the example into the context's scene and shows it."""
    scene, system = context.scene, read_system(EXAMPLE)
    pose = euler_pose(*np.deg2rad(EULER_DEGREES))
    adding = phantoms.adding(plain_settings("derenzo", voxels=_VOXELS), "Derenzo", pose)
    detector = {"detector.rows": _PIXELS, "detector.columns": _PIXELS}
    placed = {"phantom.kind": "derenzo", "phantom.euler_degrees": EULER_DEGREES, "phantom.voxels": _VOXELS}
    recipe = Recipe({"system.file": str(EXAMPLE), **placed, **detector})
    scene_name, path = scene.name, rendering.run_path(scene)

    def work(progress: Progress) -> Any:
        stored = adding.work(part_of(progress, 0, 2) or progress)
        (run,) = run_recipe(recipe, system, stages=lambda stage: part_of(progress, 1, 2) or progress)
        write_run(run, path)
        return stored, run

    def finish(result: Any) -> Generator[None, None, str]:
        stored, run = result
        scene = bpy.data.scenes[scene_name]
        collection = scanner.build_scanner(scene, system)
        adding.finish(stored)
        yield
        mosaic = yield from rendering.storing(scene, run, path, collection)
        _hide_startup(scene)
        images.show_below(mosaic, bpy.context)
        scanner.set_up_scene(scene, collection, _VIEW.to_quaternion())
        return f"Loaded the example: {len(system)} modules and what they see of a Derenzo phantom"

    return jobs.Job("Loading the example", work, finish)


def _hide_startup(scene: bpy.types.Scene) -> None:
    """Hide what Blender's own startup file has in the scene, and look through a module instead of its camera."""
    for name in _STARTUP:
        item = scene.objects.get(name)
        if item is not None:
            item.hide_viewport = item.hide_render = True
            if scene.camera == item:
                scene.camera = scanner.modules(scanner.required_scanner(scene))[0]
