"""From a clean home to a reconstruction with its score, by clicks on the one button that the tab proposes.

With the example, and in a new scene with a workbook.
"""

from collections.abc import Iterator

import bpy
from driving import WORKBOOK, editor, idle, open_tab, ours, picture, run, seen, sidebar, xdotool

_FIRST, _LATER = 44, 160  # pixels from the sidebar's top to the button, before there is anything, and later
_MOST = 6


def proposed() -> str:
    return ours("addon.next_step").next_step(bpy.context).text


def click() -> None:
    """Click on the button at the top of the tab."""
    region, window = sidebar(), editor()[0]
    down = _FIRST if proposed() == "Load Example" else _LATER
    xdotool("mousemove", round(region.x + 0.4 * region.width), window.height - region.y - region.height + down)
    xdotool("click", 1)


def clicks(name: str) -> Iterator[float]:
    """Click until a score stands; yields what to wait for."""
    scene, seen[name] = bpy.context.scene, []
    scene.mphdrr_reconstruction.voxels, scene.mphdrr_reconstruction.iterations = 32, 4  # for speed
    while not scene.mphdrr_reconstruction.known.get("scores") and len(seen[name]) < _MOST:
        seen[name].append(proposed())
        click()
        yield from idle()
        yield 2
    settings = scene.mphdrr_projections, scene.mphdrr_reconstruction
    seen[name] += [settings[0].model, settings[1].method, settings[1].known["scores"][0][0], proposed()]


def steps():
    """Yields seconds to wait, or a function that says when it has happened."""
    editor()[1].spaces.active.show_region_ui = True
    yield 1
    open_tab()
    yield 1
    picture("empty")
    yield from clicks("example")
    picture("score")
    with bpy.context.temp_override(window=editor()[0]):
        bpy.ops.scene.new(type="NEW")
    bpy.ops.mphdrr.import_geometry(filepath=str(WORKBOOK))
    settings = bpy.context.scene.mphdrr_projections
    settings.width = settings.height = 32
    yield 2
    yield from clicks("workbook")


run(steps(), patience=120.0)
