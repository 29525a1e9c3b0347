"""An imported scanner in a Rendered view, by Cycles: the Debian Blender's EEVEE does not render by software."""

import bpy
from driving import WORKBOOK, editor, press, run, seen, within


def steps():
    """Yield seconds to wait."""
    press(bpy.ops.mphdrr.import_geometry, "EXEC_DEFAULT", filepath=str(WORKBOOK))
    with within():
        bpy.ops.object.select_all(action="DESELECT")
    window, area, _ = editor()
    scene, space = bpy.context.scene, area.spaces.active
    bpy.data.objects["Cube"].hide_set(True)
    scene.render.engine = "CYCLES"
    scene.cycles.preview_samples, scene.cycles.use_preview_denoising = 2, False
    space.overlay.show_overlays = space.show_gizmo = space.show_region_toolbar = space.show_region_header = False
    space.show_region_tool_header = False
    space.shading.type = "RENDERED"
    top = window.height - area.y - area.height
    seen["frame"] = [area.x, top, area.x + area.width, top + area.height]
    yield 20.0  # s that Cycles gets


run(steps())
