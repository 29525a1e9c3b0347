"""Recipes: what a projection run was, or is to be, made from, and the TOML files that hold them."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files import replacing
from ..phantoms.kinds import KINDS
from ..toml import read_toml, toml_value
from .settings import SETTINGS, TABLES

_OF_IMAGES = ("model.", "detector.", "compute.")
_PLACED = ("phantom.position", "phantom.euler_degrees")


@dataclass(frozen=True)
class Recipe:
    """Values of settings by their keys (`settings.SETTINGS`); those that are not given have their defaults.

    >>> recipe = Recipe({"system.file": "scanner.xlsx", "model.kind": "emission", "model.isotope": "Tc-99m"})
    >>> recipe["model.time"]
    1.0

    Attributes
    ----------
    given : mapping
        What is given. The settings of a phantom's class are there as ``"phantom.<name>"``.

    Raises
    ------
    InputError
        There is no such setting, its value is not what is expected, or it has no effect beside the others.
    """

    given: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        checked = {key: _checked(self.given, key) for key in self.given}
        object.__setattr__(self, "given", checked)
        for key in checked:
            unmet = _unmet(checked, key)
            if unmet is not None:
                raise InputError(f"{_called(key)} {unmet}")

    def __getitem__(self, key: str) -> Any:
        return self.given[key] if key in self.given else SETTINGS[key].default

    def updated(self, changes: Mapping[str, Any]) -> Recipe:
        """This recipe with other values, None to take one away; entries without an effect beside the new ones are dropped.

        Raises
        ------
        InputError
            As `Recipe` does, of the changes.
        """
        values = {**self.given, **changes}
        if "phantom.matrix" in changes or any(key in changes for key in _PLACED):
            for key in ("phantom.matrix", *_PLACED):
                if key not in changes:
                    values.pop(key, None)
        return fitting_recipe(values, changes)

    def fields(self, table: str, cls: Any) -> dict[str, Any]:
        """Given values of a table that are arguments of the dataclass `cls`, by their names."""
        names = {field.name for field in dataclasses.fields(cls) if field.init}
        prefix = table + "."
        return {
            key.removeprefix(prefix): value for key, value in self.given.items() if key.removeprefix(prefix) in names
        }

    def complete(self) -> Recipe:
        """This recipe with the defaults, too, of all settings of the images that have an effect in it."""
        defaults = {key: s.default for key, s in SETTINGS.items() if key.startswith(_OF_IMAGES)}
        return fitting_recipe({**defaults, **self.given}, self.given)

    def tables(self) -> dict[str, dict[str, Any]]:
        """The values by table and name, as JSON and TOML hold them."""
        tables: dict[str, dict[str, Any]] = {}
        for key, value in self.given.items():
            table, _, name = key.partition(".")
            tables.setdefault(table, {})[name] = value
        return {name: tables[name] for name in TABLES if name in tables}


def fitting_recipe(values: Mapping[str, Any], kept: Collection[str] = ()) -> Recipe:
    """The recipe of those values, None aside, that have an effect beside each other.

    Raises
    ------
    InputError
        As `Recipe`, and where a value of `kept` has no effect.
    """
    values = {key: value for key, value in values.items() if value is not None}

    def is_stale(key: str) -> bool:
        if key not in SETTINGS and key.partition(".")[2] not in _phantom_fields(values.get("phantom.kind", "derenzo")):
            return True
        return _unmet(values, key) is not None

    while stale := [key for key in values if key not in kept and is_stale(key)]:
        for key in stale:
            del values[key]
    return Recipe(values)


def recipe_of_tables(tables: Mapping[str, Any]) -> Recipe:
    """The recipe of values by table and name, as `Recipe.tables` gives them.

    Raises
    ------
    InputError
        As `Recipe`.
    """
    values: dict[str, Any] = {}
    for table, entries in tables.items():
        if table not in TABLES or not isinstance(entries, Mapping):
            raise InputError(f"{table}: expected one of the tables {', '.join(f'[{name}]' for name in TABLES)}")
        values |= {f"{table}.{name}": value for name, value in entries.items()}
    return Recipe(values)


def read_recipe(path: str | os.PathLike[str]) -> Recipe:
    """The recipe in a TOML file, whose paths are relative to its folder.

    Raises
    ------
    InputError
        The file cannot be read, or as `Recipe`: the message names file and key.
    """
    folder = Path(path).parent
    tables = read_toml(path)
    try:
        return _with_paths(recipe_of_tables(tables), lambda name: os.path.normpath(folder / name))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def write_recipe(recipe: Recipe, path: str | os.PathLike[str]) -> None:
    """Write a recipe as TOML: what is given, and every other setting as a comment with its default.

    Raises
    ------
    InputError
        The name does not end in .toml, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".toml":
        raise InputError(f"{path}: expected a name ending in .toml")
    recipe = _with_paths(recipe, lambda name: _relative(name, path.parent))
    lines = ["# How to make projections with mphDRR: mphdrr project FILE -o run.h5"]
    for table in TABLES:
        lines += ["", f"[{table}]"]
        for key, setting in SETTINGS.items():
            if key.startswith(f"{table}."):
                name = key.removeprefix(f"{table}.")
                lines.append(f"# {setting.help}")
                if key in recipe.given:
                    lines.append(f"{name} = {toml_value(recipe[key])}")
                else:
                    lines.append(f"# {name} =" + ("" if setting.default is None else f" {toml_value(setting.default)}"))
        more = [key for key in recipe.given if key.startswith(f"{table}.") and key not in SETTINGS]
        lines += [f"{key.removeprefix(f'{table}.')} = {toml_value(recipe[key])}" for key in more]
    with replacing(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _called(key: str) -> str:
    return f"{key} ({SETTINGS[key].option})" if key in SETTINGS else key


def _checked(values: Mapping[str, Any], key: str) -> Any:
    """The value of a key, as a recipe keeps it."""
    if key in SETTINGS:
        return SETTINGS[key].checked(values[key])
    table, _, name = key.partition(".")
    known = [other.partition(".")[2] for other in SETTINGS if other.startswith(f"{table}.")]
    if table == "phantom":
        kind = values.get("phantom.kind", SETTINGS["phantom.kind"].default)
        own = _phantom_fields(kind)
        if name in own:
            value = values[key]
            return tuple(value) if isinstance(value, list) else value  # the phantom's class checks it
        known += own
    if not known:
        raise InputError(f"{key}: expected TABLE.NAME with a table of {', '.join(TABLES)}")
    raise InputError(f"{key}: no such setting; expected {', '.join(known)}")


def _phantom_fields(kind: Any) -> list[str]:
    classes = [other.phantom for other in KINDS if other.name == kind]
    return [field.name for cls in classes for field in dataclasses.fields(cls) if field.init]


def _unmet(values: Mapping[str, Any], key: str) -> str | None:
    """Why a setting has no effect beside the others; None where it has one."""
    if key in SETTINGS:
        needs = SETTINGS[key].needs
    else:
        needs = ("no phantom.file", "no phantom.text", *SETTINGS["phantom.position"].needs)
    for need in needs:
        if not is_met(values, need):
            if need.startswith("no "):
                return f"does not go with {_said(need[3:])}"
            return f"needs {' or '.join(map(_said, need.split(' or ')))}"
    return None


def is_met(values: Mapping[str, Any], need: str) -> bool:
    """Whether given values meet a condition of `Setting.needs`."""
    if need.startswith("no "):
        return not _holds(values, need[3:])
    return any(_holds(values, term) for term in need.split(" or "))


def _holds(values: Mapping[str, Any], term: str) -> bool:
    key, _, word = term.partition("=")
    if word:
        return bool(values.get(key, SETTINGS[key].default) == word)
    return values.get(key) not in (None, False)


def _said(term: str) -> str:
    key, _, word = term.partition("=")
    if key == "model.kind":
        return f"{key} = {word} (--{word})"
    return f"{key} = {word}" if word else _called(key)


def _with_paths(recipe: Recipe, change: Any) -> Recipe:
    """The recipe with every file's name changed by a function."""
    changed = {}
    for key, value in recipe.given.items():
        if key in SETTINGS and SETTINGS[key].is_path:
            changed[key] = tuple(map(change, value)) if isinstance(value, tuple) else change(value)
    return Recipe({**recipe.given, **changed})


def _relative(name: str, folder: Path) -> str:
    try:
        return os.path.relpath(name, folder)
    except ValueError:  # on another drive
        return os.path.abspath(name)
