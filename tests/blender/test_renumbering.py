"""Renumbered modules: in the scene, in the system read from it, and in the workbook."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

import mphdrr.core as mph
from mphdrr.addon.scanner import module_edits, scanner
from mphdrr.core.geometry.system import PinholeSystem


def names(collection) -> list[tuple[str, str]]:
    return [(camera.name, camera.data.name) for camera in scanner.modules(collection)]


def assert_whole(collection, numbers) -> None:
    """Every module has its number, and its parts and all names agree."""
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
    before = names(collection)
    assert bpy.ops.mphdrr.renumber_modules(order="LIST") == {"FINISHED"} and names(collection) == before
    bpy.ops.mphdrr.export_geometry(filepath=str(tmp_path / "mixed.xlsx"))
    assert np.array_equal(mph.read_system(tmp_path / "mixed.xlsx").numbers, np.arange(1, 34))


def test_added_and_removed_modules_get_the_numbers_between(scene, small_workbook, tmp_path):
    bpy.ops.mphdrr.import_geometry(filepath=str(small_workbook))
    collection = scanner.active_scanner(scene)
    system = scanner.read_scanner(collection)
    gone = [scanner.module(collection, n) for n in (3, 4, 15)]
    scanner.module(collection, 7).name = "Mine"
    scanner.module(collection, 14).mphdrr_module.pinhole_diameter = 2.5
    module_edits.remove_modules(collection, gone)
    (added,) = module_edits.duplicate_modules(collection, [scanner.module(collection, 16)], 1, np.radians(10.0), False)
    assert added.mphdrr_module.number == 17
    module_edits.duplicate_modules(collection, [scanner.module(collection, 2)], 1, np.radians(10.0), False)
    places = scanner.read_scanner(collection).centers[-2:]
    assert bpy.ops.mphdrr.renumber_modules() == {"FINISHED"}
    read = scanner.read_scanner(collection)
    assert np.array_equal(read.numbers, np.arange(1, 16)) and read.source is None
    assert np.array_equal(read.centers[[14, 2]], places), "behind the ring's last module, and in the gap"
    others = np.delete(read.centers, [2, 14], axis=0)
    assert np.array_equal(others, np.delete(system.centers, [2, 3, 14], axis=0))
    assert read.pinhole_diameter[12] == 2.5 and scanner.module(collection, 6).name == "Mine"
    # A further copy belongs to the scanner, whatever numbers its modules were imported with.
    (copy,) = module_edits.duplicate_modules(collection, [scanner.module(collection, 1)], 1, np.radians(-9.0), False)
    assert copy.mphdrr_module.number == 16
    bpy.ops.mphdrr.export_geometry(filepath=str(tmp_path / "new.xlsx"))
    written = mph.read_system(tmp_path / "new.xlsx")
    assert np.array_equal(written.numbers, np.arange(1, 17))
    assert np.allclose(written.centers[:15], read.centers, atol=1e-9)
    scanner.build_scanner(scene, written, collection.mphdrr_scanner.scanner_name, replace=True)
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


def test_copies_are_tidied_first(scene, ring_system):
    collection = scanner.build_scanner(scene, ring_system)
    camera = scanner.module(collection, 2)
    camera.users_collection[0].objects.link(camera.copy())
    with pytest.raises(RuntimeError, match="1 copied camera: press Tidy Modules"):
        bpy.ops.mphdrr.renumber_modules()
