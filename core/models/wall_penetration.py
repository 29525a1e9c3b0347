"""Photons that reach a crystal through the solid of collimators: beside its own hole, and through a neighbour's hole.

They go straight. Of those on a line, ``exp(-mu path)`` pass, with the path in the plates and walls of the collimators as
`Collimator` says that they are built: square frusta around the channels. Scatter in walls is not modelled.
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
"""Smallest weight of a hole that is taken into account: the largest one of its lines to a crystal, in units of that of
the line along the axis of the crystal's own hole."""

Lines = tuple[Floats, Floats]
"""Points (..., 3, P) on straight lines, world mm, and the unit vectors of the lines."""

_PLATE = 2.0  # mm, thickness of a plate that lets nothing pass, as `Construction` builds it
_POINTS_BESIDE = 1, 2, 4  # to either side of the hole: before the channel, where its walls begin, and farther out
_NODES_BESIDE, _NODES_OF_HOLES = 13, 33  # along each side of a crystal, between which weights are interpolated
_TRIAL_POSITIONS = np.linspace(-0.49, 0.49, 7)  # in units of the crystal's side, of lines that choose the holes


class Solids:
    """Collimators and crystals of M modules, with the paths of straight lines in them.

    In its methods `modules` is an index, or indices in a shape that goes before the two axes of `lines`.
    """

    def __init__(self, model: Any) -> None:
        optics, self.system, self.wall = model.optics, model.system, model.wall_thickness
        n = len(self.system)
        numbers = optics.plate_thickness or _PLATE, optics.opening_angle, optics.aperture_mu
        self.plate, angles, self.mu = (np.broadcast_to(x, n).astype(float) for x in numbers)
        constructions = (Construction(t, self.wall, angle) for t, angle in zip(self.plate, angles, strict=True))
        bodies = [self.system[m : m + 1].collimators(construction)[0] for m, construction in enumerate(constructions)]
        self.front, self.channel = np.array([(body.front_half_width, body.channel_half_width) for body in bodies]).T
        self.length, self.half = self.system.collimator_length, self.system.detector_side / 2
        self.frames = self.system.frames()

    def attenuation(self, modules: Any, lines: Lines, through_hole: bool = False) -> Floats:
        """Return mu times the path (..., P) of lines in the walls of modules, and in their plates unless `through_hole`."""
        sizes = (x[modules] for x in (self.plate / 2, self.front, self.channel, self.length, self.half, self.mu))
        back, front, channel, length, half, mu = sizes
        first, outside = -back, half + self.wall
        if through_hole:  # the walls begin at the plate's back
            first, front = back, front + (outside - front) * 2 * back / (length + back)
        path = self._chord(modules, lines, first, length, front, outside)
        path -= self._chord(modules, lines, back, length, channel, half)
        return mu[..., None] * path

    def passes_crystal(self, modules: Any, lines: Lines) -> NDArray[np.bool_]:
        """Return whether lines pass the crystals of modules, (..., P)."""
        sizes = self.length, self.length + self.system.detector_thickness, self.half
        front, back, half = (x[modules] for x in sizes)
        return self._chord(modules, lines, front, back, half, half) > 0

    def _chord(self, modules: Any, lines: Lines, first: Array, last: Array, start: Array, end: Array) -> Floats:
        """Return lengths of lines, mm, in square frusta from depth `first` to `last` behind the holes.

        The frusta have the half-width `start` at the depth `first` and `end` at `last`, mm.
        """
        first, last, start, end = (x[..., None] for x in (first, last, start, end))
        frames, centers = self.frames[modules], self.system.centers[modules][..., None]
        slope = (end - start) / (last - first)
        points, directions = lines[0] - centers, lines[1]
        (x, y, up), (dx, dy, rise) = (np.moveaxis(frames @ vectors, -2, 0) for vectors in (points, directions))
        half, opening = start - slope * (up + first), -slope * rise
        sides = [(half - sign * p, sign * dp - opening) for p, dp in ((x, dx), (y, dy)) for sign in (1, -1)]
        enter, leave = np.full(1, -np.inf), np.full(1, np.inf)
        # Of each bounding plane the distance of the line's point, and by how much it falls per mm of the line.
        for distance, rate in [(last + up, -rise), (-up - first, rise), *sides]:
            crossing, enters = distance / np.where(rate == 0, 1e-30, rate), rate < 0
            enter = np.where(enters, np.maximum(enter, crossing), enter)
            leave = np.where(enters, leave, np.minimum(leave, crossing))
        return np.maximum(leave - enter, 0.0)

    def points_beside(self, m: int, is_open: bool) -> Floats:
        """Return points (N, 3) beside hole m in its plane: u, v, and the area that each stands for, mm.

        They are in the walls, and in the plate if photons pass it (`is_open`). They reach half way to the next pinhole, at
        most as far as the outside of the walls at the crystal.
        """
        centers, edge = self.system.centers, self.front[m]
        distances = np.sort(np.linalg.norm(centers - centers[m], axis=1))
        reach = max(edge, min([self.half[m] + self.wall, *distances[1:2] / 2]))
        zones = zip((0.0, self.channel[m], edge), (self.channel[m], edge, reach), _POINTS_BESIDE, strict=True)
        gauss = ((a, b - a, *np.polynomial.legendre.leggauss(n)) for a, b, n in zones)  # type: ignore[no-untyped-call]
        x, w = np.hstack([(a + size * (x + 1) / 2, size * w / 2) for a, size, x, w in gauss])
        (u, v), (w, h) = np.meshgrid([*-x, *x], [*-x, *x]), np.meshgrid([*w, *w], [*w, *w])
        # The part of each point's rectangle outside the hole, by 16 x 16 points of it.
        fine = (np.arange(16) + 0.5) / 16 - 0.5
        fine_u, fine_v = u[..., None, None] + w[..., None, None] * fine, v[..., None] + h[..., None] * fine
        radius = np.hypot(fine_u, fine_v[..., None])
        area = w * h * (radius > self.system.pinhole_diameter[m] / 2).mean(axis=(2, 3))
        area[(np.maximum(abs(u), abs(v)) < edge) & (not is_open)] = 0.0
        points = np.stack([u, v, area], axis=-1)
        return points[points[..., 2] > 0]


