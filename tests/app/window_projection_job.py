"""Run in a real Blender's window: a projection job runs to its end, one is cancelled half-way, the window stays alive.

    real-blender screenshot OUT.png tests/app/window_projection_job.py 60 RESULT.json WORKBOOK [FOLDER_WITH_PACKAGE]

Writes what it saw to RESULT.json; `ok` is true when all of it is as it should be. Without a folder the extension
must be installed and enabled.
"""

from __future__ import annotations

import itertools
import json
import sys
import time
from pathlib import Path

import bpy

arguments = sys.argv[sys.argv.index("--") + 1 :]
result_file = Path(arguments[0])
if len(arguments) > 2:
    sys.path.insert(0, arguments[2])
    import mphdrr

    mphdrr.register()

WORKBOOK = Path(arguments[1])
seen: dict = {"ok": False, "events": []}
progress: list[float] = []
beats: list[float] = []


def note(event: str) -> None:
    seen["events"].append(f"{time.perf_counter() - start:.1f} s: {event}")
    result_file.write_text(json.dumps(seen, indent=1))


def context():
    window = bpy.context.window_manager.windows[0]
    area = next(a for a in window.screen.areas if a.type == "VIEW_3D")
    region = next(r for r in area.regions if r.type == "WINDOW")
    return bpy.context.temp_override(window=window, area=area, region=region)


def start_job(**settings) -> None:
    progress.clear()
    beats.clear()
    with context():
        outcome = bpy.ops.mphdrr.render_projections("INVOKE_DEFAULT", **settings)
    note(f"invoked: {outcome}")
    assert outcome == {"RUNNING_MODAL"}, outcome


def job():
    """The job that runs now, or None, as the installed extension has it."""
    return next(module for name, module in sys.modules.items() if name.endswith(".addon.jobs"))._current


def share() -> float:
    """How much of the running job is done."""
    return job().done / max(1, job().total)


def ours() -> list[str]:
    return sorted(i.name for i in bpy.data.images if i.name.startswith("mphDRR"))


def steps():
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    bpy.ops.mphdrr.import_geometry(filepath=str(WORKBOOK))
    note("imported")
    with context():
        bpy.ops.mphdrr.add_derenzo(voxels=256)
    note("phantom added")
    for area in bpy.context.window_manager.windows[0].screen.areas:
        if area.type == "VIEW_3D":
            area.spaces.active.show_region_ui = True
    yield 1.0
    for area in bpy.context.window_manager.windows[0].screen.areas:
        if area.type == "VIEW_3D":
            next(r for r in area.regions if r.type == "UI").active_panel_category = "mphDRR"
    yield 0.5

    # Several rays per pixel, so that it takes long enough to be cancelled half-way.
    start_job(width=500, height=500, pixel_points=8)
    while job():
        yield 0.05
    seen["full"] = {"steps": len(set(progress)), "longest_pause_s": max(b - a for a, b in itertools.pairwise(beats))}
    assert len(ours()) == 81, ours()
    assert len(set(progress)) > 3, progress
    run_file = Path(bpy.context.scene.mphdrr_projections.run_file)
    assert seen["full"]["longest_pause_s"] < 2, seen
    note("first job is done")
    yield 0.5

    before = run_file.read_bytes()
    pixels = list(bpy.data.images["mphDRR 01"].pixels[:400])
    start_job(width=768, height=768, pixel_points=8)
    while job() and share() < 0.2:
        yield 0.05
    assert job()
    seen["cancelled_at"] = share()
    bpy.ops.mphdrr.cancel_job()
    asked = time.perf_counter()
    while job():
        yield 0.05
    seen["cancelled"] = {
        "seconds_to_stop": time.perf_counter() - asked,
        "longest_pause_s": max(b - a for a, b in itertools.pairwise(beats)),
    }
    assert seen["cancelled"]["seconds_to_stop"] < 2 and seen["cancelled"]["longest_pause_s"] < 2, seen
    assert run_file.read_bytes() == before and list(bpy.data.images["mphDRR 01"].pixels[:400]) == pixels
    assert [p.name for p in run_file.parent.iterdir() if p.suffix == ".h5"] == [run_file.name], "something half-written"
    note("second job is cancelled, nothing changed")

    # The scene is usable: move the phantom, undo works, render again.
    bpy.data.objects["Derenzo"].location.x = 12.0
    with context():
        bpy.ops.ed.undo_push(message="moved")
        bpy.ops.ed.undo()
    assert "Derenzo" in bpy.data.objects and len(bpy.context.scene.mphdrr_geometry.scanner.all_objects) > 80
    note("undone")
    yield 0.3
    start_job(width=128, height=128)
    while job():
        yield 0.05
    with context():
        bpy.ops.mphdrr.show_projections()
    seen["ok"] = True
    note("all is well")


bpy.context.preferences.view.show_splash = False
start = time.perf_counter()
running = steps()


def drive():
    beats.append(time.perf_counter())
    if job():
        progress.append(share())
    try:
        return next(running) or 0.05
    except StopIteration:
        return None
    except Exception as error:  # into the file, where the test looks
        import traceback

        seen["error"] = str(error)
        note(f"FAILED: {type(error).__name__}: {error} {traceback.format_exc()}")
        return None


bpy.app.timers.register(drive, first_interval=2.0)
