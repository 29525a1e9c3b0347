"""Solid shapes with a place and a content: what phantoms are made of.

A shape lies in its own frame, centred on the origin with its axis along z; `pose` places it. Shapes are convex unless they
say otherwise: a line enters and leaves them once.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from ..errors import InputError
from ..geometry.frames import euler_pose
from ..validation import at_least_0, positive, real_array
from .intervals import Interval, Points, Real, below, between, common, ellipse_distance, in_cone, in_unit_ball
from .surfaces import Surface, clipped, lathe

Vector = Any
"""Numbers: given as any sequence, kept as a tuple of floats (typed Any: mypy cannot say how many)."""

MODES = ("paint", "add")
# Lines each way through a shape with a cut: enough for its volume to about 1e-5, and to find whether anything remains.
_LINES, _FEWER_LINES = 512, 128


@dataclass(frozen=True, kw_only=True)
class Shape:
    """What all shapes have: a place and a content.

    Attributes
    ----------
    position : (3,)
        Of the shape's origin in the phantom, mm.
    euler : (3,)
        phi, theta, psi in radians, as for `euler_pose`.
    axis : (3,) or None
        Instead of `euler`: the direction of the shape's z axis, of any length.
    activity, mu : float or None
        kBq/mL, and the linear attenuation coefficient, 1/mm; None leaves what is beneath as it is. One is needed.
    mode : str
        ``"paint"`` replaces what lies beneath, ``"add"`` adds to it (and may be negative).
    cut : (n, 4)
        Planes (nx, ny, nz, d) in the shape's frame: the points with ``n . x <= d |n|`` are kept, d in mm.
    name : str
        For messages and the scene.
    half_box : (3,)
        Half the sides, mm, of a box around the shape's origin that contains it, before any cut.
    ball_radius : float
        Radius, mm, of a ball around the shape's origin that contains it.
    """

    position: Vector = (0.0, 0.0, 0.0)
    euler: Vector = (0.0, 0.0, 0.0)
    axis: Vector | None = None
    activity: float | None = None
    mu: float | None = None
    mode: str = "paint"
    cut: Vector = ()
    name: str = ""
    half_box: tuple[float, float, float] = field(init=False, repr=False, compare=False)
    ball_radius: float = field(init=False, repr=False, compare=False)
    _whole: float = field(init=False, repr=False, compare=False)  # the volume before any cut, mm^3

    KIND: ClassVar[str] = ""

    def __post_init__(self) -> None:
        self._set("position", _numbers(self.position, "position", 3))
        self._set("euler", _numbers(self.euler, "euler", 3))
        if self.axis is not None:
            self._set("axis", _numbers(self.axis, "axis", 3))
            if any(self.euler):
                raise InputError("axis: expected either an axis or Euler angles, got both")
            if not any(self.axis):
                raise InputError("axis: expected a direction, got 0 0 0")
        if self.mode not in MODES:
            raise InputError(f"mode: expected one of {', '.join(MODES)}, got {self.mode!r}")
        for quantity, unit in (("activity", "kBq/mL"), ("mu", "1/mm")):
            value = getattr(self, quantity)
            if value is None:
                continue
            value = float(real_array(value, quantity, ()))
            if value < 0 and self.mode == "paint":
                raise InputError(f"{quantity}: expected 0 or more {unit}, got {value:g}")
            self._set(quantity, value)
        if self.activity is None and self.mu is None:
            raise InputError("activity, mu: expected at least one of them")
        if not isinstance(self.name, str):
            raise InputError(f"name: expected a text, got {self.name!r}")
        none = isinstance(self.cut, list | tuple) and not self.cut
        planes = np.empty((0, 4)) if none else real_array(self.cut, "cut", (None, 4))
        lengths = np.linalg.norm(planes[:, :3], axis=1)
        if np.any(lengths == 0):
            raise InputError("cut: expected planes nx ny nz d, got one whose normal is 0 0 0")
        planes[:, :3] /= lengths[:, None]
        self._set("cut", tuple(map(tuple, planes.tolist())))
        self._check()
        if self.cut and not self._summed_volume(_FEWER_LINES) > 0:
            raise InputError("cut: nothing of the shape is left")

    @property
    def pose(self) -> Points:
        """Phantom-from-shape (4, 4), mm."""
        phi, theta, psi = self.euler
        if self.axis is not None:
            x, y, z = self.axis
            phi, theta = math.atan2(y, x), math.atan2(math.hypot(x, y), z)
        return euler_pose(phi, theta, psi, self.position)

    def distance(self, points: Real) -> Real:
        """Signed distance (N,), mm, of `points` (3, N) in the shape's frame from its surface, of the points' type.

        Negative inside, and nowhere larger in magnitude than the true distance.
        """
        distance = self._distance(points)
        for *normal, offset in self.cut:
            n_x, n_y, n_z = (points.dtype.type(component) for component in normal)
            plane = n_x * points[0] + n_y * points[1] + n_z * points[2] - points.dtype.type(offset)
            distance = np.maximum(distance, plane)
        return distance

    def intervals(self, starts: Points, directions: Points) -> Interval:
        """From and to which t the lines ``starts + t directions``, (3, N) in the shape's frame, are inside.

        Each (m, N), of m disjoint parts (one where the shape is convex); from ``>=`` to where a line misses the part.
        """
        interval = self._intervals(starts, directions)
        for *normal, offset in self.cut:
            interval = common(interval, below(np.array(normal) @ starts - offset, np.array(normal) @ directions))
        return interval

    def surface(self) -> Surface:
        """A closed mesh in the shape's frame: vertices (V, 3), mm, and triangles (F, 3), counter-clockwise from outside."""
        surface = self._surface()
        for *normal, offset in self.cut:
            surface = clipped(surface, np.array(normal), offset)
        return surface

    @cached_property
    def volume(self) -> float:
        """mm^3: in closed form, or with a cut summed over lines."""
        return self._summed_volume(_LINES) if self.cut else self._whole

    @property
    def n_parts(self) -> int:
        """How many times at most a line may enter the shape."""
        return 1

    @property
    def finest(self) -> float:
        """Size, mm, of the smallest part."""
        return min(2 * min(self.half_box), self.volume ** (1 / 3))

    def _summed_volume(self, n: int) -> float:
        """The volume summed over n x n lines."""
        # Aslant: along a plane of the cut the sum would jump from line to line and converge badly.
        slant = np.array([0.3, 0.2, 1.0])
        a, b, c = self.half_box
        width, depth = 2 * a * (1 + slant[0]), 2 * b * (1 + slant[1])
        u, v = (np.mgrid[:n, :n].reshape(2, -1) + 0.5) / n - 0.5
        starts = np.stack([u * width, v * depth, np.zeros_like(u)])
        directions = np.broadcast_to((slant * [a, b, c])[:, None], starts.shape)
        enter, leave = self.intervals(starts, directions)
        return float(np.maximum(leave - enter, 0.0).sum() / len(u) * width * depth * c)

    # What a kind of shape defines: `_check` checks its numbers and calls `_set_size`; the others ignore the cut.

    def _check(self) -> None:
        raise NotImplementedError

    def _distance(self, points: Real) -> Real:
        raise NotImplementedError

    def _intervals(self, starts: Points, directions: Points) -> Interval:
        raise NotImplementedError

    def _surface(self) -> Surface:
        raise NotImplementedError

    def _set_size(self, half_box: tuple[float, float, float], ball_radius: float, volume: float) -> None:
        self._set("half_box", half_box)
        self._set("ball_radius", ball_radius)
        self._set("_whole", volume)

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    def _set_positive(self, *names: str) -> None:
        for name in names:
            self._set(name, positive(getattr(self, name), name, "mm"))


