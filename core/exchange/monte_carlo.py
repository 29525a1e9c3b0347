"""What the Monte Carlo exports share: the simulated scanner as solids in places, the source, the detector's numbers.

Every solid of a module has the module's axes: local x = u, y = v, z = k, towards the isocentre. So a point of the crystal
is at (x, y) where `PinholeSystem.views(detector="real")` has it. Lengths mm, times s, activities Bq, energies keV.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.collimator import Collimator, Construction, EdgePlace, angle_from_degrees
from ..geometry.frames import checked_affine, euler_pose
from ..geometry.module_parts import module_collimators
from ..geometry.system import PinholeSystem
from ..phantoms.derenzo import DerenzoPhantom
from ..physics.isotopes import Isotope, isotope
from ..validation import positive, real_array

REFERENCE_ENERGY = 140.5
"""keV at which the energy resolution is given."""

_SPACE = 50.0  # mm of air between the scanner's farthest point and the world's end
_SAME = 1e-6  # mm: modules whose lengths differ by less are of one class

# Density and composition by numbers of atoms or, with a point, by mass: air and PMMA as Geant4's G4_AIR and G4_PLEXIGLASS,
# CZT as Cd0.9 Zn0.1 Te.
_MATERIALS = """\
Air: d=1.20479 mg/cm3 ; n=4 ; state=gas
        +el: name=Carbon     ; f=0.000124
        +el: name=Nitrogen   ; f=0.755268
        +el: name=Oxygen     ; f=0.231781
        +el: name=Argon      ; f=0.012827

Water: d=1.00 g/cm3 ; n=2 ; state=liquid
        +el: name=Hydrogen   ; n=2
        +el: name=Oxygen     ; n=1

PMMA: d=1.19 g/cm3 ; n=3 ; state=solid
        +el: name=Hydrogen   ; f=0.080538
        +el: name=Carbon     ; f=0.599848
        +el: name=Oxygen     ; f=0.319614

Tungsten: d=19.3 g/cm3 ; n=1 ; state=solid
        +el: name=auto       ; n=1

Lead: d=11.35 g/cm3 ; n=1 ; state=solid
        +el: name=auto       ; n=1

NaI: d=3.67 g/cm3 ; n=2 ; state=solid
        +el: name=Sodium     ; n=1
        +el: name=Iodine     ; n=1

CZT: d=5.78 g/cm3 ; n=3 ; state=solid
        +el: name=Cadmium    ; n=9
        +el: name=Zinc       ; n=1
        +el: name=Tellurium  ; n=10
