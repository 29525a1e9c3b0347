"""A hole's image depth by depth, written to be read: the reference, in numpy. The functions are those of `cpu`."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..depth_response import DepthResponse

Array = NDArray[Any]


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
    spectrum = np.fft.rfft2(cells * of.before) * np.fft.rfft2(of.kernel, of.shape[1:]).conj()
    return _inverse(spectrum.sum(axis=0), of)[_pixels(of)] * of.after


def pixels_to_cells(image: Array, of: DepthResponse) -> Array:
    """The adjoint of `cells_to_pixels`."""
    fine = np.zeros(of.shape[1:])
    fine[_pixels(of)] = image * of.after
    return _inverse(np.fft.rfft2(fine) * np.fft.rfft2(of.kernel, of.shape[1:]), of) * of.before


def _pixels(of: DepthResponse) -> tuple[slice, ...]:
    """Of the cells of a plane those from which on pixels sum."""
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
    for shift in of.parts @ of.matrix[:, :3].T:
        column, row, depth = voxels + shift[:, None, None]
        inverse = 1 / np.where(in_zone, depth, np.inf)
        column, row = column * inverse, row * inverse
        inside = (inverse > 0) & (column >= 1) & (column <= columns - 3) & (row >= 1) & (row <= rows - 2)
        column, row = np.where(inside, column, 1.0), np.where(inside, row, 1.0)
        weight = inside * inverse**2
        plane = np.clip((inverse - of.first_plane) * of.planes_per_inverse, 0, planes - 1)
        farther = np.minimum(plane.astype(int), planes - 2)
        middle_row, middle_column = (np.floor(place + 0.5).astype(int) for place in (row, column))
        for a, by_row in enumerate(_spline(row - middle_row), -1):
            for b, by_column in enumerate(_spline(column - middle_column), -1):
                for k, by_plane in enumerate((1 - (plane - farther), plane - farther)):
                    yield (farther + k, middle_row + a, middle_column + b), weight * by_row * by_column * by_plane


def _spline(offset: Array) -> tuple[Array, Array, Array]:
    """The quadratic B-spline's shares of the cell before, the nearest and the one after."""
    return (0.5 - offset) ** 2 / 2, 0.75 - offset**2, (0.5 + offset) ** 2 / 2
