"""Resampling of volumes into the coordinates of views and back, and from one view's coordinates to another's."""

from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ..arrays import Array, ArrayOrTensor, Floats, is_double, to_caller, to_numpy
from ..errors import InputError, warn
from ..geometry.grid import Grid
from ..memory import require
from ..progress import Progress, part_of, tell
from ..rays import backends
from ..rays.bundles import Beam, Bundles, RayBundle
from ..rays.execution import Execution
from ..rays.linear_operator import LinearOperator
from ..rays.parallel import thread_count
from ..rays.ray_geometry import Fan
from ..validation import instance, one_of
from ..volumes.volume import UNITS, Volume, require_quantity
from .perspective_grid import PerspectiveGrid
from .places import gather, scatter

KEEP = ("density", "activity")
"""Quantity that resampling preserves: the values (density), or their integrals over cells (activity)."""

_POINTS_PER_CELL = 2  # points of one lattice along a cell of the other: shared-out values then vary by 3 % at most
_MAX_POINTS = 8  # points in a cell along each axis
_MAX_POINT_DISTANCE = 1.0  # cells from point to point: cells between points farther apart get little or nothing
_CELLS_TESTED = 9  # cells along each axis at which the number of points that a cell needs is determined

_MAX_RAY_DISTANCE = 1.5  # voxels from ray to ray: voxels between rays farther apart get nothing

Lattice = Grid | PerspectiveGrid
_Map = Callable[[Array, Progress | None], Array]


def to_perspective(
    volume: Volume | ArrayOrTensor,
    g: PerspectiveGrid,
    keep: str = "density",
    *,
    grid: Grid | None = None,
    progress: Progress | None = None,
) -> ArrayOrTensor:
    """Resample a volume to the coordinates of a view.

    Parameters
    ----------
    volume : Volume, or array or tensor (…, n_x, n_y, n_z)
        An array or tensor lies on `grid`, and may be a batch.
    g : PerspectiveGrid
        The view's cells.
    keep : str
        "density": the mean of the volume along a pixel's ray between the two planes that bound a cell. The volume is
        constant in each voxel, as in the projector, and 0 outside the grid, so ``g.image`` of the result is the projector's
        image. "activity": the content of each cell, value x mm^3 (from kBq/mL: Bq). Every voxel's value times its volume is
        shared out among the cells around it. Voxels outside `g` are left out; otherwise the total is preserved.
    grid : Grid
        The grid of an array or tensor; a `Volume` has its own.
    progress
        Called as ``progress(done, total)`` between parts; an exception raised there stops the work.

    Returns
    -------
    array or tensor (…, n_u, n_v, n_k)
        Float32, or float64 for a tensor of float64. A tensor is part of torch's graph.

    Raises
    ------
    InputError
        The volume holds CT numbers, or more memory is needed than there is.

    Warns
    -----
    InputWarning
        With "activity": voxels cover so many cells that single cells get too much or too little.

    Notes
    -----
    "density" follows each ray exactly (Siddon 1985). For "activity", voxels are shared out among cells at several
    evenly spaced points each: two along each axis for every cell that a voxel covers, up to 8. Therefore the cells of a
    uniform volume differ by up to 3 % along each axis where a voxel covers up to 4 cells, and by up to 10 % where it covers
    8.

    `from_perspective` with the opposite `keep` is the adjoint: ``<to_perspective(x, g), y> = v <x, from_perspective(y, g,
    grid, "activity")>`` and ``<to_perspective(x, g, "activity"), y> = v <x, from_perspective(y, g, grid)>``, with v the
    volume of a voxel.
    """
    one_of(keep, KEEP, "keep")
    instance(g, PerspectiveGrid, "to_perspective")
    if isinstance(volume, Volume):
        require_quantity(volume.quantity, [name for name in UNITS if name != "hu"], "to_perspective")
        if grid is not None and grid != volume.grid:
            raise InputError("to_perspective: a volume has its own grid; leave `grid` out")
        grid, volume = volume.grid, volume.array
    if grid is None:
        call = "to_perspective(array, g, grid=...)"
        raise InputError(f"to_perspective: expected a Volume, or the grid of the array: {call}")
    instance(grid, Grid, "to_perspective")
    if keep == "density":
        return _RayMeans(grid, g)(volume, progress)
    operator = _CellMeans(g, grid)
    _warn_of_few_points(operator, "to_perspective: voxels")
    return operator.T(volume, progress) * grid.voxel_volume


