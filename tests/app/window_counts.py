"""Measured counts are imported in the window: the file browser first, then with all that it asks for."""

import bpy
import numpy as np
from driving import WORKBOOK, drawn, folder, ours, press, run, seen

jobs, runs = ours("addon.blender.jobs"), ours("addon.runs.runs")


def areas(kind: str):
    return [area for window in bpy.context.window_manager.windows for area in window.screen.areas if area.type == kind]


def steps():
    """Yield the seconds that Blender may take before the next step."""
    bpy.ops.mphdrr.import_geometry(filepath=str(WORKBOOK))
    counts = folder / "counts.npy"
    picture = np.zeros((80, 32, 32), int)
    picture[:, 4:12, 4:20] = 50  # a bar near the first corner
    np.save(counts, picture)
    area = areas("TIMELINE")[0] if areas("TIMELINE") else areas("DOPESHEET_EDITOR")[0]
    area.type = "IMAGE_EDITOR"
    yield 1.0
    press(bpy.ops.mphdrr.import_counts)
    yield lambda: areas("FILE_BROWSER")
    seen["browsers"] = len(areas("FILE_BROWSER"))
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "FILE_BROWSER":
                with bpy.context.temp_override(window=window, area=area, region=area.regions[0]):
                    bpy.ops.file.cancel()
    yield from drawn()
    said = {"frames": "80-1", "orientation": "front+v", "time": 600.0}
    press(bpy.ops.mphdrr.import_counts, filepath=str(counts), **said)
    yield 1.0
    while jobs.is_running():
        yield 0.5
    scene = bpy.context.scene
    seen["runs"] = [item.name for item in scene.mphdrr_projections.runs]
    seen["said"], seen["changes"] = runs.measured_text(scene), runs.changes(scene)
    seen["image"] = [area.spaces.active.image and area.spaces.active.image.name for area in areas("IMAGE_EDITOR")]


run(steps())
