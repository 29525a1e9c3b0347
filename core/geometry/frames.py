"""Module frames, rotations and 4x4 poses. World: right-handed, mm, origin at the isocentre, +z along the patient."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..validation import radians, real_array

# z and a principal ray are parallel if the sine of the angle between them is below this.
_PARALLEL = 1e-9


def principal_rays(centers: ArrayLike) -> NDArray[np.float64]:
    """Unit vectors (M, 3) from pinhole `centers` (M, 3), mm, to the isocentre at the origin."""
    centers = real_array(centers, "pinhole centres", (None, 3))
    distance = np.linalg.norm(centers, axis=1)
    if np.any(distance == 0):
        raise InputError(f"pinhole {int(np.argmin(distance))} lies at the isocentre: it has no principal ray")
    return -centers / distance[:, None]


def module_frames(centers: ArrayLike) -> NDArray[np.float64]:
    """Module frames (M, 3, 3), rows u, v, k, of pinholes at `centers` (M, 3), mm.

    k points from the pinhole to the isocentre, ``u = normalize(z_hat x k)`` (x_hat where z_hat is parallel to k)
    and ``v = k x u``: right-handed and orthonormal. With +v up, +u is to the LEFT as seen from the pinhole.
    """
    k = principal_rays(centers)
    u = np.cross([0.0, 0.0, 1.0], k)
    parallel = np.linalg.norm(u, axis=1) < _PARALLEL
    u[parallel] = np.cross([1.0, 0.0, 0.0], k[parallel])
    u /= np.linalg.norm(u, axis=1)[:, None]
    return np.stack([u, np.cross(k, u), k], axis=1)


def module_poses(centers: ArrayLike) -> NDArray[np.float64]:
    """World-from-module poses (M, 4, 4) of pinholes at `centers` (M, 3), mm: columns u, v, k and the centre."""
    return affine_matrix(module_frames(centers).transpose(0, 2, 1), centers)


def affine_matrix(linear: NDArray[np.float64], translation: ArrayLike) -> NDArray[np.float64]:
    """Matrices (..., 4, 4) on column vectors, of their linear part (..., 3, 3) and their translation (..., 3)."""
    matrix = np.zeros((*linear.shape[:-2], 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = linear, translation, 1.0
    return matrix


def moved(affine: NDArray[np.float64], points: NDArray[np.floating | np.integer]) -> NDArray[np.float64]:
    """Points (..., 3) after an affine (4, 4)."""
    return points @ affine[:3, :3].T + affine[:3, 3]


def euler_pose(
    phi: float = 0.0, theta: float = 0.0, psi: float = 0.0, translation: ArrayLike = (0.0, 0.0, 0.0)
) -> NDArray[np.float64]:
    """World-from-object pose (4, 4): a rotation by three Euler angles, rad, then a translation, mm.

    The object is turned by psi about its z axis, then by theta about world y, then by phi about world z.
    """
    angles = radians([phi, theta, psi], "Euler angles", (3,))
    rotation = np.eye(3)
    for axis, angle in zip((2, 1, 2), angles, strict=True):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[i, i] = turn[j, j] = math.cos(angle)  # numpy's last digit depends on its version
        turn[j, i] = math.sin(angle)
        turn[i, j] = -turn[j, i]
        rotation = rotation @ turn
    return affine_matrix(rotation, real_array(translation, "translation", (3,)))


def checked_affine(affine: ArrayLike, name: str) -> NDArray[np.float64]:
    """`affine` as an invertible (4, 4) float64 matrix acting on column vectors, or `InputError`."""
    matrix = real_array(affine, name, (4, 4))
    if not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        raise InputError(f"{name}: expected 0 0 0 1 as the last row, got {' '.join(f'{x:g}' for x in matrix[3])}")
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    # Scaled to unit columns, so that a grid of small voxels is not taken for singular.
    if np.any(lengths == 0) or abs(np.linalg.det(matrix[:3, :3] / lengths)) < 1e-10:
        raise InputError(f"{name}: its three axes are not independent, so it cannot be inverted")
    return matrix
