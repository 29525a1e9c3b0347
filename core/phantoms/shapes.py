"""Solid shapes with a position, an activity and an attenuation coefficient, of which phantoms are composed.

A shape is defined in its own frame, centred on the origin with its axis along z; `pose` places it in the phantom. Shapes are
convex unless their class says otherwise: a line enters and leaves them once.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from ..arrays import Array, Floats
from ..errors import InputError
from ..geometry.frames import euler_pose
from ..validation import at_least_0, positive, real_array
from .intervals import Interval, ball_interval, cone_interval, ellipse_distance, intersect, side_interval, slab_interval
from .surfaces import Surface, clip_surface, revolve_profile

Vector = Any
"""Numbers, passed as any sequence and stored as a tuple of floats (typed Any: mypy cannot say how many)."""

MODES = ("paint", "add")
# A shape with a cut is sampled by n x n lines: 512 give its volume to about 1e-5, 128 tell whether anything of it remains.
_LINES, _FEWER_LINES = 512, 128


@dataclass(frozen=True, kw_only=True)
class Shape:
    """Base class of the shapes: position, orientation, values, cuts and name.

    Attributes
    ----------
    position : (3,)
        Position of the shape's origin in the phantom, mm.
    euler : (3,)
        Euler angles phi, theta, psi of the shape, rad, see `euler_pose`.
    axis : (3,) or None
        Direction of the shape's z axis, a vector of any length, instead of `euler`.
    activity : float or None
        Activity concentration, kBq/mL; None keeps that of the shapes beneath. A shape needs an activity or a mu.
    mu : float or None
        Linear attenuation coefficient, 1/mm; None keeps that of the shapes beneath.
    mode : str
        ``"paint"`` replaces the values beneath the shape, ``"add"`` adds to them (and may be negative).
    cut : (n, 4)
        Planes (nx, ny, nz, d) in the shape's frame, d in mm: the points with ``n . x <= d |n|`` remain.
    name : str
        Name in messages and in the scene.
    half_box : (3,)
        Half the sides, mm, of a box around the shape's origin that contains the uncut shape.
    ball_radius : float
        Radius, mm, of a ball around the shape's origin that contains the uncut shape.
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
    _uncut_volume: float = field(init=False, repr=False, compare=False)
    """Volume of the shape without its cuts, mm^3."""

    KIND: ClassVar[str] = ""
    """Name of the kind of shape in TOML files and on the command line."""

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
            if (value := getattr(self, quantity)) is None:
                continue
            value = float(real_array(value, quantity, ()))
            if value < 0 and self.mode == "paint":
                raise InputError(f"{quantity}: expected 0 or more {unit}, got {value:g}")
            self._set(quantity, value)
        if self.activity is None and self.mu is None:
            raise InputError("activity, mu: expected at least one of them")
        if not isinstance(self.name, str):
            raise InputError(f"name: expected a text, got {self.name!r}")
        is_uncut = isinstance(self.cut, list | tuple) and not self.cut
        planes = np.empty((0, 4)) if is_uncut else real_array(self.cut, "cut", (None, 4))
        lengths = np.linalg.norm(planes[:, :3], axis=1)
        if np.any(lengths == 0):
            raise InputError("cut: expected planes nx ny nz d, got one whose normal is 0 0 0")
        planes[:, :3] /= lengths[:, None]
        self._set("cut", tuple(map(tuple, planes.tolist())))
        self._check()
        if self.cut and not self._integrate_volume(_FEWER_LINES) > 0:
            raise InputError("cut: nothing of the shape is left")

    @property
    def pose(self) -> Floats:
        """Pose phantom-from-shape (4, 4), mm."""
        phi, theta, psi = self.euler
        if self.axis is not None:
            x, y, z = self.axis
            phi, theta = math.atan2(y, x), math.atan2(math.hypot(x, y), z)
        return euler_pose(phi, theta, psi, self.position)

    def distance(self, points: Array) -> Array:
        """Return a lower bound (N,) of the signed distance, mm, of `points` (3, N) from the shape's surface.

        The points are in the shape's frame. The distance is negative inside, in magnitude nowhere larger than the true
        distance, and of the points' float type.
        """
        distance = self._distance(points)
        for *normal, offset in self.cut:
            n_x, n_y, n_z = (points.dtype.type(component) for component in normal)
            plane_distance = n_x * points[0] + n_y * points[1] + n_z * points[2] - points.dtype.type(offset)
            distance = np.maximum(distance, plane_distance)
        return distance

    def intervals(self, starts: Floats, directions: Floats) -> Interval:
        """Return the values of t at which the lines ``starts + t directions`` enter and leave the shape.

        The lines (3, N) are in the shape's frame. Both results are (m, N) for m disjoint parts of the shape (1 for a convex
        one); the entry is ``>=`` the exit where a line misses the part.
        """
        interval = self._intervals(starts, directions)
        for *normal, offset in self.cut:
            side = side_interval(np.array(normal) @ starts - offset, np.array(normal) @ directions)
            interval = intersect(interval, side)
        return interval

    def surface(self) -> Surface:
        """Return a closed mesh in the shape's frame: vertices (V, 3), mm, and triangles (F, 3).

        The corners of a triangle run counter-clockwise as seen from outside. Curved surfaces become polyhedra.
        """
        surface = self._surface()
        for *normal, offset in self.cut:
            surface = clip_surface(surface, np.array(normal), offset)
        return surface

    @cached_property
    def volume(self) -> float:
        """Volume of the shape, mm^3: in closed form, or with a cut integrated over lines."""
        return self._integrate_volume(_LINES) if self.cut else self._uncut_volume

    @property
    def n_parts(self) -> int:
        """Largest number of times that a line may enter the shape."""
        return 1

    @property
    def finest(self) -> float:
        """Size of the shape's smallest part, mm, which sets how finely it is sampled."""
        return min(2 * min(self.half_box), self.volume ** (1 / 3))

    def _integrate_volume(self, n: int) -> float:
        """Return the volume, mm^3, as the sum of the lengths of n x n parallel lines inside the shape."""
        # The lines are oblique: if they ran along a plane of the cut, the sum would jump from line to line and converge
        # slowly.
        slant = np.array([0.3, 0.2, 1.0])
        a, b, c = self.half_box
        width, depth = 2 * a * (1 + slant[0]), 2 * b * (1 + slant[1])
        u, v = (np.mgrid[:n, :n].reshape(2, -1) + 0.5) / n - 0.5
        starts = np.stack([u * width, v * depth, np.zeros_like(u)])
        directions = np.broadcast_to((slant * [a, b, c])[:, None], starts.shape)
        enter, leave = self.intervals(starts, directions)
        return float(np.maximum(leave - enter, 0.0).sum() / len(u) * width * depth * c)

    # A kind of shape defines the four following methods, all of the uncut shape.

    def _check(self) -> None:
        """Check the dimensions, and call `_set_size` with the results."""
        raise NotImplementedError

    def _distance(self, points: Array) -> Array:
        """Return `distance` of the uncut shape."""
        raise NotImplementedError

    def _intervals(self, starts: Floats, directions: Floats) -> Interval:
        """Return `intervals` of the uncut shape."""
        raise NotImplementedError

    def _surface(self) -> Surface:
        """Return `surface` of the uncut shape."""
        raise NotImplementedError

    def _set_size(self, half_box: tuple[float, float, float], ball_radius: float, volume: float) -> None:
        """Store `half_box` and `ball_radius`, mm, and the uncut shape's volume, mm^3."""
        self._set("half_box", half_box)
        self._set("ball_radius", ball_radius)
        self._set("_uncut_volume", volume)

    def _set(self, name: str, value: object) -> None:
        """Set an attribute of this frozen dataclass."""
        object.__setattr__(self, name, value)

    def _set_positive(self, *names: str) -> None:
        """Replace the named dimensions, mm, by floats above 0; raise `InputError` for others."""
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

    def _distance(self, points: Array) -> Array:
        return ellipse_distance(points, self.radii)

    def _intervals(self, starts: Floats, directions: Floats) -> Interval:
        radii = np.array(self.radii)[:, None]
        return ball_interval(starts / radii, directions / radii)

    def _surface(self) -> Surface:
        angle = np.linspace(-np.pi / 2, np.pi / 2, 33)
        a, b, c = self.radii
        return revolve_profile(np.cos(angle), c * np.sin(angle), a, b)


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


