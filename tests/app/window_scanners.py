"""Two scanners in the window: a crystal clicked and grabbed by keys and mouse, each with one undo; leaves it being dragged.

Arguments after ``--``: the workbook, the file for what was seen.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import traceback
from pathlib import Path

import bpy
import numpy as np
from bpy_extras.view3d_utils import location_3d_to_region_2d
from mathutils import Matrix, Vector

workbook, result_file = (Path(word) for word in sys.argv[sys.argv.index("--") + 1 :][:2])
bpy.context.preferences.view.show_splash = False
seen: dict[str, object] = {"ok": False}


def viewport():
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == "VIEW_3D"), key=lambda a: a.width)
    region = next(r for r in area.regions if r.type == "WINDOW")
    return window, area, region


def mouse(x: float, y: float, *then: str) -> None:
    """Move the mouse to a place of the 3D view; `then` are further commands of xdotool."""
    window, _, region = viewport()
    place = str(round(region.x + x)), str(round(window.height - region.y - y))
    subprocess.run(["xdotool", "mousemove", *place, *then], check=True)


def keys(*names: str) -> None:
    """Type keys with the mouse in the middle of the 3D view."""
    _, _, region = viewport()
    mouse(region.width // 2, region.height // 2)
    for name in names:
        subprocess.run(["xdotool", "key", "--delay", "60", name], check=True)


def scanner(name: str):
    return bpy.data.collections[name]


def module(name: str, number: int):
    return next(o for o in scanner(name).all_objects if o.mphdrr_module.is_module and o.mphdrr_module.number == number)


def part(name: str, number: int, kind: str):
    return next(o for o in module(name, number).children if o.mphdrr_module.part == kind)


def state() -> dict[str, object]:
    """Where module 30 of A is, and its crystal on it; the panels' scanner, the listed and the active module."""
    camera, crystal = module("A", 30), part("A", 30, "CRYSTAL")
    geometry = bpy.context.scene.mphdrr_geometry
    on_camera = np.abs(np.array(camera.matrix_world) - np.array(crystal.matrix_world)).max()
    return {
        "place": list(camera.location),
        "turned": list(camera.rotation_euler),
        "aimed": camera.mphdrr_module.aimed,
        "distance": camera.mphdrr_module.pinhole_distance - camera.location.length,
        "off": float(on_camera),
        "panel": geometry.scanner.name,
        "listed": geometry.scanner.all_objects[geometry.active_index].mphdrr_module.number,
        "active": bpy.context.view_layer.objects.active.name,
    }


def moved(x: float, y: float, z: float):
    """Whether module 30 of A is that far from where it was at first, and at rest."""
    start = seen["before"]["place"]

    def is_there() -> bool:
        now = module("A", 30).location
        return all(abs(a - b - d) < 1e-3 for a, b, d in zip(now, start, (x, y, z), strict=True))

    return is_there


def look_at_back(name: str, number: int) -> None:
    """Look at a module's crystal from behind."""
    _, area, _ = viewport()
    area.spaces.active.show_region_ui = True
    view, camera = area.spaces.active.region_3d, module(name, number)
    view.view_rotation = (camera.matrix_world @ Matrix.Rotation(0.5, 4, "X")).to_quaternion()
    view.view_location, view.view_distance, view.view_perspective = camera.location, 500, "PERSP"


def view() -> list[float]:
    """How the 3D view looks at the scene."""
    space = viewport()[1].spaces.active
    return [space.clip_start, space.clip_end, space.region_3d.view_distance, *space.region_3d.view_location]


def on_screen(point: Vector) -> list[float]:
    """Where in the part of the 3D view that toolbar and sidebar leave free a point is, from 0 to 1."""
    _, area, region = viewport()
    x, y = location_3d_to_region_2d(region, area.spaces.active.region_3d, point)
    tools, sidebar = (next(r for r in area.regions if r.type == kind).width for kind in ("TOOLS", "UI"))
    return [(x - tools) / (region.width - tools - sidebar), y / region.height]


def counts() -> dict[str, int]:
    return {kind: len(getattr(bpy.data, kind)) for kind in ("objects", "meshes", "cameras", "materials", "collections")}


def click_on(item) -> None:
    _, area, region = viewport()
    middle = item.matrix_world @ (sum((Vector(v.co) for v in item.data.vertices), Vector()) / len(item.data.vertices))
    place = location_3d_to_region_2d(region, area.spaces.active.region_3d, middle)
    mouse(*place, "click", "1")


