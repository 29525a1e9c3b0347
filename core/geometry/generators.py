"""Systems from a few parameters: rings of modules on an ellipse or on plates, and the ellipse that a ring follows.

Azimuths are polar angles about the isocentre, rad, from +x towards +y, as in the users' workbook.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..validation import instance, positive, real_array, whole_number
from .design_formulas import collimator_length as designed_length
from .system import PinholeSystem

Array = NDArray[np.float64]
Spacing = Literal["angle", "arc"]

_FULL_TURN = 2 * math.pi
_MOST_MODULES = 10_000
# Steps of an arc whose length is measured: as a sum of chords that is 1e-9 of it short.
_ARC_STEPS = 1 << 15
# An ellipse has five parameters: fewer modules than this say nothing about one.
_FEWEST_ON_ELLIPSE = 6
_FIT_STEPS = 100
_ON_AXIS = 1e-9
# A gap of more than so many mean ones opens a ring.
_OPEN_GAP = 2.0


def ellipse_rings(
    modules: int | ArrayLike,
    semi_axes: ArrayLike,
    z: ArrayLike,
    *,
    pinhole_diameter: ArrayLike,
    detector_side: ArrayLike,
    detector_thickness: ArrayLike,
    roi_radius: ArrayLike,
    collimator_length: ArrayLike | None = None,
    start: float = 0.0,
    end: float = _FULL_TURN,
    spacing: Spacing = "angle",
    center: ArrayLike = (0.0, 0.0),
    rotation: float = 0.0,
    mirrored: bool = False,
) -> PinholeSystem:
    """A system of rings of modules on an ellipse around the isocentre, ring by ring.

    Parameters
    ----------
    modules
        M modules of each ring, evenly spaced; or their azimuths themselves, rad, (M,) or (rings, M).
    semi_axes
        Of the ellipse through the pinholes, mm: (along x, along y) before it is turned. One number: a circle.
    z
        Of the rings, mm: one number, (rings,), or (rings, M) where it differs from module to module.
    pinhole_diameter, detector_side, detector_thickness, roi_radius
        d, Ld, Td and R, mm; one number, or one for each module of the system.
    collimator_length
        l, mm, likewise. None: of the design formula (`core.design.collimator_length`).
    start, end
        Azimuths of a ring's first and last module, rad, in either direction; a full turn apart, the ring is closed and
        the last module is one step before `end`.
    spacing
        ``"angle"``: equal steps in azimuth; ``"arc"``: equal lengths of the ellipse.
    center
        Of the ellipse, (x, y) mm. The isocentre must be inside.
    rotation
        Of the ellipse about its centre, rad.
    mirrored
        Whether the rings' mirror images at z = 0 follow, the last ring's first.

    Raises
    ------
    InputError
        A number is of another kind or out of its range, or modules would stand at one place.
    """
    ellipse = _Ellipse.checked(semi_axes, center, rotation)
    if np.ndim(modules) == 0:
        azimuths = _even_azimuths(ellipse, modules, start, end, spacing)
    else:
        azimuths = real_array(modules, "azimuths", (None,) * min(np.ndim(modules), 2))
    return _rings(
        ellipse.at(azimuths),
        z,
        mirrored,
        pinhole_diameter,
        detector_side,
        detector_thickness,
        roi_radius,
        collimator_length,
    )


def plate_rings(
    modules: int | Sequence[int],
    vertices: ArrayLike,
    z: ArrayLike,
    *,
    pinhole_diameter: ArrayLike,
    detector_side: ArrayLike,
    detector_thickness: ArrayLike,
    roi_radius: ArrayLike,
    collimator_length: ArrayLike | None = None,
    closed: bool = True,
    mirrored: bool = False,
) -> PinholeSystem:
    """A system of rings of modules on flat plates, ring by ring, plate by plate.

    The n modules of a plate stand in the middles of n equal parts of it, and aim at the isocentre as all modules do.

    Parameters
    ----------
    modules
        Of each plate in each ring: one number, or one for each plate, 0 for none.
    vertices
        (V, 2), x and y of the plates' edges, mm, in order; of a regular polygon: `regular_polygon`.
    z, pinhole_diameter, detector_side, detector_thickness, roi_radius, collimator_length, mirrored
        As for `ellipse_rings`.
    closed
        Whether a plate joins the last vertex to the first.

    Raises
    ------
    InputError
        As for `ellipse_rings`.
    """
    corners = real_array(vertices, "vertices", (None, 2))
    if len(corners) < 2 + closed:
        raise InputError(f"vertices: expected at least {2 + closed}, got {len(corners)}")
    ends = np.roll(corners, -1, axis=0) if closed else corners[1:]
    starts = corners[: len(ends)]
    try:
        counts = np.asarray(modules)
    except ValueError:  # lists of different lengths
        counts = np.empty(0)
    counts = np.broadcast_to(counts, len(starts)) if counts.ndim == 0 else counts
    whole = counts.shape == (len(starts),) and counts.dtype.kind in "iu"
    if not whole or counts.min() < 0 or not 0 < counts.max() <= _MOST_MODULES:
        raise InputError(
            f"modules: expected a whole number up to {_MOST_MODULES}, or one for each of the {len(starts)} plates, "
            f"got {modules}"
        )
    shares = np.concatenate([(np.arange(n) + 0.5) / n for n in counts if n])[:, None]
    places = (1 - shares) * np.repeat(starts, counts, axis=0) + shares * np.repeat(ends, counts, axis=0)
    return _rings(
        places,
        z,
        mirrored,
        pinhole_diameter,
        detector_side,
        detector_thickness,
        roi_radius,
        collimator_length,
    )


def regular_polygon(sides: int, apothem: float, rotation: float = 0.0) -> Array:
    """Vertices (sides, 2), mm, of a regular polygon around the isocentre, for `plate_rings`.

    Parameters
    ----------
    sides
        At least 3.
    apothem
        Distance of the plates from the isocentre, mm.
    rotation
        Azimuth of the first plate's middle, rad.

    Raises
    ------
    InputError
        A number is of another kind or out of its range.
    """
    sides = whole_number(sides, "sides")
    if sides < 3:
        raise InputError(f"sides: expected at least 3, got {sides}")
    angles = float(real_array(rotation, "rotation", ())) + (2 * np.arange(sides) - 1) * math.pi / sides
    radius = positive(apothem, "apothem", "mm") / math.cos(math.pi / sides)
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


@dataclass(frozen=True, eq=False)
class RingFit:
    """The ellipse that one ring of a system follows, and how far from evenly its modules stand on it.

    Attributes
    ----------
    numbers : int array (M,)
        The ring's modules along the ring, an open one from its end.
    semi_axes, center : array (2,)
        mm, as `ellipse_rings` takes them.
    rotation : float
        rad, at most 45 degrees either way.
    azimuths, z : array (M,)
        rad (growing or falling without a jump) and mm, of each module.
    spacing : str
        ``"angle"`` or ``"arc"``: the rule of even spacing from the first azimuth to the last that comes closest.
    curve_deviation : float
        Largest distance of a pinhole from the ellipse at its own z, mm.
    even_deviation : float
        Largest distance of a pinhole from where it stands if the ring is evenly spaced and at one z, mm.
    """

    numbers: NDArray[np.int64]
    semi_axes: Array
    center: Array
    rotation: float
    azimuths: Array
    z: Array
    spacing: Spacing
    curve_deviation: float
    even_deviation: float

    def parameters(self, even: bool = False) -> dict[str, Any]:
        """Arguments of `ellipse_rings` that regenerate the ring.

        Parameters
        ----------
        even
            With M, the ends and the rule of spacing, and the mean z, instead of every module's azimuth and z.
        """
        curve = {"semi_axes": self.semi_axes, "center": self.center, "rotation": self.rotation}
        if not even:
            return {"modules": self.azimuths, "z": self.z[None], **curve}
        first, last = float(self.azimuths[0]), float(self.azimuths[-1])
        return {
            "modules": len(self.azimuths),
            "start": first,
            "end": last,
            "spacing": self.spacing,
            "z": float(self.z.mean()),
            **curve,
        }


def fit_rings(system: PinholeSystem) -> list[RingFit]:
    """The parameters of `ellipse_rings` that come closest to a system, for each of its rings along +z.

    The ellipse is that of least squares of the pinholes' distances from it, found from the direct fit of Halir and
    Flusser by Gauss and Newton's method. For a ring of fewer than 6 modules, and where no ellipse around the isocentre
    is found, it is the circle about the isocentre with the pinholes' mean distance.

    Raises
    ------
    InputError
        A module stands on the z axis, where it has no azimuth.

    References
    ----------
    R. Halir, J. Flusser, "Numerically stable direct least squares fitting of ellipses", Proc. WSCG (1998) 125-132.
    """
    instance(system, PinholeSystem, "fit_rings")
    on_axis = np.hypot(*system.centers.T[:2]) <= _ON_AXIS * system.pinhole_distance
    if on_axis.any():
        raise InputError(f"module {system.numbers[np.argmax(on_axis)]}: stands on the z axis, not on a ring around it")
    rings = system.rings()
    return [_fit(system, np.flatnonzero(rings == ring)) for ring in range(rings.max() + 1)]


def _fit(system: PinholeSystem, which: NDArray[np.intp]) -> RingFit:
    azimuths, which = _in_order(system, which, _run_clockwise(system, [which]))
    places, z = system.centers[which, :2], system.centers[which, 2]
    ellipse = _fit_ellipse(places)
    if ellipse is None:
        radius = float(np.linalg.norm(places, axis=1).mean())
        ellipse = _Ellipse(np.full(2, radius), np.zeros(2), 0.0)
    evenly: dict[Spacing, float] = {}
    spacings: tuple[Spacing, ...] = ("angle", "arc")
    for spacing in spacings:
        even = _even_azimuths(ellipse, len(which), azimuths[0], azimuths[-1], spacing)
        off = np.concatenate([ellipse.at(even) - places, (z.mean() - z)[:, None]], axis=1)
        evenly[spacing] = float(np.linalg.norm(off, axis=1).max())
    best = min(spacings, key=lambda name: evenly[name])
    return RingFit(
        numbers=system.numbers[which],
        semi_axes=ellipse.semi_axes,
        center=ellipse.center,
        rotation=ellipse.rotation,
        azimuths=azimuths,
        z=z,
        spacing=best,
        curve_deviation=float(np.abs(ellipse.distances(places)[0]).max()),
        even_deviation=evenly[best],
    )


def ring_order(system: PinholeSystem) -> NDArray[np.intp]:
    """Places (M,) of the modules in the system, ring by ring along +z, and along the rings the way most run already.

    An open ring begins beside its gap, a closed one at the module that comes first in the system.
    ``system[ring_order(system)]`` is the system in that order; numbers stay with their modules.

    Raises
    ------
    InputError
        It is no system.
    """
    instance(system, PinholeSystem, "ring_order")
    ring_of = system.rings()
    rings = [np.flatnonzero(ring_of == ring) for ring in range(ring_of.max() + 1)]
    clockwise = _run_clockwise(system, rings)
    return np.concatenate([_in_order(system, which, clockwise)[1] for which in rings])


def _run_clockwise(system: PinholeSystem, rings: Sequence[NDArray[np.intp]]) -> bool:
    """Whether azimuths fall along most of the system's rings."""
    orders = [np.argsort(_azimuths(system, which), kind="stable") for which in rings]
    falls = sum(np.count_nonzero(np.diff(order) < 0) for order in orders)
    return bool(2 * falls > sum(len(order) for order in orders))


