"""An X-ray system in one room with other scanners: what stands in the way of cones, of panels and of the patient.

Modules' parts count as convex bodies, as in `core.geometry.checks.hulls`; the tubes have no known size and are no bodies.
Sources may share a panel: equal ones are one body. A panel that overlaps with a source's own is found as such, and does not
stand in its cone's way as well. A cone is a lattice of `RAYS` x `RAYS` rays, each to an equal share of the panel.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ..arrays import Floats
from ..errors import InputError, several
from ..geometry.checks.field_of_view import find_blocked, hits, in_cone
from ..geometry.checks.hulls import TOUCH, Hulls
from ..geometry.checks.overlaps import penetration_depths
from ..geometry.finding import Finding
from ..geometry.module_parts import ModulePart
from ..geometry.scanner import Scanner
from ..geometry.system import PinholeSystem
from ..validation import instance, positive

RAYS = 48
_SHOWN = 4  # of the bodies in a cone's way, those that shadow most of it


@dataclass(frozen=True)
class ShadowedCone(Finding):
    """Bodies stand in the way of a fraction `share` of the rays from a source to its panel."""

    module: int
    share: float
    bodies: tuple[tuple[str, float], ...]  # each with its own share, the largest first
    message = "source {0.module}: {0.share:.2%} of its cone is blocked, {1}"

    def __str__(self) -> str:
        more = f" and {len(self.bodies) - _SHOWN} more" if len(self.bodies) > _SHOWN else ""
        largest = ", ".join(f"{share:.2%} by {body}" for body, share in self.bodies[:_SHOWN])
        return self.message.format(self, largest + more)


@dataclass(frozen=True)
class PanelOverlap(Finding):
    """A panel is inside other bodies, at most `depth` mm deep."""

    module: int
    bodies: tuple[str, ...]  # the deepest first
    depth: float
    message = "source {0.module}: its panel overlaps with {1}, up to {0.depth:.4g} mm deep"

    def __str__(self) -> str:
        return self.message.format(self, several(self.bodies, _SHOWN))


@dataclass(frozen=True)
class SwallowedSource(Finding):
    """A focal spot lies `depth` mm below the surface of a body."""

    module: int
    body: str
    depth: float
    message = "source {0.module}: its focal spot lies {0.depth:.4g} mm inside {0.body}"


@dataclass(frozen=True)
class PanelInView(Finding):
    """A panel stands in the way of a fraction `share` of the rays from a pinhole module's ROI."""

    module: int
    pinhole: int
    share: float
    message = "source {0.module}: its panel blocks {0.share:.2%} of the rays from the ROI of module {0.pinhole}"


@dataclass(frozen=True)
class InBore(Finding):
    """A source or its panel is nearer to the z axis than the bore's `radius`, mm."""

    module: int
    part: str
    distance: float  # mm, of its nearest point from the axis
    radius: float
    message = (
        "source {0.module}: its {0.part} is {0.distance:.4g} mm from the axis, inside the bore of {0.radius:.4g} mm"
    )


def find_in_room(
    system: Scanner, others: Sequence[Scanner] = (), *, bore: float | None = None, construction: object = None
) -> tuple[Finding, ...]:
    """What is wrong with an X-ray system beside other scanners, such as pinhole modules; their order is the sources'.

    Found are cones of which bodies block a part, panels that overlap with other panels or with modules, sources inside a
    body, panels between a module and its ROI, and sources and panels in the patient's bore, a cylinder around the z axis of
    radius `bore`, mm, if it is given. `construction` is that of the modules' collimators.
    """
    instance(system, Scanner, "find_in_room")
    panels = [part for part in system.parts() if part.kind == "panel"]
    if len(panels) != len(system):
        raise InputError(f"find_in_room: expected an X-ray system, got a {system.kind} system")
    bodies = [(f"the panel of source {panel.number}", panel) for panel in panels]
    for other in others:
        built = other.parts(construction if isinstance(other, PinholeSystem) else None)
        bodies += [(f"module {p.number}'s {p.kind}", p) for p in built if p.kind != "source"]
    hulls, names = Hulls.from_parts([part for _, part in bodies]), [name for name, _ in bodies]
    depths = [_depths(hulls, m) for m in range(len(system))]
    found: list[Finding] = []
    for m in range(len(system)):
        found += [*_shadow(system, m, hulls, names, depths[m]), *_overlaps(system, m, hulls, names, depths[m])]
    for other in others:
        if isinstance(other, PinholeSystem):
            found += _in_view(system, other, panels)
    if bore is not None:
        found += _in_bore(system, panels, positive(bore, "bore", "mm"))
    order = {number: m for m, number in enumerate(system.numbers.tolist())}
    return tuple(sorted(found, key=lambda finding: order[finding.modules[0]]))


