"""Tables of an event recipe, and its [[phantoms]]: settings, values and draws of each phantom."""

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import InputError, naming
from ..phantoms.kinds import KINDS, PhantomKind
from ..phantoms.settings import setting_names
from ..phantoms.torso import CardiacTorso
from ..recipes.settings import Setting, settings_by_key
from ..recipes.tables import flat_entries, require_name
from ..runs.settings import SETTINGS, phantom_settings
from .draws import DrawnSetting, DrawnValues, possible_values

_NEEDS_FILE = ("file",)
_ROWS = (
    Setting("name", str, None, "Name of the phantom", "its kind"),
    Setting("odds", float, 1.0, "Relative frequency of the phantom", least=0),
    Setting("split", str, None, "Split of all its events", "drawn by the fractions in [splits]"),
    SETTINGS["phantom.kind"].with_key("kind", default=None, needs=("no file",)),
    DrawnSetting("file", str, None, "A phantom's shapes (.toml) or a volume", needs=("no kind",)),
    DrawnSetting("mu_file", str, None, "Attenuation (mu) of a volume, placed as the volume is", needs=_NEEDS_FILE),
    SETTINGS["volume.center"].with_key("center", needs=_NEEDS_FILE),
    SETTINGS["volume.energy"].with_key("energy", needs=_NEEDS_FILE),
    Setting("gates", int, 1, "Phases of the beating torso over which the event is averaged", least=1, needs=("kind",)),
    SETTINGS["phantom.position"].with_key("pose.position", DrawnSetting),
    SETTINGS["phantom.euler_degrees"].with_key("pose.euler_degrees", DrawnSetting),
    Setting("pose.turn", str, None, "Distribution of rotations",
            words={"uniform": ("Uniform", "All rotations are equally likely")}, needs=("no pose.euler_degrees",)),
)  # fmt: skip


@dataclass(frozen=True)
class PhantomEntry(DrawnValues):
    """Phantom that events may draw: values of its settings by key, some of which are draws."""

    settings: Mapping[str, Any] = field(default_factory=dict)
    """Values or draws of the settings of the phantom's kind, by their names in recipes."""

    @functools.cached_property
    def rows(self) -> Mapping[str, Setting]:
        """The settings that this kind of phantom, or a phantom from a file, may have, by key."""
        return _phantom_rows(str(self.given.get("kind")))

    @functools.cached_property
    def kind(self) -> PhantomKind | None:
        """The kind of the phantom; None where it comes from a file."""
        return next((kind for kind in KINDS if kind.name == self.given.get("kind")), None)

    @property
    def name(self) -> str:
        """The name of the phantom in the recipe."""
        return str(self["name"])

    @property
    def is_volume(self) -> bool:
        """Whether the phantom comes from files of volumes, not of shapes (.toml)."""
        return self["file"] is not None and not is_shape_file(self["file"])


def phantom_entry(values: dict[str, Any], number: int, quantity: str) -> PhantomEntry:
    """Return the phantom that a table of [[phantoms]] describes, the `number`-th from 1, for a truth of `quantity`.

    `InputError` names the phantom and the entry that cannot be understood.
    """
    kind = values.get("kind")
    with naming(f"phantoms: {values.get('name', f'phantom {number}' if kind is None else kind)}"):
        if ("kind" in values) == ("file" in values):
            raise InputError('expected either kind = "…" or file = "…"')
        if kind is not None:
            _phantom_rows("")["kind"].checked(kind)
        entries = {"name": f"file-{number}" if kind is None else str(kind), **values}
        settings = {key: value for key, value in values.items() if key not in _phantom_rows("") and key != "pose"}
        entry = PhantomEntry(flat_entries(entries, _phantom_rows(str(kind)), "pose"), settings)
        if not entry.name:
            raise InputError("name: expected a text, got ''")
        if entry["split"] is not None:
            require_name(entry["split"], "split")
        if entry["gates"] > 1 and (entry.kind is None or entry.kind.phantom is not CardiacTorso or "phase" in settings):
            raise InputError('gates: expected kind = "torso" without a phase')
        if kind is None:
            _check_files(entry, quantity)
        return entry


@functools.cache
def _phantom_rows(kind: str) -> Mapping[str, Setting]:
    """Return the settings that a phantom may have, by key: one of a kind, or one from a file where no kind has the name."""
    return settings_by_key([*phantom_settings(kind, DrawnSetting), *_ROWS])


def _check_files(entry: PhantomEntry, quantity: str) -> None:
    """Raise `InputError` where file, mu_file and the settings of volumes contradict each other."""
    files, mu_files = possible_values(entry["file"]), possible_values(entry["mu_file"])
    if "" in (*files, *mu_files):
        raise InputError("file: expected a file's name, got ''")
    if any(len(set(map(is_shape_file, names))) > 1 for names in (files, mu_files)):
        raise InputError("file: expected either volumes or phantoms (.toml), got both: make two [[phantoms]] of them")
    for key in ("mu_file", "center", "energy"):
        if key in entry.given and not entry.is_volume:
            raise InputError(f"{key}: expected only beside volumes, got phantoms (.toml)")
    are_single = [isinstance(entry[key], str) for key in ("file", "mu_file")]
    if "mu_file" in entry.given and (len(mu_files) != len(files) or are_single[0] != are_single[1]):
        raise InputError("mu_file: expected one for each file, in the same order")
    if "energy" in entry.given and quantity != "mu" and "mu_file" not in entry.given:
        raise InputError("energy: converts CT numbers to mu, but the truth is activity and there is no mu_file")


def is_shape_file(file: Any) -> bool:
    """Return whether a file name, or the first of a draw, is that of a phantom's shapes (.toml)."""
    return str(possible_values(file)[0]).lower().endswith(".toml")


def recorded_settings(phantom: Any, kind: PhantomKind) -> dict[str, Any]:
    """Return all settings of a phantom by their names in recipes, with lists instead of tuples, as JSON has them."""
    settings = {key: getattr(phantom, name) for key, name in setting_names(kind.phantom).items()}
    return {key: np.asarray(value).tolist() if isinstance(value, tuple) else value for key, value in settings.items()}
