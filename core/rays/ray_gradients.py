"""Gradients of line integrals by the rays, by fans or by ends, from the derivatives that a backend returns.

An integral is length x mean. The mean changes with the planes of either grid, and, with attenuation, with the length.
"""

import numpy as np

from ..arrays import Floats
from ..geometry.grid import Grid
from .bundles import Batch
from .ray_geometry import Ends


def integrals(batch: Batch, derivatives: Floats) -> Floats:
    """Return the line integrals (rays,) of a batch, value x mm."""
    return np.concatenate([length for _, length in _fan_rays(batch)]) * derivatives[0]


def geometry_gradient(gradient: Floats, batch: Batch, derivatives: Floats, *grids: Grid) -> list[tuple[int, Floats]]:
    """Return the gradient by the geometry of each image of a batch, with the image's number.

    Parameters
    ----------
    gradient
        Gradient by the images, (images, rows, columns).
    batch
        Rays without weights, one fan of each image.
    derivatives
        Derivatives that the backend has returned, (7 or 14, rays).
    grids
        Grids of the volume and of mu.

    Returns
    -------
    list of (int, array)
        Gradients by source, corner, row step and column step of a fan, (4, 3), or by starts and ends, (2, rays, 3).
    """
    image_gradient = _ends_gradient if isinstance(batch.rays, Ends) else _fan_gradient
    images = zip(batch.images, np.split(derivatives, len(batch.images), axis=1), _fan_rays(batch), strict=True)
    matrices = [grid.index_from_world[:3, :3] for grid in grids]
    return [
        (number, image_gradient(batch, batch.pixels(gradient[number]).reshape(-1), rows, *rays, matrices))
        for (number, _), rows, rays in images
    ]


def _ends_gradient(
    batch: Batch, values: Floats, derivatives: Floats, vectors: Floats, lengths: Floats, matrices: list[Floats]
) -> Floats:
    """Return the gradient (2, n, 3) by start and end of the rays.

    `values` (n,) is the gradient by the integrals, `vectors` (3, n) and `lengths` (n,) are the rays', and `matrices` are
    index from world, (3, 3), of the volume and of mu.
    """
    weights = values * lengths
    result = np.empty((2, len(values), 3))
    for end in range(2):
        result[end] = (weights * derivatives[1 + 3 * end : 4 + 3 * end]).T @ matrices[0]
        if len(derivatives) > 7:
            result[end] += (weights * derivatives[7 + 3 * end : 10 + 3 * end]).T @ matrices[1]
    through_length = (_length_gradient(values, lengths, derivatives) * vectors).T
    result[0] -= through_length
    result[1] += through_length
    return result


def _fan_gradient(
    batch: Batch, values: Floats, derivatives: Floats, vectors: Floats, lengths: Floats, matrices: list[Floats]
) -> Floats:
    """Return the gradient (4, 3) by source, corner, row step and column step; arguments are those of `_ends_gradient`."""
    factors = _step_factors(batch)
    # The sums over the rays come first, with the number of steps by which a step moves a ray's end.
    # einsum, not `@`: BLAS would start threads of its own beside ours.
    sums = np.einsum("in,jn->ij", derivatives[1:13], values * lengths * factors)
    d_start, d_end = sums[:3, 0] @ matrices[0], sums[3:6].T @ matrices[0]
    if len(derivatives) > 7:
        d_start += sums[6:9, 0] @ matrices[1]
        d_end += sums[9:].T @ matrices[1]
    through_length = np.einsum("jn,in->ji", _length_gradient(values, lengths, derivatives) * factors, vectors)
    result = np.concatenate([d_start[None] - through_length[:1], d_end + through_length])
    # Steps are counted from the batch's corner, but are those from the fan's.
    result[2] += batch.rows.start * result[1]
    result[3] += batch.columns.start * result[1]
    return result[[0, 1, 3, 2]] if batch.transposed else result


def _length_gradient(values: Floats, lengths: Floats, derivatives: Floats) -> Floats:
    """Return the gradient (n,) by the rays' lengths at constant ends on the lattices, divided by the lengths."""
    d_length = derivatives[0] if len(derivatives) == 7 else derivatives[0] + lengths * derivatives[13]
    return values * d_length / np.where(lengths > 0, lengths, 1.0)


def _fan_rays(batch: Batch) -> list[tuple[Floats, Floats]]:
    """Return for every fan the vectors from source to target, (3, n), and the lengths (n,) of its rays, world mm."""
    if isinstance(batch.rays, Ends):
        fans = (batch.rays.ends - batch.rays.starts).T[None]
    else:
        rows, columns = map(np.arange, batch.shape)
        source, corner, row_step, column_step = batch.rays.swapaxes(0, 1)[..., None, None]
        fans = (corner - source + row_step * rows[:, None] + column_step * columns).reshape(len(source), 3, -1)
    return [(vectors, np.sqrt(np.einsum("in,in->n", vectors, vectors))) for vectors in fans]


def _step_factors(batch: Batch) -> Floats:
    """Return for each ray of a fan 1, the number of its row and that of its column, (3, n), from the batch's corner."""
    rows, columns = np.indices(batch.shape, float).reshape(2, -1)
    return np.stack([np.ones_like(rows), rows, columns])
