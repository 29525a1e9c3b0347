"""Volumes in the coordinates of views and back, and from one view's to another's."""

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
from ..rays.bundles import Beam, Bundle, Bundles
from ..rays.execution import Execution
from ..rays.linear_operator import LinearOperator
from ..rays.parallel import thread_count
from ..rays.ray_geometry import Fan
from ..validation import instance, one_of
from ..volumes.volume import UNITS, Volume, require_quantity
from .perspective_grid import PerspectiveGrid
from .places import gather, scatter

KEEP = ("density", "activity")
"""What resampling may keep: the values, or their sums."""

_PER_CELL = 2  # points of one lattice along a cell of the other: what is shared out then varies by 3 % at most
_MOST_POINTS = 8  # in a cell, along each axis
_APART = 1.0  # cells from point to point: farther apart, cells between them get little or nothing
_LOOKED_AT = 9  # cells along each axis, to find how many points one needs

_GAP = 1.5  # voxels from ray to ray

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
    """A volume in the coordinates of a view.

    Parameters
    ----------
    volume : Volume, or array or tensor (…, n_x, n_y, n_z)
        An array or tensor lies on `grid`, and may be a batch.
    g : PerspectiveGrid
    keep : str
        "density": the mean of the volume along a pixel's ray, from the plane before a cell to the one behind. Voxels are
        filled evenly, as everywhere, and 0 outside the grid: ``g.image`` of it is the projector's image. "activity":
        what lies in each cell, value x mm^3 (of kBq/mL that is Bq): every voxel's value times its volume, shared out
        among the cells around it; what lies outside `g` is left out, and nothing is lost otherwise.
    progress
        Called as ``progress(done, total)`` between parts; what it raises stops the work.

    Returns
    -------
    array or tensor (…, n_u, n_v, n_k)
        Float32, or float64 of a tensor of float64; a tensor is part of torch's graph.

    Raises
    ------
    InputError
        CT numbers, or more memory needed than there is.

    Warns
    -----
    InputWarning
        "activity": voxels cover so many cells that single cells get too much or too little.

    Notes
    -----
    "density" follows each ray exactly (Siddon 1985). Voxels are shared out among cells at several points each, evenly
    spaced: two along each axis for every cell that one covers, up to 8. So the cells of an even volume differ by up to 3 %
    along each axis where a voxel covers up to 4 cells, and by up to 10 % where it covers 8.

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
        grid, volume = volume.grid, volume.array
    if grid is None:
        how = "to_perspective(array, g, grid=...)"
        raise InputError(f"to_perspective: expected a Volume, or the grid of the array: {how}")
    instance(grid, Grid, "to_perspective")
    if keep == "density":
        return _AlongRays(grid, g)(volume, progress)
    operator = _Taking(g, grid)
    _warn_of_few_points(operator, "to_perspective: voxels")
    return operator.T(volume, progress) * grid.voxel_volume


def from_perspective(
    array: ArrayOrTensor, g: PerspectiveGrid, grid: Grid, keep: str = "density", *, progress: Progress | None = None
) -> ArrayOrTensor:
    """What is given in the coordinates of a view, on a grid of voxels.

    Parameters
    ----------
    array : array or tensor (…, n_u, n_v, n_k)
    g : PerspectiveGrid
        The array's.
    grid : Grid
    keep : str
        "density": the mean over each voxel of the array's values, interpolated linearly between cells' places; 0 outside
        `g`.
        "activity": the array holds what lies in each cell, value x mm^3, as ``to_perspective(…, "activity")`` makes it. It
        is spread evenly along the cell's ray over the voxels that this crosses, and divided by their volume. What lies
        outside `grid` is left out.
    progress
        The same as in `to_perspective`.

    Returns
    -------
    array or tensor (…, n_x, n_y, n_z)
        Values, such as kBq/mL, in both cases; of the kind of `to_perspective`.

    Warns
    -----
    InputWarning
        "activity": rays are so far apart that voxels between them get nothing.
    """
    one_of(keep, KEEP, "keep")
    instance(g, PerspectiveGrid, "from_perspective")
    instance(grid, Grid, "from_perspective")
    if keep == "density":
        return _Taking(g, grid)(array, progress)
    _warn_of_gaps(g, grid)
    return _AlongRays(grid, g).T(array, progress) / grid.voxel_volume


def camera_to_camera(
    array: ArrayOrTensor,
    g_m: PerspectiveGrid,
    g_n: PerspectiveGrid,
    keep: str = "density",
    *,
    progress: Progress | None = None,
) -> ArrayOrTensor:
    """What is given in the coordinates of one view, in those of another.

    Parameters
    ----------
    array : array or tensor (…, n_u, n_v, n_k)
    g_m, g_n : PerspectiveGrid
        The array's, and the result's.
    keep : str
        "density": the mean over each cell of the values, interpolated linearly. "activity": what lies in each cell is
        shared out among the cells around it; it is the adjoint of "density" the other way, from `g_n` to `g_m`.
    progress
        The same as in `to_perspective`.

    Returns
    -------
    array or tensor (…, n_u, n_v, n_k)
        Of the kind that `to_perspective` returns.

    Warns
    -----
    InputWarning
        "activity": cells of `g_m` cover so many of `g_n` that single ones get too much or too little.
    """
    one_of(keep, KEEP, "keep")
    instance(g_m, PerspectiveGrid, "camera_to_camera")
    instance(g_n, PerspectiveGrid, "camera_to_camera")
    if keep == "density":
        return _Taking(g_m, g_n)(array, progress)
    operator = _Taking(g_n, g_m)
    _warn_of_few_points(operator, "camera_to_camera: cells of the array")
    return operator.T(array, progress)


class _Pair(LinearOperator):
    """A linear map from arrays of one lattice to arrays of another, which its subclasses compute, and the adjoint."""

    def __init__(self, source: Lattice, target: Lattice) -> None:
        self.source, self.target = source, target

    @property
    def shape_in(self) -> tuple[int, int, int]:
        return self.source.shape

    @property
    def shape_out(self) -> tuple[int, int, int]:
        return self.target.shape

    def _run_one(self, x: ArrayOrTensor, progress: Progress | None = None, mu: Any = None) -> ArrayOrTensor:
        return _run(self.forward, x, self.shape_out, progress)

    def _run_back(self, y: ArrayOrTensor, progress: Progress | None = None, mu: Any = None) -> ArrayOrTensor:
        return _run(self.adjoint, y, self.shape_in, progress)

    @abstractmethod
    def forward(self, x: Array, progress: Progress | None) -> Array:
        """The map of an array of float32 or float64."""

    @abstractmethod
    def adjoint(self, y: Array, progress: Progress | None) -> Array:
        """The adjoint of an array of float32 or float64."""


def _run(function: _Map, x: ArrayOrTensor, shape: tuple[int, int, int], progress: Progress | None) -> ArrayOrTensor:
    """What a function makes of an array, of this shape, as the caller's kind; there must be memory for it."""
    array = to_numpy(x, np.float64 if is_double(x) or x.dtype == np.float64 else np.float32)
    require(2 * array.itemsize * float(np.prod(shape)), "resampling to {} x {} x {} numbers".format(*shape))
    return to_caller(function(array, progress).astype(array.dtype, copy=False), x)


