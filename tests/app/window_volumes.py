"""Volumes in the window: NEMA's slices and shell, an arrow that is dragged, a map; a picture of each.

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
addon = sys.modules["bl_ext.user_default.mphdrr"].__name__ + ".addon"


def viewport():
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == "VIEW_3D"), key=lambda a: a.width)
    return window, area, next(r for r in area.regions if r.type == "WINDOW")


def in_view(operator: str, *arguments: object, **settings: object) -> None:
    window, area, region = viewport()
    with bpy.context.temp_override(window=window, area=area, region=region):
        group, name = operator.split(".")
        getattr(getattr(bpy.ops, group), name)(*arguments, **settings)


def on_screen(place) -> tuple[int, int]:
    """Where a place in the world is on the screen."""
    window, _, region = viewport()
    x, y = location_3d_to_region_2d(region, region.data, place)
    return round(region.x + x), round(window.height - region.y - y)


def look(distance: float, angles=(0.0, 0.0, 0.0)) -> None:
    view = viewport()[2].data
    view.view_perspective, view.view_rotation = "ORTHO", Euler(angles).to_quaternion()
    view.view_location, view.view_distance = (0.0, 0.0, 0.0), distance


def picture(name: str) -> None:
    subprocess.run(["import", "-window", "root", str(folder / f"{name}.png")], check=True)


def frame() -> list[int]:
    """Left, top, right and bottom of the 3D view on the screen."""
    window, _, region = viewport()
    top = window.height - region.y - region.height
    return [region.x, top, region.x + region.width, top + region.height]


def steps():
    """Yields seconds to wait."""
    from importlib import import_module

    color_bar, slices = import_module(f"{addon}.perspective.color_bar"), import_module(f"{addon}.volumes.slices")
    for name in ("Cube", "Light", "Camera"):
        bpy.data.objects[name].hide_set(True)
    space = viewport()[1].spaces.active
    space.overlay.show_floor = space.overlay.show_axis_x = space.overlay.show_axis_y = False
    space.overlay.show_text = space.show_gizmo_navigate = False
    in_view("mphdrr.add_nema", "EXEC_DEFAULT", True, voxels=80)
    in_view("mphdrr.add_slices", "EXEC_DEFAULT", True)
    nema = bpy.context.object
    settings, nema_name = nema.mphdrr_volume, nema.name
    affine = slices._stored(nema).grid.affine
    middle = (-affine[:3, 3] / affine.diagonal()[:3]).round().astype(int).tolist()
    settings.slices = middle
    settings.display_low = 5.5  # above the background
    for plane in slices.planes_of(nema)[:2]:
        plane.hide_set(True)
    nema.hide_set(False)
    look(500.0)
    seen["frame"] = frame()
    yield 4
    picture("slice")
    settings.display_low = 0.0
    for plane in slices.planes_of(nema):
        plane.hide_set(False)
    look(900.0, (1.05, 0.0, 0.95))
    yield 4
    picture("slices")
    before = list(settings.slices)
    start, step = slices.way(nema, 2)
    place = start + step * before[2]
    ends = on_screen(place + step * 6), on_screen(place + step * 16)
    seen["arrow"] = ends
    subprocess.run(["xdotool", "mousemove", *map(str, ends[0])], check=True)
    yield 2
    subprocess.run(["xdotool", "mousedown", "1"], check=True)
    yield 0.5
    for share in (0.3, 0.7, 1.0):
        at = [str(round(a + share * (b - a))) for a, b in zip(*ends, strict=True)]
        subprocess.run(["xdotool", "mousemove", *at], check=True)
        yield 0.7
    subprocess.run(["xdotool", "mouseup", "1"], check=True)
    yield 2
    seen["dragged"] = [before, list(settings.slices)]
    plane = slices.planes_of(nema)[2]
    image = plane.data.materials[0].node_tree.nodes["Slice"].image
    bpy.ops.ed.undo_push(message="Before")
    painted = list(image.pixels)
    settings.slices = [*settings.slices[:2], before[2]]
    bpy.ops.ed.undo_push(message="Slice moved")
    moved = list(image.pixels)
    in_view("ed.undo")
    yield 1
    nema = bpy.data.objects[nema_name]
    settings = nema.mphdrr_volume
    image = slices.planes_of(nema)[2].data.materials[0].node_tree.nodes["Slice"].image
    seen["undone"] = [settings.slices[2], painted != moved, list(image.pixels) == painted]
    settings.look = "CUT"
    yield 4
    picture("cut")
    slices.remove_slices(nema)
    settings.look = "SHELL"
    yield 3
    picture("shell")
    nema.hide_set(True)
    for child in nema.children:
        child.hide_set(True)
    in_view("mphdrr.add_torso", "EXEC_DEFAULT", True, voxels=64)
    torso = bpy.context.object
    torso.mphdrr_volume.look = "SHELL"
    yield 4
    picture("heart")
    torso.hide_set(True)
    for child in torso.children:
        child.hide_set(True)
    in_view("mphdrr.import_geometry", "EXEC_DEFAULT", True, filepath=WORKBOOK)
    in_view("mphdrr.add_map", "EXEC_DEFAULT", True, quantity="sensitivity", voxels=32)
    in_view("mphdrr.show_modules", "EXEC_DEFAULT", True, first=1, last=40, mode="ONLY")
    look(420.0, (1.05, 0.0, 0.95))
    viewport()[2].data.view_location = (0.0, 0.0, -30.0)
    yield 5
    picture("map")
    seen["map"] = [on_screen((0.0, 0.0, 0.0)), on_screen((60.0, -60.0, 60.0))]
    left, bottom, width, height = color_bar.place()
    window, _, region = viewport()
    seen["bar"] = [region.x + left, window.height - region.y - bottom - height, width, height]
    space.show_region_ui = True
    bpy.context.view_layer.objects.active = bpy.data.objects["Sensitivity map"]
    look(600.0, (1.05, 0.0, 0.95))
    yield 2
    next(region for region in viewport()[1].regions if region.type == "UI").active_panel_category = "mphDRR"
    seen["ok"] = True


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
