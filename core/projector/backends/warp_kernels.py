# mypy: disable-error-code="no-untyped-def, valid-type"
# ruff: noqa: UP018, RUF046 -- to Warp 0.0 is a constant and float(0.0) a variable
"""Kernels of the "cuda" backend, for NVIDIA Warp: one thread a ray, in one launch the rays of several fans.

A ray walks from voxel to voxel; nothing is stored or sorted. The walk is written once (`_enter`, `_crossing`, `_pass`);
each kernel does something else with its segments. What is added up along a ray is float32, what sets the walk up float64.

Where a ray is: `alpha` runs here from 0 where it enters the volume to 1 where it leaves, not from its source to its
target, and is counted in whole numbers, 2^30 to 1. Of each axis the alpha of the next plane is kept with 32 bits more
(62 to 1); a step adds the gap between planes, without rounding. Both come from float64. So a segment errs by 1e-9 of the
ray's way inside, however far the source and however short the way, where float32 would err by some 1e-7: a hundred times
as much, and too much for one voxel of hundreds. It costs an addition of 64 bits where float32 takes a multiplication.

Why an index never leaves its lattice. The first voxel is clamped into it. An axis is stepped only when its next plane
lies before the end of the walk (`_pass`), and as soon as the voxel is the lattice's last one that way, the next plane is
`_FAR`, behind the end: an axis takes at most `planes` steps, which lead to the last voxel. Nothing of this is rounded, so
it holds whatever the compiler makes of it. Gaps are not negative, so no segment is, and the segments add up to the way
inside. Nothing overflows: a plane is crossed at less than 1, a gap is at most 1 (a plane farther off is not reached).

No kernel is differentiated by Warp: the gradients are written out, like everything else.
"""

# Warp reads the annotations: they must be its types, not strings.

from typing import Any

import warp as wp

# Without grid-stride loops the kernels need some 60 to 130 registers instead of 100 to 255.
wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

_SNAP = wp.constant(wp.float64(1e-9))  # as `rays` has it
_ONE = wp.constant(wp.float64(2.0**62))
_FAR = wp.constant(wp.int64(2**63 - 1))
_UNIT = wp.constant(2.0**-30)
_NO_AXIS = wp.constant(3)

_vec3l: Any = wp.types.vector(length=3, dtype=wp.int64)

_Volume: Any = wp.array3d(dtype=wp.float32)
_Numbers: Any = wp.array3d(dtype=wp.float32)  # one for a ray: fan, line, ray
_Rows: Any = wp.array4d(dtype=wp.float32)  # some for a ray
_Fans: Any = wp.array2d(dtype=wp.vec3d)
"""For each fan its source, corner, line step and ray step, in index space and then in world mm."""


@wp.struct
class Chord:
    """The part of a ray inside a lattice, and the axes of the planes at its ends: `_NO_AXIS` where the ray itself ends."""

    enter: wp.float64
    leave: wp.float64
    first: wp.int32
    last: wp.int32


@wp.struct
class Walk:
    """A ray's way through a lattice: where it is, and its next planes."""

    alpha: wp.int32
    leave: wp.int32
    voxel: wp.vec3i
    step: wp.vec3i  # 1, -1 or 0
    planes: wp.vec3i  # to cross at most: as many as voxels lie ahead in the lattice
    next: _vec3l  # alpha of the next plane of each axis, with 32 bits more
    gap: _vec3l  # between planes
    axis: wp.int32  # of the plane crossed last
    last: wp.int32


@wp.struct
class Beam:
    """A ray on its way through the volume and what attenuates it, and the segment that it is about to pass.

    Its `volume` walk goes from 0 to 1; the walk through mu's lattice, needed where that is another (`apart`), counts
    alpha the same, and begins and ends somewhere between.
    """

    volume: Walk
    mu: Walk
    apart: wp.int32
    chord: wp.float32  # way inside the volume, mm
    depth: wp.float32  # integral of mu from the source on, and its summation's rest
    rest: wp.float32
    end: wp.int32  # of the segment, and its length
    size: wp.float32
    mu_here: wp.float32
    t: wp.float32  # integral of mu over the segment
    left: wp.float32  # of the ray, before the segment
    seen: wp.float32  # integral over the segment of what is left


