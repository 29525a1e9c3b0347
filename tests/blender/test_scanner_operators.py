"""The operators of the Geometry panel, called as a script calls them; renumbered modules."""

from __future__ import annotations

import warnings
from unittest.mock import MagicMock

import bpy
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.blender.reports import warnings_reported
from mphdrr.addon.scanner import module_edits, scanner
from mphdrr.core.errors import InputWarning
from mphdrr.core.geometry.system import PinholeSystem

from .conftest import datablocks, refused


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
    refused(bpy.ops.mphdrr.import_geometry, "module 7 moved", filepath=str(small_workbook), name="S")
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook), name="S", replace=True)
    assert scanner.losses(scanner.find_scanner(scene, "S")) == []
    assert bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook), name="S") == {"FINISHED"}


@pytest.mark.parametrize("name", ["none.xlsx", "bad.xlsx", ""])
def test_bad_file_is_one_readable_line_and_leaves_the_scene(scene, tmp_path, name):
    (tmp_path / "bad.xlsx").write_bytes(b"not a workbook")
    before = datablocks("objects")
    refused(bpy.ops.mphdrr.import_geometry, name or "no file given", filepath=str(tmp_path / name) if name else "")
    assert datablocks("objects") == before and scanner.scanners(scene) == []


def test_show_and_look_through(scene, imported):
    bpy.ops.mphdrr.show_modules(modules="5-12", mode="ONLY")
    found = scanner.modules(imported)
    assert [o.mphdrr_module.number for o in found if not o.hide_render] == list(range(5, 13))
    bpy.ops.mphdrr.look_through_module(number=11)
    assert scene.camera.name == "Module 11"
    refused(bpy.ops.mphdrr.look_through_module, "no module 99", number=99)
    refused(bpy.ops.mphdrr.show_modules, "no module 100-120; there are 1 to", modules="100-120")


def test_import_again_keeps_the_pictures_behind_cameras(imported, small_workbook):
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
    refused(getattr(bpy.ops.mphdrr, operator), "import a geometry first")


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


def assert_whole(collection, numbers) -> None:
    """Check that every module has its number, and that its parts and all names agree."""
    found = scanner.modules(collection)
    assert [camera.mphdrr_module.number for camera in found] == list(numbers)
    assert [camera.name for camera in found] == [f"Module {n:02d}" for n in numbers]
    for camera in found:
        assert camera.data.name == camera.name
        parts = [c for c in camera.children if c.mphdrr_module.part in {"COLLIMATOR", "CRYSTAL"}]
        assert len(parts) == 2
        for part in parts:
            assert part.mphdrr_module.number == camera.mphdrr_module.number
            assert part.name == part.data.name == camera.name.replace("Module", part.mphdrr_module.part.capitalize())


def test_the_workbook_is_in_order(scene, dc_spect):
    collection = scanner.build_scanner(scene, dc_spect)
    assert bpy.ops.mphdrr.renumber_modules(order="RINGS") == {"FINISHED"}
    read = scanner.read_scanner(collection)
    assert np.array_equal(read.centers, dc_spect.centers) and read.source == dc_spect.source


def test_a_mixed_system_is_sorted_and_nothing_else_changes(scene, dc_spect, tmp_path):
    rng = np.random.default_rng(0)
    kept = rng.permutation(80)[:33]
    mixed = dc_spect[kept]
    mixed = PinholeSystem(
        mixed.centers, 2.3, mixed.collimator_length, 50.0, 10.0, 75.0, numbers=rng.permutation(500)[:33] + 1
    )
    collection = scanner.build_scanner(scene, mixed, "Mixed")
    assert bpy.ops.mphdrr.renumber_modules() == {"FINISHED"}
    assert_whole(collection, range(1, 34))
    read = scanner.read_scanner(collection)
    order = mph.ring_order(mixed)
    assert np.array_equal(read.centers, mixed.centers[order]) and np.array_equal(read.numbers, np.arange(1, 34))
    assert np.array_equal(read.collimator_length, mixed.collimator_length[order])
    assert np.all(np.diff(read.rings()) >= 0)
    assert bpy.ops.mphdrr.renumber_modules(order="LIST") == {"FINISHED"}
    assert_whole(collection, range(1, 34))
    bpy.ops.mphdrr.export_geometry(filepath=str(tmp_path / "mixed.xlsx"))
    assert np.array_equal(mph.read_system(tmp_path / "mixed.xlsx").numbers, np.arange(1, 34))


def test_added_and_removed_modules_get_the_numbers_between(scene, imported, tmp_path):
    system = scanner.read_scanner(imported)
    gone = [scanner.module(imported, n) for n in (3, 4, 15)]
    scanner.module(imported, 7).name = "Mine"
    scanner.module(imported, 14).mphdrr_module.pinhole_diameter = 2.5
    module_edits.remove_modules(imported, gone)
    (added,) = module_edits.duplicate_modules(imported, [scanner.module(imported, 16)], 1, np.radians(10.0), False)
    assert added.mphdrr_module.number == 17
    module_edits.duplicate_modules(imported, [scanner.module(imported, 2)], 1, np.radians(10.0), False)
    places = scanner.read_scanner(imported).centers[-2:]
    assert bpy.ops.mphdrr.renumber_modules() == {"FINISHED"}
    read = scanner.read_scanner(imported)
    assert np.array_equal(read.numbers, np.arange(1, 16)) and read.source is None
    assert np.array_equal(read.centers[[14, 2]], places), "behind the ring's last module, and in the gap"
    others = np.delete(read.centers, [2, 14], axis=0)
    assert np.array_equal(others, np.delete(system.centers, [2, 3, 14], axis=0))
    assert read.pinhole_diameter[12] == 2.5 and scanner.module(imported, 6).name == "Mine"
    # A further copy belongs to the scanner, whatever numbers its modules were imported with.
    (copy,) = module_edits.duplicate_modules(imported, [scanner.module(imported, 1)], 1, np.radians(-9.0), False)
    assert copy.mphdrr_module.number == 16
    bpy.ops.mphdrr.export_geometry(filepath=str(tmp_path / "new.xlsx"))
    written = mph.read_system(tmp_path / "new.xlsx")
    assert np.array_equal(written.numbers, np.arange(1, 17))
    assert np.allclose(written.centers[:15], read.centers, atol=1e-9)
    scanner.build_scanner(scene, written, imported.mphdrr_scanner.scanner_name, replace=True)
    assert len([o for o in scene.objects if o.type == "CAMERA" and o.mphdrr_module.is_module]) == 16


def test_renumbering_is_undone_at_once(scene, ring_system):
    system = PinholeSystem(ring_system.centers[::-1], 2.3, 55.0, 48.0, 9.5, 60.0, numbers=np.arange(11, 19))
    scanner.build_scanner(scene, system, "Rings")
    bpy.ops.ed.undo_push(message="built")
    assert bpy.ops.mphdrr.renumber_modules() == {"FINISHED"}
    bpy.ops.ed.undo_push(message="renumbered")
    assert_whole(bpy.data.collections["Rings"], range(1, 9))
    assert bpy.ops.ed.undo() == {"FINISHED"}
    assert_whole(bpy.data.collections["Rings"], range(11, 19))
    assert np.array_equal(scanner.read_scanner(bpy.data.collections["Rings"]).centers, system.centers)


def test_copies_are_tidied_first(ring):
    camera = scanner.module(ring, 2)
    camera.users_collection[0].objects.link(camera.copy())
    refused(bpy.ops.mphdrr.renumber_modules, "1 copied camera: press Tidy Modules")
