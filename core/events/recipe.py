"""Recipes of event sets in TOML: phantoms, volumes, models, projections, noise and storage of the events."""

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
from .draws import DrawnSetting, DrawnValues, check_odds
from .entries import PhantomEntry, is_shape_file, phantom_entry
from .inputs import Input, original_input

VERSION = 1
"""Version of the recipe language, which every recipe names."""
_RESERVED = (
    *("truth", "truth_affine", "affine", "pose", "placement", "position", "euler_degrees", "module_gain", "number"),
    *("level", "record", "json"),
)
"""Names of the other arrays and entries in exports and training batches, which no model may have."""

_ROWS = settings_by_key((
    SETTINGS["phantom.voxels"].with_key("truth.voxels"),
    SETTINGS["phantom.spacing"].with_key("truth.spacing"),
    SETTINGS["phantom.position"].with_key("truth.center", text="Centre of the truth, x y z"),
    Setting("truth.quantity", str, "activity", "Quantity of the truth", words=word_labels(("activity", "mu"))),
    Setting("truth.store", str, "float32", "How the truth is stored, sparse without voxels that are 0",
            words=word_labels(("float32", "float16", "sparse"))),
    Setting("truth.below", float, 0.0, "Fraction of the truth's maximum below which values are stored as 0",
            least=0, most=1, needs=("truth.store=sparse",)),
    Setting("radon.angles", int, None, "Numbers of angles, one for each set of parallel projections", least=1, sizes=()),
    Setting("radon.over_degrees", float, 180.0, "Range that the angles cover", unit="degrees", above=0, most=360),
    Setting("radon.rows", int, None, "Pixel rows", "one for each of the truth's voxels along z", least=1),
    Setting("radon.columns", int, None, "Pixel columns", "one for each of the truth's voxels along x or y", least=1),
    SETTINGS["phantom.spacing"].with_key("radon.pitch", text="Pixel size, one or along u and v", absent="the voxels'",
                                         sizes=(1, 2)),
    Setting("augmentation.mirror", float, 0.0, "Probability of mirroring the phantom along its x axis", least=0, most=1),
    DrawnSetting("augmentation.size", float, 1.0, "Factor of the phantom's lengths", above=0),
    DrawnSetting("augmentation.activity", float, 1.0, "Factor of all values", above=0, needs=("truth.quantity=activity",)),
    Setting("augmentation.module_gain", float, 0.0, "Relative standard deviation of the modules' sensitivities", least=0,
            most=math.nextafter(1, 0)),
    Setting("noise.levels", float, (1.0,), "Fractions of the acquisition time at which noise is drawn", above=0, sizes=()),
    *choice_setting("noise.model", NOISE_MODELS, "How counts vary around their means"),
    Setting("storage.images", str, "float32", "How images are stored", words=word_labels(("float32", "float16"))),
))  # fmt: skip
_SEED = SETTINGS["noise.seed"].with_key("seed", default=0, text="Seed of all random numbers")
_TABLES = table_names(_ROWS)
_ENTRIES = ("version", "seed", "system", "detector", "phantoms", "models", "splits", *_TABLES)


@dataclass(frozen=True)
class _Settings(DrawnValues):
    """Values of the tables `_TABLES` of an event recipe, some of which may be draws."""

    rows = _ROWS  # type: ignore[assignment]


@dataclass(frozen=True)
class Radon:
    """Parallel projections of the truth, as the table [radon] of a recipe describes them."""

    counts: tuple[int, ...]
    """Numbers of angles N, one for each set of projections."""
    degrees: float
    """Range of angles that each set covers, degrees: angle i is i / N of it."""
    shape: tuple[int, int]
    """Pixels (n_v, n_u) of an image."""
    pitch: tuple[float, float]
    """Pixel pitch along u and along v, mm."""


