"""A cardiac torso phantom: the beating left ventricle at the isocentre, with an optional perfusion defect."""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from ..errors import InputError
from ..physics.materials import attenuation
from ..validation import whole_number
from .painting import Layer, points_inside
from .phantom import Phantom
from .settings import check_settings, setting
from .shapes import Cylinder, Ellipsoid, Shape

# Rows: the heart's lateral, anterior and apical axes in the torso's frame. They are the third, second and first axis of the
# heart in M. Cristy and K. F. Eckerman, ORNL/TM-8381 (1987), where x and y point to the patient's left and back. Not
# confirmed.
_HEART = np.array([[-0.5736, -0.8191, 0.0], [-0.4640, 0.3249, 0.8241], [-0.6751, 0.4727, -0.5664]])
_U, _, _V = np.linalg.svd(_HEART)
_AXES = _U @ _V  # orthonormal: the digits above are rounded to four
# phi, theta, psi of `euler_pose` that rotate x, y, z to lateral, anterior, apical.
_EULER = (math.atan2(_AXES[2, 1], _AXES[2, 0]), math.acos(_AXES[2, 2]), math.atan2(_AXES[1, 2], -_AXES[0, 2]))
# The axis of ORNL/TM-8381's body lies at (x, y) = _MIDLINE from the left ventricle's centre, its height 0 lies _HEIGHT below
# the centre, mm. Both are choices.
_MIDLINE, _HEIGHT = (35.0, -30.0), 490.0
_SYSTOLE = 0.35  # phase of end-systole, as a fraction of the cycle
_RV_WALL = 4.0  # thickness of the right ventricle's muscle, mm
_N_FIXED = 4  # number of organs of fixed size: two lungs, liver and spine