def ring_positions(radius: float, first_angle: float) -> list[tuple[float, float]]:
    """Return (x, y), mm, of six points on a circle about the axis, 60 degrees apart, counter-clockwise as seen from +z.

    `radius` is in mm; `first_angle`, the first point's angle from +x, in degrees.
    """
    angles = [math.radians(first_angle + 60.0 * i) for i in range(6)]
    return [(radius * math.cos(angle), radius * math.sin(angle)) for angle in angles]


def make_spheres(diameters: Sequence[float], positions: Sequence[Vector], **values: Any) -> list[Shape]:
    """Return spheres of the `diameters` and centre `positions` (3,), mm; a diameter of 0 gives no sphere.

    `values` are the activity and mu of all of them.
    """
    return [
        Sphere(radius=diameter / 2, position=position, name=f"sphere {diameter:g} mm", **values)
        for diameter, position in zip(diameters, positions, strict=True)
        if diameter
    ]


@dataclass(frozen=True, kw_only=True)
class Cylinder(Shape):
    """A cylinder of `height` mm along z; its `radius`, mm, is one number, or (2,) along x and y for an ellipse."""

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

    def _distance(self, points: Array) -> Array:
        a, b, half = self.half_box
        return np.maximum(ellipse_distance(points[:2], (a, b)), np.abs(points[2]) - points.dtype.type(half))

    def _intervals(self, starts: Floats, directions: Floats) -> Interval:
        a, b, half = self.half_box
        radii = np.array([[a], [b]])
        side = ball_interval(starts[:2] / radii, directions[:2] / radii)
        return intersect(side, slab_interval(starts[2], directions[2], half))

    def _surface(self) -> Surface:
        a, b, half = self.half_box
        return revolve_profile(np.array([0.0, 1.0, 1.0, 0.0]), np.array([-half, -half, half, half]), a, b)


