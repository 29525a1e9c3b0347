"""Recipes of event sets: TOML that says which phantoms, volumes, models and projections the events have."""

import copy
import hashlib
import json
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError, naming
from ..geometry.grid import Grid
from ..runs.recipe import Recipe
from ..toml import parse_toml, toml_text
from ..validation import lengths, one_of, real_array, seed_number, whole_number, whole_shape
from .draws import check_number, check_odds, options
from .entries import PhantomEntry, phantom_entry, plain_name, share, table, unknown
from .inputs import Input, original_input

VERSION = 1
"""Of the recipes' language."""
TRUTH_STORES = ("float32", "float16", "sparse")
IMAGE_STORES = ("float32", "float16")
QUANTITIES = ("activity", "mu")
_TAKEN = (
    *("truth", "truth_affine", "affine", "pose", "placement", "position", "euler_degrees", "module_gain", "number"),
    *("level", "record", "json"),
)
"""What else exports and batches of an event hold, besides the images of models."""

_TABLES = (
    *("version", "seed", "system", "detector", "truth", "phantoms", "models", "radon", "augmentation", "noise"),
    "storage",
)
_KNOWN = (*_TABLES, "splits")


@dataclass(frozen=True)
class Radon:
    """Parallel projections of the truth: `counts` of angles over `degrees`, images of `shape` pixels of `pitch` mm."""

    counts: tuple[int, ...]
    degrees: float
    shape: tuple[int, int]  # (n_v, n_u)
    pitch: tuple[float, float]  # mm along u, v


