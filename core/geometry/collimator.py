"""Shape of a module's collimator: a plate with a knife-edged pinhole, and walls behind it.

The mesh, the solids in files and in Monte Carlo programs, the geometry checks and the physics of the knife edge all use
this one description. Depths are along the module's axis, mm from the pinhole's centre, positive towards the crystal. From
front to back:

- The hole is narrowest at depth 0, where its diameter is d, and opens as a double cone of full angle alpha through the
  whole plate: its radius at depth s is ``d/2 + |s| tan(alpha/2)``.
- The plate's faces are at `Construction.front` and `Construction.back`. The knife edge lies in the plate's middle, or on
  the face towards the ROI (front) or towards the crystal (back).
- Behind the plate is a channel, a square frustum that ends at the crystal's front face with the crystal's side. It is
  never narrower than the pyramid that the crystal sees through the hole, of half-width ``d/2 + (Ld - d)/2 * s/l``.
- The outside is a square frustum, everywhere at least a wall's thickness outside the hole and the channel.

So a ray from the front that passes the hole at depth 0, is no steeper than the cone and meets the crystal's front face
touches nothing. Any other way to that face leads through the plate or a wall.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ..errors import InputError
from ..validation import one_of, positive

EdgePlace = Literal["middle", "front", "back"]

OPENING_ANGLE = math.pi / 2
"""Default full angle of the knife edge's double cone, rad."""

_SHOULDER = 0.01  # the channel begins wider than the hole by this fraction of the free width around the hole


def edge_slope(opening_angle: float) -> float:
    """Return ``tan(alpha / 2)``, the growth of a knife-edged hole's radius per distance from the edge."""
    return math.tan(opening_angle / 2)


def angle_from_degrees(degrees: float, name: str = "opening_degrees") -> float:
    """Return an opening angle, given in degrees, in rad; raise `InputError` unless it is between 0 and 180 degrees."""
    if (degrees := positive(degrees, name, "degrees")) >= 180:
        raise InputError(f"{name}: expected less than 180 degrees, got {degrees:g}")
    return math.radians(degrees)


@dataclass(frozen=True)
class Construction:
    """Construction of a scanner's collimators: thicknesses of plates and walls, mm, and the knife edge.

    `opening_angle` is the full angle alpha of the hole's double cone, rad. `edge_at` is the place of the edge in the plate;
    front is the face towards the ROI. The edge is always at the pinhole's centre, so `edge_at` moves the plate.
    """

    plate_thickness: float = 2.0
    wall_thickness: float = 2.0
    opening_angle: float = OPENING_ANGLE
    edge_at: EdgePlace = "middle"

    def __post_init__(self) -> None:
        object.__setattr__(self, "plate_thickness", positive(self.plate_thickness, "aperture plate", "mm"))
        object.__setattr__(self, "wall_thickness", positive(self.wall_thickness, "collimator wall", "mm"))
        object.__setattr__(self, "opening_angle", positive(self.opening_angle, "opening_angle", "rad"))
        if self.opening_angle >= math.pi:
            raise InputError(f"opening_angle: expected less than pi, got {self.opening_angle:g} rad")
        one_of(self.edge_at, get_args(EdgePlace), "edge_at")

    @property
    def front(self) -> float:
        """Depth of the plate's face towards the ROI, mm, at most 0."""
        return {"middle": -0.5, "front": 0.0, "back": -1.0}[self.edge_at] * self.plate_thickness

    @property
    def back(self) -> float:
        """Depth of the plate's face towards the crystal, mm, at least 0."""
        return self.front + self.plate_thickness


