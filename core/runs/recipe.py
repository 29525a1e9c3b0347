"""Recipes: what a projection run was, or is to be, made from, and the TOML files that hold them."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import InputError, naming
from ..files import write_bytes
from ..phantoms.kinds import KINDS
from ..phantoms.settings import setting_names
from ..toml import read_toml, toml_value
from .settings import SAMPLING, SETTINGS, TABLES

_PLACED = ("phantom.position", "phantom.euler_degrees")


@dataclass(frozen=True)
class Recipe:
    """Values of settings by their keys (`settings.SETTINGS`); those that are not given have their defaults.

    The settings of a phantom's class are there as ``"phantom.<name>"``. `InputError` for an unknown setting, a wrong value,
    and a setting without an effect beside the others.

    >>> recipe = Recipe({"system.file": "scanner.xlsx", "model.kind": "emission", "model.isotope": "Tc-99m"})
    >>> recipe["model.time"]
    1.0
    """

    given: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        checked = _with_hole({key: _checked(self.given, key) for key in self.given}, self.given)
        object.__setattr__(self, "given", checked)
        for key in checked:
            for need in _unmet(checked, key):
                names = map(_said, need.removeprefix("no ").split(" or "))
                problem = "does not go with" if need.startswith("no ") else "needs"
                raise InputError(f"{_said(key)} {problem} {' or '.join(names)}")

    def __getitem__(self, key: str) -> Any:
        return self.given[key] if key in self.given else SETTINGS[key].default

    def updated(self, changes: Mapping[str, Any]) -> Recipe:
        """This recipe with other values, None to take one away; entries without an effect beside the new ones are dropped.

        So are the numbers of another kind of phantom, and the other description of a phantom's pose: a matrix replaces
        position and angles, and both of these together a matrix.
        """
        values = {**self.given, **changes}
        stale: list[str] = []
        if (values.get("phantom.kind") or SETTINGS["phantom.kind"].default) != self["phantom.kind"]:
            stale += [key for key in values if key not in SETTINGS]
        if changes.get("phantom.matrix") is not None:
            stale += _PLACED
        elif any(key in changes for key in _PLACED) and all(key in values for key in _PLACED):
            stale.append("phantom.matrix")
        return fitting_recipe({key: values[key] for key in values if key not in stale or key in changes}, changes)

    def fields(self, table: str, cls: Any) -> dict[str, Any]:
        """Given values of a table that are arguments of the dataclass `cls`, by their names."""
        keys = {f"{table}.{key}": name for key, name in setting_names(cls).items()}
        return {name: self.given[key] for key, name in keys.items() if key in self.given}

    def tables(self) -> dict[str, dict[str, Any]]:
        """The values by table and name, as JSON and TOML hold them."""
        tables: dict[str, dict[str, Any]] = {table: {} for table in TABLES}
        for key, value in self.given.items():
            table, _, name = key.partition(".")
            tables[table][name] = value
        return {table: values for table, values in tables.items() if values}


def fitting_recipe(values: Mapping[str, Any], kept: Collection[str] = ()) -> Recipe:
    """The recipe of those values, None aside, that have an effect; `InputError` where one of `kept` has none."""
    values = _with_hole({key: value for key, value in values.items() if value is not None}, kept)

    def is_stale(key: str) -> bool:
        is_known = key in SETTINGS or key.partition(".")[2] in _phantom_fields(values)
        return not is_known or bool(_unmet(values, key))

    while stale := [key for key in values if key not in kept and is_stale(key)]:
        for key in stale:
            del values[key]
    return Recipe(values)


def recorded_recipe(recipe: Recipe) -> Recipe:
    """The recipe as a run keeps it: with this version's defaults of what the images depend on."""
    of_images = ("model.", "detector.", "compute.")
    defaults = {key: setting.default for key, setting in SETTINGS.items() if key.startswith(of_images)}
    return fitting_recipe({**defaults, **recipe.given}, recipe.given)


def recipe_of_tables(tables: Mapping[str, Any], recorded: bool = False) -> Recipe:
    """The recipe of values by table and name, as `Recipe.tables` gives them, without defaults that have no effect.

    With `recorded` it is one of a run: earlier versions wrote numbers of rays that had no effect, and these go, too.
    `InputError` as of `Recipe`.
    """
    values: dict[str, Any] = {}
    for table, entries in tables.items():
        if table not in TABLES or not isinstance(entries, Mapping):
            raise InputError(f"{table}: expected one of the tables {', '.join(f'[{name}]' for name in TABLES)}")
        values |= {f"{table}.{name}": value for name, value in entries.items()}
    # Versions record defaults that have no effect in later ones.
    dropped = SAMPLING if recorded else ()
    given = [k for k, v in values.items() if k not in SETTINGS or (v != SETTINGS[k].default and k not in dropped)]
    return fitting_recipe(values, given)


