"""PyTomography's system matrix."""

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
    """A projector whose objects are (n_x, n_y, n_z) and whose projections are (M, n_v, n_u)."""

    def __init__(self, A: Projector) -> None:
        x, y, _ = A.views.sources.T
        projections = ProjMeta(np.degrees(np.arctan2(y, x)))
        projections.shape = A.shape_out
        super().__init__(ObjectMeta(tuple(A.grid.spacing / _MM_PER_CM), A.shape_in), projections)
        self.projector = A
        self._parts: list[Projector] = []
        self.set_n_subsets(1)

    def set_n_subsets(self, n_subsets: int) -> None:
        """Divide the views into balanced subsets; PyTomography's algorithms call it, each time that they run."""
        if n_subsets == len(self._parts):
            return
        self._parts = in_access_order(self.projector.subsets(n_subsets))
        self.subset_indices_array = [torch.tensor(part.which) for part in self._parts]

    def forward(self, object: Tensor, subset_idx: int | None = None) -> Tensor:
        """Return the projections of an object, of all views or of a subset."""
        return self._part(subset_idx)(object)

    def backward(self, proj: Tensor, subset_idx: int | None = None) -> Tensor:
        """Apply the exact adjoint to all projections, or to those of a subset."""
        return self._part(subset_idx).T(proj)

    def get_projection_subset(self, projections: Tensor, subset_idx: int | None) -> Tensor:
        """Return the projections of a subset."""
        if subset_idx is None:
            return projections
        return projections[self.subset_indices_array[subset_idx].to(projections.device)]

    def get_weighting_subset(self, subset_idx: int | None) -> float:
        """Return the subset's share of the views."""
        return len(self._part(subset_idx).views) / len(self.projector.views)

    def compute_normalization_factor(self, subset_idx: int | None = None) -> Tensor:
        """Return the backprojection of ones."""
        return self.backward(torch.ones(self._part(subset_idx).shape_out, device=pytomography.device), subset_idx)

    def _part(self, subset_idx: int | None) -> Projector:
        return self.projector if subset_idx is None else self._parts[subset_idx]
