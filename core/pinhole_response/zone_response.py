"""The response of a depth zone: from its geometry to the numbers that the work is done with (`DepthResponse`)."""

import numpy as np

from ..arrays import Array
from .depth_response import DepthResponse
from .depth_zone import DepthZone
from .oblique_kernels import balance_factors, node_kernels
from .pixel_kernels import Pair, pixel_kernels


def zone_response(zone: DepthZone, dtype: type) -> DepthResponse:
    """Return the response of a zone, with numbers of this type."""
    numbers, inverse_depths, cell_size, cells = zone.numbers, zone.inverse_depths, zone.cell_size, zone.cells_per_pixel
    correction = second_order_correction(zone, *correction_numbers(zone))
    kernels = zone_kernels(zone)
    kernels *= (1 + correction - correction.mean()).reshape(-1, *[1] * (kernels.ndim - 1))
    half = half_widths(kernels)
    matrix = numbers.to_camera.copy()
    for row, i in ((0, 1), (1, 0)):  # columns follow u, rows v
        offset = half[i] - numbers.first[i] / cell_size[i]
        matrix[row] = numbers.length / cell_size[i] * numbers.to_camera[row] + offset * numbers.to_camera[2]
    n_cells = [cells[i] * (zone.image_shape[i] - 1 - (-kernels.shape[i - 2] - i) // cells[i]) for i in range(2)]
    v, u = zone.crystal_positions([-h for h in half], tuple(n_cells), cell_size)
    squared_secant = 1 + (v**2 + u**2) / numbers.length**2
    piece_volume, voxel_exponent = zone.voxel_volume / zone.pieces_per_edge.prod(), 1 - zone.pixel_exponent
    cell_weights = piece_volume * numbers.length**2 * zone.point_weight(u=u, v=v) ** voxel_exponent
    cell_weights *= (1 + correction.mean() / squared_secant**2) * balance_factors(zone, v, u)
    v, u = zone.crystal_positions([0, 0], zone.image_shape, numbers.pitch)
    pixel_weights = zone.point_weight(u=u, v=v) ** zone.pixel_exponent * np.outer(*zone.fractions_on_crystal())
    depths = zone.piece_edges[2]
    zero_rows = [(0, 0)] * (kernels.ndim - 2) + [(cells[0],) * 2, (0, 0)]
    padded_kernels: Array = np.pad(kernels.astype(dtype), zero_rows)
    piece_offsets = (np.indices(tuple(zone.pieces_per_edge)).reshape(3, -1).T + 0.5) / zone.pieces_per_edge - 0.5
    depth_line = depths / zone.pieces_per_edge / np.linalg.norm(depths)
    planes_per_inverse_depth = float((len(inverse_depths) - 1) / (inverse_depths[-1] - inverse_depths[0]))
    rows, columns = (np.arange(n) / zone.node_spacing for n in zone.image_shape)
    return DepthResponse(matrix, piece_offsets, depth_line, *zone.sampling, zone.near, zone.far,
                         float(inverse_depths[0]), planes_per_inverse_depth, cell_weights.astype(dtype), padded_kernels,
                         cells, pixel_weights, None if zone.effects is None else (rows, columns))  # fmt: skip


def second_order_correction(zone: DepthZone, diameter: float, length: float, squared_edges: float) -> Array:
    """Return the relative second-order correction of each plane of depth, (planes,), on the axis.

    It is the mean of (1 + t^2)^(-3/2) over the hole, divided by what the separable weight and the kernel make of it, minus
    1; and, to second order, the same for the mean over the voxel. Off the axis it is to be multiplied by (1 + t^2)^-2.

    Parameters
    ----------
    zone
        The zone.
    diameter, length
        The hole's effective diameter d and the distance l to the image's plane, mm.
    squared_edges
        Sum of the squared transverse edges of a piece, mm^2.
    """
    s, inverse_depths = zone.pixel_exponent, zone.inverse_depths
    squared_radii = (np.arange(16)[:, None] + 0.5) / 16 * (diameter / 2) ** 2  # of rings of equal area in the hole
    squared_slopes = squared_radii * (1 / length + inverse_depths) ** 2  # of the pixels in the hole's shadow
    separable = np.average((1 + squared_slopes) ** (-1.5 * s), 0, 1 + zone.curvature * squared_slopes)
    over_voxel = -(1 - s) / 8 * squared_edges * inverse_depths**2
    return np.asarray(((1 + squared_radii * inverse_depths**2) ** -1.5).mean(axis=0) / separable - 1 + over_voxel)


def correction_numbers(zone: DepthZone) -> Array:
    """Return the numbers (3,) of the view that `second_order_correction` depends on, in the order of its arguments."""
    return np.array([zone.numbers.diameter, zone.numbers.length, np.square(zone.transverse_edges).sum()])


def zone_kernels(zone: DepthZone) -> Array:
    """Return the kernels (planes, taps, taps) of all pixels, or (planes, nodes, nodes, taps, taps) of the nodes."""
    if zone.effects is None:
        return pixel_kernels(zone.kernel_shape, zone.cells_per_pixel)
    return node_kernels(zone, zone.effects)


def half_widths(kernels: Array) -> Pair:
    """Return the number of taps before the central one, along v and u."""
    return kernels.shape[-2] // 2, kernels.shape[-1] // 2
