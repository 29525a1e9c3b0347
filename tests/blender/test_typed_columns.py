"""A column that is added to the table of pinhole modules is a property of modules, and is drawn, edited and kept."""

from __future__ import annotations

from unittest.mock import MagicMock

import bpy
import numpy as np
import pytest

from mphdrr.addon import registration
from mphdrr.addon.scanner import scanner
from mphdrr.core.errors import InputError
from mphdrr.core.geometry.columns import Column
from mphdrr.core.geometry.system import PinholeSystem

ADDED = (
    Column("shim", "shim_thickness", help="shim under the crystal", blank=0.1, plausible=(0.01, 5)),
    Column("coat", "hole_coating", kind="choice", choices=("none", "gold"), blank="none", help="coating of the hole"),
    Column("batch", "crystal_batch", kind="text", blank="", help="batch of the crystal"),
)


@pytest.fixture
def collection(scene, ring_system, monkeypatch):
    """A scanner whose table has three more columns, one of each module's own values."""
    registration.unregister()
    monkeypatch.setattr(PinholeSystem, "columns", PinholeSystem.columns.with_columns(*ADDED))
    registration.register()
    system = ring_system.replace(
        shim_thickness=np.linspace(0.1, 0.2, 8) / 3, crystal_batch=[f"B {n}" for n in range(8)], hole_coating="gold"
    )
    made = scanner.build_scanner(scene, system)
    bpy.context.view_layer.update()
    yield made
    registration.unregister()
    monkeypatch.undo()
    registration.register()
    assert "shim_thickness" not in bpy.types.Object.bl_rna.properties["mphdrr_module"].fixed_type.properties


def drawn(name: str) -> dict[str, object]:
    """Property -> owner, of what a panel draws."""
    panel, found = getattr(bpy.types, name), {}
    layout = MagicMock()
    for part in ("row", "column", "box", "split"):
        getattr(layout, part).return_value = layout
    layout.prop.side_effect = lambda owner, name, **_: found.setdefault(name, owner)
    panel.draw_scanner(MagicMock(layout=layout), bpy.context, scanner.active_scanner(bpy.context.scene))
    return found


def test_they_are_properties_with_their_limits_and_words(collection):
    properties = scanner.module(collection, 1).mphdrr_module.bl_rna.properties
    shim, coat, batch = (properties[name] for name in ("shim_thickness", "hole_coating", "crystal_batch"))
    assert (shim.type, shim.name, shim.soft_max) == ("FLOAT", "Shim Thickness", 5.0) and "in mm" in shim.description
    assert coat.type == "ENUM" and [item.identifier for item in coat.enum_items] == ["none", "gold"]
    assert batch.type == "STRING" and "batch of the crystal" in batch.description


def test_they_are_drawn(collection):
    module = scanner.module(collection, 1).mphdrr_module
    for all_at_once, owner in ((False, module), (True, collection.mphdrr_scanner)):
        bpy.context.scene.mphdrr_geometry.all_at_once = all_at_once
        found = drawn("MPHDRR_PT_design")
        for name in ("shim_thickness", "hole_coating", "crystal_batch", "crystal_material", "pinhole_diameter"):
            assert found[name] == owner, name


def test_they_are_read_exactly_edited_and_kept(collection, tmp_path):
    expected = np.linspace(0.1, 0.2, 8) / 3
    read = scanner.read_scanner(collection)
    assert np.array_equal(read.shim_thickness, expected) and read.hole_coating.tolist() == ["gold"] * 8
    module = scanner.module(collection, 3).mphdrr_module
    module.shim_thickness, module.hole_coating, module.crystal_batch = 0.7, "none", "Ü 7"
    module.crystal_material = "CsI"
    expected[2] = 0.7
    path = str(tmp_path / "columns.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    opened = scanner.active_scanner(bpy.context.scene)
    read = scanner.read_scanner(opened)
    assert np.array_equal(read.shim_thickness, expected)
    assert read.hole_coating.tolist() == ["gold"] * 2 + ["none"] + ["gold"] * 5
    assert read.crystal_batch[2] == "Ü 7" and read.crystal_batch[3] == "B 3"
    assert read.crystal_material.tolist() == ["", "", "CsI", *[""] * 5]
    assert scanner.losses(opened) == ["module 3 with changed numbers"]
    assert "hole_coating" in opened.mphdrr_scanner.mixed.split()
    opened.mphdrr_scanner.crystal_batch = "all"
    assert scanner.read_scanner(opened).crystal_batch.tolist() == ["all"] * 8
    scanner.module(opened, 5).mphdrr_module.shim_thickness = 0.0
    assert "shim_thickness must be more than 0" in scanner.module(opened, 5).mphdrr_module.problem
    with pytest.raises(InputError, match="module 5"):
        scanner.read_scanner(opened)
