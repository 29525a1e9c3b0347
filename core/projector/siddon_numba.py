"""Siddon's line integrals, compiled by numba: the default on a CPU.

A ray walks from voxel to voxel; nothing is stored or sorted. Sixteen neighbouring rays, a tile, walk side by side, each
variable being `lanes` of them. The walk is written once (`_trace`): a model adds what it begins with, what it does with
every segment and what it makes of the result, three functions. The same holds for the lattices: `_step` walks through that
of the volume, `_step_both` through those of the volume and of mu at the same time.

Geometry is set up in float64 and walked in float32, along the part of a ray that is inside the volume: an error is so 1e-7
of that part, however far the source. The kernels release the GIL, and the operator runs them on several threads; numba's
own threading layers are left alone (they do not always live well inside Blender).
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any

import numpy as np
from numba import njit, types
from numpy.typing import NDArray

from ..errors import InputError
from .compiling import compiled
from .lanes import (
    WIDTH,
    alike,
    f64,
    floor,
    gather,
    half_to_the,
    i32,
    is_double,
    largest,
    load,
    magnitude,
    maximum,
    minimum,
    multiply_add,
    numbered,
    put_aside,
    rint,
    root,
    scatter_add,
    store,
    take_back,
    where,
    whole,
    words,
    zeros_of,
)
from .rays import SNAP, Attenuation, IndexFan, Rays

Array = NDArray[Any]  # of float32 or float64; what the rays have, of float64

# Steps that a tile takes before the next has its turn. Tiles side by side then read the same part of the volume at about the
# same time, row after row, which is what a processor's memory is fast at; more steps cost that, fewer the changing of tiles.
_TURN = 12
# Tiles that take turns: their memory stays in the processor's.
_TILES = 64
# Every voxel's neighbour this many steps on is sent for. The other tiles' turns are enough time for it to come from memory;
# waiting for it would take as long as all the walking, for rays go from row to row as no processor foresees.
_AHEAD = 2 * _TURN

_NUMBERS = types.Array(types.float64, 2, "C")
_LINES = types.Array(types.float64, 2, "C", readonly=True)
_SINGLE, _DOUBLE = (
    types.void(read, _LINES, read, _LINES, _NUMBERS, written)
    for read, written in (
        (types.Array(number, 3, "C", readonly=True), types.Array(number, 3, "C"))
        for number in (types.float32, types.float64)
    )
)
_MOST_VOXELS = 2**31 - 1
_NEVER = 1e30  # alpha of a plane that is not there


def forward(volume: Array, rays: Rays, attenuation: Attenuation | None = None) -> Array:
    """Line integrals (N,), value x mm, of `volume` (n_x, n_y, n_z) along `rays`, attenuated towards their sources."""
    return _integrals(volume, _listed(rays), attenuation)[0, : len(rays)]


def adjoint(volume: Array, values: Array, rays: Rays, attenuation: Attenuation | None = None) -> None:
    """Add `values` (N,), each along its ray with the weights of `forward`, to `volume` in place."""
    kernels = _spread, _spread_attenuated, _spread_behind
    _run(kernels, volume, _listed(rays), attenuation, _padded(values), written=volume)


def derivatives(volume: Array, rays: Rays, attenuation: Attenuation | None = None) -> Array:
    """What the ends of `rays` do to their integrals (N, 7) or (N, 14), as `backends` describes it."""
    lines = _listed(rays)
    result = np.empty((7 if attenuation is None else 14, lines.shape[1]))
    if attenuation is not None:
        result[:1] = _integrals(volume, lines, attenuation)
    kernels = _differentiate, _differentiate_attenuated, _differentiate_behind
    _run(kernels, volume, lines, attenuation, result)
    return result[:, : len(rays)].T


def mu_gradient(gradient: Array, volume: Array, values: Array, rays: Rays, attenuation: Attenuation) -> None:
    """Add to `gradient`, of mu's shape, in place what mu's voxels do to the sum of `values` (N,) times the integrals."""
    lines = _listed(rays)
    numbers = np.concatenate([_padded(values), _integrals(volume, lines, attenuation)])
    _run((None, _weaken, _weaken_behind), volume, lines, attenuation, numbers, written=gradient)


def _integrals(volume: Array, lines: Array, attenuation: Attenuation | None) -> Array:
    """(1, N')."""
    integrals = np.empty((1, lines.shape[1]))
    _run((_integrate, _integrate_attenuated, _integrate_behind), volume, lines, attenuation, integrals)
    return integrals


def _run(
    kernels: tuple[Any, Any, Any],
    volume: Array,
    lines: Array,
    attenuation: Attenuation | None,
    numbers: Array,
    written: Array | None = None,
) -> None:
    """Run one of three kernels: for no attenuation, on the volume's lattice, and on one of its own.

    `numbers` (k, N') are what goes in or comes out for every ray, `written` the volume that is added to. Lanes are of
    float64 for volumes of float64, else of float32.
    """
    kernel, mu, mu_lines = kernels[0], volume, lines
    if attenuation is not None:
        mu, kernel = attenuation.mu, kernels[1]
        if attenuation.rays is not None:
            mu_lines, kernel = _listed(attenuation.rays), kernels[2]
    if max(volume.size, mu.size) > _MOST_VOXELS:
        raise InputError(
            f"numba: a volume of {max(volume.size, mu.size)} voxels, but its indices end at {_MOST_VOXELS}"
        )
    if written is None:
        written = np.empty((0, 0, 0), volume.dtype)
    signature = _DOUBLE if volume.dtype == np.float64 else _SINGLE
    compiled(kernel, signature)(volume, lines, mu, mu_lines, numbers, written)


# Rays in, as the kernels take them.


def _listed(rays: Rays) -> Array:
    """Rays as columns of (7, N'): start (3), direction (3), length; N' is N made a multiple of WIDTH by rays that miss."""
    n = len(rays)
    lines = np.empty((7, max(1, -(-n // WIDTH)) * WIDTH))
    if isinstance(rays, IndexFan):
        here, world = rays.fan, rays.world
        vectors = [here.source, here.corner, here.line_step, here.ray_step]
        vectors += [world.corner - world.source, world.line_step, world.ray_step]
        if len(here.shifts) == 1 and not here.shifts.any():
            compiled(_list_fan, types.void(_NUMBERS, types.intp, _NUMBERS))(np.stack(vectors), here.shape[1], lines)
        else:
            signature = types.void(_NUMBERS, _NUMBERS, types.intp, types.intp, _NUMBERS)
            compiled(_list_shifts, signature)(np.stack(vectors), np.array(here.shifts), *here.shape, lines)
    else:
        each = rays.listed()
        lines[:3, :n], lines[3:6, :n], lines[6, :n] = each.starts.T, each.directions.T, each.lengths
    lines[:, n:] = 0.0
    lines[:3, n:] = -1.0
    return lines


def _padded(values: Array) -> Array:
    """Values of rays (N,) as (1, N'), 0 for the rays that miss."""
    padded = np.zeros((1, max(1, -(-len(values) // WIDTH)) * WIDTH))
    padded[0, : len(values)] = values
    return padded


def _list_fan(fan, rays_of_a_line, lines):  # type: ignore[no-untyped-def]
    """`IndexFan.listed`, in lanes."""
    rows = lines.reshape(-1)
    n = lines.shape[1]
    for r in range(0, n, WIDTH):
        number = numbered() + f64(float(r))
        line = floor((number + f64(0.5)) / f64(float(rays_of_a_line)))
        ray = number - line * f64(float(rays_of_a_line))
        squared = f64(0.0)
        for axis in range(3):
            start = f64(fan[0, axis])
            end = multiply_add(ray, f64(fan[3, axis]), multiply_add(line, f64(fan[2, axis]), f64(fan[1, axis])))
            plane = rint(start)
            in_plane = (magnitude(start - plane) <= f64(SNAP)) & (magnitude(end - plane) <= f64(SNAP))
            start = where(in_plane, plane, start)
            direction = end - start
            direction = where(in_plane | (magnitude(direction) <= f64(SNAP)), f64(0.0), direction)
            store(rows, axis * n + r, start)
            store(rows, (3 + axis) * n + r, direction)
            along = multiply_add(ray, f64(fan[6, axis]), multiply_add(line, f64(fan[5, axis]), f64(fan[4, axis])))
            squared = multiply_add(along, along, squared)
        store(rows, 6 * n + r, root(squared))


def _list_shifts(fan, shifts, n_lines, rays_of_a_line, lines):  # type: ignore[no-untyped-def]
    """`IndexFan.listed` of a fan with shifts, ray by ray."""
    r = 0
    for s in range(len(shifts)):
        for i in range(n_lines):
            for j in range(rays_of_a_line):
                line, ray = i + shifts[s, 0], j + shifts[s, 1]
                squared = 0.0
                for axis in range(3):
                    start = fan[0, axis]
                    end = fan[1, axis] + line * fan[2, axis] + ray * fan[3, axis]
                    plane = np.rint(start)
                    if abs(start - plane) <= SNAP and abs(end - plane) <= SNAP:
                        start, direction = plane, 0.0
                    else:
                        direction = end - start
                        if abs(direction) <= SNAP:
                            direction = 0.0
                    lines[axis, r] = start
                    lines[3 + axis, r] = direction
                    along = fan[4, axis] + line * fan[5, axis] + ray * fan[6, axis]
                    squared += along * along
                lines[6, r] = np.sqrt(squared)
                r += 1


# The walk.


# What a kernel is given, arrays of voxels flat: the volume, its shape and the rays in its index space; the same of mu;
# numbers (k, N') of the rays, and the voxels that are added to.
_Data = namedtuple("_Data", "volume shape rays mu mu_shape mu_rays numbers written")


@njit(forceinline=True)
def _data(volume, rays, mu, mu_rays, numbers, written):  # type: ignore[no-untyped-def]
    return _Data(
        volume.reshape(-1), volume.shape, rays, mu.reshape(-1), mu.shape, mu_rays, numbers, written.reshape(-1)
    )


@njit(forceinline=True)
def _trace(data, begin, step, start, visit, finish):  # type: ignore[no-untyped-def]
    """Walk all rays: ``state = visit(data, segment, state)`` for their segments, tile by tile and turn by turn.

    begin(data, r) -> (way, measure, place, steps)
        What holds all along, in a measure of alpha that is 0 where the walk begins and about 1 where it ends; where that
        is, and how far, from source to target; the first place; how many steps take the tile to its end.
    step(way, place) -> (segment, place)
        The next segment: alpha of its two ends; of the volume's lattice the voxel's place (flat index, and what
        `_AHEAD` steps add to it), 1 inside and 0 outside, 1 for the axis (x, y, z) whose plane ends the segment, 1 if the
        lattice ends there; then these four of mu's.
    start(data, r, measure) -> state, finish(data, r, measure, state)
        The model's.
    """
    n_tiles = data.rays.shape[1] // WIDTH
    at_once = min(n_tiles, _TILES)
    steps = np.empty(at_once, np.int64)
    way, measure, place, _ = begin(data, 0)
    state = start(data, 0, measure)
    lasting, size, size_measure = words(way), words((way, place, state)), words(measure)
    memory = np.empty(at_once * size, np.float32)
    measures = np.empty(at_once * size_measure, np.float32)
    for first in range(0, n_tiles, at_once):
        some = min(at_once, n_tiles - first)
        for tile in range(some):
            way, measure, place, steps[tile] = begin(data, (first + tile) * WIDTH)
            put_aside(memory, tile * size, (way, place, start(data, (first + tile) * WIDTH, measure)))
            put_aside(measures, tile * size_measure, measure)
        for done in range(0, steps[:some].max(), _TURN):
            for tile in range(some):
                if steps[tile] > done:
                    way, place, state = take_back(memory, tile * size, (way, place, state))
                    for _ in range(min(_TURN, steps[tile] - done)):
                        segment, place = step(way, place)
                        state = visit(data, segment, state)
                    put_aside(memory, tile * size + lasting, (place, state))
        for tile in range(some):
            way, place, state = take_back(memory, tile * size, (way, place, state))
            finish(data, (first + tile) * WIDTH, take_back(measures, tile * size_measure, measure), state)


# The lattice of the volume alone; mu, if any, is on it too.


@njit(forceinline=True)
def _begin(data, r):  # type: ignore[no-untyped-def]
    """The way of a tile through the volume: (axes, ahead, end).

    A lattice's axes are, each for x, y and z: alpha of the first plane, from plane to plane, and what a plane adds to
    the voxel's flat index; ahead is what `_AHEAD` steps add to it.
    """
    shape, rays = data.shape, data.rays
    enter, leave = _clip(shape, rays, r)
    hits = enter < leave
    begin = where(hits, enter, f64(0.0))
    span = where(hits, leave - enter, f64(1.0))
    axes, ahead, p, stop, crossings = _axes(data.volume, shape, rays, r, hits, begin, begin, span)
    zero = zeros_of(data.volume)
    end = where(hits, minimum(alike(1.0, zero), stop), zero)
    measure = begin, _span(hits, span, end)
    return (axes, ahead, end), measure, ((zero, zero, zero), p, zero), largest(where(hits, crossings + i32(1), i32(0)))


@njit(forceinline=True)
def _span(hits, span, end):  # type: ignore[no-untyped-def]
    """What 1 in a tile's measure of alpha is from source to target, so that its end is where the ray leaves."""
    return where(hits, span / where(hits, alike(end, span), f64(1.0)), f64(0.0))


@njit(forceinline=True)
def _step(way, place):  # type: ignore[no-untyped-def]
    axes, ahead, end = way
    planes, p, alpha = place
    x, y, z = _next_planes(axes, planes)
    stop = minimum(minimum(x, y), minimum(z, end))
    crossed = x <= stop, y <= stop, z <= stop
    planes, following = _cross(axes, planes, p, crossed)
    here = (p, ahead), alike(1.0, alpha), _exclusive(crossed, alpha), _flag(stop >= end, alpha)
    return (alpha, stop, here, here), (planes, following, stop)


@njit(forceinline=True)
def _axes(volume, shape, rays, r, hits, enter, begin, span):  # type: ignore[no-untyped-def]
    """A tile's way through a lattice from `enter` on, in the measure that is 0 at `begin` and 1 after `span`.

    Returns its axes, what `_AHEAD` steps add to the voxel's flat index, that index on entering, alpha at which the walk
    has to stop to stay inside, and how many planes it crosses.
    """
    nx, ny, nz = shape
    x0, dx, gx, px, stop_x, to_cross_x = _axis(volume, nx, ny * nz, 0, rays, r, hits, enter, begin, span)
    y0, dy, gy, py, stop_y, to_cross_y = _axis(volume, ny, nz, 1, rays, r, hits, enter, begin, span)
    z0, dz, gz, pz, stop_z, to_cross_z = _axis(volume, nz, 1, 2, rays, r, hits, enter, begin, span)
    # A ray that misses stays in a voxel of its own: sixteen in one voxel would wait for one another in an adjoint.
    p = where(hits, px + py + pz, whole(minimum(numbered(), f64(nx * ny * nz - 1.0))))
    axes = (x0, y0, z0), (dx, dy, dz), (gx, gy, gz)
    crossings = to_cross_x + to_cross_y + to_cross_z
    share = f64(float(_AHEAD)) / maximum(crossings, f64(1.0))
    ahead = rint(to_cross_x * share) * alike(gx, share) + rint(to_cross_y * share) * alike(gy, share)
    ahead = whole(ahead + rint(to_cross_z * share) * alike(gz, share))
    return axes, ahead, p, minimum(minimum(stop_x, stop_y), stop_z), whole(crossings)


@njit(forceinline=True)
def _axis(volume, n, stride, axis, rays, r, hits, enter, begin, span):  # type: ignore[no-untyped-def]
    """One axis of `_axes`.

    Why a flat index never leaves the lattice: from the first voxel `room` planes can be crossed. Plane k, counted from
    0, is at fl(first + k step), which does not fall with k, for rounding keeps order; it is crossed only at an alpha of
    at most `stop`, and that is less than fl(first + room step). So k < room. The margin, some units in the last place of
    a number near 1 or above, covers that a processor may round the same expression once here and twice there.
    """
    start, direction = (
        load(rays.reshape(-1), axis * rays.shape[1] + r),
        load(rays.reshape(-1), (axis + 3) * rays.shape[1] + r),
    )
    zero, one = f64(0.0), f64(1.0)
    voxel = maximum(minimum(floor(multiply_add(enter, direction, start)), f64(n - 1.0)), zero)
    up, parallel = direction > zero, direction == zero
    inverse = one / where(parallel, one, direction)
    room = where(up, f64(n - 1.0) - voxel, voxel)
    first = ((where(up, voxel + one, voxel) - start) * inverse - begin) / span
    step = magnitude(inverse) / span
    crosses = hits & (magnitude(direction) > zero)
    to_cross = where(crosses, maximum(minimum(floor((one - first) / step) + one, room), zero), zero)
    first, step = where(crosses, first, f64(_NEVER)), where(crosses, step, zero)
    zero = zeros_of(volume)
    first, step, room = alike(first, zero), alike(step, zero), alike(room, zero)
    margin = 1 - 1e-15 if is_double(zero) else 1 - 3e-7
    stop = multiply_add(room, step, first) * alike(margin, zero)
    flat_step = whole(where(up, f64(float(stride)), f64(-float(stride))))
    return first, step, flat_step, whole(voxel * f64(float(stride))), stop, to_cross


@njit(forceinline=True)
def _clip(shape, rays, r):  # type: ignore[no-untyped-def]
    """Alpha, from source to target, where a tile's rays enter and leave a lattice; where one misses, enter >= leave."""
    enter, leave = f64(0.0), f64(1.0)
    for axis in range(3):
        first, last = _slab(shape, rays, r, axis)
        enter, leave = maximum(enter, first), minimum(leave, last)
    return enter, leave


@njit(forceinline=True)
def _slab(shape, rays, r, axis):  # type: ignore[no-untyped-def]
    """Alpha where the rays enter and leave the slab [0, n) of an axis."""
    n, rows = f64(float(shape[axis])), rays.reshape(-1)
    start, direction = load(rows, axis * rays.shape[1] + r), load(rows, (axis + 3) * rays.shape[1] + r)
    zero, never = f64(0.0), f64(_NEVER)
    parallel, within = direction == zero, (start >= zero) & (start < n)
    inverse = f64(1.0) / where(parallel, f64(1.0), direction)
    low, high = (zero - start) * inverse, (n - start) * inverse
    first = where(parallel, where(within, zero - never, never), minimum(low, high))
    last = where(parallel, where(within, never, zero - never), maximum(low, high))
    return first, last


@njit(forceinline=True)
def _next_planes(axes, planes):  # type: ignore[no-untyped-def]
    """Alpha of the next plane of each axis, made anew from the planes' numbers, so that rounding never piles up."""
    (x0, y0, z0), (dx, dy, dz), _ = axes
    kx, ky, kz = planes
    return multiply_add(kx, dx, x0), multiply_add(ky, dy, y0), multiply_add(kz, dz, z0)


@njit(forceinline=True)
def _cross(axes, planes, p, crossed):  # type: ignore[no-untyped-def]
    """Numbers of the next planes and flat index of the voxel behind the planes `crossed`."""
    _, _, (gx, gy, gz) = axes
    (kx, ky, kz), (x, y, z), one = planes, crossed, alike(1.0, planes[0])
    kx, ky, kz = where(x, kx + one, kx), where(y, ky + one, ky), where(z, kz + one, kz)
    p = where(x, p + gx, p)
    p = where(y, p + gy, p)
    return (kx, ky, kz), where(z, p + gz, p)


@njit(forceinline=True)
def _flag(mask, example):  # type: ignore[no-untyped-def]
    return where(mask, alike(1.0, example), alike(0.0, example))


@njit(forceinline=True)
def _exclusive(crossed, example):  # type: ignore[no-untyped-def]
    """1 for the axis crossed; at an edge, where it is several, for the first of them."""
    (x, y, z), zero = crossed, alike(0.0, example)
    return _flag(x, example), where(x, zero, _flag(y, example)), where(x | y, zero, _flag(z, example))


# The lattices of the volume and of mu, each its own.


@njit(forceinline=True)
def _begin_both(data, r):  # type: ignore[no-untyped-def]
    """`_begin` through the volume's lattice and mu's: from where either begins to where the volume's ends."""
    shape, rays, mu_shape, mu_rays = data.shape, data.rays, data.mu_shape, data.mu_rays
    enter, leave = _clip(shape, rays, r)
    mu_enter, mu_leave = _clip(mu_shape, mu_rays, r)
    hits = enter < leave
    hits_mu = hits & (mu_enter < mu_leave) & (mu_enter < leave)
    enter, mu_enter = where(hits, enter, f64(0.0)), where(hits_mu, mu_enter, f64(0.0))
    begin = where(hits_mu, minimum(enter, mu_enter), enter)
    span = where(hits, leave - begin, f64(1.0))
    axes, ahead, p, stop, crossings = _axes(data.volume, shape, rays, r, hits, enter, begin, span)
    mu_axes, mu_ahead, q, mu_stop, mu_crossings = _axes(data.mu, mu_shape, mu_rays, r, hits_mu, mu_enter, begin, span)
    zero = zeros_of(data.volume)
    entry = alike((enter - begin) / span, zero)
    mu_entry = where(hits_mu, alike((mu_enter - begin) / span, zero), alike(_NEVER, zero))
    end = where(hits, minimum(alike(1.0, zero), stop), zero)
    mu_end = where(hits_mu, minimum(alike((mu_leave - begin) / span, zero), mu_stop), zero)
    way, measure = (axes, ahead, entry, end, mu_axes, mu_ahead, mu_entry, mu_end), (begin, _span(hits, span, end))
    place = ((zero, zero, zero), p, (zero, zero, zero), q, zero)
    # The ways in and out are steps too.
    return way, measure, place, largest(where(hits, crossings + mu_crossings + i32(4), i32(0)))


@njit(forceinline=True)
def _step_both(way, place):  # type: ignore[no-untyped-def]
    axes, ahead, entry, end, mu_axes, mu_ahead, mu_entry, mu_end = way
    planes, p, mu_planes, q, alpha = place
    x, y, z = _next_planes(axes, planes)
    mu_x, mu_y, mu_z = _next_planes(mu_axes, mu_planes)
    inside, inside_mu = alpha >= entry, (alpha >= mu_entry) & (alpha < mu_end)
    stop = where(inside, minimum(minimum(x, y), z), entry)
    mu_stop = minimum(minimum(mu_x, mu_y), minimum(mu_z, mu_end))
    mu_stop = where(inside_mu, mu_stop, where(alpha < mu_entry, mu_entry, alike(_NEVER, alpha)))
    # Not back: entering, a plane may by rounding lie a hair behind.
    stop = maximum(minimum(minimum(stop, mu_stop), end), alpha)
    crossed = (x <= stop) & inside, (y <= stop) & inside, (z <= stop) & inside
    mu_crossed = (mu_x <= stop) & inside_mu, (mu_y <= stop) & inside_mu, (mu_z <= stop) & inside_mu
    planes, p_behind = _cross(axes, planes, p, crossed)
    mu_planes, q_behind = _cross(mu_axes, mu_planes, q, mu_crossed)
    of_volume = (p, ahead), _flag(inside, alpha), _exclusive(crossed, alpha), _flag(stop >= end, alpha)
    ends_mu = (stop >= mu_end) & inside_mu
    of_mu = (q, mu_ahead), _flag(inside_mu, alpha), _exclusive(mu_crossed, alpha), _flag(ends_mu, alpha)
    return (alpha, stop, of_volume, of_mu), (planes, p_behind, mu_planes, q_behind, stop)


# Plain: every segment counts its length.


def _integrate(volume, rays, mu, mu_rays, numbers, written):  # type: ignore[no-untyped-def]
    data = _data(volume, rays, mu, mu_rays, numbers, written)
    _trace(data, _begin, _step, _start_sum, _add_up, _finish_sum)


def _spread(volume, rays, mu, mu_rays, numbers, written):  # type: ignore[no-untyped-def]
    data = _data(volume, rays, mu, mu_rays, numbers, written)
    _trace(data, _begin, _step, _start_value, _add_to, _finish_nothing)


@njit(forceinline=True)
def _start_sum(data, r, measure):  # type: ignore[no-untyped-def]
    return (zeros_of(data.volume),)


@njit(forceinline=True)
def _add_up(data, segment, state):  # type: ignore[no-untyped-def]
    alpha, stop, (p, _, _, _), _ = segment
    return (multiply_add(stop - alpha, gather(data.volume, p), state[0]),)


@njit(forceinline=True)
def _finish_sum(data, r, measure, state):  # type: ignore[no-untyped-def]
    reach = _reach(data, r, measure)
    store(data.numbers.reshape(-1), r, alike(state[0], reach) * reach)


@njit(forceinline=True)
def _reach(data, r, measure):  # type: ignore[no-untyped-def]
    """Length in mm of the way that alpha measures."""
    rays = data.rays
    return measure[1] * load(rays.reshape(-1), 6 * rays.shape[1] + r)


@njit(forceinline=True)
def _start_value(data, r, measure):  # type: ignore[no-untyped-def]
    return (alike(load(data.numbers.reshape(-1), r) * _reach(data, r, measure), zeros_of(data.volume)),)


@njit(forceinline=True)
def _add_to(data, segment, state):  # type: ignore[no-untyped-def]
    alpha, stop, (p, _, _, _), _ = segment
    scatter_add(data.written, p, (stop - alpha) * state[0])
    return state


@njit(forceinline=True)
def _finish_nothing(data, r, measure, state):  # type: ignore[no-untyped-def]
    pass


# Derivatives: every plane crossed counts its jump.


def _differentiate(volume, rays, mu, mu_rays, numbers, written):  # type: ignore[no-untyped-def]
    """The integral moves with the planes crossed: each by the jump of the value there, times what alpha does.

    A plane at k is crossed at ``alpha = (k - s)/d``, d = t - s, so ``d alpha/ds = (alpha - 1)/d`` and ``d alpha/dt
    = -alpha/d``. What is needed of an axis is therefore the sum of its jumps and that of its jumps times alpha. The
    jumps are summed by segments: each gives its value at its end and takes it away at its beginning.
    """
    data = _data(volume, rays, mu, mu_rays, numbers, written)
    _trace(data, _begin, _step, _start_jumps, _add_jumps, _finish_jumps)


@njit(forceinline=True)
def _start_jumps(data, r, measure):  # type: ignore[no-untyped-def]
    zero = zeros_of(data.volume)
    first, last = _ends(data.shape, data.rays, r, zero)
    none = zero, zero, zero
    return zero, first, last, none, none


@njit(forceinline=True)
def _add_jumps(data, segment, state):  # type: ignore[no-untyped-def]
    alpha, stop, (p, _, sides, at_end), _ = segment
    total, before, last, jumps, moments = state
    value = gather(data.volume, p)
    behind = _behind(sides, at_end, last)
    jumps = _add(jumps, behind, before, value, value)
    moments = _add(moments, behind, before, stop * value, alpha * value)
    return multiply_add(stop - alpha, value, total), behind, last, jumps, moments


@njit(forceinline=True)
def _behind(sides, at_end, last):  # type: ignore[no-untyped-def]
    """1 for the axis of the plane at a segment's end: of the plane crossed or, at the lattice's end, of its face."""
    return (
        multiply_add(at_end, last[0], sides[0]),
        multiply_add(at_end, last[1], sides[1]),
        multiply_add(at_end, last[2], sides[2]),
    )


@njit(forceinline=True)
def _add(sums, behind, before, gained, lost):  # type: ignore[no-untyped-def]
    """To the sums of x, y and z: `gained` for the plane behind a segment, less `lost` for that before it."""
    return (
        multiply_add(behind[0], gained, sums[0]) - before[0] * lost,
        multiply_add(behind[1], gained, sums[1]) - before[1] * lost,
        multiply_add(behind[2], gained, sums[2]) - before[2] * lost,
    )


@njit(forceinline=True)
def _finish_jumps(data, r, measure, state):  # type: ignore[no-untyped-def]
    total, _, _, jumps, moments = state
    rows, n = data.numbers.reshape(-1), data.numbers.shape[1]
    store(rows, r, alike(total, measure[1]) * measure[1])
    _store_by_ends(rows, r, n, 1, measure, data.rays, jumps, moments)


@njit(forceinline=True)
def _store_by_ends(rows, r, n, row, measure, rays, jumps, moments):  # type: ignore[no-untyped-def]
    """Derivatives by the rays' starts, rows `row` to `row` + 2, and ends, the next three."""
    begin, span = measure
    _store_by_ends_of_axis(rows, r, n, row, begin, span, rays, jumps[0], moments[0])
    _store_by_ends_of_axis(rows, r, n, row + 1, begin, span, rays, jumps[1], moments[1])
    _store_by_ends_of_axis(rows, r, n, row + 2, begin, span, rays, jumps[2], moments[2])


@njit(forceinline=True)
def _store_by_ends_of_axis(rows, r, n, row, begin, span, rays, jumps, moments):  # type: ignore[no-untyped-def]
    axis = (row - 1) % 3
    direction = load(rays.reshape(-1), (axis + 3) * rays.shape[1] + r)
    parallel = direction == f64(0.0)
    inverse = where(parallel, f64(0.0), f64(1.0) / where(parallel, f64(1.0), direction))
    # From the walk's measure of alpha to that from source to target.
    jumps = alike(jumps, span)
    moments = multiply_add(alike(moments, span), span, jumps * begin)
    store(rows, row * n + r, (moments - jumps) * inverse)
    store(rows, (row + 3) * n + r, (f64(0.0) - moments) * inverse)


@njit(forceinline=True)
def _ends(shape, rays, r, zero):  # type: ignore[no-untyped-def]
    """1 for the axis of the face by which rays enter a lattice, and by which they leave; 0 where they end inside or miss."""
    in_x, out_x = _slab(shape, rays, r, 0)
    in_y, out_y = _slab(shape, rays, r, 1)
    in_z, out_z = _slab(shape, rays, r, 2)
    enter = maximum(maximum(in_x, in_y), maximum(in_z, f64(0.0)))
    leave = minimum(minimum(out_x, out_y), minimum(out_z, f64(1.0)))
    hits = enter < leave
    comes, goes = hits & (enter > f64(0.0)), hits & (leave < f64(1.0))
    first = comes & (in_x == enter), comes & (in_y == enter), comes & (in_z == enter)
    last = goes & (out_x == leave), goes & (out_y == leave), goes & (out_z == leave)
    return _exclusive(first, zero), _exclusive(last, zero)


# Attenuated: the ray carries what is left of it.


def _integrate_attenuated(volume, rays, mu, mu_rays, numbers, written):  # type: ignore[no-untyped-def]
    data = _data(volume, rays, mu, mu_rays, numbers, written)
    _trace(data, _begin, _step, _start_attenuated, _add_up_attenuated, _finish_sum)


def _integrate_behind(volume, rays, mu, mu_rays, numbers, written):  # type: ignore[no-untyped-def]
    data = _data(volume, rays, mu, mu_rays, numbers, written)
    _trace(data, _begin_both, _step_both, _start_attenuated, _add_up_attenuated, _finish_sum)


def _spread_attenuated(volume, rays, mu, mu_rays, numbers, written):  # type: ignore[no-untyped-def]
    data = _data(volume, rays, mu, mu_rays, numbers, written)
    _trace(data, _begin, _step, _start_value_attenuated, _add_to_attenuated, _finish_nothing)


def _spread_behind(volume, rays, mu, mu_rays, numbers, written):  # type: ignore[no-untyped-def]
    data = _data(volume, rays, mu, mu_rays, numbers, written)
    _trace(data, _begin_both, _step_both, _start_value_attenuated, _add_to_attenuated, _finish_nothing)


@njit(forceinline=True)
def _start_attenuated(data, r, measure):  # type: ignore[no-untyped-def]
    zero = zeros_of(data.volume)
    return zero, alike(1.0, zero), alike(_reach(data, r, measure), zero)


@njit(forceinline=True)
def _add_up_attenuated(data, segment, state):  # type: ignore[no-untyped-def]
    p, inside = segment[2][0], segment[2][1]
    total, left, reach = state
    seen, left, _ = _weakened(data, segment, left, reach)
    return multiply_add(seen * inside, gather(data.volume, p), total), left, reach


@njit(forceinline=True)
def _start_value_attenuated(data, r, measure):  # type: ignore[no-untyped-def]
    reach, zero = _reach(data, r, measure), zeros_of(data.volume)
    return alike(load(data.numbers.reshape(-1), r) * reach, zero), alike(1.0, zero), alike(reach, zero)


@njit(forceinline=True)
def _add_to_attenuated(data, segment, state):  # type: ignore[no-untyped-def]
    p, inside = segment[2][0], segment[2][1]
    value, left, reach = state
    seen, left, _ = _weakened(data, segment, left, reach)
    scatter_add(data.written, p, seen * inside * value)
    return value, left, reach


@njit(forceinline=True)
def _weakened(data, segment, left, reach):  # type: ignore[no-untyped-def]
    """Through a segment: the integral of what is left of the ray, what is left behind it, and its mu times its length."""
    alpha, stop, _, (q, inside_mu, _, _) = segment
    length = stop - alpha
    depth = gather(data.mu, q) * inside_mu * length * reach
    gone, mean = _absorbed(depth)
    return length * left * mean, left - left * gone, depth


@njit(forceinline=True)
def _absorbed(depth):  # type: ignore[no-untyped-def]
    """1 - exp(-depth), and that by `depth`, the mean of exp(-t) for t from 0 to `depth`; depth >= 0.

    exp(-depth) = 2^-n exp(-rest), with `rest` of at most ln(2)/2 in size, of which Taylor's series gives 1 - exp(-rest) to
    1e-7 of itself, however small.
    """
    one = alike(1.0, depth)
    terms = 14 if is_double(depth) else 7
    n = whole(multiply_add(minimum(depth, alike(80.0, depth)), alike(1.4426950408889634, depth), alike(0.5, depth)))
    halvings = alike(n, depth)
    rest = multiply_add(halvings, alike(-0.693359375, depth), minimum(depth, alike(80.0, depth)))
    rest = multiply_add(
        halvings, alike(2.1219444005469058e-4, depth), rest
    )  # ln(2) in two parts, the first of few bits
    series = one
    for k in range(terms, 1, -1):
        series = multiply_add(rest * series, alike(-1.0 / k, depth), one)
    scale = half_to_the(n, depth)
    gone = multiply_add(rest * series, scale, one - scale)
    return gone, where(depth > alike(1e-20, depth), gone / depth, one)


@njit(forceinline=True)
def _lag(depth, gone, mean):  # type: ignore[no-untyped-def]
    """Integral of t exp(-t) for t from 0 to `depth`, by depth squared: 1/2 at 0."""
    one = alike(1.0, depth)
    terms = 14 if is_double(depth) else 6
    series = one
    for k in range(terms, 0, -1):
        series = multiply_add(depth * series, alike(-(k + 1.0) / (k * (k + 2.0)), depth), one)
    small = depth < alike(0.3, depth)
    return where(small, series * alike(0.5, depth), (mean - one + gone) / where(small, one, depth))


# What mu's voxels do: each weakens what is behind it, and what is in it.


def _weaken(volume, rays, mu, mu_rays, numbers, written):  # type: ignore[no-untyped-def]
    data = _data(volume, rays, mu, mu_rays, numbers, written)
    _trace(data, _begin, _step, _start_weakening, _add_weakening, _finish_nothing)


def _weaken_behind(volume, rays, mu, mu_rays, numbers, written):  # type: ignore[no-untyped-def]
    data = _data(volume, rays, mu, mu_rays, numbers, written)
    _trace(data, _begin_both, _step_both, _start_weakening, _add_weakening, _finish_nothing)


@njit(forceinline=True)
def _start_weakening(data, r, measure):  # type: ignore[no-untyped-def]
    rows, n, zero = data.numbers.reshape(-1), data.numbers.shape[1], zeros_of(data.volume)
    value, behind = alike(load(rows, r), zero), alike(load(rows, n + r), zero)
    return value, behind, alike(1.0, zero), alike(_reach(data, r, measure), zero)


@njit(forceinline=True)
def _add_weakening(data, segment, state):  # type: ignore[no-untyped-def]
    alpha, stop, (p, inside, _, _), (q, inside_mu, _, _) = segment
    value, behind, left, reach = state
    length = (stop - alpha) * reach
    activity = gather(data.volume, p) * inside
    seen, left_behind, depth = _weakened(data, segment, left, reach)
    gone, mean = _absorbed(depth)
    behind = behind - seen * reach * activity
    within = activity * left * length * _lag(depth, gone, mean)
    scatter_add(data.written, q, alike(-1.0, value) * value * inside_mu * length * (behind + within))
    return value, behind, left_behind, reach


# Derivatives of attenuated integrals: the planes of both lattices count.


def _differentiate_attenuated(volume, rays, mu, mu_rays, numbers, written):  # type: ignore[no-untyped-def]
    """Row 0 of `numbers` holds the line integrals. Moving a plane of mu's changes all that is behind it."""
    data = _data(volume, rays, mu, mu_rays, numbers, written)
    _trace(data, _begin, _step, _start_jumps_of_both, _add_jumps_of_both, _finish_jumps_of_both)


def _differentiate_behind(volume, rays, mu, mu_rays, numbers, written):  # type: ignore[no-untyped-def]
    data = _data(volume, rays, mu, mu_rays, numbers, written)
    _trace(data, _begin_both, _step_both, _start_jumps_of_both, _add_jumps_of_both, _finish_jumps_of_both)


@njit(forceinline=True)
def _start_jumps_of_both(data, r, measure):  # type: ignore[no-untyped-def]
    zero = zeros_of(data.volume)
    none = zero, zero, zero
    reach = _reach(data, r, measure)
    some = reach > f64(0.0)
    behind = where(some, load(data.numbers.reshape(-1), r) / where(some, reach, f64(1.0)), f64(0.0))
    first, last = _ends(data.shape, data.rays, r, zero)
    mu_first, mu_last = _ends(data.mu_shape, data.mu_rays, r, zero)
    ray = alike(1.0, zero), zero, alike(behind, zero), alike(reach, zero)
    return ray, (first, last, none, none), (mu_first, mu_last, none, none), zero


@njit(forceinline=True)
def _add_jumps_of_both(data, segment, state):  # type: ignore[no-untyped-def]
    alpha, stop, (p, inside, sides, at_end), (q, inside_mu, mu_sides, mu_at_end) = segment
    (left, passed, behind, reach), (before, last, jumps, moments), of_mu, by_length = state
    mu_before, mu_last, mu_jumps, mu_moments = of_mu
    activity, mu = gather(data.volume, p) * inside, gather(data.mu, q) * inside_mu
    seen, left_behind, depth = _weakened(data, segment, left, reach)
    gone, mean = _absorbed(depth)
    still_behind = behind - seen * activity

    sides = _behind(sides, at_end, last)
    jumps = _add(jumps, sides, before, activity * left_behind, activity * left)
    moments = _add(moments, sides, before, activity * left_behind * stop, activity * left * alpha)
    mu_sides = _behind(mu_sides, mu_at_end, mu_last)
    mu_jumps = _add(mu_jumps, mu_sides, mu_before, mu * still_behind, mu * behind)
    mu_moments = _add(mu_moments, mu_sides, mu_before, mu * still_behind * stop, mu * behind * alpha)
    # Each lattice's way in counts with the first segment inside.
    before, mu_before = _chosen(inside, sides, before), _chosen(inside_mu, mu_sides, mu_before)

    weight = multiply_add(passed, mean, depth * _lag(depth, gone, mean))
    by_length = multiply_add(activity * left * (stop - alpha), weight, by_length)
    ray = left_behind, passed + depth, still_behind, reach
    return ray, (before, last, jumps, moments), (mu_before, mu_last, mu_jumps, mu_moments), by_length


@njit(forceinline=True)
def _chosen(flag, given, otherwise):  # type: ignore[no-untyped-def]
    chosen = flag > alike(0.5, flag)
    return (
        where(chosen, given[0], otherwise[0]),
        where(chosen, given[1], otherwise[1]),
        where(chosen, given[2], otherwise[2]),
    )


@njit(forceinline=True)
def _finish_jumps_of_both(data, r, measure, state):  # type: ignore[no-untyped-def]
    (_, _, _, reach), (_, _, jumps, moments), (_, _, mu_jumps, mu_moments), by_length = state
    rows, n, rays, mu_rays = data.numbers.reshape(-1), data.numbers.shape[1], data.rays, data.mu_rays
    length = load(rays.reshape(-1), 6 * rays.shape[1] + r)
    some = length > f64(0.0)
    per_mm = where(some, f64(1.0) / where(some, length, f64(1.0)), f64(0.0))
    store(rows, r, load(rows, r) * per_mm)
    _store_by_ends(rows, r, n, 1, measure, rays, jumps, moments)
    weaker = alike(-1.0, reach) * reach
    mu_jumps = weaker * mu_jumps[0], weaker * mu_jumps[1], weaker * mu_jumps[2]
    mu_moments = weaker * mu_moments[0], weaker * mu_moments[1], weaker * mu_moments[2]
    _store_by_ends(rows, r, n, 7, measure, mu_rays, mu_jumps, mu_moments)
    store(rows, 13 * n + r, f64(-1.0) * alike(by_length, per_mm) * measure[1] * per_mm)
