"""Pinholes of views before a grid: their zones of depth with their lattices, and the voxels that are too close.

The numbers at the head decide how fine the lattices are. With them, images of single voxels are right to 0.3 % on average
and to 1 % always.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import InputError
from ..geometry.frames import moved
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..rays.lattices import rounded_up
from ..rays.ray_geometry import view_rays
from ..volumes.volume import Volume
from .depth_zone import DepthZone, ViewNumbers
from .directional_effects import DirectionalEffects
from .pixel_kernels import Pair
from .transmittance import ArrayOnGrid

VoxelBox = tuple[tuple[slice, ...], NDArray[np.bool_]]
"""A box of a grid, and a mask of some of its voxels."""

# Lengths in units of the sharpness: the geometric mean of the two largest of the widths of pixel, voxel and the hole's
# shadow on the crystal. Difference of the widths of neighbouring planes; largest smear of an oblique voxel that is one
# point, and per further point of a longer one; largest difference of smear between a piece and its edges.
_PLANE_STEP, _POINT_SMEAR, _SAMPLE_SMEAR, _SKEW = 0.2, 0.17, 0.6, 0.16
# Factor of the points' smear and of the cells where the voxel's own width is the largest.
_LARGE_VOXELS = 0.6
# Smear, cells, up to which two points can share their cells; beyond it some of the cells' shares would be negative.
_PAIR_SMEAR = 0.366 * math.sqrt(12)
# Differences of slope from node to node, where kernels depend on the direction: for penetration in units of the cone's
# slope; for interaction depths, times their standard deviation, in units of that of the hole's image.
_NODE_SLOPES, _NODE_SMEAR = 0.2, 0.3
# Width of the shadow of a penetrated edge, in lengths in which the transmittance falls by a factor of e.
_SOFT_EDGE = 3.0
# Largest size of a piece, mm: the kernels of larger ones, as wide as their shadows, would take longer.
_LARGEST_PIECE = 6.0
# Largest ratio of the largest and the smallest shadow of the hole in a grid, and about that ratio in a zone.
_MAX_RATIO, _ZONE_RATIO = 2.5, 1.4


@dataclass(eq=False)
class PinholeViews:
    """Pinholes of all views, their modules and pixels, and the grid of the volume that they see."""

    views: Views
    """The views."""
    grid: Grid
    """Grid of the volume."""
    frames: Array
    """(M, 3, 3), u, v and k of the modules."""
    lengths: Array
    """(M,), distances from the holes' planes to the images', mm: collimator lengths plus mean depths of interaction."""
    diameters: Array
    """(M,), effective diameters of the holes, mm."""
    crystal_sides: Array
    """(M,), sides of the squares on the crystals in which photons are detected, mm."""
    ray_weight: Callable[..., Array]
    """Weights of the lines through the centre of module m's hole to positions on its crystal, ``ray_weight(m, u=u, v=v)``.

    They are the expected counts per mm^2 of crystal of a line integral of 1, (decay / (s mm^3)) mm. The positions are in mm,
    point-inverted."""
    mu: Volume | ArrayOnGrid | None
    """Attenuation coefficients, 1/mm; None without attenuation."""
    is_strict: bool
    """Whether grids that reach too close to a pinhole are refused."""
    directional_effects: Sequence[DirectionalEffects] | None = None
    """The modules' knife edges and crystals, where kernels depend on the photons' direction."""
    are_blurred: Sequence[bool] | None = None
    """Whether the modules' pixels are parts of pixels, blurred so much that one cell for each will do; None if none are."""

    def module(self, m: int) -> tuple[Array, Array, float, float]:
        """Return module m's pinhole (3,), mm, frame (3, 3), length l, mm, and effective diameter d, mm."""
        return self.views.sources[m], self.frames[m], float(self.lengths[m]), float(self.diameters[m])

    def depth_row(self, m: int) -> Array:
        """Return the row (4,) that gives the depth, mm, before pinhole m of a voxel with the index (x, y, z, 1)."""
        pinhole, (_, _, k), *_ = self.module(m)
        row: Array = k @ self.grid.affine[:3]
        row[3] -= k @ pinhole
        return row

    def depth_limits(self, m: int) -> tuple[float, float]:
        """Return the depth of the farthest voxel, and that of the nearest one that is not too close to pinhole m, mm.

        Both are a little wider than the grid. Raise `InputError` for a grid too close, if `is_strict`.
        """
        pinhole, (_, _, k), l, _ = self.module(m)
        depths = (self.grid.corners() - pinhole) @ k
        far = rounded_up(max(1.001 * float(depths.max()), l / 10))
        near = rounded_up(l / (_MAX_RATIO * (1 + l / far) - 1))
        first = float(depths.min())
        nearest = 1 / rounded_up(1.001 / first) if first > 0 else first
        if nearest < near and self.is_strict:
            expected = "hole 'depth' is for volumes at some distance from the pinholes"
            reached = f"the grid's depths before one are from {depths.min():.3g} to {depths.max():.3g} mm"
            raise InputError(f"emission: {expected}, but {reached}: take a smaller grid, or hole 'auto' or 'rays'")
        return far, max(nearest, near)

    def zone_limits(self, m: int) -> list[tuple[float, float]]:
        """Return the depths (far, near), mm, of the zones of view m, from far to near.

        In each zone the hole's shadow grows by so little that one lattice of cells will do.
        """
        *_, l, _ = self.module(m)
        smallest, largest = (1 + l / depth for depth in self.depth_limits(m))
        n = max(1, round(math.log(largest / smallest) / math.log(_ZONE_RATIO) + 0.4))
        far, *inner, near = (l / (np.geomspace(smallest, largest, n + 1) - 1)).tolist()
        return list(itertools.pairwise([far, *(rounded_up(depth) for depth in inner), near]))

    def close_voxels(self, m: int) -> VoxelBox | None:
        """Return the voxels before pinhole m that are nearer than all zones; None where it can see none."""
        (_, near), (pinhole, frame, l, d) = self.depth_limits(m), self.module(m)
        # They are in a pyramid before the pinhole, wider by the hole: its corners at the pinhole's plane and at `near`.
        signs = np.array(list(itertools.product((-1, 1), repeat=2)))
        views, (n_v, n_u) = self.views, self.views.shape
        half_sides = [views.u_steps[m] * n_u / 2, views.v_steps[m] * n_v / 2]
        rays = views.detector_centers[m] - pinhole + signs @ half_sides
        hole = d * (1 + near / l) * signs @ frame[:2]
        corners = pinhole + np.concatenate([hole, hole + near * rays / (rays @ frame[2])[:, None]])
        index = moved(self.grid.index_from_world, corners)
        low = np.clip(np.floor(index.min(axis=0)), 0, self.grid.shape).astype(int)
        high = np.clip(np.ceil(index.max(axis=0)) + 1, low, self.grid.shape).astype(int)
        row, indices = self.depth_row(m), np.indices((high - low).tolist()) + low[:, None, None, None]
        depths = np.tensordot(row[:3], indices, 1) + row[3]
        is_close = (depths > 0) & (depths <= near)
        return (tuple(map(slice, low.tolist(), high.tolist())), is_close) if is_close.any() else None

    def zone(self, m: int, far: float, near: float) -> DepthZone:
        """Return the zone of view m from the depth `far` to the depth `near`, mm, with its lattice."""
        effects = None if self.directional_effects is None else self.directional_effects[m]
        numbers = self._view_numbers(m, 0.0 if effects is None else effects.mean_depth)
        l, d, pitch, edges = numbers.length, numbers.diameter, numbers.pitch, numbers.to_camera[:, :3]
        # Widths of the farthest voxel's image, mm: of the hole's shadow, and of the voxel's, where that is narrowest.
        transverse_widths = np.linalg.svd(edges[:2], compute_uv=False)
        widths = d * (1 + l / far), l / far * transverse_widths[-1]
        soft = 0.0 if effects is None else _SOFT_EDGE * effects.edge_decay * (1 + l / far)
        cells_per_pixel = _cells_of_pixel(abs(pitch[0]), *widths, soft), _cells_of_pixel(abs(pitch[1]), *widths, soft)
        cells_per_pixel = (1, 1) if self.are_blurred and self.are_blurred[m] else cells_per_pixel
        _, middle, largest = sorted((*widths, np.abs(pitch).min()))
        sharpness = math.sqrt(middle * largest)
        half_diagonal = float(np.linalg.norm(self.grid.spacing)) / 2
        # The planes hold whole voxels.
        farthest, nearest = 1 / (far + half_diagonal), 1 / max(near - half_diagonal, near / 2)
        growth = (nearest - farthest) * l * (d + min(transverse_widths[0], _LARGEST_PIECE))
        n_planes = 2 + int(growth / (_PLANE_STEP * sharpness))
        cell = float(np.abs(pitch / cells_per_pixel).max()) / sharpness
        cell /= 1 if widths[0] == largest else _LARGE_VOXELS
        largest_piece = _largest_piece(numbers, self.views.shape, near, sharpness)
        pieces_per_edge = np.ceil(self.grid.spacing / largest_piece).astype(int)
        sampling = _POINT_SMEAR / cell, _PAIR_SMEAR, cell / _SAMPLE_SMEAR
        planes = np.linspace(farthest, nearest, n_planes)
        pixel_exponent = round(l / (l + 2 / (1 / near + 1 / far)), 2)
        node_spacing = 1 if effects is None else _node_spacing(effects, widths[0], float(np.abs(pitch).max()), l)

        def point_weight(*, u: Array, v: Array) -> Array:
            """Return `ray_weight` of view m times sec(angle), for crystal points (v, u), mm."""
            return np.asarray(self.ray_weight(m, u=u, v=v) * np.sqrt(1 + (u**2 + v**2) / l**2))

        return DepthZone(numbers, self.views.shape, point_weight, float(self.crystal_sides[m]), self.grid.voxel_volume,
                         pieces_per_edge, near, far, planes, cells_per_pixel, sampling, pixel_exponent, effects,
                         node_spacing)  # fmt: skip

    def _view_numbers(self, m: int, mean_depth: float) -> ViewNumbers:
        """Return the numbers of view m that responses depend on; `mean_depth` is that of interaction, mm."""
        pinhole, frame, l, d = self.module(m)
        (u, v, k), rays = frame, view_rays(self.views, m)
        scale = (l - mean_depth) / float((self.views.detector_centers[m] - pinhole) @ k)
        corner = scale * (rays.corner - pinhole)
        first = np.array([corner @ v, corner @ u])
        pitch = scale * np.array([rays.row_step @ v, rays.column_step @ u])
        to_camera = frame @ self.grid.affine[:3]
        to_camera[:, 3] -= frame @ pinhole
        return ViewNumbers(to_camera, l, d, first, pitch)


