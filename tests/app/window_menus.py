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


def search(text: str) -> None:
    """Open the search over the 3D view, as F3 does, and type."""
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == "VIEW_3D"), key=lambda a: a.width)
    region = next(r for r in area.regions if r.type == "WINDOW")
    place = [str(region.x + region.width // 3), str(window.height - region.y - region.height // 2)]
    subprocess.run(["xdotool", "mousemove", *place], check=True)
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.wm.search_menu("INVOKE_DEFAULT")
    words.append(text)


words: list[str] = []


def typed() -> None:
    subprocess.run(["xdotool", "type", "--delay", "40", words[-1]], check=True)


def chosen() -> None:
    subprocess.run(["xdotool", "key", "Return"], check=True)


def model() -> str:
    return bpy.context.scene.mphdrr_projections.model


def steps():
    bpy.ops.mphdrr.import_geometry(filepath=str(workbook))
    camera = bpy.data.objects["Module 05"]
    camera.rotation_euler.x += 0.2
    bpy.context.view_layer.update()
    yield
    seen["before"] = [camera.mphdrr_module.aimed, model()]
    for text in ("collimator aim", "preset ideal"):
        search(text)
        yield
        typed()
        yield
        chosen()
        yield
    seen["after"] = [camera.mphdrr_module.aimed, model()]
    search("projection")
    yield
    typed()
    yield
    seen["ok"] = True


running = steps()


def tick() -> float | None:
    try:
        next(running)
    except StopIteration:
        result_file.write_text(json.dumps(seen))
        return None
    except Exception:
        seen["error"] = traceback.format_exc()
        result_file.write_text(json.dumps(seen))
        return None
    return 2.5


bpy.app.timers.register(tick, first_interval=2.0)
