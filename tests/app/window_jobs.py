"""Jobs in a real Blender's window: how long it stands still in each, their words, the queue, cancelling in every stage.

Arguments after ``--``: the file for what was seen, the workbook, the pixels along a side of the images.
"""

import json
import resource
import sys
import time
import traceback
from pathlib import Path

import bpy

result_file, workbook, pixels = Path(sys.argv[-3]), sys.argv[-2], int(sys.argv[-1])
bpy.context.preferences.view.show_splash = False
jobs = next(module for name, module in sys.modules.items() if name.endswith(".addon.jobs"))
seen: dict = {"ok": False, "gaps": {}, "words": [], "memory": {}}
beats: list[float] = []


def beat() -> float:
    """The timer whose pauses are measured."""
    beats.append(time.perf_counter())
    if jobs._current is not None:
        text = jobs._current.text
        if text not in seen["words"]:
            seen["words"].append(text)
    return 0.02


def area(kind: str):
    return next((a for a in bpy.context.window_manager.windows[0].screen.areas if a.type == kind), None)


def inside():
    view = area("VIEW_3D")
    region = next(r for r in view.regions if r.type == "WINDOW")
    return bpy.context.temp_override(window=bpy.context.window_manager.windows[0], area=view, region=region)


def longest() -> float:
    return max((b - a for a, b in zip(beats, beats[1:])), default=0.0)


def start(operator, **settings) -> None:
    with inside():
        outcome = operator("INVOKE_DEFAULT", **settings)
    assert outcome == {"RUNNING_MODAL"}, outcome


def measured(name: str, operator, **settings):
    """Do a job, and note the longest pause until it is done and what it has made is drawn."""
    seen["memory"][name] = 0
    beats.clear()
    start(operator, **settings)
    while jobs.is_running():
        yield 0.03
    yield 0.5
    seen["gaps"][name] = round(longest(), 3)
    seen["memory"][name] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6, 2)


def state() -> str:
    """All that is in the file, as text: names, users, properties, custom properties, pixels."""
    lines = []
    for kind in ("objects", "images", "collections", "cameras", "meshes", "materials", "volumes", "texts", "scenes"):
        for item in getattr(bpy.data, kind):
            lines.append(f"{kind} {item.name} {item.users} {item.as_pointer()}")
            lines += [f"  {key} {item[key]!r}" for key in item.keys()]
            for name, property in item.bl_rna.properties.items():
                if property.type in ("BOOLEAN", "INT", "FLOAT", "STRING", "ENUM") and name != "pixels":
                    value = getattr(item, name)
                    lines.append(f"  {name} {value[:] if getattr(property, 'is_array', False) else value!r}")
            if kind == "images":
                lines.append(f"  {hash(tuple(item.pixels))} {item.packed_file and item.packed_file.size}")
    run_file = bpy.context.scene.mphdrr_projections.run_file
    lines.append(f"{run_file} {Path(run_file).stat().st_mtime_ns if run_file else ''}")
    folder = Path(run_file).parent
    lines.append(f"{sorted(p.name for p in folder.iterdir() if p.suffix == '.h5') if run_file else ''}")
    return "\n".join(lines)


def cancelled(name: str, stage: str, operator, **settings):
    """Cancel a job in a stage; what is in the file is as before."""
    before = state()
    start(operator, **settings)
    while jobs._current is not None and jobs._current.stage != stage:
        yield 0.0
    assert jobs._current is not None, f"{name}: has no stage {stage}"
    bpy.ops.mphdrr.cancel_job()
    while jobs.is_running():
        yield 0.02
    yield 0.1
    after = state()
    if before != after:
        a, b = (set(text.splitlines()) for text in (before, after))
        seen.setdefault("changed", []).append([name, stage, sorted(a - b)[:5], sorted(b - a)[:5]])


def steps():
    mph = bpy.ops.mphdrr
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    view = area("VIEW_3D")
    view.spaces.active.show_region_ui = True
    yield 1.0
    next(r for r in view.regions if r.type == "UI").active_panel_category = "mphDRR"
    yield 2.0
    mph.import_geometry(filepath=workbook)
    yield 4.0
    yield from measured("phantom of 64", mph.add_nema, voxels=64)
    yield from measured("phantom of 128", mph.add_derenzo, voxels=128)
    bpy.app.timers.register(beat, persistent=True) if not bpy.app.timers.is_registered(beat) else None
    yield 1.0
    # What a redraw of all this costs, with nothing to do.
    beats.clear()
    for _ in range(3):
        for each in bpy.context.window_manager.windows[0].screen.areas:
            each.tag_redraw()
        yield 0.3
    seen["redraw"] = round(longest(), 3)
    render = dict(width=pixels, height=pixels, volume="Derenzo")
    yield from measured("projecting", mph.render_projections, **render)
    yield 3.0
    beats.clear()
    for _ in range(3):
        for each in bpy.context.window_manager.windows[0].screen.areas:
            each.tag_redraw()
        yield 0.3
    seen["redraw with planes"] = round(longest(), 3)
    yield from measured("projecting again", mph.render_projections, **render)
    yield from measured("exporting a volume", mph.export_volume, filepath=str(result_file.with_name("a.nii.gz")))
    note()
    for stage in ("reading", "projecting", "writing the run file", "storing"):
        yield from cancelled("render", stage, mph.render_projections, **render)
    seen["ok"] = "changed" not in seen


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
