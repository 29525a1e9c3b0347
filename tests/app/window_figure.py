"""Figures by the operator, as the menu starts it, in a scene of scanner and phantom that is saved beside them.

Arguments after ``--``: the workbook, the folder for the results and the file for what was seen.
"""

import io
import json
import sys
import time
import traceback
from pathlib import Path

import bpy

workbook, folder, result_file = map(Path, sys.argv[sys.argv.index("--") + 1 :])
bpy.context.preferences.view.show_splash = False
seen: dict[str, object] = {"ok": False, "ticks": 0}
view = bpy.context.preferences.view
FIGURES = ["cut-away", "sums"]
_WAIT = 20.0  # s that what is said after a render may take
rendered = 0.0


def start() -> None:
    kind = FIGURES.pop(0)
    window = bpy.context.window_manager.windows[0]
    area = next(a for a in window.screen.areas if a.type == "VIEW_3D")
    region = next(r for r in area.regions if r.type == "WINDOW")
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.mphdrr.export_figure(
            "INVOKE_DEFAULT", filepath=str(folder / f"{kind}.png"), figure=kind.upper().replace("-", "_"), width=360,
            height=240, samples=8,
        )  # fmt: skip


def render() -> None:
    """Blender's own Render, as F12 starts it; what is said goes to standard error, which is kept."""
    global rendered
    rendered, sys.stderr, scene = time.monotonic(), io.StringIO(), bpy.context.scene
    scene.render.engine, scene.cycles.samples = "CYCLES", 1
    scene.render.resolution_x = scene.render.resolution_y = 32
    scene.camera = next(item for item in scene.objects if item.type == "CAMERA")
    bpy.ops.render.render("INVOKE_DEFAULT")


def step() -> float | None:
    try:
        if len(bpy.context.window_manager.windows[0].modal_operators) or bpy.app.is_job_running("RENDER"):
            seen["ticks"] += 1
        elif FIGURES:
            start()
        elif not rendered:
            seen.update(scenes=len(bpy.data.scenes), display=[before, view.render_display_type])
            render()
        elif sys.stderr.getvalue() or time.monotonic() > rendered + _WAIT:
            seen.update(ok=True, said=sys.stderr.getvalue())
    except Exception:
        seen["error"] = traceback.format_exc()
    result_file.write_text(json.dumps(seen))
    return None if seen["ok"] or "error" in seen else 0.05


def prepare() -> float | None:
    try:
        bpy.ops.mphdrr.import_geometry(filepath=str(workbook))
        bpy.ops.mphdrr.add_derenzo(voxels=48)
        bpy.ops.mphdrr.show_modules(first=1, last=20, mode="ONLY")
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scene.blend"))
        bpy.app.timers.register(step, first_interval=0.5)
    except Exception:
        seen["error"] = traceback.format_exc()
        result_file.write_text(json.dumps(seen))


before = view.render_display_type
bpy.app.timers.register(prepare, first_interval=1.5)
