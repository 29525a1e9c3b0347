"""The example in the window, with a tile clicked and a module selected; leaves the frame of module 55 around its tile.

Argument after ``--``: the file for what was seen.
"""

import json
import subprocess
import sys
import time
import traceback
from pathlib import Path

import bpy
import numpy as np

result_file = Path(sys.argv[sys.argv.index("--") + 1])
bpy.context.preferences.view.show_splash = False
seen: dict[str, object] = {"ok": False}


def editor(kind: str):
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == kind), key=lambda a: a.width)
    return window, area, next(r for r in area.regions if r.type == "WINDOW")


def load() -> None:
    """Press the empty panel's first button, and measure until its job is done."""
    started = time.monotonic()
    window, area, region = editor("VIEW_3D")
    area.spaces.active.show_region_ui = True
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.mphdrr.load_example("INVOKE_DEFAULT")

    def look() -> float | None:
        if len(window.modal_operators):
            return 0.1
        seen["seconds"] = time.monotonic() - started
        sidebar = next(region for region in area.regions if region.type == "UI")
        sidebar.active_panel_category = "mphDRR"
        bpy.app.timers.register(step, first_interval=8.0)  # drawn in software, slowly
        return None

    bpy.app.timers.register(look, first_interval=0.2)


def place_of(number: int) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of a module's tile on the screen."""
    window, area, region = editor("IMAGE_EDITOR")
    image = area.spaces.active.image
    tiles = image["mphdrr_tiles"].to_dict()
    row, column = np.reshape(tiles["corners"], (-1, 2))[tiles["numbers"].index(number)]
    width, height = image.size
    ends = []
    for down, across in ((row, column), (row + tiles["tile"][0], column + tiles["tile"][1])):
        x, y = region.view2d.view_to_region(across / width, 1 - down / height, clip=False)
        ends += [region.x + x, window.height - region.y - y]
    return tuple(ends)


def active() -> list[int]:
    """The numbers of the active module and of the one in the panel's list."""
    scene = bpy.context.scene
    item = bpy.context.view_layer.objects.active
    listed = scene.mphdrr_geometry.scanner.all_objects[scene.mphdrr_geometry.active_index]
    return [item.mphdrr_module.number, listed.mphdrr_module.number]


def click() -> None:
    left, top, right, bottom = place_of(30)
    place = [str(round(left + 0.5 * (right - left))), str(round(top + 0.7 * (bottom - top)))]
    subprocess.run(["xdotool", "mousemove", *place], check=True)
    subprocess.run(["xdotool", "click", "1"], check=True)


def select() -> None:
    seen["clicked"] = active()
    plane = bpy.data.objects["Projection 55"]
    bpy.ops.object.select_all(action="DESELECT")
    plane.select_set(True)
    bpy.context.view_layer.objects.active = plane


def finish() -> None:
    seen["selected"] = active()
    seen["tile"], seen["other"] = place_of(55), place_of(31)
    seen["tiles"] = [place_of(number) for number in range(1, 81)]
    seen["hidden"] = sorted(o.name for o in bpy.data.objects if o.hide_viewport)
    seen["planes"] = sum(not o.hide_viewport for o in bpy.data.objects if o.mphdrr_module.part == "PLANE")
    seen["ok"] = True


STEPS = iter((load, click, select, finish))


def step() -> float | None:
    action = next(STEPS)
    try:
        action()
    except Exception:
        seen["error"] = traceback.format_exc()
    result_file.write_text(json.dumps(seen))
    return None if "error" in seen or action in (load, finish) else 3.0


bpy.app.timers.register(step, first_interval=1.5)
