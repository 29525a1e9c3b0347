"""Base of the Monte Carlo formats: their options, and scanner and phantom as placed solids.

Every solid of a module has the module's axes: local x = u, y = v, z = k, towards the isocentre. A point of the crystal
therefore has the (x, y) of `PinholeSystem.views(detector="real")`. Lengths are in mm, times in s, activities in Bq, energies
in keV.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, NamedTuple, get_args, get_type_hints

import numpy as np

from ..arrays import Floats, Indexes
from ..errors import InputError
from ..geometry.collimator import Collimator, Construction, EdgePlace, angle_from_degrees
from ..geometry.frames import checked_affine, euler_pose
from ..geometry.system import PinholeSystem
from ..phantoms.derenzo import DerenzoPhantom
from ..physics.isotopes import Isotope, isotope
from ..physics.materials import MATERIALS
from ..validation import at_least_0, instance, one_of, positive, real_array

REFERENCE_ENERGY = 140.5
"""Energy, keV, at which the energy resolution is given."""

_MARGIN = 50.0  # mm of air between the farthest point of the scanner and the world's side
_TOLERANCE = 1e-6  # mm: modules whose lengths differ by less share a kind of solid

# Name in GATE -> state of matter; the material of the same name is in `MATERIALS`.
_STATES = {"Air": "gas", "Water": "liquid", **dict.fromkeys(("PMMA", "Tungsten", "Lead", "NaI", "CZT"), "solid")}
_ELEMENTS = {  # symbol -> name, atomic number, molar mass in g/mol
    "H": ("Hydrogen", 1, 1.008),
    "C": ("Carbon", 6, 12.011),
    "N": ("Nitrogen", 7, 14.007),
    "O": ("Oxygen", 8, 15.999),
    "Na": ("Sodium", 11, 22.990),
    "Ar": ("Argon", 18, 39.948),
    "Zn": ("Zinc", 30, 65.38),
    "Cd": ("Cadmium", 48, 112.414),
    "Te": ("Tellurium", 52, 127.60),
    "I": ("Iodine", 53, 126.904),
    "W": ("Tungsten", 74, 183.84),
    "Pb": ("Lead", 82, 207.2),
}


def material_database() -> str:
    """Return the text of a ``GateMaterials.db``, which GATE 9 and 10 both read."""
    lines = ["[Elements]"]
    lines += [f"{name}: S= {symbol} ; Z= {z}. ; A= {a} g/mole" for symbol, (name, z, a) in _ELEMENTS.items()]
    lines += ["", "[Materials]"]
    for name, state in _STATES.items():
        material = MATERIALS.get(name) or MATERIALS[name.lower()]
        lines.append(f"{name}: d={material.density:g} g/cm3 ; n={len(material.composition)} ; state={state}")
        if len(material.composition) == 1:  # the material is the element of the same name
            lines.append("        +el: name=auto ; n=1")
        else:
            lines += [f"        +el: name={_ELEMENTS[s][0]} ; f={share:g}" for s, share in material.composition.items()]
    return "\n".join(lines) + "\n"


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """Options of the Monte Carlo formats."""

    phantom: str | DerenzoPhantom = "point"  # "point", "derenzo" (radius, rods, height), or a phantom
    radius: float = 40.0  # radius of the phantom "derenzo", mm
    rods: tuple[float, ...] = (8.0, 6.0, 5.0, 4.0, 3.0, 2.0)  # rod diameters of the phantom "derenzo", mm
    height: float = 40.0  # length of the rods, mm
    position: tuple[float, ...] = (0.0, 0.0, 0.0)  # centre of the point source or phantom, mm
    euler_degrees: tuple[float, ...] = (0.0, 0.0, 0.0)  # phi, theta, psi of the phantom
    pose: Floats | None = None  # world from phantom (4, 4), rigid; replaces position and angles
    isotope: str | Isotope = "Tc-99m"  # nuclide whose photons are emitted independently
    activity: float | None = None  # total activity at the start, MBq; None: 1, or that of a `DerenzoPhantom`
    time: float = 1.0  # acquisition time, s
    crystal: Literal["NaI", "CZT"] = "NaI"  # material of the crystals
    collimator: Literal["Tungsten", "Lead"] = "Tungsten"  # material of the collimators
    phantom_material: Literal["Air", "Water", "PMMA"] = "Air"  # air has little attenuation
    plate_thickness: float = 2.0  # thickness of the aperture plate, mm
    wall_thickness: float = 2.0  # thickness of the collimator's walls, mm
    opening_degrees: float = 90.0  # opening angle of the knife edge, degrees
    edge_at: EdgePlace = "middle"  # position of the knife edge in the plate, see `Construction`
    intrinsic_fwhm: float = 3.0  # spatial resolution (FWHM) of the crystal, mm; 0: perfect
    energy_resolution: float = 0.1  # FWHM / energy at `REFERENCE_ENERGY`, proportional to 1 / sqrt(energy); 0: perfect
    window_percent: float = 20.0  # full width of the energy window around the strongest photon line, %
    seed: int = 1  # seed of the random numbers

    def __post_init__(self) -> None:
        positive(self.time, "time", "s")
        if positive(self.window_percent, "window_percent", "%") >= 200:
            raise InputError(f"window_percent: expected less than 200, got {self.window_percent:g}")
        for name in ("intrinsic_fwhm", "energy_resolution"):
            at_least_0(getattr(self, name), name)
        types = get_type_hints(Simulation)
        for name in ("crystal", "collimator", "phantom_material"):
            one_of(getattr(self, name), get_args(types[name]), name)
        # All of Geant4's random engines accept seeds below 900 000 000 (CLHEP's HepJamesRandom has this limit).
        seed = real_array(self.seed, "seed", ())
        if seed != int(seed) or not 0 < seed < 900_000_000:
            raise InputError(f"seed: expected a whole number from 1 to 899999999, got {self.seed!r}")
        _ = self.construction, self.nuclide, self.derenzo, self.becquerels, self.world_from_phantom

    @cached_property
    def derenzo(self) -> DerenzoPhantom | None:
        """The Derenzo phantom; None for a point source."""
        if isinstance(self.phantom, DerenzoPhantom):
            return self.phantom
        if self.phantom not in ("point", "derenzo"):
            raise InputError(f"phantom {self.phantom!r}: expected point, derenzo or a DerenzoPhantom")
        return DerenzoPhantom(self.radius, self.rods, self.height) if self.phantom == "derenzo" else None

    @cached_property
    def nuclide(self) -> Isotope:
        """The isotope, with its photon lines and half-life."""
        if isinstance(self.isotope, str):
            return isotope(self.isotope)
        instance(self.isotope, Isotope, "isotope")
        return self.isotope

    @cached_property
    def becquerels(self) -> float:
        """The total activity at the start, Bq."""
        if self.activity is not None:
            return positive(self.activity, "activity", "MBq") * 1e6
        return self.phantom.total_activity * 1e3 if isinstance(self.phantom, DerenzoPhantom) else 1e6

    @cached_property
    def world_from_phantom(self) -> Floats:
        """The phantom's pose (4, 4), world from phantom, from `pose` or from `position` and `euler_degrees`."""
        if self.pose is None:
            phi, theta, psi = np.radians(real_array(self.euler_degrees, "euler_degrees", (3,)))
            return euler_pose(phi, theta, psi, real_array(self.position, "position", (3,)))
        pose = checked_affine(self.pose, "phantom pose")
        rotation = pose[:3, :3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9) or np.linalg.det(rotation) < 0:
            raise InputError("phantom pose: expected a rotation and a translation; solids are not scaled or mirrored")
        return pose

    @cached_property
    def construction(self) -> Construction:
        """The construction of the collimators: thicknesses, opening angle and position of the edge."""
        angle = angle_from_degrees(self.opening_degrees)
        return Construction(self.plate_thickness, self.wall_thickness, angle, self.edge_at)

    @property
    def window(self) -> tuple[float, float]:
        """The energy window (low, high), keV."""
        energy, _ = max(self.nuclide.lines, key=lambda line: line[1])
        half = self.window_percent / 200
        return energy * (1 - half), energy * (1 + half)


