# mypy: disable-error-code="no-untyped-def, valid-type"
# ruff: noqa: UP018 -- to Warp 0.0 is a constant and float(0.0) a variable
"""Kernels of the backend cuda, for NVIDIA Warp: one thread per ray, the rays of several fans in one launch.

A ray goes from voxel to voxel, through the volume and through mu at once; nothing is stored or sorted. Its parameter alpha
runs in float64 from 0 at the source to 1 at the target, so segments are as exact far from the source as near it; sums along
a ray are float32.

An index never leaves its lattice: the first voxel is clamped into it, and the step that would lead out ends the walk.
"""

# Warp reads the annotations: they must be its types, not strings.

from typing import Any

import warp as wp

# Without grid-stride loops the kernels need far fewer registers.
wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

_SNAP = wp.constant(wp.float64(1e-9))  # `ray_geometry.SNAP`
_FAR = wp.constant(wp.float64(2.0))  # an alpha beyond all rays

_Volume: Any = wp.array3d(dtype=wp.float32)
_Numbers: Any = wp.array3d(dtype=wp.float32)  # one per ray: fan, row, column
_Fans: Any = wp.array2d(dtype=wp.vec3d)
"""Source, corner, row step and column step of each fan, in index space and then in world mm, and whether rays are parallel.

The last is 1 for parallel rays, which have no steps in world mm, else 0."""


@wp.struct
class Walk:
    """A ray in a lattice: the alphas at which it enters and leaves, its voxel, and its next planes."""

    enter: wp.float64
    leave: wp.float64
    voxel: wp.vec3i
    step: wp.vec3i  # 1, -1 or 0
    next: wp.vec3d  # alpha of the next plane of each axis
    gap: wp.vec3d  # alpha from plane to plane


@wp.struct
class Ray:
    """State of a ray on its way, and its present segment."""

    volume: Walk
    mu: Walk
    attenuated: wp.int32  # 0: no mu; 1: mu shares the volume's lattice; 2: mu has its own
    length: wp.float32  # of the whole ray, mm
    alpha: wp.float64  # at which the segment begins
    end: wp.float64  # alpha at which it ends
    depth: wp.float32  # optical depth from the source to the segment
    correction: wp.float32  # of the compensated sum of the depth
    weight: wp.float32  # integral of the transmittance over the segment, mm; 0 outside the volume
    thickness: wp.float32  # optical depth of the segment


@wp.func
def _axis(w: Walk, axis: int, n: int, s: wp.float64, e: wp.float64):
    """Narrow the walk to the part of a ray from s to e, along one axis, inside [0, n): the slab method."""
    plane = wp.rint(s)
    d = e - s
    if wp.abs(s - plane) <= _SNAP and wp.abs(e - plane) <= _SNAP:  # see `ray_geometry._snapped`
        s = plane
        d = wp.float64(0.0)
    if wp.abs(d) <= _SNAP:
        if s < wp.float64(0.0) or s >= wp.float64(n):
            w.leave = wp.float64(-1.0)
        return w, s, wp.float64(0.0)
    w.enter = wp.max(w.enter, wp.min(-s / d, (wp.float64(n) - s) / d))
    w.leave = wp.min(w.leave, wp.max(-s / d, (wp.float64(n) - s) / d))
    return w, s, d


@wp.func
def _begin(w: Walk, axis: int, n: int, s: wp.float64, d: wp.float64):
    """Set the first voxel along one axis, and the planes ahead."""
    voxel = wp.int32(wp.clamp(wp.floor(s + w.enter * d), wp.float64(0.0), wp.float64(n - 1)))
    w.voxel[axis] = voxel
    w.next[axis] = _FAR
    if d != wp.float64(0.0):
        w.step[axis] = wp.where(d > wp.float64(0.0), 1, -1)
        plane = wp.where(d > wp.float64(0.0), voxel + 1, voxel)
        w.next[axis] = wp.max(w.enter, (wp.float64(plane) - s) / d)
        w.gap[axis] = wp.abs(wp.float64(1.0) / d)
    return w


@wp.func
def _walk(volume: _Volume, fans: _Fans, f: int, row: int, column: int):
    """Return the walk of a ray through a lattice; a ray that misses it leaves before it enters."""
    s = fans[f, 0]
    e = fans[f, 1] + fans[f, 2] * wp.float64(row) + fans[f, 3] * wp.float64(column)
    if fans[f, 8][0] != wp.float64(0.0):
        s = e - (fans[f, 1] - s)
    w = Walk()
    w.enter = wp.float64(0.0)
    w.leave = wp.float64(1.0)
    w, sx, dx = _axis(w, 0, volume.shape[0], s[0], e[0])
    w, sy, dy = _axis(w, 1, volume.shape[1], s[1], e[1])
    w, sz, dz = _axis(w, 2, volume.shape[2], s[2], e[2])
    if w.enter < w.leave:
        w = _begin(w, 0, volume.shape[0], sx, dx)
        w = _begin(w, 1, volume.shape[1], sy, dy)
        w = _begin(w, 2, volume.shape[2], sz, dz)
    else:
        w.enter = _FAR
        w.leave = wp.float64(-1.0)
    return w


@wp.func
def _ahead(w: Walk, alpha: wp.float64):
    """Return the alpha at which a walk next meets a plane, enters or leaves."""
    if alpha < w.enter:
        return w.enter
    if alpha >= w.leave:
        return _FAR
    return wp.min(wp.min(w.next[0], w.next[1]), wp.min(w.next[2], w.leave))


