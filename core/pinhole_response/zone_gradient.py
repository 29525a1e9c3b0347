"""Gradient of a depth zone's response: the chain rule from the response's arrays back to the view's numbers."""

from dataclasses import replace
from types import ModuleType
from typing import NamedTuple, Self

import numpy as np

from ..arrays import Array
from .depth_response import Block, DepthResponse, Index
from .depth_zone import DepthZone, ViewNumbers
from .directional_effects import DirectionalEffects
from .oblique_kernels import NodeKernelGradient, balance_factors
from .pixel_kernels import KernelShape, pixel_kernels_gradient
from .zone_response import correction_numbers, half_widths, second_order_correction, zone_kernels

# Relative step of central differences: their errors are 1e-9 or less of the quantities that are differentiated by them.
_STEP = 1e-5


class ResponseGradient(NamedTuple):
    """Gradient of a loss by the arrays of a `DepthResponse`."""

    matrix: Array
    """(3, 4), by `DepthResponse.matrix`; the line's dependence on it is included."""
    depth_line: Array
    """(3,), by the line's vector (column h, row h, h), the product of the matrix and `DepthResponse.depth_line`."""
    cell_weights: Array
    """(rows, columns), by the logarithm of `DepthResponse.cell_weights`."""
    pixel_weights: Array
    """(n_v, n_u), by the logarithm of `DepthResponse.pixel_weights`."""
    kernels: Array
    """(planes, [nodes along v, along u,] taps, taps), by `DepthResponse.kernels`."""

    @classmethod
    def of_product(
        cls, volume: Array, image: Array, response: DepthResponse, transmittance: Array | None, backend: ModuleType
    ) -> tuple[Self, Array]:
        """Return the gradient of the sum of `image` times the projection of `volume`, and the adjoint's cells.

        `backend` is the module `compiled` or `reference`. The cells (planes, rows, columns) are what `pixels_to_cells` makes
        of the image.
        """
        cells = backend.voxels_to_cells(volume, response, transmittance)
        d_cells = backend.pixels_to_cells(image, response)
        matrix, depth_line = backend.matrix_gradient(volume, d_cells, response, transmittance)
        matrix[:, :3] += np.outer(depth_line, response.depth_line)
        pixel_weights = image * backend.cells_to_pixels(cells, response)
        kernels = _kernel_gradient(image, cells, response, backend)
        return cls(matrix, depth_line, (cells * d_cells).sum(axis=0), pixel_weights, kernels), d_cells

    def plus(self, addend: Self) -> Self:
        """Return the sum of two gradients."""
        return type(self)(*(a + b for a, b in zip(self, addend, strict=True)))


def _kernel_gradient(image: Array, cells: Array, response: DepthResponse, backend: ModuleType) -> Array:
    """Return the gradient of the sum of `image` times the pixels of `cells` by `response.kernels`."""
    if response.node_positions is None:
        return np.asarray(backend.kernel_gradient(image, cells, response))
    d_kernels = np.zeros(response.kernels.shape)
    for (a, b), node_response, pixels, (rows, columns) in response.node_responses():
        node_image, node_cells = np.ascontiguousarray(image[pixels]), np.ascontiguousarray(cells[:, rows, columns])
        d_kernels[:, a, b] = backend.kernel_gradient(node_image, node_cells, node_response)
    return d_kernels


