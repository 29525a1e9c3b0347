"""A phantom as one module sees it, from aside and from its pinhole, and a back-projection; a picture of each."""

import bpy
from driving import WORKBOOK, drawn, editor, idle, only, open_tab, press, run, seen
from pointing import look, picture, place

MODULE = 27


def steps():
    """Yield seconds to wait."""
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects[name].hide_set(True)
    space = editor()[1].spaces.active
    space.show_region_ui, space.overlay.show_floor = True, False
    space.overlay.show_axis_x = space.overlay.show_axis_y = space.overlay.show_text = False
    press(bpy.ops.mphdrr.import_geometry, "EXEC_DEFAULT", filepath=str(WORKBOOK))
    yield from drawn()
    scene = bpy.context.scene
    press(bpy.ops.mphdrr.add_derenzo, "EXEC_DEFAULT", voxels=160)
    yield from idle()
    phantom = bpy.context.object
    press(bpy.ops.mphdrr.show_modules, "EXEC_DEFAULT", modules=str(MODULE), mode="ONLY")
    camera = bpy.data.objects[f"Module {MODULE}"]
    scene.mphdrr_geometry.active_index = next(
        i for i, o in enumerate(scene.mphdrr_geometry.scanner.all_objects) if o == camera
    )
    bpy.context.view_layer.objects.active = phantom
    only("MPHDRR_PT_phantom", "MPHDRR_PT_reconstruction")
    yield 1
    open_tab()
    press(bpy.ops.mphdrr.show_in_perspective)
    yield from idle()
    seen["shown"] = [o.name for o in bpy.data.objects if o.name.startswith("Perspective")]
    seen["active"] = bpy.context.object.name
    phantom.hide_set(True)
    middle = camera.matrix_world.translation * 0.4
    look(520.0, (1.2, 0.0, 0.6), middle)
    yield from drawn()
    frustum = bpy.data.objects[f"Perspective {MODULE}"]
    seen["corners"] = [place(frustum.matrix_world @ vertex.co) for vertex in frustum.data.vertices]
    picture("aside")
    press(bpy.ops.mphdrr.look_through_module, "EXEC_DEFAULT", number=MODULE)
    yield from drawn()
    seen["through"] = [place(frustum.matrix_world @ vertex.co) for vertex in frustum.data.vertices[1:]]
    seen["frame"] = [place(camera.matrix_world @ corner) for corner in camera.data.view_frame()]
    picture("pinhole")
    look(520.0, (1.2, 0.0, 0.6), middle)
    editor()[2].data.view_perspective = "ORTHO"
    bpy.context.view_layer.objects.active = camera
    camera.location.z += 15.0
    yield from drawn()
    picture("moved")
    camera.location.z -= 15.0
    yield from drawn()
    bpy.context.view_layer.objects.active = phantom
    press(bpy.ops.mphdrr.resample_in_perspective)
    yield from idle()
    seen["kept"] = bpy.context.object.name
    bpy.ops.mphdrr.clear_perspective()
    press(bpy.ops.mphdrr.add_slices, "EXEC_DEFAULT")
    look(300.0, (1.05, 0.0, 0.95))
    yield from drawn()
    picture("through")
    for item in bpy.context.scene.objects:
        if item.type == "VOLUME" or (item.parent is not None and item.parent.type == "VOLUME"):
            item.hide_set(True)
    press(bpy.ops.mphdrr.show_modules, "EXEC_DEFAULT", mode="ALL")
    settings = scene.mphdrr_projections
    settings.volume, settings.model, settings.width, settings.height = phantom, "TRANSMISSION", 128, 128
    press(bpy.ops.mphdrr.render_projections)
    yield from idle()
    bpy.utils.unregister_class(bpy.types.MPHDRR_PT_phantom)  # Reconstruction is in sight
    scene.mphdrr_display.planes = "NONE"
    scene.mphdrr_reconstruction.voxels, scene.mphdrr_reconstruction.how = 96, "PRODUCT"
    press(bpy.ops.mphdrr.backproject)
    yield from idle()
    seen["backprojected"] = bpy.context.object.name
    look(420.0, (1.05, 0.0, 0.95))
    seen["middle"] = place((0.0, 0.0, 0.0))


run(steps())
