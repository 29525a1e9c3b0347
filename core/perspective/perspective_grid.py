"""The lattice of one view's own coordinates: a cell for each pixel and plane of depth."""

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
"""What the planes of a perspective grid may be evenly spaced in."""


@dataclass(frozen=True, eq=False)
class PerspectiveGrid:
    """Cells of view `m` in its own coordinates: arrays on it are (n_u, n_v, n_k), indexed [column, row, plane].

    A cell is what a pixel sees between two planes parallel to the detector; its place is the pixel's centre, in the middle
    of the planes. Column and row are in pixels, as in the image, 0 at the centre of pixel 0; ``k = D / depth`` is the
    magnification: the depth is measured from the source across the detector's plane, at distance D. k falls, and depth
    grows, from plane 0, next to `near`, to the last, next to `far`.

    For a parallel view k is 1 everywhere and says nothing of depth: the third coordinate is the depth itself, mm, from the
    plane through ``views.sources[m]``, and planes are evenly spaced in it.

    Parameters
    ----------
    views : Views
    m : int
        Which of them.
    n_k : int
        Planes.
    near, far : float
        Depths, mm, at which the first cells begin and the last ones end.
    uniform : str
        What planes are evenly spaced in: "k", so that they are densest near the source, or "depth".

    Raises
    ------
    InputError
        No such view, or depths that are not in front of the source and in this order.
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
        """The shape of arrays, (n_u, n_v, n_k)."""
        n_v, n_u = self.views.shape
        return n_u, n_v, self.n_k

    @cached_property
    def matrix(self) -> Floats:
        """The transform (4, 4) from world points, mm, to (column, row, k); of a parallel view, (column, row, depth)."""
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
        """The third coordinate (n_k + 1,) at the borders of planes: k, or the depth of a parallel view."""
        return freeze(self.planes_at(np.arange(self.n_k + 1) - 0.5))

    @cached_property
    def planes(self) -> Floats:
        """The third coordinate (n_k,) of the cells' places: k, or the depth of a parallel view."""
        return freeze(self.planes_at(np.arange(self.n_k)))

    def planes_at(self, index: ArrayLike) -> Floats:
        """The third coordinate, k or depth, where the third index is `index`, also between the cells' places."""
        share = (np.asarray(index, np.float64) + 0.5) / self.n_k
        depths = self.near + share * (self.far - self.near)
        if self.views.parallel:
            return depths
        if self.uniform == "depth":
            return np.asarray(self._distance / depths)
        return np.asarray(self._distance * (1 / self.near + share * (1 / self.far - 1 / self.near)))

    @property
    def depths(self) -> Floats:
        """The depth (n_k,) of the cells' places, mm."""
        return self.planes if self.views.parallel else self._distance / self.planes

    def to_world(self, points: ArrayLike) -> Floats:
        """World points (…, 3), mm, of points (…, 3) given as (column, row, k); of a parallel view, (column, row, depth)."""
        return transform_points(self.inverse, points)

    def from_world(self, points: ArrayLike) -> Floats:
        """The coordinates (column, row, k) (…, 3) of world points (…, 3), mm; of a parallel view, (column, row, depth)."""
        return transform_points(self.matrix, points)

    def index_from_world(self, points: ArrayLike) -> Floats:
        """Where world points (…, 3), mm, lie in arrays: their three indices (…, 3), fractions between the cells' places.

        Infinite, or not a number, of points at the source's depth; those behind it have no cell, though they have indices.
        """
        points = real_array(points, "points", (3,), batch=True)
        p = points @ self.index_matrix[:, :3].T + self.index_matrix[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(p[..., :3] / p[..., [3, 3, 4]])

    def world_from_index(self, index: ArrayLike) -> Floats:
        """World points (…, 3), mm, of an array's indices (…, 3), also between cells: the inverse of `index_from_world`."""
        index = real_array(index, "index", (3,), batch=True)
        return self.to_world(np.concatenate([index[..., :2], self.planes_at(index[..., 2:])], axis=-1))

    def centers(self) -> Floats:
        """World points (n_u, n_v, n_k, 3), mm, of the cells' places."""
        columns, rows = (np.arange(n, dtype=np.float64) for n in self.shape[:2])
        return self.to_world(np.stack(np.meshgrid(columns, rows, self.planes, indexing="ij"), axis=-1))

    def ray_lengths(self) -> Floats:
        """How long each cell's ray is in it (n_u, n_v, n_k), mm."""
        starts, targets = self.views.rays(self.m)
        rays = targets - starts
        n_v, n_u = self.views.shape
        per_depth = np.linalg.norm(rays, axis=1) / (rays @ self._normal)
        return np.asarray(per_depth.reshape(n_v, n_u).T[..., None] * np.diff(self._edge_depths))

    def cell_volumes(self) -> Floats:
        """The volume of a cell of each plane (n_k,), mm^3; it is the same for all pixels."""
        area = np.linalg.norm(np.cross(self.views.u_steps[self.m], self.views.v_steps[self.m]))
        if self.views.parallel:
            return np.asarray(area * np.diff(self.edges))
        return np.asarray(area * np.diff(self._edge_depths**3) / (3 * self._distance**2))

    def image(self, array: ArrayOrTensor) -> ArrayOrTensor:
        """Line integrals (…, n_v, n_u) along the pixels' rays, value x mm: sums over planes of values times rays' lengths.

        `array` (…, n_u, n_v, n_k), numpy or torch, holds values that keep density, as `to_perspective` makes them. A
        tensor's gradient follows.
        """
        double = str(getattr(array, "dtype", None)).endswith("float64")
        array = checked(array, "perspective array", self.shape, double, batch=True)
        values: Any = array * cast_like(self.ray_lengths(), array)
        return values.sum(-1).swapaxes(-1, -2)

    @cached_property
    def index_matrix(self) -> Floats:
        """(5, 4): from homogeneous world points to numbers p with column p0 / p3, row p1 / p3 and plane p2 / p4.

        A plane's number is that of the array's third index, at the cells' places.
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
        """(3,): across the detector's plane, away from the source."""
        return np.asarray(view_frames(self.views[self.m])[0, 2])

    @property
    def _distance(self) -> float:
        """From the source to the detector's plane, mm."""
        return float(self._normal @ (self.views.detector_centers[self.m] - self.views.sources[self.m]))

    @property
    def _edge_depths(self) -> Floats:
        return self.edges if self.views.parallel else self._distance / self.edges


def perspective_grids(
    views: Views, n_k: int, near: ArrayLike, far: ArrayLike, uniform: str = "k"
) -> tuple[PerspectiveGrid, ...]:
    """A `PerspectiveGrid` of every view; `near` and `far`: depths, mm, one or (M,), such as those of `depth_ranges`."""
    instance(views, Views, "perspective grids")
    nears, fars = (one_for_all(each, name, len(views)) for each, name in ((near, "near"), (far, "far")))
    return tuple(PerspectiveGrid(views, m, n_k, nears[m], fars[m], uniform) for m in range(len(views)))


def depth_ranges(views: Views, grid: Grid) -> tuple[Floats, Floats]:
    """The depths, mm, between which `grid` lies in each view: near (M,) and far (M,).

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
        found = f"it begins {-near.min():.3g} mm behind"
        raise InputError(f"view {int(near.argmin())}: expected a grid in front of its source, but {found}")
    return near, far


def depths_in_views(views: Views, points: ArrayLike) -> Floats:
    """The depths (M, N), mm, of world points (N, 3) in each view: from its source across its detector's plane."""
    return np.asarray(np.einsum("mpi,mi->mp", np.asarray(points) - views.sources[:, None], view_frames(views)[:, 2]))
