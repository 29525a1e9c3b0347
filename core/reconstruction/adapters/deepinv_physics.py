"""Projector as a linear physics of deepinv."""

from typing import Any

import torch
from deepinv.physics import LinearPhysics, StackedLinearPhysics
from deepinv.utils import TensorList
from torch import Tensor

from ...projector import Projector
from ...projector.subsets import balanced_subsets, in_access_order


class ProjectorPhysics(LinearPhysics):
    """Projector of tensors with axes for batch and channel."""

    def __init__(self, A: Projector, **options: Any) -> None:
        super().__init__(img_size=(1, *A.shape_in), **options)
        self.projector = A
        if A.background.any():  # deepinv's algorithms use this attribute if it exists
            self.register_buffer("background", torch.tensor(A.background, dtype=torch.float32), persistent=False)

    def A(self, x: Tensor, add_background: bool = False, **_: Any) -> Tensor:
        """Return the images (B, C, M, n_v, n_u) of volumes, with the model's background if `add_background`."""
        images: Tensor = self.projector(x)
        if add_background and hasattr(self, "background"):
            images = images + self.background
        return images

    def A_adjoint(self, y: Tensor, **_: Any) -> Tensor:
        """Return the backprojected images: the exact adjoint of `A` without background."""
        return self.projector.T(y)

    def forward(self, x: Tensor, **options: Any) -> Tensor:
        """Return measurements: the expected counts with background after the noise model and the sensor."""
        return self.sensor(self.noise(self.A(x, add_background=True, **options)))

    def split_physics(self, n: int) -> StackedLinearPhysics:
        """Return the physics of `n` balanced subsets of the views."""
        projectors = in_access_order(self.projector.subsets(n))
        return StackedLinearPhysics([ProjectorPhysics(B, noise_model=self.noise_model) for B in projectors])

    def split_measurements(self, y: Tensor, n: int) -> TensorList:
        """Return the measurements (B, C, m, n_v, n_u) of each of `n` subsets; `y` (B, C, M, n_v, n_u) has all views."""
        return TensorList([y[:, :, views] for views in in_access_order(balanced_subsets(self.projector.views, n))])
