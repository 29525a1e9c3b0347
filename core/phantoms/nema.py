"""The body phantom of IEC 61675-1 and NEMA NU 2: six spheres and a lung insert in a torso of water."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ..errors import InputError
from ..physics.materials import WATER_MU
from .phantom import Phantom
from .settings import require_apart, require_at_most, setting
from .shapes import Box, Cylinder, Shape, ring_places, spheres

# Inside, mm: the front is a half circle, the back a straight line between two quarter circles.
_FRONT_RADIUS, _BACK_RADIUS, _BACK_WIDTH = 147.0, 77.0, 140.0
_CIRCLES_Y = -(_FRONT_RADIUS - _BACK_RADIUS) / 2  # of these circles' centres
_RING_RADIUS = 57.2  # of the spheres' centres
_TO_LID = 70.0  # from the spheres' plane
_LUNG_DENSITY = 0.3  # g/cm^3


@dataclass(frozen=True)
class NemaBody(Phantom):
    """The NEMA (IEC) body phantom: NEMA NU 2-2018 section 7, IEC 61675-1.

    The inside of the body is a half circle of radius 147 mm in front (+y), and two quarter circles of radius 77 mm with a
    straight line of 140 mm between them at the back; it is 180 mm long (commercial phantoms: about 194 mm). An insert of
    50 mm holds beads of 0.3 g/cm^3. The spheres lie around it, 70 mm from the lid (+z), on a circle of radius 57.2 mm: that
    of 17 mm towards +x, the others counter-clockwise by size, 60 degrees apart. That sense is not confirmed; OpenGATE's run
    clockwise. The origin is the middle of the spheres' circle, halfway between front and back, 35 mm in front of the
    body's circles' centres. Walls are not modelled. NU 2 asks for spheres 4 (or 8) times as active as a background of
    5.3 kBq/mL.
    """

    sphere_diameters: tuple[float, ...] = setting((10.0, 13.0, 17.0, 22.0, 28.0, 37.0), "mm", "inside; 0 for none", 0.0)
    sphere_activity: float = setting(21.2, "kBq/mL", "in the spheres", 0.0)
    background: float = setting(5.3, "kBq/mL", "in the body", 0.0)
    lung_diameter: float = setting(50.0, "mm", "of the lung insert; 0 for none", 0.0)
    length: float = setting(180.0, "mm", "of the body, inside")
    mu: float = setting(WATER_MU, "1/mm", "of the water", 0.0)

    title = "NEMA body phantom"

    def __post_init__(self) -> None:
        super().__post_init__()
        inside = f"{self.title}: sphere diameters"
        lung = self.lung_diameter
        require_at_most(lung, 2 * room(0.0, 0.0), f"{self.title}: lung diameter", "in the body")
        for diameter, (x, y) in zip(self.sphere_diameters, sphere_places(), strict=True):
            if not diameter:
                continue
            require_at_most(diameter, 2 * room(x, y), inside, "in the body")
            require_at_most(diameter, 2 * _TO_LID, inside, "beneath the lid")
            least = _TO_LID + diameter / 2
            if self.length < least * (1 - 1e-9):
                around = f"around a sphere of {diameter:g} mm"
                raise InputError(f"{self.title}: length: expected at least {least:g} mm {around}, got {self.length:g}")
            if lung:
                require_at_most(diameter, 2 * _RING_RADIUS - lung, inside, f"beside a lung insert of {lung:g} mm")
        require_apart(self.sphere_diameters, _RING_RADIUS, inside)

    @cached_property
    def shapes(self) -> Sequence[Shape]:
        """Body, lung insert, spheres."""
        y, z, half = _CIRCLES_Y, _TO_LID - self.length / 2, _BACK_WIDTH / 2
        water: dict[str, Any] = {"activity": self.background, "mu": self.mu}
        tube: dict[str, Any] = {"height": self.length, **water}
        shapes: list[Shape] = [
            Cylinder(radius=_FRONT_RADIUS, position=(0, y, z), cut=[(0, -1, 0, 0)], name="front", **tube),
            Cylinder(radius=_BACK_RADIUS, position=(-half, y, z), name="left back", **tube),
            Cylinder(radius=_BACK_RADIUS, position=(half, y, z), name="right back", **tube),
            # The box reaches into the half circle, so that there is no seam between them.
            Box(size=(_BACK_WIDTH, 2 * _BACK_RADIUS, self.length), position=(0, y, z), name="back", **water),
        ]
        if self.lung_diameter:
            lung: dict[str, Any] = {"activity": 0.0, "mu": _LUNG_DENSITY * self.mu, "name": "lung insert"}
            shapes.append(Cylinder(radius=self.lung_diameter / 2, height=self.length, position=(0, 0, z), **lung))
        places = [(*place, 0.0) for place in sphere_places()]
        return [*shapes, *spheres(self.sphere_diameters, places, activity=self.sphere_activity, mu=self.mu)]


def sphere_places() -> list[tuple[float, float]]:
    """x and y of the spheres' centres, mm, in the order of their diameters."""
    return ring_places(_RING_RADIUS, -120.0)


def room(x: float, y: float) -> float:
    """Distance, mm, from a point inside the body to its outline; negative outside."""
    x, y = abs(x), y - _CIRCLES_Y
    front = math.hypot(x, y) if y > 0 else x
    aside, behind = x - _BACK_WIDTH / 2, -y
    back = math.hypot(aside, behind) if min(aside, behind) > 0 else max(aside, behind)
    return min(_FRONT_RADIUS - front, _BACK_RADIUS - back)
