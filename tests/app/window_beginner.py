"""From a clean home to a reconstruction with its score, by clicks on the one button that the tab proposes."""

import bpy
from driving import editor, is_idle, open_tab, ours, picture, run, seen, sidebar, xdotool

_FIRST, _LATER = 44, 160  # pixels from the sidebar's top to the button, without the lines of what there is, and with them
_MOST = 6


def click() -> None:
    """Click on the button at the top of the tab."""
    region, window = sidebar(), editor()[0]
    down = _LATER if seen["clicks"] else _FIRST
    xdotool("mousemove", round(region.x + 0.4 * region.width), window.height - region.y - region.height + down)
    xdotool("click", 1)


def steps():
    """Yields seconds to wait, or a function that says when it has happened."""
    editor()[1].spaces.active.show_region_ui = True
    yield 1
    open_tab()
    yield 1
    seen["clicks"], seen["proposed"] = 0, []
    scene = bpy.context.scene
    scene.mphdrr_reconstruction.voxels, scene.mphdrr_reconstruction.iterations = 32, 10  # for speed
    picture("empty")
    while not scene.mphdrr_reconstruction.known.get("scores") and seen["clicks"] < _MOST:
        seen["proposed"].append(ours("addon.next_step").next_step(bpy.context).text)
        click()
        seen["clicks"] += 1
        yield 1
        yield is_idle
        yield 2
    picture("done")
    seen["scores"] = scene.mphdrr_reconstruction.known["scores"]
    seen["stages"] = [[stage.name, stage.found] for stage in ours("addon.next_step").stages(bpy.context)]


run(steps(), patience=120.0)