"""

_ELEMENTS = (
    ("Hydrogen", "H", 1, 1.008),
    ("Carbon", "C", 6, 12.011),
    ("Nitrogen", "N", 7, 14.007),
    ("Oxygen", "O", 8, 15.999),
    ("Sodium", "Na", 11, 22.990),
    ("Argon", "Ar", 18, 39.948),
    ("Zinc", "Zn", 30, 65.38),
    ("Cadmium", "Cd", 48, 112.414),
    ("Tellurium", "Te", 52, 127.60),
    ("Iodine", "I", 53, 126.904),
    ("Tungsten", "W", 74, 183.84),
    ("Lead", "Pb", 82, 207.2),
)


def material_database() -> str:
    """The materials as the text of a ``GateMaterials.db``, which GATE 9 and 10 both read."""
    elements = [f"{name}: S= {symbol} ; Z= {z}. ; A= {a} g/mole" for name, symbol, z, a in _ELEMENTS]
    return "\n".join(["[Elements]", *elements, "", "[Materials]", _MATERIALS])


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """What is simulated: the options of the Monte Carlo formats.

    Attributes
    ----------
    phantom : str or DerenzoPhantom
        ``"point"``, ``"derenzo"`` (of the three numbers below), or a phantom.
    radius, rods, height : float, 6 floats, float
        Of the phantom ``"derenzo"``: radius, rod diameters and length of the rods, mm.
    position, euler_degrees : 3 floats
        Middle of the point or phantom, mm, and the phantom's Euler angles phi, theta, psi (`core.frames.euler_pose`).
    pose : array (4, 4) or None
        World-from-phantom, a rotation and a translation, instead of both.
    isotope : str or Isotope
        Its photons are emitted, each on its own.
    activity : float or None
        MBq in all, at the start. None: 1 MBq, or what the `DerenzoPhantom` holds.
    time : float
        s.
    crystal, collimator, phantom_material : str
        Their materials; a phantom of air attenuates next to nothing.
    plate_thickness, wall_thickness : float
        Of the aperture's plate and the collimator's walls, mm.
    opening_degrees : float
        Full angle of the knife edge's double cone.
    edge_at : "middle", "front" or "back"
        Where in the plate the knife edge is; front is the face towards the ROI.
    intrinsic_fwhm : float
        The crystal's resolution, mm; 0: none.
    energy_resolution : float
        FWHM at 140.5 keV as a share of the energy; it falls with the square root of the energy.
    window_percent : float
        Full width of the energy window around the isotope's strongest line.
    seed : int
        Of the random numbers.

    Raises
    ------
    InputError
        An option is none of these.
    """

    phantom: str | DerenzoPhantom = "point"
    radius: float = 40.0
    rods: tuple[float, ...] = (8.0, 6.0, 5.0, 4.0, 3.0, 2.0)
    height: float = 40.0
    position: tuple[float, ...] = (0.0, 0.0, 0.0)
    euler_degrees: tuple[float, ...] = (0.0, 0.0, 0.0)
    pose: NDArray[np.float64] | None = None
    isotope: str | Isotope = "Tc-99m"
    activity: float | None = None
    time: float = 1.0
    crystal: Literal["NaI", "CZT"] = "NaI"
    collimator: Literal["Tungsten", "Lead"] = "Tungsten"
    phantom_material: Literal["Air", "Water", "PMMA"] = "Air"
    plate_thickness: float = 2.0
    wall_thickness: float = 2.0
    opening_degrees: float = 90.0
    edge_at: EdgePlace = "middle"
    intrinsic_fwhm: float = 3.0
    energy_resolution: float = 0.1
    window_percent: float = 20.0
    seed: int = 1

    def __post_init__(self) -> None:
        set_ = object.__setattr__
        if isinstance(self.phantom, DerenzoPhantom):
            set_(self, "activity", self.phantom.total_activity * 1e-3 if self.activity is None else self.activity)
        elif isinstance(self.phantom, str) and self.phantom == "derenzo":
            set_(self, "phantom", DerenzoPhantom(self.radius, self.rods, self.height))
        elif not (isinstance(self.phantom, str) and self.phantom == "point"):
            raise InputError(f"phantom {self.phantom!r}: expected point, derenzo or a DerenzoPhantom")
        if self.activity is None:
            set_(self, "activity", 1.0)
        for name, unit in (
            ("activity", "MBq"),
            ("time", "s"),
            ("window_percent", "%"),
        ):
            set_(self, name, positive(getattr(self, name), name, unit))
        for name in ("intrinsic_fwhm", "energy_resolution"):
            value = float(real_array(getattr(self, name), name, ()))
            if value < 0:
                raise InputError(f"{name}: expected 0 or more, got {value:g}")
            set_(self, name, value)
        if self.window_percent >= 200:
            raise InputError(f"window_percent: expected less than 200, got {self.window_percent:g}")
        _ = self.construction
        kinds = get_type_hints(Simulation)
        for name in ("crystal", "collimator", "phantom_material"):
            known = get_args(kinds[name])
            if getattr(self, name) not in known:
                raise InputError(f"{name} {getattr(self, name)!r}: expected one of {', '.join(known)}")
        if isinstance(self.isotope, str):
            set_(self, "isotope", isotope(self.isotope))
        elif not isinstance(self.isotope, Isotope):
            raise InputError(f"isotope: expected a name or an Isotope, got {type(self.isotope).__name__}")
        # Geant4's engines take seeds up to 900 000 000 for sure (CLHEP's HepJamesRandom).
        seed = real_array(self.seed, "seed", ())
        if seed != int(seed) or not 0 < seed < 900_000_000:
            raise InputError(f"seed: expected a whole number from 1 to 899999999, got {self.seed!r}")
        set_(self, "seed", int(seed))
        if self.pose is None:
            phi, theta, psi = np.radians(real_array(self.euler_degrees, "euler_degrees", (3,)))
            set_(self, "pose", euler_pose(phi, theta, psi, real_array(self.position, "position", (3,))))
        pose = checked_affine(self.pose, "phantom pose")  # type: ignore[arg-type]
        rotation = pose[:3, :3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-9) or np.linalg.det(rotation) < 0:
            raise InputError("phantom pose: expected a rotation and a translation; solids are not scaled or mirrored")
        set_(self, "pose", pose)

    # As `__post_init__` leaves them, for the type checker too.
    @property
    def nuclide(self) -> Isotope:
        """The isotope itself."""
        assert isinstance(self.isotope, Isotope)
        return self.isotope

    @property
    def place(self) -> NDArray[np.float64]:
        """World-from-phantom (4, 4), from `pose` or from `position` and `euler_degrees`."""
        assert self.pose is not None
        return self.pose

    @property
    def construction(self) -> Construction:
        """How the collimators are built."""
        angle = angle_from_degrees(self.opening_degrees)
        return Construction(self.plate_thickness, self.wall_thickness, angle, self.edge_at)

    @property
    def becquerels(self) -> float:
        """The activity, Bq."""
        assert self.activity is not None
        return self.activity * 1e6

    @property
    def window(self) -> tuple[float, float]:
        """Of energies, keV."""
        energy, _ = max(self.nuclide.lines, key=lambda line: line[1])
        half = self.window_percent / 200
        return energy * (1 - half), energy * (1 + half)

    @property
    def photons_per_decay(self) -> float:
        """Of all lines together."""
        return sum(photons for _, photons in self.nuclide.lines)


class Part(NamedTuple):
    """Equal solids in their places within a mother volume.

    `size` by shape: ``box`` sides x, y, z; ``trd`` half-widths at -z and +z of a square frustum, and its height; ``cone``
    radii at -z and +z, height; ``cylinder`` radius, height. `rotations` (N, 3, 3) have the solid's axes in the mother's
    frame as columns, `centers` (N, 3) are in that frame.
    """

    name: str
    mother: str
    shape: str
    size: tuple[float, ...]
    material: str
    centers: NDArray[np.float64]
    rotations: NDArray[np.float64]


class Crystals(NamedTuple):
    """Crystals of one size, and whose they are."""

    part: Part
    modules: NDArray[np.intp]


class Rods(NamedTuple):
    """One sector's rods within the phantom, and their activity, Bq."""

    part: Part
    activity: float


