"""Volumes in the coordinates of views and back, and from one view's to another's."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import ArrayOrTensor, checked, to_caller, to_numpy
from ..errors import InputError
from ..geometry.grid import Grid
from ..memory import require
from ..progress import Progress
from ..projector.operator import LinearOperator
from ..validation import instance, one_of
from ..volumes.volume import UNITS, Volume, require_quantity
from .perspective_grid import PerspectiveGrid
from .places import give, take

KEEP = ("density", "activity")
"""What resampling may keep: the values, or their sums."""

_MOST_POINTS = 4  # in a cell, along each axis
_LOOKED_AT = 9  # cells along each axis, to find how many points one needs

Lattice = Grid | PerspectiveGrid


def to_perspective(
    volume: Volume | ArrayOrTensor, g: PerspectiveGrid, keep: str = "density", *, grid: Grid | None = None
) -> ArrayOrTensor:
    """A volume in the coordinates of a view.

    Parameters
    ----------
    volume : Volume, or array or tensor (…, n_x, n_y, n_z)
        Of an array or tensor, `grid` is the grid. It may be a batch.
    g : PerspectiveGrid
    keep : str
        "density": the volume's values where the cells are, interpolated linearly between voxels' centres; 0 outside the
        grid. "activity": what lies in each cell, value x mm^3 (of kBq/mL that is Bq): every voxel's value times its
        volume, shared out among the cells around it; what lies outside `g` is left out, and nothing is lost otherwise.

    Returns
    -------
    array or tensor (…, n_u, n_v, n_k)
        Float32, or float64 of a tensor of float64; a tensor is part of torch's graph.

    Raises
    ------
    InputError
        Another shape, values that are not finite, CT numbers, more memory needed than there is.

    Notes
    -----
    Cells are taken at their middle, voxels at their centre; where the other lattice is finer, at several points of each,
    evenly spaced, up to 4 along each axis.

    `from_perspective` with the other `keep` is the adjoint: ``<to_perspective(x, g), y> = v <x, from_perspective(y, g,
    grid, "activity")>`` and ``<to_perspective(x, g, "activity"), y> = v <x, from_perspective(y, g, grid)>``, with v the
    voxels' volume.
    """
    one_of(keep, KEEP, "keep")
    instance(g, PerspectiveGrid, "to_perspective")
    if isinstance(volume, Volume):
        require_quantity(volume.quantity, [name for name in UNITS if name != "hu"], "to_perspective")
        if grid is not None and grid != volume.grid:
            raise InputError("to_perspective: a volume has its own grid; leave `grid` out")
        volume, grid = volume.array, volume.grid
    if grid is None:
        raise InputError("to_perspective: expected a Volume, or the grid of the array: to_perspective(array, g, grid=...)")
    instance(grid, Grid, "to_perspective")
    if keep == "density":
        return _Taking(grid, g)(volume)
    return _Taking(g, grid).T(volume) * grid.voxel_volume


def from_perspective(array: ArrayOrTensor, g: PerspectiveGrid, grid: Grid, keep: str = "density") -> ArrayOrTensor:
    """What is given in the coordinates of a view, on a grid of voxels.

    Parameters
    ----------
    array : array or tensor (…, n_u, n_v, n_k)
    g : PerspectiveGrid
        Of `array`.
    grid : Grid
    keep : str
        "density": the array's values at the voxels, interpolated linearly between cells' places; 0 outside `g`. "activity":
        the array holds what lies in each cell, value x mm^3, as of ``to_perspective(…, "activity")``. It is shared out
        among the voxels around, and divided by their volume. What lies outside `grid` is left out.

    Returns
    -------
    array or tensor (…, n_x, n_y, n_z)
        Values, such as kBq/mL, in both cases; of the kind of `to_perspective`.

    Raises
    ------
    InputError
        As of `to_perspective`.
    """
    one_of(keep, KEEP, "keep")
    instance(g, PerspectiveGrid, "from_perspective")
    instance(grid, Grid, "from_perspective")
    if keep == "density":
        return _Taking(g, grid)(array)
    return _Taking(grid, g).T(array) / grid.voxel_volume


def camera_to_camera(
    array: ArrayOrTensor, g_m: PerspectiveGrid, g_n: PerspectiveGrid, keep: str = "density"
) -> ArrayOrTensor:
    """What is given in the coordinates of one view, in those of another.

    Parameters
    ----------
    array : array or tensor (…, n_u, n_v, n_k)
    g_m, g_n : PerspectiveGrid
        Of `array`, and of the result.
    keep : str
        "density": values are interpolated. "activity": what lies in each cell is shared out among the cells around it; it is
        the adjoint of "density" the other way, from `g_n` to `g_m`.

    Returns
    -------
    array or tensor (…, n_u, n_v, n_k)
        Of the kind of `to_perspective`.

    Raises
    ------
    InputError
        As of `to_perspective`.
    """
    one_of(keep, KEEP, "keep")
    instance(g_m, PerspectiveGrid, "camera_to_camera")
    instance(g_n, PerspectiveGrid, "camera_to_camera")
    return _Taking(g_m, g_n)(array) if keep == "density" else _Taking(g_n, g_m).T(array)


class _Taking(LinearOperator):
    """Values of an array on one lattice at the places of another, interpolated linearly."""

    def __init__(self, source: Lattice, target: Lattice) -> None:
        self._source, self._target = source, target
        from_world = _index_matrix(source)
        to_world = target.affine if isinstance(target, Grid) else target.inverse
        self._matrix = from_world @ to_world
        self._points = _points_in_cells(self._matrix, source, target)

    @property
    def T(self) -> "_Giving":
        return _Giving(self)

    @property
    def shape_in(self) -> tuple[int, int, int]:
        return self._source.shape

    @property
    def shape_out(self) -> tuple[int, int, int]:
        return self._target.shape

    def _check(self, x: Any) -> ArrayOrTensor:
        return checked(x, "array", self.shape_in, False, batch=True)

    def _run_one(self, x: ArrayOrTensor, progress: Progress | None = None, mu: Any = None) -> ArrayOrTensor:
        result = self._room(x, self.shape_out)
        for matrix, thirds in self._shifted():
            take(result, thirds, to_numpy(x, result.dtype)[None], matrix[None], progress=progress)
        return to_caller(result / self._points.prod(dtype=result.dtype), x)

    def give(self, y: ArrayOrTensor) -> ArrayOrTensor:
        """The adjoint."""
        result = self._room(y, self.shape_in)
        given = to_numpy(y, result.dtype) / self._points.prod(dtype=result.dtype)
        for matrix, thirds in self._shifted():
            give(given, thirds, result, matrix)
        return to_caller(result, y)

    def _room(self, like: ArrayOrTensor, shape: tuple[int, int, int]) -> NDArray[Any]:
        kind = np.float64 if str(like.dtype).endswith("float64") else np.float32
        require(2 * np.dtype(kind).itemsize * np.prod(shape, dtype=float), "resampling to {} x {} x {}".format(*shape))
        return np.zeros(shape, kind)

    def _shifted(self) -> Any:
        """For each of a cell's points, the matrix and the third coordinates of that point in all cells."""
        fractions = [(np.arange(n) + 0.5) / n - 0.5 for n in self._points]
        for i in fractions[0]:
            for j in fractions[1]:
                matrix = self._matrix.copy()
                matrix[:, 3] += i * matrix[:, 0] + j * matrix[:, 1]
                for k in fractions[2]:
                    yield matrix, _thirds(self._target, np.arange(self._target.shape[2]) + k)


