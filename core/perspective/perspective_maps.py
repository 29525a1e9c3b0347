"""Resampling between volumes and views inside neural networks: torch's `grid_sample` with precomputed places."""

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
    """Precomputed places for linear interpolation between a grid's voxels and the cells of each view's `PerspectiveGrid`.

    Values are interpolated linearly at the centres of cells and voxels, and are 0 outside; gradients follow. The functions
    `to_perspective` and `from_perspective` return means over cells and voxels instead: exact, and ten times slower. Only the
    requested views are computed.

    Parameters
    ----------
    views : Views
    grid : Grid
    n_k : int, optional
        Number of planes between the depths of `depth_ranges`; by default 0.6 times the largest number of voxels along an
        axis.

    Raises
    ------
    InputError
        The grid is not in front of a view's source, or the maps do not fit into memory: they take 12 bytes per voxel and per
        cell of every view.
    """

    def __init__(self, views: Views, grid: Grid, n_k: int | None = None) -> None:
        near, far = depth_ranges(views, grid)
        self.n_k = n_k or max(8, round(0.6 * max(grid.shape)))
        self.grids = [PerspectiveGrid(views, m, self.n_k, near[m], far[m]) for m in range(len(views))]
        n_coordinates = 3.0 * len(views) * (grid.n_voxels + np.prod(self.grids[0].shape))
        require(float(4 * n_coordinates), f"maps of {len(views)} views")
        voxel_centers = moved(grid.affine, np.moveaxis(np.indices(grid.shape), 0, -1))
        cells = [_normalized(moved(grid.index_from_world, g.centers()), grid.shape) for g in self.grids]
        voxels = [_normalized(g.index_from_world(voxel_centers), g.shape) for g in self.grids]
        self._cells, self._voxels = torch.stack(cells), torch.stack(voxels)
        limits = 1 + 1 / torch.tensor([n - 1 for n in self.grids[0].shape[::-1]])
        self._inside = (self._voxels.abs() <= limits).all(-1)[:, None]

    def to_views(self, volumes: Tensor, views: Tensor) -> Tensor:
        """Return volumes (B, C, n_x, n_y, n_z) in the coordinates of V `views`, given by index: (B, V, C, n_u, n_v, n_k)."""
        return _sampled(volumes[:, None].expand(-1, len(views), *volumes.shape[1:]), self._cells[views])

    def to_volume(self, arrays: Tensor, views: Tensor) -> tuple[Tensor, Tensor]:
        """Interpolate arrays on the views' cells (B, V, C, n_u, n_v, n_k) at the voxels of the grid.

        Returns the values (B, V, C, n_x, n_y, n_z), and the visibility (1, V, 1, n_x, n_y, n_z): 1 for a voxel within the
        view's cells, else 0. `views` (V,) are indices.
        """
        return _sampled(arrays, self._voxels[views]), self._inside[views][None].to(arrays)


def _sampled(values: Tensor, places: Tensor) -> Tensor:
    """Return values (B, V, C, …) interpolated at normalized places (V, …, 3), in the type and on the device of `values`."""
    n_batch, n_views = values.shape[:2]
    coordinates = places.to(values).expand(n_batch, *places.shape).flatten(0, 1)
    return grid_sample(values.flatten(0, 1), coordinates, align_corners=True).unflatten(0, (n_batch, n_views))


def _normalized(index: Floats, shape: tuple[int, int, int]) -> Tensor:
    """Return array indices (…, 3) as `grid_sample` coordinates: -1 at the first element, 1 at the last, axes reversed."""
    return torch.from_numpy((2 * index / (np.array(shape) - 1) - 1)[..., ::-1].copy())
