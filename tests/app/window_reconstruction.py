"""Counts of a few modules are reconstructed in the window: what is seen while it runs, then finished early.

Argument after ``--``: the file for what was seen.
"""

import json
import sys
import traceback
from pathlib import Path

import bpy

result_file = Path(sys.argv[sys.argv.index("--") + 1])
bpy.context.preferences.view.show_splash = False
WORKBOOK = str(Path(bpy.utils.user_resource("EXTENSIONS")) / "user_default/mphdrr/examples/dc-spect-80.xlsx")
seen: dict = {"ok": False, "iterations": []}


def view(kind: str = "VIEW_3D"):
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == kind), key=lambda a: a.width)
    return {"window": window, "area": area, "region": next(r for r in area.regions if r.type == "WINDOW")}


def call(operator, **settings) -> None:
    with bpy.context.temp_override(**view()):
        operator("INVOKE_DEFAULT", **settings)


def load() -> None:
    view()["area"].spaces.active.show_region_ui = True
    with bpy.context.temp_override(**view()):
        bpy.ops.mphdrr.import_geometry(filepath=WORKBOOK)
        bpy.ops.mphdrr.add_derenzo(voxels=48)


def prepare() -> None:
    """Only this panel is there, so that all of it is on the screen."""
    sidebar = next(region for region in view()["area"].regions if region.type == "UI")
    sidebar.active_panel_category = "mphDRR"
    ours = [getattr(bpy.types, name) for name in dir(bpy.types) if name.startswith("MPHDRR_PT_")]
    others = [cls for cls in ours if "reconstruction" not in cls.__name__]
    for cls in sorted(others, key=lambda cls: not hasattr(cls, "bl_parent_id")):  # a panel after those in it
        bpy.utils.unregister_class(cls)
    settings = bpy.context.scene.mphdrr_reconstruction
    settings.voxels, settings.spacing, settings.iterations, settings.subsets = 32, 3.0, 20000, 4
    bpy.ops.object.select_all(action="DESELECT")
    for item in bpy.context.scene.objects:
        if item.type == "VOLUME":
            item.hide_set(True)


def render() -> None:
    """Counts, few and quickly."""
    settings = bpy.context.scene.mphdrr_projections
    settings.model, settings.time, settings.width, settings.height = "EMISSION", 600.0, 24, 24
    settings.first, settings.last = 1, 16
    call(bpy.ops.mphdrr.render_projections)


def reconstruct() -> None:
    call(bpy.ops.mphdrr.reconstruct)


def watch() -> None:
    """Until it was seen at two iterations; then Finish Now."""
    known = bpy.context.scene.mphdrr_reconstruction.known
    if known and len(known["objective"]) not in seen["iterations"]:
        seen["iterations"].append(len(known["objective"]))
        seen["while"] = bpy.context.scene.mphdrr_reconstruction.volume.name
    if len(seen["iterations"]) < 2:
        STEPS.insert(0, watch)
        return
    bpy.ops.mphdrr.finish_job()


def finish() -> None:
    scene = bpy.context.scene
    known = scene.mphdrr_reconstruction.known
    seen["title"], seen["scores"] = known["title"], [name for name, _ in known["scores"]]
    seen["active"], seen["volume"] = bpy.context.object.name, scene.mphdrr_reconstruction.volume.name
    seen["image"] = view("IMAGE_EDITOR")["area"].spaces.active.image.name
    place = view("IMAGE_EDITOR")["area"]
    seen["editor"] = [place.x, view()["window"].height - place.y - place.height, place.width, place.height]
    seen["ok"] = True


STEPS = [load, prepare, render, reconstruct, watch, finish]


def step() -> float | None:
    is_busy = bool(bpy.context.window_manager.windows[0].modal_operators)
    if is_busy and STEPS[0] is not watch:
        return 0.3
    action = STEPS.pop(0)
    try:
        action()
    except Exception:
        seen["error"] = traceback.format_exc()
    result_file.write_text(json.dumps(seen))
    return None if "error" in seen or not STEPS else 0.5


bpy.app.timers.register(step, first_interval=1.5)