def _azimuths(system: PinholeSystem, which: NDArray[np.intp]) -> Array:
    return np.arctan2(system.centers[which, 1], system.centers[which, 0])


def _in_order(system: PinholeSystem, which: NDArray[np.intp], clockwise: bool) -> tuple[Array, NDArray[np.intp]]:
    """The modules `which` in their order along the ring, and their azimuths without a jump.

    An open ring begins beside its gap, a closed one at the module that comes first in the system.
    """
    azimuths = _azimuths(system, which)
    order = np.argsort(azimuths, kind="stable")
    if clockwise:
        order = order[::-1]
    steps = np.diff(azimuths[order], append=azimuths[order[0]])
    gaps = np.mod(-steps if clockwise else steps, _FULL_TURN)
    closed = gaps.max() < _OPEN_GAP * _FULL_TURN / len(which)
    first = int(np.argmin(order)) if closed else int(np.argmax(gaps)) + 1
    order = np.roll(order, -first)
    return np.unwrap(azimuths[order]), which[order]


@dataclass(frozen=True, eq=False)
class _Ellipse:
    semi_axes: Array
    center: Array
    rotation: float

    @classmethod
    def checked(cls, semi_axes: ArrayLike, center: ArrayLike, rotation: float) -> _Ellipse:
        axes = real_array(np.broadcast_to(semi_axes, 2) if np.ndim(semi_axes) == 0 else semi_axes, "semi_axes", (2,))
        if np.any(axes <= 0):
            raise InputError(f"semi_axes: expected more than 0 mm, got {axes.min():g}")
        ellipse = cls(axes, real_array(center, "center", (2,)), float(real_array(rotation, "rotation", ())))
        if not ellipse.holds_isocentre:
            raise InputError(
                f"the isocentre must be inside the ellipse, but its centre is {np.linalg.norm(ellipse.center):g} mm off"
            )
        return ellipse

    @property
    def axes(self) -> Array:
        """Unit vectors (2, 2) of its axes, as columns."""
        cosine, sine = math.cos(self.rotation), math.sin(self.rotation)
        return np.array([[cosine, -sine], [sine, cosine]])

    @property
    def holds_isocentre(self) -> bool:
        return bool(np.linalg.norm(self.center @ self.axes / self.semi_axes) < 1)

    def at(self, azimuths: Array) -> Array:
        """Where rays from the isocentre at `azimuths` cross it: (..., 2), mm."""
        rays = np.stack([np.cos(azimuths), np.sin(azimuths)], axis=-1)
        # In units of the semi-axes it is a circle: |r ray - center| = 1.
        ray, center = rays @ self.axes / self.semi_axes, self.center @ self.axes / self.semi_axes
        squared, along = (ray**2).sum(axis=-1), ray @ center
        distance = (along + np.sqrt(along**2 + squared * (1 - center @ center))) / squared
        return distance[..., None] * rays

    def at_angle(self, angle: Array) -> Array:
        """Its points (N, 2), mm, at eccentric angles, rad."""
        return self.center + np.stack([np.cos(angle), np.sin(angle)], axis=1) * self.semi_axes @ self.axes.T

    def distances(self, points: Array) -> tuple[Array, Array, Array]:
        """Signed distances (N,) of points from it, mm, the normals (N, 2) and angles (N,) of the closest points."""
        local = (points - self.center) @ self.axes
        a, b = self.semi_axes
        angle = np.arctan2(local[:, 1] / b, local[:, 0] / a)
        for _ in range(_FIT_STEPS):  # Newton's method: the way to the point stands across the tangent
            x, y = a * np.cos(angle), b * np.sin(angle)
            off_x, off_y = x - local[:, 0], y - local[:, 1]
            slope = a * a * np.sin(angle) ** 2 + b * b * np.cos(angle) ** 2
            step = (-off_x * y * a / b + off_y * x * b / a) / np.maximum(slope - off_x * x - off_y * y, 0.1 * slope)
            angle = angle - step
            if np.abs(step).max() < 1e-14:
                break
        closest = np.stack([a * np.cos(angle), b * np.sin(angle)], axis=1)
        normals = np.stack([np.cos(angle) / a, np.sin(angle) / b], axis=1)
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        return ((local - closest) * normals).sum(axis=1), normals @ self.axes.T, angle