def from_perspective(
    array: ArrayOrTensor, g: PerspectiveGrid, grid: Grid, keep: str = "density", *, progress: Progress | None = None
) -> ArrayOrTensor:
    """Resample an array on a view's cells to a grid of voxels.

    Parameters
    ----------
    array : array or tensor (…, n_u, n_v, n_k)
    g : PerspectiveGrid
        The cells of the array.
    grid : Grid
        The voxels of the result.
    keep : str
        "density": the mean over each voxel of the array's values, interpolated linearly between cells' places; 0 outside
        `g`. "activity": the array holds the content of each cell, value x mm^3, as ``to_perspective(…, "activity")`` returns
        it. A content is spread evenly along the cell's ray over the voxels that the ray crosses, and divided by their
        volume. Rays outside `grid` are left out.
    progress
        Called as ``progress(done, total)`` between parts; an exception raised there stops the work.

    Returns
    -------
    array or tensor (…, n_x, n_y, n_z)
        Values, such as kBq/mL, with either `keep`. Float32, or float64 for a tensor of float64. A tensor is part of torch's
        graph.

    Warns
    -----
    InputWarning
        With "activity": rays are so far apart that voxels between them get nothing.
    """
    one_of(keep, KEEP, "keep")
    instance(g, PerspectiveGrid, "from_perspective")
    instance(grid, Grid, "from_perspective")
    if keep == "density":
        return _CellMeans(g, grid)(array, progress)
    _warn_of_gaps(g, grid)
    return _RayMeans(grid, g).T(array, progress) / grid.voxel_volume


def camera_to_camera(
    array: ArrayOrTensor,
    g_m: PerspectiveGrid,
    g_n: PerspectiveGrid,
    keep: str = "density",
    *,
    progress: Progress | None = None,
) -> ArrayOrTensor:
    """Resample an array on one view's cells to another view's cells.

    Parameters
    ----------
    array : array or tensor (…, n_u, n_v, n_k)
    g_m, g_n : PerspectiveGrid
        The cells of the array, and those of the result.
    keep : str
        "density": the mean over each cell of the values, interpolated linearly. "activity": the content of each cell is
        shared out among the cells around it; this is the adjoint of "density" in the other direction, from `g_n` to `g_m`.
    progress
        Called as ``progress(done, total)`` between parts; an exception raised there stops the work.

    Returns
    -------
    array or tensor (…, n_u, n_v, n_k)
        Float32, or float64 for a tensor of float64. A tensor is part of torch's graph.

    Warns
    -----
    InputWarning
        With "activity": cells of `g_m` cover so many of `g_n` that single ones get too much or too little.
    """
    one_of(keep, KEEP, "keep")
    instance(g_m, PerspectiveGrid, "camera_to_camera")
    instance(g_n, PerspectiveGrid, "camera_to_camera")
    if keep == "density":
        return _CellMeans(g_m, g_n)(array, progress)
    operator = _CellMeans(g_n, g_m)
    _warn_of_few_points(operator, "camera_to_camera: cells of the array")
    return operator.T(array, progress)


class _LatticeMap(LinearOperator):
    """A linear map from arrays on one lattice to arrays on another, with its adjoint; subclasses compute both."""

    def __init__(self, source: Lattice, target: Lattice) -> None:
        self.source, self.target = source, target

    @property
    def shape_in(self) -> tuple[int, int, int]:
        """Shape of arrays on the source lattice."""
        return self.source.shape

    @property
    def shape_out(self) -> tuple[int, int, int]:
        """Shape of arrays on the target lattice."""
        return self.target.shape

    def _run_one(self, x: ArrayOrTensor, progress: Progress | None = None, mu: Any = None) -> ArrayOrTensor:
        """Apply the map to one array or tensor."""
        return _run(self.forward, x, self.shape_out, progress)

    def _run_back(self, y: ArrayOrTensor, progress: Progress | None = None, mu: Any = None) -> ArrayOrTensor:
        """Apply the adjoint to one array or tensor."""
        return _run(self.adjoint, y, self.shape_in, progress)

    @abstractmethod
    def forward(self, x: Array, progress: Progress | None) -> Array:
        """Return this map applied to `x` on the source lattice: an array on the target lattice.

        Both are of one type, float32 or float64.
        """

    @abstractmethod
    def adjoint(self, y: Array, progress: Progress | None) -> Array:
        """Return the adjoint of this map applied to `y` on the target lattice: an array on the source lattice.

        Both are of one type, float32 or float64.
        """