@dataclass(frozen=True)
class EventRecipe:
    """Recipe of an event set, from which its events are made; `InputError` names an entry that cannot be understood.

    Parameters
    ----------
    text
        The recipe as TOML.
    name
        Name of the recipe in messages, such as its path.
    folder
        Folder to which the paths in the recipe are relative.
    inputs
        A set's copies of the files that the recipe names, by these names. They are read instead of the originals.
    """

    text: str
    name: str = "recipe"
    folder: Path = field(default_factory=Path)
    inputs: Mapping[str, Input] = field(default_factory=dict)
    _read_inputs: dict[str, Input] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        with naming(self.name):
            values = self.values
            check_entries(values, VERSION, _ENTRIES)
            _ = self.seed, self.settings, self.system, self.grid, self.phantoms, self.models, self.radon, self.splits

    def __getitem__(self, key: str) -> Any:
        """Return the value of a setting, such as "truth.store", or its default."""
        return self.settings[key]

    @cached_property
    def values(self) -> dict[str, Any]:
        """The entries and tables of the recipe, as TOML holds them."""
        return parse_toml(self.text, self.name)

    @cached_property
    def settings(self) -> DrawnValues:
        """The values of the settings in the tables `_TABLES`."""
        return _Settings(table_entries(self.values, _ROWS))

    @cached_property
    def seed(self) -> int:
        """The seed of all random numbers of the set."""
        return int(_SEED.checked(self.values.get("seed", _SEED.default)))

    @cached_property
    def system(self) -> Recipe:
        """The tables [system] and [detector] as a recipe of projection runs."""
        tables = {name: read_table(self.values, name) for name in ("system", "detector")}
        recipe = Recipe(flat_entries(tables, {}, *tables))
        require_value(recipe["system.file"], "system.file", "name the geometry workbook")
        return recipe

    @property
    def quantity(self) -> str:
        """The quantity of the truth: "activity" or "mu"."""
        return str(self["truth.quantity"])

    @cached_property
    def grid(self) -> Grid:
        """The voxel grid of the truth."""
        return self.settings.table_grid("truth")

    @cached_property
    def phantoms(self) -> tuple[PhantomEntry, ...]:
        """The phantoms of which each event draws one: the entries of [[phantoms]]."""
        entries = self.values.get("phantoms")
        if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
            raise InputError("phantoms: expected one [[phantoms]] or more")
        phantoms = tuple(phantom_entry(entry, number, self.quantity) for number, entry in enumerate(entries, 1))
        names = [entry.name for entry in phantoms]
        for name in names:
            if names.count(name) > 1:
                raise InputError(f"phantoms: {names.count(name)} are called {name!r}: give each a name of its own")
        check_odds([entry["odds"] for entry in phantoms], len(phantoms), "phantoms: odds")
        for entry in phantoms:
            if entry["split"] is not None and self.splits and entry["split"] not in self.splits:
                raise InputError(f"phantoms: {entry.name}: split: expected one of {', '.join(self.splits)}")
        return phantoms

    @cached_property
    def models(self) -> dict[str, Recipe]:
        """The image models by name, each as a recipe of projection runs."""
        tables = read_table(self.values, "models")
        models = {}
        for name, entries in tables.items():
            with naming(f"models.{name}"):
                if not isinstance(entries, dict):
                    raise InputError(f"expected a table [models.{name}]")
                require_name(name, "model")
                if name in _RESERVED or name.startswith("radon"):
                    raise InputError(f"a reserved name: expected another than {', '.join(_RESERVED)} or radon…")
                models[name] = self._model_recipe(dict(entries))
        for entry in self.phantoms if any(model["attenuation.of_phantom"] for model in models.values()) else ():
            if entry.is_volume and entry["mu_file"] is None:
                raise InputError(f'phantoms: {entry.name}: mu_file: missing, but a model has attenuation = "phantom"')
        if not models and self.radon is None:
            raise InputError("models: expected one [models.NAME] or more, or [radon]")
        return models

    @cached_property
    def radon(self) -> Radon | None:
        """The parallel projections of the truth; None without a table [radon]."""
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
        """The fractions of the acquisition time at which training draws noise."""
        return tuple(self["noise.levels"])

    @cached_property
    def splits(self) -> dict[str, float]:
        """The fractions of the events in each split, by name, which sum to 1; empty without a table [splits]."""
        if splits := read_table(self.values, "splits"):
            check_odds(list(splits.values()), len(splits), "splits")
            for name in splits:
                require_name(name, "splits")
        total = math.fsum(splits.values())
        if splits and abs(total - 1) > 1e-6 and not self.inputs:  # a set begun by an earlier version keeps its recipe
            raise InputError(f"splits: expected shares that sum to 1, got {total:.9g}")
        return {name: value / total for name, value in splits.items()}

    @cached_property
    def files(self) -> dict[str, str]:
        """The files that the recipe names, by name, with the way to read each: see `Input.content`."""
        files: dict[str, str] = {}
        self._replace_file_names(lambda name, content: files.setdefault(name, content) and name)
        return files

    def input(self, name: str) -> Input:
        """Return a file that the recipe names: the set's copy, or else the original; `InputError` where both are missing."""
        inputs = self._read_inputs
        if name not in inputs:
            with naming(self.name):
                inputs[name] = self.inputs.get(name) or original_input(name, self.folder, self.files[name])
        return inputs[name]

    def placed(self, model: Recipe) -> Recipe:
        """Return a model's recipe with the path of its efficiency file, which is the set's copy where there is one."""
        file = model["model.efficiency"]
        return model.updated({"model.efficiency": str(self.input(file).path)}) if isinstance(file, str) else model

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of the recipe's values and of the contents of all files that it names, without comments."""
        values = self._replace_file_names(lambda name, content: f"sha256:{self.input(name).sha256}")
        return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()

    def _model_recipe(self, entries: dict[str, Any]) -> Recipe:
        """Return the recipe of projection runs of one table [models.NAME]; `InputError` where it does not fit the truth."""
        attenuation, energy = entries.pop("attenuation", None), entries.pop("attenuation_energy", None)
        scatter = entries.pop("scatter", {})
        if not isinstance(scatter, dict):
            raise InputError(f'scatter: expected scatter.model = "body", got scatter = {scatter!r}')
        values = dict(self.system.given) | {f"model.{key}": value for key, value in entries.items()}
        values |= {f"scatter.{key}": value for key, value in scatter.items()}
        if attenuation == "phantom":
            values["attenuation.of_phantom"] = True
        elif attenuation is not None:
            values["attenuation.file"] = attenuation
        if energy is not None:
            values["attenuation.energy"] = energy
        recipe = Recipe(values)
        if recipe["model.photons"] is not None and self.quantity != "mu":
            raise InputError('photons: expected a truth of attenuation ([truth] quantity = "mu"), got one of activity')
        if recipe["model.kind"] == "spectral":
            raise InputError("spectral: event sets have X rays of one energy; expected transmission, with photons")
        if recipe["model.kind"] == "emission" and self.quantity != "activity":
            raise InputError(f"emission: expected a truth of activity, got {self.quantity}")
        return recipe

    def _replace_file_names(self, replace: Callable[[str, str], str]) -> dict[str, Any]:
        """Return the recipe's tables with every file name replaced by ``replace(name, content)``; see `Input.content`."""

        def replaced(value: Any, content: str) -> Any:
            """Return a file's name, or a draw of `one_of` several names, with every name replaced."""
            if isinstance(value, str):
                return replace(value, content)
            return {**value, "one_of": [replaced(option, content) for option in value["one_of"]]}

        values = copy.deepcopy(self.values)
        for key in ("file", "columns"):
            if key in values["system"]:
                values["system"][key] = replace(values["system"][key], "copy")
        for entry, phantom in zip(values["phantoms"], self.phantoms, strict=True):
            for key in ("file", "mu_file"):
                if key in entry:
                    quantity = "mu" if key == "mu_file" else self.quantity
                    content = "copy" if is_shape_file(entry[key]) else _volume_content(quantity, phantom["energy"])
                    entry[key] = replaced(entry[key], content)
        for name, model in self.models.items():
            if (files := model["attenuation.file"]) is not None:
                names = [replace(file, _volume_content("mu", model["attenuation.energy"])) for file in files]
                values["models"][name]["attenuation"] = names if len(names) > 1 else names[0]
            if isinstance(file := model["model.efficiency"], str):
                values["models"][name]["efficiency"] = replace(file, "copy")
        return values


def _volume_content(quantity: str, energy: Any) -> str:
    """Return how a volume's file is read: its quantity, with the energy, keV, at which CT numbers become mu."""
    return quantity if energy is None or quantity != "mu" else f"mu at {energy}"


def read_recipe(path: AnyPath, inputs: Mapping[str, Input] | None = None) -> EventRecipe:
    """Read the recipe of an event set from a TOML file.

    Paths in the recipe are relative to the file's folder. `inputs` are a set's copies of the files that the recipe names
    (see `EventRecipe`). `InputError` names an entry that cannot be understood.
    """
    path = Path(path)
    return EventRecipe(toml_text(path), str(path), path.absolute().parent, inputs or {})