@dataclass(frozen=True, kw_only=True)
class Ellipsoid(Shape):
    """An ellipsoid with the half axes `radii` (3,) along x, y, z, mm."""

    radii: Vector

    KIND = "ellipsoid"

    def _check(self) -> None:
        self._set("radii", _positive_numbers(self.radii, "radii", 3))
        self._set_size(self.radii, max(self.radii), 4 / 3 * math.pi * math.prod(self.radii))

    def _distance(self, points: Real) -> Real:
        return ellipse_distance(points, self.radii)

    def _intervals(self, starts: Points, directions: Points) -> Interval:
        radii = np.array(self.radii)[:, None]
        return in_unit_ball(starts / radii, directions / radii)

    def _surface(self) -> Surface:
        angle = np.linspace(-np.pi / 2, np.pi / 2, 33)
        a, b, c = self.radii
        return lathe(np.cos(angle), c * np.sin(angle), a, b)


@dataclass(frozen=True, kw_only=True)
class Sphere(Ellipsoid):
    """A sphere of `radius` mm."""

    radius: float
    radii: Vector = field(init=False)

    KIND = "sphere"

    def _check(self) -> None:
        self._set_positive("radius")
        self._set("radii", (self.radius,) * 3)
        super()._check()


def ring_places(radius: float, first: float) -> list[tuple[float, float]]:
    """x and y, mm, of six places on a circle, 60 degrees apart counter-clockwise seen from +z, from `first` degrees on."""
    angles = [math.radians(first + 60.0 * i) for i in range(6)]
    return [(radius * math.cos(angle), radius * math.sin(angle)) for angle in angles]


