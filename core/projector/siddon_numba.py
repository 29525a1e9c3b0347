"""Siddon's line integrals, compiled by numba: the default on a CPU.

A ray walks from voxel to voxel; nothing is stored or sorted. The walk is written once (`_walk`); what is done
with each segment is a function handed to it. The kernels release the GIL, so the operator runs them on
several threads; numba's own threading layers are left alone (they do not always live well inside Blender).
"""

from __future__ import annotations

from math import expm1, floor, inf
from typing import Any

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from .compiling import compiled
from .rays import Attenuation, IndexFan, IndexFans, IndexRays

_READ_F32 = types.Array(types.float32, 3, "C", readonly=True)
_READ_F64_1D = types.Array(types.float64, 1, "C", readonly=True)
_READ_F64_2D = types.Array(types.float64, 2, "C", readonly=True)
_READ_F32_1D = types.Array(types.float32, 1, "C", readonly=True)
_LINES = (_READ_F64_2D, _READ_F64_2D)
_RAYS = (*_LINES, _READ_F64_1D)
_F32 = types.float32[:, :, ::1]
_F64_1D = types.float64[::1]
_F64_2D = types.float64[:, ::1]


def forward(
    volume: NDArray[np.float32], rays: IndexRays | IndexFan, attenuation: Attenuation | None = None
) -> NDArray[np.float64]:
    """Line integrals (N,), value x mm, of `volume` (n_x, n_y, n_z) along `rays`, attenuated towards their sources."""
    integrals = np.empty(len(rays))
    if attenuation is None:
        _forward_kernel()(volume, *_contiguous(rays), integrals)
    elif attenuation.rays is None:
        kernel = compiled(_integrate_attenuated, types.void(_READ_F32, *_RAYS, _READ_F32, _F64_1D))
        kernel(volume, *_contiguous(rays), attenuation.mu, integrals)
    else:
        kernel = compiled(_integrate_behind, types.void(_READ_F32, *_RAYS, _READ_F32, *_LINES, _F64_1D))
        kernel(volume, *_contiguous(rays), attenuation.mu, *_contiguous(attenuation.rays)[:2], integrals)
    return integrals


def adjoint(
    volume: NDArray[np.float32],
    values: NDArray[np.float32],
    rays: IndexRays | IndexFan,
    attenuation: Attenuation | None = None,
) -> None:
    """Add `values` (N,), each along its ray with the weights of `forward`, to `volume` in place."""
    values = np.ascontiguousarray(values)
    if attenuation is None:
        compiled(_spread, types.void(_F32, *_RAYS, _READ_F32_1D))(volume, *_contiguous(rays), values)
    elif attenuation.rays is None:
        kernel = compiled(_spread_attenuated, types.void(_F32, *_RAYS, _READ_F32, _READ_F32_1D))
        kernel(volume, *_contiguous(rays), attenuation.mu, values)
    else:
        kernel = compiled(_spread_behind, types.void(_F32, *_RAYS, _READ_F32, *_LINES, _READ_F32_1D))
        kernel(volume, *_contiguous(rays), attenuation.mu, *_contiguous(attenuation.rays)[:2], values)


def derivatives(volume: NDArray[np.float32], rays: IndexRays | IndexFan) -> NDArray[np.float64]:
    """What the ends of `rays` do to their integrals (N, 7), as `backends` describes it."""
    result = np.empty((len(rays), 7))
    kernel = compiled(_differentiate, types.void(_READ_F32, *_LINES, _F64_2D))
    kernel(volume, *_contiguous(rays)[:2], result)
    return result


def _forward_kernel() -> Any:
    return compiled(_integrate, types.void(_READ_F32, *_RAYS, _F64_1D))


def _contiguous(rays: IndexRays | IndexFan | IndexFans) -> tuple[NDArray[np.float64], ...]:
    rays = rays.listed()
    return tuple(np.ascontiguousarray(a) for a in (rays.starts, rays.directions, rays.lengths))


# Plain: every segment counts its length.


def _integrate(volume, starts, directions, lengths, integrals):  # type: ignore[no-untyped-def]
    voxels = volume.reshape(-1)
    for r in range(len(lengths)):
        integrals[r] = lengths[r] * _walk(voxels, volume.shape, starts[r], directions[r], _add_up, 0.0)


def _spread(volume, starts, directions, lengths, values):  # type: ignore[no-untyped-def]
    voxels = volume.reshape(-1)
    for r in range(len(lengths)):
        _walk(voxels, volume.shape, starts[r], directions[r], _add_to, lengths[r] * values[r])


@njit(forceinline=True)
def _add_up(voxels, p, alpha, end, total):  # type: ignore[no-untyped-def]
    return total + (end - alpha) * voxels[p]


@njit(forceinline=True)
def _add_to(voxels, p, alpha, end, value):  # type: ignore[no-untyped-def]
    voxels[p] += (end - alpha) * value
    return value


