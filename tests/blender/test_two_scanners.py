"""With two scanners the panels follow the selection, each edit changes the selected one, and a run belongs to its own."""

from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from mphdrr.addon.blender import ids
from mphdrr.addon.pictures import images, planes, tiles
from mphdrr.addon.scanner import scanner, selection
from mphdrr.addon.volumes import volumes
from mphdrr.core.errors import InputError
from mphdrr.core.geometry.grid import Grid
from mphdrr.core.volumes.volume import Volume


@pytest.fixture
def a_and_b(scene, ring_system):
    made = [scanner.build_scanner(scene, ring_system, "A"), scanner.build_scanner(scene, ring_system[2:7], "B")]
    bpy.context.view_layer.update()
    return made


def activate(item: bpy.types.Object) -> None:
    bpy.ops.object.select_all(action="DESELECT")
    item.select_set(True)
    bpy.context.view_layer.objects.active = item
    bpy.context.view_layer.update()


def shown(scene: bpy.types.Scene) -> tuple[str, int, int]:
    """The panels' scanner, and the numbers of its listed and active modules."""
    listed, active = selection.listed_module(scene), selection.active_module(bpy.context)
    return scanner.active_scanner(scene).name, listed.mphdrr_module.number, active.mphdrr_module.number


def part(camera: bpy.types.Object, name: str) -> bpy.types.Object:
    return next(c for c in camera.children if c.mphdrr_module.part == name)


def test_the_panels_follow_the_selection(scene, a_and_b):
    a, b = a_and_b
    assert shown(scene) == ("B", 3, 3), "the new one"
    activate(scanner.module(a, 6))
    assert shown(scene) == ("A", 6, 6)
    activate(part(scanner.module(b, 5), "CRYSTAL"))
    assert shown(scene) == ("B", 5, 5)
    activate(next(o for o in a.objects if o.mphdrr_module.part == "ROI"))
    assert shown(scene)[0] == "A"
    activate(scene.objects["Cube"])
    assert shown(scene)[0] == "A", "no scanner's"
    scene.mphdrr_geometry.scanner = b
    bpy.context.view_layer.update()
    assert shown(scene) == ("B", 3, 3), "what is chosen in the panel stays chosen"
    scene.mphdrr_geometry.active_index = b.all_objects.find(scanner.module(b, 7).name)
    bpy.context.view_layer.update()
    assert shown(scene) == ("B", 7, 7) and bpy.context.selected_objects == [scanner.module(b, 7)]
    scanner.show_modules(a, 5, 5)
    scene.mphdrr_geometry.scanner = a
    scene.mphdrr_geometry.active_index = a.all_objects.find(scanner.module(a, 8).name)
    bpy.context.view_layer.update()
    assert shown(scene) == ("A", 8, 8), "also a module that is hidden"


def test_each_edit_changes_the_selected_one(scene, a_and_b):
    for mine, other in (a_and_b, a_and_b[::-1]):
        before = scanner.read_scanner(other)
        activate(part(scanner.module(mine, 4), "COLLIMATOR"))
        panel = scanner.active_scanner(scene)
        panel.mphdrr_scanner.detector_thickness = 7.5
        selection.active_module(bpy.context).mphdrr_module.pinhole_diameter = 3.5
        bpy.ops.mphdrr.show_modules(first=4, last=5, mode="ONLY")
        bpy.ops.mphdrr.duplicate_modules(count=1, angle=np.radians(14))
        activate(scanner.module(mine, 5))
        bpy.ops.mphdrr.remove_modules()
        now = scanner.read_scanner(mine)
        assert 5 not in now.numbers and (now.detector_thickness == 7.5).all() and 3.5 in now.pinhole_diameter
        after = scanner.read_scanner(other)
        for name in ("centers", "numbers", "detector_thickness", "pinhole_diameter"):
            assert np.array_equal(getattr(before, name), getattr(after, name)), name
        mine.mphdrr_scanner.detector_thickness = 9.5
        scanner.show_modules(mine, 0, 0, "ALL")


def test_a_run_belongs_to_its_scanner(scene, a_and_b):
    a, b = a_and_b
    volumes.add_volume(Volume(np.ones((2, 2, 2), np.float32), Grid.centered(2, 2.0), "activity"), "Box")
    activate(scanner.module(a, 1))
    bpy.ops.mphdrr.render_projections(width=8, height=8)
    activate(scanner.module(b, 6))
    mosaic = bpy.data.images[ids.MOSAIC]
    scene.mphdrr_display.colors = "GREY"  # made anew
    assert images.scanner_of(mosaic) == a and {plane.parent for plane in planes.planes(scene)} == set(
        scanner.modules(a)
    )

    found = images.tiles(mosaic)
    row, column = np.reshape(found["corners"], (-1, 2))[found["numbers"].index(6)]
    width, height = mosaic.size
    assert tiles.active_tile(bpy.context, mosaic) is None, "module 6 of B has no image here"
    view = SimpleNamespace(region_to_view=lambda x, y: (x, y))
    context = SimpleNamespace(
        space_data=SimpleNamespace(image=mosaic), region=SimpleNamespace(view2d=view), scene=scene,
        view_layer=bpy.context.view_layer, mode="OBJECT",
    )  # fmt: skip
    place = (column + 3) / width, 1 - (row + 3) / height
    assert tiles.pick_module(context, *place) == scanner.module(a, 6).name
    bpy.context.view_layer.update()
    assert shown(scene) == ("A", 6, 6) and tiles.active_tile(bpy.context, mosaic) == found["numbers"].index(6)
    bpy.data.collections.remove(a)
    with pytest.raises(InputError, match="not in the scene"):
        tiles.pick_module(context, *place)
