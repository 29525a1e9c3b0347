"""The operators of the Geometry panel, called as a script calls them."""

from __future__ import annotations

import warnings
from unittest.mock import MagicMock

import bpy
import numpy as np
import pytest

from mphdrr.addon.blender.reports import warnings_reported
from mphdrr.addon.scanner import scanner
from mphdrr.core.errors import InputWarning


def test_import_equals_build_scanner(scene, workbook, dc_spect):
    assert bpy.ops.mphdrr.import_geometry(filepath=str(workbook)) == {"FINISHED"}
    collection = scanner.active_scanner(scene)
    assert collection.name == "dc-spect-80"
    back = scanner.read_scanner(collection)
    assert np.array_equal(back.centers, dc_spect.centers)
    assert back.source.sha256 == dc_spect.source.sha256 == collection.mphdrr_scanner.sha256
    assert (scene.render.resolution_x, scene.render.resolution_y) == (256, 256)


def test_import_refuses_to_drop_changes_unless_told(scene, small_workbook):
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook), name="S", image_size=(200, 100))
    assert (scene.render.resolution_x, scene.render.resolution_y) == (200, 100)
    camera = scanner.module(scanner.find_scanner(scene, "S"), 7)
    camera.location.x += 3.0
    with pytest.raises(RuntimeError, match="module 7 moved"):
        bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook), name="S")
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook), name="S", replace=True)
    assert scanner.losses(scanner.find_scanner(scene, "S")) == []
    assert bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook), name="S") == {"FINISHED"}


@pytest.mark.parametrize("content", [None, b"not a workbook"])
def test_bad_file_is_one_readable_line_and_leaves_the_scene(scene, tmp_path, content):
    path = tmp_path / "bad.xlsx"
    if content is not None:
        path.write_bytes(content)
    before = [o.name for o in bpy.data.objects]
    with pytest.raises(RuntimeError) as error:
        bpy.ops.mphdrr.import_geometry(filepath=str(path))
    assert "bad.xlsx" in str(error.value)
    assert "Traceback" not in str(error.value)
    assert [o.name for o in bpy.data.objects] == before
    assert scanner.scanners(scene) == []


def test_import_without_a_file_says_so():
    with pytest.raises(RuntimeError, match="no file given"):
        bpy.ops.mphdrr.import_geometry()


def test_show_and_look_through(scene, small_workbook):
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook))
    bpy.ops.mphdrr.show_modules(first=5, last=12, mode="ONLY")
    found = scanner.modules(scanner.active_scanner(scene))
    assert [o.mphdrr_module.number for o in found if not o.hide_render] == list(range(5, 13))
    bpy.ops.mphdrr.look_through_module(number=11)
    assert scene.camera.name == "Module 11"
    with pytest.raises(RuntimeError, match="no module 99"):
        bpy.ops.mphdrr.look_through_module(number=99)
    with pytest.raises(RuntimeError, match="no module between"):
        bpy.ops.mphdrr.show_modules(first=100, last=120)


def test_aim_turns_moved_modules_back(scene, small_workbook):
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook))
    collection = scanner.active_scanner(scene)
    scanner.module(collection, 12).rotation_euler.y += 0.2
    assert scanner.unaimed_numbers(collection, scanner.modules(collection)) == [12]
    bpy.ops.mphdrr.aim_modules()
    assert scanner.unaimed_numbers(collection, scanner.modules(collection)) == []


def test_import_again_keeps_the_pictures_behind_cameras(scene, small_workbook):
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook))
    picture = bpy.data.images.new("photo", 4, 4)
    camera = bpy.data.objects["Module 05"].data
    camera.show_background_images = True
    for alpha in (0.25, 0.5):
        shown = camera.background_images.new()
        shown.image, shown.alpha, shown.scale, shown.frame_method = picture, alpha, 1.5, "CROP"
        shown.image_user.frame_offset, shown.offset = 7, (0.1, -0.2)
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook))
    camera = bpy.data.objects["Module 05"].data
    assert camera.show_background_images and not bpy.data.objects["Module 06"].data.show_background_images
    assert [shown.alpha for shown in camera.background_images] == [0.25, 0.5] and picture.users == 2
    for shown in camera.background_images:
        assert (shown.image, shown.scale, shown.frame_method) == (picture, 1.5, "CROP")
        assert shown.image_user.frame_offset == 7 and list(shown.offset) == pytest.approx([0.1, -0.2])


def test_what_a_replaced_scanner_loses_is_known_before(scene, small_workbook):
    assert scanner.losses_of(scene, "small") == []
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook))
    scanner.module(scanner.active_scanner(scene), 12).rotation_euler.y += 0.2
    assert scanner.losses_of(scene, "small", "other") == ["module 12 moved or turned"]


@pytest.mark.parametrize("operator", ["show_modules", "look_through_module", "aim_modules"])
def test_without_a_scanner_operators_say_what_to_do(operator):
    with pytest.raises(RuntimeError, match="import a geometry first"):
        getattr(bpy.ops.mphdrr, operator)()


def test_file_handler_takes_workbooks():
    handler = bpy.types.MPHDRR_FH_workbook
    assert handler.bl_file_extensions == ".xlsx;.xlsm"
    assert handler.bl_import_operator == "mphdrr.import_geometry"


def test_warnings_are_reported_not_raised():
    operator = MagicMock()
    with warnings_reported(operator):
        for i in range(8):
            warnings.warn(f"cell E{i}", InputWarning, stacklevel=1)
    first, *_, last = said = [call.args for call in operator.report.call_args_list]
    assert first == ({"WARNING"}, "cell E0")
    assert last == ({"WARNING"}, "... and 3 more warnings of this kind")
    assert len(said) == 6


def test_every_operator_says_why_it_cannot_run():
    """In an empty scene; Blender's own message is "context is incorrect"."""
    bpy.data.batch_remove(bpy.data.objects)
    greyed = [name for name in dir(bpy.ops.mphdrr) if not getattr(bpy.ops.mphdrr, name).poll()]
    assert {"add_slices", "apply_phantom_pose", "update_phantom", "renumber_modules", "show_projections"} <= set(greyed)
    for name in greyed:
        with pytest.raises(RuntimeError) as refusal:
            getattr(bpy.ops.mphdrr, name)()
        assert "context is incorrect" not in str(refusal.value), refusal.value