class Scene(NamedTuple):
    """All that is simulated.

    `collimators` has one list for each class: the solid, and the air in it. `phantom` is None for a point. `world` is the
    side of the cube of air.
    """

    simulation: Simulation
    collimators: list[list[Part]]
    crystals: list[Crystals]
    phantom: Part | None
    rods: list[Rods]
    world: float


def build_scene(system: PinholeSystem, simulation: Simulation) -> Scene:
    """The scanner and what is in it, as solids.

    A collimator is the body that `core.collimator` describes: its outside as a solid square frustum, and in it as air the
    channel and the hole, a cone on either side of the knife edge, or on one where the edge is on a face of the plate.

    Raises
    ------
    InputError
        There is no such collimator, or one begins in the phantom.
    """
    poses = system.poses()
    bodies = module_collimators(system, simulation.construction)
    collimators = [
        _collimator(f"collimator_{i + 1}", modules, poses, bodies[modules[0]], simulation.collimator)
        for i, modules in enumerate(
            _classes(system.collimator_length, system.pinhole_diameter, system.detector_side, system.detector_thickness)
        )
    ]
    crystals = []
    by_size = _classes(system.detector_side, system.detector_thickness)
    for i, modules in enumerate(by_size):
        side, thickness = system.detector_side[modules[0]], system.detector_thickness[modules[0]]
        depths = system.collimator_length[modules] + thickness / 2
        name = "crystal" if len(by_size) == 1 else f"crystal{i + 1}"
        part = Part(name, "world", "box", (side, side, thickness), simulation.crystal, *places(poses[modules], depths))
        crystals.append(Crystals(part, modules))
    phantom, rods = _phantom(simulation)
    if phantom is not None:
        _refuse_inside(system, bodies, phantom)
    outer = [parts[0] for parts in collimators] + [c.part for c in crystals] + ([] if phantom is None else [phantom])
    reach = max([float(np.abs(simulation.place[:3, 3]).max()), *(np.abs(_corners(part)).max() for part in outer)])
    return Scene(simulation, collimators, crystals, phantom, rods, math.ceil(2 * (reach + _SPACE)))