def steps():
    """Yields what to wait for: seconds, or a function that says when it has happened."""
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects.remove(bpy.data.objects[name])
    yield 1
    window, area, region = viewport()
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.ed.undo_push(message="Start")
    area.spaces.active.show_region_ui = True
    yield 1
    seen["views"] = [view()]
    bpy.ops.mphdrr.import_geometry("EXEC_DEFAULT", True, filepath=str(workbook), name="A")
    yield 1
    seen["views"].append(view())
    keys("ctrl+z")
    yield lambda: "A" not in bpy.data.collections
    seen["views"].append(view())
    keys("ctrl+shift+z")
    yield lambda: "A" in bpy.data.collections
    seen["views"].append(view())
    seen["middle"] = on_screen(Vector())
    for name, first in (("A", 30), ("B", 60)):
        bpy.ops.mphdrr.import_geometry("EXEC_DEFAULT", True, filepath=str(workbook), name=name, replace=True)
        bpy.ops.mphdrr.show_modules(first=first, last=first, mode="ONLY")
    yield 2
    seen["imported"] = state()
    look_at_back("A", 30)
    yield 3
    click_on(part("A", 30, "CRYSTAL"))
    yield lambda: state()["panel"] == "A" and state()["listed"] == 30
    seen["clicked"] = seen["before"] = state()

    keys("g", "x", "3", "0", "Return")
    yield moved(30, 0, 0)
    seen["moved"] = state()
    keys("ctrl+z")
    yield moved(0, 0, 0)
    seen["undone"] = state()
    keys("ctrl+shift+z")
    yield moved(30, 0, 0)
    seen["redone"] = state()
    keys("ctrl+z")
    yield moved(0, 0, 0)

    keys("g", "y", "2", "0")
    yield moved(0, 20, 0)
    seen["dragged"] = state()
    keys("Escape")
    yield moved(0, 0, 0)
    seen["cancelled"] = state()

    keys("r", "z", "3", "0", "Return")
    yield lambda: not module("A", 30).mphdrr_module.aimed
    seen["turned"] = state()
    keys("ctrl+z")
    yield lambda: module("A", 30).mphdrr_module.aimed
    seen["turned_back"] = state()

    keys("g", "z")  # the mouse, and its button before the last motion has been drawn
    _, _, region = viewport()
    for x in range(10, 130, 10):
        mouse(region.width // 2 + x, region.height // 2 + 2 * x)
    mouse(region.width // 2 + 150, region.height // 2 + 250, "click", "1")
    yield 2
    seen["by_mouse"] = state()
    keys("ctrl+z")
    yield moved(0, 0, 0)
    seen["by_mouse_undone"] = state()
    keys("ctrl+shift+z")
    yield 2
    seen["by_mouse_redone"] = state()
    keys("ctrl+z")
    yield moved(0, 0, 0)

    # A script: the undo step is taken before Blender evaluates the scene.
    window, area, region = viewport()
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.transform.translate("EXEC_DEFAULT", True, value=(0, 0, 25))
    yield moved(0, 0, 25)
    seen["scripted"] = state()
    for _ in range(2):
        keys("ctrl+z")
        yield moved(0, 0, 0)
    seen["scripted_undone"] = state()

    window, area, region = viewport()
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.object.select_all(action="DESELECT")
        item = part("B", 60, "COLLIMATOR")
        item.select_set(True)
        bpy.context.view_layer.objects.active = item
        bpy.ops.ed.undo_push(message="Select")
    yield lambda: state()["panel"] == "B" and state()["listed"] == 60
    seen["other"] = state()
    seen["counts"] = [counts()]
    bpy.ops.mphdrr.remove_scanner("EXEC_DEFAULT", True)
    yield 1
    seen["counts"].append(counts())
    keys("ctrl+z")
    yield lambda: "B" in bpy.data.collections and state()["panel"] == "B"
    seen["counts"].append(counts())
    seen["back"] = state()
    geometry = bpy.context.scene.mphdrr_geometry
    geometry.show_rays = geometry.show_frustums = geometry.show_detectors = True
    look_at_back("B", 60)
    start = module("B", 60).location.copy()
    keys("g", "x", "4", "0")  # still moving when the picture is taken
    yield lambda: (module("B", 60).location - start - Vector((40, 0, 0))).length < 1e-3
    viewport()[1].spaces.active.region_3d.view_distance = 1500
    seen["moving"] = state()
    seen["ok"] = True


def tick() -> float | None:
    """A step when what the last one waits for has happened."""
    global wanted, waiting_since
    sidebar = next(region for region in viewport()[1].regions if region.type == "UI")
    try:
        if sidebar.width > 1:
            sidebar.active_panel_category = "mphDRR"
    except TypeError:
        pass  # it has no tabs yet
    try:
        if callable(wanted) and not wanted():
            if time.monotonic() - waiting_since < _PATIENCE:
                return 0.3
            seen["state"] = state()
            raise TimeoutError(f"waited for line {running.gi_frame.f_lineno}")
        if callable(wanted):  # and a moment for what may still come
            wanted = 0.7
            return wanted
        wanted, waiting_since = next(running), time.monotonic()
        result_file.write_text(json.dumps(seen))
        return 0.3 if callable(wanted) else wanted
    except StopIteration:
        pass
    except Exception:
        seen["error"] = traceback.format_exc()
    result_file.write_text(json.dumps(seen))
    return None


_PATIENCE = 20.0  # s
wanted: object = None
waiting_since = 0.0
running = steps()
bpy.app.timers.register(tick, first_interval=1.5)
