"""From a clean home to CT, SPECT with it, and dose, by clicks on the buttons that the tab proposes."""

import bpy
from driving import editor, idle, open_tab, ours, picture, run, seen, sidebar, xdotool

_FIRST, _LATER = 78, 160  # pixels from the sidebar's top to the button, before there is anything, and later


def steps():
    """Yields seconds to wait, or a function that says when it has happened."""
    editor()[1].spaces.active.show_region_ui = True
    yield 1
    open_tab()
    yield 1
    picture("empty")
    scene, seen["clicks"] = bpy.context.scene, []
    for number in range(1, 7):
        region, window = sidebar(), editor()[0]
        text = ours("addon.next_step").next_step(bpy.context).text
        seen["clicks"].append(text)
        down = _FIRST if text == "Load Example" else _LATER
        xdotool("mousemove", round(region.x + 0.4 * region.width), window.height - region.y - region.height + down)
        xdotool("click", 1)
        yield from idle()
        yield 2
        if number == 1:
            editor()[2].data.view_distance *= 0.55
            yield 1
        picture(f"click-{number}")
        scene.mphdrr_reconstruction.iterations = 30 if number < 3 else 0  # of the CT, for speed
    volumes = ours("addon.volumes.volumes")
    found = [(item.name, volumes.quantity_of(item)) for item in volumes.volume_objects(scene)]
    seen["volumes"] = found
    seen["next"] = ours("addon.next_step").next_step(bpy.context).text
    seen["tubes"] = scene.mphdrr_reconstruction.mu.name


run(steps(), patience=200.0)
