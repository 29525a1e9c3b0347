"""Constraints of a design as smooth penalties, and as findings of what breaks them.

A constraint says by how many mm something is too short. Where that is more than 0, its square is the penalty; a design that
is done is judged by `faults`: `check_geometry`, exactly, and these same numbers without a margin.
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
from .numbers import differences, parts_of, rows_of

_SOFT = 0.05
"""mm over which maxima are rounded off."""
_BUILT = Construction()


@dataclass(frozen=True)
class Constraint:
    """Something that must not be too short, by a `limit` in mm; `margin` is how much longer the design is made, mm.

    Called with a system it gives the penalty, mm^2, and its gradient (M, 15) by the rows of `numbers`.
    """

    limit: Any = None
    margin: float = 0.1
    words: ClassVar[str] = ""  # of a fault; without them `check_geometry` judges

    def __call__(self, system: PinholeSystem) -> tuple[float, Floats]:
        """The sum of squares of what is missing, and its gradient."""
        rows, members = rows_of(system), self._members(system)
        gradient, joined = np.zeros_like(rows), _joined(rows, members)
        short = self._short(joined, members, system) + self.margin
        near = np.flatnonzero(short.max(axis=1, initial=-1.0) > 0)  # where nothing is missing, there is no slope

        def squares(some: Floats) -> Floats:
            return (np.maximum(self._short(some, members[near], system) + self.margin, 0.0) ** 2).sum(axis=1)

        if len(near):
            np.add.at(gradient, members[near], differences(squares, joined[near]).reshape(*members[near].shape, -1))
        return float((np.maximum(short, 0.0) ** 2).sum()), gradient

    def faults(self, system: PinholeSystem) -> list[str]:
        """One line for each module, or for all together, of which something is missing."""
        members = self._members(system)
        short = self._short(_joined(rows_of(system), members), members, system).max(axis=1)
        names = [f"module {system.numbers[own[0]]}" if len(own) == 1 else "all modules" for own in members]
        return [f"{name}: {self.words.format(x)}" for name, x in zip(names, short, strict=True) if x > 1e-6]

    def _members(self, system: PinholeSystem) -> Indexes:
        """The modules (N, 1), or pairs of them (N, 2), that are looked at."""
        return np.arange(len(system))[:, None]

    def _short(self, rows: Floats, members: Indexes, system: PinholeSystem) -> Floats:
        """What is missing (N, S), mm, of the modules' rows (N, 15), or those of pairs (N, 30)."""
        raise NotImplementedError


class FieldOfView(Constraint):
    """Every module sees its ROI whole: on all four sides as `PinholeSystem.roi_radius_seen`."""

    def _short(self, rows: Floats, members: Indexes, system: PinholeSystem) -> Floats:
        centers, frames, d, l, side = parts_of(rows)
        u, v, h = -np.einsum("nij,nj->in", frames, centers)
        seen = (h * (side - d) - d * l - 2 * l * np.stack([u, -u, v, -v])) / np.hypot(2 * l, side - d)
        return (system.roi_radius[members[:, 0]] - seen).T


class Overlap(Constraint):
    """Modules stand apart: some face of one of two hulls has the other before it.

    A module's hull is that of its collimator and its crystal together, which is a little more than both.
    """

    def _members(self, system: PinholeSystem) -> Indexes:
        corners = _corners(rows_of(system), system.detector_thickness)
        middles = corners.mean(axis=1)
        radii = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
        apart = np.linalg.norm(middles[:, None] - middles, axis=2) - radii[:, None] - radii
        return np.argwhere(np.triu(apart < self.margin + 1.0, 1))

    def _short(self, rows: Floats, members: Indexes, system: PinholeSystem) -> Floats:
        both = [(rows[:, 15 * i : 15 * i + 15], system.detector_thickness[members[:, i]]) for i in (0, 1)]
        axes = np.concatenate([_normals(*one) for one in both], axis=1)
        first, second = (axes @ _corners(*one).transpose(0, 2, 1) for one in both)  # (N, axes, corners)
        gaps = np.concatenate([-_most(-b) - _most(a) for a, b in ((first, second), (second, first))], axis=1)
        weights = np.exp((gaps - gaps.max(axis=1, keepdims=True)) / _SOFT)
        return -(weights * gaps).sum(axis=1, keepdims=True) / weights.sum(axis=1, keepdims=True)


class Sight(Constraint):
    """No module stands between another one's pinhole and its ROI: in the cone around the ROI, or in the ROI."""

    def _members(self, system: PinholeSystem) -> Indexes:
        rows, found = rows_of(system), []
        for i in range(len(system)):  # not all pairs' outlines at once
            pairs = np.array([(i, j) for j in range(len(system)) if j != i], np.intp).reshape(-1, 2)
            near = self._short(_joined(rows, pairs), pairs, system).max(axis=1, initial=-np.inf)
            found.append(pairs[near > -self.margin - 1.0])
        return np.concatenate(found)

    def _short(self, rows: Floats, members: Indexes, system: PinholeSystem) -> Floats:
        pinhole, radius = rows[:, None, :3], system.roi_radius[members[:, :1]]
        points = _outline(rows[:, 15:], system.detector_thickness[members[:, 1]])
        b = np.linalg.norm(pinhole, axis=2)
        sine, cosine = radius / b, np.sqrt(np.maximum(1 - (radius / b) ** 2, 0.0))
        away = points - pinhole
        h = -(away * pinhole).sum(axis=2) / b
        across = np.sqrt(np.maximum((away**2).sum(axis=2) - h**2, 1e-12))
        along = h * cosine + across * sine  # along the cone's side, which touches the ROI at b cos
        aside = np.where(along < b * cosine, h * sine - across * cosine, radius - np.linalg.norm(points, axis=2))
        return np.where(along > 0, aside, -np.linalg.norm(away, axis=2))


