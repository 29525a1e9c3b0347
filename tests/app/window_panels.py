"""How tall the tab is with everything open, after the example was reconstructed, in pixels."""

import bpy
from driving import drawn, editor, idle, open_tab, opened, panels, press, run, seen, sidebar
from pointing import picture


def steps():
    """Yield seconds to wait."""
    press(bpy.ops.mphdrr.load_example, "EXEC_DEFAULT")
    settings = bpy.context.scene.mphdrr_reconstruction
    settings.voxels, settings.iterations = 48, 2
    press(bpy.ops.mphdrr.reconstruct)
    yield from idle()
    opened(*(cls.__name__ for cls in panels()))
    window, area, _ = editor()
    area.spaces.active.show_region_ui = True
    yield 1
    open_tab()
    yield from drawn()
    height, top = sidebar().height, 0.0
    for page in range(14):
        picture(f"page-{page}")
        with bpy.context.temp_override(window=window, area=area, region=sidebar()):
            bpy.ops.view2d.pan(deltay=60 - height)
        yield from drawn()
        if sidebar().view2d.region_to_view(0, 0)[1] == top:
            break
        top = sidebar().view2d.region_to_view(0, 0)[1]
    seen["height"] = -top


run(steps())
