"""Tables of an event recipe, and its [[phantoms]]: settings, values and draws of each phantom."""

import functools
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import InputError, naming
from ..geometry.grid import Grid
from ..phantoms.kinds import KINDS, PhantomKind
from ..phantoms.settings import setting_names
from ..phantoms.torso import CardiacTorso
from ..runs.settings import SETTINGS, Setting, own_settings
from .draws import DrawnSetting, DrawnValues, possible_values


def like(key: str, source_key: str, row: type[Setting] = Setting, **changes: Any) -> Setting:
    """Return a setting of recipes like the one of projection runs called `source_key`, with another key and `changes`."""
    return row(**{**vars(SETTINGS[source_key]), "key": key, "needs": (), **changes})


_NEEDS_FILE = ("file",)
_ROWS = (
    Setting("name", str, None, "Name of the phantom", "its kind"),
    Setting("odds", float, 1.0, "Relative frequency of the phantom", least=0),
    Setting("split", str, None, "Split of all its events", "drawn by the fractions in [splits]"),
    like("kind", "phantom.kind", default=None, needs=("no file",)),
    DrawnSetting("file", str, None, "A phantom's shapes (.toml) or a volume", needs=("no kind",)),
    DrawnSetting("mu_file", str, None, "Attenuation (mu) of a volume, placed as the volume is", needs=_NEEDS_FILE),
    like("center", "volume.center", needs=_NEEDS_FILE),
    like("energy", "volume.energy", needs=_NEEDS_FILE),
    Setting("gates", int, 1, "Phases of the beating torso over which the event is averaged", least=1, needs=("kind",)),
    like("pose.position", "phantom.position", DrawnSetting),
    like("pose.euler_degrees", "phantom.euler_degrees", DrawnSetting),
    Setting("pose.turn", str, None, "Distribution of rotations",
            words={"uniform": ("Uniform", "All rotations are equally likely")}, needs=("no pose.euler_degrees",)),
)  # fmt: skip


def by_key(rows: Iterable[Setting]) -> dict[str, Setting]:
    """Return a dictionary of settings by key."""
    return {row.key: row for row in rows}


def table(values: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return a table of a recipe, empty where the recipe has none; `InputError` where the entry is not a table."""
    entries = values.get(name, {})
    if not isinstance(entries, dict):
        raise InputError(f"{name}: expected a table [{name}]")
    return entries


def flat(values: Mapping[str, Any], rows: Mapping[str, Setting], *tables: str) -> dict[str, Any]:
    """Return the values of a recipe by setting key: "name" outside, "table.name" within the given tables."""
    entries = {key: value for key, value in values.items() if key not in tables}
    for name in tables:
        entries |= {f"{name}.{key}": value for key, value in table(values, name).items()}
    return {key: _modern_value(rows[key], value) if key in rows else value for key, value in entries.items()}


def required(value: Any, key: str, advice: str) -> Any:
    """Return a value that has no default; `InputError` with `advice` on what to give where it is None."""
    if value is None:
        raise InputError(f"{key}: missing; {advice}")
    return value


def check_entries(values: Mapping[str, Any], version: int, names: Collection[str]) -> None:
    """Raise `InputError` where a recipe has another language version than `version`, or an entry not in `names`."""
    if "version" not in values:
        raise InputError(f"version: missing; this mphDRR reads version = {version}")
    if values["version"] != version or isinstance(values["version"], bool):
        raise InputError(f"version: expected {version}, got {values['version']!r}; a newer mphDRR may read it")
    for key in values:
        if key not in names:
            raise InputError(f"{key}: no such entry; expected {', '.join(names)}")


def grid_of(values: Any, name: str) -> Grid:
    """Return the grid that the table `name` of a recipe describes by voxels, spacing and center, centred there.

    `InputError` names the table where these do not describe a grid.
    """
    spacing = required(values[f"{name}.spacing"], f"{name}.spacing", "give the voxel size in mm")
    with naming(name):
        voxels = np.broadcast_to(values[f"{name}.voxels"], 3)
        return Grid.centered(voxels, np.broadcast_to(spacing, 3), values[f"{name}.center"])


def _modern_value(row: Setting, value: Any) -> Any:
    """Return a value as recipes of today write it: earlier versions took true for 1.0, "60" for 60.0, and 8.0 for 8."""
    if isinstance(value, list):
        return [_modern_value(row, item) for item in value]
    if isinstance(value, dict):
        return {key: _modern_value(row, item) if key == "one_of" else item for key, item in value.items()}
    is_number = isinstance(value, str) and row.words and value not in row.words
    if row.kind is float and (is_number or isinstance(value, bool)):
        with suppress(ValueError):
            return float(value)
    return int(value) if row.kind is int and isinstance(value, float) and value.is_integer() else value


def plain_name(name: Any, label: str) -> str:
    """Return a name that is also usable as a file name (letters, digits, - and _), or raise `InputError`."""
    if not isinstance(name, str) or not name.replace("-", "").replace("_", "").isalnum():
        raise InputError(f"{label}: expected a name of letters, digits, - and _, got {name!r}")
    return name


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
        entry = PhantomEntry(flat(entries, _phantom_rows(str(kind)), "pose"), settings)
        if not entry.name:
            raise InputError("name: expected a text, got ''")
        if entry["split"] is not None:
            plain_name(entry["split"], "split")
        if entry["gates"] > 1 and (entry.kind is None or entry.kind.phantom is not CardiacTorso or "phase" in settings):
            raise InputError('gates: expected kind = "torso" without a phase')
        if kind is None:
            _check_files(entry, quantity)
        return entry


@functools.cache
def _phantom_rows(kind: str) -> Mapping[str, Setting]:
    """Return the settings that a phantom may have, by key: one of a kind, or one from a file where no kind has the name."""
    return by_key([*(row for k in KINDS if k.name == kind for row in own_settings(k, DrawnSetting)), *_ROWS])


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
