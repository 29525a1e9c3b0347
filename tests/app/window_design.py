"""Design in the window: keys and undo as a user's; leaves the window while a module is being moved.

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
from mathutils import Euler

workbook, result_file = (Path(word) for word in sys.argv[sys.argv.index("--") + 1 :][:2])
bpy.context.preferences.view.show_splash = False
seen: dict[str, object] = {"ok": False}


def viewport():
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == "VIEW_3D"), key=lambda a: a.width)
    region = next(r for r in area.regions if r.type == "WINDOW")
    return window, area, region


def keys(*names: str) -> None:
    """Type keys with the mouse in the middle of the 3D view."""
    window, _, region = viewport()
    x, y = region.x + region.width // 2, window.height - region.y - region.height // 2
    subprocess.run(["xdotool", "mousemove", str(x), str(y)], check=True)
    for name in names:
        subprocess.run(["xdotool", "key", "--delay", "60", name], check=True)


def scanner():
    return next(c for c in bpy.data.collections if c.mphdrr_scanner.is_scanner)


def module(number: int):
    return next(o for o in scanner().all_objects if o.mphdrr_module.is_module and o.mphdrr_module.number == number)


def state(number: int) -> dict[str, object]:
    camera = module(number)
    crystal = next(c for c in camera.children if c.mphdrr_module.part == "CRYSTAL")
    values = {name: getattr(camera.mphdrr_module, name) for name in ("pinhole_distance", "collimator_length", "aimed")}
    return {
        "place": list(camera.location),
        **values,
        "sensitivity": camera.mphdrr_module.sensitivity,
        "crystal": min(v.co.z for v in crystal.data.vertices),
        "lens": camera.data.lens / camera.data.sensor_width,
        "total": scanner().mphdrr_scanner.sensitivity,
    }


def select(number: int) -> None:
    window, area, region = viewport()
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.object.select_all(action="DESELECT")
        camera = module(number)
        camera.select_set(True)
        bpy.context.view_layer.objects.active = camera
        bpy.ops.ed.undo_push(message="Select")


def numbers() -> list[int]:
    return sorted(o.mphdrr_module.number for o in scanner().all_objects if o.mphdrr_module.is_module)


def meshes() -> int:
    return sum(o.mphdrr_module.part in {"COLLIMATOR", "CRYSTAL"} for o in scanner().all_objects)


def moved(number: int, by: tuple[float, float, float]):
    """Whether a module has come to `by` from where it was at first, and its readouts with it."""
    start = seen["before"]["place"]

    def is_there() -> bool:
        camera = module(number)
        arrived = all(abs(x - x0 - d) < 1e-3 for x, x0, d in zip(camera.location, start, by, strict=True))
        return arrived and abs(camera.mphdrr_module.pinhole_distance - camera.location.length) < 1e-3

    return is_there


def steps():
    """Yields what to wait for: seconds, or a function that says when it has happened."""
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects.remove(bpy.data.objects[name])
    bpy.ops.mphdrr.import_geometry("EXEC_DEFAULT", True, filepath=str(workbook))
    show()
    yield 3
    select(3)
    yield 1
    seen["before"] = state(3)

    keys("g", "x", "3", "0", "Return")
    yield moved(3, (30, 0, 0))
    seen["moved"] = state(3)
    keys("ctrl+z")
    yield moved(3, (0, 0, 0))
    seen["undone"] = state(3)
    keys("ctrl+shift+z")
    yield moved(3, (30, 0, 0))
    seen["redone"] = state(3)
    keys("ctrl+z")
    yield moved(3, (0, 0, 0))

    # A number typed in the panel or a script's operator: the undo step is taken before Blender evaluates the scene.
    window, area, region = viewport()
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.transform.translate("EXEC_DEFAULT", True, value=(0, 0, 25))
    yield moved(3, (0, 0, 25))
    seen["translated"] = state(3)
    keys("ctrl+z")
    yield moved(3, (0, 0, 0))
    seen["translated_undone"] = state(3)

    keys("shift+d", "z", "4", "0", "Return")
    yield lambda: max(numbers()) == 81 and meshes() == 162
    seen["copied"] = {"numbers": numbers(), "parts": meshes(), "state": state(max(numbers()))}
    keys("ctrl+z")
    yield lambda: max(numbers()) == 80
    seen["adoption_undone"] = {"numbers": numbers(), "untidy": scanner().mphdrr_scanner.untidy}
    keys("ctrl+z")
    yield lambda: len(numbers()) == 80
    seen["copy_undone"] = {"numbers": numbers(), "parts": meshes(), "untidy": scanner().mphdrr_scanner.untidy}

    select(5)
    yield 1
    keys("Delete")
    yield lambda: len(numbers()) == 79 and meshes() == 158
    seen["deleted"] = {"numbers": numbers(), "parts": meshes()}
    keys("ctrl+z")
    yield lambda: meshes() == 160
    keys("ctrl+z")
    yield lambda: len(numbers()) == 80
    seen["delete_undone"] = {"numbers": numbers(), "parts": meshes(), "state": state(5)}

    select(3)
    bpy.context.scene.mphdrr_geometry.active_index = scanner().all_objects.find(module(3).name)
    yield 1
    keys("g", "x", "4", "0")  # still moving when the picture is taken
    yield moved(3, (40, 0, 0))
    seen["moving"] = state(3)
    seen["ok"] = True


def show() -> None:
    """The scanner, and the Design panels open."""
    package = __import__("importlib").import_module("bl_ext.user_default.mphdrr.panels.design")
    for panel in (package.MPHDRR_PT_design, package.MPHDRR_PT_scanner_design):
        bpy.utils.unregister_class(panel)
        panel.bl_options = set()
        bpy.utils.register_class(panel)
    _, area, _ = viewport()
    space = area.spaces.active
    space.show_region_ui = True
    view = space.region_3d
    view.view_distance, view.view_location = 620, (110, 40, 0)
    view.view_rotation = Euler((1.05, 0, 0.95)).to_quaternion()


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
            raise TimeoutError(f"waited for line {running.gi_frame.f_lineno}")
        if callable(wanted):  # and a moment for what may still come
            wanted = 0.7
            return wanted
        wanted, waiting_since = next(running), time.monotonic()
        return 0.3 if callable(wanted) else wanted
    except StopIteration:
        pass
    except Exception:
        seen["error"] = traceback.format_exc()
    result_file.write_text(json.dumps(seen))
    return None


_PATIENCE = 30.0  # s
wanted: object = None
waiting_since = 0.0
running = steps()
bpy.app.timers.register(tick, first_interval=1.5)