@wp.func
def _snapped(s: wp.float64, e: wp.float64):
    """Start and direction along one axis; see `rays._snapped`."""
    plane = wp.rint(s)
    d = e - s
    if wp.abs(s - plane) <= _SNAP and wp.abs(e - plane) <= _SNAP:
        s = plane
        d = wp.float64(0.0)
    if wp.abs(d) <= _SNAP:
        d = wp.float64(0.0)
    return s, d


@wp.func
def _ray(fans: _Fans, fan: int, line: int, ray: int):
    """Start and direction of a ray in index space."""
    s = fans[fan, 0]
    e = fans[fan, 1] + fans[fan, 2] * wp.float64(line) + fans[fan, 3] * wp.float64(ray)
    sx, dx = _snapped(s[0], e[0])
    sy, dy = _snapped(s[1], e[1])
    sz, dz = _snapped(s[2], e[2])
    return wp.vec3d(sx, sy, sz), wp.vec3d(dx, dy, dz)


@wp.func
def _length(fans: _Fans, fan: int, line: int, ray: int):
    """Length of a ray, mm."""
    target = fans[fan, 5] + fans[fan, 6] * wp.float64(line) + fans[fan, 7] * wp.float64(ray)
    return wp.length(target - fans[fan, 4])


@wp.func
def _shape(volume: _Volume):
    return wp.vec3i(volume.shape[0], volume.shape[1], volume.shape[2])


@wp.func
def _clip(chord: Chord, axis: int, n: int, s: wp.float64, d: wp.float64):
    """The part of `chord` in which ``s + alpha d`` is inside [0, n): one axis of the slab method."""
    if d == wp.float64(0.0):
        if s < wp.float64(0.0) or s >= wp.float64(n):
            chord.leave = wp.float64(-1.0)
        return chord
    low = -s / d
    high = (wp.float64(n) - s) / d
    # A plane where the part ends counts (a part may end at another lattice's plane), but none where the ray itself ends.
    if wp.min(low, high) >= chord.enter and wp.min(low, high) > wp.float64(0.0):
        chord.enter = wp.min(low, high)
        chord.first = axis
    if wp.max(low, high) <= chord.leave and wp.max(low, high) < wp.float64(1.0):
        chord.leave = wp.max(low, high)
        chord.last = axis
    return chord


@wp.func
def _chord(shape: wp.vec3i, start: wp.vec3d, direction: wp.vec3d, low: wp.float64, high: wp.float64):
    """The part of a ray from `low` to `high` (of its way from source to target) inside a lattice."""
    chord = Chord()
    chord.enter = low
    chord.leave = high
    chord.first = _NO_AXIS
    chord.last = _NO_AXIS
    chord = _clip(chord, 0, shape[0], start[0], direction[0])
    chord = _clip(chord, 1, shape[1], start[1], direction[1])
    chord = _clip(chord, 2, shape[2], start[2], direction[2])
    return chord


@wp.func
def _voxel(shape: wp.vec3i, point: wp.vec3d):
    """The voxel in which a point lies, or the one nearest to it."""
    voxel = wp.vec3i()
    for axis in range(3):
        last = wp.float64(shape[axis] - 1)
        voxel[axis] = wp.int32(wp.clamp(wp.floor(point[axis]), wp.float64(0.0), last))
    return voxel


@wp.func
def _axis(n: int, voxel: int, s: wp.float64, d: wp.float64, enter: wp.float64, origin: wp.float64, scale: wp.float64):
    """Start of a walk along one axis: step, planes ahead, alpha of the next, gap between them."""
    step = int(0)
    plane = int(0)
    planes = int(0)
    if d > wp.float64(0.0):
        step = 1
        plane = voxel + 1
        planes = n - 1 - voxel
    elif d < wp.float64(0.0):
        step = -1
        plane = voxel
        planes = voxel
    next = _FAR
    gap = wp.int64(0)
    if planes > 0:
        first = ((wp.float64(plane) - s) / d - origin) * scale
        next = wp.int64(wp.clamp(first, (enter - origin) * scale, wp.float64(1.0)) * _ONE)
        gap = wp.int64(wp.min(wp.abs(scale / d), wp.float64(1.0)) * _ONE)
    return step, planes, next, gap


