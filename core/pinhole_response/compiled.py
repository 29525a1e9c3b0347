"""Projection, back-projection and gradients with a `DepthResponse` in C; the functions are those of `reference`."""

import math
from typing import Any

import numpy as np

from ..arrays import Array, Floats
from ..rays.backends.cpu import DepthJob, as_voxel_array, level, library
from .depth_response import DepthResponse

_NODE_ROWS, _GIVEN_ROWS = 4, 16  # in kernels.h
_READ_ON = 16  # numbers that the kernels read beyond the last one that they use


def voxels_to_cells(volume: Array, response: DepthResponse, transmittance: Array | None = None) -> Array:
    """Return the cells (planes, rows, columns) among which `volume` (n_x, n_y, n_z) is shared out.

    `transmittance`, of the volume's shape, is the share of each voxel's photons that attenuation leaves.
    """
    cells = np.zeros(response.shape, volume.dtype)
    _run_voxels(library.voxels_to_cells, response, cells, volume, transmittance)
    return cells


def cells_to_voxels(
    volume: Array, cells: Array, response: DepthResponse, transmittance: Array | None, slab: slice
) -> None:
    """Add the adjoint of `voxels_to_cells` for `cells` to the `slab` of `volume` along x, in place."""
    first, last, _ = slab.indices(len(volume))
    _run_voxels(library.cells_to_voxels, response, cells, volume, transmittance, first=first, last=last)


def cells_to_pixels(cells: Array, response: DepthResponse) -> Array:
    """Return the image (n_v, n_u) that the pixels sum of the cells."""
    image = np.zeros(response.pixel_weights.shape, cells.dtype)
    sorted_cells = _new_sorted_cells(response, cells.dtype)
    sorted_cells[...] = _by_place(cells * response.cell_weights, response)  # products of strided arrays are slower
    _run_pixels(library.cells_to_pixels, response, sorted_cells, image)
    image *= response.pixel_weights
    return image


def pixels_to_cells(image: Array, response: DepthResponse) -> Array:
    """Return the adjoint of `cells_to_pixels` for an image (n_v, n_u), the cells (planes, rows, columns)."""
    sorted_cells = _new_sorted_cells(response, image.dtype)
    if response.node_positions is not None:
        sorted_cells[...] = 0
    _run_pixels(library.pixels_to_cells, response, sorted_cells, _padded_image(image, response))
    cells = np.empty(response.shape, image.dtype)
    weights = _by_place(response.cell_weights, response)
    np.multiply(sorted_cells, weights, out=_by_place(cells, response), casting="same_kind")
    return cells


def matrix_gradient(
    volume: Array, cells: Array, response: DepthResponse, transmittance: Array | None = None
) -> tuple[Floats, Floats]:
    """Return the gradient of the sum of `volume` times the adjoint of `cells` by the voxels' places.

    It is the gradients by ``response.matrix`` (3, 4) at a constant line, and by the line's vector in (column h, row h, h),
    (3,).
    """
    gradient = np.zeros(3 + 12 * len(response.piece_offsets))
    _run_voxels(library.differentiate_places, response, cells, volume, transmittance, gradient=gradient.ctypes.data)
    # Of each piece by its shift, and that times the voxels' x, y and z.
    d_shifts = gradient[3:].reshape(-1, 4, 3)
    d_matrix = np.concatenate([d_shifts[:, 1:].sum(axis=0).T, d_shifts[:, 0].sum(axis=0)[:, None]], axis=1)
    d_matrix[:, :3] += d_shifts[:, 0].T @ response.piece_offsets
    return d_matrix, gradient[:3]


def kernel_gradient(image: Array, cells: Array, response: DepthResponse) -> Floats:
    """Return the gradient of the sum of `image` times the pixels of `cells` by ``response.kernels`` (planes, taps, taps)."""
    gradient = np.zeros(response.kernels.shape)
    sorted_cells = _new_sorted_cells(response, cells.dtype)
    sorted_cells[...] = _by_place(cells * response.cell_weights, response)
    _run_pixels(library.differentiate_taps, response, sorted_cells, _padded_image(image, response), gradient)
    return gradient


