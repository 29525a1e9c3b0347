"""Point sources on a lattice, for resolution and calibration."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..errors import InputError
from .phantom import Phantom
from .settings import count, require_at_most, setting
from .shapes import Shape, Sphere

_MAX_POINTS = 10_000


@dataclass(frozen=True)
class PointGrid(Phantom):
    """Equal small balls on a lattice centred on the origin, in air.

    Voxels of any size contain the whole activity of each point.
    """

    counts: tuple[int, int, int] = count((5, 5, 5), "number of points along x y z")
    spacing: tuple[float, float, float] = setting(
        (20.0, 20.0, 20.0), "mm", "distance between adjacent points along x y z", option="spacing-of-points"
    )
    diameter: float = setting(1.0, "mm", "diameter of a point")
    point_activity: float = setting(100.0, "kBq", "activity of each point")

    title = "grid of points"

    def __post_init__(self) -> None:
        super().__post_init__()
        if steps := [step for step, n in zip(self.spacing, self.counts, strict=True) if n > 1]:
            require_at_most(self.diameter, min(steps), f"{self.title}: diameter", "from point to point")

    @cached_property
    def shapes(self) -> Sequence[Shape]:
        """Balls of all points, the index along z running fastest."""
        if math.prod(self.counts) > _MAX_POINTS:
            raise InputError(f"expected at most {_MAX_POINTS} points, got {math.prod(self.counts)}")
        radius = self.diameter / 2
        ball = Sphere(radius=radius, activity=self.point_activity / (4e-3 / 3 * math.pi * radius**3))  # mm^3 to mL
        center_index, spacing = (np.array(self.counts) - 1) / 2, np.array(self.spacing)
        return [
            replace(ball, position=(index - center_index) * spacing, name="point " + " ".join(map(str, index)))
            for index in itertools.product(*map(range, self.counts))
        ]