class _AlongRays(_Pair):
    """Means of a volume along the rays of a perspective grid's cells: those of a plane are the rays of an image."""

    source: Grid
    target: PerspectiveGrid

    def forward(self, x: Array, progress: Progress | None) -> Array:
        n, result = self.target.n_k, np.empty(self.shape_out, x.dtype)
        for plane, image in enumerate(self._execution(x).images(x, Bundles(n, self._bundle))):
            result[..., plane] = image
            tell(progress, plane + 1, n)
        result /= self.target.ray_lengths()
        return result

    def adjoint(self, y: Array, progress: Progress | None) -> Array:
        n = self.target.n_k
        images = np.moveaxis(y / self.target.ray_lengths().astype(y.dtype), -1, 0)
        bundles = Bundles(n, self._bundle)
        return np.asarray(self._execution(y).backproject(images, bundles, None, lambda done: tell(progress, done, n)))

    def _execution(self, array: Array) -> Execution:
        backend = backends.choose("auto")
        float64 = backend.always_float64 or array.dtype == np.float64
        return Execution(backend, self.source, None, float64, thread_count(None))

    def _bundle(self, plane: int) -> Bundle:
        """The cells' rays of a plane: from the plane before to the one behind, columns after columns."""
        edges = self.target.edges[plane : plane + 2]
        places = np.array([[[0, 0, edge], [1, 0, edge], [0, 1, edge]] for edge in edges], np.float64)
        (start, next_start, _), (end, next_end, above) = self.target.to_world(places)
        follows = float(np.linalg.norm(next_start - start) / np.linalg.norm(next_end - end))
        fan = Fan(start, end, next_end - end, above - end, self.shape_out[:2], parallel=follows)
        return Bundle.along(self.source, Beam(fan))


