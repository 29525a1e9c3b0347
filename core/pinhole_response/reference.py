"""Projection and back-projection with a `DepthResponse`, written to be read: the reference in numpy, in float64."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from ..arrays import Array
from .depth_response import DepthResponse

# Steps of central differences, in units of the largest number of their kind.
_STEP = 1e-6


def voxels_to_cells(volume: Array, response: DepthResponse, transmittance: Array | None = None) -> Array:
    """Return the cells (planes, rows, columns) among which `volume` (n_x, n_y, n_z) is shared out.

    `transmittance`, of the volume's shape, is the share of each voxel's photons that attenuation leaves.
    """
    cells = np.zeros(response.shape)
    for x in range(len(volume)):
        layer = volume[x] if transmittance is None else volume[x] * transmittance[x]
        for index, weights in _stencils(response, volume.shape, x):
            np.add.at(cells, index, layer * weights)
    return cells


def cells_to_voxels(
    volume: Array, cells: Array, response: DepthResponse, transmittance: Array | None, slab: slice
) -> None:
    """Add the adjoint of `voxels_to_cells` for `cells` to the `slab` of `volume` along x, in place."""
    for x in range(*slab.indices(len(volume))):
        layer = sum(weights * cells[index] for index, weights in _stencils(response, volume.shape, x))
        volume[x] += layer if transmittance is None else layer * transmittance[x]


def cells_to_pixels(cells: Array, response: DepthResponse) -> Array:
    """Return the image (n_v, n_u): `cells`, correlated with the response's kernels, times the weights of the pixels."""
    shape = response.shape[1:]
    spectrum, image = np.fft.rfft2(cells * response.cell_weights), np.zeros(response.pixel_weights.shape)
    for kernels, weights in _node_kernels(response):
        correlation = spectrum * np.fft.rfft2(kernels, shape).conj()
        image += weights * _from_spectrum(correlation.sum(axis=0), response)[_first_cells(response)]
    return image * response.pixel_weights


def pixels_to_cells(image: Array, response: DepthResponse) -> Array:
    """Return the adjoint of `cells_to_pixels` for an image (n_v, n_u), the cells (planes, rows, columns)."""
    shape, cells = response.shape[1:], np.zeros(response.shape)
    for kernels, weights in _node_kernels(response):
        plane = np.zeros(shape)
        plane[_first_cells(response)] = image * response.pixel_weights * weights
        cells += _from_spectrum(np.fft.rfft2(plane) * np.fft.rfft2(kernels, shape), response)
    return cells * response.cell_weights


def _node_kernels(response: DepthResponse) -> Iterator[tuple[Array, Array]]:
    """Yield the kernels (planes, taps, taps) of each node, and the node's weight in each pixel, (n_v, n_u)."""
    kernels, positions = response.kernels, response.node_positions
    if positions is None:
        yield kernels, np.ones(response.pixel_weights.shape)
        return
    for node in np.ndindex(kernels.shape[1:3]):
        row_weights, column_weights = (np.maximum(1 - np.abs(p - k), 0) for p, k in zip(positions, node, strict=True))
        if row_weights.any() and column_weights.any():
            yield kernels[:, node[0], node[1]], np.outer(row_weights, column_weights)


def _first_cells(response: DepthResponse) -> tuple[slice, ...]:
    """Return the rows and columns of the first cells of all pixels."""
    pixels = zip(response.cells_per_pixel, response.pixel_weights.shape, strict=True)
    return tuple(slice(0, step * (n - 1) + 1, step) for step, n in pixels)


def _from_spectrum(spectrum: Array, response: DepthResponse) -> Array:
    """Return the inverse Fourier transform, with 0 in place of rounding errors, which could be negative."""
    values = np.fft.irfft2(spectrum, response.shape[1:])
    return np.where(np.abs(values) > 1e-14 * np.abs(values).max(), values, 0)


