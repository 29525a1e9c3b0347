"""Mixtures of random shapes: a different phantom for each seed, for training sets and tests."""

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

_MAX_SHAPES = 2000
_COLD_FRACTION = 0.2  # of the solid shapes, which have activity 0
LOOKS = ("solids", "lumps")


@dataclass(frozen=True)
class MixturePhantom(Phantom):
    """Random shapes in a ball of air, drawn from a seed: the same seed and settings give the same phantom.

    ``"solids"`` are ellipsoids, cylinders and boxes in random orientations, each replacing the shapes that it covers; one in
    five has no activity. ``"lumps"`` are balls whose activities add up to a texture, after the lumpy backgrounds of J. P.
    Rolland and H. H. Barrett, J. Opt. Soc. Am. A 9 (1992) 649-658, but with sharp edges.
    """

    seed: int = count(1, "seed of the random numbers")
    number: int = count(8, "number of shapes")
    radius: float = setting(40.0, "mm", "radius of the ball that contains all shapes")
    smallest: float = setting(3.0, "mm", "smallest half axis of a shape")
    largest: float = setting(15.0, "mm", "largest half axis of a shape")
    activity_from: float = setting(20.0, "kBq/mL", "lowest activity of a shape", 0.0)
    activity_to: float = setting(150.0, "kBq/mL", "highest activity of a shape", 0.0)
    look: str = choice("solids", LOOKS, "separate solids, or lumps that add up to a texture")
    mu: float = setting(WATER_MU, "1/mm", "attenuation coefficient of the shapes", 0.0)

    title = "mixture"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_most(self.smallest, self.largest, f"{self.title}: smallest", "as the largest")
        require_at_most(math.sqrt(3) * self.largest, self.radius, f"{self.title}: a box's half diagonal", "in the ball")

    @cached_property
    def shapes(self) -> Sequence[Shape]:
        """Shapes in the order in which they are drawn from the seed, which is the order of painting."""
        if self.number > _MAX_SHAPES:
            raise InputError(f"{self.title}: expected at most {_MAX_SHAPES} shapes, got {self.number}")
        rng = np.random.default_rng(self.seed)
        return [self._draw_shape(rng) for _ in range(self.number)]

    def _draw_shape(self, rng: np.random.Generator) -> Shape:
        """Draw the next shape. The order of the draws is fixed: it decides what a seed gives."""
        radii = rng.uniform(self.smallest, self.largest, 3)
        kind = ("ellipsoid", "cylinder", "box")[rng.integers(3)]
        activity = rng.uniform(self.activity_from, self.activity_to)
        direction, distance = rng.normal(size=3), rng.random() ** (1 / 3)  # distance as a fraction of the free radius
        degrees = rng.uniform(0, 360), math.degrees(math.acos(rng.uniform(-1, 1))), rng.uniform(0, 360)
        is_cold = rng.random() < _COLD_FRACTION
        ball_radius = radii[0] if self.look == "lumps" else float(np.linalg.norm(radii))
        position = direction / np.linalg.norm(direction) * distance * max(0.0, self.radius - ball_radius)
        common: dict[str, Any] = {"position": position, "mu": self.mu}
        if self.look == "lumps":
            return Ellipsoid(radii=[radii[0]] * 3, activity=activity, mode="add", **common)
        # The angles are converted from degrees, as they are read from a TOML file: both give the same phantom.
        common |= {"euler": tuple(map(math.radians, degrees)), "activity": 0.0 if is_cold else activity}
        if kind == "ellipsoid":
            return Ellipsoid(radii=radii, **common)
        if kind == "cylinder":
            return Cylinder(radius=radii[:2], height=2 * radii[2], **common)
        return Box(size=2 * radii, **common)
