"""A cardiac torso for this scanner: the left ventricle at the isocentre, beating, with a perfusion defect if wanted."""

import dataclasses
import math
from collections.abc import Sequence
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

# Rows: the heart's lateral, anterior and apical axis in the torso, after its third, second and first axis in M. Cristy and
# K. F. Eckerman, ORNL/TM-8381 (1987), whose x and y point to the patient's left and back. Not confirmed.
_HEART = np.array([[-0.5736, -0.8191, 0.0], [-0.4640, 0.3249, 0.8241], [-0.6751, 0.4727, -0.5664]])
_U, _, _V = np.linalg.svd(_HEART)
_AXES = _U @ _V  # orthonormal: the digits above are rounded to four
# phi, theta, psi of `euler_pose` that turn x, y, z to lateral, anterior, apical.
_EULER = (math.atan2(_AXES[2, 1], _AXES[2, 0]), math.acos(_AXES[2, 2]), math.atan2(_AXES[1, 2], -_AXES[0, 2]))
# Where ORNL/TM-8381's axis (x, y) and its height 0 lie from the left ventricle's middle, mm: chosen.
_MIDLINE, _HEIGHT = (35.0, -30.0), 490.0
_SYSTOLE = 0.35  # of the cycle
_RV_WALL = 4.0  # mm
_TRUNK = 4  # lungs, liver and spine, whose sizes are fixed


