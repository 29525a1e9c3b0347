"""Recipes of event sets: which phantoms, volumes, models and projections the events have, in TOML."""

import copy
import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError, naming
from ..files import AnyPath
from ..geometry.grid import Grid
from ..physics.noise import NOISE_MODELS
from ..recipes.settings import Setting, choice_setting, settings_by_key, table_names, word_labels
from ..recipes.tables import check_entries, flat_entries, read_table, require_name, require_value, table_entries
from ..recipes.toml import parse_toml, toml_text
from ..runs.recipe import Recipe
from ..runs.settings import SETTINGS
from .draws import Drawn, DrawnValues, check_odds
from .entries import PhantomEntry, is_text, phantom_entry
from .inputs import Input, original_input

VERSION = 1
"""The version of the recipes' language."""
_TAKEN = (
    *("truth", "truth_affine", "affine", "pose", "placement", "position", "euler_degrees", "module_gain", "number"),
    *("level", "record", "json"),
)
"""What else exports and batches of an event hold, besides the images of models."""


_ROWS = settings_by_key((
    SETTINGS["phantom.voxels"].with_key("truth.voxels"),
    SETTINGS["phantom.spacing"].with_key("truth.spacing"),
    SETTINGS["phantom.position"].with_key("truth.center", text="Middle of the truth, x y z"),
    Setting("truth.quantity", str, "activity", "What the truth is of", words=word_labels(("activity", "mu"))),
    Setting("truth.store", str, "float32", "How the truth is stored, sparse without voxels that are 0",
            words=word_labels(("float32", "float16", "sparse"))),
    Setting("truth.below", float, 0.0, "Share of the truth's maximum below which values are taken for 0", least=0, most=1,
            needs=("truth.store=sparse",)),
    Setting("radon.angles", int, None, "Numbers of angles, one for each set of parallel projections", least=1, sizes=()),
    Setting("radon.over_degrees", float, 180.0, "Angle that they cover", unit="degrees", above=0, most=360),
    Setting("radon.rows", int, None, "Pixel rows", "one for each of the truth's voxels along z", least=1),
    Setting("radon.columns", int, None, "Pixel columns", "one for each of the truth's voxels along x or y", least=1),
    SETTINGS["phantom.spacing"].with_key("radon.pitch", text="Pixel size, one or along u and v", absent="the voxels'",
                                         sizes=(1, 2)),
    Setting("augmentation.mirror", float, 0.0, "Chance that the phantom is mirrored (its x axis reversed)", least=0, most=1),
    Drawn("augmentation.size", float, 1.0, "Factor of the phantom's lengths", above=0),
    Drawn("augmentation.activity", float, 1.0, "Factor of all values", above=0, needs=("truth.quantity=activity",)),
    Setting("augmentation.module_gain", float, 0.0, "Relative standard deviation of the modules' sensitivities", least=0,
            most=math.nextafter(1, 0)),
    Setting("noise.levels", float, (1.0,), "Shares of the acquisition time at which noise is drawn", above=0, sizes=()),
    *choice_setting("noise.model", NOISE_MODELS, "How counts vary around their means"),
    Setting("storage.images", str, "float32", "How images are stored", words=word_labels(("float32", "float16"))),
))  # fmt: skip
_SEED = SETTINGS["noise.seed"].with_key("seed", default=0, text="Seed of everything that is random")
_TABLES = table_names(_ROWS)
_KNOWN = ("version", "seed", "system", "detector", "phantoms", "models", "splits", *_TABLES)


@dataclass(frozen=True)
class _Settings(DrawnValues):
    """The values of an event recipe's `_TABLES`."""

    rows = _ROWS  # type: ignore[assignment]


@dataclass(frozen=True)
class Radon:
    """Parallel projections of the truth: `counts` of angles over `degrees`, images of `shape` pixels of `pitch` mm."""

    counts: tuple[int, ...]
    degrees: float
    shape: tuple[int, int]  # (n_v, n_u)
    pitch: tuple[float, float]  # mm along u, v


