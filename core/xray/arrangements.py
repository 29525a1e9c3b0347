"""X-ray systems from a few parameters: sources on an arc or a ring, each with a panel on the opposite side.

Without arguments, both return 24 sources that suit the users' scanner, whose modules fill the azimuths from 14.3 to 255.6
degrees within 120 mm of the plane z = 0, and see a sphere of 75 mm: an arc in the open side, so high that most of each cone
passes below the modules opposite, and a ring above all modules. Neighbouring panels overlap: each stands for the part of
one detector that its source sees. Azimuths are polar angles about the isocentre, rad, from +x towards +y.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from ..geometry.frames import module_frames
from ..geometry.generators import FULL_TURN
from ..validation import lengths, positive, radians, real_array, whole_number, whole_shape
from .system import XraySystem


def xray_arc(
    n: int = 24,
    *,
    start: float = math.radians(-98.0),
    end: float = math.radians(8.0),
    source_radius: float = 300.0,
    panel_radius: float = 400.0,
    panel_size: ArrayLike = 350.0,
    shape: tuple[int, int] = (128, 128),
    z: float = 200.0,
    kvp: ArrayLike = 80.0,
    mas: ArrayLike = 1.0,
    filters: Any = "Al 2.5",
    focal_spot: ArrayLike = 1.0,
) -> XraySystem:
    """Create sources on an arc, such as in the open side of the scanner, with panels on the opposite side.

    Parameters
    ----------
    n
        Number of sources.
    start, end
        Azimuths of the first and the last source, rad; a full turn apart they form a closed ring, see `xray_ring`.
    source_radius, panel_radius
        Distances of the sources and of the panels' centres from the isocentre, mm.
    panel_size
        Width and height of the panels, mm, or one number for both. They are at right angles to the ray through the
        isocentre, with their rows along the arc: where the sources are above its plane, the panels are tilted.
    shape
        Pixels (n_v, n_u) of each panel.
    z
        z of the sources, mm. The panels stand on the other side of the isocentre.
    kvp, mas, filters, focal_spot
        As for `XraySystem`.
    """
    count = whole_number(n, "number of sources")
    first, last = (float(radians(value, name)) for value, name in ((start, "start"), (end, "end")))
    if (span := abs(last - first)) > FULL_TURN + 1e-9:
        raise InputError(f"start and end: expected at most a full turn apart, got {math.degrees(span):g} degrees")
    distance, height = positive(source_radius, "source_radius", "mm"), float(real_array(z, "z", ()))
    if abs(height) >= distance:
        raise InputError(f"z: expected less than the sources' {distance:g} mm from the isocentre, got {height:g}")
    azimuths = np.linspace(first, last, count, endpoint=span < FULL_TURN - 1e-9)  # a closed ring has no end
    radius = math.sqrt(distance**2 - height**2)
    sources = np.stack([radius * np.cos(azimuths), radius * np.sin(azimuths), np.full(count, height)], axis=1)
    u, v, k = module_frames(sources).transpose(1, 0, 2)
    (panel_width, panel_height), (n_v, n_u) = lengths(panel_size, "panel_size", 2), whole_shape(shape, "shape", 2)
    centers = positive(panel_radius, "panel_radius", "mm") * k
    tube = {"filters": filters, "focal_spot": focal_spot}
    return XraySystem(sources, centers, panel_width / n_u * u, panel_height / n_v * v, (n_v, n_u), kvp, mas, **tube)  # type: ignore[arg-type]


def xray_ring(n: int = 24, *, z: float = 310.0, start: float = 0.0, **settings: Any) -> XraySystem:
    """Create a closed ring of sources above the modules, or below with z < 0, with tilted panels on the opposite side.

    `start` is the azimuth of the first source, rad; the settings are those of `xray_arc`.
    """
    defaults = {"source_radius": 400.0, "panel_size": 300.0}
    return xray_arc(n, z=z, start=start, end=start + FULL_TURN, **{**defaults, **settings})
