"""Filtered backprojection of cone-beam views from an arc or a circle."""

from dataclasses import dataclass

import numpy as np

from ..arrays import Array, ArrayLike
from ..errors import InputError, warn
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..progress import Progress
from ..volumes.volume import Volume
from .filtered import angular_weights, checked_images, filtered_backprojection, rows_across

_OFF_CIRCLE = 0.1
"""Sources may be so far from their circle, as a share of its radius."""

_LEAST_RADIUS = 1e-6
"""A circle's radius as a share of the distance from source to detector: less is rounding."""


def fdk(
    images: ArrayLike,
    views: Views,
    grid: Grid,
    window: str = "ramp",
    progress: Progress | None = None,
    *,
    quantity: str | None = None,
) -> Volume:
    """Reconstruct the volume whose line integrals are `images`, by Feldkamp's algorithm for sources on a circle.

    Every view is taken as its own source, detector and pixel steps say, so that an orbit and detectors that are not quite
    where they should be need no correction: they are the projection matrices. The circle may lie in any plane.

    Parameters
    ----------
    images : array (M, n_v, n_u)
        Line integrals, value x mm, such as those of ``Projector(grid, views)``.
    views : Views
        From sources about on a circle, or an arc of it, around the object, at any angles and in any order. Each view counts
        for the arc halfway to its neighbours. On an arc, rays that are measured twice share their weight (Parker).
    grid, window, progress, quantity
        See `fbp`.

    Returns
    -------
    Volume
        Exact in the plane of the circle; away from it the values sink and edges across the axis blur, the more, the larger
        the angle that the rays make with the plane. Where the object reaches beyond the images, the values near their edge
        are too large.

    Raises
    ------
    InputError
        Parallel views, sources that do not lie about on a circle, images whose rows lie across it, images of another
        shape or not finite, no such window.

    Warns
    -----
    InputWarning
        The arc is shorter than half a circle and the fan's angle: some rays are missing, and edges along them are lost. Or
        the images do not fall to about 0 at their edge columns (see `fbp`).

    References
    ----------
    L. A. Feldkamp, L. C. Davis, J. W. Kress, "Practical cone-beam algorithm", Journal of the Optical Society of America A 1
    (1984) 612-619. C. Karolczak et al., "Implementation of a cone-beam reconstruction algorithm for the single-circle source
    orbit with embedded misalignment correction using homogeneous coordinates", Medical Physics 28 (2001) 2050-2069.
    D. L. Parker, "Optimal short scan convolution reconstruction for fanbeam CT", Medical Physics 9 (1982) 254-257.
    """
    images, quantity = checked_images(images, quantity, views, grid, "fdk")
    if views.parallel:
        raise InputError("fdk: expected views from sources; parallel views are for fbp")
    orbit = _Orbit.of(views)
    images, views = rows_across(images, views, orbit.axis, "fdk")
    to_detector = views.detector_centers - views.sources
    normals = np.cross(views.u_steps, views.v_steps)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    distances = np.einsum("mi,mi->m", normals, to_detector)  # from the sources to their detectors' planes, signed
    pitch = np.linalg.norm(views.u_steps, axis=1)
    reach, missing = orbit.reach(views)
    if missing > 0:
        arc = f"the arc is {np.degrees(missing):.0f} degrees too short for half a circle and the fan's angle"
        warn(f"fdk: {arc}: edges along the missing rays are lost", 2)

    def weights(m: int) -> Array:
        # With s the source and theta a ray's direction, a ray counts for |ds x theta|, which is the measure of lines in the
        # plane: the distance by which neighbouring views' rays are apart. Filtering in angles, whose kernel falls with
        # the sine, becomes filtering on the detector by the factors that are left.
        rays = views.rays(m)[1] - views.sources[m]
        step = orbit.steps[m]
        u = views.u_steps[m] / pitch[m]
        apart = distances[m] * (step @ u) - (rays @ u) * (step @ normals[m])
        factor = np.abs(apart) / np.linalg.norm(rays, axis=1) / (np.abs(distances[m]) * pitch[m])
        if reach is None:
            return (factor / 2).reshape(views.shape)
        return (factor * _parker(orbit.angles[m], orbit.fan_angles(m, rays), *reach)).reshape(views.shape)

    return Volume(filtered_backprojection(images, views, grid, window, weights, progress), grid, quantity)