def _fit_ellipse(points: Array) -> _Ellipse | None:
    """The ellipse of least squares of the distances of `points` (N, 2); None if there is none around the isocentre."""
    ellipse = _direct_ellipse(points) if len(points) >= _FEWEST_ON_ELLIPSE else None
    if ellipse is None:
        return None
    for _ in range(_FIT_STEPS):
        distance, normal, angle = ellipse.distances(points)
        across, arm = normal @ ellipse.axes, ellipse.at_angle(angle) - ellipse.center
        columns = [
            *(across * np.stack([np.cos(angle), np.sin(angle)], axis=1)).T,
            *normal.T,
            normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1],
        ]
        step, *_ = np.linalg.lstsq(np.stack(columns, axis=1), distance, rcond=1e-9)
        better = _Ellipse(ellipse.semi_axes + step[:2], ellipse.center + step[2:4], ellipse.rotation + float(step[4]))
        if np.any(better.semi_axes <= 0) or not (better.distances(points)[0] ** 2).sum() < (distance**2).sum():
            break
        ellipse = better
    quarters = round(ellipse.rotation / (math.pi / 2))
    axes = ellipse.semi_axes[::-1] if quarters % 2 else ellipse.semi_axes
    ellipse = _Ellipse(axes, ellipse.center, ellipse.rotation - quarters * math.pi / 2)
    return ellipse if ellipse.holds_isocentre else None


