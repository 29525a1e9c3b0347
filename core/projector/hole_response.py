"""A hole's image without rays: voxels are shared out in a fine image, in planes of depth, and each plane is blurred.

A point at depth h in front of the pinhole's plane is seen on the crystal as a disc of diameter ``d (1 + l / h)``. Here the
image of a voxel is made in two steps that are each a sparse matrix, whose transposes are the adjoint. First the voxel's
counts go to 3 x 3 cells of a fine image, around where the line through the hole's middle meets it, with the weights of a
quadratic B-spline, and to the two planes of depth that it lies between. Then each pixel sums the cells around it with the
plane's kernel: the disc, the voxel's shadow and the pixel's area, all convolved, less what the B-spline has blurred already.
No voxel is so small that rays miss it.

References
----------
C. E. Metz, F. B. Atkins, R. N. Beck, "The geometric transfer function component for scintillation camera collimators with
straight parallel holes", Physics in Medicine and Biology 25 (1980) 1059-1070: the response of a hole as a convolution of
discs. M. Unser, A. Aldroubi, M. Eden, "B-spline signal processing", IEEE Transactions on Signal Processing 41 (1993)
821-833: kernels that make up for the spline.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..physics.crystal import share_inside
from .depth_response import PLANES, TAPS_TOGETHER, DepthResponse
from .models import view_rays

Array = NDArray[np.float64]
Weigh = Callable[[Array, Array], Array]

# Cells across the hole's shadow, at least.
_CELLS_ACROSS = 15
# Largest ratio of the largest and the smallest shadow of the hole: beyond, interpolation between planes shows.
_MOST_RATIO = 2.5


def hole_response(
    views: Views, m: int, grid: Grid, frame: Array, l: float, d: float, side: float, weigh: Weigh
) -> DepthResponse:
    """The response of view m to a hole of diameter d.

    `frame` has the module's u, v, k, `l` is the collimator's length, and pixels count only within the crystal's `side`.
    ``weigh(along_u, along_v)`` is what a mm^2 of the crystal counts per (decay / (s mm^3) mm) along lines through the hole's
    middle to these places on the crystal, mm, point-inverted.

    Raises
    ------
    InputError
        The grid reaches so close to the pinhole that its shadows there are much larger than those of its far end.
    """
    u, v, k = frame
    pinhole, rays = views.sources[m], view_rays(views, m)
    scale = l / float((views.detector_centers[m] - pinhole) @ k)
    # The pixels' places on the crystal, mm along v and u, point-inverted: those of the first, and from pixel to pixel.
    first = scale * (rays.corner - pinhole)
    firsts = float(first @ v), float(first @ u)
    pitches = scale * float(rays.row_step @ v), scale * float(rays.column_step @ u)
    to_camera = frame @ grid.affine[:3]
    to_camera[:, 3] -= frame @ pinhole
    near, far = depths_of(grid, pinhole, k, l)
    inverses = np.linspace(1 / far, 1 / near, PLANES)
    steps = tuple(max(1, math.ceil(_CELLS_ACROSS * abs(pitch) / (d * (1 + l / far)))) for pitch in pitches)
    shadows = [np.multiply(to_camera[axis, :3], np.sign(pitch)) for axis, pitch in zip((1, 0), pitches, strict=True)]
    kernel = _kernel(d, l * inverses, np.stack(shadows), np.abs(pitches), steps)
    margin = kernel.shape[0] // 2, kernel.shape[1] // 2
    kernel = np.pad(kernel, ((0, 0), (0, -kernel.shape[1] % TAPS_TOGETHER), (0, 0)))
    matrix = np.empty((3, 4))
    for row, axis, i in ((1, 1, 0), (0, 0, 1)):  # rows follow v, columns u
        per_slope = steps[i] * l / pitches[i]
        matrix[row] = per_slope * to_camera[axis] + (margin[i] - steps[i] * firsts[i] / pitches[i]) * to_camera[2]
    matrix[2] = to_camera[2]
    n_cells = tuple(steps[i] * (views.shape[i] - 1) + kernel.shape[i] for i in range(2))
    along = [firsts[i] + pitches[i] / steps[i] * (np.arange(n_cells[i]) - margin[i]) for i in range(2)]
    pixels = [firsts[i] + pitches[i] * np.arange(views.shape[i]) for i in range(2)]
    # A photon's direction, on which its counts depend, lies between that of the voxel and that of the pixel as seen from
    # the hole's middle, l / (l + h) of the way: so the factors of either are powers that are 1 together.
    share = l / (l + 2 / (1 / near + 1 / far))
    of_direction, of_pixel = _weights(weigh, along, l) ** (1 - share), _weights(weigh, pixels, l) ** share
    on_v, on_u = (share_inside(at, abs(pitch), side) for at, pitch in zip(pixels, pitches, strict=True))
    of_pixel = of_pixel * (on_v[:, None] * on_u)
    spacing = (inverses[-1] - inverses[0]) / (PLANES - 1)
    return DepthResponse(
        matrix, near / 2, float(inverses[0]), float(1 / spacing), n_cells,  # type: ignore[arg-type]
        grid.voxel_volume * l**2 * of_direction, kernel, steps, of_pixel,  # type: ignore[arg-type]
    )  # fmt: skip


def _weights(weigh: Weigh, places: list[NDArray[Any]], l: float) -> Array:
    """What a mm^3 counts, times its squared depth by l^2, along lines to `places` (rows, columns) on the crystal."""
    v, u = places[0][:, None], places[1][None, :]
    return weigh(u, v) * np.sqrt(1 + (u**2 + v**2) / l**2)


def depths_of(grid: Grid, pinhole: Array, k: Array, l: float) -> tuple[float, float]:
    """Depths of the nearest and the farthest voxel, a little wider; `InputError` as of `hole_response`."""
    depths = (grid.corners() - pinhole) @ k
    near, far = 0.99 * float(depths.min()), 1.01 * float(depths.max())
    if near <= 0 or (1 + l / near) / (1 + l / far) > _MOST_RATIO:
        raise InputError(
            f"emission: hole 'depth' is for volumes at some distance from the pinholes, but the grid's depths before one "
            f"are from {depths.min():.3g} to {depths.max():.3g} mm: take a smaller grid, or hole 'rays'"
        )
    return near, far


def _kernel(d: float, slopes: Array, edges: Array, pitches: Array, steps: tuple[int, ...]) -> Array:
    """What a pixel counts of the cells around its middle, (taps, taps, PLANES), by their planes' l / h.

    `edges` (2, 3) are a voxel's edges, mm along v and u, and `pitches` the pixels'. In Fourier space: the exact image, by
    what the spline has blurred. It may not be negative anywhere, or expected counts would be.
    """
    size = pitches / steps
    extent = d * (1 + slopes.max()) / 2 + pitches / 2 + np.abs(edges).sum(axis=1) * slopes.max() / 2
    half = [math.ceil(reach) + 1 for reach in extent / size]
    n = [2 ** math.ceil(math.log2(2 * h + 8)) for h in half]
    f_v, f_u = np.fft.fftfreq(n[0], size[0])[:, None, None], np.fft.fftfreq(n[1], size[1])[None, :, None]
    exact = _disc(d * (1 + slopes) * np.hypot(f_v, f_u)) * np.sinc(pitches[0] * f_v) * np.sinc(pitches[1] * f_u)
    for edge in edges.T:
        exact *= np.sinc(slopes * (edge[0] * f_v + edge[1] * f_u))
    spline = np.sinc(size[0] * f_v) ** 3 * np.sinc(size[1] * f_u) ** 3
    kernel = np.fft.fftshift(np.fft.ifft2(exact / spline, axes=(0, 1)).real, axes=(0, 1))
    kernel = kernel[n[0] // 2 - half[0] : n[0] // 2 + half[0] + 1, n[1] // 2 - half[1] : n[1] // 2 + half[1] + 1]
    kernel = np.maximum(kernel, 0)
    for a in range(steps[0]):  # all counts of a cell go to the pixels
        for b in range(steps[1]):
            of_cell = (slice((half[0] - a) % steps[0], None, steps[0]), slice((half[1] - b) % steps[1], None, steps[1]))
            kernel[of_cell] /= kernel[of_cell].sum(axis=(0, 1))
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