class Clearance(Constraint):
    """No module enters the bore or the body: an elliptic cylinder along z.

    The limit, mm, is its semi-axes; and x and y of its middle, where that is not the isocentre.
    """

    words = "reaches {:.3g} mm into the bore or the body"

    def _short(self, rows: Floats, members: Indexes, system: PinholeSystem) -> Floats:
        points = _outline(rows, system.detector_thickness[members[:, 0]])
        axes, middle = np.broadcast_to(self.limit[:2], 2), self.limit[2:] or (0.0, 0.0)
        return axes.min() * (1 - np.hypot(*((points[..., :2] - middle) / axes).transpose(2, 0, 1)))


class SmallestHole(Constraint):
    """No hole is narrower than can be made."""

    words = "its hole is {:.3g} mm too narrow"

    def _short(self, rows: Floats, members: Indexes, system: PinholeSystem) -> Floats:
        return self.limit - parts_of(rows)[2][:, None]


class CrystalArea(Constraint):
    """All crystals together are no larger than a square of this side, mm."""

    words = "the side of a square as large as their crystals is {:.3g} mm too long"

    def _members(self, system: PinholeSystem) -> Indexes:
        return np.arange(len(system))[None]

    def _short(self, rows: Floats, members: Indexes, system: PinholeSystem) -> Floats:
        sides = rows.reshape(len(rows), -1, 15)[..., 14]
        return np.sqrt((sides**2).sum(axis=1, keepdims=True)) - self.limit


def faults(system: PinholeSystem, constraints: Sequence[Constraint]) -> tuple[str, ...]:
    """What is wrong with a scanner, one line each: nothing, if it can be built and keeps the constraints."""
    own = [line for constraint in constraints if constraint.words for line in constraint.faults(system)]
    return (*check_geometry(system).messages(), *own)


def _joined(rows: Floats, members: Indexes) -> Floats:
    """The rows (N, 15) of modules, or (N, 30) of pairs."""
    return rows[members].reshape(len(members), members.shape[1] * rows.shape[1])


def _sizes(rows: Floats, thickness: Floats) -> list[tuple[Floats, Floats]]:
    """Depths and half-widths (N,), mm, of a hull's three squares: the plate's front, the crystal's front and its back."""
    _, _, d, l, side = parts_of(rows)
    rim = d / 2 + max(-_BUILT.front, _BUILT.back) * edge_slope(_BUILT.opening_angle)
    front = rim + 0.01 * (side / 2 - rim) + _BUILT.wall_thickness
    return [(0 * l + _BUILT.front, front), (l, side / 2 + _BUILT.wall_thickness), (l + thickness, side / 2)]


def _corners(rows: Floats, thickness: Floats) -> Floats:
    """Corners (N, 12, 3), world mm, of the modules' hulls."""
    return _squares(rows, _sizes(rows, thickness), [(-1, -1), (1, -1), (1, 1), (-1, 1)])


def _outline(rows: Floats, thickness: Floats) -> Floats:
    """Corners, and the front's middle and those of its edges (N, 17, 3), world mm."""
    middles = _squares(rows, _sizes(rows, thickness)[:1], [(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1)])
    return np.concatenate([_corners(rows, thickness), middles], axis=1)


def _squares(rows: Floats, sizes: Sequence[tuple[Floats, Floats]], places: Sequence[tuple[int, int]]) -> Floats:
    """Points at `places` (u, v) of squares, in half-widths, world mm."""
    centers, frames, *_ = parts_of(rows)
    u, v, k = frames.transpose(1, 0, 2)
    points = [
        centers - depth[:, None] * k + half[:, None] * (x * u + y * v) for depth, half in sizes for x, y in places
    ]
    return np.stack(points, axis=1)


def _normals(rows: Floats, thickness: Floats) -> Floats:
    """Unit normals (N, 9, 3) of the faces of the modules' hulls, one of those at both ends."""
    u, v, k = parts_of(rows)[1].transpose(1, 0, 2)
    found = [k]
    sizes = _sizes(rows, thickness)
    for (near, narrow), (far, wide) in pairwise(sizes):
        deep, grown = (far - near)[:, None], (wide - narrow)[:, None]
        found += [deep * side + grown * k for side in (u, -u, v, -v)]
    normals = np.stack(found, axis=1)
    return normals / np.linalg.norm(normals, axis=2, keepdims=True)


def _most(values: Floats) -> Floats:
    """The largest of the last axis, rounded off: a little more than it."""
    largest = values.max(axis=-1, keepdims=True)
    return largest[..., 0] + _SOFT * np.log(np.exp((values - largest) / _SOFT).sum(axis=-1))
