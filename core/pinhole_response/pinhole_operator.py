"""The depth-dependent pinhole response: voxels are shared out in fine images, and each plane of depth is blurred.

A point at depth h in front of the pinhole's plane is seen on the crystal as a disc of diameter ``d (1 + l / h)``. Here the
image of a voxel is made in two steps that are each a sparse matrix, whose transposes are the adjoint. First the voxel's
counts go to 3 x 3 cells of a fine image, around where the line through the hole's middle meets it, with the weights of a
quadratic B-spline, and to the two planes of depth that it lies between. Then each pixel sums the cells around it with the
plane's kernel: the disc, the voxel's shadow and the pixel's area, all convolved, less what the B-spline has blurred already.
A voxel that is seen aslant is smeared by its depth: it is two points or more in that direction.
No voxel is so small that rays miss it.

References
----------
C. E. Metz, F. B. Atkins, R. N. Beck, "The geometric transfer function component for scintillation camera collimators with
straight parallel holes", Physics in Medicine and Biology 25 (1980) 1059-1070: the response of a hole as a convolution of
discs. M. Unser, A. Aldroubi, M. Eden, "B-spline signal processing", IEEE Transactions on Signal Processing 41 (1993)
821-833: kernels that make up for the spline.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, cropped
from ..errors import InputError
from ..geometry.frames import moved
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..rays import backends
from ..rays.lattices import rounded_up
from ..rays.parallel import in_order, run_all
from ..rays.ray_geometry import view_rays
from ..volumes.volume import Volume
from .depth_response import DepthResponse, Index
from .depth_zone import Sums, ViewNumbers, Zone
from .oblique_kernels import Passage
from .transmittance import Field, VoxelRays

VoxelBox = tuple[tuple[slice, ...], NDArray[np.bool_]]
"""A box of a grid, and which of its voxels."""
Part = tuple[DepthResponse, tuple[slice, slice]]
Weigh = Callable[[int, Array, Array], Array]

# In units of the geometric mean of the two largest of the widths of pixel, voxel and the hole's shadow on the crystal:
# widths by which planes of depth may differ; by which a voxel that is seen aslant is smeared if it is taken as a point, and
# for each point more; and by which its edges may be smeared unlike the whole. With these and the cells of a pixel, images of
# single voxels are right to 0.3 % on average, and to 1 % always.
_PLANE_APART, _POINT_SMEAR, _PART_SMEAR, _SKEW = 0.2, 0.17, 0.6, 0.16
# Where the voxel's own width is the largest, parts and cells are finer by this factor.
_LARGE_VOXELS = 0.6
# Cells by which two points that share them may be smeared; by more, some of the cells' shares would be negative.
_PAIR_SMEAR = 0.366 * math.sqrt(12)
# Where kernels depend on the direction, differences of slopes from node to node: for penetration, by the cone's; and for
# depths in the crystal, times their standard deviation, in units of that of the hole's image.
_NODE_SLOPES, _NODE_SMEAR = 0.2, 0.3
# Width of a penetrated edge's shadow, in lengths in which what passes falls by e.
_SOFT_EDGE = 3.0
# Larger voxels, mm, are cut into parts of this size at most: kernels as wide as their shadows would take longer.
_LARGEST = 6.0
# Voxels that a thread adds to, in whole layers, before it takes others, and bytes of the views' cells that are in memory.
_SLAB, _CELLS_AT_ONCE = 2**14, 2**28
# Parts of the volume, on average, whose responses a view keeps: the whole, and what a volume fills. They share its numbers.
_PARTS_OF_VIEW = 2
# Bytes of transmittances that are kept from call to call.
_KEPT = 2**30
# Largest ratio of the largest and the smallest shadow of the hole in a grid, and about so much in a zone.
_MOST_RATIO, _ZONE_RATIO = 2.5, 1.4


@dataclass(eq=False)
class WholeHoles:
    """What views count of a volume through the whole holes of their modules.

    Each view has a response for every zone of depth, made when first needed.

    Attributes
    ----------
    views, grid
        The views, and the volume's grid.
    frames
        The modules' u, v and k, (M, 3, 3).
    lengths, diameters
        The collimators' and the holes', (M,), mm.
    sides
        Sides of the square on each crystal in which pixels count, (M,), mm.
    weigh
        ``weigh(m, u, v)`` is what a mm^2 of the crystal counts per (decay / (s mm^3) mm) along lines through the middle of
        module m's hole to these places on the crystal, mm, point-inverted.
    mu
        What attenuates, if anything.
    is_strict
        Whether grids that reach too close to a pinhole are refused.
    passages
        The modules' edges and crystals where kernels depend on the photons' direction.
    """

    views: Views
    grid: Grid
    frames: Array
    lengths: Array
    diameters: Array
    sides: Array
    weigh: Weigh
    mu: Volume | Field | None
    is_strict: bool
    passages: Sequence[Passage] | None = None

    def __post_init__(self) -> None:
        self._made: dict[tuple[int, float, type], DepthResponse] = {}
        self._zones: dict[int, list[tuple[float, float]]] = {}
        self._parts: dict[tuple[int, Index, Index, type], list[Part]] = {}
        self._passing: dict[int, tuple[Index, Array]] = {}
        self._room = _KEPT

    def _module(self, m: int) -> tuple[Array, Array, float, float]:
        """Module m's pinhole, mm, its frame u, v, k, the collimator's length and the hole's diameter, mm."""
        l, d = float(self.lengths[m]), float(self.diameters[m])
        return self.views.sources[m], self.frames[m], l, d

    def images(self, volume: Array, functions: ModuleType, workers: int, mu: Field | None = None) -> Iterator[Array]:
        """The images of `volume` one by one; `mu` may attenuate in place of the usual."""
        (filled,), origin = cropped(volume)
        filled, kind = np.ascontiguousarray(filled), volume.dtype.type

        def image(m: int) -> Array:
            image, parts = np.zeros(self.views.shape, volume.dtype), self._of_part(m, origin, filled.shape, kind)
            passes = self._passes(m, origin, filled, mu) if parts else None
            for of, pixels in parts:
                cells = functions.voxels_to_cells(filled, of, passes)
                image[pixels] += functions.cells_to_pixels(cells, of)
            return image

        return in_order(image, range(len(self.views)), workers)

    def backproject(
        self, images: Array, functions: ModuleType, workers: int, report: Callable[[int], None], mu: Field | None = None
    ) -> Array:
        """The adjoint. Each thread has a slab of the volume, so the result does not depend on their number."""
        volume = np.zeros(self.grid.shape, images.dtype)
        layers = max(1, _SLAB // math.prod(volume.shape[1:]))
        slabs = [slice(x, x + layers) for x in range(0, len(volume), layers)]
        whole = (0, 0, 0), self.grid.shape, images.dtype.type

        def give(m: int) -> tuple[Array | None, list[tuple[DepthResponse, Array]]]:
            given = [(of, functions.pixels_to_cells(images[m][pixels], of)) for of, pixels in self._of_part(m, *whole)]
            return self._passes(m, whole[0], volume, mu) if given else None, given

        n, first = len(images), 0
        while first < n:
            size = sum(4 * math.prod(of.shape) for of, _ in self._of_part(first, *whole))
            last = min(first + max(workers, _CELLS_AT_ONCE // max(size, 1)), n)
            given = list(in_order(give, range(first, last), workers))

            def take(slab: slice, given: list[Any] = given) -> None:
                for passes, cells in given:
                    for of, own in cells:
                        functions.cells_to_voxels(volume, own, of, passes, slab)

            run_all(take, slabs, workers)
            first = last
            report(first)
        return volume

    def gradient(
        self, volumes: Array, images: Array, functions: ModuleType, workers: int
    ) -> tuple[Array, Array, dict[str, Array]]:
        """Of the sum of `images` (n, M, n_v, n_u) times those of n `volumes`, of one type, the derivatives by the views.

        They are those by the pinholes' places (M, 3), by the modules' frames (M, 3, 3), and by the length, the diameter, the
        first pixel's place and the pitch of `ViewNumbers`; the pitch changes around the image's middle.
        """
        filled, origin = cropped(*volumes)
        kind = images.dtype.type
        shape, affine = filled[0].shape, self.grid.affine[:3]

        def of_view(m: int) -> tuple[Array, Array, ViewNumbers]:
            pinhole, frame, *_ = self._module(m)
            numbers = ViewNumbers.zero()
            by_passing: Array = np.zeros(shape, kind)
            parts = self._of_part(m, origin, shape, kind)
            passes = self._passes(m, origin, filled[0], None) if parts else None
            for (of, pixels), zone in zip(parts, self._reached(m, origin, shape), strict=True):
                sums = None
                for volume, own in zip(filled, images[:, m], strict=True):
                    image, cells = np.ascontiguousarray(own[pixels]), functions.voxels_to_cells(volume, of, passes)
                    taken = functions.pixels_to_cells(image, of)
                    matrix, line = functions.differentiate_places(volume, taken, of, passes)
                    matrix[:, :3] += np.outer(line, of.line)
                    after = image * functions.cells_to_pixels(cells, of)
                    taps = _by_taps(image, cells, of, functions)
                    found = Sums(matrix, line, (cells * taken).sum(axis=0), after, taps)
                    sums = found if sums is None else Sums(*(a + b for a, b in zip(sums, found, strict=True)))
                    if passes is not None:
                        by_own = np.zeros(shape, kind)
                        functions.cells_to_voxels(by_own, taken, of, None, slice(None))
                        by_passing += by_own * volume
                if sums is not None:
                    numbers = numbers.plus(self.make(m, *zone).gradient(of, pixels, origin, sums))
            by = numbers.to_camera
            center: Array = -(by[:, 3] @ frame)
            by_frame: Array = by[:, :3] @ affine[:, :3].T + np.outer(by[:, 3], affine[:, 3] - pinhole)
            if passes is not None and self.mu is not None:
                center = center + self._rays(m, self.mu, origin, filled[0]).gradient(by_passing)
            return center, by_frame, numbers

        centers, frames, each = zip(*in_order(of_view, range(len(self.views)), workers), strict=True)
        by = {name: np.array([getattr(own, name) for own in each]) for name in ("length", "diameter", "first", "pitch")}
        by["pitch"] -= (np.array(self.views.shape) - 1) / 2 * by["first"]
        return np.array(centers), np.array(frames), by

    def mu_gradient(self, volume: Array, images: Array, functions: ModuleType, workers: int, mu: Field) -> Array:
        """Of the sum of `images` times those of `volume`, the derivatives by `mu`, on its grid."""
        (filled,), origin = cropped(volume)
        filled = np.ascontiguousarray(filled)

        def of_view(m: int) -> Array:
            by_passing = np.zeros_like(filled)
            for of, pixels in self._of_part(m, origin, filled.shape, volume.dtype.type):
                taken = functions.pixels_to_cells(np.ascontiguousarray(images[m][pixels]), of)
                functions.cells_to_voxels(by_passing, taken, of, None, slice(None))
            return self._rays(m, mu, origin, filled).mu_gradient(by_passing * filled)

        total = np.zeros(mu.array.shape, volume.dtype)
        for own in in_order(of_view, range(len(self.views)), workers):
            total += own
        return total

    def _of_part(self, m: int, origin: Index, shape: Index, kind: type) -> list[Part]:
        """View m's responses to a part of the volume, of the zones that it reaches into, and the pixels that may see it.

        Numbers are of this kind, numpy's float32 or float64.
        """
        key = m, origin, shape, kind
        found = self._parts.get(key)
        if found is None:
            found = [self._response(m, *zone, kind).of_part(origin, shape) for zone in self._reached(m, origin, shape)]
            if len(self._parts) >= _PARTS_OF_VIEW * len(self.views):
                self._parts.clear()
            self._parts[key] = found
        return found

    def _reached(self, m: int, origin: Index, shape: Index) -> list[tuple[float, float]]:
        """The zones of view m that a part of the volume reaches into."""
        row = self.depths(m)
        depths = [row @ (*np.add(origin, corner), 1) for corner in itertools.product(*((0, n - 1) for n in shape))]
        if m not in self._zones:
            self._zones[m] = self.zones(m)
        return [(far, near) for far, near in self._zones[m] if max(depths) > near and min(depths) <= far]

    def _response(self, m: int, far: float, near: float, kind: type) -> DepthResponse:
        if (m, far, kind) not in self._made:
            self._made[m, far, kind] = self.make(m, far, near).response(kind)
        return self._made[m, far, kind]

    def _passes(self, m: int, origin: Index, part: Array, mu: Field | None) -> Array | None:
        """What attenuation leaves of the photons from each voxel of a part of the volume."""
        if mu is None and self.mu is None:
            return None
        if mu is not None:
            return self._rays(m, mu, origin, part).passing
        start, kept = self._passing.get(m, (origin, None))
        first = np.subtract(origin, start)
        is_there = kept is not None and kept.dtype == part.dtype and first.min() >= 0
        if not is_there or (first + part.shape > kept.shape).any():  # type: ignore[union-attr]
            self._room += self._passing.pop(m)[1].nbytes if m in self._passing else 0
            first, kept = np.zeros(3, int), self._rays(m, self.mu, origin, part).passing  # type: ignore[arg-type]
            if kept.nbytes <= self._room:
                self._room -= kept.nbytes
                self._passing[m] = origin, kept
        inside = tuple(slice(a, a + n) for a, n in zip(first.tolist(), part.shape, strict=True))
        return np.ascontiguousarray(kept[inside])  # type: ignore[index]

    def _rays(self, m: int, mu: Volume | Field, origin: Index, part: Array) -> VoxelRays:
        """Rays from view m's pinhole through a part of the volume."""
        _, frame, l, d = self._module(m)
        margin = d / 2 * (1 / l + 1 / self._limits(m)[1])
        grid = self.grid.box(origin, part.shape)
        return VoxelRays(mu, self.grid, grid, self.views, m, frame, margin, part.dtype.type)

    def depths(self, m: int) -> Array:
        """The row (4,) that gives the depth of a voxel (x, y, z, 1) before view m's pinhole, mm."""
        pinhole, (_, _, k), *_ = self._module(m)
        row: Array = k @ self.grid.affine[:3]
        row[3] -= k @ pinhole
        return row

    def _limits(self, m: int) -> tuple[float, float]:
        """Depths of the farthest voxel and of the nearest one that is not too close to the pinhole, a little wider, mm."""
        pinhole, (_, _, k), l, _ = self._module(m)
        depths = (self.grid.corners() - pinhole) @ k
        far = rounded_up(max(1.001 * float(depths.max()), l / 10))
        near = rounded_up(l / (_MOST_RATIO * (1 + l / far) - 1))
        first = float(depths.min())
        nearest = 1 / rounded_up(1.001 / first) if first > 0 else first
        if nearest < near and self.is_strict:
            expected = "hole 'depth' is for volumes at some distance from the pinholes"
            found = f"the grid's depths before one are from {depths.min():.3g} to {depths.max():.3g} mm"
            raise InputError(f"emission: {expected}, but {found}: take a smaller grid, or hole 'auto' or 'rays'")
        return far, max(nearest, near)

    def zones(self, m: int) -> list[tuple[float, float]]:
        """View m's zones of depth, from far to near, mm: in each the hole's shadow grows so little that one will do."""
        *_, l, _ = self._module(m)
        smallest, largest = (1 + l / depth for depth in self._limits(m))
        n = max(1, round(math.log(largest / smallest) / math.log(_ZONE_RATIO) + 0.4))
        far, *inner, near = (l / (np.geomspace(smallest, largest, n + 1) - 1)).tolist()
        return list(itertools.pairwise([far, *(rounded_up(depth) for depth in inner), near]))

    def close(self, m: int) -> VoxelBox | None:
        """Voxels before view m's pinhole that are nearer than all zones; None where it may see none."""
        (_, near), (pinhole, frame, l, d) = self._limits(m), self._module(m)
        # A pyramid before the pinhole, wider by the hole: its corners at the pinhole's plane and at `near`.
        signs = np.array(list(itertools.product((-1, 1), repeat=2)))
        views, (n_v, n_u) = self.views, self.views.shape
        rays = views.detector_centers[m] - pinhole + signs @ [views.u_steps[m] * n_u / 2, views.v_steps[m] * n_v / 2]
        hole = d * (1 + near / l) * signs @ frame[:2]
        corners = pinhole + np.concatenate([hole, hole + near * rays / (rays @ frame[2])[:, None]])
        index = moved(self.grid.index_from_world, corners)
        low = np.clip(np.floor(index.min(axis=0)), 0, self.grid.shape).astype(int)
        high = np.clip(np.ceil(index.max(axis=0)) + 1, low, self.grid.shape).astype(int)
        row, places = self.depths(m), np.indices((high - low).tolist()) + low[:, None, None, None]
        depths = np.tensordot(row[:3], places, 1) + row[3]
        close = (depths > 0) & (depths <= near)
        return (tuple(map(slice, low.tolist(), high.tolist())), close) if close.any() else None

    def make(self, m: int, far: float, near: float) -> Zone:
        """View m's response to voxels in a zone from far to near, mm."""
        views, grid, (pinhole, frame, l, d) = self.views, self.grid, self._module(m)
        u, v, k = frame
        rays = view_rays(views, m)
        passage = None if self.passages is None else self.passages[m]
        front = l if passage is None else l - passage.mean_depth
        scale = front / float((views.detector_centers[m] - pinhole) @ k)
        # The pixels' places on the crystal: those of the first, and from pixel to pixel.
        corner = scale * (rays.corner - pinhole)
        first = np.array([corner @ v, corner @ u])
        pitch = scale * np.array([rays.row_step @ v, rays.column_step @ u])
        to_camera = frame @ grid.affine[:3]
        to_camera[:, 3] -= frame @ pinhole
        # Of the farthest voxel's image the widths, mm: of the hole's shadow and of the voxel's, where that is narrowest.
        across = np.linalg.svd(to_camera[:2, :3], compute_uv=False)
        widths = d * (1 + l / far), l / far * across[-1]
        soft = _SOFT_EDGE * passage.decay * (1 + l / far) if passage is not None else 0.0
        steps = _cells_of_pixel(abs(pitch[0]), *widths, soft), _cells_of_pixel(abs(pitch[1]), *widths, soft)
        _, middle, largest = sorted((*widths, np.abs(pitch).min()))
        sharpness = math.sqrt(middle * largest)
        half = float(np.linalg.norm(grid.spacing)) / 2
        farthest, nearest = 1 / (far + half), 1 / max(near - half, near / 2)  # of whole voxels, 1 / mm
        n_planes = 2 + int((nearest - farthest) * l * (d + min(across[0], _LARGEST)) / (_PLANE_APART * sharpness))
        # A voxel's places of one depth lie around a line: a box along it, and beside it what remains of the edges. Where
        # they are deep and across at once, this is true of small pieces only, or where the hole's shadow is wide.
        ends = np.abs([first, first + pitch * (np.array(views.shape) - 1)])
        slope = ends.max() / l + d / 2 / near
        skew = _SKEW * sharpness * near / l / max(slope, np.linalg.norm(_line(to_camera[:, :3])[:2]))
        largest_piece = min(max(skew, (skew / 2 * (d * (near / l + 1)) ** 2) ** (1 / 3)), _LARGEST)
        cell = float(np.abs(pitch / steps).max()) / sharpness
        cell /= 1 if widths[0] == largest else _LARGE_VOXELS

        def weigh(v: Array, u: Array) -> Array:
            return np.asarray(self.weigh(m, v, u) * np.sqrt(1 + (u**2 + v**2) / l**2))

        of_view = (
            ViewNumbers(to_camera, l, d, first, pitch),
            views.shape,
            weigh,
            float(self.sides[m]),
            grid.voxel_volume,
        )
        pieces = np.ceil(grid.spacing / largest_piece).astype(int)
        planes = np.linspace(farthest, nearest, n_planes)
        limits = _POINT_SMEAR / cell, _PAIR_SMEAR, cell / _PART_SMEAR
        share = round(l / (l + 2 / (1 / near + 1 / far)), 2)
        apart = 1 if passage is None else _pixels_apart(passage, widths[0], float(np.abs(pitch).max()), l)
        return Zone(*of_view, pieces, near, far, planes, steps, limits, share, passage, apart)


def depth_functions(backend: str = "auto") -> ModuleType:
    """Return the module that computes with a `DepthResponse`: `compiled`, or `reference` for numpy and without C kernels."""
    if backend != "numpy" and backends.choose("auto").name == "cpu":
        from . import compiled

        return compiled
    from . import reference

    return reference


def _by_taps(image: Array, cells: Array, of: DepthResponse, functions: ModuleType) -> Array:
    """Of the sum of `image` times what pixels count of `cells`, the derivatives by `of.kernel`."""
    if of.places is None:
        return np.asarray(functions.differentiate_taps(image, cells, of))
    by = np.zeros(of.kernel.shape)
    for (a, b), own, pixels, (rows, columns) in of.of_nodes():
        some, part = np.ascontiguousarray(image[pixels]), np.ascontiguousarray(cells[:, rows, columns])
        by[:, a, b] = functions.differentiate_taps(some, part, own)
    return by


def _line(edges: Array) -> Array:
    """Along u, v and k, per mm of depth, the line on which a voxel lies by its depth; its `edges` (3, 3) are columns, mm."""
    return edges @ edges[2] / (edges[2] @ edges[2])


def _pixels_apart(passage: Passage, shadow: float, pitch: float, length: float) -> int:
    """Pixels from node to node where kernels depend on the photons' direction."""
    slopes = []
    if passage.knife is not None:
        slopes.append(_NODE_SLOPES * passage.knife.tangent)
    if passage.crystal_mu:
        slopes.append(_NODE_SMEAR * math.hypot(shadow / 4, pitch / math.sqrt(12)) / passage.spread)
    apart = max(1, int(min(slopes) * length / pitch))
    return apart // 8 * 8 or apart  # whole vectors of the backend cpu


def _cells_of_pixel(pitch: float, shadow: float, voxel: float, soft: float) -> int:
    """Cells along a pixel's side; `soft` is how wide the shadow's edge is, mm."""
    small, middle, largest = sorted((pitch, shadow, voxel))
    sharpness = math.sqrt(middle * largest)
    size = sharpness * (0.046 + 0.34 * min(math.hypot(small, soft) / sharpness, 0.35))
    size *= 1 if shadow == largest else _LARGE_VOXELS
    return max(2, round(pitch / size + 0.2))
