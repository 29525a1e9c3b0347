"""The phantoms of an event recipe: their settings, values and draws."""

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
from .draws import Drawn, DrawnValues, options


def like(key: str, known: str, row: type[Setting] = Setting, **changes: Any) -> Setting:
    """The row of a setting that is another's of projection runs under another key."""
    return row(**{**vars(SETTINGS[known]), "key": key, "needs": (), **changes})


_OF_FILE = ("file",)
_ROWS = (
    Setting("name", str, None, "What the phantom is called", "its kind"),
    Setting("odds", float, 1.0, "How often it comes, beside the others", least=0),
    Setting("split", str, None, "The split of all its events", "one by the shares of the splits"),
    like("kind", "phantom.kind", default=None, needs=("no file",)),
    Drawn("file", str, None, "A phantom's shapes (.toml) or a volume", needs=("no kind",)),
    Drawn("mu_file", str, None, "What attenuates a volume, which is placed with it", needs=_OF_FILE),
    like("center", "volume.center", needs=_OF_FILE),
    like("energy", "volume.energy", needs=_OF_FILE),
    Setting("gates", int, 1, "Phases of the beating torso, whose mean the event is", least=1, needs=("kind",)),
    like("pose.position", "phantom.position", Drawn),
    like("pose.euler_degrees", "phantom.euler_degrees", Drawn),
    Setting("pose.turn", str, None, "How it is turned", words={"uniform": ("Uniform", "Every rotation is as likely")},
            needs=("no pose.euler_degrees",)),
)  # fmt: skip


def by_key(rows: Iterable[Setting]) -> dict[str, Setting]:
    """Settings by their keys."""
    return {row.key: row for row in rows}


def table(values: Mapping[str, Any], name: str) -> dict[str, Any]:
    """A table of a recipe, empty where it is not there; `InputError` where it is none."""
    found = values.get(name, {})
    if not isinstance(found, dict):
        raise InputError(f"{name}: expected a table [{name}]")
    return found


def flat(values: Mapping[str, Any], rows: Mapping[str, Setting], *tables: str) -> dict[str, Any]:
    """The values of a recipe by the keys of their rows: those in its tables as "table.name"."""
    found = {key: value for key, value in values.items() if key not in tables}
    for name in tables:
        found |= {f"{name}.{key}": value for key, value in table(values, name).items()}
    return {key: _as_earlier(rows[key], value) if key in rows else value for key, value in found.items()}


def required(value: Any, key: str, what: str) -> Any:
    """A value that has no default; `InputError`, which says what to give, where it is missing."""
    if value is None:
        raise InputError(f"{key}: missing; {what}")
    return value


def check_entries(values: Mapping[str, Any], version: int, known: Collection[str]) -> None:
    """Raise `InputError` where a recipe is of another version of its language, or has what is not `known`."""
    if "version" not in values:
        raise InputError(f"version: missing; this mphDRR reads version = {version}")
    if values["version"] != version or isinstance(values["version"], bool):
        raise InputError(f"version: expected {version}, got {values['version']!r}; a newer mphDRR may read it")
    for key in values:
        if key not in known:
            raise InputError(f"{key}: no such entry; expected {', '.join(known)}")


def grid_of(values: Any, name: str) -> Grid:
    """The voxels that a table of a recipe says by voxels, spacing and center; `InputError`, which names it, if it cannot."""
    spacing = required(values[f"{name}.spacing"], f"{name}.spacing", "give the voxel size in mm")
    with naming(name):
        voxels = np.broadcast_to(values[f"{name}.voxels"], 3)
        return Grid.centered(voxels, np.broadcast_to(spacing, 3), values[f"{name}.center"])


def _as_earlier(row: Setting, value: Any) -> Any:
    """A value, other where earlier versions took true for 1.0, "60" for an energy of 60.0, and 8.0 for 8."""
    if isinstance(value, list):
        return [_as_earlier(row, each) for each in value]
    if isinstance(value, dict):
        return {key: _as_earlier(row, each) if key == "one_of" else each for key, each in value.items()}
    is_number = isinstance(value, str) and row.words and value not in row.words
    if row.kind is float and (is_number or isinstance(value, bool)):
        with suppress(ValueError):
            return float(value)
    return int(value) if row.kind is int and isinstance(value, float) and value.is_integer() else value


def plain_name(name: Any, what: str) -> str:
    """A name that may also be that of a file: letters, digits, - and _."""
    if not isinstance(name, str) or not name.replace("-", "").replace("_", "").isalnum():
        raise InputError(f"{what}: expected a name of letters, digits, - and _, got {name!r}")
    return name


@dataclass(frozen=True)
class PhantomEntry(DrawnValues):
    """One of the phantoms that an event may have: its values and draws, by the keys of their settings."""

    settings: Mapping[str, Any] = field(default_factory=dict)  # of its kind, as the recipe says them

    @functools.cached_property
    def rows(self) -> Mapping[str, Setting]:
        """The settings that it may have."""
        return _rows(str(self.given.get("kind")))

    @functools.cached_property
    def kind(self) -> PhantomKind | None:
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
        entry = PhantomEntry(flat(named, _rows(str(kind)), "pose"), own)
        if not entry.name:
            raise InputError("name: expected a text, got ''")
        if entry["split"] is not None:
            plain_name(entry["split"], "split")
        if entry["gates"] > 1 and (entry.kind is None or entry.kind.phantom is not CardiacTorso or "phase" in own):
            raise InputError('gates: they are of kind = "torso" without a phase of its own')
        if kind is None:
            _check_files(entry, quantity)
        return entry


@functools.cache
def _rows(kind: str) -> Mapping[str, Setting]:
    """The settings of a phantom of a kind, or of a file."""
    return by_key([*(row for known in KINDS if known.name == kind for row in own_settings(known, Drawn)), *_ROWS])


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


def as_settings(phantom: Any, kind: PhantomKind) -> dict[str, Any]:
    """All settings of a phantom by their names in recipes, as JSON holds them."""
    found = {key: getattr(phantom, name) for key, name in setting_names(kind.phantom).items()}
    return {key: np.asarray(value).tolist() if isinstance(value, tuple) else value for key, value in found.items()}
