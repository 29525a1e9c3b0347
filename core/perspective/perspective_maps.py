"""Volumes in the coordinates of views and back by torch's `grid_sample`, with maps that are made once: for networks."""

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from ..arrays import Floats
from ..geometry.frames import moved
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..memory import require
from .perspective_grid import PerspectiveGrid, depth_ranges


class PerspectiveMaps:
    """Where the cells of each view's `PerspectiveGrid` lie among a grid's voxels, and the voxels among the cells.

    Values are interpolated linearly at the places of cells and voxels, and are 0 outside; gradients follow. `to_perspective`
    and `from_perspective` give the means over cells and voxels instead: exact, and ten times slower. The views that are
    asked for are computed, no others.

    Parameters
    ----------
    views : Views
    grid : Grid
    n_k : int, optional
        Planes, between the depths of `depth_ranges`; by default 0.6 times the largest number of voxels along an axis.

    Raises
    ------
    InputError
        The grid is not in front of a view's source, or there is no memory for the maps: 12 bytes a cell and voxel, view.
    """

    def __init__(self, views: Views, grid: Grid, n_k: int | None = None) -> None:
        near, far = depth_ranges(views, grid)
        self.n_k = n_k or max(8, round(0.6 * max(grid.shape)))
        self.grids = [PerspectiveGrid(views, m, self.n_k, near[m], far[m]) for m in range(len(views))]
        numbers = 3.0 * len(views) * (grid.n_voxels + np.prod(self.grids[0].shape))
        require(float(4 * numbers), f"maps of {len(views)} views")
        world = moved(grid.affine, np.moveaxis(np.indices(grid.shape), 0, -1))
        cells = [_normalized(moved(grid.index_from_world, g.centers()), grid.shape) for g in self.grids]
        voxels = [_normalized(g.index_from_world(world), g.shape) for g in self.grids]
        self._cells, self._voxels = torch.stack(cells), torch.stack(voxels)
        edges = 1 + 1 / torch.tensor([n - 1 for n in self.grids[0].shape[::-1]])
        self._inside = (self._voxels.abs() <= edges).all(-1)[:, None]

    def to_views(self, x: Tensor, which: Tensor) -> Tensor:
        """Volumes (B, C, n_x, n_y, n_z) as the views `which` (V,) see them: (B, V, C, n_u, n_v, n_k)."""
        return _sampled(x[:, None].expand(-1, len(which), *x.shape[1:]), self._cells[which])

    def to_volume(self, y: Tensor, which: Tensor) -> tuple[Tensor, Tensor]:
        """Values of views (B, V, C, n_u, n_v, n_k) at the voxels (B, V, C, …), and 1 for those they see (1, V, 1, …)."""
        return _sampled(y, self._voxels[which]), self._inside[which][None].to(y)


def _sampled(values: Tensor, places: Tensor) -> Tensor:
    """(B, V, C, …) at places (V, …, 3)."""
    b, v = values.shape[:2]
    where = places.to(values).expand(b, *places.shape).flatten(0, 1)
    return grid_sample(values.flatten(0, 1), where, align_corners=True).unflatten(0, (b, v))


def _normalized(index: Floats, shape: tuple[int, int, int]) -> Tensor:
    """Indices (…, 3) as `grid_sample` takes them: from -1 to 1 between the first and the last, the last axis first."""
    return torch.from_numpy((2 * index / (np.array(shape) - 1) - 1)[..., ::-1].copy())
