"""Commands found by the menus' search (F3) and started from it; leaves the search for "projection" open.

Arguments after ``--``: the workbook, the file for what was seen.
"""

import json
import subprocess
import sys
import traceback
from pathlib import Path

import bpy

workbook, result_file = (Path(word) for word in sys.argv[sys.argv.index("--") + 1 :][:2])
seen: dict[str, object] = {"ok": False}
bpy.context.preferences.view.show_splash = False


def search() -> None:
    """Open the search over the 3D view, as F3 does."""
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == "VIEW_3D"), key=lambda a: a.width)
    region = next(r for r in area.regions if r.type == "WINDOW")
    place = [str(region.x + region.width // 3), str(window.height - region.y - region.height // 2)]
    area.spaces.active.shading.type = "WIREFRAME"  # drawn fast, also without a graphics card
    keys("mousemove", *place)
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.wm.search_menu("INVOKE_DEFAULT")


def keys(*what: str) -> None:
    subprocess.run(["xdotool", *what], check=True)


def model() -> str:
    return bpy.context.scene.mphdrr_projections.model


def steps():
    """Yields how many seconds Blender may take before the next step."""
    bpy.ops.mphdrr.import_geometry(filepath=str(workbook))
    camera = bpy.data.objects["Module 05"]
    camera.rotation_euler.x += 0.2
    bpy.context.view_layer.update()
    for text in ("collimator aim", "preset ideal", "projection"):
        search()
        yield 3.0
        seen.setdefault("before", [camera.mphdrr_module.aimed, model()])
        keys("type", "--delay", "100", text)
        yield 6.0
        if text != "projection":
            keys("key", "Return")
            yield 2.0
    seen["after"] = [camera.mphdrr_module.aimed, model()]
    seen["ok"] = True


running = steps()


def tick() -> float | None:
    try:
        return next(running)
    except StopIteration:
        pass
    except Exception:
        seen["error"] = traceback.format_exc()
    result_file.write_text(json.dumps(seen))
    return None


bpy.app.timers.register(tick, first_interval=2.0)
