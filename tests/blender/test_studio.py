"""Studio light: a scanner's scene is neither black nor bleached, and what light the user has stays."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Vector

from mphdrr.addon.blender import ids
from mphdrr.addon.figures import studio
from mphdrr.addon.scanner import scanner


def studios(scene) -> list[bpy.types.Collection]:
    return [c for c in scene.collection.children if c.name.startswith(ids.STUDIO)]


def test_an_imported_scanner_is_lit_once(scene, small_workbook):
    world = scene.world
    for _ in range(2):
        bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook))
        (home,) = studios(scene)
        assert {item.data.type for item in home.objects} == {"SUN"}
    assert scene.world == world and not scene.objects["Light"].hide_viewport


def test_a_scene_with_light_of_its_own_keeps_it(scene, ring_system):
    scene.objects["Light"].data.type = "AREA"
    studio.light(scene)
    assert not studios(scene)
    scene.world = None
    bpy.data.objects.remove(scene.objects["Light"])
    studio.light(scene)
    assert len(studios(scene)) == 1 and scene.world.name == ids.STUDIO


@pytest.mark.parametrize("world", ["the startup file's", "none"])
def test_a_rendered_scanner_is_neither_black_nor_bleached(scene, dc_spect, tmp_path, world):
    if world == "none":
        scene.world = None
    scanner.build_scanner(scene, dc_spect[::4])
    studio.light(scene)
    camera = studio.new_aimed_object(bpy.data.cameras.new("View"), Vector((0, 60, 0)), Vector((550, -400, 400)))
    camera.data.clip_end = 5000.0
    scene.collection.objects.link(camera)
    scene.camera, scene.render.engine, scene.cycles.samples = camera, "CYCLES", 1
    scene.render.resolution_x = scene.render.resolution_y = 64
    scene.render.filepath = str(tmp_path / "view.png")
    bpy.ops.render.render(write_still=True)
    picture = np.array(bpy.data.images.load(scene.render.filepath).pixels).reshape(64, 64, 4)[..., :3]
    assert 0.15 < picture.mean() < 0.6
    assert np.ptp(picture.mean(axis=2)) > 0.3, "lit sides and sides in shadow"
