"""Siddon's line integrals, compiled by numba: the default on a CPU.

A ray walks from voxel to voxel; nothing is stored or sorted. The walk is written once (`_walk`); what is done
with each segment is a function handed to it. The kernels release the GIL, so the operator runs them on
several threads; numba's own threading layers are left alone (they do not always live well inside Blender).
"""

from __future__ import annotations

from math import floor, inf
from typing import Any

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from .compiling import compiled
from .rays import IndexRays

_READ_F32 = types.Array(types.float32, 3, "C", readonly=True)
_READ_F64_1D = types.Array(types.float64, 1, "C", readonly=True)
_READ_F64_2D = types.Array(types.float64, 2, "C", readonly=True)
_RAYS = (_READ_F64_2D, _READ_F64_2D, _READ_F64_1D)


def forward(volume: NDArray[np.float32], rays: IndexRays) -> NDArray[np.float32]:
    """Line integrals (N,), value x mm, of `volume` (n_x, n_y, n_z) along `rays`."""
    integrals = np.empty(len(rays), dtype=np.float32)
    _forward_kernel()(volume, *_contiguous(rays), integrals)
    return integrals


def adjoint(volume: NDArray[np.float32], values: NDArray[np.float32], rays: IndexRays) -> None:
    """Add `values` (N,), each along its ray with the weights of `forward`, to `volume` in place."""
    _adjoint_kernel()(volume, *_contiguous(rays), np.ascontiguousarray(values))


def _contiguous(rays: IndexRays) -> tuple[NDArray[np.float64], ...]:
    return tuple(np.ascontiguousarray(a) for a in (rays.starts, rays.directions, rays.lengths))


def _forward_kernel() -> Any:
    return compiled(_integrate, types.void(_READ_F32, *_RAYS, types.float32[::1]))


def _adjoint_kernel() -> Any:
    values = types.Array(types.float32, 1, "C", readonly=True)
    return compiled(_spread, types.void(types.float32[:, :, ::1], *_RAYS, values))


def _integrate(volume, starts, directions, lengths, integrals):  # type: ignore[no-untyped-def]
    voxels = volume.reshape(-1)
    for r in range(len(lengths)):
        integrals[r] = lengths[r] * _walk(voxels, volume.shape, starts[r], directions[r], _add_up, 0.0)


def _spread(volume, starts, directions, lengths, values):  # type: ignore[no-untyped-def]
    voxels = volume.reshape(-1)
    for r in range(len(lengths)):
        _walk(voxels, volume.shape, starts[r], directions[r], _add_to, lengths[r] * values[r])


@njit(forceinline=True)
def _add_up(voxels, p, weight, total):  # type: ignore[no-untyped-def]
    return total + weight * voxels[p]


@njit(forceinline=True)
def _add_to(voxels, p, weight, value):  # type: ignore[no-untyped-def]
    voxels[p] += weight * value
    return value


@njit(forceinline=True)
def _clip(n, s, d, enter, leave):  # type: ignore[no-untyped-def]
    """The part of [enter, leave] in which ``s + alpha d`` is inside [0, n): one axis of the slab method."""
    if d == 0.0:
        return (enter, leave) if 0.0 <= s < n else (1.0, 0.0)
    inv = 1.0 / d
    first, last = (0.0 - s) * inv, (n - s) * inv
    if d < 0.0:
        first, last = last, first
    return max(enter, first), min(leave, last)


@njit(forceinline=True)
def _axis(n, stride, s, d, alpha):  # type: ignore[no-untyped-def]
    """Start of the walk along one axis: offset of the voxel, next plane, plane step, 1 / d, index step."""
    i = min(max(floor(s + alpha * d), 0), n - 1)
    if d > 0.0:
        return i * stride, i + 1.0, 1.0, 1.0 / d, stride
    if d < 0.0:
        return i * stride, i + 0.0, -1.0, 1.0 / d, -stride
    return i * stride, inf, 0.0, 1.0, 0  # the next plane is never reached


@njit(forceinline=True)
def _walk(voxels, shape, start, direction, visit, state):  # type: ignore[no-untyped-def]
    """``state = visit(voxels, p, d_alpha, state)`` for every segment of a ray, p its voxel's flat index, in order.

    Why p never leaves the volume. Along an axis with d > 0 the next plane is k = i + 1, at alpha(k) = fl(fl(k
    - s) / d), recomputed from the whole number k each time and never added up. Rounding keeps order, so
    alpha(k) does not fall with k; and `leave` is at most alpha(n), computed by the very same expression in
    `_clip`. A step is taken only when alpha(k) < leave <= alpha(n), hence k < n, and the voxel entered, k, is
    in 0..n-1. With d < 0 the next plane is k = i, a step needs alpha(k) < leave <= alpha(0), hence k > 0, and
    the voxel entered is k - 1 >= 0. The first voxel is clamped. This holds for IEEE arithmetic: no fastmath
    here, which might compute the two sides differently.

    Rounding may put the first voxel one off, or a plane a hair before the last one: then a segment of some
    1e-16 is missed or negative, and the sum of the segments is still `leave - enter`.
    """
    nx, ny, nz = shape
    sx, sy, sz = start[0], start[1], start[2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    alpha, leave = _clip(nx, sx, dx, 0.0, 1.0)
    alpha, leave = _clip(ny, sy, dy, alpha, leave)
    alpha, leave = _clip(nz, sz, dz, alpha, leave)
    if alpha >= leave:
        return state

    px, kx, step_x, inv_x, stride_x = _axis(nx, ny * nz, sx, dx, alpha)
    py, ky, step_y, inv_y, stride_y = _axis(ny, nz, sy, dy, alpha)
    pz, kz, step_z, inv_z, stride_z = _axis(nz, 1, sz, dz, alpha)
    p = px + py + pz
    ax, ay, az = (kx - sx) * inv_x, (ky - sy) * inv_y, (kz - sz) * inv_z
    while True:
        crossing = min(ax, ay, az)
        if crossing >= leave:
            return visit(voxels, np.uint64(p), leave - alpha, state)
        state = visit(voxels, np.uint64(p), crossing - alpha, state)
        alpha = crossing
        if ax == crossing:
            kx += step_x
            p += stride_x
            ax = (kx - sx) * inv_x
        elif ay == crossing:
            ky += step_y
            p += stride_y
            ay = (ky - sy) * inv_y
        else:
            kz += step_z
            p += stride_z
            az = (kz - sz) * inv_z
