"""Recipe of a projection run: the values of its settings, and the TOML file that holds them."""

import dataclasses
import os
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from ..errors import InputError, naming
from ..files import AnyPath, note_input, relative_path, require_ending, write_bytes
from ..phantoms.settings import setting_names
from ..recipes.settings import Setting
from ..recipes.toml import read_toml, toml_value
from ..recipes.values import Values, unmet_needs
from .settings import SAMPLING, SETTINGS, TABLES, settings_with

_PLACEMENT = ("phantom.position", "phantom.euler_degrees")


@dataclasses.dataclass(frozen=True)
class Recipe(Values):
    """Recipe of a projection run: values of `settings.SETTINGS` by their keys.

    The settings of a phantom's class have keys of the form ``"phantom.<name>"``.

    >>> recipe = Recipe({"system.file": "scanner.xlsx", "model.kind": "emission", "model.isotope": "Tc-99m"})
    >>> recipe["model.time"]
    1.0
    """

    def __post_init__(self) -> None:
        object.__setattr__(self, "given", _with_hole(self.given, self.given))
        super().__post_init__()

    @property
    def rows(self) -> Mapping[str, Setting]:
        """Settings by their keys, those of the phantom's kind included."""
        return _rows(self.given)

    @staticmethod
    def term_text(term: str) -> str:
        """Return a term of a condition with its option on the command line, for messages."""
        key, _, word = term.partition("=")
        if word:
            return f"{key} = {word}" + (f" (--{word})" if key == "model.kind" else "")
        return f"{key} ({SETTINGS[key].option})" if key in SETTINGS else key

    def updated(self, changes: Mapping[str, Any]) -> "Recipe":
        """Return this recipe with other values, None to remove one, and without those that have no effect any more.

        The numbers of another kind of phantom are removed, too, and the other description of a phantom's pose: a matrix
        replaces position and angles, and these two together replace a matrix.
        """
        values = {**self.given, **changes}
        stale: list[str] = []
        if (values.get("phantom.kind") or SETTINGS["phantom.kind"].default) != self["phantom.kind"]:
            stale += [key for key in values if key not in SETTINGS]
        if changes.get("phantom.matrix") is not None:
            stale += _PLACEMENT
        elif any(key in changes for key in _PLACEMENT) and all(key in values for key in _PLACEMENT):
            stale.append("phantom.matrix")
        return fitting_recipe({key: values[key] for key in values if key not in stale or key in changes}, changes)

    def fields(self, table: str, cls: Any) -> dict[str, Any]:
        """Return the given values of a table that are arguments of the dataclass `cls`, by the arguments' names."""
        keys = {f"{table}.{key}": name for key, name in setting_names(cls).items()}
        return {name: self.given[key] for key, name in keys.items() if key in self.given}

    def tables(self) -> dict[str, dict[str, Any]]:
        """Return the given values by table and name, as JSON and TOML hold them."""
        tables: dict[str, dict[str, Any]] = {table: {} for table in TABLES}
        for key, value in self.given.items():
            table, _, name = key.partition(".")
            tables[table][name] = value
        return {table: values for table, values in tables.items() if values}


def fitting_recipe(values: Mapping[str, Any], required: Collection[str] = ()) -> Recipe:
    """Return the recipe of those `values` that are not None and have an effect.

    Raises `InputError` if a value whose key is in `required` has none.
    """
    values = _with_hole({key: value for key, value in values.items() if value is not None}, required)
    while True:
        rows = _rows(values)
        stale = [key for key in values if key not in required and (key not in rows or unmet_needs(values, key, rows))]
        if not stale:
            return Recipe(values)
        for key in stale:
            del values[key]


def recorded_recipe(recipe: Recipe) -> Recipe:
    """Return the recipe as a run keeps it: with this version's defaults of all settings that its images depend on."""
    tables = ("model.", "detector.", "compute.")
    defaults = {key: setting.default for key, setting in SETTINGS.items() if key.startswith(tables)}
    return fitting_recipe({**defaults, **recipe.given}, recipe.given)


def recipe_from_tables(tables: Mapping[str, Any], recorded: bool = False) -> Recipe:
    """Return the recipe of values by table and name, as `Recipe.tables` gives them, without defaults that have no effect.

    `recorded` says that the tables are those of a run. Earlier versions recorded numbers of rays that had no effect; these
    are removed, too. Errors are those of `Recipe`.
    """
    values: dict[str, Any] = {}
    for table, entries in tables.items():
        if table not in TABLES or not isinstance(entries, Mapping):
            raise InputError(f"{table}: expected one of the tables {', '.join(f'[{name}]' for name in TABLES)}")
        values |= {f"{table}.{name}": value for name, value in entries.items()}
    # A recorded default may have no effect in a later version, so it is not required to have one.
    optional = SAMPLING if recorded else ()
    required = [k for k, v in values.items() if k not in SETTINGS or (v != SETTINGS[k].default and k not in optional)]
    return fitting_recipe(values, required)


def read_recipe(path: AnyPath) -> Recipe:
    """Return the recipe of a TOML file, whose paths are relative to its folder; `InputError` names file and key."""
    folder = Path(path).parent
    tables = read_toml(path)
    with naming(path):
        if not tables:
            raise InputError(f"it is empty; expected some of the tables {', '.join(f'[{name}]' for name in TABLES)}")
        return _with_paths(recipe_from_tables(tables), lambda name: os.path.normpath(folder / name))


def note_files(recipe: Recipe) -> None:
    """Note all files that a recipe names as inputs of the running command; `note_input` refuses those that are outputs."""
    _with_paths(recipe, note_input)


def write_recipe(recipe: Recipe, path: AnyPath) -> None:
    """Write a recipe as TOML: the given values, and every other setting as a comment with its default.

    Raises `InputError` if the name does not end in .toml, or the file cannot be written.
    """
    path = Path(path)
    require_ending(path, (".toml",))
    recipe = _with_paths(recipe, lambda name: relative_path(name, path.parent))
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


def _with_hole(values: Mapping[str, Any], required: Collection[str]) -> dict[str, Any]:
    """Return the values of a recipe of counts, with the hole "rays" if its numbers of rays ask for rays.

    They do so if no hole is given; beside the hole "auto", only if they are `required`.
    """
    changed = {key for key in SAMPLING if values.get(key, SETTINGS[key].default) != SETTINGS[key].default}
    numbers = changed if "model.hole" not in values else changed.intersection(required)
    is_automatic = values.get("model.kind") == "emission" and values.get("model.hole", "auto") == "auto"
    return {**values, "model.hole": "rays"} if is_automatic and numbers else dict(values)


def _rows(values: Mapping[str, Any]) -> Mapping[str, Setting]:
    """Return all settings by their keys, with those of the kind of phantom in `values`."""
    return settings_with(str(values.get("phantom.kind", SETTINGS["phantom.kind"].default)))


def _with_paths(recipe: Recipe, change: Callable[[str], str]) -> Recipe:
    """Return the recipe with every file's name changed by a function."""
    changed = {}
    for key, value in recipe.given.items():
        if key in SETTINGS and SETTINGS[key].names_file(value):
            changed[key] = tuple(map(change, value)) if isinstance(value, tuple) else change(value)
    return Recipe({**recipe.given, **changed})
