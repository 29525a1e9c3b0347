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

import functools
import itertools
import math
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Floats32, cropped
from ..errors import InputError
from ..geometry.frames import moved
from ..geometry.grid import Grid
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..physics.crystal import share_inside
from ..volumes.volume import Volume
from .depth_response import DepthResponse, Index
from .parallel import in_order, run_all
from .rays import view_rays
from .transmittance import mean_transmittance

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


class WholeHoles:
    """What views count of a volume through the whole holes of their modules.

    Each view has a response for every zone of depth, made when first needed.

    Parameters
    ----------
    views, grid, system
        The views, the volume's grid and the modules.
    diameters
        The holes', (M,), mm.
    sides
        Sides of the square on each crystal in which pixels count, (M,), mm.
    weigh
        ``weigh(m, u, v)`` is what a mm^2 of the crystal counts per (decay / (s mm^3) mm) along lines through the middle of
        module m's hole to these places on the crystal, mm, point-inverted.
    mu
        What attenuates, if anything.
    is_strict
        Whether grids that reach too close to a pinhole are refused.
    """

    def __init__(
        self,
        views: Views,
        grid: Grid,
        system: PinholeSystem,
        diameters: Array,
        sides: Array,
        weigh: Weigh,
        mu: Volume | None,
        is_strict: bool,
    ) -> None:
        self.n, self.pixels, self.grid, self.mu = len(views), views.shape, grid, mu
        self._made: dict[tuple[int, float], DepthResponse] = {}
        self._zones: dict[int, list[tuple[float, float]]] = {}
        self._parts: dict[tuple[int, Index, Index], list[Part]] = {}
        self._passing: dict[int, tuple[Index, Array]] = {}
        self._room = _KEPT
        self._views, self._system, self._diameters, self._frames = views, system, diameters, system.frames()
        self._sides, self._weigh, self._is_strict = sides, weigh, is_strict

    def _module(self, m: int) -> tuple[Array, Array, float, float]:
        """Module m's pinhole, mm, its frame u, v, k, the collimator's length and the hole's diameter, mm."""
        l, d = float(self._system.collimator_length[m]), float(self._diameters[m])
        return self._views.sources[m], self._frames[m], l, d

    def images(self, volume: Array, functions: ModuleType, workers: int, mu: Volume | None = None) -> Iterator[Array]:
        """The images of `volume` one by one; `mu` may attenuate in place of the usual."""
        (filled,), origin = cropped(volume)
        filled = np.ascontiguousarray(filled)

        def image(m: int) -> Array:
            image, parts = np.zeros(self.pixels, volume.dtype), self._of_part(m, origin, filled.shape)
            passes = self._passes(m, origin, filled, mu) if parts else None
            for of, pixels in parts:
                cells = functions.voxels_to_cells(filled, of, passes)
                image[pixels] += functions.cells_to_pixels(cells, of)
            return image

        return in_order(image, range(self.n), workers)

    def backproject(
        self,
        images: Array,
        functions: ModuleType,
        workers: int,
        report: Callable[[int], None],
        mu: Volume | None = None,
    ) -> Array:
        """The adjoint. Each thread has a slab of the volume, so the result does not depend on their number."""
        volume = np.zeros(self.grid.shape, images.dtype)
        layers = max(1, _SLAB // math.prod(volume.shape[1:]))
        slabs = [slice(x, x + layers) for x in range(0, len(volume), layers)]
        whole = (0, 0, 0), self.grid.shape

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

    def _of_part(self, m: int, origin: Index, shape: Index) -> list[Part]:
        """View m's responses to a part of the volume, of the zones that it reaches into, and the pixels that may see it."""
        found = self._parts.get((m, origin, shape))
        if found is None:
            found = self._make_part(m, origin, shape)
            if len(self._parts) >= _PARTS_OF_VIEW * self.n:
                self._parts.clear()
            self._parts[m, origin, shape] = found
        return found

    def _make_part(self, m: int, origin: Index, shape: Index) -> list[Part]:
        row = self.depths(m)
        depths = [row @ (*np.add(origin, corner), 1) for corner in itertools.product(*((0, n - 1) for n in shape))]
        if m not in self._zones:
            self._zones[m] = self.zones(m)
        reached = [(far, near) for far, near in self._zones[m] if max(depths) > near and min(depths) <= far]
        return [self._response(m, far, near).of_part(origin, shape) for far, near in reached]

    def _response(self, m: int, far: float, near: float) -> DepthResponse:
        if (m, far) not in self._made:
            self._made[m, far] = self.make(m, far, near)
        return self._made[m, far]

    def _passes(self, m: int, origin: Index, part: Array, mu: Volume | None) -> Array | None:
        """What attenuation leaves of the photons from each voxel of a part of the volume."""
        if mu is None and self.mu is None:
            return None
        grid = self.grid.box(origin, part.shape)
        if mu is not None:
            return self.transmittance(m, mu, grid).astype(part.dtype, copy=False)
        start, kept = self._passing.get(m, (origin, None))
        first = np.subtract(origin, start)
        if kept is None or first.min() < 0 or (first + part.shape > kept.shape).any():
            self._room += self._passing.pop(m)[1].nbytes if m in self._passing else 0
            first, kept = np.zeros(3, int), self.transmittance(m, self.mu, grid)  # type: ignore[arg-type]
            if kept.nbytes <= self._room:
                self._room -= kept.nbytes
                self._passing[m] = origin, kept
        inside = tuple(slice(a, a + n) for a, n in zip(first.tolist(), part.shape, strict=True))
        return np.ascontiguousarray(kept[inside], part.dtype)

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
        far = max(1.01 * float(depths.max()), l / 10)
        near, nearest = l / (_MOST_RATIO * (1 + l / far) - 1), 0.99 * float(depths.min())
        if nearest < near and self._is_strict:
            raise InputError(
                "emission: hole 'depth' is for volumes at some distance from the pinholes, but the grid's depths before one "
                f"are from {depths.min():.3g} to {depths.max():.3g} mm: take a smaller grid, or hole 'auto' or 'rays'"
            )
        return far, max(nearest, near)

    def zones(self, m: int) -> list[tuple[float, float]]:
        """View m's zones of depth, from far to near, mm: in each the hole's shadow grows so little that one will do."""
        *_, l, _ = self._module(m)
        smallest, largest = (1 + l / depth for depth in self._limits(m))
        n = max(1, round(math.log(largest / smallest) / math.log(_ZONE_RATIO) + 0.4))
        return list(itertools.pairwise((l / (np.geomspace(smallest, largest, n + 1) - 1)).tolist()))

    def close(self, m: int) -> VoxelBox | None:
        """Voxels before view m's pinhole that are nearer than all zones; None where it may see none."""
        (_, near), (pinhole, frame, l, d) = self._limits(m), self._module(m)
        # A pyramid before the pinhole, wider by the hole: its corners at the pinhole's plane and at `near`.
        signs = np.array(list(itertools.product((-1, 1), repeat=2)))
        views, (n_v, n_u) = self._views, self.pixels
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

    def transmittance(self, m: int, mu: Volume, part: Grid) -> Floats32:
        """What `mu` leaves of the photons from each voxel of a part of the grid, on their way to view m's pinhole."""
        _, frame, l, d = self._module(m)
        margin = d / 2 * (1 / l + 1 / self._limits(m)[1])
        return mean_transmittance(mu, self.grid, part, self._views, m, frame, margin)

    def _weights(self, m: int, places: list[Array]) -> Array:
        """What a mm^3 counts, times its squared depth by l^2, along lines to `places` (rows, columns) on the crystal, mm."""
        v, u = places[0][:, None], places[1][None, :]
        return self._weigh(m, u, v) * np.sqrt(1 + (u**2 + v**2) / self._module(m)[2] ** 2)

    def make(self, m: int, far: float, near: float) -> DepthResponse:
        """View m's response to voxels in a zone from far to near, mm."""
        views, grid, (pinhole, frame, l, d) = self._views, self.grid, self._module(m)
        u, v, k = frame
        rays = view_rays(views, m)
        scale = l / float((views.detector_centers[m] - pinhole) @ k)
        # The pixels' places on the crystal, mm along v and u, point-inverted: those of the first, and from pixel to pixel.
        first = scale * (rays.corner - pinhole)
        firsts = float(first @ v), float(first @ u)
        pitches = scale * float(rays.row_step @ v), scale * float(rays.column_step @ u)
        to_camera = frame @ grid.affine[:3]
        to_camera[:, 3] -= frame @ pinhole
        pixels: list[Array] = [firsts[i] + pitches[i] * np.arange(views.shape[i], dtype=float) for i in range(2)]
        # Of the farthest voxel's image the widths, mm: of the hole's shadow and of the voxel's, where that is narrowest.
        across = np.linalg.svd(to_camera[:2, :3], compute_uv=False)
        widths = d * (1 + l / far), l / far * across[-1]
        steps = _cells_of_pixel(abs(pitches[0]), *widths), _cells_of_pixel(abs(pitches[1]), *widths)
        _, middle, largest = sorted((*widths, min(map(abs, pitches))))
        sharpness = math.sqrt(middle * largest)
        half = np.abs(to_camera[2, :3]).sum() / 2
        farthest, nearest = 1 / (far + half), 1 / max(near - half, near / 2)  # of whole voxels, 1 / mm
        n_planes = 2 + int((nearest - farthest) * l * (d + min(across[0], _LARGEST)) / (_PLANE_APART * sharpness))
        inverses = np.linspace(farthest, nearest, n_planes)
        # A voxel's places of one depth lie around a line: a box along it, and beside it what remains of the edges. Where
        # they are deep and across at once, this is true of small pieces only, or where the hole's shadow is wide.
        slope = max(abs(place) for at in pixels for place in at[[0, -1]]) / l + d / 2 / near
        skew = _SKEW * sharpness * near / l / max(slope, np.linalg.norm(_line(to_camera[:, :3])[:2]))
        largest_piece = min(max(skew, (skew / 2 * (d * (near / l + 1)) ** 2) ** (1 / 3)), _LARGEST)
        counts = np.ceil(grid.spacing / largest_piece).astype(int)
        pieces = (np.indices(tuple(counts)).reshape(3, -1).T + 0.5) / counts - 0.5
        edges = to_camera[:, :3] / counts
        along = edges[2] / counts / np.linalg.norm(edges[2])
        shadows = (edges - np.outer(_line(edges), edges[2]))[1::-1] * np.sign(pitches)[:, None]
        sizes = np.divide(pitches, steps)  # of the cells, mm along v and u
        cell = np.abs(sizes).max() / sharpness
        cell /= 1 if widths[0] == largest else _LARGE_VOXELS
        limits = _POINT_SMEAR / cell, _PAIR_SMEAR, cell / _PART_SMEAR
        # A photon's direction, on which its counts depend, lies between that of the voxel and that of the pixel as seen from
        # the hole's middle, l / (l + h) of the way: so the factors of either are powers that are 1 together.
        share = l / (l + 2 / (1 / near + 1 / far))
        bend = 1.5 * share * (1 - share)
        kernel = _kernel(d, l * inverses, np.stack(shadows), np.abs(pitches), steps, bend / l**2)
        # In all, a voxel counts (1 + t^2)^(-3/2) / h^2, t being its slope. The mean of this over the hole, and to second
        # order that over the voxel, differ from what the powers make of it, by this share times (1 + t^2)^-2.
        holes = (np.arange(16)[:, None] + 0.5) / 16 * (d / 2) ** 2  # squared distances from its middle, of equal areas
        shadow = holes * (1 / l + inverses) ** 2
        made = np.average((1 + shadow) ** (-1.5 * share), 0, 1 + bend * shadow)
        of_voxel = -(1 - share) / 8 * np.square(shadows).sum() * inverses**2
        second = ((1 + holes * inverses**2) ** -1.5).mean(axis=0) / made - 1 + of_voxel
        kernel *= (1 + second - second.mean())[:, None, None]
        margin = kernel.shape[1] // 2, kernel.shape[2] // 2
        matrix = to_camera.copy()
        for row, i in ((0, 1), (1, 0)):  # columns follow u, rows v
            matrix[row] = l / sizes[i] * to_camera[row] + (margin[i] - firsts[i] / sizes[i]) * to_camera[2]
        n_cells = [steps[i] * (views.shape[i] - 1 - (-kernel.shape[i + 1] - i) // steps[i]) for i in range(2)]
        places: list[Array] = [
            firsts[i] + sizes[i] * (np.arange(n_cells[i], dtype=float) - margin[i]) for i in range(2)
        ]
        of_direction, of_pixel = self._weights(m, places) ** (1 - share), self._weights(m, pixels) ** share
        of_pixel *= np.outer(*(share_inside(pixels[i], abs(pitches[i]), self._sides[m]) for i in range(2)))
        secant = 1 + (places[0][:, None] ** 2 + places[1] ** 2) / l**2
        before = grid.voxel_volume / len(pieces) * l**2 * of_direction * (1 + second.mean() / secant**2)
        before, kernel = before.astype(np.float32), np.pad(kernel.astype(np.float32), ((0, 0), (steps[0],) * 2, (0, 0)))
        zone = near, far, farthest, (n_planes - 1) / (nearest - farthest)
        return DepthResponse(matrix, pieces, along, *limits, *zone, before, kernel, steps, of_pixel)


def _line(edges: Array) -> Array:
    """Along u, v and k, per mm of depth, the line on which a voxel lies by its depth; its `edges` (3, 3) are columns, mm."""
    return edges @ edges[2] / (edges[2] @ edges[2])


def _cells_of_pixel(pitch: float, shadow: float, voxel: float) -> int:
    """Cells along a pixel's side."""
    small, middle, largest = sorted((pitch, shadow, voxel))
    sharpness = math.sqrt(middle * largest)
    size = sharpness * (0.046 + 0.34 * min(small / sharpness, 0.35)) * (1 if shadow == largest else _LARGE_VOXELS)
    return max(2, round(pitch / size + 0.2))


def _kernel(d: float, slopes: Array, edges: Array, pitches: Array, steps: tuple[int, ...], bend: float) -> Array:
    """What a pixel counts of the cells around its middle, (planes, taps, taps), by the planes' l / h.

    `edges` (2, 3) are a voxel's edges, mm along v and u, and `pitches` the pixels'. In Fourier space: the exact image, by
    what the spline has blurred; and `bend`, mm^-2, times the squared distance more, which the powers of the directions miss.
    It may not be negative anywhere, or expected counts would be.
    """
    size = pitches / steps
    apart = slopes[1] - slopes[0]
    slopes = np.concatenate([slopes[:1] - apart, slopes, slopes[-1:] + apart])
    extent = d * (1 + slopes.max()) / 2 + pitches / 2 + np.abs(edges).sum(axis=1) * slopes.max() / 2
    half = [math.ceil(reach) + 1 for reach in extent / size]
    n = [2 ** math.ceil(math.log2(2 * h + 8)) for h in half]
    f_v, f_u = np.fft.fftfreq(n[0], size[0])[:, None], np.fft.rfftfreq(n[1], size[1])
    spline = (np.sinc(size[0] * f_v) * np.sinc(size[1] * f_u)) ** 3
    pixel = np.sinc(pitches[0] * f_v) * np.sinc(pitches[1] * f_u) / spline
    kernel = np.empty((len(slopes), 2 * half[0] + 1, 2 * half[1] + 1))
    for slope, taps in zip(slopes, kernel, strict=True):
        exact = pixel * _disc(d * (1 + slope) * np.hypot(f_v, f_u))
        for edge in edges.T:
            exact *= np.sinc(slope * (edge[0] * f_v + edge[1] * f_u))
        image = np.fft.irfft2(exact, n)
        taps[...] = np.roll(image, half, (0, 1))[: 2 * half[0] + 1, : 2 * half[1] + 1]
    # Between planes there are straight lines: on the mean over depths they are right, not at the planes.
    kernel = kernel[1:-1] - (kernel[2:] - 2 * kernel[1:-1] + kernel[:-2]) / 12
    away = [(size[i] * np.arange(-half[i], half[i] + 1)) ** 2 for i in range(2)]
    kernel *= 1 + bend * np.add.outer(*away)
    kernel[kernel < 1e-4 * kernel.max(axis=(1, 2), keepdims=True)] = 0
    for a in range(steps[0]):  # all counts of a cell go to the pixels
        for b in range(steps[1]):
            of_cell = kernel[:, (half[0] - a) % steps[0] :: steps[0], (half[1] - b) % steps[1] :: steps[1]]
            of_cell /= of_cell.sum(axis=(1, 2), keepdims=True)
    return kernel


def _disc(x: Array) -> Array:
    """The Fourier transform of a disc of diameter 1 and integral 1, ``2 J1(pi x) / (pi x)``."""
    return np.interp(x, *_disc_table(2 ** math.ceil(math.log2(max(16.0, float(x.max()))))))


@functools.lru_cache(maxsize=8)
def _disc_table(most: int) -> tuple[Array, Array]:
    ticks = np.linspace(0, most, 128 * most)
    heights = np.cos(np.pi * (np.arange(4 * most) + 0.5) / (8 * most))  # of chords, by Gauss and Chebyshev
    shares = 1 - heights**2
    return ticks, np.cos(np.pi * np.outer(ticks, heights)) @ (shares / shares.sum())
