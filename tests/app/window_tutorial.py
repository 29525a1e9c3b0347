"""The tutorial (docs/tutorial.md) in the window, step by step, as a user does it, with a picture of each step.

A step is a generator: it yields what to wait for, and returns what it found, in words that its text must contain. Its name
is its picture's. To add one, write it here, and its section with that picture in the page; `make tutorial` takes all
pictures anew.
"""

from collections.abc import Callable

import bpy
import numpy as np
from driving import drawn, editor, folder, is_idle, module, open_tab, opened, press, run, scanner, seen, sidebar
from pointing import keys, picture, xdotool

STEPS: list[Callable] = []


def mouse(x: float, y: float, *buttons: int) -> None:
    xdotool("mousemove", round(x), round(y))
    for button in buttons:
        xdotool("click", button)


def scroll(down: int):
    """Turn the wheel over the sidebar, down, or up where negative; yield what to wait for."""
    region = sidebar()
    top = region.view2d.region_to_view(0, 0)[1]
    middle = editor()[0].height - region.y - region.height / 2
    mouse(region.x + 0.4 * region.width, middle, *([5 if down > 0 else 4] * abs(down)))
    yield lambda: region.view2d.region_to_view(0, 0)[1] != top
    mouse(region.x - 40, middle)  # no tooltip covers it


def totals() -> dict[int, float]:
    """Return the sum of each module's image, from the exact images in the .blend."""
    images = {i.name: i for i in bpy.data.images}
    return {n: float(np.asarray(images[f"mphDRR {n:02d}"].pixels[:])[::4].sum()) for n in (54, 55)}


@STEPS.append
def load():
    opened("MPHDRR_PT_design", "MPHDRR_PT_projections", "MPHDRR_PT_export")
    _, area, _ = editor("VIEW_3D")
    area.spaces.active.show_region_ui = True
    yield 1
    open_tab()
    yield 1
    press(bpy.ops.mphdrr.load_example)
    yield 1
    yield is_idle
    yield from drawn()  # the mosaic is fitted to its editor once that is drawn
    planes = [o for o in bpy.data.objects if o.mphdrr_module.part == "PLANE"]
    rings = sum(c.mphdrr_scanner.is_ring for c in scanner().children)
    return [f"{scanner().mphdrr_scanner.count} modules", f"{rings} rings", f"{len(planes)} projections", "Derenzo"]


@STEPS.append
def tile():
    window, area, region = editor("IMAGE_EDITOR")
    image = area.spaces.active.image
    tiles = image["mphdrr_tiles"].to_dict()
    row, column = np.reshape(tiles["corners"], (-1, 2))[tiles["numbers"].index(55)] + np.multiply(tiles["tile"], 0.7)
    x, y = region.view2d.view_to_region(column / image.size[0], 1 - row / image.size[1], clip=False)
    mouse(region.x + x, window.height - region.y - y, 1)
    yield lambda: bpy.context.view_layer.objects.active == module(55)
    return [module(55).name]


@STEPS.append
def look():
    view = editor("VIEW_3D")[1].spaces.active.region_3d
    seen["view"] = [view.view_distance, *view.view_location, *view.view_rotation]
    press(bpy.ops.mphdrr.look_through_module, number=55)
    yield 1
    assert view.view_perspective == "CAMERA"
    return [bpy.context.scene.camera.name]


@STEPS.append
def change():
    view, kept = editor("VIEW_3D")[1].spaces.active.region_3d, seen.pop("view")
    view.view_perspective, view.view_distance = "PERSP", kept[0]
    view.view_location, view.view_rotation = kept[1:4], kept[4:]
    yield from scroll(7)
    numbers = module(55).mphdrr_module
    before = [
        f"{numbers.sensitivity:.2f} cps/MBq",
        f"{numbers.resolution:.2f} mm",
        f"{numbers.pinhole_diameter:.1f} mm",
    ]
    numbers.pinhole_diameter = 4.0
    yield lambda: f"{numbers.sensitivity:.2f} cps/MBq" != before[0]
    return [*before, f"{numbers.sensitivity:.2f} cps/MBq", f"{numbers.resolution:.2f} mm", "4 mm"]


@STEPS.append
def render():
    settings = bpy.context.scene.mphdrr_projections
    settings.model, settings.time = "EMISSION", 60.0
    settings.width = settings.height = 128
    press(bpy.ops.mphdrr.render_projections)
    yield 1
    yield is_idle
    counts = totals()
    yield from scroll(12)
    return [f"{counts[55] / counts[54]:.1f} times", "SPECT Counts", "60", "128"]


@STEPS.append
def display():
    before = totals()
    settings = bpy.context.scene.mphdrr_display
    settings.colors, settings.scale = "VIRIDIS", "SQRT"
    yield from drawn()
    assert totals() == before, "the numbers stay"
    mouse(sidebar().x, 300)  # where the popover is put
    window, area, _ = editor()
    with bpy.context.temp_override(window=window, area=area, region=sidebar()):
        bpy.ops.wm.call_panel("INVOKE_DEFAULT", name="MPHDRR_PT_display")
    return ["Viridis", "Square Root"]


@STEPS.append
def export():
    keys("Escape")  # the popover closes
    yield 1
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "heart.blend"))
    press(bpy.ops.mphdrr.export_dataset, "EXEC_DEFAULT", filepath=str(folder / "run.h5"))
    yield 1
    (inside,) = folder.glob("heart_*")
    return ["heart.blend", inside.name, "run.h5"]


def steps():
    """Take the tutorial's steps, and a picture of each."""
    for function in STEPS:
        seen[function.__name__] = yield from function()
        yield 1
        yield from drawn()
        picture(function.__name__)


run(steps(), patience=60.0)