def read_recipe(path: str | os.PathLike[str]) -> Recipe:
    """The recipe in a TOML file, whose paths are relative to its folder; `InputError` names file and key."""
    folder = Path(path).parent
    tables = read_toml(path)
    with naming(path):
        return _with_paths(recipe_of_tables(tables), lambda name: os.path.normpath(folder / name))


def write_recipe(recipe: Recipe, path: str | os.PathLike[str]) -> None:
    """Write a recipe as TOML: what is given, and every other setting as a comment with its default.

    `InputError` where the name does not end in .toml, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".toml":
        raise InputError(f"{path}: expected a name ending in .toml")

    def relative(name: str) -> str:
        try:
            return os.path.relpath(name, path.parent)
        except ValueError:  # on another drive
            return os.path.abspath(name)

    recipe = _with_paths(recipe, relative)
    lines = ["# How to make projections with mphDRR: mphdrr project FILE -o run.h5"]
    for table in TABLES:
        lines += ["", f"[{table}]"]
        for key in dict.fromkeys([*SETTINGS, *recipe.given]):
            if key.partition(".")[0] != table:
                continue
            if key in SETTINGS:
                lines.append(f"# {SETTINGS[key].help}")
            value = recipe[key]
            line = f"{key.partition('.')[2]} =" + ("" if value is None else f" {toml_value(value)}")
            lines.append(line if key in recipe.given else f"# {line}")
    write_bytes(path, "\n".join([*lines, ""]).encode())


def _with_hole(values: dict[str, Any], kept: Collection[str]) -> dict[str, Any]:
    """The values, with hole "rays" for numbers of rays beside hole "auto", if they are `kept`, or beside none."""
    given = {key for key in SAMPLING if values.get(key, SETTINGS[key].default) != SETTINGS[key].default}
    numbers = given if "model.hole" not in values else given.intersection(kept)
    is_free = values.get("model.kind") == "emission" and values.get("model.hole", "auto") == "auto"
    return {**values, "model.hole": "rays"} if is_free and numbers else values


def is_met(values: Mapping[str, Any], need: str) -> bool:
    """Whether given values meet a condition of `Setting.needs`."""

    def holds(term: str) -> bool:
        key, _, word = term.partition("=")
        if word and SETTINGS[key].names_file(values.get(key)):  # what its contents take is known when it is read
            return True
        return values.get(key, SETTINGS[key].default) == word if word else values.get(key) not in (None, False)

    return any(map(holds, need.removeprefix("no ").split(" or "))) != need.startswith("no ")


def _unmet(values: Mapping[str, Any], key: str) -> list[str]:
    """The conditions that keep a setting from having an effect beside the others."""
    own = ("no phantom.file", "no phantom.text", *SETTINGS["phantom.position"].needs)
    return [need for need in (SETTINGS[key].needs if key in SETTINGS else own) if not is_met(values, need)]


def _said(term: str) -> str:
    """A setting, or one with a value, for messages: with its option."""
    key, _, word = term.partition("=")
    if word:
        return f"{key} = {word}" + (f" (--{word})" if key == "model.kind" else "")
    return f"{key} ({SETTINGS[key].option})" if key in SETTINGS else key


def _checked(values: Mapping[str, Any], key: str) -> Any:
    """The value of a key, as a recipe keeps it."""
    if key in SETTINGS:
        return SETTINGS[key].checked(values[key])
    table, _, name = key.partition(".")
    known = [other.partition(".")[2] for other in SETTINGS if other.startswith(f"{table}.")]
    if table == "phantom":
        own = _phantom_fields(values)
        if name in own:  # the phantom's class checks it
            value = values[key].tolist() if hasattr(values[key], "tolist") else values[key]
            return tuple(value) if isinstance(value, list) else value
        known += own
    if not known:
        raise InputError(f"{key}: expected TABLE.NAME with a table of {', '.join(TABLES)}")
    raise InputError(f"{key}: no such setting; expected {', '.join(known)}")


def _phantom_fields(values: Mapping[str, Any]) -> list[str]:
    """The numbers of the phantom's kind."""
    name = values.get("phantom.kind", SETTINGS["phantom.kind"].default)
    return [key for kind in KINDS if kind.name == name for key in setting_names(kind.phantom)]


def _with_paths(recipe: Recipe, change: Callable[[str], str]) -> Recipe:
    """The recipe with every file's name changed by a function."""
    changed = {}
    for key, value in recipe.given.items():
        if key in SETTINGS and SETTINGS[key].names_file(value):
            changed[key] = tuple(map(change, value)) if isinstance(value, tuple) else change(value)
    return Recipe({**recipe.given, **changed})
