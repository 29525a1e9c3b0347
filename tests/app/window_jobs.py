"""Jobs in a real Blender's window: how long it stands still in each, their words, the queue, cancelling in every stage."""

import time
from pathlib import Path

import addon_utils
import bpy
import numpy as np
from driving import WORKBOOK, drawn, editor, folder, open_tab, ours, press, run, seen, within
from pauses import beat, beats, pause_beyond_redraw

jobs = ours("addon.blender.jobs")
seen |= {"gaps": {}, "words": [], "changed": []}


def start(operator, **settings) -> None:
    outcome = press(operator, kind="TEXT_EDITOR", confirmed=True, **settings)
    assert outcome == {"RUNNING_MODAL"}, outcome


def measured(name: str, operator, **settings):
    """Do a job; note the longest pause until what it has made is drawn, and the longest of a redraw of that.

    Where that is late, once or twice more: what always stands still is ours, the rest is the machine's other work.
    """
    for _ in range(3):
        beats.clear()
        start(operator, **settings)
        while jobs.is_running():
            yield 0.02
        yield 0.3
        seen["gaps"].setdefault(name, []).append((yield from pause_beyond_redraw()))
        if seen["gaps"][name][-1] < 0.1:
            break


def state() -> dict[str, object]:
    """Return names, users, custom properties and pixels of the file's data, and the run file."""
    found: dict[str, object] = {}
    for kind in ("objects", "images", "collections", "cameras", "meshes", "materials", "volumes", "texts"):
        for item in getattr(bpy.data, kind):
            own = {key: str(value) for key, value in item.items() if not key.startswith("mphdrr_m")}
            found[f"{kind} {item.name}"] = [item.users, item.as_pointer(), own]
    for image in bpy.data.images:
        pixels = np.empty(len(image.pixels), np.float32)
        image.pixels.foreach_get(pixels)
        found[f"pixels {image.name}"] = hash(pixels.tobytes())
    folder = Path(bpy.context.scene.mphdrr_projections.run_file).parent
    found["run files"] = sorted([path.name, path.stat().st_mtime_ns] for path in folder.glob("*.h5"))
    return found


def cancelled(stage: str, operator, **settings):
    """Cancel a job in a stage, and note what differs in the file from before."""
    before = state()
    start(operator, **settings)
    while jobs._current is not None and jobs._current.stage != stage:
        yield 0.0
    assert jobs._current is not None, f"no stage {stage}"
    bpy.ops.mphdrr.cancel_job()
    while jobs.is_running():
        yield 0.02
    yield 0.1
    after = state()
    if before != after:
        seen["changed"].append([stage, [key for key in before | after if before.get(key) != after.get(key)][:9]])


def steps():
    mph = bpy.ops.mphdrr
    area = editor()[1]
    area.spaces.active.show_region_ui = True
    yield 1.0
    open_tab()
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    mph.import_geometry(filepath=str(WORKBOOK))
    yield from drawn()
    # Without the 3D view, which takes seconds to draw in software: what is measured is not the drawing.
    area.type = "TEXT_EDITOR"
    yield from drawn()
    render = {"width": 256, "height": 256, "volume": "Derenzo"}
    yield from measured("phantom", mph.add_derenzo, voxels=128)
    yield from measured("projecting", mph.render_projections, **render)
    yield from measured("dataset", mph.export_dataset, filepath=str(folder / "a.h5"))
    yield from measured("volume", mph.export_volume, filepath=str(folder / "a.nii.gz"))
    yield from measured("solids", mph.export_for_program, format="stl", filepath=str(folder / "a.stl"))
    for stage in ("projecting", "packing", "storing"):
        yield from cancelled(stage, mph.render_projections, **render)
    # The scene is usable: undo works, and it can be rendered again.
    bpy.data.objects["Derenzo"].location.x = 12.0
    with within("TEXT_EDITOR"):
        bpy.ops.ed.undo_push(message="moved")
        bpy.ops.ed.undo()
    yield 0.5
    start(mph.render_projections, width=64, height=64)
    while jobs.is_running():
        yield 0.05
    seen["undone"] = bpy.data.objects["Derenzo"].location.x
    # Three jobs: the second is taken out of the queue, the first cancelled, the third done.
    for name in ("A", "B", "C"):
        start(mph.add_derenzo, name=name, voxels=192)
    yield 0.1
    first, second, third = jobs._current, *jobs._waiting
    seen["queue"] = [first.is_alive(), second.is_alive(), third.is_alive()]
    mph.cancel_job(number=second.number)
    mph.cancel_job(number=first.number)
    while jobs.is_running():
        yield 0.05
    seen["added"] = sorted(name for name in ("A", "B", "C") if name in bpy.data.objects)
    # Saved as another file while two jobs run: what they make goes with it, and the first file's folder stays as it was.
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "old.blend"))
    before = sorted(path.name for path in (folder / "old_mphdrr").glob("*"))
    start(mph.render_projections, **render)
    start(mph.add_derenzo, name="E", voxels=192)
    yield 0.3
    seen["running"] = jobs.is_running() and len(jobs._waiting)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "new.blend"))
    while jobs.is_running():
        yield 0.05
    yield 0.3
    seen["old_folder"] = [before, sorted(path.name for path in (folder / "old_mphdrr").glob("*"))]
    run_path = bpy.context.scene.mphdrr_projections.run_file
    seen["saved_meanwhile"] = [bpy.data.objects["E"].data.filepath, run_path]
    seen["exists"] = [Path(bpy.path.abspath(path)).is_file() for path in seen["saved_meanwhile"]]
    # Disabled while a job does not look up.
    show, jobs.Worker.show = jobs.Worker.show, lambda self, *step: time.sleep(3.0)
    start(mph.add_derenzo, name="D", voxels=192)
    yield 0.5
    since = time.perf_counter()
    addon_utils.disable("bl_ext.user_default.mphdrr")
    seen["disabled"] = time.perf_counter() - since
    yield 4.0
    jobs.Worker.show = show
    seen["left"] = "D" in bpy.data.objects


bpy.app.timers.register(beat)
run(steps())
