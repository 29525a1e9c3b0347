"""The body phantom of IEC 61675-1 and NEMA NU 2: six spheres and a lung insert in a torso of water."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ..errors import InputError
from ..physics.isotopes import WATER_MU
from .phantom import Phantom
from .settings import require_apart, require_at_most, setting
from .shapes import Box, Cylinder, Shape, Sphere

# Inside, mm: the front is half a circle, the back a straight line between two quarters of circles.
_FRONT_RADIUS, _BACK_RADIUS, _BACK_WIDTH = 147.0, 77.0, 140.0
_CIRCLES_Y = -(_FRONT_RADIUS - _BACK_RADIUS) / 2  # of the circles' centres
_RING_RADIUS = 57.2  # of the spheres' centres
_TO_LID = 70.0  # from the spheres' plane
_LUNG_DENSITY = 0.3  # g/cm^3


@dataclass(frozen=True)
class NemaBody(Phantom):
    """The NEMA (IEC) body phantom: NEMA NU 2-2018 section 7, IEC 61675-1.

    Its inside: half a circle of radius 147 mm in front (+y), two quarters of circles of radius 77 mm and a straight line
    of 140 mm at the back, 180 mm long (phantoms that are sold are about 194 mm); spheres of 10, 13, 17, 22, 28,
    37 mm around an insert of 50 mm that is filled with beads of 0.3 g/cm^3, on a circle of radius 57.2 mm, 70 mm from the
    lid (+z). The 17 mm sphere lies towards +x, the others follow counter-clockwise by size, 60 degrees apart: in which
    sense is not confirmed, OpenGATE's run clockwise. The origin is the middle of the spheres' circle; it lies halfway
    between front and back, 35 mm in front of the circles' centres. Walls are not modelled.

    Attributes
    ----------
    sphere_diameters : (6,)
        mm; 0 leaves one out.
    sphere_activity, background : float
        kBq/mL; NU 2 asks for 4 to 1 (or 8 to 1) over 5.3 kBq/mL.
    lung_diameter : float
        mm; 0 leaves the insert out.
    length : float
        Inside, mm.
    mu : float
        Of the water, 1/mm.
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
        require_at_most(lung, 2 * _room(0.0, 0.0), f"{self.title}: lung diameter", "mm", "in the body")
        for diameter, (x, y) in zip(self.sphere_diameters, _ring(), strict=True):
            if not diameter:
                continue
            require_at_most(diameter, 2 * _room(x, y), inside, "mm", "in the body")
            require_at_most(diameter, 2 * _TO_LID, inside, "mm", "beneath the lid")
            least = _TO_LID + diameter / 2
            if self.length < least * (1 - 1e-9):
                raise InputError(
                    f"{self.title}: length: expected at least {least:g} mm around a sphere of {diameter:g} mm, "
                    f"got {self.length:g}"
                )
            if lung:
                require_at_most(diameter, 2 * _RING_RADIUS - lung, inside, "mm", f"beside a lung insert of {lung:g} mm")
        require_apart(self.sphere_diameters, _RING_RADIUS, inside)

    @cached_property
    def shapes(self) -> Sequence[Shape]:
        """Body, lung insert, spheres."""
        z = _TO_LID - self.length / 2
        y = _CIRCLES_Y
        water: dict[str, Any] = {"activity": self.background, "mu": self.mu}
        half = _BACK_WIDTH / 2
        # The box reaches into the half circle: no seam between them.
        shapes: list[Shape] = [
            Cylinder(
                radius=_FRONT_RADIUS, height=self.length, position=(0, y, z), cut=[(0, -1, 0, 0)], name="front", **water
            ),
            *(
                Cylinder(radius=_BACK_RADIUS, height=self.length, position=(x, y, z), name=f"{side} back", **water)
                for x, side in ((-half, "left"), (half, "right"))
            ),
            Box(size=(_BACK_WIDTH, 2 * _BACK_RADIUS, self.length), position=(0, y, z), name="back", **water),
        ]
        if self.lung_diameter:
            shapes.append(
                Cylinder(
                    radius=self.lung_diameter / 2,
                    height=self.length,
                    position=(0, 0, z),
                    activity=0.0,
                    mu=_LUNG_DENSITY * self.mu,
                    name="lung insert",
                )
            )
        for diameter, (x, y) in zip(self.sphere_diameters, _ring(), strict=True):
            if diameter:
                shapes.append(
                    Sphere(
                        radius=diameter / 2,
                        activity=self.sphere_activity,
                        mu=self.mu,
                        name=f"sphere {diameter:g} mm",
                        position=(x, y, 0.0),
                    )
                )
        return shapes


def _ring() -> list[tuple[float, float]]:
    """x and y of the spheres' centres, mm."""
    angles = [math.radians(60.0 * (i - 2)) for i in range(6)]
    return [(_RING_RADIUS * math.cos(angle), _RING_RADIUS * math.sin(angle)) for angle in angles]


def _room(x: float, y: float) -> float:
    """Distance, mm, from a point inside to the body's outline."""
    x, y = abs(x), y - _CIRCLES_Y
    front = math.hypot(x, y) if y > 0 else x
    aside, behind = x - _BACK_WIDTH / 2, -y
    back = math.hypot(aside, behind) if min(aside, behind) > 0 else max(aside, behind)
    return min(_FRONT_RADIUS - front, _BACK_RADIUS - back)
