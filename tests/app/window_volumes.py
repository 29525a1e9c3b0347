"""Volumes in the window: NEMA's slices and shell, an arrow that is dragged, a map; a picture of each."""

import bpy
from driving import WORKBOOK, drawn, editor, open_tab, ours, press, run, seen, within
from pointing import frame, look, on_screen, picture, place, xdotool


def steps():
    """Yield seconds to wait."""
    color_bar, slices = ours("addon.perspective.color_bar"), ours("addon.volumes.slices")
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects[name].hide_set(True)
    space = editor()[1].spaces.active
    space.overlay.show_floor = space.overlay.show_axis_x = space.overlay.show_axis_y = False
    space.overlay.show_text = space.show_gizmo_navigate = False
    press(bpy.ops.mphdrr.add_nema, "EXEC_DEFAULT", voxels=80)
    press(bpy.ops.mphdrr.add_slices, "EXEC_DEFAULT")
    nema = bpy.context.object
    settings, nema_name = nema.mphdrr_volume, nema.name
    affine = slices._read_volume(nema).grid.affine
    middle = (-affine[:3, 3] / affine.diagonal()[:3]).round().astype(int).tolist()
    settings.slices = middle
    settings.display_low = 5.5  # above the background
    for plane in slices.planes_of(nema)[:2]:
        plane.hide_set(True)
    nema.hide_set(False)
    look(500.0)
    seen["frame"] = frame()
    yield from drawn()
    picture("slice")
    settings.display_low = 0.0
    for plane in slices.planes_of(nema):
        plane.hide_set(False)
    look(900.0, (1.05, 0.0, 0.95))
    yield from drawn()
    picture("slices")
    before = list(settings.slices)
    start, step = slices.slice_track(nema, 2)
    handle = start + step * before[2]
    ends = place(handle + step * 6), place(handle + step * 16)
    seen["arrow"] = ends
    xdotool("mousemove", *ends[0])
    yield 0.5
    yield from drawn()
    xdotool("mousedown", 1)
    yield 0.5
    for share in (0.3, 0.7, 1.0):
        xdotool("mousemove", *(round(a + share * (b - a)) for a, b in zip(*ends, strict=True)))
        yield 0.7
    xdotool("mouseup", 1)
    yield from drawn()
    seen["dragged"] = [before, list(settings.slices)]
    plane = slices.planes_of(nema)[2]
    image = plane.data.materials[0].node_tree.nodes["Slice"].image
    bpy.ops.ed.undo_push(message="Before")
    painted = list(image.pixels)
    settings.slices = [*settings.slices[:2], before[2]]
    bpy.ops.ed.undo_push(message="Slice moved")
    moved = list(image.pixels)
    with within():
        bpy.ops.ed.undo()
    yield from drawn()
    nema = bpy.data.objects[nema_name]
    settings = nema.mphdrr_volume
    image = slices.planes_of(nema)[2].data.materials[0].node_tree.nodes["Slice"].image
    seen["undone"] = [settings.slices[2], painted != moved, list(image.pixels) == painted]
    settings.look = "CUT"
    yield from drawn()
    picture("cut")
    slices.remove_slices(nema)
    settings.look = "SHELL"
    yield from drawn()
    picture("shell")
    nema.hide_set(True)
    for child in nema.children:
        child.hide_set(True)
    press(bpy.ops.mphdrr.add_torso, "EXEC_DEFAULT", voxels=64)
    torso = bpy.context.object
    torso.mphdrr_volume.look = "SHELL"
    yield from drawn()
    picture("heart")
    torso.hide_set(True)
    for child in torso.children:
        child.hide_set(True)
    press(bpy.ops.mphdrr.import_geometry, "EXEC_DEFAULT", filepath=str(WORKBOOK))
    press(bpy.ops.mphdrr.add_map, "EXEC_DEFAULT", quantity="sensitivity", voxels=32)
    press(bpy.ops.mphdrr.show_modules, "EXEC_DEFAULT", modules="1-40", mode="ONLY")
    look(420.0, (1.05, 0.0, 0.95), (0.0, 0.0, -30.0))
    yield from drawn()
    picture("map")
    seen["map"] = [place((0.0, 0.0, 0.0)), place((60.0, -60.0, 60.0))]
    left, bottom, width, height = color_bar.rectangle()
    seen["bar"] = [*on_screen(left, bottom + height - 1), width, height]
    space.show_region_ui = True
    bpy.context.view_layer.objects.active = bpy.data.objects["Sensitivity map"]
    look(600.0, (1.05, 0.0, 0.95))
    yield from drawn()
    open_tab()


run(steps())