# Derivatives: every plane crossed counts its jump.


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
        leave, first, last = _ends(volume.shape, start, direction)
        data = (voxels, stride_x, stride_y, first)
        state = (np.int64(-1), 0.0, 0.0, none, none, none)
        _, value, total, x, y, z = _walk(data, volume.shape, start, direction, _add_jump, state)
        x, y, z = _jump(x, y, z, last, value, leave)
        result[r, 0] = total
        for axis, (jumps, moments) in enumerate((x, y, z)):
            inv = 1.0 / direction[axis] if direction[axis] != 0.0 else 0.0
            result[r, 1 + axis] = (moments - jumps) * inv
            result[r, 4 + axis] = -moments * inv


@njit(forceinline=True)
def _ends(shape, start, direction):  # type: ignore[no-untyped-def]
    """Alpha where a ray leaves the volume, and the axes of the planes of its entry and exit: 3 if it has none."""
    enter, leave, first, last = 0.0, 1.0, 3, 3
    for axis in range(3):
        later, earlier = _clip(shape[axis], start[axis], direction[axis], enter, leave)
        first, last = axis if later > enter else first, axis if earlier < leave else last
        enter, leave = later, earlier
    return leave, first, last


@njit(forceinline=True)
def _add_jump(data, p, alpha, end, state):  # type: ignore[no-untyped-def]
    voxels, stride_x, stride_y, first = data
    p_before, before, total, x, y, z = state
    here, value = np.int64(p), np.float64(voxels[p])
    step = abs(here - p_before)
    if p_before < 0:
        axis = first
    elif step == stride_x:
        axis = 0
    else:
        axis = 1 if step == stride_y else 2
    x, y, z = _jump(x, y, z, axis, before - value, alpha)
    return here, value, total + (end - alpha) * value, x, y, z


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


# Attenuated, mu on the volume's lattice: the ray carries what is left of it.


def _integrate_attenuated(volume, starts, directions, lengths, mu, integrals):  # type: ignore[no-untyped-def]
    voxels, mu_voxels = volume.reshape(-1), mu.reshape(-1)
    for r in range(len(lengths)):
        data = (voxels, mu_voxels, lengths[r])
        total, _ = _walk(data, volume.shape, starts[r], directions[r], _add_up_attenuated, (0.0, 1.0))
        integrals[r] = lengths[r] * total


def _spread_attenuated(volume, starts, directions, lengths, mu, values):  # type: ignore[no-untyped-def]
    voxels, mu_voxels = volume.reshape(-1), mu.reshape(-1)
    for r in range(len(lengths)):
        data = (voxels, mu_voxels, lengths[r])
        state = (lengths[r] * values[r], 1.0)
        _walk(data, volume.shape, starts[r], directions[r], _add_to_attenuated, state)


@njit(forceinline=True)
def _add_up_attenuated(data, p, alpha, end, state):  # type: ignore[no-untyped-def]
    voxels, mu, length = data
    total, left = state
    seen, left = _pass(mu[p] * length, end - alpha, left)
    return total + seen * voxels[p], left


@njit(forceinline=True)
def _add_to_attenuated(data, p, alpha, end, state):  # type: ignore[no-untyped-def]
    voxels, mu, length = data
    value, left = state
    seen, left = _pass(mu[p] * length, end - alpha, left)
    voxels[p] += seen * value
    return value, left


@njit(forceinline=True)
def _pass(mu, step, left):  # type: ignore[no-untyped-def]
    """Through a segment of length `step`: the integral of what is left of the ray, and what is left behind it.

    With t = mu step the integral is left * step * (1 - exp(-t)) / t. A voxel's t is small: the fraction's series,
    cut where its terms fall below 1e-9.
    """
    t = mu * step
    series = 1 - t * (1 / 2 - t * (1 / 6 - t * (1 / 24 - t * (1 / 120 - t * (1 / 720)))))
    mean = series if t < 0.1 else -expm1(-t) / t
    return left * step * mean, left * (1 - t * mean)


# Attenuated, mu on a lattice of its own: within each of the volume's segments the ray walks on through mu's.


def _integrate_behind(  # type: ignore[no-untyped-def]
    volume, starts, directions, lengths, mu, mu_starts, mu_directions, integrals
):
    voxels, mu_voxels = volume.reshape(-1), mu.reshape(-1)
    for r in range(len(lengths)):
        line, place = _enter(mu.shape, mu_starts[r], mu_directions[r])
        data = (voxels, mu_voxels, lengths[r], line)
        total, _, _, _ = _walk(data, volume.shape, starts[r], directions[r], _add_up_behind, (0.0, 1.0, 0.0, place))
        integrals[r] = lengths[r] * total


def _spread_behind(  # type: ignore[no-untyped-def]
    volume, starts, directions, lengths, mu, mu_starts, mu_directions, values
):
    voxels, mu_voxels = volume.reshape(-1), mu.reshape(-1)
    for r in range(len(lengths)):
        line, place = _enter(mu.shape, mu_starts[r], mu_directions[r])
        data = (voxels, mu_voxels, lengths[r], line)
        state = (lengths[r] * values[r], 1.0, 0.0, place)
        _walk(data, volume.shape, starts[r], directions[r], _add_to_behind, state)