def _direct_ellipse(points: Array) -> _Ellipse | None:
    """Halir and Flusser's fit: the least algebraic distance among the conics that are ellipses."""
    middle = points.mean(axis=0)
    size = float(np.abs(points - middle).max())
    x, y = (points - middle).T / size
    quadratic, linear = np.stack([x * x, x * y, y * y], axis=1), np.stack([x, y, np.ones_like(x)], axis=1)
    try:
        reduction = -np.linalg.solve(linear.T @ linear, linear.T @ quadratic)
        scatter = quadratic.T @ (quadratic + linear @ reduction)
        _, vectors = np.linalg.eig(np.stack([scatter[2] / 2, -scatter[1], scatter[0] / 2]))
    except np.linalg.LinAlgError:  # all on one line
        return None
    vectors = vectors.real
    is_ellipse = 4 * vectors[0] * vectors[2] - vectors[1] ** 2
    best = vectors[:, int(np.argmax(is_ellipse))]
    if is_ellipse.max() <= 0:
        return None
    matrix = np.array([[best[0], best[1] / 2], [best[1] / 2, best[2]]])
    gradient = reduction @ best
    center = -np.linalg.solve(2 * matrix, gradient[:2])
    values, axes = np.linalg.eigh(matrix)
    squares = -(gradient[2] + gradient[:2] @ center / 2) / values
    if not np.all(squares > 0):
        return None
    rotation = math.atan2(axes[1, 0], axes[0, 0]) if np.ptp(squares) > 1e-12 * squares.max() else 0.0
    return _Ellipse(size * np.sqrt(squares), middle + size * center, rotation)


