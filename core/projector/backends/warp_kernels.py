# mypy: disable-error-code="no-untyped-def, valid-type"
# ruff: noqa: UP018, RUF046 -- to Warp 0.0 is a constant and float(0.0) a variable
"""Kernels of the "cuda" backend, for NVIDIA Warp: one thread per ray, the rays of several fans in one launch.

A ray goes from voxel to voxel; nothing is stored or sorted. The traversal is written once (`_enter`, `_crossing`,
`_cross`); each kernel uses its segments differently. Sums along a ray are float32, the traversal is set up in float64.

`alpha` runs here from 0 where a ray enters the volume to 1 where it leaves, not from its source to its target, and is
counted in units of 2^-30. The alpha of the next plane of each axis has 32 bits more (units of 2^-62); a step adds the gap
between planes, without rounding. Both come from float64. So the error of a segment is about 1e-9 of the chord, however far
the source and however short the chord; in float32 it would be about 1e-7, too much for one voxel of hundreds. The price is
a 64-bit addition where float32 takes a multiplication.

Why an index never leaves its lattice: the first voxel is clamped into it. An axis is stepped only when its next plane
lies before the end of the traversal (`_cross`), and from the last voxel of the lattice in its direction the next plane is
`_FAR`, beyond the end: an axis takes at most `planes` steps, which lead to the last voxel. Nothing of this is rounded, so
it holds whatever the compiler makes of it. Gaps are not negative, so no segment is, and the segments add up to the chord.
Nothing overflows: a plane is crossed at less than 1, and a gap is at most 1 (a plane farther off is not reached).

Warp differentiates no kernel: the gradients are written out, like everything else. The file is long because Warp compiles
the functions of one module together.
"""

# Warp reads the annotations: they must be its types, not strings.

from typing import Any

import warp as wp

# Without grid-stride loops the kernels need about 60 to 130 registers instead of 100 to 255.
wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

_SNAP = wp.constant(wp.float64(1e-9))  # as `rays` has it
_ONE = wp.constant(wp.float64(2.0**62))
_FAR = wp.constant(wp.int64(2**63 - 1))
_UNIT = wp.constant(2.0**-30)
_NO_AXIS = wp.constant(3)

_vec3l: Any = wp.types.vector(length=3, dtype=wp.int64)

_Volume: Any = wp.array3d(dtype=wp.float32)
_Numbers: Any = wp.array3d(dtype=wp.float32)  # one per ray: fan, row, column
_Rows: Any = wp.array4d(dtype=wp.float32)  # several per ray
_Fans: Any = wp.array2d(dtype=wp.vec3d)
"""Source, corner, row step and column step of each fan, in index space and then in world mm; then 1 where its rays are
parallel, which have no steps in world mm, 0 where they are not."""


@wp.struct
class Chord:
    """The part of a ray inside a lattice, and the axes of the planes at its ends: `_NO_AXIS` where the ray itself ends."""

    enter: wp.float64
    leave: wp.float64
    first: wp.int32
    last: wp.int32


@wp.struct
class Traversal:
    """The traversal of a lattice by a ray: where the ray is, and its next planes."""

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
class AttenuatedRay:
    """A ray that traverses the volume and mu, and its next segment.

    The traversal of the volume goes from 0 to 1; that of mu, needed where mu has its own lattice (`own_lattice`), uses the
    same alpha and starts and ends somewhere between.
    """

    volume: Traversal
    mu: Traversal
    own_lattice: wp.int32
    chord: wp.float32  # length in the volume, mm
    depth: wp.float32  # optical depth from the source on, and its compensated sum's correction
    correction: wp.float32
    end: wp.int32  # of the segment, and its length
    size: wp.float32
    mu_here: wp.float32
    t: wp.float32  # optical depth of the segment
    transmittance: wp.float32  # from the source to the segment
    weight: wp.float32  # integral of the transmittance over the segment


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
def _ray(fans: _Fans, fan: int, row: int, column: int):
    """Start and direction of a ray in index space."""
    s = fans[fan, 0]
    e = fans[fan, 1] + fans[fan, 2] * wp.float64(row) + fans[fan, 3] * wp.float64(column)
    if fans[fan, 8][0] != wp.float64(0.0):
        s = e - (fans[fan, 1] - s)
    sx, dx = _snapped(s[0], e[0])
    sy, dy = _snapped(s[1], e[1])
    sz, dz = _snapped(s[2], e[2])
    return wp.vec3d(sx, sy, sz), wp.vec3d(dx, dy, dz)


