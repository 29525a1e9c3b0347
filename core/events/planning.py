"""What event i is: drawn from recipe, seed and number alone, before anything is computed."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, naming
from ..geometry.frames import euler_pose
from ..phantoms.language import read_phantom
from ..phantoms.phantom import Phantom
from ..phantoms.settings import setting_names
from ..phantoms.torso import CardiacTorso
from ..recording import Remembered, remembered
from .draws import Dice, options
from .entries import PhantomEntry, as_settings
from .recipe import EventRecipe

FIXED_COLUMNS = (
    *("event", "phantom", "split", "x_mm", "y_mm", "z_mm", "phi_degrees", "theta_degrees", "psi_degrees", "mirror"),
    *("size", "activity_factor", "noise_seed"),
)
"""Of the index, those that all recipes have."""
_GOLDEN = (math.sqrt(5) - 1) / 2


@dataclass(frozen=True, eq=False)
class PlannedEvent:
    """What event `number` of a recipe is; nothing of it is computed yet."""

    number: int
    entry: PhantomEntry
    split: str | None
    settings: dict[str, Any]  # of the phantom, drawn: those that the recipe names
    file: str | None  # of the phantom, as the recipe names it
    mu_file: str | None
    position: tuple[float, float, float]  # mm
    euler_degrees: tuple[float, float, float]  # phi, theta, psi
    mirror: bool
    size: float
    activity_factor: float
    noise_seed: int
    recipe: EventRecipe

    @property
    def name(self) -> str:
        """Of the recipe's phantom."""
        return self.entry.name

    @property
    def pose(self) -> NDArray[np.float64]:
        """World-from-phantom pose (4, 4), mm: rotation and translation."""
        phi, theta, psi = (math.radians(angle) for angle in self.euler_degrees)
        return euler_pose(phi, theta, psi, self.position)

    @property
    def placement(self) -> NDArray[np.float64]:
        """The pose after mirroring and the factor of size: what the phantom's own frame is placed by, (4, 4), mm."""
        scale = np.diag([-self.size if self.mirror else self.size, self.size, self.size, 1.0])
        placement: NDArray[np.float64] = self.pose @ scale
        return placement

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
        if kind is None:
            return (
                None if self.entry.is_volume or self.file is None else read_phantom(self.recipe.input(self.file).path)
            )
        names = setting_names(kind.phantom)
        given = {names[key]: _tuples(value) for key, value in self.settings.items()}
        phantom: Phantom = kind.phantom(**{**kind.usual, **given})
        return phantom

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

    def gains(self, count: int) -> NDArray[np.float64]:
        """Factors (count,) of the modules' sensitivities."""
        deviation, dice = self.recipe["augmentation.module_gain"], Dice(self.recipe.seed, self.number)
        return np.array([math.exp(deviation * dice.normal(f"module gain {m}")) for m in range(count)])

    def row(self) -> dict[str, Any]:
        """The event's row of the index, by column."""
        fixed = (
            *(self.number, self.name, self.split or "", *self.position, *self.euler_degrees, self.mirror, self.size),
            *(self.activity_factor, self.noise_seed),
        )
        return {
            **dict(zip(FIXED_COLUMNS, fixed, strict=True)),
            **({} if self.file is None else {"file": self.file}),
            **{f"phantom.{key}": value for key, value in self.settings.items()},
        }


def plan(recipe: EventRecipe, number: int) -> PlannedEvent:
    """What event `number`, from 0, of a recipe is: the same on every machine, whatever is made before or beside it."""
    if isinstance(number, bool) or not isinstance(number, int | np.integer) or number < 0:
        raise InputError(f"event: expected a whole number of at least 0, got {number!r}")
    number = int(number)
    dice = Dice(recipe.seed, number)
    entry = recipe.phantoms[dice.choice("phantom", [entry["odds"] for entry in recipe.phantoms])]
    own = f"{entry.name}: "
    settings = {
        key: dice.draw(value, f"{own}{key}", entry.rows[key].kind is int) for key, value in entry.settings.items()
    }
    file, mu_file = dice.draw(entry["file"], f"{own}file"), None
    if entry["mu_file"] is not None:
        mu_file = options(entry["mu_file"])[options(entry["file"]).index(file)]
    position = dice.draw(entry["pose.position"], f"{own}pose.position")
    if entry["pose.turn"] is not None:
        u, v, w = (dice.unit(f"{own}pose.turn {axis}") for axis in range(3))
        angles = [360 * u, math.degrees(math.acos(1 - 2 * v)), 360 * w]
    else:
        angles = dice.draw(entry["pose.euler_degrees"], f"{own}pose.euler_degrees")
    with naming(f"event {number}"):
        size, factor = (recipe.drawn(key, dice) for key in ("augmentation.size", "augmentation.activity"))
    return PlannedEvent(
        number=number,
        entry=entry,
        split=entry["split"] or _split(recipe, number),
        settings=settings,
        file=file,
        mu_file=mu_file,
        position=_three(position),
        euler_degrees=_three(angles),
        mirror=dice.unit("augmentation.mirror") < recipe["augmentation.mirror"],
        size=size,
        activity_factor=factor,
        noise_seed=dice.bits("noise") >> 32,
        recipe=recipe,
    )


def _split(recipe: EventRecipe, number: int) -> str | None:
    """The split of an event that no phantom's entry says.

    A low-discrepancy sequence, so that any stretch of events has about the shares of the recipe.
    """
    place, total = (Dice(recipe.seed, 0).unit("splits") + number * _GOLDEN) % 1.0, 0.0
    for name, part in recipe.splits.items():
        total += part
        if place < total:
            return name
    return next(reversed(recipe.splits), None)


def _three(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value
