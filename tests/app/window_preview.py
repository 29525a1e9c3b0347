"""The example with a live preview: fifty moves of module and phantom, numbers edited; then the eyedropper."""

import bpy
import numpy as np
from driving import drawn, editor, folder, idle, open_tab, ours, press, run, seen
from pauses import own_time
from pointing import on_screen, picture, xdotool

core, preview, volumes = (ours(name) for name in ("core", "addon.runs.preview", "addon.volumes.volumes"))
images = ours("addon.pictures.images")
spent = {"move": 0.0}
MOVES = 50


def timed(function):
    """Wrap a function so that its time is added to that of the move."""

    def run(*arguments):
        started = own_time()
        try:
            return function(*arguments)
        finally:
            spent["move"] += own_time() - started

    return run


original = preview.after_update
handlers = bpy.app.handlers.depsgraph_update_post
handlers[handlers.index(original)] = timed(original)
preview._take_turn = timed(preview._take_turn)
preview.preview_drawing._draw_box = timed(preview.preview_drawing._draw_box)
preview.preview_drawing._draw_plane = timed(preview.preview_drawing._draw_plane)


def pick_high(number):
    """Click with the eyedropper on the brightest pixel of a module's tile in the mosaic."""
    area, region = editor("IMAGE_EDITOR")[1:]
    image = area.spaces.active.image
    tiles = image["mphdrr_tiles"].to_dict()
    exact = images.projection_array(bpy.data.images[f"mphDRR {number}"])
    picture = exact[::-1, ::-1]
    place = np.array(np.unravel_index(picture.argmax(), picture.shape)) + 0.5
    row, column = np.reshape(tiles["corners"], (-1, 2))[tiles["numbers"].index(number)] + place
    x, y = region.view2d.view_to_region(column / image.size[0], 1 - row / image.size[1], clip=False)
    press(bpy.ops.mphdrr.pick_window, kind="IMAGE_EDITOR", end="HIGH")
    xdotool("mousemove", *on_screen(x, y, "IMAGE_EDITOR"))
    xdotool("click", 1)


def figures(name, times):
    seen[name] = {"median": float(np.median(times)), "p95": float(np.percentile(times, 95)), "most": max(times)}


def at_rest() -> bool:
    """Return whether the preview has all pixels of what there is."""
    shown = preview.session().preview
    return shown is not None and not shown.is_quick


def steps():
    editor()[1].spaces.active.show_region_ui = True
    press(bpy.ops.mphdrr.load_example)
    yield from idle()
    yield from drawn()
    open_tab()
    scene = bpy.context.scene
    camera, phantom = bpy.data.objects["Module 55"], bpy.data.objects["Derenzo"]
    for item in list(bpy.context.selected_objects):
        item.select_set(False)
    camera.select_set(True)
    bpy.context.view_layer.objects.active = camera
    scene.mphdrr_projections.width = scene.mphdrr_projections.height = 256
    bpy.ops.mphdrr.show_modules(modules="50-60", mode="ONLY")  # drawn in software, slowly
    phantom.display_type = "BOUNDS"
    yield from drawn()
    off = []
    for _ in range(MOVES // 2):
        spent["move"] = 0.0
        camera.location.x += 0.01
        yield 0.05
        off.append(1e3 * spent["move"])
    figures("off", off)
    names = set(bpy.data.images.keys()), set(bpy.data.objects.keys())
    bpy.ops.mphdrr.live_preview()
    session = preview.session()
    yield at_rest
    seen["first"] = [session.problem, session.lines, session.preview is not None and not session.preview.is_quick]
    times, quick = [], []
    for number in range(MOVES):
        spent["move"] = 0.0
        (camera, phantom)[number % 2].location.x += 0.5 if number % 4 < 2 else -0.45
        yield 0.15
        times.append(1e3 * spent["move"])
        quick.append(session.preview.is_quick)
    figures("on", times)
    seen["quick"] = sum(quick)
    yield at_rest
    seen["full"] = not session.preview.is_quick
    run = session.preview.run
    volume = volumes.volume_from_object(phantom)
    exact = core.Projector(volume.grid, run.system.views((256, 256)))(volume)
    seen["differs"] = float(np.abs(run.projections - exact).max() / exact.max())
    seen["largest"] = float(exact.max())
    seen["same place"] = bool(np.allclose(run.system.centers[0], camera.location, atol=1e-5))
    camera.mphdrr_module.collimator_length = 60.0
    yield lambda: at_rest() and session.preview.run.system.collimator_length[0] == 60.0
    seen["typed"] = float(session.preview.run.system.collimator_length[0])
    camera.mphdrr_module.pinhole_diameter = 400.0
    yield lambda: session.problem
    seen["impossible"] = session.problem
    camera.mphdrr_module.pinhole_diameter = 2.3
    yield lambda: not session.problem and at_rest()
    seen["again"] = session.problem
    seen["images"] = (set(bpy.data.images.keys()), set(bpy.data.objects.keys())) == names
    scene.mphdrr_projections.model, phantom.display_type = "EMISSION", "TEXTURED"
    yield lambda: session.preview.run.unit == "counts" and at_rest()
    yield from drawn()
    seen["unit"] = session.preview.run.unit
    drawing, _, region = preview.preview_drawing, *editor()[1:]
    left, bottom, right, top = drawing._boxes[region.as_pointer()][0]
    xdotool("mousemove", *on_screen((left + right) / 2, (bottom + top) / 2))
    yield 1.0
    place = list(camera.location)
    xdotool("mousedown", 1)
    yield 0.5
    for step in range(1, 6):
        xdotool("mousemove", *on_screen((left + right) / 2 - 20 * step, (bottom + top) / 2 + 10 * step))
        yield 0.3
    xdotool("mouseup", 1)
    yield from drawn()
    box = drawing._boxes[region.as_pointer()][0]
    seen["dragged"] = [box[0] - left, box[1] - bottom, list(camera.location) == place]
    picture("dragged")
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "a.blend"))
    yield from drawn()
    picture("saved")
    settings = scene.mphdrr_display
    pick_high(30)
    yield lambda: not settings.automatic
    exact = images.projection_array(bpy.data.images["mphDRR 30"])
    seen["picked"] = [settings.automatic, settings.low, bool(settings.high > 0 and np.isin(settings.high, exact))]


run(steps())
