"""The parts of an event recipe and their checks: tables, and the phantoms with their ranges."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import InputError, naming
from ..phantoms.kinds import KINDS, Kind
from ..phantoms.settings import setting_names
from ..phantoms.torso import CardiacTorso
from ..physics.isotopes import photon_energy
from ..validation import one_of, real_array, whole_number
from .draws import check_draw, check_number, options

_OWN = ("name", "odds", "split", "pose")
_OF_FILE = ("file", "mu_file", "center", "energy")


def table(values: Mapping[str, Any], name: str, *known: str) -> dict[str, Any]:
    """A table of the recipe, empty where it is not there; `InputError` for a key that is not one of those `known`."""
    found = values.get(name, {})
    if not isinstance(found, dict):
        raise InputError(f"{name}: expected a table [{name}]")
    unknown(found, known or found, f"{name}.")
    return found


def unknown(values: Mapping[str, Any], known: Collection[str], before: str) -> None:
    """Raise `InputError` for a key that is not one of those `known`."""
    for key in values:
        if key not in known:
            raise InputError(f"{before}{key}: no such entry; expected {', '.join(known)}")


def plain_name(name: Any, what: str) -> str:
    """A name that may also be that of a file: letters, digits, - and _."""
    if not isinstance(name, str) or not name.replace("-", "").replace("_", "").isalnum():
        raise InputError(f"{what}: expected a name of letters, digits, - and _, got {name!r}")
    return name


def share(value: Any, name: str) -> float:
    """A number from 0 to 1."""
    number = float(real_array(value, name, ()))
    if not 0 <= number <= 1:
        raise InputError(f"{name}: expected from 0 to 1, got {number:g}")
    return number


@dataclass(frozen=True)
class PhantomEntry:
    """One of the phantoms that an event may have."""

    name: str
    kind: Kind | None  # None where it is a file
    file: Any = None  # draw of the names of volumes or of phantoms (.toml)
    mu_file: Any = None  # of a volume: what attenuates, which is placed with it
    center: bool = False  # whether a volume's middle is moved to the origin first
    energy: float | str | None = None  # at which a volume of CT numbers becomes mu
    settings: dict[str, Any] = field(default_factory=dict)  # of the kind: values and draws
    position: Any = (0.0, 0.0, 0.0)  # mm
    euler_degrees: Any = (0.0, 0.0, 0.0)  # phi, theta, psi
    turn_uniform: bool = False  # every rotation is as likely as any other
    gates: int = 1  # of the beating torso: the event is the mean of so many phases
    odds: float = 1.0
    split: str | None = None  # to which all such events belong

    @property
    def is_volume(self) -> bool:
        """Whether the files are volumes."""
        return self.file is not None and not str(options(self.file)[0]).lower().endswith(".toml")

    def is_whole(self, setting: str) -> bool:
        """Whether a setting of the kind is a whole number, or several."""
        default = _defaults(self.kind)[setting] if self.kind else 0.0
        first = default[0] if isinstance(default, tuple) else default
        return isinstance(first, int) and not isinstance(first, bool)

    def what(self, quantity: str) -> str:
        """What a volume is read as: its quantity, and the energy at which CT numbers become mu."""
        return quantity if self.energy is None or quantity != "mu" else f"mu at {self.energy}"


def phantom_entry(values: dict[str, Any], number: int, quantity: str) -> PhantomEntry:
    """One table of [[phantoms]]; `InputError` names phantom and entry."""
    called = values.get("name", values.get("kind", f"phantom {number}"))
    with naming(f"phantoms: {called}"):
        if ("kind" in values) == ("file" in values):
            raise InputError('expected either kind = "…" or file = "…"')
        kind = None
        if "kind" in values:
            one_of(values["kind"], [known.name for known in KINDS], "kind")
            (kind,) = (known for known in KINDS if known.name == values["kind"])
        found = _placed(values) | _of_file(values, kind, quantity)
        name = values.get("name", kind.name if kind else f"file-{number}")
        if not isinstance(name, str) or not name:
            raise InputError(f"name: expected a text, got {name!r}")
        split = values.get("split")
        if split is not None:
            plain_name(split, "split")
        odds = float(real_array(values.get("odds", 1.0), "odds", ()))
        gates = whole_number(values.get("gates", 1), "gates")
        if gates > 1 and (kind is None or kind.phantom is not CardiacTorso or "phase" in values):
            raise InputError('gates: they are of kind = "torso" without a phase of its own')
        entry = PhantomEntry(name, kind, gates=gates, odds=odds, split=split, **found)
        _check_settings(entry)
        return entry


def _of_file(values: dict[str, Any], kind: Kind | None, quantity: str) -> dict[str, Any]:
    """The entries of a phantom that is a file, or the settings of one of a kind."""
    if kind is not None:
        settings = {key: value for key, value in values.items() if key not in (*_OWN, "kind", "gates")}
        return {"settings": settings}
    unknown(values, (*_OWN, *_OF_FILE), "")
    found: dict[str, Any] = {}
    for key in ("file", "mu_file"):
        if key not in values:
            continue
        check_draw(values[key], key)
        names = options(values[key])
        if not names or not all(isinstance(name, str) and name for name in names):
            raise InputError(f"{key}: expected a file's name, or {{ one_of = [names] }}, got {values[key]!r}")
        if len({name.lower().endswith(".toml") for name in names}) > 1:
            raise InputError(f"{key}: volumes and phantoms (.toml) do not go together: make two [[phantoms]] of them")
        found[key] = values[key]
    is_volume = not str(options(values["file"])[0]).lower().endswith(".toml")
    for key in ("mu_file", "center", "energy"):
        if key in values and not is_volume:
            raise InputError(f"{key}: it goes with volumes, not with phantoms (.toml)")
    if not isinstance(values.get("center", False), bool):
        raise InputError(f"center: expected true or false, got {values['center']!r}")
    if "mu_file" in values and isinstance(values["mu_file"], dict) != isinstance(values["file"], dict):
        raise InputError("mu_file: expected one for each file")
    if "mu_file" in values and len(options(values["mu_file"])) != len(options(values["file"])):
        raise InputError("mu_file: expected one for each file, in the same order")
    if "energy" in values:
        photon_energy(values["energy"])
        if quantity != "mu" and "mu_file" not in values:
            raise InputError("energy: it converts CT numbers to mu, but the truth is activity and there is no mu_file")
    return found | {key: values[key] for key in ("center", "energy") if key in values}


def _placed(values: dict[str, Any]) -> dict[str, Any]:
    """The entries of [phantoms.pose]."""
    pose = table(values, "pose", "position", "euler_degrees", "turn")
    found: dict[str, Any] = {}
    for key in ("position", "euler_degrees"):
        if key not in pose:
            continue
        check_draw(pose[key], f"pose.{key}")
        for option in options(pose[key]):
            if not isinstance(option, list) or len(option) != 3:
                raise InputError(f"pose.{key}: expected three numbers or draws, got {option!r}")
            for value in option:
                check_number(value, f"pose.{key}")
        found[key] = pose[key]
    if "turn" in pose:
        one_of(pose["turn"], ("uniform",), "pose.turn")
        if "euler_degrees" in pose:
            raise InputError("pose.turn: it does not go with euler_degrees")
        found["turn_uniform"] = True
    return found


def _check_settings(entry: PhantomEntry) -> None:
    """Raise `InputError` for a setting that the kind does not have, or a wrong draw; the values are checked when drawn."""
    if entry.kind is None:
        return
    known = setting_names(entry.kind.phantom)
    for key, value in entry.settings.items():
        if key not in known:
            expected = ", ".join((*known, *_OWN, *(["gates"] if entry.kind.phantom is CardiacTorso else [])))
            raise InputError(f"{key}: no such setting of {entry.kind.name}; expected {expected}")
        check_draw(value, key, entry.is_whole(key))


def _defaults(kind: Kind) -> dict[str, Any]:
    """The settings of a kind by their names in recipes, with the values that they have unless told otherwise."""
    defaults = {field.name: field.default for field in kind.phantom.__dataclass_fields__.values() if field.init}
    return {key: kind.usual.get(name, defaults[name]) for key, name in setting_names(kind.phantom).items()}


def as_settings(phantom: Any, kind: Kind) -> dict[str, Any]:
    """All settings of a phantom by their names in recipes, as JSON holds them."""
    found = {key: getattr(phantom, name) for key, name in setting_names(kind.phantom).items()}
    return {key: np.asarray(value).tolist() if isinstance(value, tuple) else value for key, value in found.items()}
