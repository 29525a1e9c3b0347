"""The phantoms of an event recipe: their settings, values and draws."""

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import InputError, naming
from ..phantoms.kinds import KINDS, Kind
from ..phantoms.settings import setting_names
from ..phantoms.torso import CardiacTorso
from ..recipes.settings import Setting, settings_by_key
from ..recipes.tables import flat_entries, require_name
from ..runs.settings import SETTINGS, phantom_settings
from .draws import Drawn, DrawnValues, options

_OF_FILE = ("file",)
_ROWS = (
    Setting("name", str, None, "What the phantom is called", "its kind"),
    Setting("odds", float, 1.0, "How often it comes, beside the others", least=0),
    Setting("split", str, None, "The split of all its events", "one by the shares of the splits"),
    SETTINGS["phantom.kind"].with_key("kind", default=None, needs=("no file",)),
    Drawn("file", str, None, "A phantom's shapes (.toml) or a volume", needs=("no kind",)),
    Drawn("mu_file", str, None, "What attenuates a volume, which is placed with it", needs=_OF_FILE),
    SETTINGS["volume.center"].with_key("center", needs=_OF_FILE),
    SETTINGS["volume.energy"].with_key("energy", needs=_OF_FILE),
    Setting("gates", int, 1, "Phases of the beating torso, whose mean the event is", least=1, needs=("kind",)),
    SETTINGS["phantom.position"].with_key("pose.position", Drawn),
    SETTINGS["phantom.euler_degrees"].with_key("pose.euler_degrees", Drawn),
    Setting("pose.turn", str, None, "How it is turned", words={"uniform": ("Uniform", "Every rotation is as likely")},
            needs=("no pose.euler_degrees",)),
)  # fmt: skip


@dataclass(frozen=True)
class PhantomEntry(DrawnValues):
    """One of the phantoms that an event may have: its values and draws, by the keys of their settings."""

    settings: Mapping[str, Any] = field(default_factory=dict)  # of its kind, as the recipe says them

    @functools.cached_property
    def rows(self) -> Mapping[str, Setting]:
        """The settings that it may have."""
        return _rows(str(self.given.get("kind")))

    @functools.cached_property
    def kind(self) -> Kind | None:
        """None where the phantom is a file."""
        return next((kind for kind in KINDS if kind.name == self.given.get("kind")), None)

    @property
    def name(self) -> str:
        """What the recipe calls it."""
        return str(self["name"])

    @property
    def is_volume(self) -> bool:
        """Whether the files are volumes."""
        return self["file"] is not None and not is_text(self["file"])


def phantom_entry(values: dict[str, Any], number: int, quantity: str) -> PhantomEntry:
    """One table of [[phantoms]]; `InputError` names phantom and entry."""
    kind = values.get("kind")
    with naming(f"phantoms: {values.get('name', f'phantom {number}' if kind is None else kind)}"):
        if ("kind" in values) == ("file" in values):
            raise InputError('expected either kind = "…" or file = "…"')
        if kind is not None:
            _rows("")["kind"].checked(kind)
        named = {"name": f"file-{number}" if kind is None else str(kind), **values}
        own = {key: value for key, value in values.items() if key not in _rows("") and key != "pose"}
        entry = PhantomEntry(flat_entries(named, _rows(str(kind)), "pose"), own)
        if not entry.name:
            raise InputError("name: expected a text, got ''")
        if entry["split"] is not None:
            require_name(entry["split"], "split")
        if entry["gates"] > 1 and (entry.kind is None or entry.kind.phantom is not CardiacTorso or "phase" in own):
            raise InputError('gates: they are of kind = "torso" without a phase of its own')
        if kind is None:
            _check_files(entry, quantity)
        return entry


@functools.cache
def _rows(kind: str) -> Mapping[str, Setting]:
    """The settings of a phantom of a kind, or of a file."""
    return settings_by_key([*phantom_settings(kind, Drawn), *_ROWS])


def _check_files(entry: PhantomEntry, quantity: str) -> None:
    """Raise `InputError` where the files of a phantom do not go together."""
    files, others = options(entry["file"]), options(entry["mu_file"])
    if "" in (*files, *others):
        raise InputError("file: expected a file's name, got ''")
    if any(len(set(map(is_text, names))) > 1 for names in (files, others)):
        raise InputError("file: volumes and phantoms (.toml) do not go together: make two [[phantoms]] of them")
    for key in ("mu_file", "center", "energy"):
        if key in entry.given and not entry.is_volume:
            raise InputError(f"{key}: it goes with volumes, not with phantoms (.toml)")
    is_one = [isinstance(entry[key], str) for key in ("file", "mu_file")]
    if "mu_file" in entry.given and (len(others) != len(files) or is_one[0] != is_one[1]):
        raise InputError("mu_file: expected one for each file, in the same order")
    if "energy" in entry.given and quantity != "mu" and "mu_file" not in entry.given:
        raise InputError("energy: it converts CT numbers to mu, but the truth is activity and there is no mu_file")


def is_text(file: Any) -> bool:
    """Whether a file, or the first that may be drawn, is a phantom's description."""
    return str(options(file)[0]).lower().endswith(".toml")


def as_settings(phantom: Any, kind: Kind) -> dict[str, Any]:
    """All settings of a phantom by their names in recipes, as JSON holds them."""
    found = {key: getattr(phantom, name) for key, name in setting_names(kind.phantom).items()}
    return {key: np.asarray(value).tolist() if isinstance(value, tuple) else value for key, value in found.items()}
