"""Photons that reach a crystal through the solid of collimators: beside its own hole, and through a neighbour's hole.

They go straight. Of those on a line, ``exp(-mu path)`` pass, with the path in the plates and walls of the collimators as
`Collimator` says that they are built: square frusta around the channels. What is scattered in a wall is not modelled.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Floats
from ..geometry.collimator import Construction
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..physics import aperture
from ..physics.crystal import absorbed_share, share_inside
from ..rays.bundles import Beam
from ..rays.ray_geometry import Fan, view_rays
from .model import Model
from .pixel_points import lattices, offsets, points_needed, shadow_edges

LEAST_SHARE = 1e-4
"""Holes whose lines to a crystal all count less, by the line along the axis of its own hole, are left out."""

_PLATE = 2.0  # mm, of a plate that lets nothing pass, as `Construction` builds it
_BESIDE = 1, 2, 4  # points beside the hole, to either side: before the channel, where its walls begin, and farther out
_PLACES_BESIDE, _PLACES_OF_HOLES = 13, 33  # along each side of a crystal
_TRIED = np.linspace(-0.49, 0.49, 7)  # of the crystal's side, where lines to it are tried


class Solids:
    """The collimators and crystals of M modules, as straight lines cross them.

    Lines are points (..., 3, P) on them, world mm, and their unit vectors. `which` modules is an index, or
    indices in a shape that goes before the lines' two axes.
    """

    def __init__(self, model: Any) -> None:
        optics, self.system, self.wall = model.optics, model.system, model.wall_thickness
        n = len(self.system)
        numbers = optics.plate_thickness or _PLATE, optics.opening_angle, optics.aperture_mu
        self.plate, angles, self.mu = (np.broadcast_to(x, n).astype(float) for x in numbers)
        constructions = (Construction(t, self.wall, angle) for t, angle in zip(self.plate, angles, strict=True))
        built = [self.system[m : m + 1].collimators(each)[0] for m, each in enumerate(constructions)]
        self.front, self.channel = np.array([(each.front_half_width, each.channel_half_width) for each in built]).T
        self.length, self.half = self.system.collimator_length, self.system.detector_side / 2
        self.frames = self.system.frames()

    def attenuation(self, which: Any, lines: tuple[Floats, Floats], through_hole: bool = False) -> Floats:
        """mu times the path (..., P) in the walls of modules, and in their plates but of lines `through_hole`."""
        own = (x[which] for x in (self.plate / 2, self.front, self.channel, self.length, self.half, self.mu))
        back, front, channel, length, half, mu = own
        first, outside = -back, half + self.wall
        if through_hole:  # from the plate's back on
            first, front = back, front + (outside - front) * 2 * back / (length + back)
        path = self._chord(which, lines, first, length, front, outside)
        path -= self._chord(which, lines, back, length, channel, half)
        return mu[..., None] * path

    def crystal(self, which: Any, lines: tuple[Floats, Floats]) -> NDArray[np.bool_]:
        """Whether lines pass the crystals of modules, (..., P)."""
        own = (x[which] for x in (self.length, self.length + self.system.detector_thickness, self.half))
        front, back, half = own
        return self._chord(which, lines, front, back, half, half) > 0

    def _chord(
        self, which: Any, lines: tuple[Floats, Floats], first: Array, last: Array, start: Array, end: Array
    ) -> Floats:
        """Lengths, mm, in square frusta from depth `first` to `last` behind the holes, of half-widths `start` and `end`."""
        first, last, start, end = (x[..., None] for x in (first, last, start, end))
        frames, centers = self.frames[which], self.system.centers[which][..., None]
        slope = (end - start) / (last - first)
        (x, y, up), (dx, dy, rise) = (np.moveaxis(frames @ each, -2, 0) for each in (lines[0] - centers, lines[1]))
        half, opens = start - slope * (up + first), -slope * rise
        sides = [(half - sign * p, sign * dp - opens) for p, dp in ((x, dx), (y, dy)) for sign in (1, -1)]
        enter: Floats
        leave: Floats
        enter, leave = np.array(-np.inf), np.array(np.inf)
        for room, rate in [(last + up, -rise), (-up - first, rise), *sides]:
            at, enters = room / np.where(rate == 0, 1e-30, rate), rate < 0
            enter = np.where(enters, np.maximum(enter, at), enter)
            leave = np.where(enters, leave, np.minimum(leave, at))
        return np.maximum(leave - enter, 0.0)

    def beside(self, m: int, is_open: bool) -> Floats:
        """Points (N, 3) beside the hole in its plane: u, v and area; of the walls, and of the plate if it `is_open`.

        They reach half way to the next pinhole, at most as far as the outside of the walls at the crystal.
        """
        centers, edge = self.system.centers, self.front[m]
        apart = np.sort(np.linalg.norm(centers - centers[m], axis=1))
        reach = max(edge, min([self.half[m] + self.wall, *apart[1:2] / 2]))
        zones = zip((0.0, self.channel[m], edge), (self.channel[m], edge, reach), _BESIDE, strict=True)
        gauss = ((a, b - a, *np.polynomial.legendre.leggauss(n)) for a, b, n in zones)  # type: ignore[no-untyped-call]
        x, w = np.hstack([(a + size * (x + 1) / 2, size * w / 2) for a, size, x, w in gauss])
        (u, v), (w, h) = np.meshgrid([*-x, *x], [*-x, *x]), np.meshgrid([*w, *w], [*w, *w])
        fine = (np.arange(16) + 0.5) / 16 - 0.5
        along, across = u[..., None, None] + w[..., None, None] * fine, v[..., None] + h[..., None] * fine
        from_middle = np.hypot(along, across[..., None])
        area = w * h * (from_middle > self.system.pinhole_diameter[m] / 2).mean(axis=(2, 3))
        area[(np.maximum(abs(u), abs(v)) < edge) & (not is_open)] = 0.0
        points = np.stack([u, v, area], axis=-1)
        return points[points[..., 2] > 0]


@dataclass(frozen=True, eq=False)
class ThroughWalls(Model):
    """What modules count besides the photons through their own holes: by rays, with the walls' attenuation.

    A pixel of area p_u p_v counts, of a line of length D from its point to a point that stands for an area a of a hole or
    of the plane beside one, ``p_u p_v a cos cos' / (4 pi D^2) exp(-mu path)`` times what `Emission` says of crystal, time
    and photons; the angles are those to the normals of the crystal and of the hole. Through a neighbour's hole, as large as
    d_e, lines pass within its cone. Lines that meet other modules' crystals are not counted.
    """

    model: Any  # the `Emission` whose modules count, with as many rays as what comes through walls needs
    whole: Any  # that of the whole scanner
    solids: Solids  # its
    own: NDArray[np.int64]  # (M,): the modules' places in the whole scanner
    holes: NDArray[np.int64]  # (M,): those of the modules through whose holes, or beside whose own, photons come
    between: tuple[NDArray[np.int64], ...]  # M times those of other modules whose solids lines meet

    name = "photons through walls"
    takes = ("activity",)

    @property
    def mu(self) -> Any:  # type: ignore[override]
        """That of the model."""
        return self.model.mu

    @property
    def efficiency(self) -> Any:  # type: ignore[override]
        """That of the model."""
        return self.model.efficiency

    def of_views(self, which: NDArray[np.integer]) -> Self:
        """The model of the modules `which` (indices) alone."""
        own = {"own": self.own[which], "holes": self.holes[which], "between": tuple(self.between[m] for m in which)}
        return replace(self, model=self.model.of_views(which), **own)

    def check(self, views: Views) -> None:
        """Raise `InputError` unless `views` are of the modules."""
        self.model.check(views)

    def response(self, views: Views, m: int) -> Any:
        """That of the model."""
        return self.model.response(views, m)

    def beams(self, views: Views, m: int, grid: Grid) -> Iterator[Beam]:
        """Rays from points of the hole, or of the plane beside it, through the grid, from the points of the crystal."""
        model, hole, n_hole, n_places = self.model, self.holes[m], 0, _PLACES_BESIDE
        (u, v, _), (*axes, k) = self.whole._frames[hole], model._frames[m]
        system = model.system
        center, l, side = system.centers[m], system.collimator_length[m], system.detector_side[m]
        rays, scale, pitch = view_rays(views, m), model._crystal_scale(views, m), model.crystal_pitch(views, m)
        middle = scale * (rays.corner - center) - l * k  # from that of the crystal, point-inverted
        n = model.pixel_points or 1
        if hole == self.own[m]:
            points = self.solids.beside(hole, self.whole.plate_thickness is not None)
        else:
            n_hole, n_places = model.hole_points(views, m, grid), _PLACES_OF_HOLES
            each = aperture.openings(n_hole, self.whole.effective_diameter[hole])
            points = np.array([(one.x, one.y, one.hole) for one in each])
            n = model.pixel_points or points_needed(shadow_edges(views, m, grid), model.tolerance, len(points))
        # Between places on the crystal weights' logarithms are linear; pixels have the shares of them that are on it.
        places, spread = np.linspace(-side / 2, side / 2, n_places), []
        of_axes = zip(axes, pitch, (rays.column_step, rays.row_step), views.shape[::-1], strict=True)
        for axis, size, step, pixels in of_axes:
            at = -(middle @ axis + scale * (step @ axis) * np.arange(pixels))
            linear = np.stack([np.interp(at, places, hat) for hat in np.eye(n_places)], axis=1)
            spread += [linear, share_inside(at, size, side)]
        across = np.stack(np.meshgrid(places, places)).reshape(2, -1)
        for layer, z in enumerate(model.optics.depths(system.detector_thickness[m])):
            ends = (center - (l + z) * k)[:, None] + np.stack(axes, axis=1) @ across
            starts = self.whole.system.centers[hole] + points[:, :1] * u + points[:, 1:2] * v
            counted = self._counted(m, layer, starts[..., None], ends) * (points[:, 2:] * pitch[0] * pitch[1] / n)
            first = center - (l + z) * k - middle
            tables = np.log(counted + 1e-30).reshape(-1, n_places, n_places)
            for point, table, start in zip(starts, tables, lattices(n_hole, len(points)), strict=True):
                far = max(float(((grid.corners() - point) @ k).max() / ((point - first) @ k)), 1.0)
                steps = far * scale * rays.row_step, far * scale * rays.column_step
                seen = (1 + l / system.pinhole_distance[m]) * np.array([point @ axis for axis in axes]) / pitch
                shifts = offsets(n, start / n**0.5 - seen)[:, ::-1]  # from the isocentre all fill the pixel evenly
                fan = Fan(point, point + far * (point - first), *steps, views.shape, shifts)
                yield Beam(fan, partial(_weigh, spread, table, n))

    def _counted(self, m: int, layer: int, points: Floats, ends: Floats) -> Floats:
        """What a mm^2 of module m's crystal counts along lines from `ends` (3, P), for a mm^2 at each point (N, 3, 1)."""
        model = self.model
        optics, thickness = model._optics_of(m), model.system.detector_thickness[m]
        counted = passing(self.whole, self.solids, self.own[m], self.holes[m], self.between[m], points, ends)
        if optics.crystal_mu is not None:
            towards = points - ends
            cosine = model._frames[m, 2] @ towards / np.linalg.norm(towards, axis=1)
            counted *= absorbed_share(cosine, optics.crystal_mu, thickness, optics.depths(thickness), layer)
        seconds = float(np.broadcast_to(model.effective_time, len(model.system))[m])
        return counted * (seconds * optics.photons_per_decay / (4 * np.pi))