@dataclass(frozen=True, eq=False)
class ThroughWalls(Model):
    """Counts of modules besides the photons through their own holes: by rays, with the walls' attenuation.

    A pixel of area p_u p_v detects, along a line of length D from its point to a point that stands for an area a of a hole
    or of the plane beside one, ``p_u p_v a cos cos' / (4 pi D^2) exp(-mu path)`` times the factors of `Emission` for
    crystal, time and photons; the angles are those to the normals of the crystal and of the hole. Through a neighbour's
    hole, as large as d_e, lines pass within its cone. Lines that meet other modules' crystals have no weight.
    """

    model: Any
    """`Emission` of the modules whose counts these are, with as many rays as photons through walls need."""
    scanner: Any
    """`Emission` of the whole scanner."""
    solids: Solids
    """Solids of the whole scanner."""
    modules: NDArray[np.int64]
    """(M,), indices of the modules in the whole scanner."""
    holes: NDArray[np.int64]
    """(M,), indices in it of the modules through whose holes photons come, or beside whose own hole."""
    between: tuple[NDArray[np.int64], ...]
    """M arrays of indices in it of other modules whose solids the lines meet."""

    name = "photons through walls"
    takes = ("activity",)

    @property
    def mu(self) -> Any:  # type: ignore[override]
        """Attenuation coefficients of `model`."""
        return self.model.mu

    @property
    def efficiency(self) -> Any:  # type: ignore[override]
        """Efficiencies of `model`."""
        return self.model.efficiency

    def of_views(self, which: NDArray[np.integer]) -> Self:
        """Return the model of the modules `which` alone, indices from 0."""
        between = tuple(self.between[m] for m in which)
        chosen = {"modules": self.modules[which], "holes": self.holes[which], "between": between}
        return replace(self, model=self.model.of_views(which), **chosen)

    def check(self, views: Views) -> None:
        """Raise `InputError` unless `views` are of the modules."""
        self.model.check(views)

    def pixel_parts(self, views: Views, grid: Grid) -> int:
        """Return the number of parts along a pixel's side that the response of `model` needs."""
        return self.model.pixel_parts(views, grid)

    def response(self, views: Views, m: int, parts: int) -> Any:
        """Return the detector's response of `model` in view m."""
        return self.model.response(views, m, parts)

    def beams(self, views: Views, m: int, grid: Grid) -> Iterator[Beam]:
        """Yield rays from points of the hole, or of the plane beside it, through the grid, with their weights."""
        model, hole, n_hole, n_nodes = self.model, self.holes[m], 0, _NODES_BESIDE
        (u, v, _), (*axes, k) = self.scanner._frames[hole], model._frames[m]
        system = model.system
        center, l, side = system.centers[m], system.collimator_length[m], system.detector_side[m]
        rays, scale, pitch = view_rays(views, m), model._crystal_scale(views, m), model.crystal_pitch(views, m)
        first = scale * (rays.corner - center) - l * k  # pixel, from the crystal's centre, point-inverted
        n = model.pixel_points or 1
        if hole == self.modules[m]:
            points = self.solids.points_beside(hole, self.scanner.plate_thickness is not None)
        else:
            n_hole, n_nodes = model.hole_points(views, m, grid), _NODES_OF_HOLES
            openings = aperture.openings(n_hole, self.scanner.effective_diameter[hole])
            points = np.array([(opening.x, opening.y, opening.hole) for opening in openings])
            n = model.pixel_points or points_needed(shadow_edges(views, m, grid), model.tolerance, len(points))
        # The logarithm of the weights is interpolated linearly between nodes on the crystal; pixels have their part on it.
        nodes, factors = np.linspace(-side / 2, side / 2, n_nodes), []
        image_axes = zip(axes, pitch, (rays.column_step, rays.row_step), views.shape[::-1], strict=True)
        for axis, size, step, n_pixels in image_axes:
            positions = -(first @ axis + scale * (step @ axis) * np.arange(n_pixels))
            interpolation = np.stack([np.interp(positions, nodes, hat) for hat in np.eye(n_nodes)], axis=1)
            factors += [interpolation, share_inside(positions, size, side)]
        node_grid = np.stack(np.meshgrid(nodes, nodes)).reshape(2, -1)
        for layer, z in enumerate(model.optics.depths(system.detector_thickness[m])):
            ends = (center - (l + z) * k)[:, None] + np.stack(axes, axis=1) @ node_grid
            starts = self.scanner.system.centers[hole] + points[:, :1] * u + points[:, 1:2] * v
            weights = self._weights(m, layer, starts[..., None], ends) * (points[:, 2:] * pitch[0] * pitch[1] / n)
            first_end = center - (l + z) * k - first
            tables = np.log(weights + 1e-30).reshape(-1, n_nodes, n_nodes)
            for point, table, start in zip(starts, tables, lattices(n_hole, len(points)), strict=True):
                far = max(float(((grid.corners() - point) @ k).max() / ((point - first_end) @ k)), 1.0)
                steps = far * scale * rays.row_step, far * scale * rays.column_step
                shadow = (1 + l / system.pinhole_distance[m]) * np.array([point @ axis for axis in axes]) / pitch
                shifts = offsets(n, start / n**0.5 - shadow)[:, ::-1]  # from the isocentre all fill the pixel evenly
                fan = Fan(point, point + far * (point - first_end), *steps, views.shape, shifts)
                yield Beam(fan, partial(_node_weights, factors, table, n))

    def _weights(self, m: int, layer: int, points: Floats, ends: Floats) -> Floats:
        """Return the expected counts per mm^2 of module m's crystal and mm^2 at each point (N, 3, 1), along lines.

        The lines go from `ends` (3, P) on the crystal to the points; the result is (N, P), per decay / mm^3 mm.
        """
        model = self.model
        optics, thickness = model._optics_of(m), model.system.detector_thickness[m]
        weights = line_weights(self.scanner, self.solids, self.modules[m], self.holes[m], self.between[m], points, ends)
        if optics.crystal_mu is not None:
            directions = points - ends
            cosine = model._frames[m, 2] @ directions / np.linalg.norm(directions, axis=1)
            weights *= absorbed_share(cosine, optics.crystal_mu, thickness, optics.depths(thickness), layer)
        seconds = float(np.broadcast_to(model.effective_time, len(model.system))[m])
        return weights * (seconds * optics.photons_per_decay / (4 * np.pi))


