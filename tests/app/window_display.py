"""The example in the window, with a tile clicked and a module selected; leaves the frame of module 55 around its tile."""

import time

import bpy
import numpy as np
from driving import drawn, editor, is_idle, open_tab, press, run, seen
from pointing import xdotool


def place_of(number: int) -> tuple[int, int, int, int]:
    """Return left, top, right and bottom of a module's tile on the screen."""
    window, area, region = editor("IMAGE_EDITOR")
    image = area.spaces.active.image
    tiles = image["mphdrr_tiles"].to_dict()
    row, column = np.reshape(tiles["corners"], (-1, 2))[tiles["numbers"].index(number)]
    width, height = image.size
    ends = []
    for down, across in ((row, column), (row + tiles["tile"][0], column + tiles["tile"][1])):
        x, y = region.view2d.view_to_region(across / width, 1 - down / height, clip=False)
        ends += [region.x + x, window.height - region.y - y]
    return tuple(ends)


def active() -> list[int]:
    """Return the numbers of the active module and of the one in the panel's list."""
    scene = bpy.context.scene
    item = bpy.context.view_layer.objects.active
    listed = scene.mphdrr_geometry.scanner.all_objects[scene.mphdrr_geometry.active_index]
    return [item.mphdrr_module.number, listed.mphdrr_module.number]


def steps():
    """Yield seconds to wait."""
    started = time.monotonic()
    editor()[1].spaces.active.show_region_ui = True
    press(bpy.ops.mphdrr.load_example)  # the empty panel's first button
    yield 0.2
    while not is_idle():
        yield 0.1
    seen["seconds"] = time.monotonic() - started
    open_tab()
    yield from drawn()
    left, top, right, bottom = place_of(30)
    xdotool("mousemove", round(left + 0.5 * (right - left)), round(top + 0.7 * (bottom - top)))
    xdotool("click", 1)
    yield lambda: active()[0] == 30
    yield from drawn()
    seen["clicked"] = active()
    plane = bpy.data.objects["Projection 55"]
    bpy.ops.object.select_all(action="DESELECT")
    plane.select_set(True)
    bpy.context.view_layer.objects.active = plane
    yield from drawn()
    seen["selected"] = active()
    seen["tile"], seen["other"] = place_of(55), place_of(31)
    seen["tiles"] = [place_of(number) for number in range(1, 81)]
    seen["hidden"] = sorted(o.name for o in bpy.data.objects if o.hide_viewport)
    seen["planes"] = sum(not o.hide_viewport for o in bpy.data.objects if o.mphdrr_module.part == "PLANE")


run(steps())
