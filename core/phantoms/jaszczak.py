"""The Jaszczak phantom: rods and spheres, usually cold, in a cylinder of active water."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from ..physics.materials import WATER_MU, attenuation
from .derenzo import DerenzoRods
from .phantom import Phantom
from .settings import require_apart, require_at_most, setting
from .shapes import Cylinder, Shape, make_spheres, ring_positions


@dataclass(frozen=True)
class JaszczakPhantom(Phantom):
    """The Jaszczak phantom (Deluxe, model ECT/DLX/P) along z, with the origin at the cylinder's centre.

    The dimensions are those of Data Spectrum's data sheet: a cylinder 216 mm wide and 186 mm high inside; rods in six
    sectors, 88 mm high, their centres two diameters apart; spheres with their centres 127 mm above the base. The rods stand
    on the base (-z) in the pattern of `DerenzoRods`. The data sheet does not give the spheres' distance from the axis: here
    it is half the radius, and they lie 60 degrees apart, counter-clockwise from -y. The wall, 3.2 mm thick, is not modelled.
    Rods and spheres without activity are made of PMMA, all others of water.
    """

    radius: float = setting(108.0, "mm", "inner radius of the cylinder")
    height: float = setting(186.0, "mm", "inner height of the cylinder")
    rod_diameters: tuple[float, ...] = setting((4.8, 6.4, 7.9, 9.5, 11.1, 12.7), "mm", "of each sector; 0: none", 0.0)
    rod_height: float = setting(88.0, "mm", "length of the rods")
    sphere_diameters: tuple[float, ...] = setting((9.5, 12.7, 15.9, 19.1, 25.4, 31.8), "mm", "0 for no sphere", 0.0)
    sphere_height: float = setting(127.0, "mm", "height of the spheres' centres above the base")
    sphere_ring_radius: float = setting(54.0, "mm", "distance of the spheres' centres from the axis", 0.0)
    activity: float = setting(50.0, "kBq/mL", "activity of the water", 0.0)
    rod_activity: float = setting(0.0, "kBq/mL", "activity of the rods", 0.0)
    sphere_activity: float = setting(0.0, "kBq/mL", "activity of the spheres", 0.0)
    mu: float = setting(WATER_MU, "1/mm", "attenuation coefficient of the water", 0.0)

    title = "Jaszczak phantom"

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(self.rod_diameters):
            require_at_most(self.rod_height, self.height, f"{self.title}: rod height", "in the cylinder")
        if any(self.sphere_diameters):
            ring, height = self.sphere_ring_radius, self.sphere_height
            require_at_most(ring, self.radius, f"{self.title}: sphere ring radius", "in the cylinder")
            require_at_most(height, self.height, f"{self.title}: sphere height", "in the cylinder")
            name, largest = f"{self.title}: sphere diameters", max(self.sphere_diameters)
            require_at_most(largest, 2 * (self.radius - ring), name, f"at {ring:g} mm from the axis")
            require_at_most(largest, 2 * height, name, f"at {height:g} mm above the base")
            depth = self.height - height
            require_at_most(largest, 2 * depth, name, f"at {depth:g} mm below the top")
            require_apart(self.sphere_diameters, ring, name)

    @cached_property
    def shapes(self) -> Sequence[Shape]:
        """Cylinder of water, rods and spheres."""
        base, plastic_mu = -self.height / 2, attenuation("PMMA", self.mu_energy)
        water = Cylinder(radius=self.radius, height=self.height, activity=self.activity, mu=self.mu, name="water")
        shapes: list[Shape] = [water]
        if any(self.rod_diameters):
            rods = DerenzoRods(radius=self.radius, rod_diameters=self.rod_diameters, height=self.rod_height,
                               name="rods", position=(0, 0, base + self.rod_height / 2), activity=self.rod_activity,
                               mu=self.mu if self.rod_activity else plastic_mu)  # fmt: skip
            shapes.append(rods)
        positions = [(*xy, base + self.sphere_height) for xy in ring_positions(self.sphere_ring_radius, -90.0)]
        mu = self.mu if self.sphere_activity else plastic_mu
        return [*shapes, *make_spheres(self.sphere_diameters, positions, activity=self.sphere_activity, mu=mu)]
