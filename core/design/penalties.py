"""Constraints of a design, as smooth penalties for the search and as faults of the finished scanner.

A constraint computes by how many mm it is violated. In the search, the square of a violation above 0 is the penalty. The
finished design is judged by `faults`: exactly by `check_geometry`, and by the same violations without a margin.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np

from ..arrays import Floats, Indexes
from ..geometry.checks import check_geometry
from ..geometry.collimator import Construction, edge_slope
from ..geometry.system import PinholeSystem
from .numbers import central_differences, module_rows, split_rows

_SMOOTHING = 0.05  # mm over which maxima of lengths are smoothed
_CONSTRUCTION = Construction()


@dataclass(frozen=True)
class Constraint:
    """Base class of the constraints, each on lengths in mm.

    Called with a system, a constraint returns the penalty, mm^2, and its gradient (M, 15) by the modules' rows (`numbers`).
    """

    limit: Any = None
    """Limit of the constraint, mm, if it has one of its own."""
    margin: float = 0.1
    """Length, mm, by which the search over-fulfils the constraint."""
    words: ClassVar[str] = ""
    """Text of a fault, with the violation in mm; "" if `check_geometry` reports the fault."""

    def __call__(self, system: PinholeSystem) -> tuple[float, Floats]:
        """Return the penalty, the sum of squared violations, mm^2, and its gradient (M, 15)."""
        rows, members = module_rows(system), self._members(system)
        gradient, member_rows = np.zeros_like(rows), _member_rows(rows, members)
        violation = self._violation(member_rows, members, system) + self.margin
        violated = np.flatnonzero(violation.max(axis=1, initial=-1.0) > 0)  # all others have no gradient
        violators = members[violated]

        def squares(rows: Floats) -> Floats:
            """Return the sum of squared violations (N,) of the violated members' rows."""
            return (np.maximum(self._violation(rows, violators, system) + self.margin, 0.0) ** 2).sum(axis=1)

        if len(violated):
            derivatives = central_differences(squares, member_rows[violated])
            np.add.at(gradient, violators, derivatives.reshape(*violators.shape, -1))
        return float((np.maximum(violation, 0.0) ** 2).sum()), gradient

    def faults(self, system: PinholeSystem) -> list[str]:
        """Return one line for each violation by a module, or by all modules together."""
        members = self._members(system)
        violation = self._violation(_member_rows(module_rows(system), members), members, system).max(axis=1)
        names = [f"module {system.numbers[group[0]]}" if len(group) == 1 else "all modules" for group in members]
        return [f"{name}: {self.words.format(x)}" for name, x in zip(names, violation, strict=True) if x > 1e-6]

    def _members(self, system: PinholeSystem) -> Indexes:
        """Return the modules (N, 1), or pairs of modules (N, 2), that may violate the constraint."""
        return np.arange(len(system))[:, None]

    def _violation(self, rows: Floats, members: Indexes, system: PinholeSystem) -> Floats:
        """Return by how many mm the constraint is violated, (N, S) for S conditions; <= 0 where it holds.

        `rows` are the parameters of N modules (N, 15) or pairs (N, 30), `members` their indices.
        """
        raise NotImplementedError


class FieldOfView(Constraint):
    """Constraint that every module sees its whole ROI, on all four sides, see `PinholeSystem.roi_radius_seen`."""

    def _violation(self, rows: Floats, members: Indexes, system: PinholeSystem) -> Floats:
        """Return R minus the radius of the sphere that is seen on each of four sides (N, 4), mm."""
        centers, frames, d, l, side = split_rows(rows)
        u, v, h = -np.einsum("nij,nj->in", frames, centers)
        radius = (h * (side - d) - d * l - 2 * l * np.stack([u, -u, v, -v])) / np.hypot(2 * l, side - d)
        return (system.roi_radius[members[:, 0]] - radius).T


