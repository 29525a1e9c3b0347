"""The main path in the window: import, phantom, projections, export; leaves the window open.

Arguments after ``--``: the workbook, a folder for the files. Writes ``result.json`` there.
"""

from __future__ import annotations

import json
import math
import sys
import traceback
from pathlib import Path

import bpy
from bpy_extras.view3d_utils import location_3d_to_region_2d
from mathutils import Euler

workbook, folder = (Path(word) for word in sys.argv[sys.argv.index("--") + 1 :][:2])
bpy.context.preferences.view.show_splash = False


def viewport():
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == "VIEW_3D"), key=lambda a: a.width)
    region = next(r for r in area.regions if r.type == "WINDOW")
    return area, bpy.context.temp_override(window=window, area=area, region=region)


def work() -> None:
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects.remove(bpy.data.objects[name])
    bpy.ops.mphdrr.import_geometry(filepath=str(workbook))
    _, there = viewport()
    with there:
        bpy.ops.mphdrr.add_derenzo(voxels=128, theta=math.radians(55), phi=math.radians(30))
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scanner.blend"))
    bpy.ops.mphdrr.render_projections(width=96, height=96)
    bpy.ops.mphdrr.export_dataset(filepath=str(folder / "run.npz"))
    area, there = viewport()
    with there:
        bpy.ops.mphdrr.show_projections()
    space = area.spaces.active
    space.show_region_ui = True
    view = space.region_3d
    view.view_distance, view.view_location = 520, (40, 0, 10)
    view.view_rotation = Euler((1.05, 0, 0.95)).to_quaternion()


def start() -> None:
    result: dict[str, object] = {"ok": False}
    try:
        work()
        result = {"files": sorted(path.name for path in folder.iterdir())}
    except Exception:
        result["error"] = traceback.format_exc()
    (folder / "result.json").write_text(json.dumps(result))
    if "error" not in result:
        bpy.app.timers.register(open_tab, first_interval=3)


def open_tab() -> None:
    area, _ = viewport()
    sidebar = next(region for region in area.regions if region.type == "UI")
    sidebar.active_panel_category = "mphDRR"
    bpy.context.view_layer.objects.active.select_set(False)  # its outline has the rods' colour
    area.tag_redraw()
    # Where the phantom's middle is on the screen, in pixels from its top left.
    window = bpy.context.window_manager.windows[0]
    region = next(region for region in area.regions if region.type == "WINDOW")
    x, y = location_3d_to_region_2d(region, area.spaces.active.region_3d, (0, 0, 0))
    result = json.loads((folder / "result.json").read_text())
    result["ok"] = True
    result["phantom_at"] = [round(region.x + x), round(window.height - region.y - y)]
    (folder / "result.json").write_text(json.dumps(result))


bpy.app.timers.register(start, first_interval=1.5)
