"""Jobs in a real Blender's window: how long it stands still in each, their words, the queue, cancelling in every stage.

Arguments after ``--``: the file for what was seen, the workbook.
"""

import itertools
import json
import sys
import time
import traceback
from pathlib import Path

import bpy
import numpy as np

result_file, workbook = Path(sys.argv[-2]), sys.argv[-1]
bpy.context.preferences.view.show_splash = False
jobs = next(module for name, module in sys.modules.items() if name.endswith(".addon.blender.jobs"))
seen: dict = {"ok": False, "gaps": {}, "words": [], "changed": []}
beats: list[float] = []


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


def longest() -> float:
    return round(max(b - a for a, b in itertools.pairwise(beats)), 3)


def view():
    """The largest area, which is the 3D view to begin with, as the context."""
    window = bpy.context.window_manager.windows[0]
    area = max(window.screen.areas, key=lambda area: area.width * area.height)
    region = next(r for r in area.regions if r.type == "WINDOW")
    return bpy.context.temp_override(window=window, area=area, region=region)


def start(operator, **settings) -> None:
    with view():
        outcome = operator("INVOKE_DEFAULT", confirmed=True, **settings)
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
        during = longest()
        beats.clear()
        for _ in range(3):
            for area in bpy.context.window_manager.windows[0].screen.areas:
                area.tag_redraw()
            yield 0.1
        seen["gaps"].setdefault(name, []).append(round(during - longest(), 3))
        if seen["gaps"][name][-1] < 0.1:
            break
    note()


def state() -> dict[str, object]:
    """Names, users, custom properties and pixels of the file's data, and the run file."""
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
    """Cancel a job in a stage; what is in the file is as before."""
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
    with view():
        area = bpy.context.area
    area.spaces.active.show_region_ui = True
    yield 1.0
    next(r for r in area.regions if r.type == "UI").active_panel_category = "mphDRR"
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    mph.import_geometry(filepath=workbook)
    yield 2.0
    # Without the 3D view, which takes seconds to draw in software: what is measured is not the drawing.
    area.type = "TEXT_EDITOR"
    yield 1.0
    render = {"width": 256, "height": 256, "volume": "Derenzo"}
    folder = result_file.parent
    yield from measured("phantom", mph.add_derenzo, voxels=128)
    yield from measured("projecting", mph.render_projections, **render)
    yield from measured("dataset", mph.export_dataset, filepath=str(folder / "a.h5"))
    yield from measured("volume", mph.export_volume, filepath=str(folder / "a.nii.gz"))
    yield from measured("solids", mph.export_for_program, format="stl", filepath=str(folder / "a.stl"))
    for stage in ("projecting", "packing", "storing"):
        yield from cancelled(stage, mph.render_projections, **render)
    note()
    # The scene is usable: undo works, and it can be rendered again.
    bpy.data.objects["Derenzo"].location.x = 12.0
    with view():
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
    seen["ok"] = True


def note() -> None:
    result_file.write_text(json.dumps(seen, indent=1))


running = steps()


def drive() -> float | None:
    try:
        return next(running)
    except StopIteration:
        pass
    except Exception:
        seen["error"] = traceback.format_exc()
    note()
    return None


bpy.app.timers.register(beat)
bpy.app.timers.register(drive, first_interval=1.5)
