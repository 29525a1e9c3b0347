"""Module frames, rotations and 4x4 poses. World: right-handed, mm, origin at the isocentre, +z along the patient."""

import math

import numpy as np
from numpy.typing import NDArray

from ..arrays import ArrayLike, Floats
from ..errors import InputError
from ..validation import radians, real_array

# z and a principal ray are parallel if the sine of the angle between them is below this.
_PARALLEL = 1e-9
_ROUNDING = 1e-14  # rad


def principal_rays(centers: ArrayLike) -> Floats:
    """Return the unit vectors (M, 3) from pinhole `centers` (M, 3), mm, to the isocentre at the origin."""
    centers = real_array(centers, "pinhole centres", (None, 3))
    distance = np.linalg.norm(centers, axis=1)
    if np.any(distance == 0):
        raise InputError(f"pinhole {int(np.argmin(distance))} lies at the isocentre: it has no principal ray")
    return -centers / distance[:, None]


def module_frames(centers: ArrayLike) -> Floats:
    """Return the module frames (M, 3, 3), rows u, v, k, of untilted modules with pinholes at `centers` (M, 3), mm.

    k points from the pinhole to the isocentre, ``u = normalize(z_hat x k)`` (x_hat where z_hat is parallel to k)
    and ``v = k x u``: right-handed and orthonormal. With +v up, +u is to the LEFT as seen from the pinhole.
    """
    k = principal_rays(centers)
    u = _cross(np.array([0.0, 0.0, 1.0]), k)
    parallel = np.linalg.norm(u, axis=1) < _PARALLEL
    if parallel.any():
        u[parallel] = _cross(np.array([1.0, 0.0, 0.0]), k[parallel])
    u /= np.linalg.norm(u, axis=1)[:, None]
    return np.stack([u, _cross(k, u), k], axis=1)


def _cross(a: Floats, b: Floats) -> Floats:
    """Return the cross products of vectors (3,) or (M, 3), to the digit as `numpy.cross`, but faster for few vectors."""
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def tilt_frames(frames: Floats, tilt: Floats) -> Floats:
    """Turn frames (M, 3, 3), rows u, v, k, by rotation vectors `tilt` (M, 3), rad, about their own u, v and k."""
    is_tilted = np.any(tilt, axis=1)
    if not is_tilted.any():  # returned as they are, so that no last digit changes
        return frames
    turned = frames.copy()
    # A vector a of the frame becomes R a, whose world coordinates are F^T R a: the rows turn by R^T F.
    turned[is_tilted] = rotations(tilt[is_tilted]).transpose(0, 2, 1) @ frames[is_tilted]
    return turned


def tilt_vectors(frames: Floats, turned: Floats) -> Floats:
    """Return the rotation vectors (M, 3), rad, with which `tilt_frames` makes `frames` (M, 3, 3) `turned`.

    A vector within rounding of 0 is 0.
    """
    if np.array_equal(frames, turned):  # exactly 0, the usual case
        return np.zeros((len(frames), 3))
    vectors = rotation_vectors((turned @ frames.transpose(0, 2, 1)).transpose(0, 2, 1))
    return np.where(np.abs(vectors).max(axis=1, keepdims=True) > _ROUNDING, vectors, 0.0)


def rotations(vectors: Floats) -> Floats:
    """Return the rotation matrices (N, 3, 3) of rotation vectors (N, 3), rad, by Rodrigues' formula."""
    angle, cross = np.linalg.norm(vectors, axis=1)[:, None, None], cross_matrix(vectors)
    # sin(a)/a and (1 - cos(a))/a^2 are computed by sinc, which is exact at 0; NumPy's sinc is sin(pi x)/(pi x).
    return np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (cross @ cross)


def unit_vectors(vectors: Floats) -> Floats:
    """Return `vectors` (…, 3) scaled to length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def cross_matrix(vectors: Floats) -> Floats:
    """Return the matrices (…, 3, 3) of the cross product with `vectors` a (…, 3): ``matrix @ b = a x b``."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)


