"""Two runs of the example in the window: a module is moved and moved back, the run is rendered again, both are compared."""

import bpy
from driving import drawn, editor, idle, open_tab, ours, press, run, seen
from pauses import own_time

runs = ours("addon.runs.runs")


def move() -> None:
    """Move the active object by 1 mm up with Blender's tool, which makes an undo step."""
    for item in bpy.context.selected_objects:
        item.select_set(False)
    camera = bpy.data.objects["Module 30"]
    camera.select_set(True)
    bpy.context.view_layer.objects.active = camera
    press(bpy.ops.transform.translate, "EXEC_DEFAULT", value=(0.0, 0.0, 1.0))


def changes(when: str) -> None:
    seen[when] = runs.change_lines(bpy.context.scene)


def there_and_back():
    """Undo the last step and redo it; note what the Image Editor shows after each."""
    for step in (bpy.ops.ed.undo, bpy.ops.ed.redo):
        step()
        yield from drawn()
        image = editor("IMAGE_EDITOR")[1].spaces.active.image
        seen.setdefault("pictures", []).append(image and image.name)


def steps():
    """Yield seconds to wait."""
    editor()[1].spaces.active.show_region_ui = True
    press(bpy.ops.mphdrr.load_example)
    yield from idle()
    yield from there_and_back()
    editor("IMAGE_EDITOR")[1].spaces.active.show_region_ui = True
    changes("loaded")
    yield from drawn()
    open_tab()
    open_tab("IMAGE_EDITOR")
    move()
    yield from drawn()
    changes("moved")
    bpy.ops.ed.undo()
    yield from drawn()
    changes("undone")
    bpy.context.scene.mphdrr_projections.runs[0].name = "As imported"
    move()
    yield from drawn()
    changes("moved again")
    started = own_time()
    for _ in range(1000):
        runs.after_update()
    seen["handler ms"] = own_time() - started
    press(bpy.ops.mphdrr.render_projections, volume=runs.volume_to_render(bpy.context.scene))
    yield from idle()
    yield from drawn()
    yield from there_and_back()
    changes("rendered")
    bpy.context.scene.mphdrr_projections.active_run = 0  # as a click in the list does, which starts a job
    yield lambda: runs.shown_run(bpy.context.scene).name == "As imported"
    yield from idle()
    yield from drawn()
    changes("chosen")
    seen["shown"] = runs.shown_run(bpy.context.scene).name
    press(bpy.ops.mphdrr.compare_runs, other="1")
    yield from idle()
    yield from drawn()
    seen["runs"] = [item.name for item in bpy.context.scene.mphdrr_projections.runs]
    window, area, _ = editor("IMAGE_EDITOR")
    seen["image"] = area.spaces.active.image.name
    seen["editor"] = [area.x, window.height - area.y - area.height, area.width, area.height]


run(steps())
