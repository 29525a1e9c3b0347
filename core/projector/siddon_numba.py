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


def forward(volume: NDArray[np.float32], rays: IndexRays) -> NDArray[np.float64]:
    """Line integrals (N,), value x mm, of `volume` (n_x, n_y, n_z) along `rays`."""
    integrals = np.empty(len(rays))
    _forward_kernel()(volume, *_contiguous(rays), integrals)
    return integrals


def adjoint(volume: NDArray[np.float32], values: NDArray[np.float32], rays: IndexRays) -> None:
    """Add `values` (N,), each along its ray with the weights of `forward`, to `volume` in place."""
    _adjoint_kernel()(volume, *_contiguous(rays), np.ascontiguousarray(values))


def derivatives(volume: NDArray[np.float32], rays: IndexRays) -> NDArray[np.float64]:
    """What the ends of `rays` do to their integrals (N, 7), as `backends` describes it."""
    result = np.empty((len(rays), 7))
    starts, directions, _ = _contiguous(rays)
    _derivatives_kernel()(volume, starts, directions, result)
    return result


def _contiguous(rays: IndexRays) -> tuple[NDArray[np.float64], ...]:
    return tuple(np.ascontiguousarray(a) for a in (rays.starts, rays.directions, rays.lengths))


def _forward_kernel() -> Any:
    return compiled(_integrate, types.void(_READ_F32, *_RAYS, types.float64[::1]))


def _adjoint_kernel() -> Any:
    values = types.Array(types.float32, 1, "C", readonly=True)
    return compiled(_spread, types.void(types.float32[:, :, ::1], *_RAYS, values))


def _derivatives_kernel() -> Any:
    return compiled(_differentiate, types.void(_READ_F32, _READ_F64_2D, _READ_F64_2D, types.float64[:, ::1]))


def _integrate(volume, starts, directions, lengths, integrals):  # type: ignore[no-untyped-def]
    voxels = volume.reshape(-1)
    for r in range(len(lengths)):
        integrals[r] = lengths[r] * _walk(voxels, volume.shape, starts[r], directions[r], _add_up, 0.0)


def _spread(volume, starts, directions, lengths, values):  # type: ignore[no-untyped-def]
    voxels = volume.reshape(-1)
    for r in range(len(lengths)):
        _walk(voxels, volume.shape, starts[r], directions[r], _add_to, lengths[r] * values[r])


def _differentiate(volume, starts, directions, result):  # type: ignore[no-untyped-def]
    """The integral moves with the planes crossed: each by the jump of the value there, times what alpha does.

    A plane at k is crossed at ``alpha = (k - s)/d``, d = t - s, so ``d alpha/ds = (alpha - 1)/d`` and ``d alpha/dt
    = -alpha/d``. What is needed of an axis is therefore the sum of its jumps and that of its jumps times alpha.
    """
    voxels = volume.reshape(-1)
    nx, ny, nz = volume.shape
    # A step in the flat index tells the axis crossed; an axis of one voxel is not crossed on the way.
    stride_x, stride_y = ny * nz if nx > 1 else 0, nz if ny > 1 else 0
    none = (0.0, 0.0)
    for r in range(len(starts)):
        start, direction = starts[r], directions[r]
        enter, leave, first, last = _ends(volume.shape, start, direction)
        state = ((stride_x, stride_y, first), np.int64(-1), 0.0, enter, 0.0, none, none, none)
        _, _, value, _, total, x, y, z = _walk(voxels, volume.shape, start, direction, _add_jump, state)
        x, y, z = _jump(x, y, z, last, value, leave)
        result[r, 0] = total
        for axis, (jumps, moments) in enumerate((x, y, z)):
            inv = 1.0 / direction[axis] if direction[axis] != 0.0 else 0.0
            result[r, 1 + axis] = (moments - jumps) * inv
            result[r, 4 + axis] = -moments * inv


@njit(forceinline=True)
def _ends(shape, start, direction):  # type: ignore[no-untyped-def]
    """Alpha where a ray enters and leaves the volume, and the axes of the planes there: 3 where it starts or ends inside."""
    enter, leave, first, last = 0.0, 1.0, 3, 3
    for axis in range(3):
        later, earlier = _clip(shape[axis], start[axis], direction[axis], enter, leave)
        first, last = axis if later > enter else first, axis if earlier < leave else last
        enter, leave = later, earlier
    return enter, leave, first, last


@njit(forceinline=True)
def _add_jump(voxels, p, weight, state):  # type: ignore[no-untyped-def]
    (stride_x, stride_y, first), p_before, before, alpha, total, x, y, z = state
    here, value = np.int64(p), np.float64(voxels[p])
    step = abs(here - p_before)
    if p_before < 0:
        axis = first
    elif step == stride_x:
        axis = 0
    else:
        axis = 1 if step == stride_y else 2
    x, y, z = _jump(x, y, z, axis, before - value, alpha)
    return (stride_x, stride_y, first), here, value, alpha + weight, total + weight * value, x, y, z


@njit(forceinline=True)
def _jump(x, y, z, axis, jump, alpha):  # type: ignore[no-untyped-def]
    """Add a jump to its axis: to the sum of the jumps, and to that of the jumps times alpha."""
    if axis == 0:
        return (x[0] + jump, x[1] + jump * alpha), y, z
    if axis == 1:
        return x, (y[0] + jump, y[1] + jump * alpha), z
    if axis == 2:
        return x, y, (z[0] + jump, z[1] + jump * alpha)
    return x, y, z


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
