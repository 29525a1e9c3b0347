"""Every command of ours is in a menu, where the menus' search (F3) finds it by a word of the field."""

from __future__ import annotations

import re
from pathlib import Path
from unittest.mock import MagicMock

import bpy
import pytest

from mphdrr.addon import registration

CLASSES = {cls.__name__: cls for cls in registration.CLASSES}
WORDS = ("projection", "module", "collimator", "geometry", "phantom", "volume", "example")


def entries(draw, path: str) -> dict[str, list[str]]:
    """Paths, as the search has them, of the commands in what `draw` draws and in our menus below, by their idnames."""
    menu = MagicMock()
    draw(menu, bpy.context)
    found: dict[str, list[str]] = {}
    for call, arguments, options in menu.layout.mock_calls:
        what = call.rpartition(".")[2]
        if what in ("operator", "operator_menu_enum") and arguments[0].startswith("mphdrr."):
            group, name = arguments[0].split(".")
            label = options.get("text") or getattr(getattr(bpy.ops, group), name).get_rna_type().name
            found.setdefault(arguments[0], []).append(f"{path} > {label}")
        elif what == "menu" and arguments[0] in CLASSES:
            below = CLASSES[arguments[0]]
            text = options.get("text") or below.bl_label
            for idname, paths in entries(below.draw, f"{path} > {text}").items():
                found.setdefault(idname, []).extend(paths)
    return found


@pytest.fixture
def found(scene) -> dict[str, list[str]]:
    merged: dict[str, list[str]] = {}
    for menu, draw in registration.MENUS:
        for idname, paths in entries(draw, menu.bl_rna.name).items():
            merged.setdefault(idname, []).extend(paths)
    return merged


def test_every_command_is_in_a_menu_and_found_by_a_word_of_the_field(found):
    commands = {
        cls.bl_idname
        for cls in registration.CLASSES
        if issubclass(cls, bpy.types.Operator) and "INTERNAL" not in getattr(cls, "bl_options", ())
    }
    assert len(commands) > 30
    assert commands <= found.keys(), "add them to panels/menus.py, or make them INTERNAL"
    lost = {
        idname: paths
        for idname, paths in found.items()
        if not any(word in path.lower() for path in paths for word in WORDS)
    }
    assert not lost


@pytest.mark.parametrize("word", ["projection", "module", "collimator"])
def test_a_word_finds_several_commands_in_the_3d_view(scene, word):
    draw = registration.MENUS[[menu for menu, _ in registration.MENUS].index(bpy.types.VIEW3D_MT_object)][1]
    paths = [path for each in entries(draw, "Object").values() for path in each]
    assert sum(word in path.lower() for path in paths) >= 5


def test_every_operator_and_panel_that_the_code_names_exists():
    top = Path(registration.__file__).parents[1]
    texts = [
        path.read_text(encoding="utf-8")
        for room in ("addon", "operators", "panels")
        for path in (top / room).rglob("*.py")
    ]
    named = {name for text in texts for name in re.findall(r'"mphdrr\.(\w+)"', text)} - {
        "add_"
    }  # and a kind of phantom
    assert len(named) > 55
    assert not [name for name in named if f"MPHDRR_OT_{name}" not in CLASSES]
    others = {name for text in texts for name in re.findall(r'"(MPHDRR_(?:PT|MT|UL)_\w+)"', text)}
    assert others and others <= CLASSES.keys()


def test_labels_follow_from_the_names_of_classes_unless_these_say_another():
    assert bpy.ops.mphdrr.show_run.get_rna_type().name == "Show Run"
    assert bpy.ops.mphdrr.mesh_from_volume.get_rna_type().name == "Mesh from Volume"
    assert bpy.ops.mphdrr.ct_to_attenuation.get_rna_type().name == "CT to Attenuation"
    assert bpy.types.MPHDRR_PT_event_set.bl_label == "Event Set"