def zone_gradient(
    zone: DepthZone, response: DepthResponse, pixels: Block, origin: Index, gradient: ResponseGradient
) -> ViewNumbers:
    """Return the gradient by the view's numbers from that by the response to a box of the volume.

    Parameters
    ----------
    zone
        The zone.
    response, pixels, origin
        The response to the box, the pixels that may see it, and the index of its first voxel, as
        `DepthResponse.restrict_to_box` returns and takes them.
    gradient
        Gradient of a loss by that response.
    """
    first_pixels, half = [part.start or 0 for part in pixels], half_widths(response.kernels)
    first_cells = [zone.cells_per_pixel[i] * first_pixels[i] - half[i] for i in range(2)]
    d_shape, d_correction, d_nodes = _tap_chain(zone, response, first_cells, gradient)
    total, d_cell_size = _matrix_chain(zone, response, origin, first_cells, gradient)
    d_numbers, d_mean_correction, d_size = _cell_chain(zone, first_cells, gradient.cell_weights)
    total, d_cell_size = total.plus(d_numbers), d_cell_size + d_size
    total = total.plus(_pixel_chain(zone, pixels, first_pixels, gradient.pixel_weights))
    # Kernels have the correction less its mean, cells its mean.
    d_correction += d_mean_correction / len(d_correction) - d_correction.mean()
    d_numbers, d_size = _shape_chain(zone, d_shape, d_correction)
    total = total.plus(d_nodes)
    pitch = total.pitch + d_numbers.pitch + (d_cell_size + d_size) / zone.cells_per_pixel
    return total.plus(d_numbers)._replace(pitch=pitch)


def _tap_chain(
    zone: DepthZone, response: DepthResponse, first_cells: list[int], gradient: ResponseGradient
) -> tuple[KernelShape, Array, ViewNumbers]:
    """Return what the gradient by the kernels becomes: the gradients by shape, by correction, and by the view's numbers.

    The gradient by the correction (planes,) is that of ``correction - correction.mean()``. With nodes the gradient by the
    shape is 0, and all flows to the view's numbers, as does the gradient through the cells' `balance_factors`.
    """
    d_box = gradient.kernels
    first = round((response.first_plane - zone.inverse_depths[0]) * response.planes_per_inverse_depth)
    d_kernels = np.zeros((len(zone.inverse_depths), *d_box.shape[1:]))
    d_kernels[first : first + len(d_box)] = d_box
    correction = second_order_correction(zone, *correction_numbers(zone))
    factors = (1 + correction - correction.mean()).reshape(-1, *[1] * (d_kernels.ndim - 1))
    if zone.effects is None:
        kernels, d_shape = pixel_kernels_gradient(zone.kernel_shape, zone.cells_per_pixel, d_kernels * factors)
        return d_shape, (d_kernels * kernels).sum(axis=(1, 2)), ViewNumbers.zero()
    kernels, zero_shape = zone_kernels(zone), KernelShape(*(0 * number for number in zone.kernel_shape))
    d_correction = (d_kernels * kernels).sum(axis=(1, 2, 3, 4))
    d_nodes = _node_chain(zone, zone.effects, d_kernels * factors, first_cells, gradient.cell_weights)
    return zero_shape, d_correction, d_nodes


def _node_chain(
    zone: DepthZone, effects: DirectionalEffects, d_kernels: Array, first_cells: list[int], d_log_weights: Array
) -> ViewNumbers:
    """Return the gradient by the view's numbers through kernels of nodes and factors of cells, by central differences."""
    numbers, form = zone.numbers, NodeKernelGradient(zone, effects, d_kernels)

    def difference(name: str, index: Index, scale: float) -> float:
        """Return the central difference by the element `index` of the number `name`, with a step of 1e-5 `scale`."""
        values = []
        for sign in (1, -1):
            step = np.zeros_like(getattr(numbers, name))
            step[index] = sign * _STEP * scale
            moved = replace(zone, numbers=numbers.plus(ViewNumbers.zero()._replace(**{name: step})))
            places = moved.crystal_positions(first_cells, d_log_weights.shape, moved.cell_size)
            balance = float((d_log_weights * np.log(balance_factors(moved, *places))).sum())
            if name == "to_camera":  # the kernels depend on it by the edges alone
                values.append(balance + form.value_by_edges(moved))
            else:
                values.append(balance + form.value(moved, effects.with_effective_diameter(moved.numbers.diameter)))
        return (values[0] - values[1]) / (2 * _STEP * scale)

    longest_edge, result = float(np.abs(numbers.to_camera[:, :3]).max()), ViewNumbers.zero()
    for index in np.ndindex(3, 3):
        result.to_camera[index] = difference("to_camera", index, longest_edge)
    for i in range(2):
        result.first[i] = difference("first", (i,), numbers.length)
        result.pitch[i] = difference("pitch", (i,), abs(numbers.pitch[i]))
    length, diameter = (difference(name, (), getattr(numbers, name)) for name in ("length", "diameter"))
    return result._replace(length=length, diameter=diameter)