@wp.func
def _enter(
    chord: Chord,
    voxel: wp.vec3i,
    shape: wp.vec3i,
    start: wp.vec3d,
    direction: wp.vec3d,
    origin: wp.float64,
    scale: wp.float64,
):
    """A walk along `chord` from `voxel` on, where alpha is ``(alpha from source to target - origin) scale``.

    A miss is at its end.
    """
    w = Walk()
    if chord.enter >= chord.leave:
        return w  # from 0 to 0
    enter = chord.enter
    step_x, planes_x, next_x, gap_x = _axis(shape[0], voxel[0], start[0], direction[0], enter, origin, scale)
    step_y, planes_y, next_y, gap_y = _axis(shape[1], voxel[1], start[1], direction[1], enter, origin, scale)
    step_z, planes_z, next_z, gap_z = _axis(shape[2], voxel[2], start[2], direction[2], enter, origin, scale)
    w.voxel = voxel
    w.step = wp.vec3i(step_x, step_y, step_z)
    w.planes = wp.vec3i(planes_x, planes_y, planes_z)
    w.next = _vec3l(next_x, next_y, next_z)
    w.gap = _vec3l(gap_x, gap_y, gap_z)
    w.alpha = _upper(wp.int64(wp.clamp((chord.enter - origin) * scale, wp.float64(0.0), wp.float64(1.0)) * _ONE))
    w.leave = _upper(wp.int64(wp.clamp((chord.leave - origin) * scale, wp.float64(0.0), wp.float64(1.0)) * _ONE))
    w.axis = chord.first
    w.last = chord.last
    return w


@wp.func
def _upper(alpha: wp.int64):
    """An alpha without its 32 more bits."""
    return wp.int32(alpha >> wp.int64(32))


@wp.func
def _through(shape: wp.vec3i, start: wp.vec3d, direction: wp.vec3d, low: wp.float64, high: wp.float64):
    """The walk through a lattice from `low` to `high`, its alpha from 0 to 1, and the part of the ray inside."""
    chord = _chord(shape, start, direction, low, high)
    if chord.enter >= chord.leave:
        chord.leave = chord.enter
        return Walk(), chord
    voxel = _voxel(shape, start + direction * chord.enter)
    scale = wp.float64(1.0) / (chord.leave - chord.enter)
    return _enter(chord, voxel, shape, start, direction, chord.enter, scale), chord


@wp.func
def _crossing(w: Walk):
    """Alpha at which the walk comes to its next plane, or to its end."""
    return wp.min(wp.min(_upper(w.next[0]), _upper(w.next[1])), wp.min(_upper(w.next[2]), w.leave))


@wp.func
def _step(w: Walk, axis: int):
    """Cross the next plane of an axis."""
    w.axis = axis
    w.voxel[axis] = w.voxel[axis] + w.step[axis]
    w.planes[axis] = w.planes[axis] - 1
    w.next[axis] = wp.where(w.planes[axis] > 0, w.next[axis] + w.gap[axis], _FAR)
    return w


@wp.func
def _pass(w: Walk, end: int):
    """Walk on to `end`, at most the next crossing, and cross the plane that is there."""
    w.alpha = end
    if end >= w.leave:
        w.axis = w.last
    elif _upper(w.next[0]) <= end:
        w = _step(w, 0)
    elif _upper(w.next[1]) <= end:
        w = _step(w, 1)
    elif _upper(w.next[2]) <= end:
        w = _step(w, 2)
    return w


@wp.func
def _number(alpha: int):
    """An alpha, or a part of it, as a number."""
    return float(alpha) * _UNIT


@wp.func
def _plus(total: float, rest: float, x: float):
    """``total + x``, and what rounding took from it so far (Kahan): a ray may have thousands of segments."""
    y = x - rest
    result = total + y
    return result, (result - total) - y


@wp.func
def _on(axis: int):
    """1 for the axis, 0 for the others; all 0 for `_NO_AXIS`."""
    return wp.vec3f(float(axis == 0), float(axis == 1), float(axis == 2))


