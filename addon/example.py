"""Examples: the bundled scanner around a phantom, projected by it or by X-ray tubes beside it, in one step."""

from typing import Any

import bpy
import numpy as np
from mathutils import Euler

from ..core import Recipe, euler_pose, read_system, run_recipe, xray_ring
from ..core.example import EULER_DEGREES, EXAMPLE
from ..core.geometry.scanner import Scanner
from ..core.progress import Progress, stages_of
from ..core.runs.display import Display
from .blender import ids, jobs, objects
from .figures import studio
from .phantoms import phantom_properties, phantoms
from .pictures import images
from .runs import rendering, runs
from .scanner import collimators, following, scanner, selection

_VOXELS, _PIXELS = 140, 128  # voxels at most half of the reconstruction's
# Module that is active, direction of the view, and radius shown, mm: the opening of the rings, with the phantom a third of
# the view's height; and a tube whose panel is behind the torso, so that both are seen.
_SHOWN = {False: (15, Euler((1.12, 0.0, 1.15)), 104.0), True: (18, Euler((1.2, 0.0, 0.79)), 600.0)}
_OPACITY = 0.3  # of modules in the solid view, for what is behind them
_CUT = (0.32, 0.67, 0.47)  # places of the torso's slices, as shares of its grid: its heart is in front of all three
EXAMPLES = (
    ("DERENZO", "Derenzo Phantom", "What 80 modules see of a Derenzo phantom"),
    ("XRAY", "X-ray Inside SPECT", "CT by 24 X-ray tubes above the modules, SPECT with it, dose"),
)
"""Identifier, label and description of each example."""
_RING: dict[str, Any] = {
    "source_radius": 600, "panel_radius": 480, "panel_size": (864, 648), "shape": (96, 128), "kvp": 120, "mas": 0.5,
}  # fmt: skip
"""X-ray ring with panels so wide that each source sees the whole torso, with all of its grid before the panels."""
_XRAY_SETTINGS: dict[str, dict[str, Any]] = {
    "mphdrr_projections": {"hole": "POINT", "pixel_points": 4, "width": 48, "height": 48},
    "mphdrr_reconstruction": {"method": "TV", "fitted": "TV", "weight": 0.5, "voxels": 56, "spacing": 8.0,
                              "center": (35.0, -30.0, -30.0)},  # mm: that of the torso, whose heart is at the isocentre
    "mphdrr_display": {"planes": "ACTIVE", "plane_at_detector": True},
    "mphdrr_geometry": {"show_frustums": True},
}  # fmt: skip
"""Settings for SPECT of the torso in seconds, by ideal holes, for the CT before it, and for a radiograph on its panel."""
_STARTUP = ("Cube", "Light", "Camera")


def example_job(context: bpy.types.Context, of_xrays: bool = False, replace: bool = False) -> jobs.Job:
    """Return the job that puts an example into the context's scene and shows it: the first of `EXAMPLES`, or that of X rays.

    With `replace`, it also replaces a changed example.
    """
    scene, pinholes = context.scene, read_system(EXAMPLE)
    system: Scanner = xray_ring(**_RING) if of_xrays else pinholes
    kind, name = ("torso", "Cardiac Torso") if of_xrays else ("derenzo", "Derenzo")
    pose = np.eye(4) if of_xrays else euler_pose(*np.deg2rad(EULER_DEGREES))
    # Few modules see activity beside their field of view: a reconstruction would show bright voxels at the field's edge.
    removed = dict.fromkeys(("liver", "lung", "body"), 0.0) if of_xrays else {}
    settings = phantom_properties.plain_settings(kind, voxels=_VOXELS, **removed)
    adding = phantoms.add_phantom_job(settings, name, pose, attenuation=of_xrays)
    entries: dict[str, Any] = {"system.file": str(EXAMPLE), "detector.rows": _PIXELS, "detector.columns": _PIXELS}
    if of_xrays:
        entries = {"model.kind": "spectral", "volume.energy": settings.phantom().mu_energy, "noise.seed": 1}
    recipe = rendering.with_settings(Recipe(entries), settings, pose)
    scene_uid, path = scene.session_uid, rendering.new_run_path(scene)
    display = Display("grey", "log") if of_xrays else scene.mphdrr_display.display()

    def work(progress: Progress) -> Any:
        """Voxelize the phantom and project it; return the stored volumes, the run and its pictures."""
        stages = stages_of(progress)
        stored_volumes = adding.work(progress)
        (run,) = run_recipe(recipe, system, stored_volumes[-1].volume, stages=stages)
        return stored_volumes, run, rendering.write_and_draw(run, path, display, stages)

    def finish(result: Any) -> jobs.Finishing:
        """Put scanner, phantom and run into the scene, and return the line to report."""
        stored_volumes, run, pictures = result
        scene = jobs.require_scene(scene_uid, "the projections are")
        if of_xrays:
            scene.mphdrr_display.colors, scene.mphdrr_display.scale = "GREY", "LOG"
        mosaic = yield from images.store_images(run, pictures)
        collection = scanner.build_scanner(scene, pinholes, replace=replace)
        yield None
        if of_xrays:
            collection = scanner.build_scanner(scene, system, "X-ray", replace=replace)
            yield None
        adding.finish(stored_volumes)
        item = bpy.context.object
        yield None
        rendering.show_planes(scene, run, collection)
        projected = phantoms.with_children(item)[-1]
        runs.add_run(scene, run, path, rendering.adopt_settings(scene, run, projected), collection)
        for group, values in _XRAY_SETTINGS.items() if of_xrays else ():
            for setting, value in values.items():
                setattr(getattr(scene, group), setting, value)
        studio.light(scene)
        images.show_below(mosaic, bpy.context)
        yield None  # the 3D view gets its new height
        _show(scene, collection, item, projected)
        sources = "X-ray tubes" if of_xrays else "modules"
        return f"Loaded the example: {len(system)} {sources} and what they see of a {name} phantom"

    return jobs.Job("Loading the example", work, finish, lambda: path.unlink(missing_ok=True))


def _show(
    scene: bpy.types.Scene, collection: bpy.types.Collection, item: bpy.types.Object, projected: bpy.types.Object
) -> None:
    """Show an example's phantom between dimmed modules, one of which is active; nothing is selected, no lamp in the way."""
    of_xrays = item != projected
    number, rotation, reach = _SHOWN[of_xrays]
    for part in ("COLLIMATOR", "CRYSTAL"):
        collimators.part_material(part).diffuse_color[3] = _OPACITY
    for lamp in [lamp for studio_ in objects.collections_named(scene, ids.STUDIO) for lamp in studio_.objects]:
        lamp.hide_viewport = True  # they light renders, and Home frames the scanner
    for startup in filter(None, map(scene.objects.get, _STARTUP)):  # Blender's own startup file's
        startup.hide_viewport = startup.hide_render = True
        if scene.camera == startup:
            scene.camera = scanner.modules(collection)[0]
    item.select_set(False)
    item.mphdrr_volume.look = "SHELL"
    if of_xrays:
        projected.mphdrr_volume.look = "CUT"
        projected.mphdrr_volume.slices = [round(share * _VOXELS) for share in _CUT]
    with following.writing():
        selection.activate_in_list(scene, scanner.module(collection, number))
    scanner.set_up_scene(scene, collection, rotation.to_quaternion(), reach)
