"""The four functions of the depth-dependent pinhole response in C, by the library of the backend cpu."""

import math
from typing import Any

import numpy as np

from ..arrays import Array, Floats
from ..rays.backends.cpu import DepthJob, as_lattice, level, library
from .depth_response import DepthResponse

_NODE_ROWS, _GIVEN_ROWS = 4, 16  # in kernels.h
_READ_ON = 16  # numbers that kernels read beyond the last of what they use


def voxels_to_cells(volume: Array, of: DepthResponse, passes: Array | None = None) -> Array:
    """What `volume` (n_x, n_y, n_z) gives to the cells (planes, rows, columns) of a view's fine image.

    `passes`, of the volume's shape, are the shares of photons that attenuation leaves.
    """
    cells = np.zeros(of.shape, volume.dtype)
    _run_voxels(library.voxels_to_cells, of, cells, volume, passes)
    return cells


def cells_to_voxels(volume: Array, cells: Array, of: DepthResponse, passes: Array | None, slab: slice) -> None:
    """Add to the `slab` of `volume` along x, in place, what the adjoint of `voxels_to_cells` gives."""
    _run_voxels(library.cells_to_voxels, of, cells, volume, passes, slab)


def cells_to_pixels(cells: Array, of: DepthResponse) -> Array:
    """The image (n_v, n_u) of a view's cells."""
    image = np.zeros(of.after.shape, cells.dtype)
    sorted_cells = _sorted_cells(of, cells.dtype)
    sorted_cells[...] = _by_place(cells * of.before, of)  # faster than products of what is apart
    _run_pixels(library.cells_to_pixels, of, sorted_cells, image)
    image *= of.after
    return image


def pixels_to_cells(image: Array, of: DepthResponse) -> Array:
    """The adjoint of `cells_to_pixels`."""
    sorted_cells = _sorted_cells(of, image.dtype)
    if of.places is not None:
        sorted_cells[...] = 0
    _run_pixels(library.pixels_to_cells, of, sorted_cells, _padded(image, of))
    cells = np.empty(of.shape, image.dtype)
    np.multiply(sorted_cells, _by_place(of.before, of), out=_by_place(cells, of), casting="same_kind")
    return cells


def differentiate_places(
    volume: Array, cells: Array, of: DepthResponse, passes: Array | None = None
) -> tuple[Floats, Floats]:
    """Of the sum of `volume` times what `voxels_to_cells`' adjoint gives: by `of.matrix` (3, 4), and by its line (3,)."""
    gradient = np.zeros(3 + 12 * len(of.pieces))
    _run_voxels(library.differentiate_places, of, cells, volume, passes, gradient=gradient)
    by_shifts = gradient[3:].reshape(-1, 4, 3)  # and times the voxels' indices
    by_matrix = np.concatenate([by_shifts[:, 1:].sum(axis=0).T, by_shifts[:, 0].sum(axis=0)[:, None]], axis=1)
    by_matrix[:, :3] += by_shifts[:, 0].T @ of.pieces
    return by_matrix, gradient[:3]


def differentiate_taps(image: Array, cells: Array, of: DepthResponse) -> Floats:
    """Of the sum of `image` times `cells_to_pixels`: by `of.kernel`, (planes, taps, taps)."""
    gradient = np.zeros(of.kernel.shape)
    sorted_cells = _sorted_cells(of, cells.dtype)
    sorted_cells[...] = _by_place(cells * of.before, of)
    _run_pixels(library.differentiate_taps, of, sorted_cells, _padded(image, of), gradient)
    return gradient