@dataclasses.dataclass(frozen=True)
class CardiacTorso(Phantom):
    """A torso of simple shapes around a heart, as for myocardial perfusion with Tc-99m sestamibi.

    Frame: +x is the patient's right, +y the front, +z the head; the origin is the middle of the left ventricle at
    end-diastole. The patient's left and front thus face the modules of the 80-module cardiac scanner, and the ventricle
    lies well inside its 75 mm.

    Lungs, liver, spine and the direction of the heart's axis follow the mathematical adult of M. Cristy and K. F.
    Eckerman, ORNL/TM-8381 (1987). The trunk, the places of the organs and the half axes of liver and spine were checked
    against its 15-year-old in Geant4's human_phantom, scaled. The half axes of the lungs, the plane that cuts the liver
    and the heart's axis are not confirmed. The report's body of 400 x 200 mm includes the arms; here an ellipse of 330 x
    230 mm stands for a chest with the arms up, the liver reaches 150 instead of 165 mm to the right, and the spine lies
    15 mm further back.
    The left ventricle's cavity and outer surface are half ellipsoids. The cavity holds 120 mL at end-diastole and 45 mL
    at end-systole, the wall is 9.5 mm thick (within men's normal ranges, R. M. Lang et al., J Am Soc Echocardiogr 28
    (2015) 1-39): 133 g of muscle. The muscle's volume and the apex stay the same over the cycle. The cavity's volume
    falls along half a cosine for 35 % of the cycle and rises along another; the right ventricle's shrinks with it. Ribs,
    arms, breasts and other organs are left out.

    The activities are choices for rest, an hour after 1 GBq: 1.2 % of it in the heart (sestamibi's prescribing
    information) is about 90 kBq/mL in 133 g; the other organs are set to ratios seen in clinical images; the spine has
    the body's.
    """

    phase: float = setting(0.0, "of the cycle", "0 at end-diastole, 0.35 at end-systole, below 1", 0.0)
    end_diastolic_volume: float = setting(120.0, "mL", "of the left ventricle")
    end_systolic_volume: float = setting(45.0, "mL", "of the left ventricle")
    ventricle_length: float = setting(80.0, "mm", "of its cavity at end-diastole")
    wall: float = setting(9.5, "mm", "of its muscle at end-diastole")
    shortening: float = setting(0.13, "of the length", "until end-systole", 0.0)
    defect_severity: float = setting(0.0, "of the activity", "missing in the defect; 0 for none", 0.0)
    defect_angle_degrees: float = setting(0.0, "DEG", "0 anterior, 90 lateral, 180 inferior, 270 septal", -360.0)
    defect_width_degrees: float = setting(60.0, "DEG", "how far around the defect reaches")
    defect_from: float = setting(0.3, "of the way", "from base to apex, where it begins", 0.0)
    defect_to: float = setting(0.8, "of the way", "from base to apex, where it ends")
    defect_transmural: float = setting(1.0, "of the wall", "from the inside, that it takes")
    body_radii: tuple[float, float] = setting((165.0, 115.0), "mm", "half axes, left-right and front-back")
    myocardium: float = setting(90.0, "kBq/mL", "in the left ventricle's muscle", 0.0)
    right_myocardium: float = setting(45.0, "kBq/mL", "in the right ventricle's muscle", 0.0)
    blood: float = setting(5.0, "kBq/mL", "in the heart's cavities", 0.0)
    liver: float = setting(45.0, "kBq/mL", "in the liver", 0.0)
    lung: float = setting(3.0, "kBq/mL", "in the lungs", 0.0)
    body: float = setting(5.0, "kBq/mL", "elsewhere", 0.0)

    title = "cardiac torso"

    def __post_init__(self) -> None:
        check_settings(self, self.title)
        below = {"phase": 1.0, "defect_from": self.defect_to}
        at_most = {"shortening": 0.9, "defect_width_degrees": 360.0, "end_systolic_volume": self.end_diastolic_volume}
        at_most |= dict.fromkeys(("defect_severity", "defect_to", "defect_transmural"), 1.0)
        for name, most in {**at_most, **below}.items():
            value = getattr(self, name)
            if value > most or (value == most and name in below):
                limit = f"{'less than' if name in below else 'at most'} {most:g}"
                raise InputError(f"{self.title}: {name.replace('_', ' ')}: expected {limit}, got {value:g}")
        super().__post_init__()  # it makes the shapes, whose messages would not name the setting
        body, *organs = self.shapes
        for i, organ in enumerate(organs):
            points = next(points_inside(Layer(organ, organ.pose, 0.0))) - body.pose[:3, 3:]
            if np.any(body.distance(points) > 0):
                settings = (
                    f"body radii of {self.body_radii[0]:g} and {self.body_radii[1]:g} mm"
                    if i < _TRUNK
                    else f"ventricle length of {self.ventricle_length:g} mm, wall of {self.wall:g} mm and end diastolic "
                    f"volume of {self.end_diastolic_volume:g} mL"
                )
                raise InputError(f"{self.title}: {settings}: the {organ.name} reaches out of the body")

    def beating(self, frames: int) -> "list[CardiacTorso]":
        """The torso at as many phases, evenly spaced over the cycle, the first at end-diastole."""
        count = whole_number(frames, "frames of the cycle")
        return [dataclasses.replace(self, phase=i / count) for i in range(count)]

    @property
    def ventricle_volume(self) -> float:
        """Volume of the left ventricle's cavity at this phase, mL."""
        stroke = self.end_diastolic_volume - self.end_systolic_volume
        return self.end_diastolic_volume - stroke * self._contraction

    @cached_property
    def shapes(self) -> Sequence[Shape]:
        """Body, lungs, liver, spine, atria, right ventricle, left ventricle with its defect."""
        return [*self._trunk(), *self._heart()]

    @property
    def _contraction(self) -> float:
        """0 at end-diastole, 1 at end-systole."""
        after = self.phase - _SYSTOLE
        return 0.5 + 0.5 * math.cos(math.pi * after / (_SYSTOLE if after < 0 else 1 - _SYSTOLE))

    def _trunk(self) -> list[Shape]:
        def at(x: float, y: float, z: float) -> tuple[float, float, float]:
            return x + _MIDLINE[0], y + _MIDLINE[1], z - _HEIGHT

        soft, lung, bone = (attenuation(name, self.mu_energy) for name in ("soft tissue", "lung", "vertebra"))
        # The liver lies below the plane x/350 + y/450 - z/430 = -1, x and y to the left and back, here about z = 350.
        plane = np.array([-1 / 350, -1 / 450, -1 / 430])
        liver = [(*plane, (350 / 430 - 1) / float(np.linalg.norm(plane)))]
        holds: dict[str, Any] = {"activity": self.liver, "mu": soft}
        lungs: dict[str, Any] = {"radii": (50, 75, 240), "cut": [(0, 0, -1, 0)], "activity": self.lung, "mu": lung}
        body: dict[str, Any] = {"height": 440, "activity": self.body}
        return [
            Cylinder(name="body", radius=self.body_radii, position=at(0, 0, 460), mu=soft, **body),
            Ellipsoid(name="right lung", position=at(85, 0, 435), **lungs),
            Ellipsoid(name="left lung", position=at(-85, 0, 435), **lungs),
            Cylinder(name="liver", radius=(150, 80), height=160, position=at(0, 0, 350), cut=liver, **holds),
            Cylinder(name="spine", radius=(20, 25), position=at(0, -70, 460), mu=bone, **body),
        ]

    def _heart(self) -> list[Shape]:
        cavity, full = self.ventricle_volume * 1e3, self.end_diastolic_volume * 1e3  # mm^3
        widest = _radius(full, self.ventricle_length) + self.wall
        muscle = 2 / 3 * math.pi * widest**2 * (self.ventricle_length + self.wall) - full  # the same at every phase
        length = self.ventricle_length * (1 - self.shortening * self._contraction)
        radius = _radius(cavity, length)
        # The wall w with which half an ellipsoid of radius + w and length + w holds both.
        product = 1.5 * (cavity + muscle) / math.pi
        roots = np.roots([1.0, 2 * radius + length, radius**2 + 2 * radius * length, radius**2 * length - product])
        wall = float(roots.real.max())  # the only positive one
        # The apex stays where it is; at end-diastole the origin is halfway between it and the base.
        base = (self.ventricle_length + self.wall) / 2 - length - wall
        soft = attenuation("soft tissue", self.mu_energy)
        blood: dict[str, Any] = {"activity": self.blood, "mu": soft}

        def half(name: str, *radii: float, right: float = 0.0, cut: Sequence = (), **holds: Any) -> Shape:
            """The apical half of an ellipsoid whose middle lies at the base, `right` mm towards the right ventricle."""
            place: dict[str, Any] = {"position": np.array([-right, 0, base]) @ _AXES, "euler": _EULER}
            return Ellipsoid(name=name, radii=radii, cut=[(0, 0, -1, 0), *cut], **place, **holds)

        beat = (self.ventricle_volume / self.end_diastolic_volume) ** (1 / 3)
        right = [30.0 * beat, 36.0 * beat, 66.0 * beat]
        layer, left = self.defect_transmural * wall, (1 - self.defect_severity) * self.myocardium
        depth = (radius + layer, radius + layer, length + layer)
        pieces = self._defect_planes(length + wall)
        outer = (radius + wall, radius + wall, length + wall)
        right_outer = [r + _RV_WALL for r in right]
        return [
            Ellipsoid(name="atria", radii=(35, 35, 28), position=(-8, 0, base - 20) @ _AXES, euler=_EULER, **blood),
            half("right myocardium", *right_outer, right=26.0, activity=self.right_myocardium, mu=soft),
            half("right ventricle", *right, right=26.0, **blood),
            half("myocardium", *outer, activity=self.myocardium, mu=soft),
            *(half("defect", *depth, cut=planes, activity=left) for planes in pieces),
            half("left ventricle", radius, radius, length, **blood),
        ]

    def _defect_planes(self, length: float) -> list[list[tuple[float, float, float, float]]]:
        """Planes around each convex piece of the defect, in the heart's frame; beyond 180 degrees there are two pieces."""
        if not self.defect_severity:
            return []
        ends = [(0.0, 0.0, -1.0, -self.defect_from * length), (0.0, 0.0, 1.0, self.defect_to * length)]
        pieces = 1 if self.defect_width_degrees <= 180 else 2
        half = math.radians(self.defect_width_degrees) / pieces / 2
        middle = math.radians(self.defect_angle_degrees)
        sides = []
        for piece in range(pieces):
            direction = middle + (2 * piece - (pieces - 1)) * half
            # Angles run from anterior (y) to lateral (x): the edge at angle a has its outward normal a quarter further.
            first, last = direction - half - math.pi / 2, direction + half + math.pi / 2
            sides.append([(math.sin(a), math.cos(a), 0.0, 0.0) for a in (first, last)] + ends)
        return sides


def _radius(volume: float, length: float) -> float:
    """Radius, mm, of half an ellipsoid of `volume` mm^3 and `length` mm."""
    return math.sqrt(1.5 * volume / (math.pi * length))