def _weigh(spread: list[Floats], table: Floats, n: int, rows: slice, columns: slice, which: slice) -> Floats:
    along_u, share_u, along_v, share_v = spread
    weights = np.exp(along_v[rows] @ table @ along_u[columns].T) * share_v[rows, None] * share_u[columns]
    return np.broadcast_to(weights, (len(range(n)[which]), *weights.shape))


def passing(
    whole: Any, solids: Solids, own: int, hole: Any, between: NDArray[np.int64], points: Floats, ends: Floats
) -> Floats:
    """``cos cos' exp(-mu path) / D^2`` (..., P) of lines from `ends` (3, P) on a crystal to points (..., 3, 1).

    The points are in the plane of a `hole`, or of a hole each.
    """
    towards = points - ends
    distance = np.linalg.norm(towards, axis=-2, keepdims=True)
    towards /= distance
    lines = ends, towards
    cosine = (solids.frames[hole][..., 2:, :] @ towards)[..., 0, :]
    attenuation = solids.attenuation(own, lines)
    passed = cosine.clip(min=0) * (solids.frames[own][2] @ towards) / distance[..., 0, :] ** 2
    if np.any(hole != own):
        tangent = np.broadcast_to(whole.optics.tangent, len(solids.half))[hole]
        passed *= (cosine > np.cos(np.arctan(tangent))[..., None]) & ~solids.crystal(hole, lines)
        attenuation = attenuation + solids.attenuation(hole, lines, through_hole=True)
    for third in between:
        attenuation = attenuation + solids.attenuation(third, lines)
        passed *= ~solids.crystal(third, lines)
    return passed * np.exp(-attenuation)