def places(
    poses: NDArray[np.float64], depths: NDArray[np.float64] | float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Centres and rotations of solids that lie `depths` mm behind their pinholes."""
    k = poses[:, :3, 2]
    return poses[:, :3, 3] - np.broadcast_to(depths, len(poses))[:, None] * k, poses[:, :3, :3]


def _classes(*lengths: NDArray[np.float64]) -> list[NDArray[np.intp]]:
    """Indices of the modules of equal lengths, class by class, from the shortest."""
    _, inverse = np.unique(np.round(np.stack(lengths, axis=1) / _SAME), axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    return [np.flatnonzero(inverse == i) for i in range(inverse.max() + 1)]


def _collimator(
    name: str, modules: NDArray[np.intp], poses: NDArray[np.float64], body: Collimator, material: str
) -> list[Part]:
    """The solid and the pieces of air in it, front to back, of one class."""
    built, l, half_side = body.construction, body.length, body.detector_side / 2
    middle = (l + built.front) / 2  # depth of the solid's centre

    def air(kind: str, shape: str, behind: float, before: float, back: float, front: float) -> Part:
        """Air of widths `behind` and `before` from the depth `back` to `front`."""
        center = np.array([[0.0, 0.0, middle - (front + back) / 2]])
        return Part(f"{kind}_{name}", name, shape, (behind, before, back - front), "Air", center, np.eye(3)[None])

    outside = (half_side + built.wall_thickness, body.front_half_width, l - built.front)
    profile = body.hole_profile
    cones = [
        air("front" if back <= 0 else "back", "cone", behind, before, back, front)
        for (front, before), (back, behind) in pairwise(profile)
    ]
    return [
        Part(name, "world", "trd", outside, material, *places(poses[modules], middle)),
        *cones,
        air("channel", "trd", half_side, body.channel_half_width, l, built.back),
    ]


def _phantom(simulation: Simulation) -> tuple[Part | None, list[Rods]]:
    if not isinstance(simulation.phantom, DerenzoPhantom):
        return None, []
    table, height, material = simulation.phantom.rods(), simulation.phantom.height, simulation.phantom_material
    pose = simulation.place
    reach = float((np.hypot(table[:, 1], table[:, 2]) + table[:, 3] / 2).max())
    size = (max(reach, simulation.phantom.radius) + 1.0, height + 2.0)
    body = Part("phantom", "world", "cylinder", size, material, pose[None, :3, 3], pose[None, :3, :3])
    rods = []
    areas = table[:, 3] ** 2
    for sector in np.unique(table[:, 0]):
        chosen = table[:, 0] == sector
        centers = np.column_stack([table[chosen, 1:3], np.zeros(chosen.sum())])
        rotations = np.broadcast_to(np.eye(3), (len(centers), 3, 3))
        rod = (table[chosen][0, 3] / 2, height)
        part = Part(f"rods_{int(sector)}", "phantom", "cylinder", rod, material, centers, rotations)
        rods.append(Rods(part, simulation.becquerels * areas[chosen].sum() / areas.sum()))
    return body, rods


def _refuse_inside(system: PinholeSystem, bodies: list[Collimator], phantom: Part) -> None:
    """Refuse a phantom that a collimator's front reaches into."""
    poses, (radius, height) = system.poses(), phantom.size
    corners = np.array([[x, y, -1, 1] for x in (-1, 1) for y in (-1, 1)], float)
    for m, body in enumerate(bodies):
        wide = body.front_half_width
        front = (poses[m] @ (corners * [wide, wide, body.construction.front, 1]).T)[:3].T
        local = (front - phantom.centers[0]) @ phantom.rotations[0]
        if np.any((np.hypot(local[:, 0], local[:, 1]) <= radius) & (np.abs(local[:, 2]) <= height / 2)):
            raise InputError(f"module {system.numbers[m]}: its collimator begins inside the phantom; move one of them")


def _corners(part: Part) -> NDArray[np.float64]:
    """Corners (8 N, 3), in the mother's frame, of the boxes around a part's solids."""
    half = np.array(part.size) / 2 if part.shape == "box" else np.array([part.size[0], part.size[0], part.size[-1] / 2])
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    corners = part.centers[:, None] + np.einsum("nij,cj->nci", part.rotations, signs * half)
    return corners.reshape(-1, 3)