_Section = tuple[float, float]
"""Depth and half-width of a cross-section, mm."""


class PlacedSolids(NamedTuple):
    """N equal solids, placed in a mother volume.

    `size` depends on the shape: ``box``: sides x, y, z; ``trd``: half-widths at -z and +z of a square frustum, and its
    height; ``cone``: radii at -z and +z, height; ``cylinder``: radius, height.
    """

    name: str  # name of the volume in GATE
    mother: str  # name of the mother volume
    shape: Literal["box", "trd", "cone", "cylinder"]
    size: tuple[float, ...]  # mm, by the shape
    material: str  # name of the material in GATE
    centers: Floats  # (N, 3), mm, in the mother's frame
    rotations: Floats  # (N, 3, 3), with the solid's axes in the mother's frame as columns


class GateGeometry(NamedTuple):
    """Solids of the scanner and of the phantom in a simulation, and the activity of the rods."""

    collimators: list[list[PlacedSolids]]  # by kind: the collimators, then the pieces of air in each
    crystals: list[tuple[PlacedSolids, Indexes]]  # by size: the crystals, and the indices of their modules
    phantom: PlacedSolids | None  # body of the phantom; None for a point source
    rods: list[tuple[PlacedSolids, float]]  # by sector: the rods in the phantom, and their total activity, Bq
    world: float  # side of the surrounding cube of air, mm