def _stencils(response: DepthResponse, shape: tuple[int, ...], x: int) -> Iterator[tuple[tuple[Array, ...], Array]]:
    """Yield cells and weights of a layer of voxels: for each of 3 x 3 x 2 neighbours, indices and weights (n_y, n_z)."""
    planes, rows, columns = response.shape
    y, z = np.meshgrid(np.arange(shape[1]), np.arange(shape[2]), indexing="ij")
    index = np.stack([np.full(y.shape, x), y, z, np.ones(y.shape)])
    voxels = np.einsum("ij,jyz->iyz", response.matrix, index)
    in_zone = (voxels[2] > response.nearest) & (voxels[2] <= response.farthest)
    line = response.matrix[:, :3] @ response.depth_line
    for shift in response.piece_offsets @ response.matrix[:, :3].T:
        centers = voxels + shift[:, None, None]
        centers[2, ~in_zone] = np.inf
        columns_long, rows_long = (line[:2, None, None] - centers[:2] / centers[2] * line[2]) / centers[2]
        length = np.maximum(np.abs(columns_long), np.abs(rows_long))
        is_single = length <= response.max_pair_length
        n_points = np.where(is_single, 1, 2 + np.floor(length * response.samples_per_cell))
        half_distance = np.where(is_single & (length > response.max_point_length), 1 / math.sqrt(12), 0)
        # A single point has the mean of 1 / depth^2 on the line.
        share = np.where(is_single, 1 + (line[2] / centers[2] / 2) ** 2, 1 / n_points)
        for number in range(int(n_points.max())):
            # Several points have the variance of the line.
            offset = (number - (n_points - 1) / 2) / np.sqrt(np.maximum(n_points**2 - 1, 1))
            column, row, depth = centers + line[:, None, None] * np.where(is_single, 0, offset)
            column, row, inverse = column / depth, row / depth, 1 / depth
            inside = in_zone & (number < n_points)
            inside &= (column >= 1) & (column <= columns - 3) & (row >= 1) & (row <= rows - 2)
            column, row = np.where(inside, column, 1.0), np.where(inside, row, 1.0)
            weight = inside * share * inverse**2 / 2
            plane = np.clip((inverse - response.first_plane) * response.planes_per_inverse_depth, 0, planes - 1)
            farther = np.minimum(plane.astype(int), planes - 2)
            first_row, first_column = (np.floor(place + 0.5).astype(int) - 1 for place in (row, column))
            # A pair of points, which are the same where the line is short.
            row_shares, column_shares = (
                [_spline_shares(place - first - 1 + end * half_distance * long) for end in (-1, 1)]
                for place, first, long in ((row, first_row, rows_long), (column, first_column, columns_long))
            )
            plane_shares = 1 - (plane - farther), plane - farther
            for a, b, k in itertools.product(range(3), range(3), range(2)):
                cell_share = row_shares[0][a] * column_shares[0][b] + row_shares[1][a] * column_shares[1][b]
                yield (farther + k, first_row + a, first_column + b), weight * cell_share * plane_shares[k]


def _spline_shares(offset: Array) -> tuple[Array, Array, Array]:
    """Return the quadratic B-spline's shares of the cell before, the nearest one and the one after.

    `offset` is from the nearest cell's centre, -1/2 to 1/2 cell.
    """
    return (0.5 - offset) ** 2 / 2, 0.75 - offset**2, (0.5 + offset) ** 2 / 2


def matrix_gradient(
    volume: Array, cells: Array, response: DepthResponse, transmittance: Array | None = None
) -> tuple[Array, Array]:
    """Return the gradient of the sum of `volume` times the adjoint of `cells` by the voxels' places.

    It is the gradients by ``response.matrix`` (3, 4) at a constant line, and by the line's vector in (column h, row h, h),
    (3,). They are central differences, which tell no more than the images themselves.
    """
    numbers = np.concatenate([response.matrix.ravel(), response.matrix[:, :3] @ response.depth_line])
    scale = np.concatenate([np.repeat(np.abs(response.matrix[:, :3]).max(axis=1), 4), np.abs(numbers[12:])])

    def total(numbers: Array) -> float:
        """Return the sum of `volume` times the adjoint of `cells`; `numbers` (15,): the matrix, then the line."""
        matrix = numbers[:12].reshape(3, 4)
        moved = replace(response, matrix=matrix, depth_line=np.linalg.solve(matrix[:, :3], numbers[12:]))
        return float((voxels_to_cells(volume, moved, transmittance) * cells).sum())

    gradient = np.array([(total(numbers + step) - total(numbers - step)) for step in _STEP * np.diag(scale)])
    gradient /= 2 * _STEP * scale
    return gradient[:12].reshape(3, 4), gradient[12:]


def kernel_gradient(image: Array, cells: Array, response: DepthResponse) -> Array:
    """Return the gradient of the sum of `image` times the pixels of `cells` by ``response.kernels`` (planes, taps, taps)."""
    plane = np.zeros(response.shape[1:])
    plane[_first_cells(response)] = image * response.pixel_weights
    spectrum = np.fft.rfft2(cells * response.cell_weights) * np.fft.rfft2(plane).conj()
    taps = np.fft.irfft2(spectrum, response.shape[1:])
    return taps[:, : response.kernels.shape[1], : response.kernels.shape[2]]
