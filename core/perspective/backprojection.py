"""Back-projection: the values of all views along their rays, combined in each voxel as sum, geometric mean or minimum."""

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
"""Ways of combining a voxel's values in the views, by the name that the argument `how` takes."""

_NEUTRAL = {SUM: 0.0, PRODUCT: 1.0, LEAST: np.inf}
_PARTS = 8  # parts of a volume that are computed one after the other
_SAME = 1e-6  # mm: difference up to which two views are the same

Counts = NDArray[np.int32]
Inputs = Iterable[tuple[Floats32, Floats]]
"""Arrays, each batch with the matrices that `gather` takes for it."""
Depth = Callable[[int], tuple[PerspectiveGrid, ArrayOrTensor]] | Sequence[tuple[PerspectiveGrid, ArrayOrTensor]]
"""A depth distribution per view: pairs of perspective grid and array (n_u, n_v, n_k), or a function of the view's index."""


def backproject(
    images: ArrayLike,
    views: Views,
    grid: Grid | PerspectiveGrid,
    how: str = "sum",
    depth: Depth | None = None,
    progress: Progress | None = None,
) -> Volume | Floats32:
    """Combine, at each voxel, the images' values at its place: their sum, geometric mean or minimum.

    It is no reconstruction: each value belongs to a whole ray, not to the voxel. The sum is large wherever many rays cross
    something; the product and the minimum, of values of at least 0, are small wherever one view sees nothing.

    Parameters
    ----------
    images : array (M, n_v, n_u)
        For instance line integrals, in any unit. For the product and the minimum they should be comparable from view to
        view, as those of `run_line_integrals` are.
    views : Views
        The images' views; they may be parallel.
    grid : Grid or PerspectiveGrid
        Voxels, or the cells of one view's coordinates, of these or other views.
    how : str
        "sum": the sum over all views that see the voxel. "product": their geometric mean. "minimum": their least value.
        A view sees a voxel whose centre is in front of its source and within its image, up to the pixels' outer edges;
        values are interpolated linearly between the pixels' centres. A voxel that no view sees is 0.
    depth : callable or sequence, optional
        For each view the distribution of its pixels' values along their rays: a `PerspectiveGrid` of that view and an
        array (n_u, n_v, n_k) on it. Either a sequence of such pairs, or a function that is called with the views' indices,
        one after the other, so that not all arrays need be in memory. The view's value at a voxel is then pixel times
        distribution, interpolated linearly between the cells' places, and the view sees only voxels within its
        perspective grid. None: the same value everywhere along the ray, as with 1 in every cell.
    progress
        Called as ``progress(done, total)`` between parts; an exception raised there stops the work.

    Returns
    -------
    Volume or array (n_u, n_v, n_k)
        A volume of "backprojection", in the images' unit (times that of the distributions); on a perspective grid, an array
        of float32.

    Raises
    ------
    InputError
        There are negative values in a product, tensors that require a gradient, distributions that are negative or belong to
        other views, or more memory is needed than there is.

    Notes
    -----
    Besides images and result, little memory is needed: with `depth` an array of one view's cells, and for the product two
    arrays of the result's size.

    For gradients, sum `from_perspective` of each view's image times its distribution: this is the same sum, except that
    values are means over the voxels.
    """
    instance(views, Views, "backproject: views")
    one_of(how, HOW, "how")
    to_world, planes = _world_lattice(grid, "backproject: grid")
    kind = HOW[how]
    images = _checked_array(images, "backproject: images", (len(views), *views.shape))
    if kind == PRODUCT:
        _require_no_negative(images, "backproject: images", "product", ("view", "row", "column"))
    n_extra = 2 if kind == PRODUCT and depth is not None else 0
    require(4.0 * (1 + n_extra) * float(np.prod(grid.shape)), "a back-projection to {} x {} x {}".format(*grid.shape))
    points = np.empty(grid.shape, np.float32)
    inputs: Inputs
    if depth is None:
        matrices = _pixel_rows(views) @ to_world
        size = -(-len(points) // _PARTS)
        starts = range(0, len(points), size)  # in parts, so that a product needs little more memory
        for number, first in enumerate(starts):
            inputs, stage = [(images[..., None], shifted(matrices, first))], part_of(progress, number, len(starts))
            _fill(points[first : first + size], kind, planes, inputs, 1, stage, flat=True)
    else:
        inputs = (
            (np.multiply(images[m].T[None, ..., None], array, order="C"), (g.index_matrix @ to_world)[None])
            for m, (g, array) in enumerate(_checked_distributions(depth, views))
        )
        _fill(points, kind, planes, inputs, len(views), progress)
    return _as_volume(points, grid, "backprojection")


def views_that_see(views: Views, grid: Grid | PerspectiveGrid, progress: Progress | None = None) -> Volume | Floats32:
    """Count, for each voxel, the views that see it: its centre is in front of their source and within their image.

    Parameters
    ----------
    views : Views
    grid : Grid or PerspectiveGrid
        Voxels, or the cells of one view's coordinates, of these or other views.
    progress
        Called as ``progress(done, total)`` between parts; an exception raised there stops the work.

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
    to_world, planes = _world_lattice(grid, "views_that_see: grid")
    require(8.0 * float(np.prod(grid.shape)), "numbers of views at {} x {} x {} places".format(*grid.shape))
    counts = np.zeros(grid.shape, np.int32)
    points, image = np.zeros(grid.shape, np.float32), np.zeros((1, *views.shape, 1), np.float32)
    for m, matrix in enumerate(_pixel_rows(views) @ to_world):
        view_progress = part_of(progress, m, len(views))
        gather(points, planes, image, matrix[None], flat=True, seen=counts, progress=view_progress)
    points[...] = counts
    return _as_volume(points, grid, "modules")


def _world_lattice(grid: Grid | PerspectiveGrid, name: str) -> tuple[Floats, Floats]:
    """Return the matrix (4, 4) from a grid's points (i, j, plane) to the world, and the third coordinates of its planes.

    Raises `InputError`, which begins with `name`, if it is not a grid.
    """
    if not isinstance(grid, Grid | PerspectiveGrid):
        raise InputError(f"{name}: expected a Grid or a PerspectiveGrid, got {type(grid).__name__}")
    return (grid.affine, np.arange(float(grid.shape[2]))) if isinstance(grid, Grid) else (grid.inverse, grid.planes)


def _as_volume(points: Floats32, grid: Grid | PerspectiveGrid, quantity: str) -> Volume | Floats32:
    """Return the values at a grid's points as a `Volume`, or on a perspective grid as the array they are."""
    return Volume(freeze(points), grid, quantity) if isinstance(grid, Grid) else points


def _pixel_rows(views: Views) -> Floats:
    """Return the matrices (M, 5, 4) from world points to indices of images (n_v, n_u, 1), as `gather` takes them."""
    column, row, factor = np.moveaxis(views.projection_matrices(), 1, 0)
    return np.stack([row, column, np.zeros_like(row), factor, factor], axis=1)


def _checked_array(values: Any, name: str, shape: tuple[int, ...]) -> Floats32:
    """Return an array, or a tensor without a gradient, of this `shape` as float32, copied only if necessary."""
    if is_tensor(values):
        if values.requires_grad:
            advice = "sum from_perspective(...) of each view, or detach() the tensor"
            raise InputError(f"{name}: a back-projection has no gradients; {advice}")
        values = to_numpy(values, None)
    return np.require(checked(values, name, shape, False), requirements=["C", "A"])


def _require_no_negative(values: Floats32, name: str, use: str, axes: tuple[str, ...]) -> None:
    """Raise `InputError`, which names the place by its `axes`, if a value is below 0; `use` is what the values are for."""
    if values.min(initial=0.0) < 0:
        index = np.unravel_index(int(values.argmin()), values.shape)
        place = ", ".join(f"{axis} {i}" for axis, i in zip(axes, index, strict=True))
        raise InputError(f"{name}: expected 0 or more for a {use}, got {values[index]:g} at {place}")


def _checked_distributions(depth: Depth, views: Views) -> Iterator[tuple[PerspectiveGrid, Floats32]]:
    """Yield each view's perspective grid and depth distribution (n_u, n_v, n_k), checked."""
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
        array = _checked_array(distribution, f"depth: view {m}", g.shape)
        _require_no_negative(array, f"depth: view {m}", "distribution", ("column", "row", "plane"))
        yield g, array


def _is_view(g: PerspectiveGrid, views: Views, m: int) -> bool:
    """Return whether `g` belongs to view m of `views`."""
    if g.views is views:
        return g.m == m
    if (g.views.shape, g.views.parallel) != (views.shape, views.parallel):
        return False
    return all(np.allclose(getattr(g.views, n)[g.m], getattr(views, n)[m], rtol=0, atol=_SAME) for n in VECTORS)


def _fill(
    points: Floats32, kind: int, planes: Floats, inputs: Inputs, n: int, progress: Progress | None, flat: bool = False
) -> None:
    """Set `points` to the combination of all inputs, of which there are `n`, in the way `kind` of `gather`.

    `planes` are the third coordinates of the points; `flat` is whether the arrays are images.
    """
    points[...] = _NEUTRAL[kind]
    names = ("seen", "exponents") if kind == PRODUCT else ()
    counters: dict[str, Any] = {name: np.zeros(points.shape, np.int32) for name in names}
    for number, (arrays, matrices) in enumerate(inputs):
        gather(points, planes, arrays, matrices, how=kind, flat=flat, progress=part_of(progress, number, n), **counters)
    if kind == LEAST:
        for plane in points:  # one plane at a time needs little memory
            plane[np.isinf(plane)] = 0.0
    elif kind == PRODUCT:
        _take_roots(points, **counters)


def _take_roots(points: Floats32, seen: Counts, exponents: Counts) -> None:
    """Turn products, in place, into geometric means.

    A product is the point's value times 2 to its `exponents`; `seen` is the number of its factors. A point without factors
    gets 0.
    """
    for plane, n, exponent in zip(points, seen, exponents, strict=True):  # one plane at a time needs little memory
        with np.errstate(divide="ignore"):
            mean = (np.log2(plane, dtype=np.float64) + exponent) / np.maximum(n, 1)
        plane[...] = np.where(n > 0, np.exp2(mean), 0.0)
