"""From a clean home to CT, SPECT with it, and dose, by clicks on the buttons that the tab proposes."""

import bpy
from driving import drawn, editor, idle, open_tab, ours, run, seen
from pointing import click_proposed, picture, proposed

_FIRST = 78  # pixels from the sidebar's top to the button of the X-ray example


def steps():
    """Yield seconds to wait, or a function that says when it has happened."""
    editor()[1].spaces.active.show_region_ui = True
    yield 1
    open_tab()
    yield 1
    picture("empty")
    scene, seen["clicks"] = bpy.context.scene, []
    for number in range(1, 7):
        seen["clicks"].append(proposed())
        click_proposed(_FIRST)
        yield from idle()
        yield from drawn()
        if number == 1:
            editor()[2].data.view_distance *= 0.55
            yield from drawn()
        picture(f"click-{number}")
        scene.mphdrr_reconstruction.iterations = 30 if number < 3 else 0  # of the CT, for speed
    volumes = ours("addon.volumes.volumes")
    found = [(item.name, volumes.quantity_of(item)) for item in volumes.volume_objects(scene)]
    seen["volumes"] = found
    seen["next"] = proposed()
    seen["tubes"] = scene.mphdrr_reconstruction.mu.name


run(steps(), patience=200.0)
