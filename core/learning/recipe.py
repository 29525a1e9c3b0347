"""Training recipes: event set, network and training settings, in TOML."""

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
from ..recipes.settings import (
    LibraryAlgorithm,
    Setting,
    choice_setting,
    default_setting,
    settings_by_key,
    table_names,
    word_labels,
)
from ..recipes.tables import check_entries, require_value, table_entries
from ..recipes.toml import parse_toml, toml_text, toml_value
from ..recipes.values import Values
from ..runs.settings import SETTINGS
from ..validation import one_of
from .networks import NETWORKS

VERSION = 1
"""Version of the recipes' language."""
_KIND = "after-osem"
_TEMPLATE = Path(__file__).parent / "templates" / "training.toml"
OPTIMIZERS: Mapping[str, LibraryAlgorithm] = {
    "adamw": LibraryAlgorithm("AdamW", "Adam with decoupled weight decay", "AdamW", {"weight_decay": 1e-3}),
}
"""Optimisers of `torch.optim` by their names in recipes; a second row makes the choice a setting, ``training.optimizer``."""
_ROWS = settings_by_key((
    Setting("data.events", str, None, "Folder of the event set to learn from", is_path=True),
    Setting("data.model", str, None, "Model of the set's recipe whose images are used", "the only one of counts"),
    Setting("data.train", str, "train", "Split of the set whose events are used for training"),
    Setting("data.validation", str, "validation", "Split of the set whose events are used for validation"),
    Setting("data.levels", float, None, "Shares of the acquisition time, in turn", "those of the set's recipe", above=0,
            sizes=()),
    Setting("data.draws", int, 1, "Number of noise draws per event", least=1),
    SETTINGS["reconstruction.voxels"].with_key("grid.voxels", default=(64,), absent=""),
    SETTINGS["reconstruction.spacing"].with_key("grid.spacing", absent=""),
    SETTINGS["reconstruction.center"].with_key("grid.center"),
    Setting("osem.subsets", int, 10, "Number of OSEM subsets", least=1),
    Setting("osem.after", int, (2, 8, 16), "Iterations of OSEM whose volumes the network gets", least=1,
            sizes=()),
    Setting("network.kind", str, _KIND, "The network's name in `NETWORKS`"),
    Setting("network.permuted", int, None, "Permute the poses among the modules with this seed, to see what they are "
            "worth", least=0),
    Setting("network.weights_from", str, None, "Model file (.pt) whose weights of equal name and shape are loaded first",
            "random weights", is_path=True),
    Setting("training.steps", int, 3000, "Number of steps", least=1),
    Setting("training.batch", int, 1, "Scans in each step, on all devices together", least=1),
    Setting("training.rate", float, 1.5e-3, "Largest learning rate", above=0, most=1),
    *choice_setting("training.optimizer", OPTIMIZERS, "Optimiser of the weights"),
    Setting("training.seed", int, 0, "Seed of weights, order and noise", least=0, most=2**31 - 1),
    Setting("training.precision", str, None, "Precision of the network's computing", "bf16-mixed where the processor "
            "multiplies such matrices, else 32", words=word_labels(("32", "bf16-mixed", "16-mixed"))),
    Setting("training.threads", int, None, "Processor threads", "all", least=1),
    Setting("training.accelerator", str, "auto", "Device that computes", words=word_labels(("auto", "cpu", "gpu"))),
    Setting("training.devices", int, 1, "GPUs, or CPU processes, on each node", least=1),
    Setting("training.nodes", int, 1, "Machines", least=1),
    Setting("training.strategy", str, "auto", "Lightning's name of how devices share the work, such as ddp"),
))  # fmt: skip
TABLES = table_names(_ROWS)


@functools.cache
def network_settings(kind: str) -> Mapping[str, Setting]:
    """Return the settings of a network by key: the positional arguments of its class.

    Keyword-only arguments are no settings: `Network.fixed` derives them from the scanner's setup. Raises `InputError` if
    torch or MONAI is missing.
    """
    network, settings, text = NETWORKS[kind].load(), [], f"Setting of the network {NETWORKS[kind].label}"
    for name, argument in inspect.signature(network).parameters.items():
        if argument.kind is argument.KEYWORD_ONLY:
            continue
        row = default_setting(f"network.{name}", argument.default, text)
        settings.append(replace(row, least=int(name not in network.may_be_0)) if row.kind is int else row)
    return settings_by_key(settings)


@dataclass(frozen=True)
class TrainingRecipe(Values):
    """Recipe of a training: values of settings by their keys, such as "training.batch".

    Create it with `read_recipe` or `parse_recipe`; `InputError` names the entry that cannot be understood.
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
        """All settings, those of the network included."""
        return {**_ROWS, **network_settings(self.given.get("network.kind", _KIND))}

    @property
    def processes(self) -> int:
        """Number of devices of all nodes."""
        return int(self["training.devices"] * self["training.nodes"])

    @functools.cached_property
    def grid(self) -> Grid:
        """Voxels of the network's volumes."""
        return self.table_grid("grid")

    @property
    def network(self) -> dict[str, Any]:
        """Explicitly set arguments of the network's class."""
        settings = network_settings(self["network.kind"])
        return {key.partition(".")[2]: value for key, value in self.given.items() if key in settings}

    def path(self, key: str) -> Path:
        """Return the path of a file or folder that the recipe names under `key`."""
        return Path(os.path.normpath(self.folder / self[key]))

    @functools.cached_property
    def fingerprint(self) -> str:
        """SHA-256 of all settings that determine the weights, without comments and the number of threads."""
        settings = {key: value for key, value in self.given.items() if key != "training.threads"}
        return hashlib.sha256(repr(sorted(settings.items())).encode()).hexdigest()


def parse_recipe(text: str, name: str = "recipe", folder: Path | None = None) -> TrainingRecipe:
    """Parse the recipe of a training in TOML; messages call it `name`, and its paths are relative to `folder`."""
    with naming(name):
        values = parse_toml(text, name)
        check_entries(values, VERSION, ("version", *TABLES))
        return TrainingRecipe(table_entries(values, _ROWS), text, folder or Path())


def read_recipe(path: AnyPath) -> TrainingRecipe:
    """Read the recipe of a training from a TOML file; its paths are relative to the file's folder.

    Raises `InputError`, which names the entry that cannot be understood.
    """
    return parse_recipe(toml_text(path), str(path), Path(path).absolute().parent)


def template_text(network: str = _KIND) -> str:
    """Return a commented recipe (TOML) for a network in `NETWORKS` as a start; raise `InputError` for another name."""
    one_of(network, NETWORKS, "network")
    text = _TEMPLATE.read_text(encoding="utf-8")
    return text.replace(f"\nkind = {toml_value(_KIND)}\n", f"\nkind = {toml_value(network)}\n", 1)