def _even_azimuths(ellipse: _Ellipse, modules: Any, start: float, end: float, spacing: str) -> Array:
    count = whole_number(modules, "modules")
    if count > _MOST_MODULES:
        raise InputError(f"modules: expected at most {_MOST_MODULES} in a ring, got {count}")
    start, end = (float(real_array(x, name, ())) for x, name in ((start, "start"), (end, "end")))
    turn = abs(end - start)
    closed = abs(turn - _FULL_TURN) < 1e-9
    if turn > _FULL_TURN + 1e-9:
        raise InputError(f"start and end: expected at most a full turn apart, got {math.degrees(turn):g} degrees")
    shares = np.linspace(0, 1, count, endpoint=not closed)
    if spacing == "angle":
        return start + shares * (end - start)
    if spacing != "arc":
        raise InputError(f"spacing {spacing!r}: expected 'angle' or 'arc'")
    fine = np.linspace(start, end, _ARC_STEPS + 1)
    chords = np.linalg.norm(np.diff(ellipse.at(fine), axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(chords)])
    return np.interp(shares * travelled[-1], travelled, fine)


def _rings(
    places: Array,
    z: ArrayLike,
    mirrored: bool,
    pinhole_diameter: ArrayLike,
    detector_side: ArrayLike,
    detector_thickness: ArrayLike,
    roi_radius: ArrayLike,
    collimator_length: ArrayLike | None,
) -> PinholeSystem:
    """Modules at `places` ((rings,) M, 2), mm, in rings at `z`."""
    heights = np.atleast_1d(real_array(z, "z", (None,) * min(np.ndim(z), 2)))
    if heights.ndim == 1:
        heights = heights[:, None]
    if places.ndim == 2:
        places = places[None]
    try:
        shape = np.broadcast_shapes(heights.shape, places.shape[:2])
    except ValueError:
        rings, n = places.shape[:2]
        raise InputError(
            f"z: expected one number, one for each of {f'the {rings}' if rings > 1 else 'the'} rings, or rings x {n}, "
            f"got shape {' x '.join(map(str, np.shape(z)))}"
        ) from None
    centers = np.concatenate([np.broadcast_to(places, (*shape, 2)), np.broadcast_to(heights, shape)[..., None]], axis=2)
    if mirrored:
        if np.any(heights == 0):
            raise InputError("mirrored: a ring at z = 0 is its own mirror image; expected z other than 0")
        centers = np.concatenate([centers, centers[::-1] * [1, 1, -1]])
    centers = centers.reshape(-1, 3)
    d, side, thickness, radius = (
        real_array(value, name, (len(centers),) if np.ndim(value) else ())
        for name, value in (
            ("pinhole_diameter", pinhole_diameter),
            ("detector_side", detector_side),
            ("detector_thickness", detector_thickness),
            ("roi_radius", roi_radius),
        )
    )
    if collimator_length is None:
        collimator_length = designed_length(np.linalg.norm(centers, axis=1), d, side, radius)
    return PinholeSystem(centers, d, collimator_length, side, thickness, radius)  # type: ignore[arg-type]  # or numbers
