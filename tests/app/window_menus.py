"""Commands found by the menus' search (F3) and started from it; leaves the search for "projection" open."""

import bpy
from driving import WORKBOOK, drawn, editor, press, run, seen
from pointing import on_screen, xdotool


def search() -> None:
    """Open the search over the 3D view, as F3 does."""
    _, area, region = editor()
    area.spaces.active.shading.type = "WIREFRAME"  # drawn fast, also without a graphics card
    xdotool("mousemove", *on_screen(region.width // 3, region.height // 2))
    press(bpy.ops.wm.search_menu)


def model() -> str:
    return bpy.context.scene.mphdrr_projections.model


def steps():
    """Yield the seconds that Blender may take before the next step."""
    bpy.ops.mphdrr.import_geometry(filepath=str(WORKBOOK))
    camera = bpy.data.objects["Module 05"]
    camera.rotation_euler.x += 0.2
    bpy.context.view_layer.update()
    for text in ("collimator aim", "preset ideal", "projection"):
        search()
        yield from drawn()
        seen.setdefault("before", [camera.mphdrr_module.aimed, model()])
        xdotool("type", "--delay", "100", text)
        yield 1.0
        yield from drawn()
        if text != "projection":
            xdotool("key", "Return")
            yield from drawn()
    seen["after"] = [camera.mphdrr_module.aimed, model()]


run(steps())