@wp.func
def _length(fans: _Fans, fan: int, row: int, column: int):
    """Length of a ray, mm."""
    target = fans[fan, 5] + fans[fan, 6] * wp.float64(row) + fans[fan, 7] * wp.float64(column)
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
    """The part of a ray between the alphas `low` and `high` (from source to target) inside a lattice."""
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
    """Start of a traversal along one axis: step, planes ahead, alpha of the next, gap between them."""
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
    """A traversal along `chord` from `voxel` on, where alpha is ``(alpha from source to target - origin) scale``.

    A miss is at its end.
    """
    w = Traversal()
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
    """An alpha without its lower 32 bits."""
    return wp.int32(alpha >> wp.int64(32))


@wp.func
def _through(shape: wp.vec3i, start: wp.vec3d, direction: wp.vec3d, low: wp.float64, high: wp.float64):
    """The traversal of a lattice between the alphas `low` and `high`, and the chord; its own alpha is from 0 to 1."""
    chord = _chord(shape, start, direction, low, high)
    if chord.enter >= chord.leave:
        chord.leave = chord.enter
        return Traversal(), chord
    voxel = _voxel(shape, start + direction * chord.enter)
    scale = wp.float64(1.0) / (chord.leave - chord.enter)
    return _enter(chord, voxel, shape, start, direction, chord.enter, scale), chord


@wp.func
def _crossing(w: Traversal):
    """Alpha of the next plane, or of the end of the traversal."""
    return wp.min(wp.min(_upper(w.next[0]), _upper(w.next[1])), wp.min(_upper(w.next[2]), w.leave))


@wp.func
def _step(w: Traversal, axis: int):
    """Cross the next plane of an axis."""
    w.axis = axis
    w.voxel[axis] = w.voxel[axis] + w.step[axis]
    w.planes[axis] = w.planes[axis] - 1
    w.next[axis] = wp.where(w.planes[axis] > 0, w.next[axis] + w.gap[axis], _FAR)
    return w


@wp.func
def _cross(w: Traversal, end: int):
    """Traversal on to `end`, at most the next crossing, and cross the plane that is there."""
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
def _plus(total: float, correction: float, x: float):
    """``total + x`` and the rounding error so far (Kahan summation): a ray may have thousands of segments."""
    y = x - correction
    result = total + y
    return result, (result - total) - y


@wp.func
def _unit(axis: int):
    """1 for the axis, 0 for the others; all 0 for `_NO_AXIS`."""
    return wp.vec3f(float(axis == 0), float(axis == 1), float(axis == 2))


# Without attenuation: the weight of a segment is its length.


@wp.func
def _integral(volume: _Volume, start: wp.vec3d, direction: wp.vec3d, high: wp.float64):
    """Integral over a chord, per its length, up to the alpha `high` (from source to target); the traversal after it."""
    w, chord = _through(_shape(volume), start, direction, wp.float64(0.0), high)
    total = float(0.0)
    correction = float(0.0)
    while w.alpha < w.leave:
        end = _crossing(w)
        total, correction = _plus(
            total, correction, _number(end - w.alpha) * volume[w.voxel[0], w.voxel[1], w.voxel[2]]
        )
        w = _cross(w, end)
    return total, w, chord


@wp.kernel
def integrate(volume: _Volume, fans: _Fans, first_row: int, integrals: _Numbers):
    """Line integrals, value x mm."""
    f, i, j = wp.tid()
    start, direction = _ray(fans, f, first_row + i, j)
    total, _, chord = _integral(volume, start, direction, wp.float64(1.0))
    integrals[f, i, j] = total * wp.float32(_length(fans, f, first_row + i, j) * (chord.leave - chord.enter))


@wp.kernel
def backproject(volume: _Volume, fans: _Fans, first_row: int, values: _Numbers):
    """Add each ray's value to the volume, with the weights of `integrate`."""
    f, i, j = wp.tid()
    start, direction = _ray(fans, f, first_row + i, j)
    w, chord = _through(_shape(volume), start, direction, wp.float64(0.0), wp.float64(1.0))
    value = values[f, i, j] * wp.float32(_length(fans, f, first_row + i, j) * (chord.leave - chord.enter))
    while w.alpha < w.leave:
        end = _crossing(w)
        wp.atomic_add(volume, w.voxel[0], w.voxel[1], w.voxel[2], _number(end - w.alpha) * value)
        w = _cross(w, end)


# Derivatives by the ends: every plane crossed contributes its jump times the change of its alpha. The plane at k is
# crossed at alpha = (k - s)/d (from source to target), d = t - s, so d alpha/ds = (alpha - 1)/d and d alpha/dt = -alpha/d:
# the sum of an axis's jumps and that of its jumps times alpha are all that is needed.


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


