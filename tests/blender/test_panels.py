"""Panels draw settings and buttons that exist, without a scanner, and with a scanner and a phantom."""

from __future__ import annotations

import functools
from unittest.mock import MagicMock

import blf
import bpy
import pytest

from mphdrr.addon import registration
from mphdrr.addon.scanner import scanner

PANELS = [cls for cls in registration.CLASSES if issubclass(cls, bpy.types.Panel)]


class Drawn:
    """Stands for a panel that Blender draws; its layout remembers what was drawn."""

    def __init__(self, cls: type) -> None:
        self.cls, self.layout = cls, MagicMock()

    def __getattr__(self, name: str):
        return functools.partial(getattr(self.cls, name), self)


def draw_panels() -> int:
    """Draw all visible panels; return their number."""
    count = 0
    for cls in PANELS:
        if hasattr(cls, "poll") and not cls.poll(bpy.context):
            continue
        panel = Drawn(cls)
        cls.draw(panel, bpy.context)
        count += 1
        for path, arguments, options in panel.layout.mock_calls:
            what = path.rpartition(".")[2]
            if what == "prop":
                owner, name = arguments
                assert name in owner.bl_rna.properties, f"{cls.__name__}: {name}"
            elif what in ("operator", "operator_menu_enum"):
                group, name = arguments[0].split(".")
                known = getattr(getattr(bpy.ops, group), name).get_rna_type().properties
                assert set(arguments[1:]) <= set(known.keys()), f"{cls.__name__}: {arguments} {options}"
    return count


def test_panels_draw_what_exists(scene, ring_system):
    without = draw_panels()
    collection = scanner.build_scanner(scene, ring_system)
    bpy.ops.mphdrr.check_geometry()
    bpy.context.view_layer.objects.active = scanner.module(collection, 3)
    assert draw_panels() > without
    copy = scanner.module(collection, 2).copy()
    collection.objects.link(copy)
    bpy.context.view_layer.update()
    scanner.module(collection, 1).mphdrr_module.pinhole_diameter = 500.0
    collection.mphdrr_scanner.findings = '["a finding that is too long for one line of the sidebar"]'
    draw_panels()


@pytest.mark.parametrize("kind", ["derenzo", "torso"])
def test_panels_draw_a_phantom(kind):
    assert getattr(bpy.ops.mphdrr, f"add_{kind}")(voxels=12) == {"FINISHED"}
    draw_panels()


def test_labels_of_the_projections_fit_beside_their_fields(scene):
    """At the default width a label has 85 pixels, with letters of 11; checkboxes have theirs on the right."""
    blf.size(0, 11)
    properties = scene.mphdrr_projections.bl_rna.properties
    drawn = {p.name for p in properties if p.type != "BOOLEAN" and not p.is_hidden}
    assert len(drawn) > 20
    assert {name for name in drawn if blf.dimensions(0, name)[0] > 85} == set()
