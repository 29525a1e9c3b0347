"""Phantoms in the window: a slider is dragged, which is undone, a torso beats; leaves the window while it plays."""

import bpy
from driving import editor, empty_scene, run, seen, within
from pauses import own_time
from pointing import keys


def phantom():
    return bpy.data.objects["NEMA Body"]


def state() -> dict[str, object]:
    properties = phantom().mphdrr_volume
    planes = sorted(o.name for o in phantom().children if "mphdrr_slice" in o)
    return {
        "length": properties.nema.length,
        "file": phantom().data.filepath,  # named by its content
        "outdated": properties.outdated,
        "loads": phantom().data.grids.load(),
        "planes": planes,
    }


def is_made() -> bool:
    return not phantom().mphdrr_volume.outdated


def has_length(length: float):
    return lambda: phantom().mphdrr_volume.nema.length == length and is_made()


def steps():
    """Yield what to wait for: seconds, or a function that says when it has happened."""
    empty_scene()
    area = editor()[1]
    area.spaces.active.show_region_ui = True
    area.spaces.active.shading.type = "WIREFRAME"  # drawn fast, also without a graphics card
    with within():
        bpy.ops.mphdrr.add_nema("EXEC_DEFAULT", True, voxels=100)
        bpy.ops.mphdrr.add_slices("EXEC_DEFAULT", True)
        bpy.ops.view3d.view_all("EXEC_DEFAULT")
    yield 1
    seen["before"] = state()
    drags = []
    for length in range(190, 270, 10):  # as a slider sets it, many times a second
        start = own_time()
        phantom().mphdrr_volume.nema.length = length
        drags.append(own_time() - start)
        yield 0.05
    seen["dragging"], seen["seconds"] = state(), sorted(drags)
    bpy.ops.ed.undo_push(message="Length")
    yield has_length(260)
    seen["rested"] = state()
    keys("ctrl+z")  # the update
    yield 1
    keys("ctrl+z")  # the edit
    yield has_length(180)
    seen["undone"] = state()
    phantom().mphdrr_volume.nema.voxels = 30
    phantom().mphdrr_volume.nema.length = 220  # few enough voxels to be made at once
    seen["small"] = state()

    with within():
        bpy.ops.mphdrr.remove_slices("EXEC_DEFAULT", True)
        phantom().hide_set(True)
        bpy.ops.mphdrr.add_torso("INVOKE_DEFAULT", True, confirmed=True, voxels=32, frames=3)
    yield lambda: bpy.context.object.name.startswith("Cardiac")
    torso, shown = bpy.context.object, set()

    def has_played() -> bool:
        shown.add(torso.data.grids.frame)
        return len(shown) == 3

    area.spaces.active.shading.type = "SOLID"
    bpy.ops.screen.animation_play()
    yield has_played
    seen["frames"] = sorted(shown)


run(steps())