# Plain: every segment counts its length.


@wp.kernel
def integrate(volume: _Volume, fans: _Fans, first_line: int, integrals: _Numbers):
    """Line integrals, value x mm."""
    f, i, j = wp.tid()
    start, direction = _ray(fans, f, first_line + i, j)
    w, chord = _through(_shape(volume), start, direction, wp.float64(0.0), wp.float64(1.0))
    total = float(0.0)
    rest = float(0.0)
    while w.alpha < w.leave:
        end = _crossing(w)
        total, rest = _plus(total, rest, _number(end - w.alpha) * volume[w.voxel[0], w.voxel[1], w.voxel[2]])
        w = _pass(w, end)
    integrals[f, i, j] = total * wp.float32(_length(fans, f, first_line + i, j) * (chord.leave - chord.enter))


@wp.kernel
def spread(volume: _Volume, fans: _Fans, first_line: int, values: _Numbers):
    """The adjoint of `integrate`."""
    f, i, j = wp.tid()
    start, direction = _ray(fans, f, first_line + i, j)
    w, chord = _through(_shape(volume), start, direction, wp.float64(0.0), wp.float64(1.0))
    value = values[f, i, j] * wp.float32(_length(fans, f, first_line + i, j) * (chord.leave - chord.enter))
    while w.alpha < w.leave:
        end = _crossing(w)
        wp.atomic_add(volume, w.voxel[0], w.voxel[1], w.voxel[2], _number(end - w.alpha) * value)
        w = _pass(w, end)


# Derivatives by the ends: every plane crossed counts its jump, times what its alpha does. The plane at k is crossed at
# alpha = (k - s)/d (from source to target), d = t - s, so d alpha/ds = (alpha - 1)/d and d alpha/dt = -alpha/d: what is
# needed of an axis are the sum of its jumps and that of its jumps times alpha.


@wp.func
def _write_ends(
    rows: _Rows, f: int, i: int, j: int, column: int, direction: wp.vec3d, jumps: wp.vec3d, moments: wp.vec3d
):
    """Write the derivatives by start and end into six columns."""
    for axis in range(3):
        by_start = wp.float64(0.0)
        by_end = wp.float64(0.0)
        if direction[axis] != wp.float64(0.0):
            by_start = (moments[axis] - jumps[axis]) / direction[axis]
            by_end = -moments[axis] / direction[axis]
        rows[f, i, j, column + axis] = wp.float32(by_start)
        rows[f, i, j, column + 3 + axis] = wp.float32(by_end)


@wp.func
def _moments(chord: Chord, jumps: wp.vec3f, moments: wp.vec3f):
    """The sum of jumps times alpha, alpha from source to target, of those with alpha along `chord`."""
    return wp.vec3d(jumps) * chord.enter + wp.vec3d(moments) * (chord.leave - chord.enter)


@wp.kernel
def differentiate(volume: _Volume, fans: _Fans, first_line: int, rows: _Rows):
    """Columns: the integral over alpha from 0 to 1, its derivatives by the start (3) and by the end (3)."""
    f, i, j = wp.tid()
    start, direction = _ray(fans, f, first_line + i, j)
    w, chord = _through(_shape(volume), start, direction, wp.float64(0.0), wp.float64(1.0))
    total = float(0.0)
    rest = float(0.0)
    before = float(0.0)
    jumps = wp.vec3f()
    moments = wp.vec3f()
    while w.alpha < w.leave:
        value = volume[w.voxel[0], w.voxel[1], w.voxel[2]]
        jump = _on(w.axis) * (before - value)
        jumps += jump
        moments += jump * _number(w.alpha)
        before = value
        end = _crossing(w)
        total, rest = _plus(total, rest, _number(end - w.alpha) * value)
        w = _pass(w, end)
    jump = _on(w.axis) * before
    jumps += jump
    moments += jump * _number(w.alpha)
    rows[f, i, j, 0] = total * wp.float32(chord.leave - chord.enter)
    _write_ends(rows, f, i, j, 1, direction, wp.vec3d(jumps), _moments(chord, jumps, moments))


