"""Back-projections: what many views say of a place, each along its rays, as sum, geometric mean or minimum."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import ArrayLike, ArrayOrTensor, Floats, Floats32, checked, is_tensor, to_numpy
from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.views import VECTORS, Views
from ..memory import require
from ..progress import Progress, part_of
from ..validation import freeze, instance, one_of
from ..volumes.volume import Volume
from .perspective_grid import PerspectiveGrid
from .places import LEAST, PRODUCT, SUM, gather, shifted

HOW = {"sum": SUM, "product": PRODUCT, "minimum": LEAST}
"""In which ways a voxel's values in the views may be put together."""

_NEUTRAL = {SUM: 0.0, PRODUCT: 1.0, LEAST: np.inf}
_PARTS = 8  # of a volume, one after the other
_SAME = 1e-6  # mm: between places of the same view

Counts = NDArray[np.int32]
Taken = Iterable[tuple[Floats32, Floats]]
"""Arrays, with the matrices that `gather` takes for them."""
Depth = Callable[[int], tuple[PerspectiveGrid, ArrayOrTensor]] | Sequence[tuple[PerspectiveGrid, ArrayOrTensor]]
"""A depth distribution for each view: its perspective grid and an array (n_u, n_v, n_k) on it, or what gives them."""


def backproject(
    images: ArrayLike,
    views: Views,
    grid: Grid | PerspectiveGrid,
    how: str = "sum",
    depth: Depth | None = None,
    progress: Progress | None = None,
) -> Volume | Floats32:
    """What the views say of each voxel: the images' values at its place, summed, multiplied, or the least of them.

    It is no reconstruction: a value is that of whole rays, not of the voxel. The sum is large wherever many rays cross
    something; the product and the minimum, of values of at least 0, are small wherever one view sees nothing.

    Parameters
    ----------
    images : array (M, n_v, n_u)
        Line integrals for instance, in any unit; for the product and the minimum they should be comparable from view to
        view, as those of `run_line_integrals` are.
    views : Views
        The images' views; also parallel ones.
    grid : Grid or PerspectiveGrid
        Voxels, or the cells of one view's coordinates, of these or other views.
    how : str
        "sum": of all views that see the voxel. "product": their geometric mean. "minimum": the least value of them.
        A view sees a voxel whose centre is in front of its source and within its image, up to the pixels' outer edges;
        values are interpolated linearly between the pixels' centres. What no view sees is 0.
    depth : callable or sequence, optional
        For each view the distribution of its pixels' values along their rays: a `PerspectiveGrid` of that view and an
        array (n_u, n_v, n_k) on it, as a sequence of such pairs or a function that is called with the views' indices,
        one after the other, so that not all arrays need be in memory. The view's value at a voxel is then that of pixel
        times distribution, interpolated linearly between the cells' places, and the view sees only what lies within its
        perspective grid. None: the same everywhere along the ray, as with 1 in every cell.
    progress
        Called as ``progress(done, total)`` between parts; what it raises stops the work.

    Returns
    -------
    Volume or array (n_u, n_v, n_k)
        A volume of "backprojection", in the images' unit (times that of the distributions); on a perspective grid, an array
        of float32.

    Raises
    ------
    InputError
        Negative values in a product, tensors that require a gradient, distributions that are negative or of other views, or
        more memory needed than there is.

    Notes
    -----
    Besides images and result, little memory is needed; with `depth`, one array of one view's cells, and for the product two
    of the result's size.

    For gradients, sum what `from_perspective` makes of each view's image times its distribution: it is the same sum, but
    for the cells' means.
    """
    instance(views, Views, "backproject: views")
    one_of(how, HOW, "how")
    to_world, planes = _placed(grid, "backproject: grid")
    kind = HOW[how]
    images = _plain(images, "backproject: images", (len(views), *views.shape))
    if kind == PRODUCT:
        _require_no_negative(images, "backproject: images", "product", ("view", "row", "column"))
    besides = 2 if kind == PRODUCT and depth is not None else 0
    require(4.0 * (1 + besides) * float(np.prod(grid.shape)), "a back-projection to {} x {} x {}".format(*grid.shape))
    points = np.empty(grid.shape, np.float32)
    taken: Taken
    if depth is None:
        matrices = _pixel_rows(views) @ to_world
        size = -(-len(points) // _PARTS)
        parts = range(0, len(points), size)  # so that what a product needs besides is small
        for number, first in enumerate(parts):
            taken, part = [(images[..., None], shifted(matrices, first))], part_of(progress, number, len(parts))
            _fill(points[first : first + size], kind, planes, taken, 1, part, flat=True)
    else:
        taken = (
            (np.multiply(images[m].T[None, ..., None], array, order="C"), (g.index_matrix @ to_world)[None])
            for m, (g, array) in enumerate(_distributions(depth, views))
        )
        _fill(points, kind, planes, taken, len(views), progress)
    return _finished(points, grid, "backprojection")


def views_that_see(views: Views, grid: Grid | PerspectiveGrid, progress: Progress | None = None) -> Volume | Floats32:
    """How many views see each voxel: its centre is in front of their source and within their image.

    Parameters
    ----------
    views : Views
    grid : Grid or PerspectiveGrid
        Voxels, or the cells of one view's coordinates, of these or other views.
    progress
        Called as ``progress(done, total)`` between parts; what it raises stops the work.

    Returns
    -------
    Volume or array (n_u, n_v, n_k)
        A volume of "modules"; on a perspective grid, an array of float32.

    Raises
    ------
    InputError
        More memory is needed than there is.
    """
    instance(views, Views, "views_that_see: views")
    to_world, planes = _placed(grid, "views_that_see: grid")
    require(8.0 * float(np.prod(grid.shape)), "numbers of views at {} x {} x {} places".format(*grid.shape))
    seen = np.zeros(grid.shape, np.int32)
    points, image = np.zeros(grid.shape, np.float32), np.zeros((1, *views.shape, 1), np.float32)
    for m, matrix in enumerate(_pixel_rows(views) @ to_world):
        part = part_of(progress, m, len(views))
        gather(points, planes, image, matrix[None], flat=True, seen=seen, progress=part)
    points[...] = seen
    return _finished(points, grid, "modules")


def _placed(grid: Grid | PerspectiveGrid, name: str) -> tuple[Floats, Floats]:
    """Where the points of a grid lie, as `gather` needs it: the matrix to the world, and the third coordinate of planes."""
    if not isinstance(grid, Grid | PerspectiveGrid):
        raise InputError(f"{name}: expected a Grid or a PerspectiveGrid, got {type(grid).__name__}")
    return (grid.affine, np.arange(float(grid.shape[2]))) if isinstance(grid, Grid) else (grid.inverse, grid.planes)


def _finished(points: Floats32, grid: Grid | PerspectiveGrid, quantity: str) -> Volume | Floats32:
    return Volume(freeze(points), grid, quantity) if isinstance(grid, Grid) else points


def _pixel_rows(views: Views) -> Floats:
    """Matrices (M, 5, 4) from world points to places in images (n_v, n_u, 1)."""
    column, row, factor = np.moveaxis(views.projection_matrices(), 1, 0)
    return np.stack([row, column, np.zeros_like(row), factor, factor], axis=1)


def _plain(values: Any, name: str, shape: tuple[int, ...]) -> Floats32:
    """`values`, an array or tensor without a gradient, as float32; not copied without need."""
    if is_tensor(values):
        if values.requires_grad:
            advice = "sum from_perspective(...) of each view, or detach() the tensor"
            raise InputError(f"{name}: a back-projection has no gradients; {advice}")
        values = to_numpy(values, None)
    return np.require(checked(values, name, shape, False), requirements=["C", "A"])


def _require_no_negative(values: Floats32, name: str, what: str, axes: tuple[str, ...]) -> None:
    if values.min(initial=0.0) < 0:
        index = np.unravel_index(int(values.argmin()), values.shape)
        place = ", ".join(f"{axis} {i}" for axis, i in zip(axes, index, strict=True))
        raise InputError(f"{name}: expected 0 or more for a {what}, got {values[index]:g} at {place}")


def _distributions(depth: Depth, views: Views) -> Iterator[tuple[PerspectiveGrid, Floats32]]:
    """Each view's perspective grid and distribution, checked."""
    if not callable(depth):
        if not isinstance(depth, Sequence):
            raise InputError(f"depth: expected a function or a list of pairs, got {type(depth).__name__}")
        if len(depth) != len(views):
            raise InputError(f"depth: expected a pair for each of {len(views)} views, got {len(depth)}")
    for m in range(len(views)):
        pair = depth(m) if callable(depth) else depth[m]
        if not (isinstance(pair, tuple | list) and len(pair) == 2 and isinstance(pair[0], PerspectiveGrid)):
            raise InputError(f"depth: view {m}: expected a pair of PerspectiveGrid and array (n_u, n_v, n_k)")
        g, distribution = pair
        if not _is_view(g, views, m):
            raise InputError(f"depth: view {m}: expected a perspective grid of this view, got one of another")
        array = _plain(distribution, f"depth: view {m}", g.shape)
        _require_no_negative(array, f"depth: view {m}", "distribution", ("column", "row", "plane"))
        yield g, array


def _is_view(g: PerspectiveGrid, views: Views, m: int) -> bool:
    """Whether `g` is of view m of `views`."""
    if g.views is views:
        return g.m == m
    if (g.views.shape, g.views.parallel) != (views.shape, views.parallel):
        return False
    return all(np.allclose(getattr(g.views, n)[g.m], getattr(views, n)[m], rtol=0, atol=_SAME) for n in VECTORS)


def _fill(
    points: Floats32, kind: int, planes: Floats, taken: Taken, n: int, progress: Progress | None, flat: bool = False
) -> None:
    """Combine what is taken, `n` times arrays with their matrices, into `points`."""
    points[...] = _NEUTRAL[kind]
    names = ("seen", "exponents") if kind == PRODUCT else ()
    counts: dict[str, Any] = {name: np.zeros(points.shape, np.int32) for name in names}
    for done, (arrays, matrices) in enumerate(taken):
        gather(points, planes, arrays, matrices, how=kind, flat=flat, progress=part_of(progress, done, n), **counts)
    if kind == LEAST:
        for plane in points:  # in little memory
            plane[np.isinf(plane)] = 0.0
    elif kind == PRODUCT:
        _take_roots(points, **counts)


def _take_roots(points: Floats32, seen: Counts, exponents: Counts) -> None:
    """Make products, times 2 to the `exponents`, geometric means of as many numbers as were `seen`; in place."""
    for plane, count, exponent in zip(points, seen, exponents, strict=True):  # in little memory
        with np.errstate(divide="ignore"):
            mean = (np.log2(plane, dtype=np.float64) + exponent) / np.maximum(count, 1)
        plane[...] = np.where(count > 0, np.exp2(mean), 0.0)