def _padded_image(image: Array, response: DepthResponse) -> Array:
    """Return `image` times the pixels' weights, as a view of an array with the zeros around it that the kernels read."""
    n_v, n_u = image.shape
    step, columns = response.cells_per_pixel[1], response.shape[2]
    zeros_before = (response.kernels.shape[-1] - 1) // step
    padded = np.zeros((n_v, zeros_before + -(-(columns // step) // _READ_ON) * _READ_ON), image.dtype)
    padded[:, zeros_before : zeros_before + n_u] = image * response.pixel_weights
    return padded[:, zeros_before:]


def _by_place(cells: Array, response: DepthResponse) -> Array:
    """Return `cells` (…, rows, columns) as a view (…, rows, cells along a pixel, pixels along a row)."""
    return cells.reshape(*cells.shape[:-1], -1, response.cells_per_pixel[1]).swapaxes(-1, -2)


def _new_sorted_cells(response: DepthResponse, dtype: Any) -> Array:
    """Return an array for cells in the order of `_by_place`, followed in memory by numbers that the kernels read."""
    planes, rows, columns = response.shape
    places = response.cells_per_pixel[1]
    shape = planes, rows, places, columns // places
    memory = np.empty(math.prod(shape) + _READ_ON, dtype)
    memory[-_READ_ON:] = 0
    return memory[:-_READ_ON].reshape(shape)


def _run_voxels(
    kernel: Any, response: DepthResponse, cells: Array, volume: Array, transmittance: Array | None, **fields: Any
) -> None:
    """Run a kernel between the voxels and the cells of one view; `fields` are further ones of the job."""
    if transmittance is not None and (transmittance.shape != volume.shape or transmittance.dtype != cells.dtype):
        shape, dtype = transmittance.shape, transmittance.dtype
        raise ValueError(f"expected a transmittance of the volume's shape and type, got {shape}, {dtype}")
    matrix, fields = response.matrix, {"first": 0, "last": len(volume)} | fields
    shifts, line = np.ascontiguousarray(response.piece_offsets @ matrix[:, :3].T), matrix[:, :3] @ response.depth_line
    planes, rows, columns = response.shape
    job = DepthJob(is_double=cells.dtype == np.float64,
                   volume=as_voxel_array(volume, cells, kernel is library.cells_to_voxels),
                   matrix=tuple(matrix.ravel().tolist()), line=tuple(line.tolist()), shifts=shifts.ctypes.data,
                   pieces=len(shifts), of_point=response.max_point_length, of_pair=response.max_pair_length,
                   parts_per_cell=response.samples_per_cell, nearest=response.nearest, farthest=response.farthest,
                   first_plane=response.first_plane, planes_per_inverse=response.planes_per_inverse_depth,
                   cells=cells.ctypes.data, passes=None if transmittance is None else transmittance.ctypes.data,
                   planes=planes, rows=rows, columns=columns, step=response.cells_per_pixel, **fields)  # fmt: skip
    kernel(level, job)


def _run_pixels(
    kernel: Any, response: DepthResponse, sorted_cells: Array, image: Array, gradient: Floats | None = None
) -> None:
    """Run a kernel between the sorted cells and the pixels of one view."""
    step_v, step_u = response.cells_per_pixel
    planes, rows, columns = response.shape
    kernels = np.ascontiguousarray(response.padded_kernels, image.dtype)
    if kernels.shape[-1] * step_v < _READ_ON:
        kernels = np.append(kernels, np.zeros(_READ_ON, image.dtype))[: kernels.size].reshape(kernels.shape)
    nodes: dict[str, Any] = {}
    if response.node_positions is not None:
        node_rows, node_columns = (np.ascontiguousarray(positions) for positions in response.node_positions)
        row = _GIVEN_ROWS * kernels.shape[-1] + response.pixel_weights.shape[1] + 2 * _READ_ON
        room = np.zeros(_NODE_ROWS * row + 2 * _READ_ON, image.dtype)
        columns_of = np.arange(kernels.shape[-1]) % step_u * (columns // step_u)
        columns_of += np.arange(kernels.shape[-1]) // step_u
        nodes = {"nodes": kernels.shape[1:3], "node_rows": node_rows.ctypes.data,
                 "node_columns": node_columns.ctypes.data, "room": room.ctypes.data,
                 "columns_of": columns_of.ctypes.data}  # fmt: skip
    job = DepthJob(is_double=image.dtype == np.float64, cells=sorted_cells.ctypes.data, planes=planes, rows=rows,
                   columns=columns, kernel=kernels.ctypes.data, bounds=response.tap_bounds.ctypes.data,
                   taps=response.kernels.shape[-2:], step=response.cells_per_pixel, image=image.ctypes.data,
                   row=image.strides[0] // image.itemsize, pixels=response.pixel_weights.shape,
                   gradient=None if gradient is None else gradient.ctypes.data, **nodes)  # fmt: skip
    kernel(level, job)