def models_with_walls(model: Any) -> tuple[Model, ...]:
    """A model of emission without what passes walls, and models of that: beside the own hole, and by neighbours' holes.

    Of each module the holes come in order of the largest weight of a line through them.
    """
    whole = replace(model, wall_thickness=None, background=0.0)
    solids, n, none = Solids(model), len(model.system), np.empty(0, np.int64)
    holes, shares, between = np.arange(n)[:, None].repeat(n, 1), np.zeros((n, n)), [[none] * n for _ in range(n)]
    areas = np.pi / 4 * whole.effective_diameter**2
    for m, ((u, v, k), center) in enumerate(zip(solids.frames, model.system.centers, strict=True)):
        tried = 2 * solids.half[m] * np.stack(np.meshgrid(_TRIED, _TRIED)).reshape(2, -1)
        ends = (center - solids.length[m] * k)[:, None] + np.stack([u, v], axis=1) @ tried
        on_axis = areas[m] / solids.length[m] ** 2
        u_beside, v_beside, area = solids.beside(m, whole.plate_thickness is not None).T[..., None, None]
        points = center[:, None] + u_beside * u[:, None] + v_beside * v[:, None]
        beside = (area[..., 0] * passing(whole, solids, m, m, none, points, ends)).sum(axis=0).max() / on_axis
        others = np.delete(np.arange(n), m)
        places = model.system.centers[..., None]
        found = areas[others] * passing(whole, solids, m, others, none, places[others], ends).max(axis=-1) / on_axis
        for hole in others[found > LEAST_SHARE]:
            third = others[others != hole]
            towards = (places[hole] - ends) / np.linalg.norm(places[hole] - ends, axis=0)
            meets = (solids.attenuation(third, (ends, towards)) > 0) | solids.crystal(third, (ends, towards))
            between[m][hole] = third[meets.any(axis=-1)]
            seen = passing(whole, solids, m, hole, between[m][hole], places[hole], ends)
            shares[m, hole] = areas[hole] * seen.max() / on_axis
        holes[m] = np.argsort(-shares[m], kind="stable")
        holes[m] = [m, *holes[m][holes[m] != m]]
        shares[m] = [beside, *shares[m][holes[m][1:]]]
    parts: list[Model] = [whole]
    for rank, most in enumerate(shares.max(axis=0).tolist()):
        if most > LEAST_SHARE:
            of_pairs = tuple(between[m][hole] for m, hole in enumerate(holes[:, rank]))
            own = _coarser(whole, most), whole, solids, np.arange(n), holes[:, rank]
            parts.append(ThroughWalls(*own, of_pairs))
    return tuple(parts)


def _coarser(model: Any, share: float) -> Any:
    """The model with as few rays as keep the errors of what is this `share` of a pixel as small as those of the rest."""
    changes: dict[str, Any] = {"tolerance": min(1.0, model.tolerance / min(share, 1.0))}
    if model.hole != "point" and model.aperture_points is None:
        tolerance = (model.aperture_tolerance or 0.1) / min(share, 1.0)
        changes |= {"hole": "rays", "aperture_tolerance": min(1.0, tolerance)}
    return replace(model, **changes)