# Attenuated: the ray carries what is left of it. Where mu has a lattice of its own, the planes of both cut the ray.


@wp.func
def _mean_transmission(t: float):
    """Mean of ``exp(-x)`` for x from 0 to t, (1 - exp(-t)) / t: for a small t its series, cut below 1e-8."""
    if wp.abs(t) < 0.1:
        return 1.0 - t * (1.0 / 2.0 - t * (1.0 / 6.0 - t * (1.0 / 24.0 - t * (1.0 / 120.0 - t * (1.0 / 720.0)))))
    return (1.0 - wp.exp(-t)) / t


@wp.func
def _first_moment(t: float):
    """Integral of ``u exp(-t u)`` for u from 0 to 1, (1 - (1 + t) exp(-t)) / t^2: for a small t its series."""
    if wp.abs(t) < 0.3:
        series = 1.0 / 30.0 - t * (1.0 / 144.0 - t * (1.0 / 840.0 - t * (1.0 / 5760.0)))
        return 1.0 / 2.0 - t * (1.0 / 3.0 - t * (1.0 / 8.0 - t * series))
    return (1.0 - (1.0 + t) * wp.exp(-t)) / (t * t)


@wp.func
def _before(mu: _Volume, start: wp.vec3d, direction: wp.vec3d, high: wp.float64):
    """Integral of mu over alpha, from source to target, from the source to `high`; and the walk and part inside."""
    w, chord = _through(_shape(mu), start, direction, wp.float64(0.0), high)
    total = float(0.0)
    rest = float(0.0)
    while w.alpha < w.leave:
        end = _crossing(w)
        total, rest = _plus(total, rest, _number(end - w.alpha) * mu[w.voxel[0], w.voxel[1], w.voxel[2]])
        w = _pass(w, end)
    return total * wp.float32(chord.leave - chord.enter), w, chord


@wp.func
def _open(shape: wp.vec3i, mu: _Volume, fans: _Fans, mu_fans: _Fans, apart: int, f: int, line: int, ray: int):
    """A ray where it enters the volume, and its part inside."""
    beam = Beam()
    start, direction = _ray(fans, f, line, ray)
    w, chord = _through(shape, start, direction, wp.float64(0.0), wp.float64(1.0))
    length = _length(fans, f, line, ray)
    beam.volume = w
    beam.apart = apart
    beam.chord = wp.float32(length * (chord.leave - chord.enter))
    if apart != 0 and w.alpha < w.leave:
        start, direction = _ray(mu_fans, f, line, ray)
        depth, ahead, way = _before(mu, start, direction, chord.enter)
        beam.depth = wp.float32(length) * depth
        within = _chord(_shape(mu), start, direction, chord.enter, chord.leave)
        # The walk goes on from where it is: at a plane that is just there, rounding must not cross it twice or never.
        voxel = _voxel(_shape(mu), start + direction * within.enter)
        if way.leave > way.enter:
            voxel = ahead.voxel
        scale = wp.float64(1.0) / (chord.leave - chord.enter)
        beam.mu = _enter(within, voxel, _shape(mu), start, direction, chord.enter, scale)
    return beam, chord


@wp.func
def _look(beam: Beam, mu: _Volume):
    """The next segment, up to the next plane of either lattice."""
    alpha = beam.volume.alpha
    beam.end = _crossing(beam.volume)
    beam.mu_here = 0.0
    if beam.apart == 0:
        beam.mu_here = mu[beam.volume.voxel[0], beam.volume.voxel[1], beam.volume.voxel[2]]
    elif alpha < beam.mu.alpha:  # not there yet
        beam.end = wp.min(beam.end, beam.mu.alpha)
    elif alpha < beam.mu.leave:
        beam.end = wp.min(beam.end, _crossing(beam.mu))
        beam.mu_here = mu[beam.mu.voxel[0], beam.mu.voxel[1], beam.mu.voxel[2]]
    beam.size = _number(beam.end - alpha)
    beam.t = beam.mu_here * beam.chord * beam.size
    beam.left = wp.exp(-beam.depth)
    beam.seen = beam.left * beam.size * _mean_transmission(beam.t)
    return beam


