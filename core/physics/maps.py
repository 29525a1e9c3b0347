"""Maps of a system's performance, as volumes. A voxel's value is that at its centre, and 0 if no module sees the centre."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ..arrays import Floats
from ..geometry.frames import moved
from ..geometry.grid import Grid
from ..geometry.system import PinholeSystem
from ..memory import require
from ..progress import Progress, in_threads
from ..validation import freeze, instance
from ..volumes.volume import Volume
from .optics import Optics, chosen_optics
from .performance import resolution, seen, sensitivity
from .sampling import TOLERANCE, sampling_gaps

# Product of points and modules in one block, small enough for the processor's cache.
_BLOCK = 1 << 17


def sensitivity_map(
    system: PinholeSystem,
    grid: Grid,
    *,
    optics: Optics | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> Volume:
    """Return a volume with the sum of the modules' `sensitivity`, counts per decay (times 1e6: cps/MBq).

    `optics` and `settings` are those of `sensitivity`. ``progress(done, total)`` is called between blocks of voxels and may
    raise `Cancelled`.
    """
    optics = chosen_optics(optics, settings)
    return _map(system, grid, "sensitivity", lambda points: sensitivity(system, points, optics=optics).sum(1), progress)


def modules_map(system: PinholeSystem, grid: Grid, *, progress: Progress | None = None) -> Volume:
    """Return a volume with the number of modules that see each voxel (see `seen`)."""
    return _map(system, grid, "modules", lambda points: seen(system, points).sum(axis=1, dtype=np.float64), progress)


def resolution_map(
    system: PinholeSystem,
    grid: Grid,
    *,
    optics: Optics | None = None,
    progress: Progress | None = None,
    **settings: Any,
) -> Volume:
    """Return a volume with the projections' resolution, FWHM in mm: the count-weighted RMS of the modules' `resolution`.

    The variance of all photons together is the mean of the modules' variances. A reconstruction that models the blur
    may do better, and one from few counts worse. The arguments are those of `sensitivity_map`.
    """
    optics = chosen_optics(optics, settings)

    def combined_fwhm(points: Floats) -> Floats:
        """Return the FWHM (N,), mm, of all modules' projections together at `points` (N, 3), world mm."""
        fwhm, counts = resolution(system, points, optics=optics), sensitivity(system, points, optics=optics)
        total = counts.sum(axis=1)
        return np.sqrt((counts * np.nan_to_num(fwhm) ** 2).sum(axis=1) / np.where(total > 0, total, 1))

    return _map(system, grid, "resolution", combined_fwhm, progress)


def completeness_map(
    system: PinholeSystem, grid: Grid, *, tolerance: float = TOLERANCE, progress: Progress | None = None
) -> Volume:
    """Return a volume with the completeness of the angular sampling: 1 - gap / 90 degrees, from 0 to 1 (`sampling_gaps`).

    It is 1 if every plane through the voxel meets a pinhole that sees it (Tuy's condition), and 0 if at most one module sees
    the voxel. `tolerance` is the accuracy of the gap, rad.
    """

    def completeness(points: Floats) -> Floats:
        """Return the completeness (N,) at `points` (N, 3), world mm."""
        return 1 - sampling_gaps(system, points, tolerance=tolerance) / (math.pi / 2)

    return _map(system, grid, "completeness", completeness, progress)


def within_roi(volume: Volume, system: PinholeSystem) -> Volume:
    """Return a copy of a map with 0 in all voxels whose centres lie outside the largest ROI sphere."""
    squares = np.zeros(volume.grid.shape)
    axes = np.ogrid[tuple(slice(n) for n in volume.grid.shape)]
    for row in volume.grid.affine[:3]:
        squares += (sum(a * x for a, x in zip(row[:3], axes, strict=True)) + row[3]) ** 2
    inside = squares <= system.roi_radius.max() ** 2
    return Volume(freeze(np.where(inside, volume.array, np.float32(0))), volume.grid, volume.quantity)


def _map(
    system: PinholeSystem, grid: Grid, quantity: str, value: Callable[[Floats], Floats], progress: Progress | None
) -> Volume:
    """Return the volume with the values of the function `value` of points (P, 3), mm, computed block by block."""
    instance(system, PinholeSystem, "system")
    instance(grid, Grid, "grid")
    require(4.2 * grid.n_voxels, "a volume of {} x {} x {} voxels".format(*grid.shape))
    values = np.empty(grid.n_voxels, np.float32)
    size = max(1, _BLOCK // len(system))

    def fill(first: int) -> None:
        """Compute the map's values in the block of voxels that starts at index `first`."""
        voxels = np.arange(first, min(first + size, grid.n_voxels))
        index = np.stack(np.unravel_index(voxels, grid.shape), axis=1)
        values[voxels] = value(moved(grid.affine, index))

    in_threads(fill, range(0, grid.n_voxels, size), progress)
    return Volume(freeze(values.reshape(grid.shape)), grid, quantity)


MAPS: dict[str, Callable[..., Volume]] = {
    "sensitivity": sensitivity_map,
    "modules": modules_map,
    "resolution": resolution_map,
    "completeness": completeness_map,
}
"""Functions that make the maps, by the quantity of their volumes."""
