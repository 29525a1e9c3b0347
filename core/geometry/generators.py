"""Generators of systems from a few parameters: rings of modules on an ellipse or on flat plates.

Azimuths are polar angles about the isocentre, rad, from +x towards +y, as in the users' workbook.
"""

import math
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from ..arrays import ArrayLike, Floats
from ..errors import InputError
from ..validation import lengths, positive, radians, real_array, whole_number
from .design_formulas import collimator_length as designed_length
from .ellipse import Ellipse
from .system import PinholeSystem

Spacing = Literal["angle", "arc"]

FULL_TURN = 2 * math.pi
_MAX_MODULES = 10_000
# Number of chords whose lengths are summed to an arc's length, which they miss by 1e-9 of it.
_ARC_STEPS = 1 << 15


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
    end: float = FULL_TURN,
    spacing: Spacing = "angle",
    center: ArrayLike = (0.0, 0.0),
    rotation: float = 0.0,
    mirrored: bool = False,
) -> PinholeSystem:
    """Return a system of rings of modules on an ellipse around the isocentre, ring by ring.

    Parameters
    ----------
    modules
        Number of evenly spaced modules in each ring; or the azimuths themselves, rad, (M,) or (rings, M).
    semi_axes
        Semi-axes of the ellipse through the pinholes, mm: along x and y before rotation, or one number for a circle.
    z
        z of the rings, mm: one number, (rings,), or (rings, M) if it differs from module to module.
    pinhole_diameter, detector_side, detector_thickness, roi_radius
        d, Ld, Td and R, mm; one number, or one for each module of the system.
    collimator_length
        l, mm; one number, or one for each module of the system. Default: from the design formula,
        `core.geometry.design_formulas.collimator_length`.
    start, end
        Azimuths of a ring's first and last module, rad, in either direction. A full turn apart, they describe a closed
        ring, whose last module is one step before `end`.
    spacing
        ``"angle"``: equal steps in azimuth; ``"arc"``: equal lengths along the ellipse.
    center, rotation
        Centre (x, y) of the ellipse, mm, and its rotation about it, rad. The isocentre must be inside the ellipse.
    mirrored
        Append the rings' mirror images at z = 0, beginning with that of the last ring.
    """
    turn = float(radians(rotation, "rotation"))
    ellipse = Ellipse(lengths(semi_axes, "semi_axes", 2), real_array(center, "center", (2,)), turn)
    if not ellipse.holds_isocentre:
        off = float(np.linalg.norm(ellipse.center))
        raise InputError(f"the isocentre must be inside the ellipse, but its centre is {off:g} mm off")
    if np.ndim(modules) == 0:
        azimuths = even_azimuths(ellipse, modules, start, end, spacing)
    else:
        azimuths = radians(modules, "azimuths", (None,) * min(np.ndim(modules), 2))
    sizes = (pinhole_diameter, detector_side, detector_thickness, roi_radius)
    return _system_of_rings(ellipse.points_at(azimuths), z, mirrored, collimator_length, *sizes)


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
    """Return a system of rings of modules on flat plates, ring by ring and plate by plate.

    The n modules of a plate stand in the middles of n equal parts of it, and aim at the isocentre like all modules.
    `modules` is the number of modules on each plate in each ring, or a sequence with one number for each plate (0 for none).
    `vertices` (V, 2) are x and y of the plates' edges, mm, in order, such as those of `regular_polygon`; if `closed`, a
    plate joins the last to the first. The other parameters are described at `ellipse_rings`.
    """
    corners = real_array(vertices, "vertices", (None, 2))
    if len(corners) < 2 + closed:
        raise InputError(f"vertices: expected at least {2 + closed}, got {len(corners)}")
    ends = np.roll(corners, -1, axis=0) if closed else corners[1:]
    starts = corners[: len(ends)]
    try:
        counts = np.broadcast_to(modules, len(starts)) if np.ndim(modules) == 0 else np.asarray(modules)
    except ValueError:  # lists of different lengths
        counts = np.empty(0)
    are_integers = counts.shape == (len(starts),) and counts.dtype.kind in "iu"
    if not are_integers or counts.min() < 0 or not 0 < counts.max() <= _MAX_MODULES:
        expected = f"a whole number up to {_MAX_MODULES}, or one for each of the {len(starts)} plates"
        raise InputError(f"modules: expected {expected}, got {modules}")
    fractions = np.concatenate([(np.arange(n) + 0.5) / n for n in counts if n])[:, None]  # positions along the plate
    positions = (1 - fractions) * np.repeat(starts, counts, axis=0) + fractions * np.repeat(ends, counts, axis=0)
    sizes = (pinhole_diameter, detector_side, detector_thickness, roi_radius)
    return _system_of_rings(positions, z, mirrored, collimator_length, *sizes)


