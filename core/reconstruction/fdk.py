"""Filtered backprojection of cone-beam views with sources on an arc or a circle: FDK."""

from dataclasses import dataclass

import numpy as np

from ..arrays import Array, ArrayLike
from ..errors import InputError, warn
from ..geometry.grid import Grid
from ..geometry.views import Views
from ..progress import Progress
from ..volumes.volume import Volume
from .filtered import angular_weights, checked_images, filtered_backprojection, rows_across

_MAX_OFF_CIRCLE = 0.1
"""Largest distance of a source from the circle, as a share of the radius."""

_SMALLEST_RADIUS = 1e-6
"""Smallest radius of the circle, as a share of the distance from source to detector; a smaller one is rounding."""


def fdk(
    images: ArrayLike,
    views: Views,
    grid: Grid,
    window: str = "ramp",
    progress: Progress | None = None,
    *,
    quantity: str | None = None,
) -> Volume:
    """Reconstruct the volume whose line integrals are `images` by Feldkamp's algorithm for flat detectors.

    Every view is backprojected with its own projection matrix, from its source, detector and pixel steps, so that deviations
    of orbit and detectors from the ideal positions need no correction. The circle may lie in any plane.

    Parameters
    ----------
    images : array (M, n_v, n_u)
        Line integrals, value x mm, such as those of ``Projector(grid, views)``.
    views : Views
        Views whose sources lie approximately on a circle around the object, or an arc of it, in any order. A view's weight
        is half the angle to both of its neighbours. On an arc, rays that are measured twice share their weight (Parker).
    grid, window, progress, quantity
        See `fbp`.

    Returns
    -------
    Volume
        The reconstructed volume, exact in the plane of the circle. The larger the angle of the rays to this plane, the lower
        the values, and the more blurred are edges parallel to the plane. If the object reaches beyond the images, values
        near their edges are too large.

    Raises
    ------
    InputError
        The views are parallel, the sources do not lie approximately on a circle, the images' rows are tilted against it, the
        images have another shape or are not finite, or there is no window of this name.

    Warns
    -----
    InputWarning
        The arc is shorter than half a circle plus the fan angle: rays are missing, and edges along them are lost. Or the
        images do not fall to about 0 at their edge columns (see `fbp`).

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
    orbit = _Orbit.fit(views)
    images, views = rows_across(images, views, orbit.axis, "fdk")
    to_detector = views.detector_centers - views.sources
    normals = np.cross(views.u_steps, views.v_steps)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    distances = np.einsum("mi,mi->m", normals, to_detector)  # signed, from the sources to their detectors' planes
    pitch = np.linalg.norm(views.u_steps, axis=1)
    parker_arc, missing = orbit.parker_arc(views)
    if missing > 0:
        arc = f"the arc is {np.degrees(missing):.0f} degrees too short for half a circle and the fan's angle"
        warn(f"fdk: {arc}: edges along the missing rays are lost", 2)

    def weights(m: int) -> Array:
        """Return the weights (n_v, n_u) of the pixels of view m before filtering."""
        # With the source s and a ray's direction theta, the ray's weight is |ds x theta|, the measure of lines in the
        # plane: the distance between the rays of neighbouring views. The remaining factors turn the filter in fan angles,
        # whose kernel falls with the sine, into the ramp filter on the detector.
        rays = views.rays(m)[1] - views.sources[m]
        step = orbit.steps[m]
        u = views.u_steps[m] / pitch[m]
        ray_distance = distances[m] * (step @ u) - (rays @ u) * (step @ normals[m])
        factor = np.abs(ray_distance) / np.linalg.norm(rays, axis=1) / (np.abs(distances[m]) * pitch[m])
        if parker_arc is None:
            return (factor / 2).reshape(views.shape)
        return (factor * _parker_weights(orbit.angles[m], orbit.fan_angles(m, rays), *parker_arc)).reshape(views.shape)

    return Volume(filtered_backprojection(images, views, grid, window, weights, progress), grid, quantity)


@dataclass(frozen=True, eq=False)
class _Orbit:
    """Circle, or arc of a circle, on which the sources lie."""

    axis: Array
    """Unit vector (3,) normal to the circle's plane."""
    radial: Array
    """Unit vectors (M, 3) from the circle's centre towards the sources."""
    angles: Array
    """Angles (M,) of the sources on the circle, from the arc's beginning if there is one, rad."""
    steps: Array
    """Path (M, 3) of the source for which each view stands, tangential, mm."""
    arc: float
    """Angle for which all views stand together, rad; 2 pi for a circle."""

    @classmethod
    def fit(cls, views: Views) -> "_Orbit":
        """Fit a circle to the sources; raise `InputError` if they are too far from it, or fewer than three."""
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
        if radius < _SMALLEST_RADIUS * np.linalg.norm(views.detector_centers - sources, axis=1).max():
            raise InputError("fdk: expected sources on a circle around the object, got all at one place")
        x, y = flat[:, 0] - solution[0], flat[:, 1] - solution[1]
        deviation = np.hypot(np.hypot(x, y) - radius, (sources - mean) @ axis)
        if not deviation.max() <= _MAX_OFF_CIRCLE * radius:
            raise InputError(
                f"fdk: view {int(deviation.argmax())}: its source is {deviation.max():.3g} mm off the circle of radius "
                f"{radius:.3g} mm that fits the sources best; fdk needs them about on a circle, sirt and osem do not"
            )
        angles = np.arctan2(y, x)
        view_angles, beginning, gap = angular_weights(angles, 2 * np.pi)
        angles = (angles - beginning) % (2 * np.pi)
        radii = np.hypot(x, y)[:, None]
        radial = (x[:, None] * first + y[:, None] * second) / radii
        steps = view_angles[:, None] * radii * np.cross(axis, radial)
        # The arc begins half of the first view's angle before its source.
        half_angle = view_angles[angles.argmin()] / 2
        arc = float(view_angles.sum()) if gap else 2 * np.pi
        return cls(axis, radial, angles + half_angle, steps, arc)

    def fan_angles(self, m: int, rays: Array) -> Array:
        """Return the fan angles (N,) of rays (N, 3) of view m: in the plane, from the ray to the circle's centre, rad.

        A fan angle is positive in the direction in which the source's angle grows.
        """
        inward, sideways = -self.radial[m], np.cross(self.axis, self.radial[m])
        return np.arctan2(rays @ sideways, rays @ inward)

    def parker_arc(self, views: Views) -> tuple[tuple[float, float] | None, float]:
        """Return arc and half fan angle for Parker's weights, and by how much the arc is too short, rad.

        The first item is None for a circle, where every ray is measured twice.
        """
        if self.arc >= 2 * np.pi - 1e-9:
            return None, 0.0
        n_u = views.shape[1]
        edge = 0.0
        for m in range(len(views)):
            central_ray = views.detector_centers[m] - views.sources[m]
            ends = central_ray + np.array([[-n_u / 2], [n_u / 2]]) * views.u_steps[m]
            edge = max(edge, float(np.abs(self.fan_angles(m, ends)).max()))
        return (self.arc, max((self.arc - np.pi) / 2, 0.0)), np.pi + 2 * edge - self.arc


def _parker_weights(angle: float, fan: Array, arc: float, half_fan: float) -> Array:
    """Return Parker's weights (N,) of rays with fan angles `fan` from a source at `angle` on the arc, all in rad.

    The line (angle, fan) is measured again as (angle + pi - 2 fan, -fan) if both lie within the arc; the weights of the same
    line sum to 1. An arc longer than half a circle plus the fan angle is treated as if the fan were wider.
    """
    fan = np.clip(fan, -half_fan, half_fan)
    # Rays at angles below `rising` are measured again at the arc's end, rays within `falling` of the end at its beginning.
    rising, falling = 2 * (half_fan + fan), 2 * (half_fan - fan)
    weight = np.ones_like(fan)
    early, late = angle < rising, angle > arc - falling
    weight[early] = np.sin(np.pi / 2 * angle / rising[early]) ** 2
    weight[late] = np.sin(np.pi / 2 * (arc - angle) / falling[late]) ** 2
    return weight
