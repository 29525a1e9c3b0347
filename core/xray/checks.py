"""Checks of an X-ray system in one room with other scanners: obstacles in cones, around panels and in the patient's bore.

Modules' parts are convex bodies, as in `core.geometry.checks.hulls`; tubes have no known size and are no bodies. Sources may
share a panel: equal panels are one body. A panel that overlaps with a source's own panel is reported as such, and not as an
obstacle in its cone as well. A cone is a lattice of `RAYS` x `RAYS` rays, each to an equal share of the panel.
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
from ..geometry.module_parts import ModulePart
from ..geometry.scanner import Finding, Scanner
from ..geometry.system import PinholeSystem
from ..validation import instance, positive

RAYS = 48
_MAX_NAMED = 4  # number of bodies that a message names, the most important ones


@dataclass(frozen=True)
class ShadowedCone(Finding):
    """Finding: bodies block a fraction `share` of the rays from a source to its panel."""

    module: int
    share: float
    bodies: tuple[tuple[str, float], ...]  # each body with the share that it blocks, the largest first
    message = "source {0.module}: {0.share:.2%} of its cone is blocked, {1}"

    def __str__(self) -> str:
        texts = (f"{share:.2%} by {body}" for body, share in self.bodies)
        return self.message.format(self, several(texts, _MAX_NAMED))


@dataclass(frozen=True)
class PanelOverlap(Finding):
    """Finding: a panel penetrates other bodies, at most `depth` mm deep."""

    module: int
    bodies: tuple[str, ...]  # names of the bodies, the deepest first
    depth: float
    message = "source {0.module}: its panel overlaps with {1}, up to {0.depth:.4g} mm deep"

    def __str__(self) -> str:
        return self.message.format(self, several(self.bodies, _MAX_NAMED))


@dataclass(frozen=True)
class SwallowedSource(Finding):
    """Finding: a focal spot lies `depth` mm below the surface of a body."""

    module: int
    body: str
    depth: float
    message = "source {0.module}: its focal spot lies {0.depth:.4g} mm inside {0.body}"


@dataclass(frozen=True)
class PanelInView(Finding):
    """Finding: a panel blocks a fraction `share` of the rays from a pinhole module's ROI."""

    module: int
    pinhole: int
    share: float
    message = "source {0.module}: its panel blocks {0.share:.2%} of the rays from the ROI of module {0.pinhole}"


@dataclass(frozen=True)
class InBore(Finding):
    """Finding: a source or its panel is nearer to the z axis than the bore's `radius`, mm."""

    module: int
    part: str
    distance: float  # mm, from the axis to the part's nearest point
    radius: float
    message = (
        "source {0.module}: its {0.part} is {0.distance:.4g} mm from the axis, inside the bore of {0.radius:.4g} mm"
    )


def find_in_room(
    system: Scanner, others: Sequence[Scanner] = (), *, bore: float | None = None, construction: object = None
) -> tuple[Finding, ...]:
    """Find the mechanical problems of an X-ray system in one room with other scanners, such as pinhole modules.

    The findings, in the order of the sources, are cones that bodies block in part, panels that overlap with other panels or
    with modules, sources inside a body, panels between a module and its ROI, and sources and panels in the patient's bore, a
    cylinder around the z axis of radius `bore`, mm, if it is given. `construction` is that of the modules' collimators.
    """
    instance(system, Scanner, "find_in_room")
    panels = [part for part in system.parts() if part.kind == "panel"]
    if len(panels) != len(system):
        raise InputError(f"find_in_room: expected an X-ray system, got a {system.kind} system")
    bodies = [(f"the panel of source {panel.number}", panel) for panel in panels]
    for scanner in others:
        parts = scanner.parts(construction)
        bodies += [(f"module {p.number}'s {p.kind}", p) for p in parts if p.kind != "source"]
    hulls, names = Hulls.from_parts([part for _, part in bodies]), [name for name, _ in bodies]
    depths = [_overlap_depths(hulls, m) for m in range(len(system))]
    findings: list[Finding] = []
    for m in range(len(system)):
        findings += [*_shadows(system, m, hulls, names, depths[m]), *_overlaps(system, m, hulls, names, depths[m])]
    for scanner in others:
        if isinstance(scanner, PinholeSystem):
            findings += _panels_in_view(system, scanner, panels)
    if bore is not None:
        findings += _parts_in_bore(system, panels, positive(bore, "bore", "mm"))
    order = {number: m for m, number in enumerate(system.numbers.tolist())}
    return tuple(sorted(findings, key=lambda finding: order[finding.modules[0]]))


def _sources(system: Scanner) -> Floats:
    """Return the focal spots (N, 3), mm."""
    return system.poses()[:, :3, 3]