def rotation_vectors(matrices: Floats) -> Floats:
    """Return the rotation vectors (N, 3), rad, of rotation matrices (N, 3, 3); for half a turn, either of the two.

    They are computed by unit quaternions. Each of the four rows of q q^T is a multiple of q; the one with the largest
    divisor is taken, so that no angle loses digits.
    """
    r = matrices
    trace = np.trace(r, axis1=1, axis2=2)
    diagonal = np.diagonal(r, axis1=1, axis2=2)
    odd = np.stack([r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1)
    # The rows of 4 q q^T are multiples of q = (w, x, y, z).
    rows = np.empty((len(r), 4, 4))
    rows[:, 0, 0], rows[:, 0, 1:], rows[:, 1:, 0] = 1 + trace, odd, odd
    rows[:, 1:, 1:] = r + r.transpose(0, 2, 1)
    for i in range(3):
        rows[:, i + 1, i + 1] = 1 + 2 * diagonal[:, i] - trace
    largest = np.argmax(np.diagonal(rows, axis1=1, axis2=2), axis=1)
    q = rows[np.arange(len(r)), largest]
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    q *= np.where(q[:, :1] < 0, -1.0, 1.0)
    sine = np.linalg.norm(q[:, 1:], axis=1, keepdims=True)
    angle = 2 * np.arctan2(sine, q[:, :1])
    return q[:, 1:] * np.where(sine > 0, angle / np.where(sine > 0, sine, 1.0), 2.0)


def module_poses(centers: ArrayLike) -> Floats:
    """Return the poses (M, 4, 4), world from module, of pinholes at `centers` (M, 3), mm: columns u, v, k and the centre."""
    return affine_matrix(module_frames(centers).transpose(0, 2, 1), centers)


def affine_matrix(linear: Floats, translation: ArrayLike) -> Floats:
    """Return affine matrices (..., 4, 4) for column vectors from linear parts (..., 3, 3) and translations (..., 3)."""
    matrix = np.zeros((*linear.shape[:-2], 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = linear, translation, 1.0
    return matrix


def moved(affine: Floats, points: NDArray[np.floating | np.integer]) -> Floats:
    """Transform `points` (..., 3) by an `affine` matrix (4, 4) for column vectors."""
    return points @ affine[:3, :3].T + affine[:3, 3]


def euler_pose(
    phi: float = 0.0, theta: float = 0.0, psi: float = 0.0, translation: ArrayLike = (0.0, 0.0, 0.0)
) -> Floats:
    """Return the pose (4, 4), world from object, of a rotation by three Euler angles, rad, then a translation, mm.

    The object is turned by psi about its z axis, then by theta about world y, then by phi about world z.
    """
    angles = radians([phi, theta, psi], "Euler angles", (3,))
    rotation = np.eye(3)
    for axis, angle in zip((2, 1, 2), angles, strict=True):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[i, i] = turn[j, j] = math.cos(angle)  # math's, because the last digit of NumPy's depends on its version
        turn[j, i] = math.sin(angle)
        turn[i, j] = -turn[j, i]
        rotation = rotation @ turn
    return affine_matrix(rotation, real_array(translation, "translation", (3,)))


def checked_affine(affine: ArrayLike, name: str) -> Floats:
    """Return `affine` as an invertible float64 matrix (4, 4) for column vectors; raise `InputError` if it is none."""
    matrix = real_array(affine, name, (4, 4))
    if not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        raise InputError(f"{name}: expected 0 0 0 1 as the last row, got {' '.join(f'{x:g}' for x in matrix[3])}")
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    # The columns are scaled to unit length, so that a grid of small voxels is not taken for singular.
    if np.any(lengths == 0) or abs(np.linalg.det(matrix[:3, :3] / lengths)) < 1e-10:
        raise InputError(f"{name}: its three axes are not independent, so it cannot be inverted")
    return matrix
