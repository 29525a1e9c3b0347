"""What the window says: words of the field alone, in menus where F3 finds every command, and in names that exist."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from unittest.mock import MagicMock

import bpy
import pytest

from mphdrr.addon import registration
from mphdrr.addon.blender.reports import in_window
from mphdrr.core.runs.settings import SETTINGS

TOP = Path(registration.__file__).parents[1]
COMMAND = re.compile(r"--[a-z]|\bmphdrr [a-z]")
FOREIGN = re.compile(COMMAND.pattern + "|" + "|".join(rf"\b{re.escape(key)}\b(?!\.)" for key in SETTINGS))


def text_of(node: ast.expr) -> str:
    """Return a text in code, with {} for what is put into it."""
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
    return str(node.value) if isinstance(node, ast.Constant) else "{}"


def messages() -> dict[str, str]:
    """Return the texts of `InputError` and warnings, by their places; not those of commands."""
    paths = [path for top in ("core", "addon", "operators") for path in (TOP / top).rglob("*.py")]
    return {
        f"{path.relative_to(TOP)}:{node.lineno}": text_of(node.args[0])
        for path in paths
        if "cli" not in path.parts
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("InputError", "warn", "Locked") and node.args
    }


def test_no_message_has_words_of_the_command_line():
    found = messages()
    assert len(found) > 500 and any(COMMAND.search(text) for text in found.values())
    said = {where: in_window(text) for where, text in found.items()}
    # In a Python script or a process that is no Blender.
    others = ("core/exchange/gate10_script.py", "core/events/dask_work.py")
    assert not {where: text for where, text in said.items() if FOREIGN.search(text) and not where.startswith(others)}
    assert all(text.strip() for text in said.values()), "something is left to be read"


def test_every_operator_and_setting_is_explained_without_them():
    texts, silent = {}, []
    for cls in registration.CLASSES:
        if is_operator := issubclass(cls, bpy.types.Operator):
            rna = getattr(bpy.ops.mphdrr, cls.bl_idname.partition(".")[2]).get_rna_type()
        else:
            rna = cls.bl_rna
        texts[cls.__name__] = f"{rna.name}. {rna.description}"
        silent += [cls.__name__] if is_operator and not rna.description.strip() else []
        for prop in rna.properties:
            for choice in (prop, *(prop.enum_items if prop.type == "ENUM" else ())):
                texts[f"{cls.__name__}.{prop.identifier}.{choice.identifier}"] = f"{choice.name}. {choice.description}"
            is_group = prop.type == "COLLECTION" or isinstance(getattr(prop, "fixed_type", 0), bpy.types.PropertyGroup)
            is_setting = (
                (is_operator or issubclass(cls, bpy.types.PropertyGroup)) and not prop.is_hidden and not is_group
            )
            if is_setting and prop.identifier not in ("rna_type", "name") and not prop.description.strip():
                silent.append(f"{cls.__name__}.{prop.identifier}")
    assert len(texts) > 1000 and not silent
    assert not {name: text for name, text in texts.items() if COMMAND.search(text)}


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        ("reconstruction.method: osem needs counts", "Method: osem needs counts"),
        ('model.hole: needs model.kind=emission or model.kind = "transmission"', None),
        ("recipe.toml: model.kind: expected one of", "recipe.toml: model.kind: expected one of"),
        ("a.h5: has no recipe (--set): give one", "a.h5: has no recipe: give one"),
        ("x: cannot be read: mphdrr events check x --repair writes it anew", "x: cannot be read"),
        ("go on with these (mphdrr events make x), or another", "go on with these, or another"),
        ("it holds CT numbers; give --energy KEV or --quantity mu", "it holds CT numbers"),
        (
            "no energy (--energy KEV): hu_to_mu(volume, energy), `mphdrr volume convert FILE`, or CT to Attenuation",
            "no energy: hu_to_mu(volume, energy), or CT to Attenuation",
        ),
        ("a map can help (columns='map.toml', --columns map.toml; docs)", "a map can help (columns='map.toml'; docs)"),
    ],
)
def test_messages_in_the_windows_words(said, shown):
    kind = SETTINGS["model.kind"]
    words = [f"{kind.label} {kind.words[word][0]}" for word in ("emission", "transmission")]
    assert in_window(said) == (shown or f"{SETTINGS['model.hole'].label}: needs {words[0]} or {words[1]}")


CLASSES = {cls.__name__: cls for cls in registration.CLASSES}
WORDS = ("projection", "module", "collimator", "geometry", "phantom", "volume", "example")


def entries(draw, path: str) -> dict[str, list[str]]:
    """Return the search's paths of the commands in what `draw` draws and in our menus below, by their idnames."""
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
def menu_paths(scene) -> dict[str, list[str]]:
    merged: dict[str, list[str]] = {}
    for menu, draw in registration.MENUS:
        for idname, paths in entries(draw, menu.bl_rna.name).items():
            merged.setdefault(idname, []).extend(paths)
    return merged


def test_every_command_is_in_a_menu_and_found_by_a_word_of_the_field(menu_paths):
    operators = [cls for cls in registration.CLASSES if issubclass(cls, bpy.types.Operator)]
    commands = {cls.bl_idname for cls in operators if "INTERNAL" not in getattr(cls, "bl_options", ())}
    assert len(commands) > 30
    assert commands <= menu_paths.keys(), "add them to panels/menus.py, or make them INTERNAL"
    joined = {idname: " ".join(paths).lower() for idname, paths in menu_paths.items()}
    assert not {idname: text for idname, text in joined.items() if not any(word in text for word in WORDS)}
    in_object_menu = [path for paths in menu_paths.values() for path in paths if path.startswith("VIEW3D_MT_object >")]
    for word in ("projection", "module", "collimator"):
        assert sum(word in path.lower() for path in in_object_menu) >= 5, f"{word}: in the 3D View several are found"


def test_every_operator_and_panel_that_the_code_names_exists():
    rooms = [TOP / room for room in ("addon", "operators", "panels")]
    text = "".join(path.read_text(encoding="utf-8") for room in rooms for path in room.rglob("*.py"))
    named = set(re.findall(r'"mphdrr\.(\w+)"', text)) - {"add_"}  # and a kind of phantom
    assert len(named) > 55
    assert not [name for name in named if f"MPHDRR_OT_{name}" not in CLASSES]
    others = set(re.findall(r'"(MPHDRR_(?:PT|MT|UL)_\w+)"', text))
    assert others and others <= CLASSES.keys()


def test_labels_follow_from_the_names_of_classes_unless_these_say_another():
    operators = ("show_run", "mesh_from_volume", "ct_to_attenuation")
    labels = [getattr(bpy.ops.mphdrr, name).get_rna_type().name for name in operators]
    assert labels == ["Show Run", "Mesh from Volume", "CT to Attenuation"]
    assert bpy.types.MPHDRR_PT_event_set.bl_label == "Event Set"
