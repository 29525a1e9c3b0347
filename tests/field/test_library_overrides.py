"""Library overrides of scanners and volumes keep the extension's numbers, through save and reload."""

from __future__ import annotations

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

import mphdrr.core as mph  # noqa: E402
from mphdrr.addon.blender import jobs  # noqa: E402
from mphdrr.addon.phantoms import phantoms  # noqa: E402
from mphdrr.addon.scanner import scanner  # noqa: E402
from mphdrr.addon.volumes import volumes  # noqa: E402

from ..blender.conftest import registered, reopened, ring_system, scene  # noqa: E402

__all__ = ["registered", "ring_system", "scene"]  # fixtures


def groups(group, path=""):
    """Yield a property group and those in it, with their paths."""
    yield path, group
    for row in group.bl_rna.properties:
        value = getattr(group, row.identifier)
        if row.identifier != "rna_type" and isinstance(value, bpy.types.PropertyGroup):
            yield from groups(value, f"{path}.{row.identifier}")


@pytest.fixture
def override(scene, ring_system, tmp_path):
    """Link a scanner and a phantom from another file, and return their override's collection."""
    collection = scanner.build_scanner(scene, ring_system, "Ring")
    bpy.ops.mphdrr.add_derenzo(voxels=16)
    collection.objects.link(bpy.data.objects["Derenzo"])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, linked):
        linked.collections = ["Ring"]
    bpy.context.scene.collection.children.link(linked.collections[0])
    context = bpy.context.scene, bpy.context.view_layer
    result = linked.collections[0].override_hierarchy_create(*context, do_fully_editable=True)
    bpy.context.scene.collection.children.unlink(linked.collections[0])
    return result


def test_all_properties_can_be_overridden(override):
    camera, volume = scanner.module(override, 1), override.all_objects["Derenzo"]
    for owner in (camera.mphdrr_module, override.mphdrr_scanner, volume.mphdrr_volume):
        for path, group in groups(owner):
            rows = [row for row in group.bl_rna.properties if row.identifier not in ("rna_type", "name")]
            assert [f"{path}.{row.identifier}" for row in rows if not row.is_overridable] == []


@pytest.mark.parametrize("number", [1, 4, 8])
def test_numbers_of_a_scanner_survive(override, tmp_path, number):
    module, settings = scanner.module(override, number).mphdrr_module, override.mphdrr_scanner
    module.pinhole_diameter, module.collimator_length, module.id_data.location.z = 3.7, 61.3, 41.5
    settings.opening_angle, settings.bore, settings.keep_aimed = 1.25, 120.5, False
    scanner.module(override, 3).mphdrr_module.crystal_width = 33.25
    before = scanner.read_scanner(override)
    scene = reopened(tmp_path / "user.blend")
    (again,) = scanner.scanners(scene)
    assert again.override_library is not None
    after = scanner.read_scanner(again)
    for name, values in before.values().items():
        np.testing.assert_array_equal(values, after.values()[name], err_msg=name)
    m = after.numbers.tolist().index(number)
    assert (after.pinhole_diameter[m], after.collimator_length[m], after.centers[m, 2]) == (3.7, 61.3, 41.5)
    settings = again.mphdrr_scanner
    assert (settings.opening_angle, settings.bore, settings.keep_aimed) == (1.25, 120.5, False)
    assert bpy.ops.mphdrr.export_geometry(filepath=str(tmp_path / "w.xlsx")) == {"FINISHED"}
    np.testing.assert_array_equal(mph.read_system(tmp_path / "w.xlsx").pinhole_diameter, before.pinhole_diameter)


def test_numbers_of_a_phantom_survive(override, tmp_path):
    item = override.all_objects["Derenzo"]
    item.mphdrr_volume.display_high, item.location.x = 77.5, 12.25
    settings = phantoms.settings_of(item)
    settings.rod_diameters = (9, 7, 5, 0, 0, 0)
    jobs.run(phantoms.update_phantom_job(item))
    before = volumes.volume_from_object(item)
    scene = reopened(tmp_path / "user.blend")
    item = scene.objects["Derenzo"]
    after = volumes.volume_from_object(item)
    assert item.override_library is not None and item.mphdrr_volume.display_high == 77.5
    assert phantoms.settings_of(item).rod_diameters[:] == (9, 7, 5, 0, 0, 0)
    np.testing.assert_array_equal(after.array, before.array)
    np.testing.assert_allclose(after.grid.affine, before.grid.affine, atol=1e-9)
