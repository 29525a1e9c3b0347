"""Counts of a few modules are reconstructed in the window: what is seen while it runs, then finished early."""

import bpy
from driving import WORKBOOK, editor, idle, only, open_tab, ours, press, run, seen
from pointing import escape_asks

seen |= {"iterations": []}


def steps():
    """Yield seconds to wait."""
    editor()[1].spaces.active.show_region_ui = True
    press(bpy.ops.mphdrr.import_geometry, "EXEC_DEFAULT", filepath=str(WORKBOOK))
    press(bpy.ops.mphdrr.add_derenzo, "EXEC_DEFAULT", voxels=48)
    yield 1
    open_tab()
    only("MPHDRR_PT_reconstruction")
    settings = bpy.context.scene.mphdrr_reconstruction
    settings.voxels, settings.spacing, settings.iterations, settings.subsets = 32, 3.0, 20000, 4
    bpy.ops.object.select_all(action="DESELECT")
    for item in bpy.context.scene.objects:
        if item.type == "VOLUME":
            item.hide_set(True)
    projections = bpy.context.scene.mphdrr_projections  # of counts, few and quickly
    projections.model, projections.time, projections.width, projections.height = "EMISSION", 600.0, 24, 24
    projections.first, projections.last = 1, 16
    press(bpy.ops.mphdrr.render_projections)
    yield from idle()
    press(bpy.ops.mphdrr.reconstruct)
    while len(seen["iterations"]) < 2:
        yield 0.5
        known = bpy.context.scene.mphdrr_reconstruction.details
        if known and len(known["objective"]) not in seen["iterations"]:
            seen["iterations"].append(len(known["objective"]))
            seen["while"] = bpy.context.scene.mphdrr_reconstruction.volume.name
    yield from escape_asks()
    bpy.ops.mphdrr.finish_job()
    yield from idle()
    scene = bpy.context.scene
    done = len(scene.mphdrr_reconstruction.details["objective"])
    press(bpy.ops.mphdrr.continue_reconstruction)
    yield from idle()
    yield 1.0
    known = scene.mphdrr_reconstruction.details
    seen["continued"] = len(known["objective"]) - done
    seen["title"], seen["rods"] = known["title"], [name for name, *_ in known["rods"]]
    seen["hidden"] = [item.name for item in scene.objects if item.type == "VOLUME" and item.hide_get()]
    seen["active"], seen["volume"] = bpy.context.object.name, scene.mphdrr_reconstruction.volume.name
    window, area, _ = editor("IMAGE_EDITOR")
    image = area.spaces.active.image
    seen["image"], seen["size"], seen["zoom"] = image.name, image.size[:], area.spaces.active.zoom[:]
    seen["room"] = ours("addon.pictures.images").editor_size(bpy.context)
    seen["editor"] = [area.x, window.height - area.y - area.height, area.width, area.height]


run(steps())