def spheres(diameters: Sequence[float], places: Sequence[Vector], **content: Any) -> list[Shape]:
    """Spheres of these `diameters`, mm, at their places; a diameter of 0 is no sphere."""
    return [
        Sphere(radius=diameter / 2, position=place, name=f"sphere {diameter:g} mm", **content)
        for diameter, place in zip(diameters, places, strict=True)
        if diameter
    ]


@dataclass(frozen=True, kw_only=True)
class Cylinder(Shape):
    """A cylinder of `height` mm along z; its `radius`, mm, is one number, or (2,) along x and y for an elliptic one."""

    radius: Vector
    height: float

    KIND = "cylinder"

    def _check(self) -> None:
        if isinstance(self.radius, list | tuple | np.ndarray):
            self._set("radius", _positive_numbers(self.radius, "radius", 2))
        else:
            self._set_positive("radius")
        self._set_positive("height")
        a, b = self.radius if isinstance(self.radius, tuple) else (self.radius, self.radius)
        half = self.height / 2
        self._set_size((a, b, half), math.hypot(max(a, b), half), 2 * math.pi * a * b * half)

    def _distance(self, points: Real) -> Real:
        a, b, half = self.half_box
        return np.maximum(ellipse_distance(points[:2], (a, b)), np.abs(points[2]) - points.dtype.type(half))

    def _intervals(self, starts: Points, directions: Points) -> Interval:
        a, b, half = self.half_box
        radii = np.array([[a], [b]])
        side = in_unit_ball(starts[:2] / radii, directions[:2] / radii)
        return common(side, between(starts[2], directions[2], half))

    def _surface(self) -> Surface:
        a, b, half = self.half_box
        return lathe(np.array([0.0, 1.0, 1.0, 0.0]), np.array([-half, -half, half, half]), a, b)


