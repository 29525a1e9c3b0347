"""Projector as a system matrix of PyTomography."""

import numpy as np
import pytomography
import torch
from pytomography.metadata import ObjectMeta, ProjMeta
from pytomography.projectors import SystemMatrix
from torch import Tensor

from ...projector import Projector
from ...projector.subsets import in_access_order

_MM_PER_CM = 10.0


class ProjectorMatrix(SystemMatrix):
    """Projector from objects (n_x, n_y, n_z) to projections (M, n_v, n_u)."""

    def __init__(self, A: Projector) -> None:
        x, y, _ = A.views.sources.T
        projections = ProjMeta(np.degrees(np.arctan2(y, x)))
        projections.shape = A.shape_out
        super().__init__(ObjectMeta(tuple(A.grid.spacing / _MM_PER_CM), A.shape_in), projections)
        self.projector = A
        self._subsets: list[Projector] = []
        self.set_n_subsets(1)

    def set_n_subsets(self, n_subsets: int) -> None:
        """Divide the views into balanced subsets; PyTomography's algorithms call it each time that they run."""
        if n_subsets == len(self._subsets):
            return
        self._subsets = in_access_order(self.projector.subsets(n_subsets))
        self.subset_indices_array = [torch.tensor(projector.which) for projector in self._subsets]

    def forward(self, object: Tensor, subset_idx: int | None = None) -> Tensor:
        """Return the projections of an object in a subset of the views, or in all views."""
        return self._subset(subset_idx)(object)

    def backward(self, proj: Tensor, subset_idx: int | None = None) -> Tensor:
        """Return the backprojection, the exact adjoint, of the projections of a subset or of all views."""
        return self._subset(subset_idx).T(proj)

    def get_projection_subset(self, projections: Tensor, subset_idx: int | None) -> Tensor:
        """Return the projections of a subset from those of all views."""
        if subset_idx is None:
            return projections
        return projections[self.subset_indices_array[subset_idx].to(projections.device)]

    def get_weighting_subset(self, subset_idx: int | None) -> float:
        """Return the number of views in a subset divided by the number of all views."""
        return len(self._subset(subset_idx).views) / len(self.projector.views)

    def compute_normalization_factor(self, subset_idx: int | None = None) -> Tensor:
        """Return the sensitivity ``A.T(1)`` of a subset or of all views, counts per unit of activity in each voxel."""
        return self.backward(torch.ones(self._subset(subset_idx).shape_out, device=pytomography.device), subset_idx)

    def _subset(self, subset_idx: int | None) -> Projector:
        """Return the projector of a subset, or of all views for None."""
        return self.projector if subset_idx is None else self._subsets[subset_idx]