def _node_weights(factors: list[Floats], table: Floats, n: int, rows: slice, columns: slice, shifts: slice) -> Floats:
    """Return the rays' weights (shifts, rows, columns) from their logarithms at the nodes, `table`.

    `factors` are the interpolation matrix and the pixels' fraction on the crystal, along u and along v; n is the number of
    shifts.
    """
    matrix_u, fraction_u, matrix_v, fraction_v = factors
    weights = np.exp(matrix_v[rows] @ table @ matrix_u[columns].T) * fraction_v[rows, None] * fraction_u[columns]
    return np.broadcast_to(weights, (len(range(n)[shifts]), *weights.shape))


def line_weights(
    scanner: Any, solids: Solids, module: int, hole: Any, between: NDArray[np.int64], points: Floats, ends: Floats
) -> Floats:
    """Return ``cos cos' exp(-mu path) / D^2`` (..., P) of lines from `ends` (3, P) on a crystal to points (..., 3, 1).

    The points are in the plane of a `hole`, or of one hole each; `between` are other modules whose solids lines may meet.
    """
    directions = points - ends
    distance = np.linalg.norm(directions, axis=-2, keepdims=True)
    directions /= distance
    lines = ends, directions
    cosine = (solids.frames[hole][..., 2:, :] @ directions)[..., 0, :]
    attenuation = solids.attenuation(module, lines)
    weights = cosine.clip(min=0) * (solids.frames[module][2] @ directions) / distance[..., 0, :] ** 2
    if np.any(hole != module):
        tangent = np.broadcast_to(scanner.optics.tangent, len(solids.half))[hole]
        weights *= (cosine > np.cos(np.arctan(tangent))[..., None]) & ~solids.passes_crystal(hole, lines)
        attenuation = attenuation + solids.attenuation(hole, lines, through_hole=True)
    for third in between:
        attenuation = attenuation + solids.attenuation(third, lines)
        weights *= ~solids.passes_crystal(third, lines)
    return weights * np.exp(-attenuation)