@dataclass(frozen=True)
class EventRecipe:
    """What the events of a set are made from; `InputError` names the entry that cannot be understood.

    Parameters
    ----------
    text
        The recipe, TOML.
    name
        What messages call it, such as its path.
    folder
        The paths in the recipe are relative to it.
    inputs
        Copies of the files that the recipe names, by these names, which a set keeps and reads instead.
    """

    text: str
    name: str = "recipe"
    folder: Path = field(default_factory=Path)
    inputs: Mapping[str, Input] = field(default_factory=dict)

    def __post_init__(self) -> None:
        with naming(self.name):
            values = self.values
            check_entries(values, VERSION, _KNOWN)
            _ = self.seed, self.settings, self.system, self.grid, self.phantoms, self.models, self.radon, self.splits

    def __getitem__(self, key: str) -> Any:
        """The value of a setting, such as "truth.store", or its default."""
        return self.settings[key]

    @cached_property
    def values(self) -> dict[str, Any]:
        """The tables of the recipe."""
        return parse_toml(self.text, self.name)

    @cached_property
    def settings(self) -> DrawnValues:
        """The values of the tables `_TABLES`."""
        return _Settings(table_entries(self.values, _ROWS))

    @cached_property
    def seed(self) -> int:
        """The seed of all random numbers."""
        return int(_SEED.checked(self.values.get("seed", _SEED.default)))

    @cached_property
    def system(self) -> Recipe:
        """The tables [system] and [detector], as a recipe of projections."""
        given = {name: read_table(self.values, name) for name in ("system", "detector")}
        recipe = Recipe(flat_entries(given, {}, *given))
        require_value(recipe["system.file"], "system.file", "name the geometry workbook")
        return recipe

    @property
    def quantity(self) -> str:
        """What the truth is of: "activity" or "mu"."""
        return str(self["truth.quantity"])

    @cached_property
    def grid(self) -> Grid:
        """The voxels of the truth."""
        return self.settings.table_grid("truth")

    @cached_property
    def phantoms(self) -> tuple[PhantomEntry, ...]:
        """The entries of [[phantoms]]."""
        entries = self.values.get("phantoms")
        if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
            raise InputError("phantoms: expected one [[phantoms]] or more")
        found = tuple(phantom_entry(entry, number, self.quantity) for number, entry in enumerate(entries, 1))
        names = [entry.name for entry in found]
        for name in names:
            if names.count(name) > 1:
                raise InputError(f"phantoms: {names.count(name)} are called {name!r}: give each a name of its own")
        check_odds([entry["odds"] for entry in found], len(found), "phantoms: odds")
        for entry in found:
            if entry["split"] is not None and self.splits and entry["split"] not in self.splits:
                raise InputError(f"phantoms: {entry.name}: split: expected one of {', '.join(self.splits)}")
        return found

    @cached_property
    def models(self) -> dict[str, Recipe]:
        """The models by name, each as a recipe of projections."""
        models = read_table(self.values, "models")
        found = {}
        for name, entries in models.items():
            with naming(f"models.{name}"):
                if not isinstance(entries, dict):
                    raise InputError(f"expected a table [models.{name}]")
                require_name(name, "model")
                if name in _TAKEN or name.startswith("radon"):
                    raise InputError(f"other arrays are called so: expected a name but {', '.join(_TAKEN)} and radon…")
                found[name] = self._model(dict(entries))
        for entry in self.phantoms if any(model["attenuation.of_phantom"] for model in found.values()) else ():
            if entry.is_volume and entry["mu_file"] is None:
                raise InputError(f'phantoms: {entry.name}: mu_file: missing, but a model has attenuation = "phantom"')
        if not found and self.radon is None:
            raise InputError("models: expected one [models.NAME] or more, or [radon]")
        return found

    @cached_property
    def radon(self) -> Radon | None:
        """The parallel projections; None for none."""
        if "radon" not in self.values:
            return None
        counts = require_value(self["radon.angles"], "radon.angles", "give numbers of angles, such as [96, 256]")
        if len(set(counts)) < len(counts):
            raise InputError(f"radon.angles: expected different numbers of angles, such as [96, 256], got {counts}")
        (n_x, n_y, n_z), (d_x, d_y, d_z) = self.grid.shape, self.grid.spacing.tolist()
        shape = self["radon.rows"] or n_z, self["radon.columns"] or max(n_x, n_y)
        pitch_u, pitch_v = np.broadcast_to(self["radon.pitch"] or (max(d_x, d_y), d_z), 2).tolist()
        return Radon(counts, self["radon.over_degrees"], shape, (pitch_u, pitch_v))

    @property
    def levels(self) -> tuple[float, ...]:
        """Shares of the acquisition time at which noise is to be drawn."""
        return tuple(self["noise.levels"])

    @cached_property
    def splits(self) -> dict[str, float]:
        """The shares of the splits by their names, which sum to 1; empty where there are none."""
        splits = read_table(self.values, "splits")
        if splits:
            check_odds(list(splits.values()), len(splits), "splits")
            for name in splits:
                require_name(name, "splits")
        total = math.fsum(splits.values())
        if splits and abs(total - 1) > 1e-6 and not self.inputs:  # sets that are begun keep what they were begun with
            raise InputError(f"splits: expected shares that sum to 1, got {total:.9g}")
        return {name: value / total for name, value in splits.items()}

    @cached_property
    def files(self) -> dict[str, str]:
        """The names of files in the recipe, and what each is: "copy", "activity" or "mu" (a volume)."""
        found: dict[str, str] = {}
        self._with_files(lambda name, what: found.setdefault(name, what) and name)
        return found

    def input(self, name: str) -> Input:
        """A file that the recipe names: the set's copy, or the original where there is none; `InputError` if neither."""
        known = self._read_inputs
        if name not in known:
            with naming(self.name):
                known[name] = self.inputs.get(name) or original_input(name, self.folder, self.files[name])
        return known[name]

    def placed(self, model: Recipe) -> Recipe:
        """A model's recipe with its file of efficiencies where it is."""
        file = model["model.efficiency"]
        return model.updated({"model.efficiency": str(self.input(file).path)}) if isinstance(file, str) else model

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of what the recipe says and of the contents of all files that it names; comments do not count."""
        values = self._with_files(lambda name, what: f"sha256:{self.input(name).sha256}")
        return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()

    @cached_property
    def _read_inputs(self) -> dict[str, Input]:
        return {}

    def _model(self, entries: dict[str, Any]) -> Recipe:
        attenuation, energy = entries.pop("attenuation", None), entries.pop("attenuation_energy", None)
        given = dict(self.system.given) | {f"model.{key}": value for key, value in entries.items()}
        if attenuation == "phantom":
            given["attenuation.of_phantom"] = True
        elif attenuation is not None:
            given["attenuation.file"] = attenuation
        if energy is not None:
            given["attenuation.energy"] = energy
        recipe = Recipe(given)
        if recipe["model.photons"] is not None and self.quantity != "mu":
            raise InputError('photons: they are of a truth of attenuation: [truth] quantity = "mu"')
        if recipe["model.kind"] == "spectral":
            raise InputError("spectral: event sets have X rays of one energy; expected transmission, with photons")
        if recipe["model.kind"] == "emission" and self.quantity != "activity":
            raise InputError(f"emission is of activity, but the truth is {self.quantity}")
        return recipe

    def _with_files(self, change: Callable[[str, str], str]) -> dict[str, Any]:
        """The recipe's tables, with each file's name changed by ``change(name, what it is)``."""

        def changed(value: Any, what: str) -> Any:
            if isinstance(value, str):
                return change(value, what)
            return {**value, "one_of": [changed(option, what) for option in value["one_of"]]}

        values = copy.deepcopy(self.values)
        for key in ("file", "columns"):
            if key in values["system"]:
                values["system"][key] = change(values["system"][key], "copy")
        for entry, checked in zip(values["phantoms"], self.phantoms, strict=True):
            for key in ("file", "mu_file"):
                if key in entry:
                    quantity = "mu" if key == "mu_file" else self.quantity
                    what = "copy" if is_text(entry[key]) else _what(quantity, checked["energy"])
                    entry[key] = changed(entry[key], what)
        for name, model in self.models.items():
            if (files := model["attenuation.file"]) is not None:
                found = [change(file, _what("mu", model["attenuation.energy"])) for file in files]
                values["models"][name]["attenuation"] = found if len(found) > 1 else found[0]
            if isinstance(file := model["model.efficiency"], str):
                values["models"][name]["efficiency"] = change(file, "copy")
        return values


def _what(quantity: str, energy: Any) -> str:
    """What a volume's file is read as: its quantity, and the energy at which CT numbers become mu."""
    return quantity if energy is None or quantity != "mu" else f"mu at {energy}"


def read_recipe(path: AnyPath, inputs: Mapping[str, Input] | None = None) -> EventRecipe:
    """The recipe of an event set in a TOML file; paths in it are relative to its folder. `InputError` names the entry.

    `inputs` as for `EventRecipe`.
    """
    path = Path(path)
    return EventRecipe(toml_text(path), str(path), path.absolute().parent, inputs or {})
