"""A mixture of random shapes: phantoms that are all different, for training sets and tests."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..errors import InputError
from ..physics.materials import WATER_MU
from .phantom import Phantom
from .settings import choice, count, require_at_most, setting
from .shapes import Box, Cylinder, Ellipsoid, Shape

_MOST = 2000
_COLD = 0.2  # share of the solid shapes that hold nothing
LOOKS = ("solids", "lumps")


@dataclass(frozen=True)
class MixturePhantom(Phantom):
    """Random shapes in a ball of air, drawn from a seed: the same seed and settings give the same phantom.

    ``"solids"`` are ellipsoids, cylinders and boxes, turned at random, each in the place of what it covers; one of five is
    empty. ``"lumps"`` are balls whose activities add up: a texture, after the lumpy backgrounds of J. P. Rolland and H. H.
    Barrett, J. Opt. Soc. Am. A 9 (1992) 649-658, with sharp edges.
    """

    seed: int = count(1, "of all that is random")
    number: int = count(8, "of the shapes")
    radius: float = setting(40.0, "mm", "of the ball that holds all shapes")
    smallest: float = setting(3.0, "mm", "half axis")
    largest: float = setting(15.0, "mm", "half axis")
    activity_from: float = setting(20.0, "kBq/mL", "at least, of a shape", 0.0)
    activity_to: float = setting(150.0, "kBq/mL", "at most", 0.0)
    look: str = choice("solids", LOOKS, "what the shapes are")
    mu: float = setting(WATER_MU, "1/mm", "of the shapes", 0.0)

    title = "mixture"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_most(self.smallest, self.largest, f"{self.title}: smallest", "as the largest")
        require_at_most(math.sqrt(3) * self.largest, self.radius, f"{self.title}: a box's half diagonal", "in the ball")

    @cached_property
    def shapes(self) -> Sequence[Shape]:
        """The shapes, in the order in which they are drawn."""
        if self.number > _MOST:
            raise InputError(f"{self.title}: expected at most {_MOST} shapes, got {self.number}")
        rng = np.random.default_rng(self.seed)
        return [self._shape(rng) for _ in range(self.number)]

    def _shape(self, rng: np.random.Generator) -> Shape:
        radii = rng.uniform(self.smallest, self.largest, 3)
        kind = ("ellipsoid", "cylinder", "box")[rng.integers(3)]
        activity = rng.uniform(self.activity_from, self.activity_to)
        direction, share = rng.normal(size=3), rng.random() ** (1 / 3)
        degrees = rng.uniform(0, 360), math.degrees(math.acos(rng.uniform(-1, 1))), rng.uniform(0, 360)
        is_cold = rng.random() < _COLD
        reach = radii[0] if self.look == "lumps" else float(np.linalg.norm(radii))
        place = direction / np.linalg.norm(direction) * share * max(0.0, self.radius - reach)
        common: dict[str, Any] = {"position": place, "mu": self.mu}
        if self.look == "lumps":
            return Ellipsoid(radii=[radii[0]] * 3, activity=activity, mode="add", **common)
        # Angles are those that text in degrees gives back.
        common |= {"euler": tuple(map(math.radians, degrees)), "activity": 0.0 if is_cold else activity}
        if kind == "ellipsoid":
            return Ellipsoid(radii=radii, **common)
        if kind == "cylinder":
            return Cylinder(radius=radii[:2], height=2 * radii[2], **common)
        return Box(size=2 * radii, **common)
