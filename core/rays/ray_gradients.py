"""How line integrals move with the rays: gradients by fans and by ends, from a backend's derivatives.

An integral is length x mean. The mean moves with the planes of either grid, and, attenuated, with the length.
"""

import numpy as np

from ..arrays import Floats
from ..geometry.grid import Grid
from .bundles import Part
from .ray_geometry import Ends


def integrals(part: Part, derivatives: Floats) -> Floats:
    """Line integrals (rays,) of a part, value x mm."""
    return np.concatenate([length for _, length in _rays(part)]) * derivatives[0]


def by_geometry(part: Part, gradient: Floats, derivatives: Floats, *grids: Grid) -> list[tuple[int, Floats]]:
    """The gradient by the geometry of each image of a part, with the image's number.

    Parameters
    ----------
    part
        Rays without weights, one fan of each image.
    gradient
        By the images, (images, rows, columns).
    derivatives
        What the backend returned, (7 or 14, rays).
    grids
        The volume's and mu's.

    Returns
    -------
    list of (int, array)
        By source, corner, row step and column step of a fan, (4, 3); by starts and ends, (2, rays, 3).
    """
    by = _by_ends if isinstance(part.rays, Ends) else _by_fan
    each = zip(part.images, np.split(derivatives, len(part.images), axis=1), _rays(part), strict=True)
    linear = [grid.index_from_world[:3, :3] for grid in grids]
    return [
        (number, by(part, part.pixels(gradient[number]).reshape(-1), own, *rays, *linear))
        for (number, _), own, rays in each
    ]


def _by_ends(
    part: Part, values: Floats, derivatives: Floats, along: Floats, lengths: Floats, linear: Floats, of_mu: Floats
) -> Floats:
    """The gradient (2, n, 3) by start and end of the rays."""
    weights = values * lengths
    result = np.empty((2, len(values), 3))
    for end in range(2):
        result[end] = (weights * derivatives[1 + 3 * end : 4 + 3 * end]).T @ linear
        if len(derivatives) > 7:
            result[end] += (weights * derivatives[7 + 3 * end : 10 + 3 * end]).T @ of_mu
    by_length = (_by_length(values, lengths, derivatives) * along).T
    result[0] -= by_length
    result[1] += by_length
    return result


def _by_fan(
    part: Part, values: Floats, derivatives: Floats, along: Floats, lengths: Floats, linear: Floats, of_mu: Floats
) -> Floats:
    """The gradient (4, 3) by source, corner, row step and column step."""
    numbers = _numbers(part)
    # Sums over the rays first, times their numbers where a step moves their ends as often.
    # einsum, not `@`: BLAS would start threads of its own beside ours.
    by_planes = np.einsum("in,jn->ij", derivatives[1:13], values * lengths * numbers)
    by_start, by_end = by_planes[:3, 0] @ linear, by_planes[3:6].T @ linear
    if len(derivatives) > 7:
        by_start += by_planes[6:9, 0] @ of_mu
        by_end += by_planes[9:].T @ of_mu
    by_length = np.einsum("jn,in->ji", _by_length(values, lengths, derivatives) * numbers, along)
    result = np.concatenate([by_start[None] - by_length[:1], by_end + by_length])
    # The part's corner is that of its first row and column.
    result[2] += part.rows.start * result[1]
    result[3] += part.columns.start * result[1]
    return result[[0, 1, 3, 2]] if part.transposed else result


def _by_length(values: Floats, lengths: Floats, derivatives: Floats) -> Floats:
    """The gradient (n,) by the rays' lengths at constant ends on the lattices, divided by the lengths."""
    by_length = derivatives[0] if len(derivatives) == 7 else derivatives[0] + lengths * derivatives[13]
    return values * by_length / np.where(lengths > 0, lengths, 1.0)


def _rays(part: Part) -> list[tuple[Floats, Floats]]:
    """Source to target of the rays of every fan, (3, n), and their lengths (n,), world mm."""
    if isinstance(part.rays, Ends):
        each = (part.rays.ends - part.rays.starts).T[None]
    else:
        rows, columns = map(np.arange, part.shape)
        source, corner, row_step, column_step = part.rays.swapaxes(0, 1)[..., None, None]
        each = (corner - source + row_step * rows[:, None] + column_step * columns).reshape(len(source), 3, -1)
    return [(along, np.sqrt(np.einsum("in,in->n", along, along))) for along in each]


def _numbers(part: Part) -> Floats:
    """For each ray of a fan: 1, the row's number and the column's, (3, n), counted from the part's corner."""
    rows, columns = np.indices(part.shape, float).reshape(2, -1)
    return np.stack([np.ones_like(rows), rows, columns])