def _padded(image: Array, of: DepthResponse) -> Array:
    """`image` times `of.after`, with the zeros around it that kernels read."""
    n_v, n_u = image.shape
    before, together = (of.kernel.shape[-1] - 1) // of.steps[1], of.shape[2] // of.steps[1]
    padded = np.zeros((n_v, before + -(-together // _READ_ON) * _READ_ON), image.dtype)
    padded[:, before : before + n_u] = image * of.after
    return padded[:, before:]


def _by_place(cells: Array, of: DepthResponse) -> Array:
    """`cells` (…, rows, columns) as (…, rows, places in a pixel, pixels)."""
    return cells.reshape(*cells.shape[:-1], -1, of.steps[1]).swapaxes(-1, -2)


def _sorted_cells(of: DepthResponse, kind: Any) -> Array:
    """Room for cells as `_by_place` has them, in a row, with what kernels read beyond."""
    planes, rows, columns = of.shape
    shape = planes, rows, of.steps[1], columns // of.steps[1]
    room = np.empty(math.prod(shape) + _READ_ON, kind)
    room[-_READ_ON:] = 0
    return room[:-_READ_ON].reshape(shape)


def _run_voxels(
    kernel: Any,
    of: DepthResponse,
    cells: Array,
    volume: Array,
    passes: Array | None,
    slab: slice = slice(None),
    gradient: Floats | None = None,
) -> None:
    """Run a kernel between the voxels and the cells of one view."""
    if passes is not None and (passes.shape != volume.shape or passes.dtype != cells.dtype):
        raise ValueError(f"expected passes of the volume's shape and type, got {passes.shape}, {passes.dtype}")
    first, last, _ = slab.indices(len(volume))
    shifts, line = np.ascontiguousarray(of.pieces @ of.matrix[:, :3].T), of.matrix[:, :3] @ of.line
    job = DepthJob(
        is_double=cells.dtype == np.float64, volume=as_lattice(volume, cells, kernel is library.cells_to_voxels),
        first=first, last=last, matrix=tuple(of.matrix.ravel().tolist()), line=tuple(line.tolist()),
        shifts=shifts.ctypes.data, pieces=len(shifts), of_point=of.of_point, of_pair=of.of_pair,
        parts_per_cell=of.parts_per_cell, nearest=of.nearest, farthest=of.farthest, first_plane=of.first_plane,
        planes_per_inverse=of.planes_per_inverse, passes=None if passes is None else passes.ctypes.data,
        cells=cells.ctypes.data, planes=of.shape[0], rows=of.shape[1], columns=of.shape[2], step=of.steps,
        gradient=None if gradient is None else gradient.ctypes.data,
    )  # fmt: skip
    kernel(level, job)


def _run_pixels(
    kernel: Any, of: DepthResponse, sorted_cells: Array, image: Array, gradient: Floats | None = None
) -> None:
    """Run a kernel between the sorted cells and the pixels of one view."""
    taps = np.ascontiguousarray(of.padded, image.dtype)
    if taps.shape[-1] * of.steps[0] < _READ_ON:
        taps = np.append(taps, np.zeros(_READ_ON, image.dtype))[: taps.size].reshape(taps.shape)
    nodes: dict[str, Any] = {}
    if of.places is not None:
        rows, columns = (np.ascontiguousarray(each) for each in of.places)
        of_pixels = of.after.shape[1] + 2 * _READ_ON
        room = np.zeros(_NODE_ROWS * (_GIVEN_ROWS * taps.shape[-1] + of_pixels) + 2 * _READ_ON, image.dtype)
        columns_of = np.arange(taps.shape[-1]) % of.steps[1] * (of.shape[2] // of.steps[1])
        columns_of += np.arange(taps.shape[-1]) // of.steps[1]
        nodes = {"nodes": taps.shape[1:3], "node_rows": rows.ctypes.data, "node_columns": columns.ctypes.data,
                 "room": room.ctypes.data, "columns_of": columns_of.ctypes.data}  # fmt: skip
    job = DepthJob(
        is_double=image.dtype == np.float64,
        cells=sorted_cells.ctypes.data, planes=of.shape[0], rows=of.shape[1], columns=of.shape[2],
        kernel=taps.ctypes.data, bounds=of.bounds.ctypes.data, taps=of.kernel.shape[-2:], step=of.steps,
        image=image.ctypes.data, row=image.strides[0] // image.itemsize, pixels=of.after.shape,
        gradient=None if gradient is None else gradient.ctypes.data, **nodes,
    )  # fmt: skip
    kernel(level, job)
