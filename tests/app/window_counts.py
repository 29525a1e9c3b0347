"""Measured counts are imported in the window: the file browser first, then with all that it asks for.

Arguments after ``--``: the workbook, the file for what was seen, beside which the counts are written.
"""

import importlib
import json
import sys
import traceback
from pathlib import Path

import bpy
import numpy as np

workbook, result_file = (Path(word) for word in sys.argv[sys.argv.index("--") + 1 :][:2])
bpy.context.preferences.view.show_splash = False
runs = importlib.import_module("bl_ext.user_default.mphdrr.addon.runs.runs")
jobs = importlib.import_module("bl_ext.user_default.mphdrr.addon.blender.jobs")
seen: dict[str, object] = {"ok": False}


def areas(kind: str):
    return [area for window in bpy.context.window_manager.windows for area in window.screen.areas if area.type == kind]


def call(operator, **options) -> None:
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type in ("VIEW_3D", "IMAGE_EDITOR")), key=lambda a: a.width)
    region = next(r for r in area.regions if r.type == "WINDOW")
    with bpy.context.temp_override(window=window, area=area, region=region):
        operator("INVOKE_DEFAULT", **options)


def steps():
    """Yields how many seconds Blender may take before the next step."""
    bpy.ops.mphdrr.import_geometry(filepath=str(workbook))
    counts = result_file.with_name("counts.npy")
    picture = np.zeros((80, 32, 32), int)
    picture[:, 4:12, 4:20] = 50  # a bar near the first corner
    np.save(counts, picture)
    area = areas("TIMELINE")[0] if areas("TIMELINE") else areas("DOPESHEET_EDITOR")[0]
    area.type = "IMAGE_EDITOR"
    yield 1.0
    call(bpy.ops.mphdrr.import_counts)
    yield 3.0
    seen["browsers"] = len(areas("FILE_BROWSER"))
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "FILE_BROWSER":
                with bpy.context.temp_override(window=window, area=area, region=area.regions[0]):
                    bpy.ops.file.cancel()
    yield 2.0
    said = {"frames": "80-1", "orientation": "front+v", "time": 600.0}
    call(bpy.ops.mphdrr.import_counts, filepath=str(counts), **said)
    yield 1.0
    while jobs.is_running():
        yield 0.5
    scene = bpy.context.scene
    seen["runs"] = [item.name for item in scene.mphdrr_projections.runs]
    seen["said"], seen["changes"] = runs.measured_text(scene), runs.changes(scene)
    seen["image"] = [area.spaces.active.image and area.spaces.active.image.name for area in areas("IMAGE_EDITOR")]
    seen["ok"] = True


running = steps()


def step() -> float | None:
    try:
        wait = next(running, None)
    except BaseException:
        seen["error"], wait = traceback.format_exc(), None
    if wait is None:
        result_file.write_text(json.dumps(seen))
    return wait


bpy.app.timers.register(step, first_interval=2.0)
