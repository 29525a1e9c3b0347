"""What event i is: drawn from recipe, seed and number alone, before anything is computed."""

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
from .draws import Dice, options
from .entries import as_settings
from .recipe import EventRecipe

FIXED_COLUMNS = (
    *("event", "phantom", "split", "x_mm", "y_mm", "z_mm", "phi_degrees", "theta_degrees", "psi_degrees", "mirror"),
    *("size", "activity_factor", "noise_seed"),
)
"""The columns of the index that all recipes have."""
_GOLDEN = (math.sqrt(5) - 1) / 2


class PlannedEvent:
    """What event `number`, from 0, of a recipe is: drawn, with nothing of it computed yet.

    Attributes
    ----------
    entry : PhantomEntry
        The recipe's phantom, and its `split`, None where there are none.
    settings : dict
        Those of the phantom that the recipe names, drawn.
    file, mu_file : str or None
        The phantom's files, as the recipe names them.
    position, euler_degrees : tuple of three floats
        The phantom's middle, mm, and phi, theta, psi.
    mirror, size, activity_factor
        What is changed besides: whether the phantom is mirrored, factors of its lengths and of all values.
    noise_seed : int
        The event's own seed of noise.
    """

    def __init__(self, recipe: EventRecipe, number: int) -> None:
        self.recipe, self.number = recipe, number
        dice = Dice(recipe.seed, number)
        entry = recipe.phantoms[dice.choice("phantom", [entry["odds"] for entry in recipe.phantoms])]
        own, kinds = f"{entry.name}: ", {key: row.kind for key, row in entry.rows.items()}
        self.entry, self.split = entry, entry["split"] or _split(recipe, number)
        self.settings = {key: dice.draw(value, own + key, kinds[key] is int) for key, value in entry.settings.items()}
        self.file, self.mu_file = dice.draw(entry["file"], f"{own}file"), None
        if entry["mu_file"] is not None:
            self.mu_file = options(entry["mu_file"])[options(entry["file"]).index(self.file)]
        self.position = entry.drawn("pose.position", dice, own)
        if entry["pose.turn"] is None:
            self.euler_degrees = entry.drawn("pose.euler_degrees", dice, own)
        else:
            u, v, w = (dice.unit(f"{own}pose.turn {axis}") for axis in range(3))
            self.euler_degrees = 360 * u, math.degrees(math.acos(1 - 2 * v)), 360 * w
        self.mirror = dice.unit("augmentation.mirror") < recipe["augmentation.mirror"]
        with naming(f"event {number}"):
            self.size = recipe.settings.drawn("augmentation.size", dice)
            self.activity_factor = recipe.settings.drawn("augmentation.activity", dice)
        self.noise_seed = dice.bits("noise") >> 32

    @property
    def name(self) -> str:
        """What the recipe calls the phantom."""
        return self.entry.name

    @property
    def pose(self) -> Floats:
        """World-from-phantom pose (4, 4), mm: rotation and translation."""
        phi, theta, psi = map(math.radians, self.euler_degrees)
        return euler_pose(phi, theta, psi, self.position)

    @property
    def placement(self) -> Floats:
        """The pose after mirroring and the factor of size: what the phantom's own frame is placed by, (4, 4), mm."""
        scale = np.diag([-self.size if self.mirror else self.size, self.size, self.size, 1.0])
        return self.pose @ scale

    @property
    def phantom(self) -> Phantom | None:
        """The phantom; None where it is a volume's file. `InputError` where the drawn settings do not go together."""
        return self.made_phantom.value

    @cached_property
    def made_phantom(self) -> Remembered[Phantom | None]:
        """The phantom, and what was warned of when it was made."""
        with naming(f"event {self.number}"):
            return remembered(self._make_phantom)

    def _make_phantom(self) -> Phantom | None:
        kind = self.entry.kind
        if kind is not None:
            names = setting_names(kind.phantom)
            given = {names[key]: _tuples(value) for key, value in self.settings.items()}
            return kind.phantom(**{**kind.usual, **given})
        return None if self.entry.is_volume else read_phantom(self.recipe.input(str(self.file)).path)

    @property
    def phantoms(self) -> list[Phantom]:
        """The phantoms whose mean the event is: one, or the gates of a beating torso; none of a volume's file."""
        if self.phantom is None:
            return []
        if isinstance(self.phantom, CardiacTorso) and self.entry["gates"] > 1:
            return list(self.phantom.beating(self.entry["gates"]))
        return [self.phantom]

    @property
    def all_settings(self) -> dict[str, Any]:
        """All settings of the phantom by their names in recipes, drawn or not; of a file its name."""
        if self.entry.kind is not None:
            return {"kind": self.entry.kind.name, **as_settings(self.phantom, self.entry.kind)}
        return {"file": self.file} | ({} if self.mu_file is None else {"mu_file": self.mu_file})

    def gains(self, count: int) -> Floats:
        """Factors (count,) of the modules' sensitivities."""
        deviation, dice = self.recipe["augmentation.module_gain"], Dice(self.recipe.seed, self.number)
        return np.array([math.exp(deviation * dice.normal(f"module gain {m}")) for m in range(count)])

    def row(self) -> dict[str, Any]:
        """The event's row of the index, by column."""
        fixed = (
            *(self.number, self.name, self.split or "", *self.position, *self.euler_degrees, self.mirror, self.size),
            *(self.activity_factor, self.noise_seed),
        )
        row = dict(zip(FIXED_COLUMNS, fixed, strict=True)) | ({} if self.file is None else {"file": self.file})
        return row | {f"phantom.{key}": value for key, value in self.settings.items()}


def plan(recipe: EventRecipe, number: int) -> PlannedEvent:
    """What event `number`, from 0, of a recipe is: the same on every machine, whatever is made before or beside it."""
    return PlannedEvent(recipe, seed_number(number, "event"))


def _split(recipe: EventRecipe, number: int) -> str | None:
    """The split of an event whose phantom has none of its own.

    A low-discrepancy sequence, so that any stretch of events has about the shares of the recipe.
    """
    place, total = (Dice(recipe.seed, 0).unit("splits") + number * _GOLDEN) % 1.0, 0.0
    for name, part in recipe.splits.items():
        total += part
        if place < total:
            return name
    return next(reversed(recipe.splits), None)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
