"""Recipes: what a projection run was, or is to be, made from, and the TOML files that hold them."""

import dataclasses
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from ..errors import InputError, naming
from ..files import AnyPath, require_ending, write_bytes
from ..phantoms.settings import setting_names
from ..toml import read_toml, toml_value
from .settings import SAMPLING, SETTINGS, TABLES, Setting, settings_with

_PLACED = ("phantom.position", "phantom.euler_degrees")


@dataclasses.dataclass(frozen=True)
class Values(ABC):
    """Values of settings by their keys; those that are not given have their defaults.

    `InputError` for an unknown setting, a wrong value, and a setting without an effect beside the others.
    """

    given: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    @abstractmethod
    def rows(self) -> Mapping[str, Setting]:
        """The settings that there are, by their keys."""

    def __post_init__(self) -> None:
        rows = self.rows
        for key in self.given:
            if key not in rows:
                siblings = [other for other in rows if other.rpartition(".")[0] == key.rpartition(".")[0]]
                if not siblings:
                    tables = dict.fromkeys(other.partition(".")[0] for other in rows)
                    raise InputError(f"{key}: expected TABLE.NAME with a table of {', '.join(tables)}")
                known = ", ".join(other.rpartition(".")[2] for other in siblings)
                raise InputError(f"{key}: no such setting; expected {known}")
        checked = {key: rows[key].checked(value) for key, value in self.given.items()}
        object.__setattr__(self, "given", checked)
        for key in checked:
            for need in _unmet(checked, key, rows):
                names = map(_named, need.removeprefix("no ").split(" or "))
                problem = "does not go with" if need.startswith("no ") else "needs"
                raise InputError(f"{_named(key)} {problem} {' or '.join(names)}")

    def __getitem__(self, key: str) -> Any:
        return self.given[key] if key in self.given else self.rows[key].default


@dataclasses.dataclass(frozen=True)
class Recipe(Values):
    """What a projection run is made from: values of `settings.SETTINGS`, by their keys.

    The settings of a phantom's class are there as ``"phantom.<name>"``.

    >>> recipe = Recipe({"system.file": "scanner.xlsx", "model.kind": "emission", "model.isotope": "Tc-99m"})
    >>> recipe["model.time"]
    1.0
    """

    def __post_init__(self) -> None:
        object.__setattr__(self, "given", _with_hole(self.given, self.given))
        super().__post_init__()

    @property
    def rows(self) -> Mapping[str, Setting]:
        """All settings, with those of the phantom's kind."""
        return _rows(self.given)

    def updated(self, changes: Mapping[str, Any]) -> "Recipe":
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
    while True:
        rows = _rows(values)
        stale = [key for key in values if key not in kept and (key not in rows or _unmet(values, key, rows))]
        if not stale:
            return Recipe(values)
        for key in stale:
            del values[key]


def recorded_recipe(recipe: Recipe) -> Recipe:
    """The recipe as a run keeps it: with this version's defaults of what the images depend on."""
    of_images = ("model.", "detector.", "compute.")
    defaults = {key: setting.default for key, setting in SETTINGS.items() if key.startswith(of_images)}
    return fitting_recipe({**defaults, **recipe.given}, recipe.given)


def recipe_of_tables(tables: Mapping[str, Any], recorded: bool = False) -> Recipe:
    """The recipe of values by table and name, as `Recipe.tables` gives them, without defaults that have no effect.

    With `recorded` it is one of a run: earlier versions wrote numbers of rays that had no effect, and these go, too.
    `InputError` as for `Recipe`.
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


def read_recipe(path: AnyPath) -> Recipe:
    """The recipe in a TOML file, whose paths are relative to its folder; `InputError` names file and key."""
    folder = Path(path).parent
    tables = read_toml(path)
    with naming(path):
        return _with_paths(recipe_of_tables(tables), lambda name: os.path.normpath(folder / name))


def write_recipe(recipe: Recipe, path: AnyPath) -> None:
    """Write a recipe as TOML: what is given, and every other setting as a comment with its default.

    `InputError` where the name does not end in .toml, or the file cannot be written.
    """
    path = Path(path)
    require_ending(path, (".toml",))

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


def _with_hole(values: Mapping[str, Any], kept: Collection[str]) -> dict[str, Any]:
    """The values, with hole "rays" for numbers of rays beside hole "auto", if they are `kept`, or beside none."""
    given = {key for key in SAMPLING if values.get(key, SETTINGS[key].default) != SETTINGS[key].default}
    numbers = given if "model.hole" not in values else given.intersection(kept)
    is_free = values.get("model.kind") == "emission" and values.get("model.hole", "auto") == "auto"
    return {**values, "model.hole": "rays"} if is_free and numbers else dict(values)


def is_met(values: Mapping[str, Any], need: str, rows: Mapping[str, Setting] = SETTINGS) -> bool:
    """Whether given values meet a condition of `Setting.needs`."""

    def holds(term: str) -> bool:
        key, _, word = term.partition("=")
        if word and rows[key].names_file(values.get(key)):  # what its contents take is known when it is read
            return True
        return values.get(key, rows[key].default) == word if word else values.get(key) not in (None, False)

    return any(map(holds, need.removeprefix("no ").split(" or "))) != need.startswith("no ")


def _unmet(values: Mapping[str, Any], key: str, rows: Mapping[str, Setting]) -> list[str]:
    """The conditions that keep a setting from having an effect beside the others."""
    return [need for need in rows[key].needs if not is_met(values, need, rows)]


def _named(term: str) -> str:
    """A setting, or one with a value, for messages: with its option."""
    key, _, word = term.partition("=")
    if word:
        return f"{key} = {word}" + (f" (--{word})" if key == "model.kind" else "")
    return f"{key} ({SETTINGS[key].option})" if key in SETTINGS else key


def _rows(values: Mapping[str, Any]) -> Mapping[str, Setting]:
    """All settings, with those of the phantom's kind."""
    return settings_with(str(values.get("phantom.kind", SETTINGS["phantom.kind"].default)))


def _with_paths(recipe: Recipe, change: Callable[[str], str]) -> Recipe:
    """The recipe with every file's name changed by a function."""
    changed = {}
    for key, value in recipe.given.items():
        if key in SETTINGS and SETTINGS[key].names_file(value):
            changed[key] = tuple(map(change, value)) if isinstance(value, tuple) else change(value)
    return Recipe({**recipe.given, **changed})