@dataclass(frozen=True, kw_only=True)
class Cone(Shape):
    """A cone or truncated cone of `height` mm along z.

    `radius` is the radius at ``z = -height / 2``, `top_radius` that at ``z = height / 2``, mm; one of them may be 0.
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
    def _side(self) -> tuple[float, float]:
        """Radius at z = 0, mm, and its increase per mm along z."""
        return (self.radius + self.top_radius) / 2, (self.top_radius - self.radius) / self.height

    def _distance(self, points: Array) -> Array:
        scalar = points.dtype.type
        radius, slope = self._side
        distance = np.hypot(points[0], points[1]) - scalar(radius) - scalar(slope) * points[2]
        distance *= scalar(1 / math.hypot(1, slope))
        return np.maximum(distance, np.abs(points[2]) - scalar(self.height / 2))

    def _intervals(self, starts: Floats, directions: Floats) -> Interval:
        return cone_interval(starts, directions, *self._side, self.height / 2)

    def _surface(self) -> Surface:
        half = self.height / 2
        ends = [(r, z) for r, z in ((self.radius, -half), (self.top_radius, half)) if r > 0]
        radii, heights = np.array([(0.0, -half), *ends, (0.0, half)]).T
        return revolve_profile(radii, heights, 1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Capsule(Shape):
    """A cylinder of `radius` and `height`, mm, along z with a hemisphere on each end: 2 `radius` longer than `height`."""

    radius: float
    height: float

    KIND = "capsule"

    def _check(self) -> None:
        self._set_positive("radius", "height")
        r, half = self.radius, self.height / 2 + self.radius
        self._set_size((r, r, half), half, math.pi * r**2 * (self.height + 4 / 3 * r))

    def _distance(self, points: Array) -> Array:
        scalar = points.dtype.type
        beyond_end = np.maximum(np.abs(points[2]) - scalar(self.height / 2), 0)
        return np.sqrt(points[0] ** 2 + points[1] ** 2 + beyond_end**2) - scalar(self.radius)

    def _intervals(self, starts: Floats, directions: Floats) -> Interval:
        half = np.array([0.0, 0.0, self.height / 2])[:, None]
        side = ball_interval(starts[:2] / self.radius, directions[:2] / self.radius)
        intervals = [
            intersect(side, slab_interval(starts[2], directions[2], self.height / 2)),
            ball_interval((starts - half) / self.radius, directions / self.radius),
            ball_interval((starts + half) / self.radius, directions / self.radius),
        ]
        # The union of cylinder and balls is convex: one interval, from the first entry to the last exit.
        enter = np.minimum.reduce([np.where(enter >= leave, np.inf, enter) for enter, leave in intervals])
        leave = np.maximum.reduce([np.where(enter >= leave, -np.inf, leave) for enter, leave in intervals])
        return enter, leave

    def _surface(self) -> Surface:
        angle = np.linspace(0, np.pi / 2, 13)
        r, half = self.radius, self.height / 2
        radii = r * np.concatenate([np.sin(angle), np.cos(angle)])
        return revolve_profile(radii, np.concatenate([-half - r * np.cos(angle), half + r * np.sin(angle)]), 1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Box(Shape):
    """A box with the side lengths `size` (3,) along x, y, z, mm."""

    size: Vector

    KIND = "box"

    def _check(self) -> None:
        self._set("size", _positive_numbers(self.size, "size", 3))
        a, b, c = (side / 2 for side in self.size)
        self._set_size((a, b, c), math.hypot(a, b, c), 8 * a * b * c)

    def _distance(self, points: Array) -> Array:
        half = np.array(self.half_box, points.dtype)[:, None]
        return (np.abs(points) - half).max(axis=0)

    def _intervals(self, starts: Floats, directions: Floats) -> Interval:
        x, y, z = (slab_interval(starts[i], directions[i], half) for i, half in enumerate(self.half_box))
        return intersect(intersect(x, y), z)

    def _surface(self) -> Surface:
        a, b, half = self.half_box
        # A profile revolved in four sides, of which each is as far from the axis as the box's.
        radii, heights = np.sqrt(2.0) * np.array([0.0, 1.0, 1.0, 0.0]), np.array([-half, -half, half, half])
        return revolve_profile(radii, heights, a, b, n_sides=4)


def _numbers(value: Vector, name: str, count: int) -> tuple[float, ...]:
    """Return `value` as a tuple of `count` finite floats, or raise `InputError`."""
    return tuple(real_array(value, name, (count,)).tolist())


def _positive_numbers(value: Vector, name: str, count: int) -> tuple[float, ...]:
    """Return `value` as a tuple of `count` floats above 0, mm, or raise `InputError`."""
    return tuple(positive(number, name, "mm") for number in _numbers(value, name, count))