def regular_polygon(sides: int, apothem: float, rotation: float = 0.0) -> Floats:
    """Return the vertices (sides, 2), mm, of a regular polygon around the isocentre, for `plate_rings`.

    The plates are `apothem` mm from the isocentre; the middle of the first has the azimuth `rotation`, rad.
    """
    if (sides := whole_number(sides, "sides")) < 3:
        raise InputError(f"sides: expected at least 3, got {sides}")
    angles = float(radians(rotation, "rotation")) + (2 * np.arange(sides) - 1) * math.pi / sides
    radius = positive(apothem, "apothem", "mm") / math.cos(math.pi / sides)
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def even_azimuths(ellipse: Ellipse, modules: Any, start: float, end: float, spacing: str) -> Floats:
    """Return the azimuths (M,), rad, of evenly spaced modules on an ellipse.

    `modules` is their number; `start` and `end` are the azimuths of the first and last, rad, and `spacing` is "angle" or
    "arc", as described at `ellipse_rings`.
    """
    if (count := whole_number(modules, "modules")) > _MAX_MODULES:
        raise InputError(f"modules: expected at most {_MAX_MODULES} in a ring, got {count}")
    start, end = (float(real_array(x, name, ())) for x, name in ((start, "start"), (end, "end")))
    if (turn := abs(end - start)) > FULL_TURN + 1e-9:
        raise InputError(f"start and end: expected at most a full turn apart, got {math.degrees(turn):g} degrees")
    closed = turn >= FULL_TURN - 1e-9
    fractions = np.linspace(0, 1, count, endpoint=not closed)  # positions between start and end
    if spacing == "angle":
        return start + fractions * (end - start)
    if spacing != "arc":
        raise InputError(f"spacing {spacing!r}: expected 'angle' or 'arc'")
    steps = np.linspace(start, end, _ARC_STEPS + 1)
    chords = np.linalg.norm(np.diff(ellipse.points_at(steps), axis=0), axis=1)
    arc_lengths = np.concatenate([[0.0], np.cumsum(chords)])
    return np.interp(fractions * arc_lengths[-1], arc_lengths, steps)


def _system_of_rings(
    positions: Floats, z: ArrayLike, mirrored: bool, collimator_length: ArrayLike | None, *sizes: ArrayLike
) -> PinholeSystem:
    """Return the system of modules at x and y `positions` ((rings,) M, 2) in rings at heights `z`, mm.

    `sizes` are d, Ld, Td and R, mm; the other arguments are described at `ellipse_rings`.
    """
    heights = np.atleast_1d(real_array(z, "z", (None,) * min(np.ndim(z), 2)))
    heights = heights[:, None] if heights.ndim == 1 else heights
    xy = positions[None] if positions.ndim == 2 else positions
    try:
        shape = np.broadcast_shapes(heights.shape, xy.shape[:2])
    except ValueError:
        rings, n = xy.shape[:2]
        expected = f"one number, one for each of {f'the {rings}' if rings > 1 else 'the'} rings, or rings x {n}"
        raise InputError(f"z: expected {expected}, got shape {' x '.join(map(str, np.shape(z)))}") from None
    centers = np.concatenate([np.broadcast_to(xy, (*shape, 2)), np.broadcast_to(heights, shape)[..., None]], axis=2)
    if mirrored:
        if np.any(heights == 0):
            raise InputError("mirrored: a ring at z = 0 is its own mirror image; expected z other than 0")
        centers = np.concatenate([centers, centers[::-1] * [1, 1, -1]])
    centers = centers.reshape(-1, 3)
    named = zip(sizes, ("pinhole_diameter", "detector_side", "detector_thickness", "roi_radius"), strict=True)
    d, side, thickness, radius = (real_array(x, name, (len(centers),) if np.ndim(x) else ()) for x, name in named)
    if collimator_length is None:
        collimator_length = designed_length(np.linalg.norm(centers, axis=1), d, side, radius)
    return PinholeSystem(centers, d, collimator_length, side, thickness, radius)  # type: ignore[arg-type]  # or numbers
