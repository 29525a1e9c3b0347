"""A scene saved by version 0.1.0 opens completely: scanner, settings, phantom and projections."""

from __future__ import annotations

import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest

from mphdrr.addon.blender import storage
from mphdrr.addon.pictures import images
from mphdrr.addon.scanner import scanner
from mphdrr.addon.volumes import volumes
from mphdrr.core.runs.files import read_run

DATA = Path(__file__).parent / "data"
"""Blender 4.5. Modules 3, 31 and 66 of the example workbook: 3 was moved, 31 has a hole and a length that were typed,
66 is hidden; a Derenzo phantom of 16^3 voxels; its projections, 24 x 16 pixels."""


@pytest.fixture
def old_scene(scene, tmp_path):
    shutil.copytree(DATA / "scene-0.1.0_mphdrr", tmp_path / "scene-0.1.0_mphdrr")
    shutil.copy(DATA / "scene-0.1.0.blend", tmp_path)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene-0.1.0.blend"))
    return bpy.context.scene


def test_the_scanner_reads_back_exactly(old_scene):
    collection = scanner.active_scanner(old_scene)
    system = scanner.read_scanner(collection)
    assert system.numbers.tolist() == [3, 31, 66]
    assert system.centers.tolist() == [
        [201.3326, 136.87, -68.0519], [-170.499, 95.57272, -23.9678], [56.74056, 177.7703, 71.7895],
    ]  # fmt: skip
    assert system.pinhole_diameter.tolist() == [2.3, 2.7, 2.3]
    np.testing.assert_allclose(system.collimator_length, [75.55147057014942, 61.3, 57.9776304498216], rtol=1e-14)
    assert system.collimator_length[1] == 61.3
    for name, value in (("detector_side", 50.0), ("detector_thickness", 10.0), ("roi_radius", 75.0)):
        assert getattr(system, name).tolist() == [value] * 3
    assert [camera.mphdrr_module.visible for camera in scanner.modules(collection)] == [True, True, False]
    assert [camera.mphdrr_module.length_mode for camera in scanner.modules(collection)] == [
        "FROM_ROI", "TYPED", "FROM_ROI",
    ]  # fmt: skip
    assert scanner.losses(collection) == ["module 3 moved or turned", "modules 3, 31 with changed numbers"]
    assert scanner.source(collection).cell("x1", 31) == ("Coordinates", "B4")


def test_settings_are_there(old_scene):
    built = scanner.active_scanner(old_scene).mphdrr_scanner
    for name, value in {
        "scanner_name": "Three", "n_modules": 3, "plate_thickness": 3.5, "wall_thickness": 1.25, "edge_at": "BACK",
        "opening_angle": np.radians(60), "intrinsic_fwhm": 3.2, "keep_aimed": False,
        "mixed": "pinhole_diameter collimator_length length_mode", "count": 3, "untidy": "",
    }.items():  # fmt: skip
        assert getattr(built, name) == (pytest.approx(value) if isinstance(value, float) else value), name
    rendered = old_scene.mphdrr_projections
    for name, value in {
        "model": "EMISSION", "isotope": "Tc-99m", "aperture_material": "tungsten", "crystal_material": "CZT",
        "magnification": 8.0, "width": 24, "height": 16, "detector": "VIRTUAL", "noise": False,
    }.items():  # fmt: skip
        assert getattr(rendered, name) == value, name


def test_phantom_and_projections_are_there(old_scene):
    (phantom,) = volumes.volume_objects(old_scene)
    settings = phantom.mphdrr_volume
    assert (settings.kind, settings.quantity, settings.derenzo.voxels) == ("DERENZO", "activity", 16)
    assert settings.derenzo.activity == 80.0
    assert volumes.volume_from_object(phantom).array.max() == pytest.approx(settings.maximum)
    phantom.mphdrr_volume.display_high = 33.0
    looked = phantom.data.materials[0].node_tree.nodes["Display Range"].inputs["From Max"]
    assert looked.default_value == 33.0, "its material has no look, and follows all the same"
    run = read_run(storage.absolute(old_scene.mphdrr_projections.run_file))
    assert run.system.numbers.tolist() == [3, 31, 66] and run.projections.shape == (3, 16, 24)
    for number, projection in zip(run.system.numbers, run.projections, strict=True):
        image = bpy.data.images[f"mphDRR {number:02d}"]
        np.testing.assert_array_equal(images.projection_array(image), projection)