@dataclass(frozen=True)
class Augmentation:
    """What is changed besides the phantom's settings and pose."""

    mirror: float = 0.0  # chance that the phantom is mirrored (its x axis reversed)
    size: Any = 1.0  # draw of a factor of the phantom's lengths
    activity: Any = 1.0  # draw of a factor of all values
    module_gain: float = 0.0  # relative standard deviation of the modules' sensitivities


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
        To which the paths in it are relative.
    inputs
        Instead of the files that it names: copies of them, by the names in the recipe, as a set keeps them.
    """

    text: str
    name: str = "recipe"
    folder: Path = field(default_factory=Path)
    inputs: Mapping[str, Input] = field(default_factory=dict)

    def __post_init__(self) -> None:
        with naming(self.name):
            values = self.values
            if "version" not in values:
                raise InputError(f"version: missing; this mphDRR reads version = {VERSION}")
            if values["version"] != VERSION or isinstance(values["version"], bool):
                raise InputError(f"version: expected {VERSION}, got {values['version']!r}; a newer mphDRR may read it")
            unknown(values, _KNOWN, "")
            _ = self.seed, self.system, self.grid, self.quantity, self.phantoms, self.models, self.radon
            _ = self.augmentation, self.levels, self.splits, self.truth_store, self.image_store

    @cached_property
    def values(self) -> dict[str, Any]:
        """The tables of the recipe."""
        return parse_toml(self.text, self.name)

    @cached_property
    def seed(self) -> int:
        """Of all random numbers."""
        return seed_number(self.values.get("seed", 0))

    @cached_property
    def system(self) -> Recipe:
        """What [system], [detector] and nothing else say, as a recipe of projections."""
        given: dict[str, Any] = {}
        for name in ("system", "detector"):
            given |= {f"{name}.{key}": value for key, value in table(self.values, name).items()}
        if "system.file" not in given:
            raise InputError("system.file: missing; name the geometry workbook")
        return Recipe(given)

    @cached_property
    def quantity(self) -> str:
        """Of the truth: "activity" or "mu"."""
        quantity: str = self._truth.get("quantity", "activity")
        one_of(quantity, QUANTITIES, "truth.quantity")
        return quantity

    @cached_property
    def grid(self) -> Grid:
        """Of the truth."""
        if "spacing" not in self._truth:
            raise InputError("truth.spacing: missing; give the voxel size in mm")
        voxels = self._truth.get("voxels", 256)
        if isinstance(voxels, bool):
            raise InputError(f"truth.voxels: expected 3 whole numbers of at least 1, got {voxels}")
        shape = whole_shape([voxels] * 3 if isinstance(voxels, int) else voxels, "truth.voxels", 3)
        spacing = lengths(self._truth["spacing"], "truth.spacing", 3)
        return Grid.centered(shape, spacing, real_array(self._truth.get("center", [0.0] * 3), "truth.center", (3,)))

    @cached_property
    def truth_store(self) -> str:
        """How the truth is stored: one of `TRUTH_STORES`."""
        store: str = self._truth.get("store", "float32")
        one_of(store, TRUTH_STORES, "truth.store")
        if "below" in self._truth and store != "sparse":
            raise InputError('truth.below: it goes with store = "sparse" only')
        return store

    @cached_property
    def truth_below(self) -> float:
        """Of a sparse truth: the share of its maximum below which values are taken for 0."""
        return share(self._truth.get("below", 0.0), "truth.below")

    @cached_property
    def image_store(self) -> str:
        """How images are stored: one of `IMAGE_STORES`."""
        storage = table(self.values, "storage", "images")
        store: str = storage.get("images", "float32")
        one_of(store, IMAGE_STORES, "storage.images")
        return store

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
        check_odds([entry.odds for entry in found], len(found), "phantoms: odds")
        for entry in found:
            if entry.split is not None and self.splits and entry.split not in self.splits:
                raise InputError(f"phantoms: {entry.name}: split: expected one of {', '.join(self.splits)}")
        return found

    @cached_property
    def models(self) -> dict[str, Recipe]:
        """The models by name, each as a recipe of projections."""
        models = table(self.values, "models")
        found = {}
        for name, entries in models.items():
            with naming(f"models.{name}"):
                if not isinstance(entries, dict):
                    raise InputError(f"expected a table [models.{name}]")
                plain_name(name, "model")
                if name in _TAKEN or name.startswith("radon"):
                    raise InputError(f"other arrays are called so: expected a name but {', '.join(_TAKEN)} and radon…")
                found[name] = self._model(dict(entries))
        for entry in self.phantoms if any(model["attenuation.of_phantom"] for model in found.values()) else ():
            if entry.is_volume and entry.mu_file is None:
                raise InputError(f'phantoms: {entry.name}: mu_file: missing, but a model has attenuation = "phantom"')
        if not found and self.radon is None:
            raise InputError("models: expected one [models.NAME] or more, or [radon]")
        return found

    @cached_property
    def radon(self) -> Radon | None:
        """The parallel projections; None for none."""
        if "radon" not in self.values:
            return None
        radon = table(self.values, "radon", "angles", "over_degrees", "rows", "columns", "pitch")
        counts = radon.get("angles")
        counts = counts if isinstance(counts, list) else [counts]
        counts = tuple(whole_number(count, "radon.angles") for count in counts)
        if not counts or len(set(counts)) < len(counts):
            raise InputError(f"radon.angles: expected different numbers of angles, such as [96, 256], got {counts}")
        degrees = float(real_array(radon.get("over_degrees", 180.0), "radon.over_degrees", ()))
        if not 0 < degrees <= 360:
            raise InputError(f"radon.over_degrees: expected above 0 and at most 360, got {degrees:g}")
        n_x, n_y, n_z = self.grid.shape
        rows = whole_number(radon.get("rows", n_z), "radon.rows")
        columns = whole_number(radon.get("columns", max(n_x, n_y)), "radon.columns")
        d_x, d_y, d_z = self.grid.spacing.tolist()
        pitch_u, pitch_v = lengths(radon.get("pitch", [max(d_x, d_y), d_z]), "radon.pitch", 2).tolist()
        return Radon(counts, degrees, (rows, columns), (pitch_u, pitch_v))

    @cached_property
    def augmentation(self) -> Augmentation:
        """What is changed besides the phantom's settings and pose."""
        values = table(self.values, "augmentation", "mirror", "size", "activity", "module_gain")
        for name in ("size", "activity"):
            check_number(values.get(name, 1.0), f"augmentation.{name}")
        if "activity" in values and self.quantity != "activity":
            raise InputError(f"augmentation.activity: the truth is {self.quantity}")
        gain = float(real_array(values.get("module_gain", 0.0), "augmentation.module_gain", ()))
        if not 0 <= gain < 1:
            raise InputError(f"augmentation.module_gain: expected 0 or more and below 1, got {gain:g}")
        mirror = share(values.get("mirror", 0.0), "augmentation.mirror")
        return Augmentation(mirror, values.get("size", 1.0), values.get("activity", 1.0), gain)

    @cached_property
    def levels(self) -> tuple[float, ...]:
        """Shares of the acquisition time at which noise is to be drawn."""
        noise = table(self.values, "noise", "levels")
        levels = real_array(noise.get("levels", [1.0]), "noise.levels", (None,))
        if not len(levels) or np.any(levels <= 0):
            raise InputError("noise.levels: expected shares of the acquisition time above 0, such as [1.0, 0.25]")
        return tuple(levels.tolist())

    @cached_property
    def splits(self) -> dict[str, float]:
        """The shares of the splits by their names, which sum to 1; empty where there are none."""
        splits = table(self.values, "splits")
        if splits:
            check_odds(list(splits.values()), len(splits), "splits")
            for name in splits:
                plain_name(name, "splits")
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

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of what the recipe says and of the contents of all files that it names; comments do not count."""
        values = self._with_files(lambda name, what: f"sha256:{self.input(name).sha256}")
        return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()

    @cached_property
    def _read_inputs(self) -> dict[str, Input]:
        return {}

    @cached_property
    def _truth(self) -> dict[str, Any]:
        return table(self.values, "truth", "voxels", "spacing", "center", "quantity", "store", "below")

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
                    is_text = all(str(name).lower().endswith(".toml") for name in options(entry[key]))
                    quantity = "mu" if key == "mu_file" else self.quantity
                    entry[key] = changed(entry[key], "copy" if is_text else checked.what(quantity))
        for name, model in self.models.items():
            if model["attenuation.file"] is not None:
                energy = model["attenuation.energy"]
                what = "mu" if energy is None else f"mu at {energy}"
                values["models"][name]["attenuation"] = change(model["attenuation.file"], what)
        return values


def read_recipe(path: str | os.PathLike[str], inputs: Mapping[str, Input] | None = None) -> EventRecipe:
    """The recipe of an event set in a TOML file; paths in it are relative to its folder. `InputError` names the entry.

    `inputs` as of `EventRecipe`.
    """
    path = Path(path)
    return EventRecipe(toml_text(path), str(path), path.absolute().parent, inputs or {})
