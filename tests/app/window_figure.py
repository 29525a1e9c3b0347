"""Figures by the operator, as the menu starts it, in a scene of scanner and phantom that is saved beside them."""

import io
import sys
import time

import bpy
from driving import WORKBOOK, drawn, editor, folder, idle, is_idle, press, run, seen
from pointing import escape_asks, picture


def steps():
    """Yield seconds to wait."""
    shown_in = bpy.context.preferences.view.render_display_type
    bpy.ops.mphdrr.import_geometry(filepath=str(WORKBOOK))
    bpy.ops.mphdrr.add_derenzo(voxels=48)
    bpy.ops.mphdrr.show_modules(modules="1-20", mode="ONLY")
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "scene.blend"))
    yield 0.5
    seen["ticks"] = 0
    for kind in ("cut-away", "sums"):
        settings = {"figure": kind.upper().replace("-", "_"), "width": 360, "height": 240, "samples": 8}
        press(bpy.ops.mphdrr.export_figure, filepath=str(folder / f"{kind}.png"), **settings)
        while not is_idle() or bpy.app.is_job_running("RENDER"):
            seen["ticks"] += 1
            yield 0.05
    film = {"width": 120, "height": 120, "samples": 1, "seconds": 0.1, "fps": 20}
    press(bpy.ops.mphdrr.render_animation, filepath=str(folder / "film.mp4"), **film)
    while not is_idle() or bpy.app.is_job_running("RENDER"):
        yield 0.05
    seen["film"] = bpy.data.movieclips.load(str(folder / "film.mp4")).frame_duration
    film |= {"figure": "LIGHT_UP", "seconds": 60}
    press(bpy.ops.mphdrr.render_animation, filepath=str(folder / "cut.mp4"), **film)
    while not list(folder.glob("cut-frames/*.png")):
        yield 0.05
    yield from escape_asks()
    bpy.ops.mphdrr.cancel_job()
    yield from idle()
    press(bpy.ops.mphdrr.render_picture, filepath=str(folder / "picture.png"), width=480, height=300, samples=8)
    yield from idle()
    yield from drawn()
    seen["shown"] = editor("IMAGE_EDITOR")[1].spaces.active.image.name
    picture("shown")
    seen.update(scenes=len(bpy.data.scenes), display=[shown_in, bpy.context.preferences.view.render_display_type])
    # Blender's own Render, as F12 starts it; what is said goes to standard error, which is kept.
    rendered, sys.stderr, scene = time.monotonic(), io.StringIO(), bpy.context.scene
    scene.render.engine, scene.cycles.samples = "CYCLES", 1
    scene.render.resolution_x = scene.render.resolution_y = 32
    scene.camera = next(item for item in scene.objects if item.type == "CAMERA")
    bpy.ops.render.render("INVOKE_DEFAULT")
    while bpy.app.is_job_running("RENDER") or not (sys.stderr.getvalue() or time.monotonic() > rendered + 20.0):
        yield 0.05
    seen["said"] = sys.stderr.getvalue()


run(steps())