class ModuleSeparation(Constraint):
    """Constraint that modules do not overlap: a plane parallel to a face of one of two hulls separates them.

    A module's hull is the convex hull of its collimator and its crystal, which is slightly larger than both.
    """

    def _members(self, system: PinholeSystem) -> Indexes:
        """Return the pairs (N, 2) of modules whose bounding spheres lie less than margin + 1 mm apart."""
        corners = _hull_corners(module_rows(system), system.detector_thickness)
        centers = corners.mean(axis=1)
        radii = np.linalg.norm(corners - centers[:, None], axis=2).max(axis=1)
        distance = np.linalg.norm(centers[:, None] - centers, axis=2) - radii[:, None] - radii
        return np.argwhere(np.triu(distance < self.margin + 1.0, 1))

    def _violation(self, rows: Floats, members: Indexes, system: PinholeSystem) -> Floats:
        """Return minus the largest gap (N, 1), mm, between two hulls along the normals of their faces, smoothed.

        `rows` (N, 30) are the parameters of the pairs of modules, `members` (N, 2) their indices.
        """
        pair = [(rows[:, 15 * i : 15 * i + 15], system.detector_thickness[members[:, i]]) for i in (0, 1)]
        axes = np.concatenate([_hull_normals(*module) for module in pair], axis=1)
        first, second = (axes @ _hull_corners(*module).transpose(0, 2, 1) for module in pair)  # (N, axes, corners)
        gaps = np.hstack([-_smooth_max(-b) - _smooth_max(a) for a, b in ((first, second), (second, first))])
        weights = np.exp((gaps - gaps.max(axis=1, keepdims=True)) / _SMOOTHING)
        return -(weights * gaps).sum(axis=1, keepdims=True) / weights.sum(axis=1, keepdims=True)


class LineOfSight(Constraint):
    """Constraint that no module is in another module's view: in the cone from its pinhole around its ROI, or in the ROI."""

    def _members(self, system: PinholeSystem) -> Indexes:
        """Return the pairs (N, 2) of a viewing module and a module that is at most margin + 1 mm beside its cone."""
        rows, members = module_rows(system), []
        for i in range(len(system)):  # one module after the other, for outlines of all pairs would take much memory
            pairs = np.array([(i, j) for j in range(len(system)) if j != i], np.intp).reshape(-1, 2)
            depth = self._violation(_member_rows(rows, pairs), pairs, system).max(axis=1, initial=-np.inf)
            members.append(pairs[depth > -self.margin - 1.0])
        return np.concatenate(members)

    def _violation(self, rows: Floats, members: Indexes, system: PinholeSystem) -> Floats:
        """Return how deep, mm, each point of the second module's outline (N, 17) lies in the first module's cone or ROI."""
        pinhole, radius = rows[:, None, :3], system.roi_radius[members[:, :1]]
        points = _hull_outline(rows[:, 15:], system.detector_thickness[members[:, 1]])
        b = np.linalg.norm(pinhole, axis=2)
        sine, cosine = radius / b, np.sqrt(np.maximum(1 - (radius / b) ** 2, 0.0))
        offset = points - pinhole
        h = -(offset * pinhole).sum(axis=2) / b
        rho = np.sqrt(np.maximum((offset**2).sum(axis=2) - h**2, 1e-12))  # distance from the cone's axis
        along = h * cosine + rho * sine  # along the cone's side, which touches the ROI at b cos
        depth = np.where(along < b * cosine, h * sine - rho * cosine, radius - np.linalg.norm(points, axis=2))
        return np.where(along > 0, depth, -np.linalg.norm(offset, axis=2))


class Clearance(Constraint):
    """Constraint that no module enters the bore or the body, an elliptic cylinder along z.

    The limit, mm, contains its semi-axes, and x and y of its centre if that is not the isocentre.
    """

    words = "reaches {:.3g} mm into the bore or the body"

    def _violation(self, rows: Floats, members: Indexes, system: PinholeSystem) -> Floats:
        """Return how deep, mm, each point of a module's outline (N, 17) lies in the cylinder, in units of its small axis."""
        points = _hull_outline(rows, system.detector_thickness[members[:, 0]])
        axes, center = np.broadcast_to(self.limit[:2], 2), self.limit[2:] or (0.0, 0.0)
        return axes.min() * (1 - np.hypot(*((points[..., :2] - center) / axes).transpose(2, 0, 1)))


class SmallestHole(Constraint):
    """Constraint that no hole is narrower than the limit, the smallest diameter that can be made, mm."""

    words = "its hole is {:.3g} mm too narrow"

    def _violation(self, rows: Floats, members: Indexes, system: PinholeSystem) -> Floats:
        """Return the limit minus d (N, 1), mm."""
        return self.limit - split_rows(rows)[2][:, None]


