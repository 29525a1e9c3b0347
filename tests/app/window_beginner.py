"""From a clean home to a reconstruction with its score, by clicks on the one button that the tab proposes.

With the example, and in a new scene with a workbook.
"""

from collections.abc import Iterator

import bpy
from driving import WORKBOOK, drawn, editor, idle, open_tab, run, seen
from pointing import click_proposed, picture, proposed

_MOST = 6


def clicks(name: str) -> Iterator[float]:
    """Click until a score stands; yield what to wait for."""
    scene, seen[name] = bpy.context.scene, []
    scene.mphdrr_reconstruction.voxels, scene.mphdrr_reconstruction.iterations = 32, 4  # for speed
    while not scene.mphdrr_reconstruction.details.get("scores") and len(seen[name]) < _MOST:
        seen[name].append(proposed())
        click_proposed()
        yield from idle()
        yield from drawn()
    settings = scene.mphdrr_projections, scene.mphdrr_reconstruction
    seen[name] += [settings[0].model, settings[1].method, settings[1].details["scores"][0][0], proposed()]


def steps():
    """Yield seconds to wait, or a function that says when it has happened."""
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
    yield from drawn()
    yield from clicks("workbook")


run(steps(), patience=120.0)