@wp.func
def _jumps(volume: _Volume, start: wp.vec3d, direction: wp.vec3d, high: wp.float64):
    """As `_integral`: the integral, the sums of jumps and of jumps times alpha along the chord, and the chord."""
    w, chord = _through(_shape(volume), start, direction, wp.float64(0.0), high)
    total = float(0.0)
    correction = float(0.0)
    before = float(0.0)
    jumps = wp.vec3f()
    moments = wp.vec3f()
    while w.alpha < w.leave:
        value = volume[w.voxel[0], w.voxel[1], w.voxel[2]]
        jump = _unit(w.axis) * (before - value)
        jumps += jump
        moments += jump * _number(w.alpha)
        before = value
        end = _crossing(w)
        total, correction = _plus(total, correction, _number(end - w.alpha) * value)
        w = _cross(w, end)
    jump = _unit(w.axis) * before
    jumps += jump
    moments += jump * _number(w.alpha)
    return total, jumps, moments, chord


@wp.kernel
def differentiate(volume: _Volume, fans: _Fans, first_row: int, rows: _Rows):
    """Columns: the integral over alpha from 0 to 1, its derivatives by the start (3) and by the end (3)."""
    f, i, j = wp.tid()
    start, direction = _ray(fans, f, first_row + i, j)
    total, jumps, moments, chord = _jumps(volume, start, direction, wp.float64(1.0))
    rows[f, i, j, 0] = total * wp.float32(chord.leave - chord.enter)
    _write_ends(rows, f, i, j, 1, direction, wp.vec3d(jumps), _moments(chord, jumps, moments))


# With attenuation: the weight includes the transmittance. Where mu has its own lattice, the planes of both cut the ray.


@wp.func
def _mean_transmittance(t: float):
    """Mean of ``exp(-x)`` for x from 0 to t, (1 - exp(-t)) / t; for small t by a series, to 1e-8."""
    if wp.abs(t) < 0.1:
        return 1.0 - t * (1.0 / 2.0 - t * (1.0 / 6.0 - t * (1.0 / 24.0 - t * (1.0 / 120.0 - t * (1.0 / 720.0)))))
    return (1.0 - wp.exp(-t)) / t


@wp.func
def _first_moment(t: float):
    """Integral of ``u exp(-t u)`` for u from 0 to 1, (1 - (1 + t) exp(-t)) / t^2; for small t by a series."""
    if wp.abs(t) < 0.3:
        series = 1.0 / 30.0 - t * (1.0 / 144.0 - t * (1.0 / 840.0 - t * (1.0 / 5760.0)))
        return 1.0 / 2.0 - t * (1.0 / 3.0 - t * (1.0 / 8.0 - t * series))
    return (1.0 - (1.0 + t) * wp.exp(-t)) / (t * t)


@wp.func
def _enter_attenuated(
    shape: wp.vec3i, mu: _Volume, fans: _Fans, mu_fans: _Fans, own_lattice: int, f: int, row: int, column: int
):
    """A ray where it enters the volume, and its chord."""
    traced = AttenuatedRay()
    start, direction = _ray(fans, f, row, column)
    w, chord = _through(shape, start, direction, wp.float64(0.0), wp.float64(1.0))
    length = _length(fans, f, row, column)
    traced.volume = w
    traced.own_lattice = own_lattice
    traced.chord = wp.float32(length * (chord.leave - chord.enter))
    if own_lattice != 0 and w.alpha < w.leave:
        start, direction = _ray(mu_fans, f, row, column)
        depth, ahead, mu_chord = _integral(mu, start, direction, chord.enter)
        traced.depth = wp.float32(length) * (depth * wp.float32(mu_chord.leave - mu_chord.enter))
        within = _chord(_shape(mu), start, direction, chord.enter, chord.leave)
        # The traversal goes on from where it is: rounding must not make it cross a plane just there twice or never.
        voxel = _voxel(_shape(mu), start + direction * within.enter)
        if mu_chord.leave > mu_chord.enter:
            voxel = ahead.voxel
        scale = wp.float64(1.0) / (chord.leave - chord.enter)
        traced.mu = _enter(within, voxel, _shape(mu), start, direction, chord.enter, scale)
    return traced, chord