@wp.func
def _move(beam: Beam):
    """Behind the segment."""
    depth, rest = _plus(beam.depth, beam.rest, beam.t)
    beam.depth = depth
    beam.rest = rest
    if beam.apart != 0 and beam.mu.alpha <= beam.volume.alpha and beam.volume.alpha < beam.mu.leave:
        beam.mu = _pass(beam.mu, beam.end)
    beam.volume = _pass(beam.volume, beam.end)
    return beam


@wp.func
def _sum(beam: Beam, volume: _Volume, mu: _Volume):
    """The integral along the rest of a ray, per `chord`."""
    total = float(0.0)
    rest = float(0.0)
    while beam.volume.alpha < beam.volume.leave:
        beam = _look(beam, mu)
        value = volume[beam.volume.voxel[0], beam.volume.voxel[1], beam.volume.voxel[2]]
        total, rest = _plus(total, rest, beam.seen * value)
        beam = _move(beam)
    return total


@wp.kernel
def integrate_attenuated(
    volume: _Volume, mu: _Volume, fans: _Fans, mu_fans: _Fans, apart: int, first_line: int, integrals: _Numbers
):
    """Line integrals, attenuated towards the sources."""
    f, i, j = wp.tid()
    beam, _ = _open(_shape(volume), mu, fans, mu_fans, apart, f, first_line + i, j)
    integrals[f, i, j] = beam.chord * _sum(beam, volume, mu)


@wp.kernel
def spread_attenuated(
    volume: _Volume, mu: _Volume, fans: _Fans, mu_fans: _Fans, apart: int, first_line: int, values: _Numbers
):
    """The adjoint of `integrate_attenuated`."""
    f, i, j = wp.tid()
    beam, _ = _open(_shape(volume), mu, fans, mu_fans, apart, f, first_line + i, j)
    value = values[f, i, j] * beam.chord
    while beam.volume.alpha < beam.volume.leave:
        beam = _look(beam, mu)
        v = beam.volume.voxel
        wp.atomic_add(volume, v[0], v[1], v[2], beam.seen * value)
        beam = _move(beam)


# A plane of mu moves what is left behind it: by the jump of mu there, times the integral of all that lies behind.


