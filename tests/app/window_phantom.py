"""Phantoms in the window: a slider is dragged, which is undone, a torso beats; leaves the window while it plays.

Argument after ``--``: the file for what was seen.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
import traceback
from pathlib import Path

import bpy

result_file = Path(sys.argv[sys.argv.index("--") + 1])
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


def phantom():
    return bpy.data.objects["NEMA Body"]


def state() -> dict[str, object]:
    properties = phantom().mphdrr_volume
    planes = sorted(o.name for o in phantom().children if "mphdrr_slice" in o)
    return {
        "length": properties.nema.length,
        "file": phantom().data.filepath,  # named by its content
        "outdated": properties.outdated,
        "loads": phantom().data.grids.load(),
        "planes": planes,
    }


def is_made() -> bool:
    return not phantom().mphdrr_volume.outdated


def has_length(length: float):
    return lambda: phantom().mphdrr_volume.nema.length == length and is_made()


def steps():
    """Yields what to wait for: seconds, or a function that says when it has happened."""
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects.remove(bpy.data.objects[name])
    window, area, region = viewport()
    area.spaces.active.show_region_ui = True
    area.spaces.active.shading.type = "WIREFRAME"  # drawn fast, also without a graphics card
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.mphdrr.add_nema("EXEC_DEFAULT", True, voxels=100)
        bpy.ops.mphdrr.add_slices("EXEC_DEFAULT", True)
        bpy.ops.view3d.view_all("EXEC_DEFAULT")
    yield 1
    seen["before"] = state()
    drags = []
    for length in range(190, 270, 10):  # as a slider sets it, many times a second
        start = time.perf_counter()
        phantom().mphdrr_volume.nema.length = length
        drags.append(time.perf_counter() - start)
        yield 0.05
    seen["dragging"], seen["seconds"] = state(), sorted(drags)
    bpy.ops.ed.undo_push(message="Length")
    yield has_length(260)
    seen["rested"] = state()
    keys("ctrl+z")  # the update
    yield 1
    keys("ctrl+z")  # the edit
    yield has_length(180)
    seen["undone"] = state()
    phantom().mphdrr_volume.nema.voxels = 30
    phantom().mphdrr_volume.nema.length = 220  # few enough voxels to be made at once
    seen["small"] = state()

    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.mphdrr.remove_slices("EXEC_DEFAULT", True)
        phantom().hide_set(True)
        bpy.ops.mphdrr.add_torso("INVOKE_DEFAULT", True, confirmed=True, voxels=32, frames=3)
    yield lambda: bpy.context.object.name.startswith("Cardiac")
    torso, shown = bpy.context.object, set()

    def has_played() -> bool:
        shown.add(torso.data.grids.frame)
        return len(shown) == 3

    area.spaces.active.shading.type = "SOLID"
    bpy.ops.screen.animation_play()
    yield has_played
    seen["frames"] = sorted(shown)
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
            raise TimeoutError(f"waited for line {running.gi_frame.f_lineno}")
        wanted, waiting_since = next(running), time.monotonic()
        return 0.3 if callable(wanted) else wanted
    except StopIteration:
        pass
    except Exception:
        seen["error"] = traceback.format_exc()
    result_file.write_text(json.dumps(seen))
    return None


_PATIENCE = 40.0  # s
wanted: object = None
waiting_since = 0.0
running = steps()
bpy.app.timers.register(tick, first_interval=1.5)