@dataclass(frozen=True, eq=False)
class _Orbit:
    """The circle on which the sources lie."""

    axis: Array  # (3,)
    towards: Array  # (M, 3): unit vectors in the plane, from the circle's centre to the sources
    angles: Array  # (M,): of the sources on the circle, from the arc's beginning if there is one
    steps: Array  # (M, 3): the way of the source for which each view stands, mm
    arc: float  # the angle that all views stand for; 2 pi for a circle

    @classmethod
    def of(cls, views: Views) -> "_Orbit":
        """Return the best circle through the sources; raise InputError where they are too few, or too far from it."""
        if len(views) < 3:
            raise InputError(f"fdk: expected three views or more, got {len(views)}")
        sources = views.sources
        mean = sources.mean(axis=0)
        axis, second, first = np.linalg.eigh((sources - mean).T @ (sources - mean))[1].T
        second = np.cross(axis, first)
        flat = np.stack([(sources - mean) @ first, (sources - mean) @ second], axis=1)
        # |x|^2 = 2 c x + (r^2 - |c|^2), linear in c and the rest (Kasa's fit).
        solution = np.linalg.lstsq(np.insert(2 * flat, 2, 1.0, axis=1), (flat**2).sum(axis=1), rcond=None)[0]
        radius = float(np.sqrt(max(solution[2] + solution[0] ** 2 + solution[1] ** 2, 0.0)))
        if radius < _LEAST_RADIUS * np.linalg.norm(views.detector_centers - sources, axis=1).max():
            raise InputError("fdk: expected sources on a circle around the object, got all at one place")
        x, y = flat[:, 0] - solution[0], flat[:, 1] - solution[1]
        off = np.hypot(np.hypot(x, y) - radius, (sources - mean) @ axis)
        if not off.max() <= _OFF_CIRCLE * radius:
            raise InputError(
                f"fdk: view {int(off.argmax())}: its source is {off.max():.3g} mm off the circle of radius {radius:.3g} mm "
                "that fits the sources best; fdk needs them about on a circle, sirt and osem do not"
            )
        angles = np.arctan2(y, x)
        shares, beginning, gap = angular_weights(angles, 2 * np.pi)
        angles = (angles - beginning) % (2 * np.pi)
        lengths = np.hypot(x, y)[:, None]
        towards = (x[:, None] * first + y[:, None] * second) / lengths
        steps = shares[:, None] * lengths * np.cross(axis, towards)
        # From the first view's half share on.
        first_share = shares[angles.argmin()] / 2
        arc = float(shares.sum()) if gap else 2 * np.pi
        return cls(axis, towards, angles + first_share, steps, arc)

    def fan_angles(self, m: int, rays: Array) -> Array:
        """Return the in-plane angles (N,) of view m's rays from its central ray; they grow with the source's angle."""
        inward, sideways = -self.towards[m], np.cross(self.axis, self.towards[m])
        return np.arctan2(rays @ sideways, rays @ inward)

    def reach(self, views: Views) -> tuple[tuple[float, float] | None, float]:
        """Return the arc and half the fan's angle that share the weights of rays measured twice, and what the arc lacks.

        None for a circle, where every ray is measured twice.
        """
        if self.arc >= 2 * np.pi - 1e-9:
            return None, 0.0
        n_u = views.shape[1]
        edge = 0.0
        for m in range(len(views)):
            middle = views.detector_centers[m] - views.sources[m]
            ends = middle + np.array([[-n_u / 2], [n_u / 2]]) * views.u_steps[m]
            edge = max(edge, float(np.abs(self.fan_angles(m, ends)).max()))
        return (self.arc, max((self.arc - np.pi) / 2, 0.0)), np.pi + 2 * edge - self.arc


def _parker(angle: float, fan: Array, arc: float, half_fan: float) -> Array:
    """Return the weights of rays by the source's angle on the arc and their fan angles: weights of the same line sum to 1.

    The line of (angle, fan) is that of (angle + pi - 2 fan, -fan), so that one is measured again as long as both lie within
    the arc. An arc longer than necessary is shared as if the fan were as much wider.
    """
    fan = np.clip(fan, -half_fan, half_fan)
    # Measured again at the arc's end, and at its beginning.
    rising, falling = 2 * (half_fan + fan), 2 * (half_fan - fan)
    weight = np.ones_like(fan)
    early, late = angle < rising, angle > arc - falling
    weight[early] = np.sin(np.pi / 2 * angle / rising[early]) ** 2
    weight[late] = np.sin(np.pi / 2 * (arc - angle) / falling[late]) ** 2
    return weight
