"""A phantom as one module sees it, from aside and from its pinhole, and a back-projection; a picture of each.

Arguments after ``--``: the file for what was seen, and the folder for the pictures.
"""

from __future__ import annotations

import json
import subprocess
import sys
import traceback
from pathlib import Path

import bpy
from bpy_extras.view3d_utils import location_3d_to_region_2d
from mathutils import Euler

result_file, folder = map(Path, sys.argv[sys.argv.index("--") + 1 :])
bpy.context.preferences.view.show_splash = False
seen: dict[str, object] = {"ok": False}
MODULE = 27


def viewport():
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == "VIEW_3D"), key=lambda a: a.width)
    return window, area, next(r for r in area.regions if r.type == "WINDOW")


def call(name: str, how: str = "EXEC_DEFAULT", **settings: object) -> None:
    """Call one of our operators; INVOKE_DEFAULT starts a job as its button does."""
    window, area, region = viewport()
    with bpy.context.temp_override(window=window, area=area, region=region):
        getattr(bpy.ops.mphdrr, name)(how, True, **settings)


def look(distance: float, angles, place=(0.0, 0.0, 0.0)) -> None:
    view = viewport()[2].data
    view.view_perspective, view.view_rotation = "ORTHO", Euler(angles).to_quaternion()
    view.view_location, view.view_distance = place, distance


def on_screen(place) -> tuple[int, int]:
    window, _, region = viewport()
    x, y = location_3d_to_region_2d(region, region.data, place)
    return round(region.x + x), round(window.height - region.y - y)


def picture(name: str) -> None:
    subprocess.run(["import", "-window", "root", str(folder / f"{name}.png")], check=True)


def only(*classes: str) -> None:
    """Only these panels are there, so that all of them is on the screen."""
    ours = [getattr(bpy.types, name) for name in dir(bpy.types) if name.startswith("MPHDRR_PT_")]
    others = [cls for cls in ours if cls.__name__ not in classes]
    for cls in sorted(others, key=lambda cls: not hasattr(cls, "bl_parent_id")):  # a panel after those in it
        bpy.utils.unregister_class(cls)
    for name in classes:
        cls = getattr(bpy.types, name)
        bpy.utils.unregister_class(cls)
        cls.bl_options = set()  # open
        bpy.utils.register_class(cls)


def steps():
    """Yields seconds to wait."""
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects[name].hide_set(True)
    space = viewport()[1].spaces.active
    space.show_region_ui, space.overlay.show_floor = True, False
    space.overlay.show_axis_x = space.overlay.show_axis_y = space.overlay.show_text = False
    call("import_geometry", filepath=WORKBOOK)
    yield 2
    scene = bpy.context.scene
    call("add_derenzo", voxels=160)
    yield from idle()
    phantom = bpy.context.object
    call("show_modules", first=MODULE, last=MODULE, mode="ONLY")
    camera = bpy.data.objects[f"Module {MODULE}"]
    scene.mphdrr_geometry.active_index = next(
        i for i, o in enumerate(scene.mphdrr_geometry.scanner.all_objects) if o == camera
    )
    bpy.context.view_layer.objects.active = phantom
    only("MPHDRR_PT_phantom", "MPHDRR_PT_perspective", "MPHDRR_PT_reconstruction", "MPHDRR_PT_backprojection")
    sidebar = next(region for region in viewport()[1].regions if region.type == "UI")
    yield 1
    sidebar.active_panel_category = "mphDRR"
    call("show_in_perspective", "INVOKE_DEFAULT")
    yield from idle()
    seen["shown"] = [o.name for o in bpy.data.objects if o.name.startswith("Perspective")]
    seen["active"] = bpy.context.object.name
    phantom.hide_set(True)
    middle = camera.matrix_world.translation * 0.4
    look(520.0, (1.2, 0.0, 0.6), middle)
    yield 5
    frustum = bpy.data.objects[f"Perspective {MODULE}"]
    seen["corners"] = [on_screen(frustum.matrix_world @ vertex.co) for vertex in frustum.data.vertices]
    picture("aside")
    call("look_through_module", number=MODULE)
    yield 5
    seen["through"] = [on_screen(frustum.matrix_world @ vertex.co) for vertex in frustum.data.vertices[1:]]
    seen["frame"] = [on_screen(camera.matrix_world @ corner) for corner in camera.data.view_frame()]
    picture("pinhole")
    look(520.0, (1.2, 0.0, 0.6), middle)
    viewport()[2].data.view_perspective = "ORTHO"
    bpy.context.view_layer.objects.active = camera
    camera.location.z += 15.0
    yield 3
    picture("moved")
    camera.location.z -= 15.0
    yield 1
    bpy.context.view_layer.objects.active = phantom
    call("resample_in_perspective", "INVOKE_DEFAULT")
    yield from idle()
    seen["kept"] = bpy.context.object.name
    bpy.ops.mphdrr.clear_perspective()
    call("add_slices")
    look(300.0, (1.05, 0.0, 0.95))
    yield 4
    picture("through")
    for item in bpy.context.scene.objects:
        if item.type == "VOLUME" or (item.parent is not None and item.parent.type == "VOLUME"):
            item.hide_set(True)
    call("show_modules", mode="ALL")
    settings = scene.mphdrr_projections
    settings.volume, settings.model, settings.width, settings.height = phantom, "TRANSMISSION", 128, 128
    call("render_projections", "INVOKE_DEFAULT")
    yield from idle()
    for name in ("MPHDRR_PT_perspective", "MPHDRR_PT_phantom"):  # the others are in sight
        bpy.utils.unregister_class(getattr(bpy.types, name))
    scene.mphdrr_display.planes = "NONE"
    scene.mphdrr_reconstruction.voxels, scene.mphdrr_reconstruction.how = 96, "PRODUCT"
    call("backproject", "INVOKE_DEFAULT")
    yield from idle()
    seen["backprojected"] = bpy.context.object.name
    look(420.0, (1.05, 0.0, 0.95))
    seen["middle"] = on_screen((0.0, 0.0, 0.0))
    seen["ok"] = True


def idle():
    """Wait until no job runs."""
    yield 0.5
    while bpy.context.window_manager.windows[0].modal_operators:
        yield 0.3


def tick() -> float | None:
    try:
        return next(running)
    except StopIteration:
        pass
    except Exception:
        seen["error"] = traceback.format_exc()
    result_file.write_text(json.dumps(seen))
    return None


WORKBOOK = str(Path(bpy.utils.user_resource("EXTENSIONS")) / "user_default/mphdrr/examples/dc-spect-80.xlsx")
running = steps()
bpy.app.timers.register(tick, first_interval=1.5)