def _matrix_chain(
    zone: DepthZone, response: DepthResponse, origin: Index, first_cells: list[int], gradient: ResponseGradient
) -> tuple[ViewNumbers, Array]:
    """Return the gradients by the view's numbers and by the cell size (2,) that flow through the voxels' positions."""
    numbers, cell_size, d_cell_size = zone.numbers, zone.cell_size, np.zeros(2)
    result = ViewNumbers.zero()
    box_to_camera = numbers.to_camera.copy()
    box_to_camera[:, 3] += box_to_camera[:, :3] @ origin
    result.to_camera[2] += gradient.matrix[2]
    d_length = 0.0
    for row, i in ((0, 1), (1, 0)):
        d_row = gradient.matrix[row]
        d_across, d_deep = d_row @ box_to_camera[row], d_row @ box_to_camera[2]
        result.to_camera[row] += numbers.length / cell_size[i] * d_row
        result.to_camera[2] += (-first_cells[i] - numbers.first[i] / cell_size[i]) * d_row
        d_length += d_across / cell_size[i]
        result.first[i] -= d_deep / cell_size[i]
        d_cell_size[i] += (numbers.first[i] * d_deep - numbers.length * d_across) / cell_size[i] ** 2
    result.to_camera[:, :3] += np.outer(result.to_camera[:, 3], origin)
    # The line is along the gradient of the depth, a unit vector.
    depths, d_direction = zone.piece_edges[2], gradient.depth_line @ response.matrix[:, :3] / zone.pieces_per_edge
    d_depths = (d_direction - depths * (depths @ d_direction) / (depths @ depths)) / np.linalg.norm(depths)
    result.to_camera[2, :3] += d_depths / zone.pieces_per_edge
    return result._replace(length=d_length), d_cell_size


def _cell_chain(zone: DepthZone, first_cells: list[int], d_log_weights: Array) -> tuple[ViewNumbers, float, Array]:
    """Return the gradients that flow through the cells' weights.

    They are those by the view's numbers, by the mean of the second-order correction, and by the cell size (2,).
    """
    numbers, s = zone.numbers, zone.pixel_exponent
    mean_correction = second_order_correction(zone, *correction_numbers(zone)).mean()
    v, u = zone.crystal_positions(first_cells, d_log_weights.shape, zone.cell_size)
    squared_slope = (v**2 + u**2) / numbers.length**2
    denominator = (1 + squared_slope) ** 2 + mean_correction
    slope_term = 4 * mean_correction * squared_slope / (1 + squared_slope) / denominator
    d_log_distance = (1 - s) * _log_derivative(zone, v, u) - slope_term
    d_first, d_size = _position_chain(v, u, d_log_weights * d_log_distance, first_cells)
    length = (d_log_weights * (2 * s - d_log_distance)).sum() / numbers.length
    diameter = 2 * (1 - s) * d_log_weights.sum() / numbers.diameter
    result = ViewNumbers.zero()._replace(length=length, diameter=diameter, first=d_first)
    return result, (d_log_weights / denominator).sum(), d_size


def _pixel_chain(zone: DepthZone, pixels: Block, first_pixels: list[int], d_log_weights: Array) -> ViewNumbers:
    """Return the gradient by the view's numbers that flows through the pixels' weights.

    The fractions of pixels on the crystal are differentiated by central differences.
    """
    numbers, s = zone.numbers, zone.pixel_exponent
    v, u = zone.crystal_positions(first_pixels, d_log_weights.shape, numbers.pitch)
    d_log_distance = s * _log_derivative(zone, v, u)
    first, pitch = _position_chain(v, u, d_log_weights * d_log_distance, first_pixels)
    if np.isfinite(zone.crystal_side):
        for i, (fractions, part) in enumerate(zip(zone.fractions_on_crystal(), pixels, strict=True)):
            d_log, inside = d_log_weights.sum(axis=1 - i), fractions[part]
            d_fractions = np.divide(d_log, inside, out=np.zeros(len(d_log)), where=inside > 0)
            step = _STEP * abs(numbers.pitch[i])
            for result, change in ((first, (step, 0.0)), (pitch, (0.0, step))):
                upper, lower = (zone.fractions_on_crystal(a * change[0], a * change[1])[i] for a in (1, -1))
                result[i] += d_fractions @ (upper - lower)[part] / (2 * step)
    length = (d_log_weights * (-2 * s - d_log_distance)).sum() / numbers.length
    diameter = 2 * s * d_log_weights.sum() / numbers.diameter
    return ViewNumbers.zero()._replace(length=length, diameter=diameter, first=first, pitch=pitch)


