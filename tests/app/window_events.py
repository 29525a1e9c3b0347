"""Events of a recipe in the window: tried on the phantom, made as a set (cancelled, then gone on with), one opened.

Argument after ``--``: the file for what was seen.
"""

import itertools
import json
import sys
import time
import traceback
from pathlib import Path

import bpy

result_file = Path(sys.argv[sys.argv.index("--") + 1])
folder = result_file.parent
bpy.context.preferences.view.show_splash = False
WORKBOOK = Path(bpy.utils.user_resource("EXTENSIONS")) / "user_default/mphdrr/examples/dc-spect-80.xlsx"
ours = {name.rpartition(".addon.")[2]: module for name, module in sys.modules.items() if ".mphdrr.addon." in name}
jobs, runs, event_notes = ours["blender.jobs"], ours["runs.runs"], ours["events.event_notes"]
seen: dict = {"ok": False, "numbers": [], "poses": [], "words": [], "pauses": []}
beats: list[float] = []
RECIPE = f"""
version = 1
seed = 4
[system]
file = '{WORKBOOK}'
modules = "1-8"
[detector]
rows = 64
columns = 64
[truth]
voxels = 64
spacing = 1.5
[[phantoms]]
kind = "derenzo"
radius = {{ from = 28, to = 36 }}
rod_diameters = [8, 7, 6, 5, 0, 0]
[phantoms.pose]
position = [{{ from = -8, to = 8 }}, 0, {{ from = -8, to = 8 }}]
turn = "uniform"
[[phantoms]]
kind = "defrise"
odds = 0.5
disk_radius = {{ from = 20, to = 30 }}
disks = {{ from = 2, to = 4 }}
[phantoms.pose]
turn = "uniform"
[models.lines]
kind = "transmission"
[radon]
angles = 32
"""


def own_time() -> float:
    """Seconds, without those in which this thread could run but other work had the processor (Linux counts them)."""
    try:
        waited = int(Path("/proc/thread-self/schedstat").read_text().split()[1])
    except OSError:
        waited = 0
    return time.perf_counter() - waited * 1e-9


def beat() -> float:
    """The timer whose pauses are measured."""
    beats.append(own_time())
    if jobs._current is not None and jobs._current.text not in seen["words"]:
        seen["words"].append(jobs._current.text)
    return 0.02


def view(kind: str = "VIEW_3D") -> dict:
    window = bpy.context.window_manager.windows[0]
    area = max((a for a in window.screen.areas if a.type == kind), key=lambda a: a.width)
    return {"window": window, "area": area, "region": next(r for r in area.regions if r.type == "WINDOW")}


def press(operator, **settings):
    """Press a button of the panel, and wait until its job is done."""
    with bpy.context.temp_override(**view()):
        outcome = operator("INVOKE_DEFAULT", **settings)
    assert outcome == {"RUNNING_MODAL"}, outcome
    while jobs.is_running():
        yield 0.02
    yield 0.3


def only_panel() -> None:
    """So that all of it is on the screen."""
    sidebar = next(region for region in view()["area"].regions if region.type == "UI")
    sidebar.active_panel_category = "mphDRR"
    panels = [getattr(bpy.types, name) for name in dir(bpy.types) if name.startswith("MPHDRR_PT_")]
    others = [cls for cls in panels if "event" not in cls.__name__]
    for cls in sorted(others, key=lambda cls: not hasattr(cls, "bl_parent_id")):  # a panel after those in it
        bpy.utils.unregister_class(cls)
    panel = bpy.types.MPHDRR_PT_event_set
    bpy.utils.unregister_class(panel)
    panel.bl_options = set()  # open
    bpy.utils.register_class(panel)


def pose() -> list[list[float]]:
    item = bpy.context.scene.mphdrr_events.phantom
    return [[round(x, 4) for x in row] for row in item.matrix_world]


def steps():
    mph, settings = bpy.ops.mphdrr, bpy.context.scene.mphdrr_events
    view()["area"].spaces.active.show_region_ui = True
    yield 1.0
    only_panel()
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    (folder / "events.toml").write_text(RECIPE)
    settings.recipe, settings.folder, settings.count = str(folder / "events.toml"), str(folder / "set"), 12
    while event_notes.of_recipe(settings.recipe).text == "Reading …":
        yield 0.1
    note = event_notes.of_recipe(settings.recipe)
    seen["note"] = [note.text, note.is_wrong]
    for _ in range(3):
        yield from press(mph.try_event)
        settings = bpy.context.scene.mphdrr_events
        seen["numbers"].append(settings.number)
        seen["poses"].append(pose())
    with bpy.context.temp_override(**view()):
        bpy.ops.ed.undo()
    yield 0.5
    settings = bpy.context.scene.mphdrr_events
    seen["undone"], seen["number_undone"] = pose(), settings.number
    yield from press(mph.try_event)

    # Without the 3D view, which takes seconds to draw in software: what is measured is not the drawing.
    area = view()["area"]
    area.type = "TEXT_EDITOR"
    yield 1.0
    made = folder / "set" / "events"
    window = bpy.context.window_manager.windows[0]
    beats.clear()
    with bpy.context.temp_override(window=window, area=area, region=area.regions[-1]):
        assert mph.make_event_set("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    while len(list(made.glob("0*.h5"))) < 3:
        yield 0.02
    mph.cancel_job()
    while jobs.is_running():
        yield 0.02
    yield from note_pause()
    first = {path.name: path.stat().st_mtime_ns for path in made.glob("*.h5")}
    seen["after_cancel"] = len(first)
    beats.clear()
    with bpy.context.temp_override(window=window, area=area, region=area.regions[-1]):
        assert mph.make_event_set("INVOKE_DEFAULT") == {"RUNNING_MODAL"}
    while jobs.is_running():
        yield 0.02
    yield from note_pause()
    area.type = "VIEW_3D"
    area.spaces.active.show_region_ui = True
    yield 1.0
    next(region for region in area.regions if region.type == "UI").active_panel_category = "mphDRR"
    seen["made"] = len(list(made.glob("*.h5")))
    seen["kept"] = all((made / name).stat().st_mtime_ns == when for name, when in first.items())
    settings = bpy.context.scene.mphdrr_events
    settings.opened = 3
    yield from press(mph.open_event)
    scene = bpy.context.scene
    seen["opened"], seen["run"] = scene.mphdrr_events.truth.name, runs.shown(scene).name
    seen["image"] = view("IMAGE_EDITOR")["area"].spaces.active.image.name
    seen["changes"] = runs.changes(scene)
    yield 3.0  # until the note of the set is read
    seen["ok"] = True


def note_pause():
    """The longest pause of the window in the job, without what a redraw of all of it takes."""
    during = longest()
    beats.clear()
    for _ in range(3):
        for area in bpy.context.window_manager.windows[0].screen.areas:
            area.tag_redraw()
        yield 0.1
    seen["pauses"].append(round(during - longest(), 3))


def longest() -> float:
    return max(b - a for a, b in itertools.pairwise(beats))


running = steps()


def drive() -> float | None:
    again = None
    try:
        again = next(running)
    except StopIteration:
        pass
    except Exception:
        seen["error"] = traceback.format_exc()
    if again is None or "error" in seen:
        result_file.write_text(json.dumps(seen, indent=1))
        return None
    return again


bpy.app.timers.register(beat)
bpy.app.timers.register(drive, first_interval=1.5)