@dataclasses.dataclass(frozen=True)
class CardiacTorso(Phantom):
    """A torso of simple shapes around a heart, as for myocardial perfusion with Tc-99m sestamibi.

    Frame: +x is the patient's right, +y the front, +z the head; the origin is the centre of the left ventricle at
    end-diastole. The patient's left and front thus face the modules of the 80-module cardiac scanner, and the ventricle
    lies well inside its 75 mm.

    Lungs, liver, spine and the direction of the heart's axis follow the mathematical adult of M. Cristy and K. F.
    Eckerman, ORNL/TM-8381 (1987). The trunk, the positions of the organs and the half axes of liver and spine were checked
    against the report's 15-year-old in Geant4's human_phantom, scaled. The half axes of the lungs, the plane that cuts the
    liver and the heart's axis are not confirmed. The report's body of 400 x 200 mm includes the arms; here an ellipse of
    330 x 230 mm stands for a chest with the arms up, the liver extends 150 instead of 165 mm to the right, and the spine
    lies 15 mm further back.

    The left ventricle's cavity and outer surface are half ellipsoids. The cavity holds 120 mL at end-diastole and 45 mL
    at end-systole, the wall is 9.5 mm thick (within men's normal ranges, R. M. Lang et al., J Am Soc Echocardiogr 28
    (2015) 1-39): 133 g of muscle. The muscle's volume and the apex stay the same over the cycle. The cavity's volume
    falls along half a cosine for 35 % of the cycle and rises along another; the right ventricle's shrinks with it. Ribs,
    arms, breasts and other organs are left out.

    The activities are choices for a study at rest, an hour after injection of 1 GBq: the heart's 1.2 % (sestamibi's
    prescribing information) is about 90 kBq/mL in 133 g; the other organs have the ratios of clinical images; the spine has
    the activity of the body.
    """

    phase: float = setting(0.0, "of the cycle", "0 at end-diastole, 0.35 at end-systole, below 1", 0.0)
    end_diastolic_volume: float = setting(120.0, "mL", "volume of the left ventricle's cavity at end-diastole")
    end_systolic_volume: float = setting(45.0, "mL", "volume of the left ventricle's cavity at end-systole")
    ventricle_length: float = setting(80.0, "mm", "length of the left ventricle's cavity at end-diastole")
    wall: float = setting(9.5, "mm", "thickness of the left ventricle's muscle at end-diastole")
    shortening: float = setting(0.13, "of the length", "by which the left ventricle is shorter at end-systole", 0.0)
    defect_severity: float = setting(0.0, "of the activity", "missing in the defect; 0 for no defect", 0.0)
    defect_angle_degrees: float = setting(0.0, "DEG", "0 anterior, 90 lateral, 180 inferior, 270 septal", -360.0)
    defect_width_degrees: float = setting(60.0, "DEG", "width of the defect around the ventricle's axis")
    defect_from: float = setting(0.3, "of the way from base to apex", "at which the defect begins", 0.0)
    defect_to: float = setting(0.8, "of the way from base to apex", "at which the defect ends")
    defect_transmural: float = setting(1.0, "of the wall", "from the inside, affected by the defect")
    body_radii: tuple[float, float] = setting((165.0, 115.0), "mm", "half axes of the body, left-right and front-back")
    myocardium: float = setting(90.0, "kBq/mL", "activity of the left ventricle's muscle", 0.0)
    right_myocardium: float = setting(45.0, "kBq/mL", "activity of the right ventricle's muscle", 0.0)
    blood: float = setting(5.0, "kBq/mL", "activity of the blood in the heart's cavities", 0.0)
    liver: float = setting(45.0, "kBq/mL", "activity of the liver", 0.0)
    lung: float = setting(3.0, "kBq/mL", "activity of the lungs", 0.0)
    body: float = setting(5.0, "kBq/mL", "activity of all other tissue", 0.0)

    title = "cardiac torso"

    def __post_init__(self) -> None:
        check_settings(self, self.title)
        upper_bounds = {"phase": 1.0, "defect_from": self.defect_to}  # not allowed themselves
        maxima = {"shortening": 0.9, "defect_width_degrees": 360.0, "end_systolic_volume": self.end_diastolic_volume}
        maxima |= dict.fromkeys(("defect_severity", "defect_to", "defect_transmural"), 1.0)
        for name, limit in {**maxima, **upper_bounds}.items():
            value = getattr(self, name)
            if value > limit or (value == limit and name in upper_bounds):
                expected = f"{'less than' if name in upper_bounds else 'at most'} {limit:g}"
                raise InputError(f"{self.title}: {name.replace('_', ' ')}: expected {expected}, got {value:g}")
        super().__post_init__()  # only now, because it makes the shapes, whose messages would not name the setting
        body, *organs = self.shapes
        for i, organ in enumerate(organs):
            points = next(points_inside(Layer(organ, organ.pose, 0.0))) - body.pose[:3, 3:]
            if np.any(body.distance(points) > 0):
                settings = "body radii of {:g} and {:g} mm".format(*self.body_radii)
                if i >= _N_FIXED:
                    lengths = f"ventricle length of {self.ventricle_length:g} mm, wall of {self.wall:g} mm"
                    settings = f"{lengths} and end diastolic volume of {self.end_diastolic_volume:g} mL"
                raise InputError(f"{self.title}: {settings}: the {organ.name} reaches out of the body")

    def beating(self, frames: int) -> "list[CardiacTorso]":
        """Return the torso at `frames` phases, evenly spaced over the cycle, the first at end-diastole."""
        n_frames = whole_number(frames, "frames of the cycle")
        return [dataclasses.replace(self, phase=i / n_frames) for i in range(n_frames)]

    @property
    def ventricle_volume(self) -> float:
        """Volume of the left ventricle's cavity at this phase, mL."""
        stroke = self.end_diastolic_volume - self.end_systolic_volume
        return self.end_diastolic_volume - stroke * self._contraction

    @cached_property
    def shapes(self) -> Sequence[Shape]:
        """Body, lungs, liver, spine, atria, right ventricle, left ventricle with its defect."""
        return [*self._trunk_shapes(), *self._heart_shapes()]

    @property
    def _contraction(self) -> float:
        """Degree of contraction: 0 at end-diastole, 1 at end-systole."""
        delay = self.phase - _SYSTOLE
        return 0.5 + 0.5 * math.cos(math.pi * delay / (_SYSTOLE if delay < 0 else 1 - _SYSTOLE))

    def _trunk_shapes(self) -> list[Shape]:
        """Return body, lungs, liver and spine."""

        def position(x: float, y: float, z: float) -> tuple[float, float, float]:
            """Return a point in the torso's frame, given relative to the axis and height 0 of ORNL/TM-8381's body."""
            return x + _MIDLINE[0], y + _MIDLINE[1], z - _HEIGHT

        soft, lung, bone = (attenuation(name, self.mu_energy) for name in ("soft tissue", "lung", "vertebra"))
        # The report's liver is the part of the cylinder with x/350 + y/450 - z/430 <= -1, x and y to the left and back. Here
        # x and y have the opposite signs, and z is measured from the cylinder's centre, at 350 mm.
        normal = np.array([-1 / 350, -1 / 450, -1 / 430])
        liver_cut = [(*normal, (350 / 430 - 1) / float(np.linalg.norm(normal)))]
        liver: dict[str, Any] = {"activity": self.liver, "mu": soft}
        lungs: dict[str, Any] = {"radii": (50, 75, 240), "cut": [(0, 0, -1, 0)], "activity": self.lung, "mu": lung}
        body: dict[str, Any] = {"height": 440, "activity": self.body}
        return [
            Cylinder(name="body", radius=self.body_radii, position=position(0, 0, 460), mu=soft, **body),
            Ellipsoid(name="right lung", position=position(85, 0, 435), **lungs),
            Ellipsoid(name="left lung", position=position(-85, 0, 435), **lungs),
            Cylinder(name="liver", radius=(150, 80), height=160, position=position(0, 0, 350), cut=liver_cut, **liver),
            Cylinder(name="spine", radius=(20, 25), position=position(0, -70, 460), mu=bone, **body),
        ]

    def _heart_shapes(self) -> list[Shape]:
        """Return atria, right ventricle and left ventricle with its defect, at this phase."""
        cavity, end_diastolic = self.ventricle_volume * 1e3, self.end_diastolic_volume * 1e3  # mm^3
        outer_radius = _half_ellipsoid_radius(end_diastolic, self.ventricle_length) + self.wall
        # The muscle's volume, mm^3, is the same at every phase.
        muscle = 2 / 3 * math.pi * outer_radius**2 * (self.ventricle_length + self.wall) - end_diastolic
        length = self.ventricle_length * (1 - self.shortening * self._contraction)
        radius = _half_ellipsoid_radius(cavity, length)
        # Wall w for which half an ellipsoid of radius + w and length + w has the volume of cavity and muscle:
        # (radius + w)^2 (length + w) = product.
        product = 1.5 * (cavity + muscle) / math.pi
        roots = np.roots([1.0, 2 * radius + length, radius**2 + 2 * radius * length, radius**2 * length - product])
        wall = float(roots.real.max())  # the only positive root
        # The apex does not move; at end-diastole the origin is halfway between base and apex.
        base = (self.ventricle_length + self.wall) / 2 - length - wall
        soft = attenuation("soft tissue", self.mu_energy)
        blood: dict[str, Any] = {"activity": self.blood, "mu": soft}

        def apical_half(name: str, *radii: float, right: float = 0.0, cut: Sequence = (), **values: Any) -> Shape:
            """Return the apical half of an ellipsoid centred at the base, `right` mm towards the right ventricle."""
            pose: dict[str, Any] = {"position": np.array([-right, 0, base]) @ _AXES, "euler": _EULER}
            return Ellipsoid(name=name, radii=radii, cut=[(0, 0, -1, 0), *cut], **pose, **values)

        scale = (self.ventricle_volume / self.end_diastolic_volume) ** (1 / 3)
        right_radii = [30.0 * scale, 36.0 * scale, 66.0 * scale]
        thickness, defect_activity = self.defect_transmural * wall, (1 - self.defect_severity) * self.myocardium
        defect_radii = (radius + thickness, radius + thickness, length + thickness)
        defect_cuts = self._defect_planes(length + wall)
        outer_radii = (radius + wall, radius + wall, length + wall)
        right_outer_radii = [r + _RV_WALL for r in right_radii]
        return [
            Ellipsoid(name="atria", radii=(35, 35, 28), position=(-8, 0, base - 20) @ _AXES, euler=_EULER, **blood),
            apical_half("right myocardium", *right_outer_radii, right=26.0, activity=self.right_myocardium, mu=soft),
            apical_half("right ventricle", *right_radii, right=26.0, **blood),
            apical_half("myocardium", *outer_radii, activity=self.myocardium, mu=soft),
            *(apical_half("defect", *defect_radii, cut=planes, activity=defect_activity) for planes in defect_cuts),
            apical_half("left ventricle", radius, radius, length, **blood),
        ]

    def _defect_planes(self, length: float) -> Iterator[list[tuple[float, float, float, float]]]:
        """Yield the planes (nx, ny, nz, d) that bound each convex piece of the defect, in the heart's frame, d in mm.

        A defect of up to 180 degrees is one piece, a wider one two. `length` is the distance from base to apex, mm.
        """
        if not self.defect_severity:
            return
        ends = [(0.0, 0.0, -1.0, -self.defect_from * length), (0.0, 0.0, 1.0, self.defect_to * length)]
        n_pieces = 1 if self.defect_width_degrees <= 180 else 2
        half_width = math.radians(self.defect_width_degrees) / n_pieces / 2
        defect_angle = math.radians(self.defect_angle_degrees)
        for piece in range(n_pieces):
            angle = defect_angle + (2 * piece - (n_pieces - 1)) * half_width
            # Angles run from anterior (y) to lateral (x). The outward normal of an edge is a quarter turn beyond the edge.
            normals = angle - half_width - math.pi / 2, angle + half_width + math.pi / 2
            yield [(math.sin(a), math.cos(a), 0.0, 0.0) for a in normals] + ends


def _half_ellipsoid_radius(volume: float, length: float) -> float:
    """Return the radius, mm, of half an ellipsoid of revolution of `volume` mm^3 and `length` mm."""
    return math.sqrt(1.5 * volume / (math.pi * length))
