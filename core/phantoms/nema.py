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
from .shapes import Box, Cylinder, Shape, make_spheres, ring_positions

# The body's inner outline, mm: a half circle in front, a straight line between two quarter circles at the back.
_FRONT_RADIUS, _BACK_RADIUS, _BACK_WIDTH = 147.0, 77.0, 140.0
_CIRCLES_Y = -(_FRONT_RADIUS - _BACK_RADIUS) / 2  # y of the centres of the outline's circles, mm
_RING_RADIUS = 57.2  # radius of the circle through the spheres' centres, mm
_LID_HEIGHT = 70.0  # distance of the lid from the plane of the spheres' centres, mm
_LUNG_DENSITY = 0.3  # g/cm^3


@dataclass(frozen=True)
class NemaBody(Phantom):
    """The NEMA (IEC) body phantom: NEMA NU 2-2018 section 7, IEC 61675-1.

    The body's inner outline is a half circle of radius 147 mm in front (+y), and two quarter circles of radius 77 mm with a
    straight line of 140 mm between them at the back; the body is 180 mm long (commercial phantoms: about 194 mm). An insert
    of 50 mm diameter contains beads of 0.3 g/cm^3. The spheres lie around it, 70 mm from the lid (+z), on a circle of radius
    57.2 mm, 60 degrees apart: the sphere of 17 mm towards +x, the next larger ones counter-clockwise. That direction is not
    confirmed; in OpenGATE the spheres run clockwise. The origin is the centre of the spheres' circle, halfway between front
    and back, 35 mm in front of the centres of the outline's circles. Walls are not modelled. NU 2 asks for spheres 4 (or 8)
    times as active as a background of 5.3 kBq/mL.
    """

    sphere_diameters: tuple[float, ...] = setting((10.0, 13.0, 17.0, 22.0, 28.0, 37.0), "mm", "inside; 0 for none", 0.0)
    sphere_activity: float = setting(21.2, "kBq/mL", "activity of the spheres", 0.0)
    background: float = setting(5.3, "kBq/mL", "activity of the body", 0.0)
    lung_diameter: float = setting(50.0, "mm", "diameter of the lung insert; 0 for none", 0.0)
    length: float = setting(180.0, "mm", "inner length of the body")
    mu: float = setting(WATER_MU, "1/mm", "attenuation coefficient of the water", 0.0)

    title = "NEMA body phantom"

    def __post_init__(self) -> None:
        super().__post_init__()
        name, lung = f"{self.title}: sphere diameters", self.lung_diameter
        require_at_most(lung, 2 * outline_distance(0.0, 0.0), f"{self.title}: lung diameter", "in the body")
        for diameter, (x, y) in zip(self.sphere_diameters, sphere_positions(), strict=True):
            if not diameter:
                continue
            require_at_most(diameter, 2 * outline_distance(x, y), name, "in the body")
            require_at_most(diameter, 2 * _LID_HEIGHT, name, "beneath the lid")
            shortest = _LID_HEIGHT + diameter / 2
            if self.length < shortest * (1 - 1e-9):
                expected = f"at least {shortest:g} mm around a sphere of {diameter:g} mm"
                raise InputError(f"{self.title}: length: expected {expected}, got {self.length:g}")
            if lung:
                require_at_most(diameter, 2 * _RING_RADIUS - lung, name, f"beside a lung insert of {lung:g} mm")
        require_apart(self.sphere_diameters, _RING_RADIUS, name)

    @cached_property
    def shapes(self) -> Sequence[Shape]:
        """Body (four overlapping parts), lung insert and spheres."""
        y, z, half = _CIRCLES_Y, _LID_HEIGHT - self.length / 2, _BACK_WIDTH / 2
        water: dict[str, Any] = {"activity": self.background, "mu": self.mu}
        tube: dict[str, Any] = {"height": self.length, **water}
        shapes: list[Shape] = [
            Cylinder(radius=_FRONT_RADIUS, position=(0, y, z), cut=[(0, -1, 0, 0)], name="front", **tube),
            Cylinder(radius=_BACK_RADIUS, position=(-half, y, z), name="left back", **tube),
            Cylinder(radius=_BACK_RADIUS, position=(half, y, z), name="right back", **tube),
            # The box extends into the half circle, so that there is no gap between them.
            Box(size=(_BACK_WIDTH, 2 * _BACK_RADIUS, self.length), position=(0, y, z), name="back", **water),
        ]
        if self.lung_diameter:
            lung: dict[str, Any] = {"activity": 0.0, "mu": _LUNG_DENSITY * self.mu, "name": "lung insert"}
            shapes.append(Cylinder(radius=self.lung_diameter / 2, height=self.length, position=(0, 0, z), **lung))
        positions = [(*xy, 0.0) for xy in sphere_positions()]
        return [*shapes, *make_spheres(self.sphere_diameters, positions, activity=self.sphere_activity, mu=self.mu)]


def sphere_positions() -> list[tuple[float, float]]:
    """Return (x, y) of the spheres' centres, mm, in the order of their diameters."""
    return ring_positions(_RING_RADIUS, -120.0)


def outline_distance(x: float, y: float) -> float:
    """Return the distance, mm, from a point inside the NEMA body to its outline; negative outside."""
    x, y = abs(x), y - _CIRCLES_Y
    front = math.hypot(x, y) if y > 0 else x
    dx, dy = x - _BACK_WIDTH / 2, -y  # from the centre of a quarter circle, outwards and backwards
    back = math.hypot(dx, dy) if min(dx, dy) > 0 else max(dx, dy)
    return min(_FRONT_RADIUS - front, _BACK_RADIUS - back)