def _log_derivative(zone: DepthZone, v: Array, u: Array) -> Array:
    """Return d log(point weight) / d log(distance from the crystal's centre), by central differences; 0 where it is 0."""
    upper, lower = (zone.point_weight(u=scale * u, v=scale * v) for scale in (1 + _STEP, 1 - _STEP))
    is_positive = (upper > 0) & (lower > 0)
    return np.divide(upper - lower, (upper + lower) * _STEP, out=np.zeros_like(upper), where=is_positive)


def _position_chain(v: Array, u: Array, d_log_distance: Array, first: list[int]) -> tuple[Array, Array]:
    """Return the gradients by the first position and by the step (2,) of positions numbered from `first` on.

    `d_log_distance` is the gradient by the logarithm of the positions' distance from the crystal's centre.
    """
    squared = v**2 + u**2
    by_square = np.divide(d_log_distance, squared, out=np.zeros_like(d_log_distance), where=squared > 0)
    d_positions = (by_square * v).sum(axis=1), (by_square * u).sum(axis=0)
    d_step = [d @ (start + np.arange(len(d))) for d, start in zip(d_positions, first, strict=True)]
    return np.array([d.sum() for d in d_positions]), np.array(d_step)


def _shape_chain(zone: DepthZone, d_shape: KernelShape, d_correction: Array) -> tuple[ViewNumbers, Array]:
    """Return the gradients by the view's numbers and by the cell size (2,) through kernel shapes and correction.

    The second-order correction is differentiated by central differences.
    """
    numbers, cell_size, shape = zone.numbers, zone.cell_size, zone.kernel_shape
    arguments = correction_numbers(zone)
    d_arguments = np.empty(3)
    for i, step in enumerate(_STEP * np.eye(3) * arguments):
        upper, lower = (second_order_correction(zone, *(arguments + sign * step)) for sign in (1, -1))
        d_arguments[i] = d_correction @ (upper - lower) / (2 * step[i])
    diameter = d_arguments[0] + (d_shape.hole_diameter / np.abs(cell_size)).sum()
    d_length = d_arguments[1] + d_shape.image_scales @ zone.inverse_depths
    length = d_length - 2 / numbers.length * (d_shape.curvature @ shape.curvature)
    d_log_edges = (d_shape.voxel_edges * shape.voxel_edges).sum(axis=1)
    d_log_diameter = d_shape.hole_diameter * shape.hole_diameter
    d_cell_size = (2 * d_shape.curvature * shape.curvature - d_log_diameter - d_log_edges) / cell_size
    d_transverse = d_shape.voxel_edges / cell_size[:, None] + 2 * d_arguments[2] * zone.transverse_edges
    edges, result = zone.piece_edges, ViewNumbers.zero()
    depths, squared = edges[2], edges[2] @ edges[2]
    for row, d_edges in ((0, d_transverse[1]), (1, d_transverse[0])):
        slope, d_along = edges[row] @ depths / squared, d_edges @ depths / squared
        result.to_camera[row, :3] += (d_edges - d_along * depths) / zone.pieces_per_edge
        d_depths = 2 * slope * d_along * depths - slope * d_edges - d_along * edges[row]
        result.to_camera[2, :3] += d_depths / zone.pieces_per_edge
    return result._replace(diameter=diameter, length=length), d_cell_size
