"""The tutorial (docs/tutorial.md) in the window, step by step, as a user does it, with a picture of each step.

Argument after ``--``: a folder for the pictures, the tutorial's files and ``said.json``: what each step found, in words that
its text must contain. A step is a generator: it yields what to wait for, and returns these words; its name is its picture's.
To add one, write it here, and its section with that picture in the page; `make tutorial` takes all pictures anew.
"""

import json
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

import bpy
import numpy as np

folder = Path(sys.argv[sys.argv.index("--") + 1])
bpy.context.preferences.view.show_splash = False
said: dict[str, object] = {}

STEPS: list[Callable] = []
_PATIENCE = 60.0  # s
_DRAWN = 4.0  # s until all is drawn, in software


def editor(kind: str):
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == kind), key=lambda a: a.width * a.height)
    return window, area, next(r for r in area.regions if r.type == "WINDOW")


def press(operator: Callable, how: str = "INVOKE_DEFAULT", **settings: object) -> None:
    """Call an operator as its button in the 3D view's sidebar does."""
    window, area, region = editor("VIEW_3D")
    with bpy.context.temp_override(window=window, area=area, region=region):
        operator(how, True, **settings)


def mouse(x: float, y: float, *buttons: int) -> None:
    subprocess.run(["xdotool", "mousemove", str(round(x)), str(round(y))], check=True)
    for button in buttons:
        subprocess.run(["xdotool", "click", str(button)], check=True)


def scroll(down: int):
    """Turn the wheel over the sidebar, down, or up where negative; yields what to wait for."""
    window, area, _ = editor("VIEW_3D")
    sidebar = next(region for region in area.regions if region.type == "UI")
    top = sidebar.view2d.region_to_view(0, 0)[1]
    middle = window.height - sidebar.y - sidebar.height / 2
    mouse(sidebar.x + 0.4 * sidebar.width, middle, *([5 if down > 0 else 4] * abs(down)))
    yield lambda: sidebar.view2d.region_to_view(0, 0)[1] != top


def idle() -> bool:
    """Whether no job is running."""
    return not len(bpy.context.window_manager.windows[0].modal_operators)


def scanner():
    return next(c for c in bpy.data.collections if c.mphdrr_scanner.is_scanner)


def module(number: int):
    return next(o for o in scanner().all_objects if o.mphdrr_module.is_module and o.mphdrr_module.number == number)


def totals() -> dict[int, float]:
    """The sum of each module's image, from the exact images in the .blend."""
    images = {i.name: i for i in bpy.data.images}
    return {n: float(np.asarray(images[f"mphDRR {n:02d}"].pixels[:])[::4].sum()) for n in (54, 55)}


def open_from_the_start(*panels: str) -> None:
    """Have panels open that are closed by default: their headers' places are not known to a script that clicks."""
    for name in panels:
        panel = getattr(bpy.types, name)
        bpy.utils.unregister_class(panel)
        panel.bl_options = set()
        bpy.utils.register_class(panel)


def step(function: Callable) -> Callable:
    STEPS.append(function)
    return function


@step
def load():
    open_from_the_start("MPHDRR_PT_design", "MPHDRR_PT_display")
    _, area, _ = editor("VIEW_3D")
    area.spaces.active.show_region_ui = True
    yield 1
    next(region for region in area.regions if region.type == "UI").active_panel_category = "mphDRR"
    yield 1
    press(bpy.ops.mphdrr.load_example)
    yield 1
    yield idle
    yield 6  # the mosaic is fitted to its editor once that is drawn
    planes = [o for o in bpy.data.objects if o.mphdrr_module.part == "PLANE"]
    rings = sum(c.mphdrr_scanner.is_ring for c in scanner().children)
    return [f"{scanner().mphdrr_scanner.count} modules", f"{rings} rings", f"{len(planes)} projections", "Derenzo"]


@step
def tile():
    window, area, region = editor("IMAGE_EDITOR")
    image = area.spaces.active.image
    tiles = image["mphdrr_tiles"].to_dict()
    row, column = np.reshape(tiles["corners"], (-1, 2))[tiles["numbers"].index(55)] + np.multiply(tiles["tile"], 0.7)
    x, y = region.view2d.view_to_region(column / image.size[0], 1 - row / image.size[1], clip=False)
    mouse(region.x + x, window.height - region.y - y, 1)
    yield lambda: bpy.context.view_layer.objects.active == module(55)
    return [module(55).name]


@step
def look():
    view = editor("VIEW_3D")[1].spaces.active.region_3d
    said["view"] = [view.view_distance, *view.view_location, *view.view_rotation]
    press(bpy.ops.mphdrr.look_through_module, number=55)
    yield 1
    assert view.view_perspective == "CAMERA"
    return [bpy.context.scene.camera.name]


@step
def change():
    view, kept = editor("VIEW_3D")[1].spaces.active.region_3d, said.pop("view")
    view.view_perspective, view.view_distance = "PERSP", kept[0]
    view.view_location, view.view_rotation = kept[1:4], kept[4:]
    yield from scroll(4)
    numbers = module(55).mphdrr_module
    before = [
        f"{numbers.sensitivity:.2f} cps/MBq",
        f"{numbers.resolution:.2f} mm",
        f"{numbers.pinhole_diameter:.1f} mm",
    ]
    numbers.pinhole_diameter = 4.0
    yield lambda: f"{numbers.sensitivity:.2f} cps/MBq" != before[0]
    return [*before, f"{numbers.sensitivity:.2f} cps/MBq", f"{numbers.resolution:.2f} mm", "4 mm"]


@step
def render():
    settings = bpy.context.scene.mphdrr_projections
    settings.model, settings.time = "EMISSION", 60.0
    settings.width = settings.height = 128
    press(bpy.ops.mphdrr.render_projections)
    yield 1
    yield idle
    counts = totals()
    yield from scroll(6)
    return [f"{counts[55] / counts[54]:.1f} times", "SPECT Counts", "60", "128"]


@step
def display():
    before = totals()
    settings = bpy.context.scene.mphdrr_display
    settings.colors, settings.scale = "VIRIDIS", "SQRT"
    yield 2
    assert totals() == before, "the numbers stay"
    yield from scroll(14)
    return ["Viridis", "Square Root"]


@step
def export():
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "heart.blend"))
    press(bpy.ops.mphdrr.export_dataset, "EXEC_DEFAULT", filepath=str(folder / "run.h5"))
    yield 1
    (inside,) = folder.glob("heart_*")
    yield from scroll(20)
    return ["heart.blend", inside.name, "run.h5"]


def work():
    """Do the steps."""
    for function in STEPS:
        said[function.__name__] = yield from function()
        yield _DRAWN
        subprocess.run(["import", "-window", "root", str(folder / f"{function.__name__}.png")], check=True)
    said["ok"] = True


def tick() -> float | None:
    """Go on when what the last step waits for has happened."""
    global wanted, since
    try:
        if callable(wanted):
            if not wanted():
                if time.monotonic() - since > _PATIENCE:
                    raise TimeoutError(f"waited in vain in {running.gi_yieldfrom.__name__}")
                return 0.2
            wanted = None
        wanted, since = next(running), time.monotonic()
        return 0.2 if callable(wanted) else wanted
    except StopIteration:
        pass
    except Exception:
        said["error"] = traceback.format_exc()
    (folder / "said.json").write_text(json.dumps(said))
    return None


wanted: object = None
since = 0.0
running = work()
bpy.app.timers.register(tick, first_interval=1.5)