@wp.func
def _cross(w: Walk, shape: wp.vec3i, end: wp.float64):
    """Cross the planes at `end`, at most the alpha of `_ahead`."""
    if end >= w.enter and end < w.leave:
        for axis in range(3):
            if w.next[axis] <= end:
                voxel = w.voxel[axis] + w.step[axis]
                if voxel < 0 or voxel >= shape[axis]:
                    w.leave = end
                else:
                    w.voxel[axis] = voxel
                    w.next[axis] = w.next[axis] + w.gap[axis]
    return w


@wp.func
def _shape(volume: _Volume):
    """Return the shape of a volume as a vector of integers."""
    return wp.vec3i(volume.shape[0], volume.shape[1], volume.shape[2])


@wp.func
def _plus(total: float, correction: float, x: float):
    """Return ``total + x`` and the rounding error so far (Kahan summation): a ray may have thousands of segments."""
    y = x - correction
    result = total + y
    return result, (result - total) - y


@wp.func
def _mean_transmittance(t: float):
    """Return the mean of ``exp(-x)`` for x from 0 to t, (1 - exp(-t)) / t; for small t by a series, to 1e-8."""
    if wp.abs(t) < 0.1:
        return 1.0 - t * (1.0 / 2.0 - t * (1.0 / 6.0 - t * (1.0 / 24.0 - t * (1.0 / 120.0 - t * (1.0 / 720.0)))))
    return (1.0 - wp.exp(-t)) / t


@wp.func
def _ray(volume: _Volume, mu: _Volume, fans: _Fans, mu_fans: _Fans, attenuated: int, f: int, row: int, column: int):
    """Return a ray at the point where it enters the volume or, before that, mu."""
    ray = Ray()
    ray.volume = _walk(volume, fans, f, row, column)
    ray.attenuated = attenuated
    target = fans[f, 5] + fans[f, 6] * wp.float64(row) + fans[f, 7] * wp.float64(column)
    ray.length = wp.float32(wp.length(target - fans[f, 4]))
    ray.alpha = ray.volume.enter
    if attenuated == 2 and ray.volume.leave > wp.float64(0.0):
        ray.mu = _walk(mu, mu_fans, f, row, column)
        ray.alpha = wp.min(ray.alpha, ray.mu.enter)
    return ray


@wp.func
def _segment(ray: Ray, mu: _Volume):
    """Return the ray with its next segment, up to the next plane of either lattice."""
    ray.end = _ahead(ray.volume, ray.alpha)
    v = ray.volume.voxel
    has_mu = ray.attenuated == 1
    if ray.attenuated == 2:
        ray.end = wp.min(ray.end, _ahead(ray.mu, ray.alpha))
        v = ray.mu.voxel
        has_mu = ray.alpha >= ray.mu.enter and ray.alpha < ray.mu.leave
    size = wp.float32(ray.end - ray.alpha) * ray.length
    ray.thickness = float(0.0)
    if has_mu:
        ray.thickness = mu[v[0], v[1], v[2]] * size
    ray.weight = float(0.0)
    if ray.alpha >= ray.volume.enter:
        ray.weight = size
        if ray.attenuated != 0:
            ray.weight = size * wp.exp(-ray.depth) * _mean_transmittance(ray.thickness)
    return ray


@wp.func
def _advance(ray: Ray, shape: wp.vec3i, mu_shape: wp.vec3i):
    """Return the ray at the end of its segment."""
    depth, correction = _plus(ray.depth, ray.correction, ray.thickness)
    ray.depth = depth
    ray.correction = correction
    ray.volume = _cross(ray.volume, shape, ray.end)
    if ray.attenuated == 2:
        ray.mu = _cross(ray.mu, mu_shape, ray.end)
    ray.alpha = ray.end
    return ray


@wp.kernel
def integrate(
    volume: _Volume, mu: _Volume, fans: _Fans, mu_fans: _Fans, attenuated: int, first_row: int, integrals: _Numbers
):
    """Write the line integrals, value x mm, attenuated towards the sources."""
    f, i, j = wp.tid()
    ray = _ray(volume, mu, fans, mu_fans, attenuated, f, first_row + i, j)
    total = float(0.0)
    correction = float(0.0)
    while ray.alpha < ray.volume.leave:
        ray = _segment(ray, mu)
        v = ray.volume.voxel
        total, correction = _plus(total, correction, ray.weight * volume[v[0], v[1], v[2]])
        ray = _advance(ray, _shape(volume), _shape(mu))
    integrals[f, i, j] = total


@wp.kernel
def backproject(
    volume: _Volume, mu: _Volume, fans: _Fans, mu_fans: _Fans, attenuated: int, first_row: int, values: _Numbers
):
    """Add each ray's value to the volume, with the weights of `integrate`."""
    f, i, j = wp.tid()
    ray = _ray(volume, mu, fans, mu_fans, attenuated, f, first_row + i, j)
    value = values[f, i, j]
    while ray.alpha < ray.volume.leave:
        ray = _segment(ray, mu)
        v = ray.volume.voxel
        if ray.weight > 0.0:
            wp.atomic_add(volume, v[0], v[1], v[2], ray.weight * value)
        ray = _advance(ray, _shape(volume), _shape(mu))
