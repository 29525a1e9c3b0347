"""Random parameters of event i (phantom, pose, size, activity, noise seed), drawn from recipe, seed and i alone."""

import math
from functools import cached_property
from typing import Any

import numpy as np

from ..arrays import Floats
from ..errors import naming
from ..geometry.frames import euler_pose
from ..phantoms.language import read_phantom
from ..phantoms.phantom import Phantom
from ..phantoms.settings import setting_names
from ..phantoms.torso import CardiacTorso
from ..recording import Remembered, remembered
from ..validation import seed_number
from .draws import Dice, possible_values
from .entries import recorded_settings
from .recipe import EventRecipe

FIXED_COLUMNS = (
    *("event", "phantom", "split", "x_mm", "y_mm", "z_mm", "phi_degrees", "theta_degrees", "psi_degrees", "mirror"),
    *("size", "activity_factor", "noise_seed"),
)
"""Columns of the index that are the same for all recipes."""
_GOLDEN = (math.sqrt(5) - 1) / 2
"""Step of the low-discrepancy sequence that assigns splits: the golden ratio minus 1."""


class PlannedEvent:
    """Drawn parameters of event `number`, from 0, of a recipe; images and truth are not computed.

    The attributes ``size`` and ``activity_factor`` are the factors, float, of the phantom's lengths and of all values.

    Attributes
    ----------
    entry : PhantomEntry
        Phantom of the recipe that was drawn.
    split : str or None
        Split of the event; None where the recipe has no splits.
    settings : dict
        Drawn values of the phantom's settings that the recipe names.
    file, mu_file : str or None
        Files of the phantom and of its attenuation, as the recipe names them; None without such files.
    position, euler_degrees : tuple of three floats
        Position of the phantom's centre, mm, and its angles phi, theta, psi, degrees.
    mirror : bool
        Whether the phantom is mirrored.
    noise_seed : int
        Seed of the event's own noise.
    """

    def __init__(self, recipe: EventRecipe, number: int) -> None:
        self.recipe, self.number = recipe, number
        dice = Dice(recipe.seed, number)
        entry = recipe.phantoms[dice.choice("phantom", [entry["odds"] for entry in recipe.phantoms])]
        prefix, is_int = f"{entry.name}: ", {key: row.kind is int for key, row in entry.rows.items()}
        self.entry, self.split = entry, entry["split"] or _draw_split(recipe, number)
        self.settings = {key: dice.draw(value, prefix + key, is_int[key]) for key, value in entry.settings.items()}
        self.file, self.mu_file = dice.draw(entry["file"], f"{prefix}file"), None
        if entry["mu_file"] is not None:
            self.mu_file = possible_values(entry["mu_file"])[possible_values(entry["file"]).index(self.file)]
        self.position = entry.drawn("pose.position", dice, prefix)
        if entry["pose.turn"] is None:
            self.euler_degrees = entry.drawn("pose.euler_degrees", dice, prefix)
        else:
            u, v, w = (dice.unit(f"{prefix}pose.turn {axis}") for axis in range(3))
            self.euler_degrees = 360 * u, math.degrees(math.acos(1 - 2 * v)), 360 * w
        self.mirror = dice.unit("augmentation.mirror") < recipe["augmentation.mirror"]
        with naming(f"event {number}"):
            self.size = recipe.settings.drawn("augmentation.size", dice)
            self.activity_factor = recipe.settings.drawn("augmentation.activity", dice)
        self.noise_seed = dice.bits("noise") >> 32

    @property
    def name(self) -> str:
        """The name of the phantom in the recipe."""
        return self.entry.name

    @property
    def pose(self) -> Floats:
        """The pose (4, 4), world from phantom, mm: rotation and translation."""
        phi, theta, psi = map(math.radians, self.euler_degrees)
        return euler_pose(phi, theta, psi, self.position)

    @property
    def placement(self) -> Floats:
        """The placement (4, 4), world from the phantom's own frame, mm: factor of size and mirroring, then the pose."""
        scale = np.diag([-self.size if self.mirror else self.size, self.size, self.size, 1.0])
        return self.pose @ scale

    @property
    def phantom(self) -> Phantom | None:
        """The phantom; None where it is a file of a volume. `InputError` where the drawn settings contradict each other."""
        return self.made_phantom.value

    @cached_property
    def made_phantom(self) -> Remembered[Phantom | None]:
        """The phantom together with the warnings that its construction gave."""
        with naming(f"event {self.number}"):
            return remembered(self._make_phantom)

    def _make_phantom(self) -> Phantom | None:
        """Return the phantom of the drawn kind and settings, or read it from its file; None for a volume."""
        if (kind := self.entry.kind) is not None:
            names = setting_names(kind.phantom)
            arguments = {names[key]: _as_tuples(value) for key, value in self.settings.items()}
            return kind.phantom(**{**kind.usual, **arguments})
        return None if self.entry.is_volume else read_phantom(self.recipe.input(str(self.file)).path)

    @property
    def phantoms(self) -> list[Phantom]:
        """The phantoms over which the event is averaged: one, or the gates of a beating torso; none for a volume."""
        if self.phantom is None:
            return []
        if isinstance(self.phantom, CardiacTorso) and self.entry["gates"] > 1:
            return list(self.phantom.beating(self.entry["gates"]))
        return [self.phantom]

    @property
    def all_settings(self) -> dict[str, Any]:
        """All settings of the phantom, drawn or not, by their names in recipes; the file names of a phantom from files."""
        if self.entry.kind is not None:
            return {"kind": self.entry.kind.name, **recorded_settings(self.phantom, self.entry.kind)}
        return {"file": self.file} | ({} if self.mu_file is None else {"mu_file": self.mu_file})

    def gains(self, count: int) -> Floats:
        """Draw the factors (count,) of the modules' sensitivities, log-normal with the recipe's module_gain."""
        deviation, dice = self.recipe["augmentation.module_gain"], Dice(self.recipe.seed, self.number)
        return np.array([math.exp(deviation * dice.normal(f"module gain {m}")) for m in range(count)])

    def row(self) -> dict[str, Any]:
        """Return the event's row of the index, by column."""
        fixed = (
            *(self.number, self.name, self.split or "", *self.position, *self.euler_degrees, self.mirror, self.size),
            *(self.activity_factor, self.noise_seed),
        )
        row = dict(zip(FIXED_COLUMNS, fixed, strict=True)) | ({} if self.file is None else {"file": self.file})
        return row | {f"phantom.{key}": value for key, value in self.settings.items()}


def plan(recipe: EventRecipe, number: int) -> PlannedEvent:
    """Draw the parameters of event `number`, from 0, of a recipe: the same on every machine and in any order of events."""
    return PlannedEvent(recipe, seed_number(number, "event"))


def _draw_split(recipe: EventRecipe, number: int) -> str | None:
    """Return the split of an event whose phantom names none; None where the recipe has no splits.

    Splits follow a low-discrepancy sequence, so that every range of events has about the recipe's fractions.
    """
    point, total = (Dice(recipe.seed, 0).unit("splits") + number * _GOLDEN) % 1.0, 0.0
    for name, fraction in recipe.splits.items():
        total += fraction
        if point < total:
            return name
    return next(reversed(recipe.splits), None)


def _as_tuples(value: Any) -> Any:
    """Return nested lists as nested tuples, and any other value as it is."""
    return tuple(map(_as_tuples, value)) if isinstance(value, list) else value