@dataclass(frozen=True)
class Collimator:
    """Collimator of one module."""

    diameter: float  # d of the pinhole, mm
    length: float  # l from the pinhole's centre to the crystal's front face, mm
    detector_side: float  # Ld of the crystal, mm
    construction: Construction = Construction()

    def __post_init__(self) -> None:
        plate, angle = self.construction.plate_thickness, math.degrees(self.construction.opening_angle)
        crystal = f"less than the crystal's {self.detector_side:g} mm"
        if not plate < self.length:
            length = f"the collimator's {self.length:g} mm"
            raise InputError(f"aperture plate: expected less than {length}, got {plate:g} mm")
        if not 0 < self.diameter < self.detector_side:
            raise InputError(f"pinhole diameter: expected more than 0 and {crystal}, got {self.diameter:g} mm")
        width = 2 * max(radius for _, radius in self.hole_profile)
        if not width < self.detector_side:
            hole = f"with {plate:g} mm and an opening angle of {angle:g} degrees its hole is {width:.4g} mm wide"
            advice = "choose a thinner plate or a smaller angle"
            raise InputError(f"aperture plate: {hole}, expected {crystal}; {advice}")

    def hole_radius(self, depth: float) -> float:
        """Return the hole's radius, mm, at a depth s within the plate: ``d/2 + |s| tan(alpha/2)``."""
        return self.diameter / 2 + abs(depth) * edge_slope(self.construction.opening_angle)

    @property
    def hole_profile(self) -> list[tuple[float, float]]:
        """Corners (depth, radius), mm, of the hole's profile from the plate's front to its back: 2 or 3 of them."""
        faces = (self.construction.front, 0.0, self.construction.back)
        return [(depth, self.hole_radius(depth)) for depth in dict.fromkeys(faces)]

    @property
    def channel_half_width(self) -> float:
        """Half-width, mm, of the channel at the plate's back, where it begins; at the crystal it is Ld/2."""
        back, d = self.construction.back, self.diameter
        return max(d / 2 + (self.detector_side - d) / 2 * back / self.length, self._shoulder)

    @property
    def front_half_width(self) -> float:
        """Half-width, mm, of the plate's front face; at the crystal, the outside has the half-width Ld/2 + wall."""
        return max(self.hole_radius(self.construction.front), self._shoulder) + self.construction.wall_thickness

    @property
    def _shoulder(self) -> float:
        """Half-width, mm, of a square slightly wider than the hole's rim at the plate's back."""
        rim = self.hole_radius(self.construction.back)
        return rim + _SHOULDER * (self.detector_side / 2 - rim)

    @property
    def rings(self) -> list[tuple[Literal["circle", "square"], float, float]]:
        """Outline, half-width and depth, mm, of the rings of the surface: along the hole, the channel, and back outside."""
        construction, half_side = self.construction, self.detector_side / 2
        return [
            *(("circle", radius, depth) for depth, radius in self.hole_profile),  # type: ignore[list-item]
            ("square", self.channel_half_width, construction.back),
            ("square", half_side, self.length),
            ("square", half_side + construction.wall_thickness, self.length),
            ("square", self.front_half_width, construction.front),
        ]

    def open_share(self, slope: float) -> float:
        """Return the fraction of the hole's area that is open to parallel rays of the `slope` tan(angle to the axis) >= 0.

        A ray passes if it is within the hole at the edge and at both faces of the plate, because the hole consists of
        cones. So the open area is the intersection of three discs, shifted along the rays.
        """
        n = 512
        across = self.diameter / 2 * np.sin((np.arange(n) + 0.5) / n * np.pi / 2)  # half of the symmetric disc
        low, high = np.full(n, -np.inf), np.full(n, np.inf)  # ends of the open chord at each `across`, mm
        for depth, radius in self.hole_profile:
            half_chord = np.sqrt(np.maximum(radius**2 - across**2, 0.0))
            low, high = np.maximum(low, -depth * slope - half_chord), np.minimum(high, -depth * slope + half_chord)
        # The steps are even in an angle, because the chords' lengths behave like a square root at the disc's rim.
        steps = self.diameter / 2 * np.cos((np.arange(n) + 0.5) / n * np.pi / 2) * (np.pi / 2 / n)
        return float(2 * (np.maximum(high - low, 0.0) * steps).sum() / (np.pi / 4 * self.diameter**2))


COLLIMATORS: Mapping[str, type[Collimator]] = {"square": Collimator}
"""Classes of collimators by the shape of their channel and outside; `PinholeSystem.collimators` makes them."""
