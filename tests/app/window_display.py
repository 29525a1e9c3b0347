"""Projections in the window: a tile is clicked, a module is selected; leaves planes, mosaic and the frame of module 55.

Arguments after ``--``: the workbook, the file for what was seen.
"""

import json
import subprocess
import sys
import traceback
from pathlib import Path

import bpy
import numpy as np
from mathutils import Euler

workbook, result_file = (Path(word) for word in sys.argv[sys.argv.index("--") + 1 :][:2])
bpy.context.preferences.view.show_splash = False
seen: dict[str, object] = {"ok": False}


def editor(kind: str):
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == kind), key=lambda a: a.width)
    return window, area, next(r for r in area.regions if r.type == "WINDOW")


def project() -> None:
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects.remove(bpy.data.objects[name])
    bpy.ops.mphdrr.import_geometry(filepath=str(workbook))
    bpy.ops.mphdrr.add_derenzo(voxels=64)
    bpy.ops.mphdrr.render_projections(width=64, height=64)
    window, area, region = editor("VIEW_3D")
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.mphdrr.show_projections()
    view = area.spaces.active.region_3d
    view.view_distance, view.view_rotation = 620, Euler((1.05, 0, 0.95)).to_quaternion()


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
    seen["planes"] = sum(not o.hide_viewport for o in bpy.data.objects if o.mphdrr_module.part == "PLANE")
    seen["ok"] = True


def step(steps=iter((project, click, select, finish))) -> float | None:
    try:
        next(steps)()
    except StopIteration:
        return None
    except Exception:
        seen["error"] = traceback.format_exc()
    result_file.write_text(json.dumps(seen))
    return None if "error" in seen else 3.0


bpy.app.timers.register(step, first_interval=1.5)