@njit(forceinline=True)
def _add_up_behind(data, p, alpha, end, state):  # type: ignore[no-untyped-def]
    voxels, mu, length, line = data
    total, left, done, place = state
    _, left, place = _pass_on(mu, length, line, left, done, alpha, place)  # before the first segment
    seen, left, place = _pass_on(mu, length, line, left, alpha, end, place)
    return total + seen * voxels[p], left, end, place


@njit(forceinline=True)
def _add_to_behind(data, p, alpha, end, state):  # type: ignore[no-untyped-def]
    voxels, mu, length, line = data
    value, left, done, place = state
    _, left, place = _pass_on(mu, length, line, left, done, alpha, place)
    seen, left, place = _pass_on(mu, length, line, left, alpha, end, place)
    voxels[p] += seen * value
    return value, left, end, place


@njit
def _pass_on(mu, length, line, left, alpha, end, place):  # type: ignore[no-untyped-def]
    """From `alpha` to `end` through mu's lattice: `_pass` for all of its segments between, and the place at `end`."""
    enter, leave = line[0], line[1]
    seen = 0.0
    if alpha < enter:  # not there yet, or never
        before = min(enter, end)
        seen, left = _pass(0.0, before - alpha, left)
        alpha = before
    while alpha < end:
        crossing = _crossing(place)
        if alpha >= leave:
            part, left = _pass(0.0, end - alpha, left)
            return seen + part, left, place
        stop = min(crossing, leave, end)
        part, left = _pass(mu[np.uint64(place[0])] * length, stop - alpha, left)
        seen += part
        alpha = stop
        if crossing == stop and crossing < leave:
            place = _next(line, place)
    return seen, left, place


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
def _enter(shape, start, direction):  # type: ignore[no-untyped-def]
    """A ray's way into a lattice: its line there, and its place on entering.

    The line is (enter, leave, and for each axis: start, 1 / d, plane step, index step); a ray that misses has enter =
    inf. The place is (flat index of the voxel, and for each axis: next plane, alpha of that).
    """
    nx, ny, nz = shape
    sx, sy, sz = start[0], start[1], start[2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    enter, leave = _clip(nx, sx, dx, 0.0, 1.0)
    enter, leave = _clip(ny, sy, dy, enter, leave)
    enter, leave = _clip(nz, sz, dz, enter, leave)
    if enter >= leave:
        enter = inf
    inside = 0.0 if enter == inf else enter

    px, kx, step_x, inv_x, stride_x = _axis(nx, ny * nz, sx, dx, inside)
    py, ky, step_y, inv_y, stride_y = _axis(ny, nz, sy, dy, inside)
    pz, kz, step_z, inv_z, stride_z = _axis(nz, 1, sz, dz, inside)
    line = (enter, leave, sx, inv_x, step_x, stride_x, sy, inv_y, step_y, stride_y, sz, inv_z, step_z, stride_z)
    return line, (px + py + pz, kx, (kx - sx) * inv_x, ky, (ky - sy) * inv_y, kz, (kz - sz) * inv_z)


@njit(forceinline=True)
def _crossing(place):  # type: ignore[no-untyped-def]
    """Alpha of the next plane."""
    return min(place[2], place[4], place[6])


@njit(forceinline=True)
def _next(line, place):  # type: ignore[no-untyped-def]
    """The place behind the next plane."""
    _, _, sx, inv_x, step_x, stride_x, sy, inv_y, step_y, stride_y, sz, inv_z, step_z, stride_z = line
    p, kx, ax, ky, ay, kz, az = place
    crossing = min(ax, ay, az)
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
    return p, kx, ax, ky, ay, kz, az


@njit(forceinline=True)
def _walk(data, shape, start, direction, visit, state):  # type: ignore[no-untyped-def]
    """``state = visit(data, p, alpha, end, state)`` for every segment of a ray, p its voxel's flat index, in order.

    Why p never leaves the volume. Along an axis with d > 0 the next plane is k = i + 1, at alpha(k) = fl(fl(k
    - s) / d), recomputed from the whole number k each time and never added up. Rounding keeps order, so
    alpha(k) does not fall with k; and `leave` is at most alpha(n), computed by the very same expression in
    `_clip`. A step (`_next`) is taken only when alpha(k) < leave <= alpha(n), hence k < n, and the voxel entered, k, is
    in 0..n-1. With d < 0 the next plane is k = i, a step needs alpha(k) < leave <= alpha(0), hence k > 0, and
    the voxel entered is k - 1 >= 0. The first voxel is clamped. This holds for IEEE arithmetic: no fastmath
    here, which might compute the two sides differently.

    Rounding may put the first voxel one off, or a plane a hair before the last one: then a segment of some
    1e-16 is missed or negative, and the sum of the segments is still `leave - enter`.
    """
    line, place = _enter(shape, start, direction)
    alpha, leave = line[0], line[1]
    if alpha == inf:
        return state
    while True:
        crossing = _crossing(place)
        if crossing >= leave:
            return visit(data, np.uint64(place[0]), alpha, leave, state)
        state = visit(data, np.uint64(place[0]), alpha, crossing, state)
        alpha = crossing
        place = _next(line, place)
