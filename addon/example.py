"""The example: the bundled scanner around a Derenzo phantom, projected and shown, in one step."""

from typing import Any

import bpy
import numpy as np
from mathutils import Euler

from ..core import Recipe, euler_pose, read_system, run_recipe
from ..core.example import EULER_DEGREES, EXAMPLE
from ..core.progress import Progress, stages_of
from .blender import jobs
from .figures import studio
from .phantoms import phantom_properties, phantoms
from .pictures import images
from .runs import rendering, runs
from .scanner import scanner

_VOXELS, _PIXELS = 128, 128
_VIEW = Euler((1.05, 0.0, 0.95))  # from above, into the opening of the rings
_STARTUP = ("Cube", "Light", "Camera")


def example_job(context: bpy.types.Context, replace: bool = False) -> jobs.Job:
    """The job that puts the example into the context's scene and shows it; `replace`: also in place of a changed one."""
    scene, system = context.scene, read_system(EXAMPLE)
    pose = euler_pose(*np.deg2rad(EULER_DEGREES))
    settings = phantom_properties.plain_settings("derenzo", voxels=_VOXELS)
    adding = phantoms.adding(settings, "Derenzo", pose)
    detector = {"detector.rows": _PIXELS, "detector.columns": _PIXELS}
    recipe = rendering.of_phantom(Recipe({"system.file": str(EXAMPLE), **detector}), settings, pose)
    scene_uid, path, display = scene.session_uid, rendering.run_path(scene), scene.mphdrr_display.display()

    def work(progress: Progress) -> Any:
        stages = stages_of(progress)
        stored = adding.work(progress)
        (run,) = run_recipe(recipe, system, stored[0].volume, stages=stages)
        return stored, run, rendering.kept(run, path, display, stages)

    def finish(result: Any) -> jobs.Finishing:
        stored, run, made = result
        scene = jobs.scene_again(scene_uid, "the projections are")
        mosaic = yield from images.storing(run, made)
        collection = scanner.build_scanner(scene, system, replace=replace)
        yield None
        adding.finish(stored)
        yield None
        rendering.place(scene, run, collection)
        runs.add(scene, run, path, rendering.taken_over(scene, run, bpy.context.object), collection)
        _hide_startup(scene, collection)
        studio.light(scene)
        images.show_below(mosaic, bpy.context)
        scanner.set_up_scene(scene, collection, _VIEW.to_quaternion())
        return f"Loaded the example: {len(system)} modules and what they see of a Derenzo phantom"

    return jobs.Job("Loading the example", work, finish, lambda: path.unlink(missing_ok=True))


def _hide_startup(scene: bpy.types.Scene, collection: bpy.types.Collection) -> None:
    """Hide what Blender's own startup file has in the scene, and look through a module instead of its camera."""
    for name in _STARTUP:
        item = scene.objects.get(name)
        if item is not None:
            item.hide_viewport = item.hide_render = True
            if scene.camera == item:
                scene.camera = scanner.modules(collection)[0]