@wp.func
def _next_segment(traced: AttenuatedRay, mu: _Volume):
    """The next segment, up to the next plane of either lattice."""
    alpha = traced.volume.alpha
    traced.end = _crossing(traced.volume)
    traced.mu_here = 0.0
    if traced.own_lattice == 0:
        traced.mu_here = mu[traced.volume.voxel[0], traced.volume.voxel[1], traced.volume.voxel[2]]
    elif alpha < traced.mu.alpha:  # not there yet
        traced.end = wp.min(traced.end, traced.mu.alpha)
    elif alpha < traced.mu.leave:
        traced.end = wp.min(traced.end, _crossing(traced.mu))
        traced.mu_here = mu[traced.mu.voxel[0], traced.mu.voxel[1], traced.mu.voxel[2]]
    traced.size = _number(traced.end - alpha)
    traced.t = traced.mu_here * traced.chord * traced.size
    traced.transmittance = wp.exp(-traced.depth)
    traced.weight = traced.transmittance * traced.size * _mean_transmittance(traced.t)
    return traced


@wp.func
def _advance(traced: AttenuatedRay):
    """Go on to the end of the segment."""
    depth, correction = _plus(traced.depth, traced.correction, traced.t)
    traced.depth = depth
    traced.correction = correction
    if traced.own_lattice != 0 and traced.mu.alpha <= traced.volume.alpha and traced.volume.alpha < traced.mu.leave:
        traced.mu = _cross(traced.mu, traced.end)
    traced.volume = _cross(traced.volume, traced.end)
    return traced


@wp.func
def _sum(traced: AttenuatedRay, volume: _Volume, mu: _Volume):
    """The integral along the rest of a ray, per `chord`."""
    total = float(0.0)
    correction = float(0.0)
    while traced.volume.alpha < traced.volume.leave:
        traced = _next_segment(traced, mu)
        value = volume[traced.volume.voxel[0], traced.volume.voxel[1], traced.volume.voxel[2]]
        total, correction = _plus(total, correction, traced.weight * value)
        traced = _advance(traced)
    return total


@wp.kernel
def integrate_attenuated(
    volume: _Volume, mu: _Volume, fans: _Fans, mu_fans: _Fans, own_lattice: int, first_row: int, integrals: _Numbers
):
    """Line integrals, attenuated towards the sources."""
    f, i, j = wp.tid()
    traced, _ = _enter_attenuated(_shape(volume), mu, fans, mu_fans, own_lattice, f, first_row + i, j)
    integrals[f, i, j] = traced.chord * _sum(traced, volume, mu)


@wp.kernel
def backproject_attenuated(
    volume: _Volume, mu: _Volume, fans: _Fans, mu_fans: _Fans, own_lattice: int, first_row: int, values: _Numbers
):
    """Add each ray's value to the volume, with the weights of `integrate_attenuated`."""
    f, i, j = wp.tid()
    traced, _ = _enter_attenuated(_shape(volume), mu, fans, mu_fans, own_lattice, f, first_row + i, j)
    value = values[f, i, j] * traced.chord
    while traced.volume.alpha < traced.volume.leave:
        traced = _next_segment(traced, mu)
        v = traced.volume.voxel
        wp.atomic_add(volume, v[0], v[1], v[2], traced.weight * value)
        traced = _advance(traced)


# Moving a plane of mu changes the transmittance beyond it: by the jump of mu there, times the integral beyond.