@wp.kernel
def differentiate_attenuated(
    volume: _Volume, mu: _Volume, fans: _Fans, mu_fans: _Fans, apart: int, first_line: int, rows: _Rows
):
    """Columns of `differentiate`, those by the ends through the volume's planes alone; by mu's (6); by the length."""
    f, i, j = wp.tid()
    line = first_line + i
    beam, chord = _open(_shape(volume), mu, fans, mu_fans, apart, f, line, j)
    _, direction = _ray(fans, f, line, j)
    mu_start, mu_direction = _ray(mu_fans, f, line, j)
    length = _length(fans, f, line, j)
    total = float(0.0)
    rest = float(0.0)
    by_length = float(0.0)
    before = float(0.0)
    mu_before = float(0.0)
    jumps = wp.vec3f()
    moments = wp.vec3f()
    mu_jumps = wp.vec3f()  # of mu, and times the integral up to there
    mu_moments = wp.vec3f()
    done_jumps = wp.vec3f()
    done_moments = wp.vec3f()
    if apart != 0 and beam.mu.axis == _NO_AXIS:  # inside mu's lattice already
        mu_before = mu[beam.mu.voxel[0], beam.mu.voxel[1], beam.mu.voxel[2]]
        if beam.mu.alpha >= beam.mu.leave:  # and just about to leave it
            beam.mu.axis = beam.mu.last
    while beam.volume.alpha < beam.volume.leave:
        beam = _look(beam, mu)
        alpha = _number(beam.volume.alpha)
        value = volume[beam.volume.voxel[0], beam.volume.voxel[1], beam.volume.voxel[2]]
        # A lattice whose plane this is not has no jump here: the same voxel on both sides.
        jump = _on(beam.volume.axis) * ((before - value) * beam.left)
        jumps += jump
        moments += jump * alpha
        before = value
        mu_axis = beam.volume.axis
        if beam.apart != 0:
            mu_axis = beam.mu.axis
        jump = _on(mu_axis) * (mu_before - beam.mu_here)
        mu_jumps += jump
        mu_moments += jump * alpha
        done_jumps += jump * total
        done_moments += jump * (alpha * total)
        mu_before = beam.mu_here
        by_length += (
            value * beam.left * beam.size * (beam.depth * _mean_transmission(beam.t) + beam.t * _first_moment(beam.t))
        )
        total, rest = _plus(total, rest, beam.seen * value)
        beam = _move(beam)
    jump = _on(beam.volume.axis) * (before * wp.exp(-beam.depth))
    jumps += jump
    moments += jump
    inside = wp.float32(chord.leave - chord.enter)
    rows[f, i, j, 0] = total * inside
    _write_ends(rows, f, i, j, 1, direction, wp.vec3d(jumps), _moments(chord, jumps, moments))

    mu_jumps = mu_jumps * total - done_jumps
    mu_moments = mu_moments * total - done_moments
    jumps_64 = wp.vec3d(mu_jumps)
    moments_64 = _moments(chord, mu_jumps, mu_moments)
    if apart != 0 and total != 0.0:  # mu's planes before the volume: all of the integral is behind them
        w, ahead = _through(_shape(mu), mu_start, mu_direction, wp.float64(0.0), chord.enter)
        before = float(0.0)
        jumps = wp.vec3f()
        moments = wp.vec3f()
        while w.alpha < w.leave:
            value = mu[w.voxel[0], w.voxel[1], w.voxel[2]]
            jump = _on(w.axis) * ((before - value) * total)
            jumps += jump
            moments += jump * _number(w.alpha)
            before = value
            w = _pass(w, _crossing(w))
        jump = _on(w.axis) * (before * total)
        jumps += jump
        moments += jump
        jumps_64 += wp.vec3d(jumps)
        moments_64 += _moments(ahead, jumps, moments)
    scale = -length * (chord.leave - chord.enter)
    _write_ends(rows, f, i, j, 7, mu_direction, jumps_64 * scale, moments_64 * scale)
    rows[f, i, j, 13] = 0.0
    if length > wp.float64(0.0):
        rows[f, i, j, 13] = -by_length * inside / wp.float32(length)


@wp.kernel
def spread_on_mu(
    gradient: _Volume,
    volume: _Volume,
    mu: _Volume,
    fans: _Fans,
    mu_fans: _Fans,
    apart: int,
    first_line: int,
    values: _Numbers,
):
    """Add to `gradient` each ray's value times its integral's derivatives by mu.

    A segment of mu weakens all that lies behind it, and within it the more the farther from its begin.
    """
    f, i, j = wp.tid()
    line = first_line + i
    beam, chord = _open(_shape(volume), mu, fans, mu_fans, apart, f, line, j)
    total = _sum(beam, volume, mu)
    value = -values[f, i, j] * beam.chord
    if apart != 0 and total != 0.0:
        start, direction = _ray(mu_fans, f, line, j)
        w, ahead = _through(_shape(mu), start, direction, wp.float64(0.0), chord.enter)
        all = value * total * wp.float32(_length(fans, f, line, j) * (ahead.leave - ahead.enter))
        while w.alpha < w.leave:
            end = _crossing(w)
            wp.atomic_add(gradient, w.voxel[0], w.voxel[1], w.voxel[2], _number(end - w.alpha) * all)
            w = _pass(w, end)
    value = value * beam.chord
    done = float(0.0)
    rest = float(0.0)
    while beam.volume.alpha < beam.volume.leave:
        beam = _look(beam, mu)
        here = volume[beam.volume.voxel[0], beam.volume.voxel[1], beam.volume.voxel[2]]
        done, rest = _plus(done, rest, beam.seen * here)
        v = beam.volume.voxel
        inside = bool(True)
        if beam.apart != 0:
            v = beam.mu.voxel
            inside = beam.mu.alpha <= beam.volume.alpha and beam.volume.alpha < beam.mu.leave
        if inside:
            own = here * beam.left * beam.size * _first_moment(beam.t)
            wp.atomic_add(gradient, v[0], v[1], v[2], value * beam.size * (total - done + own))
        beam = _move(beam)
