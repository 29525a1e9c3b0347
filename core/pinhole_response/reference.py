"""A hole's image depth by depth, written to be read: the reference, in numpy. The functions are those of `cpu`."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ..arrays import Array
from .depth_response import DepthResponse

# Steps of central differences, by the largest of their kind.
_STEP = 1e-6


def voxels_to_cells(volume: Array, of: DepthResponse, passes: Array | None = None) -> Array:
    """What `volume` (n_x, n_y, n_z) gives to the cells (planes, rows, columns) of a view's fine image.

    `passes`, of the volume's shape, are the shares of photons that attenuation leaves.
    """
    cells = np.zeros(of.shape)
    for x in range(len(volume)):
        given = volume[x] if passes is None else volume[x] * passes[x]
        for where, weights in _shares(of, volume.shape, x):
            np.add.at(cells, where, given * weights)
    return cells


def cells_to_voxels(volume: Array, cells: Array, of: DepthResponse, passes: Array | None, slab: slice) -> None:
    """Add to the `slab` of `volume` along x, in place, what the adjoint of `voxels_to_cells` gives."""
    for x in range(*slab.indices(len(volume))):
        taken = sum(weights * cells[where] for where, weights in _shares(of, volume.shape, x))
        volume[x] += taken if passes is None else taken * passes[x]


def cells_to_pixels(cells: Array, of: DepthResponse) -> Array:
    """The image (n_v, n_u) of a view's cells."""
    spectrum, image = np.fft.rfft2(cells * of.before), np.zeros(of.after.shape)
    for kernel, weights in _nodes(of):
        own = spectrum * np.fft.rfft2(kernel, of.shape[1:]).conj()
        image += weights * _inverse(own.sum(axis=0), of)[_pixels(of)]
    return image * of.after


def pixels_to_cells(image: Array, of: DepthResponse) -> Array:
    """The adjoint of `cells_to_pixels`."""
    cells = np.zeros(of.shape)
    for kernel, weights in _nodes(of):
        fine = np.zeros(of.shape[1:])
        fine[_pixels(of)] = image * of.after * weights
        cells += _inverse(np.fft.rfft2(fine) * np.fft.rfft2(kernel, of.shape[1:]), of)
    return cells * of.before


def _nodes(of: DepthResponse) -> Iterator[tuple[Array, Array]]:
    """Kernels (planes, taps, taps), and their weights in each pixel."""
    if of.places is None:
        yield of.kernel, np.ones(of.after.shape)
        return
    for number in np.ndindex(of.kernel.shape[1:3]):
        by_row, by_column = (np.maximum(1 - np.abs(at - k), 0) for at, k in zip(of.places, number, strict=True))
        if by_row.any() and by_column.any():
            yield of.kernel[:, number[0], number[1]], np.outer(by_row, by_column)


def _pixels(of: DepthResponse) -> tuple[slice, ...]:
    """The cells of a plane from which on pixels sum."""
    return tuple(slice(0, step * (n - 1) + 1, step) for step, n in zip(of.steps, of.after.shape, strict=True))


def _inverse(spectrum: Array, of: DepthResponse) -> Array:
    """What has this spectrum, with zeros in place of rounding: nothing becomes negative by it."""
    found = np.fft.irfft2(spectrum, of.shape[1:])
    return np.where(np.abs(found) > 1e-14 * np.abs(found).max(), found, 0)


