"""The window speaks of what it shows: no option or command of the command line, no key of a recipe."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import bpy
import pytest

from mphdrr.addon import registration
from mphdrr.addon.blender.reports import in_window
from mphdrr.core.runs.settings import SETTINGS

TOP = Path(registration.__file__).parents[1]
COMMAND = re.compile(r"--[a-z]|\bmphdrr [a-z]")
FOREIGN = re.compile(COMMAND.pattern + "|" + "|".join(rf"\b{re.escape(key)}\b(?!\.)" for key in SETTINGS))


def text_of(node: ast.expr) -> str:
    """A text in code, with {} for what is put into it."""
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
    return str(node.value) if isinstance(node, ast.Constant) else "{}"


def messages() -> dict[str, str]:
    """What `InputError` and warnings say, by where; not those of commands."""
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


def test_no_tooltip_has_them():
    texts = {}
    for cls in registration.CLASSES:
        if issubclass(cls, bpy.types.Operator):
            group, name = cls.bl_idname.split(".")
            rna = getattr(getattr(bpy.ops, group), name).get_rna_type()
        else:
            rna = cls.bl_rna
        texts[cls.__name__] = f"{rna.name}. {rna.description}"
        for prop in rna.properties:
            choices = prop.enum_items if prop.type == "ENUM" else ()
            for each in (prop, *choices):
                texts[f"{cls.__name__}.{prop.identifier}.{each.identifier}"] = f"{each.name}. {each.description}"
    assert len(texts) > 1000
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
    ],
)
def test_messages_in_the_windows_words(said, shown):
    kind = SETTINGS["model.kind"]
    words = [f"{kind.label} {kind.words[word][0]}" for word in ("emission", "transmission")]
    assert in_window(said) == (shown or f"{SETTINGS['model.hole'].label}: needs {words[0]} or {words[1]}")