def _shadows(system: Scanner, m: int, hulls: Hulls, names: list[str], depths: dict[int, float]) -> Iterator[Finding]:
    """Yield the bodies that block the cone of source m; the hulls in `depths` overlap with its panel and are left out."""
    source, targets = _sources(system)[m], system[m].views((RAYS, RAYS)).rays(0)[1]
    rays = targets - source
    lengths = np.linalg.norm(rays, axis=1)
    directions = rays / lengths[:, None]
    axis = directions.mean(axis=0)
    axis /= np.linalg.norm(axis)
    half_angle = np.arccos(np.clip((directions @ axis).min(), -1, 1))
    blocked, shares = np.zeros(len(rays), bool), dict[str, float]()
    for p in np.flatnonzero(in_cone(hulls, source, axis, half_angle, lengths.max())).tolist():
        is_panel = p == m or (p < len(system) and p in depths)
        if not is_panel and (hit := hits(hulls, p, source, directions, lengths)).any():
            blocked |= hit
            shares[names[p]] = float(hit.mean())
    if shares:
        largest_first = tuple(sorted(shares.items(), key=lambda item: -item[1]))
        yield ShadowedCone(int(system.numbers[m]), float(blocked.mean()), largest_first)


def _overlap_depths(hulls: Hulls, m: int) -> dict[int, float]:
    """Return the penetration depths, mm, of hull m in other hulls, by their index."""
    distance = np.linalg.norm(hulls.centers - hulls.centers[m], axis=1)
    near = np.flatnonzero(distance < hulls.radii + hulls.radii[m])
    near = near[near != m]
    depths = penetration_depths(hulls, np.full(len(near), m), near) if len(near) else np.zeros(0)
    return {p: depth for p, depth in zip(near.tolist(), depths.tolist(), strict=True) if depth > TOUCH}


def _overlaps(system: Scanner, m: int, hulls: Hulls, names: list[str], depths: dict[int, float]) -> Iterator[Finding]:
    """Yield the bodies with which the panel of source m overlaps, and those that contain its focal spot."""
    number = int(system.numbers[m])
    overlapping = [p for p in depths if np.abs(hulls.vertices[p] - hulls.vertices[m]).max() > TOUCH]
    if overlapping:
        overlapping.sort(key=lambda p: -depths[p])
        yield PanelOverlap(number, tuple(names[p] for p in overlapping), depths[overlapping[0]])
    inside = (hulls.offsets - hulls.normals @ _sources(system)[m]).min(axis=1)
    for p in np.flatnonzero(inside > TOUCH).tolist():
        yield SwallowedSource(number, names[p], float(inside[p]))


def _panels_in_view(system: Scanner, pinholes: PinholeSystem, panels: Sequence[ModulePart]) -> list[Finding]:
    """Return a finding for each panel that stands between a pinhole module's hole and its ROI."""
    hulls = Hulls.from_parts(panels)
    hulls.numbers[:] = -1 - np.arange(len(panels))  # unlike the modules' numbers
    blocked = find_blocked(pinholes, hulls)
    return [PanelInView(int(system.numbers[-1 - finding.by]), finding.module, finding.share) for finding in blocked]


def _parts_in_bore(system: Scanner, panels: Sequence[ModulePart], radius: float) -> list[Finding]:
    """Return the focal spots and panels nearer to the z axis than `radius`, mm."""
    corners_by_part = [("focal spot", _sources(system)[:, None]), ("panel", np.stack([p.vertices for p in panels]))]
    return [
        InBore(number, part, distance, radius)
        for part, corners in corners_by_part
        for number, distance in zip(system.numbers.tolist(), map(_distance_from_axis, corners), strict=True)
        if distance < radius - TOUCH
    ]


def _distance_from_axis(corners: Floats) -> float:
    """Return the distance, mm, of a convex body with these corners (V, 3) from the z axis."""
    xy = corners[:, :2]
    angles = np.sort(np.arctan2(xy[:, 1], xy[:, 0]))
    if np.diff(angles, append=angles[0] + 2 * np.pi).max() < np.pi:  # the corners surround the axis
        return 0.0
    edges = [(xy[i], xy[j] - xy[i]) for i, j in combinations(range(len(xy)), 2)] or [(xy[0], np.zeros(2))]
    return float(min(np.linalg.norm(a + _nearest(a, edge) * edge) for a, edge in edges))


def _nearest(start: Floats, edge: Floats) -> float | Floats:
    """Return the position, from 0 to 1, of the point of an edge (2,) from `start` (2,) that is nearest to the origin."""
    squared_length = edge @ edge
    return 0.0 if squared_length == 0 else np.clip(-(start @ edge) / squared_length, 0.0, 1.0)