class _Taking(_Pair):
    """Means over the cells of one lattice of another's values, interpolated linearly."""

    def __init__(self, source: Lattice, target: Lattice) -> None:
        super().__init__(source, target)
        from_world = source.index_matrix if isinstance(source, PerspectiveGrid) else _with_ones(source.index_from_world)
        self._matrix = from_world @ (target.affine if isinstance(target, Grid) else target.inverse)
        steps = _cells_covered(self._matrix, source, target)
        self._points = np.clip(np.ceil(_PER_CELL * steps - 0.1), 1, _MOST_POINTS).astype(int)
        self.apart = float((steps / self._points).max())  # from point to point, in the source's cells, at most

    def forward(self, x: Array, progress: Progress | None) -> Array:
        result = np.zeros(self.shape_out, x.dtype)
        for n, (matrix, planes) in enumerate(self._shifted()):
            part = part_of(progress, n, int(self._points.prod()))
            gather(result, planes, x[None], matrix[None], progress=part)
        return np.asarray(result / self._points.prod(dtype=x.dtype))

    def adjoint(self, y: Array, progress: Progress | None) -> Array:
        result = np.zeros(self.shape_in, y.dtype)
        y = np.asarray(y / self._points.prod(dtype=y.dtype))
        for n, (matrix, planes) in enumerate(self._shifted()):
            scatter(y, planes, result, matrix, part_of(progress, n, int(self._points.prod())))
        return result

    def _shifted(self) -> Iterator[tuple[Floats, Floats]]:
        """For each of a cell's points, the matrix and the third coordinates of that point in all cells."""
        fractions = [(np.arange(n) + 0.5) / n - 0.5 for n in self._points]
        for i in fractions[0]:
            for j in fractions[1]:
                matrix = self._matrix.copy()
                matrix[:, 3] += i * matrix[:, 0] + j * matrix[:, 1]
                for k in fractions[2]:
                    yield matrix, _planes_at(self.target, np.arange(self.target.shape[2]) + k)


def _with_ones(matrix: Floats) -> Floats:
    """Rows (5, 4), as `places.gather` needs them, of an affine one (4, 4)."""
    return np.insert(matrix, 4, [0.0, 0.0, 0.0, 1.0], axis=0)


def _planes_at(lattice: Lattice, index: Floats) -> Floats:
    """The third coordinate, as of places, at (fractional) indices of the third axis."""
    return index if isinstance(lattice, Grid) else lattice.planes_at(index)


def _cells_covered(matrix: Floats, source: Lattice, target: Lattice) -> Floats:
    """How many of the source's cells one of the target's covers along each of its axes (3,), at most."""
    index = _some_cells(target)
    here = _places(matrix, target, index)
    index = index[((here >= -0.5) & (here <= np.array(source.shape) - 0.5)).all(axis=1)]
    return np.array([_longest_step(matrix, target, index, axis) for axis in range(3)])


def _warn_of_few_points(operator: _Taking, what: str) -> None:
    """Warn where what is shared out at a cell's points leaves some of the cells between them out."""
    if operator.apart > _APART:
        covered = f"cover up to {operator.apart * _MOST_POINTS:.2g} cells along an axis"
        kept = "the total is kept, but single cells get too much or too little"
        advice = f"give fewer pixels and planes, or finer {what.split()[1]}"
        warn(f"{what} {covered} and are shared out at {_MOST_POINTS} points: {kept}; {advice}")


def _warn_of_gaps(g: PerspectiveGrid, grid: Grid) -> None:
    """Warn where rays are so far apart that they leave voxels out."""
    apart = _cells_covered(_with_ones(grid.index_from_world) @ g.inverse, grid, g)[:2].max()
    if apart > _GAP:
        found = f"rays are up to {apart:.2g} voxels apart, and voxels between them get nothing"
        warn(f'from_perspective: {found}: give coarser voxels or finer pixels, or keep "density"')


def _some_cells(lattice: Lattice) -> Floats:
    """Indices (N, 3) of some cells, all corners among them."""
    axes = [np.unique(np.linspace(0, n - 1, min(n, _LOOKED_AT)).round()) for n in lattice.shape]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _places(matrix: Floats, target: Lattice, index: Floats) -> Floats:
    """Where cells (N, 3) of `target` lie in the other lattice, as indices (N, 3); NaN of what is not in front."""
    third = _planes_at(target, index[:, 2])
    p = np.column_stack([index[:, :2], third, np.ones(len(index))]) @ matrix.T
    front = (p[:, 3] > 0) & (p[:, 4] > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(front[:, None], p[:, :3] / p[:, [3, 3, 4]], np.nan)


def _longest_step(matrix: Floats, target: Lattice, index: Floats, axis: int) -> float:
    """How far apart neighbours along an axis are in the other lattice, in its cells, at most; 0 where nothing is known."""
    half = 0.5 * np.eye(3)[axis]
    before, after = (_places(matrix, target, index + step) for step in (-half, half))
    steps = np.abs(after - before).max(axis=1, initial=0.0)
    return float(steps[np.isfinite(steps)].max(initial=0.0))