def _sources(system: Scanner) -> Floats:
    return system.poses()[:, :3, 3]


def _shadow(
    system: Scanner, m: int, hulls: Hulls, names: Sequence[str], depths: dict[int, float]
) -> Iterator[ShadowedCone]:
    """What of the cone of source m, whose panel overlaps with the hulls of `depths`, the others block."""
    source, targets = _sources(system)[m], system[m].views((RAYS, RAYS)).rays(0)[1]
    ways = targets - source
    lengths = np.linalg.norm(ways, axis=1)
    directions = ways / lengths[:, None]
    axis = directions.mean(axis=0)
    axis /= np.linalg.norm(axis)
    half = np.arccos(np.clip((directions @ axis).min(), -1, 1))
    blocked, shares = np.zeros(len(ways), bool), dict[str, float]()
    for p in np.flatnonzero(in_cone(hulls, source, axis, half, lengths.max())).tolist():
        own = p == m or (p < len(system) and p in depths)
        if not own and (hit := hits(hulls, p, source, directions, lengths)).any():
            blocked |= hit
            shares[names[p]] = float(hit.mean())
    if shares:
        largest_first = tuple(sorted(shares.items(), key=lambda item: -item[1]))
        yield ShadowedCone(int(system.numbers[m]), float(blocked.mean()), largest_first)


def _depths(hulls: Hulls, m: int) -> dict[int, float]:
    """How deep, mm, hull m is inside others, by their index."""
    distance = np.linalg.norm(hulls.centers - hulls.centers[m], axis=1)
    near = np.flatnonzero(distance < hulls.radii + hulls.radii[m])
    near = near[near != m]
    depths = penetration_depths(hulls, np.full(len(near), m), near) if len(near) else np.zeros(0)
    return {p: depth for p, depth in zip(near.tolist(), depths.tolist(), strict=True) if depth > TOUCH}


def _overlaps(
    system: Scanner, m: int, hulls: Hulls, names: Sequence[str], depths: dict[int, float]
) -> Iterator[Finding]:
    number = int(system.numbers[m])
    others = [p for p in depths if np.abs(hulls.vertices[p] - hulls.vertices[m]).max() > TOUCH]
    if others:
        others.sort(key=lambda p: -depths[p])
        yield PanelOverlap(number, tuple(names[p] for p in others), depths[others[0]])
    inside = (hulls.offsets - hulls.normals @ _sources(system)[m]).min(axis=1)
    for p in np.flatnonzero(inside > TOUCH).tolist():
        yield SwallowedSource(number, names[p], float(inside[p]))


def _in_view(system: Scanner, pinholes: PinholeSystem, panels: Sequence[ModulePart]) -> list[Finding]:
    hulls = Hulls.from_parts(panels)
    hulls.numbers[:] = -1 - np.arange(len(panels))  # unlike those of the modules
    blocked = find_blocked(pinholes, hulls)
    return [PanelInView(int(system.numbers[-1 - one.by]), one.module, one.share) for one in blocked]


def _in_bore(system: Scanner, panels: Sequence[ModulePart], radius: float) -> list[Finding]:
    places = [("focal spot", _sources(system)[:, None]), ("panel", np.stack([p.vertices for p in panels]))]
    return [
        InBore(number, part, distance, radius)
        for part, corners in places
        for number, distance in zip(system.numbers.tolist(), map(_distance_from_axis, corners), strict=True)
        if distance < radius - TOUCH
    ]


def _distance_from_axis(corners: Floats) -> float:
    """Distance, mm, of a convex body with these corners (V, 3) from the z axis."""
    flat = corners[:, :2]
    angles = np.sort(np.arctan2(flat[:, 1], flat[:, 0]))
    if np.diff(angles, append=angles[0] + 2 * np.pi).max() < np.pi:  # the axis is within
        return 0.0
    ends = [(flat[i], flat[j] - flat[i]) for i, j in combinations(range(len(flat)), 2)] or [(flat[0], np.zeros(2))]
    return float(min(np.linalg.norm(a + _nearest(a, way) * way) for a, way in ends))


def _nearest(start: Floats, way: Floats) -> float | Floats:
    """Where on the way from `start`, from 0 to 1, the origin is nearest."""
    square = way @ way
    return 0.0 if square == 0 else np.clip(-(start @ way) / square, 0.0, 1.0)
