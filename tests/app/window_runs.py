"""Two runs of the example in the window: a module is moved and moved back, the run is rendered again, both are compared.

Argument after ``--``: the file for what was seen.
"""

import importlib
import json
import sys
import time
import traceback
from pathlib import Path

import bpy

result_file = Path(sys.argv[sys.argv.index("--") + 1])
bpy.context.preferences.view.show_splash = False
runs = importlib.import_module("bl_ext.user_default.mphdrr.addon.runs.runs")
seen: dict[str, object] = {"ok": False}


def editor(kind: str):
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == kind), key=lambda a: a.width)
    return {"window": window, "area": area, "region": next(r for r in area.regions if r.type == "WINDOW")}


def call(operator, *arguments, **options) -> None:
    with bpy.context.temp_override(**editor("VIEW_3D")):
        operator(*arguments, **options)


def load() -> None:
    editor("VIEW_3D")["area"].spaces.active.show_region_ui = True
    call(bpy.ops.mphdrr.load_example, "INVOKE_DEFAULT")


def show_sidebars() -> None:
    editor("IMAGE_EDITOR")["area"].spaces.active.show_region_ui = True
    seen["loaded"] = runs.change_lines(bpy.context.scene)


def show_tabs() -> None:
    """Once the sidebars have been drawn."""
    for kind in ("VIEW_3D", "IMAGE_EDITOR"):
        sidebar = next(region for region in editor(kind)["area"].regions if region.type == "UI")
        sidebar.active_panel_category = "mphDRR"


def move() -> None:
    """With the tool, 1 mm up: an undo step."""
    for item in bpy.context.selected_objects:
        item.select_set(False)
    camera = bpy.data.objects["Module 30"]
    camera.select_set(True)
    bpy.context.view_layer.objects.active = camera
    call(bpy.ops.transform.translate, "EXEC_DEFAULT", True, value=(0.0, 0.0, 1.0))


def back() -> None:
    seen["moved"] = runs.change_lines(bpy.context.scene)
    bpy.ops.ed.undo()


def again() -> None:
    seen["undone"] = runs.change_lines(bpy.context.scene)
    bpy.context.scene.mphdrr_projections.runs[0].name = "As imported"
    move()


def render() -> None:
    seen["moved again"] = runs.change_lines(bpy.context.scene)
    started = time.perf_counter()
    for _ in range(1000):
        runs.after_update()
    seen["handler ms"] = time.perf_counter() - started
    call(bpy.ops.mphdrr.render_projections, "INVOKE_DEFAULT", volume=runs.volume_to_render(bpy.context.scene))


def choose() -> None:
    """As a click in the list does."""
    seen["rendered"] = runs.change_lines(bpy.context.scene)
    bpy.context.scene.mphdrr_projections.active_run = 0


def compare() -> None:
    seen["chosen"] = runs.change_lines(bpy.context.scene)
    seen["shown"] = runs.shown(bpy.context.scene).name
    call(bpy.ops.mphdrr.compare_runs, "INVOKE_DEFAULT", other="1")


def finish() -> None:
    seen["runs"] = [item.name for item in bpy.context.scene.mphdrr_projections.runs]
    seen["image"] = editor("IMAGE_EDITOR")["area"].spaces.active.image.name
    place = editor("IMAGE_EDITOR")
    area = place["area"]
    seen["editor"] = [area.x, place["window"].height - area.y - area.height, area.width, area.height]
    seen["ok"] = True


STEPS = [load, show_sidebars, show_tabs, move, back, again, render, choose, compare, finish]


def step() -> float | None:
    if len(bpy.context.window_manager.windows[0].modal_operators):  # a job
        return 0.5
    action = STEPS.pop(0)
    try:
        action()
    except Exception:
        seen["error"] = traceback.format_exc()
    result_file.write_text(json.dumps(seen))
    return None if "error" in seen or not STEPS else 4.0


bpy.app.timers.register(step, first_interval=1.5)