def _largest_piece(numbers: ViewNumbers, image_shape: Pair, near: float, sharpness: float) -> float:
    """Return the largest size of a voxel's pieces, mm.

    The places of one depth in a voxel lie around a line; the response takes a box along the line, and beside it what remains
    of the edges. Where edges are deep and transverse at once this is true of small pieces only, or where the hole's shadow
    is wide.
    """
    l, d, edges = numbers.length, numbers.diameter, numbers.to_camera[:, :3]
    ends = np.abs([numbers.first, numbers.first + numbers.pitch * (np.array(image_shape) - 1)])
    slope = ends.max() / l + d / 2 / near
    line_slope = np.linalg.norm((edges @ edges[2] / (edges[2] @ edges[2]))[:2])
    skew = _SKEW * sharpness * near / l / max(slope, line_slope)
    return float(min(max(skew, (skew / 2 * (d * (near / l + 1)) ** 2) ** (1 / 3)), _LARGEST_PIECE))


def _node_spacing(effects: DirectionalEffects, shadow: float, pitch: float, length: float) -> int:
    """Return the number of pixels from node to node; `shadow` and `pitch` are widths on the crystal, mm."""
    slopes = []
    if effects.knife is not None:
        slopes.append(_NODE_SLOPES * effects.knife.tangent)
    if effects.crystal_mu:
        slopes.append(_NODE_SMEAR * math.hypot(shadow / 4, pitch / math.sqrt(12)) / effects.depth_deviation)
    spacing = max(1, int(min(slopes) * length / pitch))
    return spacing // 8 * 8 or spacing  # whole vectors of the compiled code


def _cells_of_pixel(pitch: float, shadow: float, voxel: float, soft: float) -> int:
    """Return the number of cells along a pixel's side.

    `pitch` is the pixel's width, `shadow` the hole's, `voxel` the voxel's, all on the crystal, and `soft` the width of the
    shadow's edge, mm.
    """
    small, middle, largest = sorted((pitch, shadow, voxel))
    sharpness = math.sqrt(middle * largest)
    size = sharpness * (0.046 + 0.34 * min(math.hypot(small, soft) / sharpness, 0.35))
    size *= 1 if shadow == largest else _LARGE_VOXELS
    return max(2, round(pitch / size + 0.2))