def models_with_walls(model: Any) -> tuple[Model, ...]:
    """Return an `Emission` without walls, and models of the photons through walls that add to its images.

    The first of these is of the photons beside each module's own hole, the next ones of those through neighbours' holes.
    Each module's holes are in order of the largest weight of a line through them.
    """
    scanner = replace(model, wall_thickness=None, background=0.0)
    solids, n, none = Solids(model), len(model.system), np.empty(0, np.int64)
    holes, shares, between = np.arange(n)[:, None].repeat(n, 1), np.zeros((n, n)), [[none] * n for _ in range(n)]
    areas = np.pi / 4 * scanner.effective_diameter**2
    for m, ((u, v, k), center) in enumerate(zip(solids.frames, model.system.centers, strict=True)):
        trials = 2 * solids.half[m] * np.stack(np.meshgrid(_TRIAL_POSITIONS, _TRIAL_POSITIONS)).reshape(2, -1)
        ends = (center - solids.length[m] * k)[:, None] + np.stack([u, v], axis=1) @ trials
        on_axis = areas[m] / solids.length[m] ** 2
        u_beside, v_beside, area = solids.points_beside(m, scanner.plate_thickness is not None).T[..., None, None]
        points = center[:, None] + u_beside * u[:, None] + v_beside * v[:, None]
        weights = area[..., 0] * line_weights(scanner, solids, m, m, none, points, ends)
        share_beside = weights.sum(axis=0).max() / on_axis
        neighbors, centers = np.delete(np.arange(n), m), model.system.centers[..., None]
        weights = line_weights(scanner, solids, m, neighbors, none, centers[neighbors], ends).max(axis=-1)
        neighbor_shares = areas[neighbors] * weights / on_axis
        for hole in neighbors[neighbor_shares > LEAST_SHARE]:
            thirds = neighbors[neighbors != hole]
            lines = ends, (centers[hole] - ends) / np.linalg.norm(centers[hole] - ends, axis=0)
            meets = (solids.attenuation(thirds, lines) > 0) | solids.passes_crystal(thirds, lines)
            between[m][hole] = thirds[meets.any(axis=-1)]
            weights = line_weights(scanner, solids, m, hole, between[m][hole], centers[hole], ends)
            shares[m, hole] = areas[hole] * weights.max() / on_axis
        holes[m] = np.argsort(-shares[m], kind="stable")
        holes[m] = [m, *holes[m][holes[m] != m]]
        shares[m] = [share_beside, *shares[m][holes[m][1:]]]
    parts: list[Model] = [scanner]
    for rank, largest in enumerate(shares.max(axis=0).tolist()):
        if largest > LEAST_SHARE:
            modules = np.arange(n), holes[:, rank], tuple(between[m][hole] for m, hole in enumerate(holes[:, rank]))
            parts.append(ThroughWalls(_with_fewer_rays(scanner, largest), scanner, solids, *modules))
    return tuple(parts)


def _with_fewer_rays(model: Any, share: float) -> Any:
    """Return the model with fewer rays, for a part of the counts of at most this `share` of a pixel's.

    The errors of that part stay as small as those of the rest.
    """
    changes: dict[str, Any] = {"tolerance": min(1.0, model.tolerance / min(share, 1.0))}
    if model.hole != "point" and model.aperture_points is None:
        tolerance = (model.aperture_tolerance or 0.1) / min(share, 1.0)
        changes |= {"hole": "rays", "aperture_tolerance": min(1.0, tolerance)}
    return replace(model, **changes)
