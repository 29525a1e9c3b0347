"""The Defrise phantom: hot disks perpendicular to the axis, which show where data along the axis are missing."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..physics.materials import WATER_MU
from .phantom import Phantom
from .settings import count, require_at_most, setting
from .shapes import Cylinder, Shape


@dataclass(frozen=True)
class DefrisePhantom(Phantom):
    """Hot disks in a cylinder of water along z, centred on the origin.

    After M. Defrise et al., "A solution to the long-object problem in helical cone-beam tomography", Physics in Medicine
    and Biology 45 (2000) 623-643. By default it fills a ball of 75 mm radius.
    """

    disks: int = count(7, "number of disks")
    disk_radius: float = setting(50.0, "mm", "radius of the disks")
    disk_thickness: float = setting(8.0, "mm", "thickness of the disks")
    spacing: float = setting(16.0, "mm", "distance between the centres of adjacent disks", option="spacing-of-disks")
    margin: float = setting(5.0, "mm", "thickness of the water around the disks; 0 for none", 0.0)
    activity: float = setting(100.0, "kBq/mL", "activity of the disks", 0.0)
    background: float = setting(0.0, "kBq/mL", "activity of the water", 0.0)
    mu: float = setting(WATER_MU, "1/mm", "attenuation coefficient of disks and water", 0.0)

    title = "Defrise phantom"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.disks > 1:
            require_at_most(self.disk_thickness, self.spacing, f"{self.title}: disk thickness", "from disk to disk")

    @cached_property
    def shapes(self) -> Sequence[Shape]:
        """Cylinder of water, if the margin is above 0, and the disks from -z to +z."""
        height = (self.disks - 1) * self.spacing + self.disk_thickness
        shapes: list[Shape] = []
        if self.margin:
            radius, height = self.disk_radius + self.margin, height + 2 * self.margin
            shapes.append(Cylinder(radius=radius, height=height, activity=self.background, mu=self.mu, name="water"))
        disk = Cylinder(radius=self.disk_radius, height=self.disk_thickness, activity=self.activity, mu=self.mu)
        heights = (np.arange(self.disks) - (self.disks - 1) / 2) * self.spacing
        return shapes + [replace(disk, position=(0, 0, z), name=f"disk {i}") for i, z in enumerate(heights, 1)]