def _run(function: _Map, x: ArrayOrTensor, shape: tuple[int, int, int], progress: Progress | None) -> ArrayOrTensor:
    """Return ``function(x)``, an array of this `shape`, as the caller's kind of array or tensor.

    Raises `InputError` unless there is memory for it.
    """
    array = to_numpy(x, np.float64 if is_double(x) or x.dtype == np.float64 else np.float32)
    require(2 * array.itemsize * float(np.prod(shape)), "resampling to {} x {} x {} numbers".format(*shape))
    return to_caller(function(array, progress).astype(array.dtype, copy=False), x)


class _RayMeans(_LatticeMap):
    """Means of a volume along the rays of a perspective grid's cells; each plane's rays are those of one image."""

    source: Grid
    target: PerspectiveGrid

    def forward(self, x: Array, progress: Progress | None) -> Array:
        """Return the means (n_u, n_v, n_k) of a volume along the rays, computed plane by plane as images."""
        n, result = self.target.n_k, np.empty(self.shape_out, x.dtype)
        for plane, image in enumerate(self._execution(x).images(x, Bundles(n, self._bundle))):
            result[..., plane] = image
            tell(progress, plane + 1, n)
        result /= self.target.ray_lengths()
        return result

    def adjoint(self, y: Array, progress: Progress | None) -> Array:
        """Return the backprojection of the cells' values, divided by the rays' lengths in them."""
        n = self.target.n_k
        images = np.moveaxis(y / self.target.ray_lengths().astype(y.dtype), -1, 0)
        bundles = Bundles(n, self._bundle)
        return np.asarray(self._execution(y).backproject(images, bundles, None, lambda done: tell(progress, done, n)))

    def _execution(self, array: Array) -> Execution:
        """Return the projector's execution for arrays of this type."""
        backend = backends.choose("auto")
        float64 = backend.always_float64 or array.dtype == np.float64
        return Execution(backend, self.source, None, float64, thread_count(None))

    def _bundle(self, plane: int) -> RayBundle:
        """Return the rays of one plane's cells, from their front to their back plane, in the order of columns."""
        edges = self.target.edges[plane : plane + 2]
        corners = np.array([[[0, 0, k], [1, 0, k], [0, 1, k]] for k in edges], np.float64)
        (start, next_start, _), (end, next_end, row_end) = self.target.to_world(corners)
        spacing_ratio = float(np.linalg.norm(next_start - start) / np.linalg.norm(next_end - end))
        fan = Fan(start, end, next_end - end, row_end - end, self.shape_out[:2], parallel=spacing_ratio)
        return RayBundle.along(self.source, Beam(fan))


class _CellMeans(_LatticeMap):
    """Means, over the cells of one lattice, of values on another, interpolated linearly."""

    def __init__(self, source: Lattice, target: Lattice) -> None:
        super().__init__(source, target)
        from_world = source.index_matrix if isinstance(source, PerspectiveGrid) else _five_rows(source.index_from_world)
        self._matrix = from_world @ (target.affine if isinstance(target, Grid) else target.inverse)
        steps = _cells_covered(self._matrix, source, target)
        self._points = np.clip(np.ceil(_POINTS_PER_CELL * steps - 0.1), 1, _MAX_POINTS).astype(int)
        self.point_distance = float((steps / self._points).max())  # the greatest, in cells of the source

    def forward(self, x: Array, progress: Progress | None) -> Array:
        """Return the means over the target's cells, each from the source's values at several points."""
        result = np.zeros(self.shape_out, x.dtype)
        for n, (matrix, planes) in enumerate(self._point_lattices()):
            part_progress = part_of(progress, n, int(self._points.prod()))
            gather(result, planes, x[None], matrix[None], progress=part_progress)
        return np.asarray(result / self._points.prod(dtype=x.dtype))

    def adjoint(self, y: Array, progress: Progress | None) -> Array:
        """Return the target's values shared out among the source's cells around the same points."""
        result = np.zeros(self.shape_in, y.dtype)
        y = np.asarray(y / self._points.prod(dtype=y.dtype))
        for n, (matrix, planes) in enumerate(self._point_lattices()):
            scatter(y, planes, result, matrix, part_of(progress, n, int(self._points.prod())))
        return result

    def _point_lattices(self) -> Iterator[tuple[Floats, Floats]]:
        """Yield, for each point within a cell, the matrix (5, 4) and the third coordinates (n_z,) of all cells' points.

        The matrix leads to the source's array indices, as `places.gather` takes it.
        """
        fractions = [(np.arange(n) + 0.5) / n - 0.5 for n in self._points]
        for i in fractions[0]:
            for j in fractions[1]:
                matrix = self._matrix.copy()
                matrix[:, 3] += i * matrix[:, 0] + j * matrix[:, 1]
                for k in fractions[2]:
                    yield matrix, _planes_at(self.target, np.arange(self.target.shape[2]) + k)