@dataclass(frozen=True, kw_only=True)
class Cone(Shape):
    """A cone along z, with or without its tip.

    Its `radius` is that at ``z = -height / 2``, its `top_radius` that at ``z = height / 2``, mm; one of them may be 0.
    """

    radius: float
    top_radius: float = 0.0
    height: float

    KIND = "cone"

    def _check(self) -> None:
        for name in ("radius", "top_radius"):
            self._set(name, at_least_0(getattr(self, name), name, "mm"))
        r, t = self.radius, self.top_radius
        widest = positive(max(r, t), "radius", "mm")
        self._set_positive("height")
        half = self.height / 2
        volume = math.pi / 3 * self.height * (r * r + r * t + t * t)
        self._set_size((widest, widest, half), math.hypot(widest, half), volume)

    @property
    def _line(self) -> tuple[float, float]:
        """The radius at z = 0, mm, and by how much it grows per mm along z."""
        return (self.radius + self.top_radius) / 2, (self.top_radius - self.radius) / self.height

    def _distance(self, points: Real) -> Real:
        of_type = points.dtype.type
        middle, slope = self._line
        side = np.hypot(points[0], points[1]) - of_type(middle) - of_type(slope) * points[2]
        side *= of_type(1 / math.hypot(1, slope))
        return np.maximum(side, np.abs(points[2]) - of_type(self.height / 2))

    def _intervals(self, starts: Points, directions: Points) -> Interval:
        return in_cone(starts, directions, *self._line, self.height / 2)

    def _surface(self) -> Surface:
        half = self.height / 2
        ends = [(r, z) for r, z in ((self.radius, -half), (self.top_radius, half)) if r > 0]
        radii, heights = np.array([(0.0, -half), *ends, (0.0, half)]).T
        return lathe(radii, heights, 1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Capsule(Shape):
    """A cylinder of `radius` and `height` mm along z with half balls on its ends, which add a `radius` each."""

    radius: float
    height: float

    KIND = "capsule"

    def _check(self) -> None:
        self._set_positive("radius", "height")
        r, half = self.radius, self.height / 2 + self.radius
        self._set_size((r, r, half), half, math.pi * r**2 * (self.height + 4 / 3 * r))

    def _distance(self, points: Real) -> Real:
        of_type = points.dtype.type
        beyond = np.maximum(np.abs(points[2]) - of_type(self.height / 2), 0)
        return np.sqrt(points[0] ** 2 + points[1] ** 2 + beyond**2) - of_type(self.radius)

    def _intervals(self, starts: Points, directions: Points) -> Interval:
        half = np.array([0.0, 0.0, self.height / 2])[:, None]
        side = in_unit_ball(starts[:2] / self.radius, directions[:2] / self.radius)
        parts = [
            common(side, between(starts[2], directions[2], self.height / 2)),
            in_unit_ball((starts - half) / self.radius, directions / self.radius),
            in_unit_ball((starts + half) / self.radius, directions / self.radius),
        ]
        # The sum of the parts is convex: one interval, from the first entry to the last exit.
        enter = np.minimum.reduce([np.where(enter >= leave, np.inf, enter) for enter, leave in parts])
        leave = np.maximum.reduce([np.where(enter >= leave, -np.inf, leave) for enter, leave in parts])
        return enter, leave

    def _surface(self) -> Surface:
        angle = np.linspace(0, np.pi / 2, 13)
        r, half = self.radius, self.height / 2
        radii = r * np.concatenate([np.sin(angle), np.cos(angle)])
        return lathe(radii, np.concatenate([-half - r * np.cos(angle), half + r * np.sin(angle)]), 1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Box(Shape):
    """A box with the sides `size` (3,) along x, y, z, mm."""

    size: Vector

    KIND = "box"

    def _check(self) -> None:
        self._set("size", _positive_numbers(self.size, "size", 3))
        a, b, c = (side / 2 for side in self.size)
        self._set_size((a, b, c), math.hypot(a, b, c), 8 * a * b * c)

    def _distance(self, points: Real) -> Real:
        half = np.array(self.half_box, points.dtype)[:, None]
        return (np.abs(points) - half).max(axis=0)

    def _intervals(self, starts: Points, directions: Points) -> Interval:
        x, y, z = (between(starts[i], directions[i], half) for i, half in enumerate(self.half_box))
        return common(common(x, y), z)

    def _surface(self) -> Surface:
        a, b, half = self.half_box
        # A lathe of four sides.
        radii, heights = np.sqrt(2.0) * np.array([0.0, 1.0, 1.0, 0.0]), np.array([-half, -half, half, half])
        return lathe(radii, heights, a, b, n_sides=4)


def _numbers(value: Vector, name: str, count: int) -> tuple[float, ...]:
    return tuple(real_array(value, name, (count,)).tolist())


def _positive_numbers(value: Vector, name: str, count: int) -> tuple[float, ...]:
    return tuple(positive(number, name, "mm") for number in _numbers(value, name, count))