class CrystalArea(Constraint):
    """Constraint on the area of all crystals: at most that of a square whose side is the limit, mm."""

    words = "the side of a square as large as their crystals is {:.3g} mm too long"

    def _members(self, system: PinholeSystem) -> Indexes:
        """Return all modules as one group (1, M)."""
        return np.arange(len(system))[None]

    def _violation(self, rows: Floats, members: Indexes, system: PinholeSystem) -> Floats:
        """Return the side of a square of all crystals' area, minus the limit, (1, 1), mm; `rows` is (1, 15 M)."""
        sides = rows.reshape(len(rows), -1, 15)[..., 14]
        return np.sqrt((sides**2).sum(axis=1, keepdims=True)) - self.limit


def faults(system: PinholeSystem, constraints: Sequence[Constraint]) -> tuple[str, ...]:
    """Return what is wrong with a scanner, one line each: none if it can be built and fulfils the constraints."""
    lines = [line for constraint in constraints if constraint.words for line in constraint.faults(system)]
    return (*check_geometry(system).messages(), *lines)


def _member_rows(rows: Floats, members: Indexes) -> Floats:
    """Return the rows (N, 15) of modules (N, 1), or the joined rows (N, 30) of pairs of modules (N, 2)."""
    return rows[members].reshape(len(members), members.shape[1] * rows.shape[1])


def _hull_squares(rows: Floats, thickness: Floats) -> list[tuple[Floats, Floats]]:
    """Return depth behind the pinhole and half width (N,), mm, of a hull's squares: plate front, crystal front and back."""
    _, _, d, l, side = split_rows(rows)
    rim = d / 2 + max(-_CONSTRUCTION.front, _CONSTRUCTION.back) * edge_slope(_CONSTRUCTION.opening_angle)
    front, wall = rim + 0.01 * (side / 2 - rim) + _CONSTRUCTION.wall_thickness, _CONSTRUCTION.wall_thickness
    return [(0 * l + _CONSTRUCTION.front, front), (l, side / 2 + wall), (l + thickness, side / 2)]


def _hull_corners(rows: Floats, thickness: Floats) -> Floats:
    """Return the corners (N, 12, 3), world mm, of the modules' hulls."""
    return _hull_points(rows, _hull_squares(rows, thickness), [(-1, -1), (1, -1), (1, 1), (-1, 1)])


def _hull_outline(rows: Floats, thickness: Floats) -> Floats:
    """Return points (N, 17, 3), world mm, of hulls: the corners, the centre of the front, and the centres of its edges."""
    front = _hull_points(rows, _hull_squares(rows, thickness)[:1], [(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1)])
    return np.concatenate([_hull_corners(rows, thickness), front], axis=1)


def _hull_points(rows: Floats, squares: Sequence[tuple[Floats, Floats]], uv: Sequence[tuple[int, int]]) -> Floats:
    """Return points (N, squares x uv, 3), world mm, of a hull's squares at the coordinates `uv`, in half widths."""
    centers, frames, *_ = split_rows(rows)
    u, v, k = frames.transpose(1, 0, 2)
    return np.stack([centers - depth[:, None] * k + half[:, None] * (x * u + y * v)
                     for depth, half in squares for x, y in uv], axis=1)  # fmt: skip


def _hull_normals(rows: Floats, thickness: Floats) -> Floats:
    """Return unit normals (N, 9, 3) of the hulls' faces: k for both ends, and four for each of two truncated pyramids."""
    u, v, k = split_rows(rows)[1].transpose(1, 0, 2)
    normals = [k]
    for (near, near_half), (far, far_half) in pairwise(_hull_squares(rows, thickness)):
        depth, growth = (far - near)[:, None], (far_half - near_half)[:, None]
        normals += [depth * side + growth * k for side in (u, -u, v, -v)]
    stacked = np.stack(normals, axis=1)
    return stacked / np.linalg.norm(stacked, axis=2, keepdims=True)


def _smooth_max(values: Floats) -> Floats:
    """Return a smooth maximum of the last axis, slightly larger than the maximum."""
    largest = values.max(axis=-1, keepdims=True)
    return largest[..., 0] + _SMOOTHING * np.log(np.exp((values - largest) / _SMOOTHING).sum(axis=-1))
