"""The solids of all modules in the world, for checks and for files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .collimator import Collimator, Construction
from .collimator_mesh import Solid, collimator_solid, crystal_solid
from .system import PinholeSystem

PartKind = Literal["collimator", "crystal"]


class Look(NamedTuple):
    """How a part is shown: linear RGBA colour, metallic and roughness from 0 to 1."""

    color: tuple[float, float, float, float]
    metallic: float
    roughness: float


LOOKS: dict[PartKind, Look] = {
    "collimator": Look((0.36, 0.39, 0.43, 1.0), metallic=0.85, roughness=0.42),  # tungsten: grey metal
    "crystal": Look((1.0, 0.48, 0.06, 0.85), metallic=0.0, roughness=0.12),  # scintillator: clear amber
}
"""In Blender and in exported solids."""


@dataclass(frozen=True, eq=False)
class ModulePart:
    """The collimator, with its aperture plate, or the crystal of the module with that number.

    `name`, such as "Module 07 collimator", sorts like the modules' numbers. `solid` is in the module's camera space (see
    `core.geometry.collimator_mesh`), and `pose` (4, 4) is world from camera space, mm.
    """

    number: int
    kind: PartKind
    name: str
    solid: Solid
    pose: NDArray[np.float64]

    @property
    def vertices(self) -> NDArray[np.float64]:
        """(V, 3), world mm."""
        return self.to_world(self.solid[0])

    @property
    def triangles(self) -> NDArray[np.int32]:
        """(F, 3), counter-clockwise seen from outside."""
        return self.solid[1][:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)

    def to_world(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """World mm of points (N, 3) of camera space."""
        return points @ self.pose[:3, :3].T + self.pose[:3, 3]


def module_collimators(system: PinholeSystem, construction: Construction) -> list[Collimator]:
    """Each module's collimator; `InputError` names a module whose collimator cannot be built like that."""
    made = []
    sizes = (system.pinhole_diameter, system.collimator_length, system.detector_side)
    for number, d, l, side in zip(system.numbers.tolist(), *(size.tolist() for size in sizes), strict=True):
        try:
            made.append(Collimator(d, l, side, construction))
        except InputError as error:
            raise InputError(f"module {number}: {error}") from None
    return made


def module_parts(system: PinholeSystem, construction: Construction | None = None) -> list[ModulePart]:
    """Collimator and crystal of each module, module by module. Errors as in `module_collimators`."""
    collimators = module_collimators(system, construction or Construction())
    poses = system.poses()
    poses[:, :3, [0, 2]] *= -1  # camera space is X = -u, Y = v, Z = -k
    width = max(2, len(str(system.numbers.max())))
    parts = []
    for number, pose, built, thickness in zip(
        system.numbers.tolist(), poses, collimators, system.detector_thickness.tolist(), strict=True
    ):
        name = f"Module {number:0{width}d}"
        crystal = crystal_solid(built.length, built.detector_side, thickness)
        parts.append(ModulePart(number, "collimator", f"{name} collimator", collimator_solid(built), pose))
        parts.append(ModulePart(number, "crystal", f"{name} crystal", crystal, pose))
    return parts
