"""Events of a recipe in the window: tried on the phantom, made as a set (cancelled, then gone on with), one opened."""

import bpy
from driving import WORKBOOK, editor, folder, only, open_tab, ours, press, run, seen, within
from pauses import beat, beats, pause_beyond_redraw

jobs, runs, event_notes = map(ours, ("addon.blender.jobs", "addon.runs.runs", "addon.events.event_notes"))
seen |= {"numbers": [], "poses": [], "words": [], "pauses": []}
RECIPE = f"""
version = 1
seed = 4
system = {{ file = '{WORKBOOK}', modules = "1-8" }}
detector = {{ rows = 64, columns = 64 }}
truth = {{ voxels = 64, spacing = 1.5 }}
models = {{ lines = {{ kind = "transmission" }} }}
radon = {{ angles = 32 }}
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
"""


def job(operator):
    """Press a button of the panel, and wait until its job is done."""
    outcome = press(operator)
    assert outcome == {"RUNNING_MODAL"}, outcome
    while jobs.is_running():
        yield 0.02
    yield 0.3


def pose() -> list[list[float]]:
    item = bpy.context.scene.mphdrr_events.phantom
    return [[round(x, 4) for x in row] for row in item.matrix_world]


def steps():
    mph, settings = bpy.ops.mphdrr, bpy.context.scene.mphdrr_events
    editor()[1].spaces.active.show_region_ui = True
    yield 1.0
    open_tab()
    only("MPHDRR_PT_event_set")
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    (folder / "events.toml").write_text(RECIPE)
    settings.recipe, settings.folder, settings.count = str(folder / "events.toml"), str(folder / "set"), 12
    while event_notes.recipe_note(settings.recipe).text == "Reading …":
        yield 0.1
    note = event_notes.recipe_note(settings.recipe)
    seen["note"] = [note.text, note.is_wrong]
    for _ in range(3):
        yield from job(mph.try_event)
        settings = bpy.context.scene.mphdrr_events
        seen["numbers"].append(settings.number)
        seen["poses"].append(pose())
    with within():
        bpy.ops.ed.undo()
    yield 0.5
    settings = bpy.context.scene.mphdrr_events
    seen["undone"], seen["number_undone"] = pose(), settings.number
    yield from job(mph.try_event)

    # Without the 3D view, which takes seconds to draw in software: what is measured is not the drawing.
    area = editor()[1]
    area.type = "TEXT_EDITOR"
    yield 1.0
    made = folder / "set" / "events"
    beats.clear()
    assert press(mph.make_event_set, kind="TEXT_EDITOR") == {"RUNNING_MODAL"}
    while len(list(made.glob("0*.h5"))) < 3:
        yield 0.02
    mph.cancel_job()
    while jobs.is_running():
        yield 0.02
    seen["pauses"].append((yield from pause_beyond_redraw()))
    first = {path.name: path.stat().st_mtime_ns for path in made.glob("*.h5")}
    seen["after_cancel"] = len(first)
    beats.clear()
    assert press(mph.make_event_set, kind="TEXT_EDITOR") == {"RUNNING_MODAL"}
    while jobs.is_running():
        yield 0.02
    seen["pauses"].append((yield from pause_beyond_redraw()))
    area.type = "VIEW_3D"
    area.spaces.active.show_region_ui = True
    yield 1.0
    open_tab()
    seen["made"] = len(list(made.glob("*.h5")))
    seen["kept"] = all((made / name).stat().st_mtime_ns == when for name, when in first.items())
    settings = bpy.context.scene.mphdrr_events
    settings.opened = 3
    yield from job(mph.open_event)
    scene = bpy.context.scene
    seen["opened"], seen["run"] = scene.mphdrr_events.truth.name, runs.shown_run(scene).name
    seen["image"] = editor("IMAGE_EDITOR")[1].spaces.active.image.name
    seen["changes"] = runs.changes(scene)
    yield 3.0  # until the note of the set is read


bpy.app.timers.register(beat)
run(steps())
