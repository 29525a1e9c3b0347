"""What the Monte Carlo exports share: their options, and the scanner as placed solids.

Every solid of a module has the module's axes: local x = u, y = v, z = k, towards the isocentre. A point of the crystal
therefore lies at the (x, y) that `PinholeSystem.views(detector="real")` gives it. Lengths mm, times s, activities Bq,
energies keV.
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
"""keV at which the energy resolution is given."""

_SPACE = 50.0  # mm of air between the scanner's farthest point and the end of the world
_SAME = 1e-6  # mm: modules whose lengths differ by less are alike

# Name in GATE -> its state; the material of the same name is in `MATERIALS`.
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
    """The text of a ``GateMaterials.db``, which GATE 9 and 10 both read."""
    lines = ["[Elements]"]
    lines += [f"{name}: S= {symbol} ; Z= {z}. ; A= {a} g/mole" for symbol, (name, z, a) in _ELEMENTS.items()]
    lines += ["", "[Materials]"]
    for name, state in _STATES.items():
        material = MATERIALS.get(name) or MATERIALS[name.lower()]
        lines.append(f"{name}: d={material.density:g} g/cm3 ; n={len(material.composition)} ; state={state}")
        if len(material.composition) == 1:  # the element of the same name
            lines.append("        +el: name=auto ; n=1")
        else:
            lines += [f"        +el: name={_ELEMENTS[s][0]} ; f={share:g}" for s, share in material.composition.items()]
    return "\n".join(lines) + "\n"


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """The options of the Monte Carlo formats."""

    phantom: str | DerenzoPhantom = "point"  # "point", "derenzo" of the next three numbers, or a phantom
    radius: float = 40.0  # of the phantom "derenzo", mm
    rods: tuple[float, ...] = (8.0, 6.0, 5.0, 4.0, 3.0, 2.0)  # their diameters, mm
    height: float = 40.0  # the rods' length, mm
    position: tuple[float, ...] = (0.0, 0.0, 0.0)  # middle of the point or phantom, mm
    euler_degrees: tuple[float, ...] = (0.0, 0.0, 0.0)  # the phantom's phi, theta, psi of `euler_pose`
    pose: Floats | None = None  # world from phantom (4, 4), rigid, instead of both
    isotope: str | Isotope = "Tc-99m"  # its photons are emitted, each on its own
    activity: float | None = None  # total at the start, MBq; None: 1, or that of a `DerenzoPhantom`
    time: float = 1.0  # s
    crystal: Literal["NaI", "CZT"] = "NaI"
    collimator: Literal["Tungsten", "Lead"] = "Tungsten"
    phantom_material: Literal["Air", "Water", "PMMA"] = "Air"  # air hardly attenuates
    plate_thickness: float = 2.0  # mm; this and the next three are those of `Construction`
    wall_thickness: float = 2.0  # mm
    opening_degrees: float = 90.0
    edge_at: EdgePlace = "middle"
    intrinsic_fwhm: float = 3.0  # the crystal's resolution, mm; 0: perfect
    energy_resolution: float = 0.1  # FWHM / energy at `REFERENCE_ENERGY`, as 1 / sqrt(energy); 0: perfect
    window_percent: float = 20.0  # full width of the energy window around the strongest line
    seed: int = 1

    def __post_init__(self) -> None:
        positive(self.time, "time", "s")
        if positive(self.window_percent, "window_percent", "%") >= 200:
            raise InputError(f"window_percent: expected less than 200, got {self.window_percent:g}")
        for name in ("intrinsic_fwhm", "energy_resolution"):
            at_least_0(getattr(self, name), name)
        types = get_type_hints(Simulation)
        for name in ("crystal", "collimator", "phantom_material"):
            one_of(getattr(self, name), get_args(types[name]), name)
        # Geant4's engines are sure to take seeds up to 900 000 000 (CLHEP's HepJamesRandom).
        seed = real_array(self.seed, "seed", ())
        if seed != int(seed) or not 0 < seed < 900_000_000:
            raise InputError(f"seed: expected a whole number from 1 to 899999999, got {self.seed!r}")
        _ = self.construction, self.nuclide, self.derenzo, self.becquerels, self.world_from_phantom

    @cached_property
    def derenzo(self) -> DerenzoPhantom | None:
        """The phantom; None for a point."""
        if isinstance(self.phantom, DerenzoPhantom):
            return self.phantom
        if self.phantom not in ("point", "derenzo"):
            raise InputError(f"phantom {self.phantom!r}: expected point, derenzo or a DerenzoPhantom")
        return DerenzoPhantom(self.radius, self.rods, self.height) if self.phantom == "derenzo" else None

    @cached_property
    def nuclide(self) -> Isotope:
        """The isotope itself."""
        if isinstance(self.isotope, str):
            return isotope(self.isotope)
        instance(self.isotope, Isotope, "isotope")
        return self.isotope

    @cached_property
    def becquerels(self) -> float:
        """Total activity, Bq."""
        if self.activity is not None:
            return positive(self.activity, "activity", "MBq") * 1e6
        return self.phantom.total_activity * 1e3 if isinstance(self.phantom, DerenzoPhantom) else 1e6

    @cached_property
    def world_from_phantom(self) -> Floats:
        """(4, 4), from `pose` or from `position` and `euler_degrees`."""
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
        """How the collimators are built."""
        angle = angle_from_degrees(self.opening_degrees)
        return Construction(self.plate_thickness, self.wall_thickness, angle, self.edge_at)

    @property
    def window(self) -> tuple[float, float]:
        """Energies, keV."""
        energy, _ = max(self.nuclide.lines, key=lambda line: line[1])
        half = self.window_percent / 200
        return energy * (1 - half), energy * (1 + half)


class Placed(NamedTuple):
    """Equal solids at their places in a mother volume.

    `size` depends on the shape: ``box``: sides x, y, z; ``trd``: half-widths at -z and +z of a square frustum, and its
    height; ``cone``: radii at -z and +z, height; ``cylinder``: radius, height.
    """

    name: str
    mother: str
    shape: Literal["box", "trd", "cone", "cylinder"]
    size: tuple[float, ...]
    material: str
    centers: Floats  # (N, 3), in the mother's frame
    rotations: Floats  # (N, 3, 3), the solid's axes in that frame as columns


class Setup(NamedTuple):
    """All that is simulated."""

    collimators: list[list[Placed]]  # kind by kind: the collimators, and the pieces of air in one of them
    crystals: list[tuple[Placed, Indexes]]  # size by size: the crystals, and the indices of their modules
    phantom: Placed | None  # its body; None for a point
    rods: list[tuple[Placed, float]]  # sector by sector: the rods in the phantom, and their total activity, Bq
    world: float  # side of the surrounding cube of air, mm


def build_setup(system: PinholeSystem, simulation: Simulation) -> Setup:
    """The scanner and the phantom as solids.

    Modules of equal sizes share a collimator: the body of `core.geometry.collimator`, its outside a solid square frustum,
    and in it, as air, the channel and the hole, a cone on each side of the knife edge. A collimator
    may not begin inside the phantom.
    """
    instance(system, PinholeSystem, "a simulation by GATE")
    poses = system.poses()
    bodies = system.collimators(simulation.construction)
    l, side, thickness = system.collimator_length, system.detector_side, system.detector_thickness
    kinds, material = enumerate(_alike(l, system.pinhole_diameter, side, thickness), 1), simulation.collimator
    collimators = [_collimator(f"collimator_{i}", poses[own], bodies[own[0]], material) for i, own in kinds]
    crystals = []
    sizes = _alike(side, thickness)
    for i, modules in enumerate(sizes):
        size = (side[modules[0]], side[modules[0]], thickness[modules[0]])
        places = _behind_pinholes(poses[modules], l[modules] + size[2] / 2)
        name = "crystal" if len(sizes) == 1 else f"crystal{i + 1}"
        crystals.append((Placed(name, "world", "box", size, simulation.crystal, *places), modules))
    phantom, rods = _phantom(simulation)
    outer = [parts[0] for parts in collimators] + [solids for solids, _ in crystals]
    if phantom is not None:
        _refuse_overlap(system, bodies, phantom)
        outer.append(phantom)
    reach = np.abs(simulation.world_from_phantom[:3, 3]).max()
    for solids in outer:
        radius, *_, height = solids.size
        half = np.array(solids.size) / 2 if solids.shape == "box" else np.array([radius, radius, height / 2])
        reach = max(reach, (np.abs(solids.centers) + np.abs(solids.rotations) @ half).max())
    return Setup(collimators, crystals, phantom, rods, math.ceil(2 * (reach + _SPACE)))


def _alike(*lengths: Floats) -> list[Indexes]:
    """Indexes of the modules with equal lengths, kind by kind, from the shortest."""
    _, kind = np.unique(np.round(np.stack(lengths, axis=1) / _SAME), axis=0, return_inverse=True)
    kind = kind.reshape(-1)
    return [np.flatnonzero(kind == i) for i in range(kind.max() + 1)]


def _behind_pinholes(poses: Floats, depths: Any) -> tuple[Floats, Floats]:
    """Centres and rotations of solids that lie `depths` (M,) or one depth, mm, behind their pinholes."""
    return poses[:, :3, 3] - np.reshape(depths, (-1, 1)) * poses[:, :3, 2], poses[:, :3, :3]


def _collimator(name: str, poses: Floats, body: Collimator, material: str) -> list[Placed]:
    """The solids of one kind, and the pieces of air in each, front to back."""
    built, l, half_side = body.construction, body.length, body.detector_side / 2
    middle = (l + built.front) / 2  # depth of the solid's centre

    def air(kind: str, shape: Literal["trd", "cone"], front: tuple[float, float], back: tuple[float, float]) -> Placed:
        """Air between two (depth, half-width)."""
        center = np.array([[0.0, 0.0, middle - (front[0] + back[0]) / 2]])
        size = (back[1], front[1], back[0] - front[0])
        return Placed(f"{kind}_{name}", name, shape, size, "Air", center, np.eye(3)[None])

    outside = (half_side + built.wall_thickness, body.front_half_width, l - built.front)
    return [
        Placed(name, "world", "trd", outside, material, *_behind_pinholes(poses, middle)),
        *(air("front" if back[0] <= 0 else "back", "cone", front, back) for front, back in pairwise(body.hole_profile)),
        air("channel", "trd", (built.back, body.channel_half_width), (l, half_side)),
    ]


def _phantom(simulation: Simulation) -> tuple[Placed | None, list[tuple[Placed, float]]]:
    """The phantom's body, 1 mm larger than the rods, and the rods sector by sector."""
    if simulation.derenzo is None:
        return None, []
    material, pose, height = simulation.phantom_material, simulation.world_from_phantom, simulation.derenzo.height
    table = simulation.derenzo.rods()
    sector, x, y, diameter = table.T
    reach = max(float((np.hypot(x, y) + diameter / 2).max()), simulation.derenzo.radius)
    size = (reach + 1.0, height + 2.0)
    body = Placed("phantom", "world", "cylinder", size, material, pose[None, :3, 3], pose[None, :3, :3])
    rods = []
    for number in np.unique(sector):
        own = sector == number
        centers = np.column_stack([x[own], y[own], np.zeros(own.sum())])
        rotations = np.broadcast_to(np.eye(3), (len(centers), 3, 3))
        size = (diameter[own][0] / 2, height)
        solids = Placed(f"rods_{int(number)}", "phantom", "cylinder", size, material, centers, rotations)
        rods.append((solids, float(simulation.becquerels * (diameter[own] ** 2).sum() / (diameter**2).sum())))
    return body, rods


def _refuse_overlap(system: PinholeSystem, bodies: list[Collimator], phantom: Placed) -> None:
    """Refuse a collimator whose front reaches into the phantom."""
    poses, (radius, height) = system.poses(), phantom.size
    corners = np.array([[x, y, -1, 1] for x in (-1, 1) for y in (-1, 1)], float)
    for m, body in enumerate(bodies):
        wide = body.front_half_width
        front = (poses[m] @ (corners * [wide, wide, body.construction.front, 1]).T)[:3].T
        local = (front - phantom.centers[0]) @ phantom.rotations[0]
        if np.any((np.hypot(local[:, 0], local[:, 1]) <= radius) & (np.abs(local[:, 2]) <= height / 2)):
            raise InputError(f"module {system.numbers[m]}: its collimator begins inside the phantom; move one of them")