def _shares(of: DepthResponse, shape: tuple[int, ...], x: int) -> Iterator[tuple[tuple[Array, ...], Array]]:
    """For a layer of voxels, all (n_y, n_z): indices of 3 x 3 x 2 cells each, and weights."""
    planes, rows, columns = of.shape
    y, z = np.meshgrid(np.arange(shape[1]), np.arange(shape[2]), indexing="ij")
    voxels = np.einsum("ij,jyz->iyz", of.matrix, np.stack([np.full(y.shape, x), y, z, np.ones(y.shape)]))
    in_zone = (voxels[2] > of.nearest) & (voxels[2] <= of.farthest)
    line = of.matrix[:, :3] @ of.line
    for shift in of.pieces @ of.matrix[:, :3].T:
        middles = voxels + shift[:, None, None]
        middles[2, ~in_zone] = np.inf
        wide, high = (line[:2, None, None] - middles[:2] / middles[2] * line[2]) / middles[2]
        smear = np.maximum(np.abs(wide), np.abs(high))
        is_one = smear <= of.of_pair
        parts = np.where(is_one, 1, 2 + np.floor(smear * of.parts_per_cell))
        apart = np.where(is_one & (smear > of.of_point), 1 / math.sqrt(12), 0)
        # With the mean of 1 / depth^2 on the line.
        share = np.where(is_one, 1 + (line[2] / middles[2] / 2) ** 2, 1 / parts)
        for number in range(int(parts.max())):
            off = np.where(is_one, 0, (number - (parts - 1) / 2) / np.sqrt(np.maximum(parts**2 - 1, 1)))
            column, row, depth = middles + line[:, None, None] * off
            column, row, inverse = column / depth, row / depth, 1 / depth
            inside = in_zone & (number < parts)
            inside &= (column >= 1) & (column <= columns - 3) & (row >= 1) & (row <= rows - 2)
            column, row = np.where(inside, column, 1.0), np.where(inside, row, 1.0)
            weight = inside * share * inverse**2 / 2
            plane = np.clip((inverse - of.first_plane) * of.planes_per_inverse, 0, planes - 1)
            farther = np.minimum(plane.astype(int), planes - 2)
            first_row, first_column = (np.floor(place + 0.5).astype(int) - 1 for place in (row, column))
            by_row, by_column = (
                [_spline(place - first - 1 + end * apart * smeared) for end in (-1, 1)]
                for place, first, smeared in ((row, first_row, high), (column, first_column, wide))
            )
            by_plane = 1 - (plane - farther), plane - farther
            for a, b, k in itertools.product(range(3), range(3), range(2)):
                share_of_cell = by_row[0][a] * by_column[0][b] + by_row[1][a] * by_column[1][b]
                yield (farther + k, first_row + a, first_column + b), weight * share_of_cell * by_plane[k]


def _spline(offset: Array) -> tuple[Array, Array, Array]:
    """The quadratic B-spline's shares of the cell before, the nearest and the one after."""
    return (0.5 - offset) ** 2 / 2, 0.75 - offset**2, (0.5 + offset) ** 2 / 2


def differentiate_places(
    volume: Array, cells: Array, of: DepthResponse, passes: Array | None = None
) -> tuple[Array, Array]:
    """Of the sum of `volume` times what the adjoint of `voxels_to_cells` gives: by `of.matrix` (3, 4), and by its line (3,).

    By central differences, which say no more than the images themselves.
    """
    numbers = np.concatenate([of.matrix.ravel(), of.matrix[:, :3] @ of.line])
    scale = np.concatenate([np.repeat(np.abs(of.matrix[:, :3]).max(axis=1), 4), np.abs(numbers[12:])])

    def total(numbers: Array) -> float:
        matrix = numbers[:12].reshape(3, 4)
        line = np.linalg.solve(matrix[:, :3], numbers[12:])
        return float((voxels_to_cells(volume, replace(of, matrix=matrix, line=line), passes) * cells).sum())

    by = np.array([(total(numbers + step) - total(numbers - step)) for step in _STEP * np.diag(scale)])
    by /= 2 * _STEP * scale
    return by[:12].reshape(3, 4), by[12:]


def differentiate_taps(image: Array, cells: Array, of: DepthResponse) -> Array:
    """Of the sum of `image` times `cells_to_pixels`: by `of.kernel`, (planes, taps, taps)."""
    fine = np.zeros(of.shape[1:])
    fine[_pixels(of)] = image * of.after
    spectrum = np.fft.rfft2(cells * of.before) * np.fft.rfft2(fine).conj()
    taps = np.fft.irfft2(spectrum, of.shape[1:])
    return taps[:, : of.kernel.shape[1], : of.kernel.shape[2]]