@wp.kernel
def differentiate_attenuated(
    volume: _Volume, mu: _Volume, fans: _Fans, mu_fans: _Fans, own_lattice: int, first_row: int, rows: _Rows
):
    """The columns of `differentiate`, through the volume's planes alone; by the ends through mu's planes (6); by length."""
    f, i, j = wp.tid()
    row = first_row + i
    traced, chord = _enter_attenuated(_shape(volume), mu, fans, mu_fans, own_lattice, f, row, j)
    _, direction = _ray(fans, f, row, j)
    mu_start, mu_direction = _ray(mu_fans, f, row, j)
    length = _length(fans, f, row, j)
    total = float(0.0)
    correction = float(0.0)
    by_length = float(0.0)
    before = float(0.0)
    mu_before = float(0.0)
    jumps = wp.vec3f()
    moments = wp.vec3f()
    mu_jumps = wp.vec3f()  # of mu, and times the integral before the plane
    mu_moments = wp.vec3f()
    done_jumps = wp.vec3f()
    done_moments = wp.vec3f()
    if own_lattice != 0 and traced.mu.axis == _NO_AXIS:  # already inside mu's lattice
        mu_before = mu[traced.mu.voxel[0], traced.mu.voxel[1], traced.mu.voxel[2]]
        if traced.mu.alpha >= traced.mu.leave:  # and about to leave it
            traced.mu.axis = traced.mu.last
    while traced.volume.alpha < traced.volume.leave:
        traced = _next_segment(traced, mu)
        alpha = _number(traced.volume.alpha)
        value = volume[traced.volume.voxel[0], traced.volume.voxel[1], traced.volume.voxel[2]]
        # A lattice whose plane this is not has no jump here: the same voxel on both sides.
        jump = _unit(traced.volume.axis) * ((before - value) * traced.transmittance)
        jumps += jump
        moments += jump * alpha
        before = value
        mu_axis = traced.volume.axis
        if traced.own_lattice != 0:
            mu_axis = traced.mu.axis
        jump = _unit(mu_axis) * (mu_before - traced.mu_here)
        mu_jumps += jump
        mu_moments += jump * alpha
        done_jumps += jump * total
        done_moments += jump * (alpha * total)
        mu_before = traced.mu_here
        by_length += (
            value
            * traced.transmittance
            * traced.size
            * (traced.depth * _mean_transmittance(traced.t) + traced.t * _first_moment(traced.t))
        )
        total, correction = _plus(total, correction, traced.weight * value)
        traced = _advance(traced)
    jump = _unit(traced.volume.axis) * (before * wp.exp(-traced.depth))
    jumps += jump
    moments += jump
    inside = wp.float32(chord.leave - chord.enter)
    rows[f, i, j, 0] = total * inside
    _write_ends(rows, f, i, j, 1, direction, wp.vec3d(jumps), _moments(chord, jumps, moments))

    mu_jumps = mu_jumps * total - done_jumps
    mu_moments = mu_moments * total - done_moments
    jumps_64 = wp.vec3d(mu_jumps)
    moments_64 = _moments(chord, mu_jumps, mu_moments)
    if own_lattice != 0 and total != 0.0:  # mu's planes before the volume: the whole integral is beyond them
        _mu_total, jumps_ahead, moments_ahead, ahead = _jumps(mu, mu_start, mu_direction, chord.enter)
        jumps_64 += wp.vec3d(jumps_ahead * total)
        moments_64 += _moments(ahead, jumps_ahead * total, moments_ahead * total)
    scale = -length * (chord.leave - chord.enter)
    _write_ends(rows, f, i, j, 7, mu_direction, jumps_64 * scale, moments_64 * scale)
    rows[f, i, j, 13] = 0.0
    if length > wp.float64(0.0):
        rows[f, i, j, 13] = -by_length * inside / wp.float32(length)


@wp.kernel
def differentiate_by_mu(
    gradient: _Volume,
    volume: _Volume,
    mu: _Volume,
    fans: _Fans,
    mu_fans: _Fans,
    own_lattice: int,
    first_row: int,
    values: _Numbers,
):
    """Add to `gradient` each ray's value times its integral's derivatives by mu.

    A segment of mu weakens all that lies beyond it, and what is in it the more, the farther from its start.
    """
    f, i, j = wp.tid()
    row = first_row + i
    traced, chord = _enter_attenuated(_shape(volume), mu, fans, mu_fans, own_lattice, f, row, j)
    total = _sum(traced, volume, mu)
    value = -values[f, i, j] * traced.chord
    if own_lattice != 0 and total != 0.0:
        start, direction = _ray(mu_fans, f, row, j)
        w, ahead = _through(_shape(mu), start, direction, wp.float64(0.0), chord.enter)
        all = value * total * wp.float32(_length(fans, f, row, j) * (ahead.leave - ahead.enter))
        while w.alpha < w.leave:
            end = _crossing(w)
            wp.atomic_add(gradient, w.voxel[0], w.voxel[1], w.voxel[2], _number(end - w.alpha) * all)
            w = _cross(w, end)
    value = value * traced.chord
    done = float(0.0)
    correction = float(0.0)
    while traced.volume.alpha < traced.volume.leave:
        traced = _next_segment(traced, mu)
        here = volume[traced.volume.voxel[0], traced.volume.voxel[1], traced.volume.voxel[2]]
        done, correction = _plus(done, correction, traced.weight * here)
        v = traced.volume.voxel
        inside = bool(True)
        if traced.own_lattice != 0:
            v = traced.mu.voxel
            inside = traced.mu.alpha <= traced.volume.alpha and traced.volume.alpha < traced.mu.leave
        if inside:
            own = here * traced.transmittance * traced.size * _first_moment(traced.t)
            wp.atomic_add(gradient, v[0], v[1], v[2], value * traced.size * (total - done + own))
        traced = _advance(traced)