def _five_rows(matrix: Floats) -> Floats:
    """Return an affine matrix (4, 4) in the form (5, 4) that `places.gather` takes, with divisors of 1."""
    return np.insert(matrix, 4, [0.0, 0.0, 0.0, 1.0], axis=0)


def _planes_at(lattice: Lattice, index: Floats) -> Floats:
    """Return the third coordinate, as `places.gather` takes it, at (fractional) indices of the third axis."""
    return index if isinstance(lattice, Grid) else lattice.planes_at(index)


def _cells_covered(matrix: Floats, source: Lattice, target: Lattice) -> Floats:
    """Return the largest number of the source's cells that a cell of the target covers along each of its axes, (3,)."""
    index = _sample_cells(target)
    position = _positions(matrix, target, index)
    index = index[((position >= -0.5) & (position <= np.array(source.shape) - 0.5)).all(axis=1)]
    return np.array([_longest_step(matrix, target, index, axis) for axis in range(3)])


def _warn_of_few_points(operator: _CellMeans, cells: str) -> None:
    """Warn if the points at which a cell is shared out are so far apart that cells between them are left out."""
    if operator.point_distance > _MAX_POINT_DISTANCE:
        extent = f"cover up to {operator.point_distance * _MAX_POINTS:.2g} cells along an axis"
        effect = "the total is kept, but single cells get too much or too little"
        advice = f"give fewer pixels and planes, or finer {cells.split()[1]}"
        warn(f"{cells} {extent} and are shared out at {_MAX_POINTS} points: {effect}; {advice}")


def _warn_of_gaps(g: PerspectiveGrid, grid: Grid) -> None:
    """Warn if rays are so far apart that voxels between them are left out."""
    distance = _cells_covered(_five_rows(grid.index_from_world) @ g.inverse, grid, g)[:2].max()
    if distance > _MAX_RAY_DISTANCE:
        gap = f"rays are up to {distance:.2g} voxels apart, and voxels between them get nothing"
        warn(f'from_perspective: {gap}: give coarser voxels or finer pixels, or keep "density"')


def _sample_cells(lattice: Lattice) -> Floats:
    """Return the indices (N, 3) of evenly spread cells, all corners among them."""
    axes = [np.unique(np.linspace(0, n - 1, min(n, _CELLS_TESTED)).round()) for n in lattice.shape]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _positions(matrix: Floats, target: Lattice, index: Floats) -> Floats:
    """Return the source's array indices (N, 3) of the target's cells `index` (N, 3); NaN for cells not in front."""
    p = np.column_stack([index[:, :2], _planes_at(target, index[:, 2]), np.ones(len(index))]) @ matrix.T
    front = (p[:, 3] > 0) & (p[:, 4] > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(front[:, None], p[:, :3] / p[:, [3, 3, 4]], np.nan)


def _longest_step(matrix: Floats, target: Lattice, index: Floats, axis: int) -> float:
    """Return the largest distance, in cells of the other lattice, between neighbours along an axis of the target.

    `index` (N, 3) are the cells that are tested; the result is 0 where none has a position.
    """
    half = 0.5 * np.eye(3)[axis]
    start, end = (_positions(matrix, target, index + step) for step in (-half, half))
    steps = np.abs(end - start).max(axis=1, initial=0.0)
    return float(steps[np.isfinite(steps)].max(initial=0.0))
