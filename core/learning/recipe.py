"""Recipes of trainings: from which events which network learns, and how, in TOML."""

import functools
import hashlib
import inspect
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..errors import InputError, naming
from ..files import AnyPath
from ..geometry.grid import Grid
from ..recipes.settings import Setting, default_setting, settings_by_key, table_names, word_labels
from ..recipes.tables import check_entries, require_value, table_entries, table_grid
from ..recipes.toml import parse_toml, toml_text, toml_value
from ..recipes.values import Values
from ..runs.settings import SETTINGS
from ..validation import one_of
from .networks import NETWORKS

VERSION = 1
"""The version of the recipes' language."""
_KIND = "after-osem"
_TEMPLATE = Path(__file__).parent / "templates" / "training.toml"
_ROWS = settings_by_key((
    Setting("data.events", str, None, "Folder of the event set that is learned from", is_path=True),
    Setting("data.model", str, None, "Whose images, by the model's name in the set's recipe", "the only one of counts"),
    Setting("data.train", str, "train", "The split whose events are learned from"),
    Setting("data.validation", str, "validation", "The split whose events tell how well it is learned"),
    Setting("data.levels", float, None, "Shares of the acquisition time, in turn", "those of the set's recipe", above=0,
            sizes=()),
    Setting("data.draws", int, 1, "How often noise is drawn for each event", least=1),
    SETTINGS["reconstruction.voxels"].with_key("grid.voxels", default=(64,), absent=""),
    SETTINGS["reconstruction.spacing"].with_key("grid.spacing", absent=""),
    SETTINGS["reconstruction.center"].with_key("grid.center"),
    Setting("osem.subsets", int, 10, "Of the modules", least=1),
    Setting("osem.after", int, (2, 8, 16), "Iterations of OSEM after which the network is given its volume", least=1,
            sizes=()),
    Setting("network.kind", str, _KIND, "The network's name in `NETWORKS`"),
    Setting("network.permuted", int, None, "Permute the poses among the modules with this seed, to see what they are "
            "worth", least=0),
    Setting("network.weights_from", str, None, "Model file (.pt) whose weights of equal name and shape it begins with",
            "random weights", is_path=True),
    Setting("training.steps", int, 3000, "How many steps", least=1),
    Setting("training.batch", int, 1, "Scans in each step, of all devices together", least=1),
    Setting("training.rate", float, 1.5e-3, "Learning rate, at its largest", above=0, most=1),
    Setting("training.seed", int, 0, "Seed of weights, order and noise", least=0, most=2**31 - 1),
    Setting("training.precision", str, None, "Numbers that the network computes in", "bf16-mixed where the processor "
            "multiplies matrices of it, else 32", words=word_labels(("32", "bf16-mixed", "16-mixed"))),
    Setting("training.threads", int, None, "Processor threads", "all", least=1),
    Setting("training.accelerator", str, "auto", "What it computes on", words=word_labels(("auto", "cpu", "gpu"))),
    Setting("training.devices", int, 1, "GPUs, or processes of a CPU, on each node", least=1),
    Setting("training.nodes", int, 1, "Machines", least=1),
    Setting("training.strategy", str, "auto", "How devices share the work, by Lightning's name for it, such as ddp"),
))  # fmt: skip
TABLES = table_names(_ROWS)


@functools.cache
def network_settings(kind: str) -> Mapping[str, Setting]:
    """A network's own settings: the arguments of its class, but those that follow from a setup, which only have names.

    `InputError` where torch or MONAI is missing.
    """
    network, found, text = NETWORKS[kind].load(), [], f"Of {NETWORKS[kind].label}"
    for name, argument in inspect.signature(network).parameters.items():
        if argument.kind is argument.KEYWORD_ONLY:
            continue
        row = default_setting(f"network.{name}", argument.default, text)
        found.append(replace(row, least=int(name not in network.may_be_0)) if row.kind is int else row)
    return settings_by_key(found)


@dataclass(frozen=True)
class TrainingRecipe(Values):
    """What a network is trained on, and how: values of settings by their keys, such as "training.batch".

    Made by `read_recipe`, or `parsed`; `InputError` names the entry that cannot be understood.
    """

    text: str = ""
    folder: Path = field(default_factory=Path)

    def __post_init__(self) -> None:
        one_of(_ROWS["network.kind"].checked(self.given.get("network.kind", _KIND)), NETWORKS, "network.kind")
        super().__post_init__()
        require_value(self["data.events"], "data.events", "name the folder of an event set")
        _ = self.grid
        if list(self["osem.after"]) != sorted(set(self["osem.after"])):
            raise InputError(f"osem.after: expected rising numbers, got {list(self['osem.after'])}")
        if self["training.batch"] % self.processes:
            batch = self["training.batch"]
            raise InputError(f"training.batch: expected a multiple of the {self.processes} processes, got {batch}")

    @property
    def rows(self) -> Mapping[str, Setting]:
        """The settings that there are, with those of the network."""
        return {**_ROWS, **network_settings(self.given.get("network.kind", _KIND))}

    @property
    def processes(self) -> int:
        """Devices of all nodes."""
        return int(self["training.devices"] * self["training.nodes"])

    @functools.cached_property
    def grid(self) -> Grid:
        """The voxels of the network's volumes."""
        return table_grid(self, "grid")

    @property
    def network(self) -> dict[str, Any]:
        """The arguments of the network's class that are given."""
        own = network_settings(self["network.kind"])
        return {key.partition(".")[2]: value for key, value in self.given.items() if key in own}

    def path(self, key: str) -> Path:
        """A file or folder that the recipe names."""
        return Path(os.path.normpath(self.folder / self[key]))

    @functools.cached_property
    def fingerprint(self) -> str:
        """SHA-256 of all that decides over the weights; comments and the number of threads do not count."""
        told = {key: value for key, value in self.given.items() if key != "training.threads"}
        return hashlib.sha256(repr(sorted(told.items())).encode()).hexdigest()


def parsed(text: str, name: str = "recipe", folder: Path | None = None) -> TrainingRecipe:
    """The recipe in a text in TOML; messages call it `name`, and its paths are relative to `folder`."""
    with naming(name):
        values = parse_toml(text, name)
        check_entries(values, VERSION, ("version", *TABLES))
        return TrainingRecipe(table_entries(values, _ROWS), text, folder or Path())


def read_recipe(path: AnyPath) -> TrainingRecipe:
    """The recipe of a training in a TOML file; paths in it are relative to its folder. `InputError` names the entry."""
    return parsed(toml_text(path), str(path), Path(path).absolute().parent)


def template_text(network: str = _KIND) -> str:
    """A commented recipe (TOML) to begin with, of a network in `NETWORKS`; `InputError` for another name."""
    one_of(network, NETWORKS, "network")
    text = _TEMPLATE.read_text(encoding="utf-8")
    return text.replace(f"\nkind = {toml_value(_KIND)}\n", f"\nkind = {toml_value(network)}\n", 1)
