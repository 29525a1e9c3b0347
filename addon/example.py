"""The example: the bundled scanner around a Derenzo phantom, projected and shown, in one step."""

from typing import Any

import bpy
import numpy as np
from mathutils import Euler

from ..core.geometry.frames import euler_pose
from ..core.progress import Progress, stages_of
from ..core.runs.files import write_run
from ..core.runs.recipe import Recipe
from ..core.runs.run_recipe import run_recipe
from ..core.workbook import read_system
from . import images, jobs, phantoms, rendering, runs, scanner, studio
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
    scene_name, path, display = scene.name, rendering.run_path(scene), scene.mphdrr_display.display()

    def work(progress: Progress) -> Any:
        stages = stages_of(progress)
        stored = adding.work(progress)
        (run,) = run_recipe(recipe, system, stages=stages)
        stages("writing the run file")
        write_run(run, path)
        return stored, run, images.pictures(run, display, stages("storing"))

    def finish(result: Any) -> jobs.Finishing:
        stored, run, made = result
        scene = bpy.data.scenes[scene_name]
        mosaic = yield from images.storing(run, display, made)
        collection = scanner.build_scanner(scene, system)
        yield None
        adding.finish(stored)
        yield None
        rendering.place(scene, run, collection)
        runs.add(scene, run, path, rendering.taken_over(scene, run, bpy.context.object), collection)
        _hide_startup(scene)
        studio.light(scene)
        _look(bpy.context)
        images.show_below(mosaic, bpy.context)
        return f"Loaded the example: {len(system)} modules and what they see of a Derenzo phantom"

    return jobs.Job("Loading the example", work, finish, lambda: path.unlink(missing_ok=True))


def _hide_startup(scene: bpy.types.Scene) -> None:
    """Hide what Blender's own startup file has in the scene, and look through a module instead of its camera."""
    for name in _STARTUP:
        item = scene.objects.get(name)
        if item is not None:
            item.hide_viewport = item.hide_render = True
            if scene.camera == item:
                scene.camera = scanner.modules(scanner.required_scanner(scene))[0]


def _look(context: bpy.types.Context) -> None:
    """Turn the largest 3D view to the scanner."""
    areas = [a for window in context.window_manager.windows for a in window.screen.areas if a.type == "VIEW_3D"]
    if areas:
        view = max(areas, key=lambda a: a.width * a.height).spaces.active.region_3d
        if view is not None:
            view.view_perspective, view.view_rotation = "PERSP", _VIEW.to_quaternion()
            view.view_location, view.view_distance = (60.0, 30.0, 0.0), 0.85 * view.view_distance  # beside the sidebar
