"""An imported scanner in a Rendered view, by Cycles: the Debian Blender's EEVEE does not render by software.

Arguments after ``--``: the file for what was seen.
"""

from __future__ import annotations

import json
import sys
import traceback
from pathlib import Path

import bpy

result_file = Path(sys.argv[-1])
bpy.context.preferences.view.show_splash = False
_RENDERING = 20.0  # s that Cycles gets
WORKBOOK = str(Path(bpy.utils.user_resource("EXTENSIONS")) / "user_default/mphdrr/examples/dc-spect-80.xlsx")


def show() -> list[int]:
    """Import the scanner and show it; returns left, top, right and bottom of the 3D view on the screen."""
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == "VIEW_3D"), key=lambda a: a.width)
    region = next(r for r in area.regions if r.type == "WINDOW")
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.mphdrr.import_geometry("EXEC_DEFAULT", True, filepath=WORKBOOK)
        bpy.ops.object.select_all(action="DESELECT")
    scene, space = bpy.context.scene, area.spaces.active
    bpy.data.objects["Cube"].hide_set(True)
    scene.render.engine = "CYCLES"
    scene.cycles.preview_samples, scene.cycles.use_preview_denoising = 2, False
    space.overlay.show_overlays = space.show_gizmo = space.show_region_toolbar = space.show_region_header = False
    space.show_region_tool_header = False
    space.shading.type = "RENDERED"
    top = window.height - area.y - area.height
    return [area.x, top, area.x + area.width, top + area.height]


def start() -> None:
    seen: dict[str, object] = {"ok": False}
    try:
        seen["frame"] = show()
    except Exception:
        seen["error"] = traceback.format_exc()
    result_file.write_text(json.dumps(seen))
    if "error" not in seen:
        bpy.app.timers.register(end, first_interval=_RENDERING)


def end() -> None:
    seen = json.loads(result_file.read_text())
    result_file.write_text(json.dumps({**seen, "ok": True}))


bpy.app.timers.register(start, first_interval=1.5)