class _Giving(LinearOperator):
    """The adjoint of `_Taking`."""

    def __init__(self, taking: _Taking) -> None:
        self._taking = taking

    @property
    def T(self) -> _Taking:
        return self._taking

    @property
    def shape_in(self) -> tuple[int, int, int]:
        return self._taking.shape_out

    @property
    def shape_out(self) -> tuple[int, int, int]:
        return self._taking.shape_in

    def _check(self, x: Any) -> ArrayOrTensor:
        return checked(x, "array", self.shape_in, False, batch=True)

    def _run_one(self, x: ArrayOrTensor, progress: Progress | None = None, mu: Any = None) -> ArrayOrTensor:
        return self._taking.give(x)


def _index_matrix(lattice: Lattice) -> NDArray[np.float64]:
    """(5, 4): from world points to indices, as `places.take` needs it."""
    if isinstance(lattice, PerspectiveGrid):
        return lattice.index_matrix
    return np.insert(lattice.index_from_world, 4, [0.0, 0.0, 0.0, 1.0], axis=0)


def _thirds(lattice: Lattice, index: NDArray[np.float64]) -> NDArray[np.float64]:
    """The third coordinate, as of places, at (fractional) indices of the third axis."""
    return index if isinstance(lattice, Grid) else lattice.third_at(index)


def _points_in_cells(matrix: NDArray[np.float64], source: Lattice, target: Lattice) -> NDArray[np.int64]:
    """Points (3,) along each axis of the target's cells, so that about none of the source's cells is stepped over."""
    axes = [np.unique(np.linspace(0, n - 1, min(n, _LOOKED_AT)).round()) for n in target.shape]
    index = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)

    def places(index: NDArray[np.float64]) -> NDArray[np.float64]:
        third = _thirds(target, index[:, 2])
        p = np.stack([*index[:, :2].T, third, np.ones(len(index))]).T @ matrix.T
        front = (p[:, 3] > 0) & (p[:, 4] > 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            found = p[:, :3] / p[:, [3, 3, 4]]
        return np.where(front[:, None], found, np.nan)

    here = places(index)
    inside = ((here >= -0.5) & (here <= np.array(source.shape) - 0.5)).all(axis=1)
    counts = np.ones(3, np.int64)
    for axis in range(3):
        half = np.zeros(3)
        half[axis] = 0.5
        steps = np.abs(places(index[inside] + half) - places(index[inside] - half)).max(axis=1, initial=0.0)
        steps = steps[np.isfinite(steps)]
        counts[axis] = np.clip(np.round(steps.max(initial=1.0)), 1, _MOST_POINTS)
    return counts
