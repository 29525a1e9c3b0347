"""A look is dragged from the Asset Browser onto a phantom with slices; leaves the window as it is then."""

import bpy
from driving import drawn, editor, empty_scene, idle, press, run, seen, within
from pointing import look, on_screen, picture, xdotool


def brightest(item) -> list[float]:
    """Return the colour of the brightest pixel of the slices."""
    pixels = [
        child.data.materials[0].node_tree.nodes["Slice"].image.pixels[:]
        for child in item.children
        if child.data.materials
    ]
    colors = [each[n : n + 3] for each in pixels for n in range(0, len(each), 4)]
    return list(max(colors, key=sum))


def steps():
    """Yield seconds to wait, or a function that says when it has happened."""
    empty_scene()
    press(bpy.ops.mphdrr.add_derenzo, voxels=48, confirmed=True)
    yield from idle()
    press(bpy.ops.mphdrr.add_slices)
    item = bpy.data.objects["Derenzo"]
    look(200.0, (0.9, 0.0, 0.6))
    seen["materials"], seen["brightest"] = [item.data.materials[0].name], [brightest(item)]
    press(bpy.ops.mphdrr.add_looks)
    with within():
        bpy.ops.screen.area_split(direction="HORIZONTAL", factor=0.4)
    area = min((a for a in editor()[0].screen.areas if a.type == "VIEW_3D"), key=lambda a: a.height)
    area.ui_type = "ASSETS"
    yield from drawn()
    area.spaces.active.params.asset_library_reference = "mphDRR"
    yield 4
    window, _, region = editor()
    browser = next(each for each in area.regions if each.type == "WINDOW")
    start = browser.x + 60, window.height - (browser.y + browser.height - 50)
    end = on_screen(region.width // 2, region.height // 2)
    xdotool("mousemove", *start)
    yield 1
    xdotool("mousedown", 1)
    for share in (0.05, 0.1, 0.3, 0.6, 0.9, 1.0):
        xdotool("mousemove", *(round(a + share * (b - a)) for a, b in zip(start, end, strict=True)))
        yield 0.5
    picture("dragged")
    xdotool("mouseup", 1)
    yield lambda: item.data.materials[0].name != "Derenzo activity"
    yield from drawn()
    seen["materials"].append(item.data.materials[0].name)
    seen["brightest"].append(brightest(item))
    seen["slice"] = sorted(
        {
            node.name
            for child in item.children
            for node in child.data.materials[0].node_tree.nodes
            if node.type == "TEX_IMAGE"
        }
    )
    seen["high"] = item.data.materials[0].node_tree.nodes["Look"].inputs["High"].default_value


run(steps())
