"""The main path in the window: import, phantom, projections, export; leaves the window open."""

import math

import bpy
from driving import WORKBOOK, drawn, editor, empty_scene, folder, open_tab, press, run, seen
from mathutils import Euler
from pointing import place


def steps():
    """Yield seconds to wait."""
    empty_scene()
    bpy.ops.mphdrr.import_geometry(filepath=str(WORKBOOK))
    press(bpy.ops.mphdrr.add_derenzo, "EXEC_DEFAULT", voxels=128, theta=math.radians(55), phi=math.radians(30))
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scanner.blend"))
    bpy.ops.mphdrr.render_projections(width=96, height=96)
    bpy.ops.mphdrr.export_dataset(filepath=str(folder / "run.npz"))
    press(bpy.ops.mphdrr.show_projections, "EXEC_DEFAULT")
    area = editor()[1]
    space = area.spaces.active
    space.show_region_ui = True
    view = space.region_3d
    view.view_distance, view.view_location = 520, (40, 0, 10)
    view.view_rotation = Euler((1.05, 0, 0.95)).to_quaternion()
    seen["files"] = sorted(path.name for path in folder.iterdir())
    yield from drawn()
    open_tab()
    bpy.context.view_layer.objects.active.select_set(False)  # its outline has the rods' colour
    area.tag_redraw()
    seen["phantom_at"] = place((0, 0, 0))


run(steps())