def build_geometry(system: PinholeSystem, simulation: Simulation) -> GateGeometry:
    """Return the solids of scanner and phantom; `InputError` where a collimator begins inside the phantom.

    Modules of equal sizes share a kind of collimator, the body of `core.geometry.collimator`: a solid square frustum that
    holds, as air, the channel and the hole, a cone on each side of the knife edge.
    """
    instance(system, PinholeSystem, "a simulation by GATE")
    poses = system.poses()
    bodies = system.collimators(simulation.construction)
    l, side, thickness = system.collimator_length, system.detector_side, system.detector_thickness
    kinds, material = enumerate(_group_equal(l, system.pinhole_diameter, side, thickness), 1), simulation.collimator
    collimators = [_collimator_solids(f"collimator_{i}", poses[m], bodies[m[0]], material) for i, m in kinds]
    crystals, groups = [], _group_equal(side, thickness)
    for i, modules in enumerate(groups):
        size = (side[modules[0]], side[modules[0]], thickness[modules[0]])
        placement = _behind_pinholes(poses[modules], l[modules] + size[2] / 2)
        name = "crystal" if len(groups) == 1 else f"crystal{i + 1}"
        crystals.append((PlacedSolids(name, "world", "box", size, simulation.crystal, *placement), modules))
    phantom, rods = _phantom_solids(simulation)
    outermost = [parts[0] for parts in collimators] + [solids for solids, _ in crystals]
    if phantom is not None:
        _check_overlap(system, bodies, phantom)
        outermost.append(phantom)
    reach = np.abs(simulation.world_from_phantom[:3, 3]).max()
    for solids in outermost:
        radius, *_, height = solids.size
        half = np.array(solids.size) / 2 if solids.shape == "box" else np.array([radius, radius, height / 2])
        reach = max(reach, (np.abs(solids.centers) + np.abs(solids.rotations) @ half).max())
    return GateGeometry(collimators, crystals, phantom, rods, math.ceil(2 * (reach + _MARGIN)))


def _group_equal(*lengths: Floats) -> list[Indexes]:
    """Group modules by equal lengths (each (M,), mm); return the indices of each group, in order of the lengths."""
    _, group = np.unique(np.round(np.stack(lengths, axis=1) / _TOLERANCE), axis=0, return_inverse=True)
    group = group.reshape(-1)
    return [np.flatnonzero(group == i) for i in range(group.max() + 1)]


