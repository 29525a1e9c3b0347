"""Knife edge and crystal of a module, where they make its pinhole response depend on the photons' direction."""

import math
from dataclasses import dataclass, replace
from typing import Self

from ..physics.aperture import KnifeEdge
from ..physics.crystal import recorded_depths
from ..physics.optics import Optics


@dataclass(frozen=True)
class DirectionalEffects:
    """Knife edge and crystal of a module, as far as they make its pinhole response depend on the photons' direction."""

    knife: KnifeEdge | None
    """Edge of the hole, where photons penetrate it by path."""
    crystal_mu: float
    """Attenuation coefficient of the crystal, 1/mm, where photons are recorded at their depth; else 0."""
    thickness: float
    """Thickness of the crystal, mm."""
    mean_depth: float
    """Depth of the image's plane behind the crystal's front face, mm: the mean depth of interaction along the axis."""
    depth_deviation: float
    """Standard deviation of the depth of interaction along the axis, mm."""

    @classmethod
    def from_optics(cls, optics: Optics, diameter: float, thickness: float) -> Self:
        """Return the effects for a hole of this diameter, mm, and a crystal of this thickness, mm."""
        knife = None
        if optics.edge == "path":
            plate = optics.plate_thickness
            knife = KnifeEdge(diameter / 2, float(optics.aperture_mu), float(optics.tangent), plate and float(plate))
        if optics.depth_layers == 1:
            return cls(knife, 0.0, thickness, 0.0, 0.0)
        mu = float(optics.crystal_mu)
        return cls(knife, mu, thickness, *recorded_depths(mu, thickness))

    def with_effective_diameter(self, diameter: float) -> Self:
        """Return the effects for a hole of another effective diameter by Paix, mm."""
        if self.knife is None:
            return self
        depth = self.knife.tangent / self.knife.mu
        return replace(self, knife=replace(self.knife, radius=(math.hypot(diameter, depth) - depth) / 2))

    @property
    def edge_decay(self) -> float:
        """Distance beyond the rim, mm, in which the transmittance along the axis falls by a factor of e."""
        return 0.0 if self.knife is None else self.knife.tangent / (2 * self.knife.mu)
