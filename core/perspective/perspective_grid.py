"""Perspective grids: the lattice of one view's own coordinates, a cell for each pixel and plane of depth."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..arrays import ArrayLike, ArrayOrTensor, Floats, cast_like, checked
from ..errors import InputError
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..validation import freeze, instance, one_for_all, one_of, real_array, whole_number
from .coordinates import transform_points
from .view_rays import view_frames

UNIFORM = ("k", "depth")
"""Coordinates in which the planes of a perspective grid may be evenly spaced."""


@dataclass(frozen=True, eq=False)
class PerspectiveGrid:
    """Cells of view `m` in its own coordinates; arrays on the grid are (n_u, n_v, n_k), indexed [column, row, plane].

    A cell is the part of a pixel's pyramid of rays between two planes parallel to the detector; its place is on the ray of
    the pixel's centre, midway between the planes in the coordinate in which planes are evenly spaced. Column and row are in
    pixels, as in the image, 0 at the centre of pixel 0; ``k = D / depth`` is the magnification. Depth is measured from the
    source along the detector's normal, and D is the detector's distance. From plane 0, next to `near`, to the last plane,
    next to `far`, k falls and depth grows.

    For a parallel view k is 1 everywhere and does not tell the depth: there the third coordinate is the depth itself, mm,
    from the plane through ``views.sources[m]``, and planes are evenly spaced in it.

    Parameters
    ----------
    views : Views
    m : int
        Index of the view.
    n_k : int
        Number of planes.
    near, far : float
        Depths, mm, at which the first cells begin and the last ones end.
    uniform : str
        Coordinate in which planes are evenly spaced: "k", so that they are densest near the source, or "depth".

    Raises
    ------
    InputError
        There is no view `m`, or the depths are not in front of the source or not in this order.
    """

    views: Views
    m: int
    n_k: int
    near: float
    far: float
    uniform: str = "k"

    def __post_init__(self) -> None:
        instance(self.views, Views, "perspective grid")
        one_of(self.uniform, UNIFORM, "uniform")
        if isinstance(self.m, bool) or not isinstance(self.m, int | np.integer):
            raise InputError(f"perspective grid: expected the index of a view, got {self.m!r}")
        if not -len(self.views) <= self.m < len(self.views):
            raise InputError(f"perspective grid: there is no view {self.m} among {len(self.views)}")
        object.__setattr__(self, "m", int(self.m) % len(self.views))
        object.__setattr__(self, "n_k", whole_number(self.n_k, "planes of a perspective grid"))
        for name in ("near", "far"):
            object.__setattr__(self, name, float(real_array(getattr(self, name), name, ())))
        if not self.near < self.far or (self.near <= 0 and not self.views.parallel):
            order = "near < far" if self.views.parallel else "0 < near < far"
            raise InputError(f"perspective grid: expected depths {order}, got {self.near:g} and {self.far:g} mm")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of arrays on the grid, (n_u, n_v, n_k)."""
        n_v, n_u = self.views.shape
        return n_u, n_v, self.n_k

    @cached_property
    def matrix(self) -> Floats:
        """Transform (4, 4) from world points, mm, to (column, row, k); for a parallel view, to (column, row, depth)."""
        matrix = self.views[self.m].perspective_matrices()[0]
        if self.views.parallel:
            matrix[2] = [*self._normal, -self._normal @ self.views.sources[self.m]]
        return freeze(matrix)

    @cached_property
    def inverse(self) -> Floats:
        """The transform (4, 4) back, from (column, row, k) to world points, mm."""
        return freeze(np.linalg.inv(self.matrix))

    @cached_property
    def edges(self) -> Floats:
        """Third coordinate (n_k + 1,) of the cells' borders: k, or for a parallel view the depth, mm."""
        return freeze(self.planes_at(np.arange(self.n_k + 1) - 0.5))

    @cached_property
    def planes(self) -> Floats:
        """Third coordinate (n_k,) of the cells' places: k, or for a parallel view the depth, mm."""
        return freeze(self.planes_at(np.arange(self.n_k)))

    def planes_at(self, index: ArrayLike) -> Floats:
        """Return the third coordinate, k or for a parallel view depth, at third array indices, which may be fractions."""
        fraction = (np.asarray(index, np.float64) + 0.5) / self.n_k
        depths = self.near + fraction * (self.far - self.near)
        if self.views.parallel:
            return depths
        if self.uniform == "depth":
            return np.asarray(self._distance / depths)
        return np.asarray(self._distance * (1 / self.near + fraction * (1 / self.far - 1 / self.near)))

    @property
    def depths(self) -> Floats:
        """Depth (n_k,), mm, of the cells' places."""
        return self.planes if self.views.parallel else self._distance / self.planes

    def to_world(self, points: ArrayLike) -> Floats:
        """Return the world points (…, 3), mm, of points (column, row, k); for a parallel view, (column, row, depth)."""
        return transform_points(self.inverse, points)

    def from_world(self, points: ArrayLike) -> Floats:
        """Return the coordinates (column, row, k) of world points (…, 3), mm; for a parallel view, (column, row, depth)."""
        return transform_points(self.matrix, points)

    def index_from_world(self, points: ArrayLike) -> Floats:
        """Return the array indices (…, 3) of world points (…, 3), mm, as fractions between the cells' places.

        They are infinite or NaN for points at the source's depth. Points behind the source lie in no cell, though they have
        indices.
        """
        points = real_array(points, "points", (3,), batch=True)
        p = points @ self.index_matrix[:, :3].T + self.index_matrix[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(p[..., :3] / p[..., [3, 3, 4]])

    def world_from_index(self, index: ArrayLike) -> Floats:
        """Return the world points (…, 3), mm, of array indices (…, 3), also fractional; inverse of `index_from_world`."""
        index = real_array(index, "index", (3,), batch=True)
        return self.to_world(np.concatenate([index[..., :2], self.planes_at(index[..., 2:])], axis=-1))

    def centers(self) -> Floats:
        """Return the world points (n_u, n_v, n_k, 3), mm, of the cells' places."""
        columns, rows = (np.arange(n, dtype=np.float64) for n in self.shape[:2])
        return self.to_world(np.stack(np.meshgrid(columns, rows, self.planes, indexing="ij"), axis=-1))

    def ray_lengths(self) -> Floats:
        """Return the length (n_u, n_v, n_k), mm, of each pixel's ray inside each of its cells."""
        starts, targets = self.views.rays(self.m)
        rays = targets - starts
        n_v, n_u = self.views.shape
        per_depth = np.linalg.norm(rays, axis=1) / (rays @ self._normal)
        return np.asarray(per_depth.reshape(n_v, n_u).T[..., None] * np.diff(self._edge_depths))

    def cell_volumes(self) -> Floats:
        """Return the volume (n_k,), mm^3, of a cell of each plane; all cells of a plane have the same."""
        area = np.linalg.norm(np.cross(self.views.u_steps[self.m], self.views.v_steps[self.m]))
        if self.views.parallel:
            return np.asarray(area * np.diff(self.edges))
        return np.asarray(area * np.diff(self._edge_depths**3) / (3 * self._distance**2))

    def image(self, array: ArrayOrTensor) -> ArrayOrTensor:
        """Return line integrals (…, n_v, n_u) along the pixels' rays, value x mm: sums over planes of value x ray length.

        `array` (…, n_u, n_v, n_k), numpy or torch, holds mean values of the cells, as `to_perspective` returns them with
        ``keep="density"``. A tensor's gradient follows.
        """
        double = str(getattr(array, "dtype", None)).endswith("float64")
        array = checked(array, "perspective array", self.shape, double, batch=True)
        values: Any = array * cast_like(self.ray_lengths(), array)
        return values.sum(-1).swapaxes(-1, -2)

    @cached_property
    def index_matrix(self) -> Floats:
        """Matrix (5, 4) from homogeneous world points to p, with column ``p0 / p3``, row ``p1 / p3`` and plane ``p2 / p4``.

        The plane is the third array index, a whole number at the cells' places.
        """
        column, row, third, last = self.matrix
        if self.views.parallel or self.uniform == "k":
            step = (self.edges[-1] - self.edges[0]) / self.n_k
            plane, divisor = third - (self.edges[0] + step / 2) * last, last
        else:
            step = (self.far - self.near) / self.n_k
            plane, divisor = self._distance * last - (self.near + step / 2) * third, third
        return freeze(np.stack([column, row, plane / step, last, divisor]))

    @cached_property
    def _normal(self) -> Floats:
        """Unit normal (3,) of the detector's plane, which points away from the source."""
        return np.asarray(view_frames(self.views[self.m])[0, 2])

    @property
    def _distance(self) -> float:
        """Distance D, mm, from the source to the detector's plane."""
        return float(self._normal @ (self.views.detector_centers[self.m] - self.views.sources[self.m]))

    @property
    def _edge_depths(self) -> Floats:
        """Depth (n_k + 1,), mm, of the cells' borders."""
        return self.edges if self.views.parallel else self._distance / self.edges


def perspective_grids(
    views: Views, n_k: int, near: ArrayLike, far: ArrayLike, uniform: str = "k"
) -> tuple[PerspectiveGrid, ...]:
    """Return a `PerspectiveGrid` of every view.

    `near` and `far` are depths, mm: one for all views, or (M,), such as those of `depth_ranges`.
    """
    instance(views, Views, "perspective grids")
    nears, fars = (one_for_all(depths, name, len(views)) for depths, name in ((near, "near"), (far, "far")))
    return tuple(PerspectiveGrid(views, m, n_k, nears[m], fars[m], uniform) for m in range(len(views)))


def depth_ranges(views: Views, grid: Grid) -> tuple[Floats, Floats]:
    """Return the least and the greatest depth, mm, of `grid` in each view: near (M,) and far (M,).

    Raises
    ------
    InputError
        A part of the grid is not in front of a view's source.
    """
    instance(views, Views, "depths: views")
    instance(grid, Grid, "depths: grid")
    depths = depths_in_views(views, grid.corners())
    near, far = depths.min(axis=1), depths.max(axis=1)
    if not views.parallel and (near <= 0).any():
        position = f"it begins {-near.min():.3g} mm behind"
        raise InputError(f"view {int(near.argmin())}: expected a grid in front of its source, but {position}")
    return near, far


def depths_in_views(views: Views, points: ArrayLike) -> Floats:
    """Return the depths (M, N), mm, of world points (N, 3) in each view, from its source along its detector's normal."""
    return np.asarray(np.einsum("mpi,mi->mp", np.asarray(points) - views.sources[:, None], view_frames(views)[:, 2]))