def _behind_pinholes(poses: Floats, depths: Any) -> tuple[Floats, Floats]:
    """Return the centres and rotations of solids at `depths` (M,), or one depth, mm, behind the pinholes."""
    return poses[:, :3, 3] - np.reshape(depths, (-1, 1)) * poses[:, :3, 2], poses[:, :3, :3]


def _collimator_solids(name: str, poses: Floats, body: Collimator, material: str) -> list[PlacedSolids]:
    """Return the collimators of one kind of modules, then the pieces of air in each, from front to back."""
    construction, l, half_side = body.construction, body.length, body.detector_side / 2
    middle = (l + construction.front) / 2  # depth of the solid's centre behind the pinhole, mm

    def air(prefix: str, shape: Literal["trd", "cone"], front: _Section, back: _Section) -> PlacedSolids:
        """Return a piece of air between two cross-sections (depth, half-width), mm."""
        center = np.array([[0.0, 0.0, middle - (front[0] + back[0]) / 2]])
        size = (back[1], front[1], back[0] - front[0])
        return PlacedSolids(f"{prefix}_{name}", name, shape, size, "Air", center, np.eye(3)[None])

    outside = (half_side + construction.wall_thickness, body.front_half_width, l - construction.front)
    return [
        PlacedSolids(name, "world", "trd", outside, material, *_behind_pinholes(poses, middle)),
        *(air("front" if back[0] <= 0 else "back", "cone", front, back) for front, back in pairwise(body.hole_profile)),
        air("channel", "trd", (construction.back, body.channel_half_width), (l, half_side)),
    ]


def _phantom_solids(simulation: Simulation) -> tuple[PlacedSolids | None, list[tuple[PlacedSolids, float]]]:
    """Return the phantom's body, 1 mm larger than the rods on each side, and the rods with their activity by sector."""
    if simulation.derenzo is None:
        return None, []
    material, pose, height = simulation.phantom_material, simulation.world_from_phantom, simulation.derenzo.height
    sector, x, y, diameter = simulation.derenzo.rods().T
    reach = max(float((np.hypot(x, y) + diameter / 2).max()), simulation.derenzo.radius)
    size = (reach + 1.0, height + 2.0)
    body = PlacedSolids("phantom", "world", "cylinder", size, material, pose[None, :3, 3], pose[None, :3, :3])
    rods = []
    for number in np.unique(sector):
        mask = sector == number
        centers = np.column_stack([x[mask], y[mask], np.zeros(mask.sum())])
        rotations = np.broadcast_to(np.eye(3), (len(centers), 3, 3))
        size = (diameter[mask][0] / 2, height)
        solids = PlacedSolids(f"rods_{int(number)}", "phantom", "cylinder", size, material, centers, rotations)
        rods.append((solids, float(simulation.becquerels * (diameter[mask] ** 2).sum() / (diameter**2).sum())))
    return body, rods


def _check_overlap(system: PinholeSystem, bodies: list[Collimator], phantom: PlacedSolids) -> None:
    """Raise `InputError` where a corner of a collimator's front lies inside the phantom."""
    poses, (radius, height) = system.poses(), phantom.size
    corners = np.array([[x, y, -1, 1] for x in (-1, 1) for y in (-1, 1)], float)
    for m, body in enumerate(bodies):
        half_width = body.front_half_width
        front = (poses[m] @ (corners * [half_width, half_width, body.construction.front, 1]).T)[:3].T
        in_phantom = (front - phantom.centers[0]) @ phantom.rotations[0]
        if np.any((np.hypot(in_phantom[:, 0], in_phantom[:, 1]) <= radius) & (np.abs(in_phantom[:, 2]) <= height / 2)):
            raise InputError(f"module {system.numbers[m]}: its collimator begins inside the phantom; move one of them")
