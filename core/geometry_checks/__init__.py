"""Can the scanner be built, and does every module see what it should?

hulls.py     the parts' convex hulls
overlaps.py  parts that penetrate each other, by separating axes
coverage.py  the field of view beside the ROI
blocking.py  rays from the ROI that meet another module
places.py    pinholes and modules where none can be
meshes.py    closed surfaces, by trimesh
report.py    what was found
"""

from __future__ import annotations

from ..checks import instance
from ..module_parts import module_parts
from ..system import PinholeSystem
from .blocking import find_blocked
from .coverage import find_uncovered
from .hulls import Hulls
from .meshes import find_open_meshes
from .overlaps import find_overlaps
from .places import find_intrusions, find_near_pairs, find_swallowed_pinholes
from .report import GeometryReport

__all__ = ["GeometryReport", "check_geometry"]


def check_geometry(
    system: PinholeSystem, *, plate_thickness: float = 2.0, wall_thickness: float = 2.0
) -> GeometryReport:
    """Look for parts that overlap, an ROI that is not seen, blocked holes, and surfaces that are not closed.

    Parameters
    ----------
    system
        The modules.
    plate_thickness, wall_thickness
        Of the aperture plates and of the collimators' walls, mm: the solids are those of `core.collimator_mesh`.

    Raises
    ------
    InputError
        The collimators cannot be built so.

    Examples
    --------
    >>> report = check_geometry(system)
    >>> report.ok
    True
    """
    instance(system, PinholeSystem, "check_geometry")
    parts = module_parts(system, plate_thickness, wall_thickness)
    hulls = Hulls.of(parts)
    return GeometryReport(
        n_modules=len(system),
        plate_thickness=float(plate_thickness),
        wall_thickness=float(wall_thickness),
        overlaps=find_overlaps(hulls),
        near_pairs=find_near_pairs(system, float(wall_thickness)),
        swallowed_pinholes=find_swallowed_pinholes(system, hulls),
        intrusions=find_intrusions(system),
        uncovered=find_uncovered(system),
        blocked=find_blocked(system, hulls),
        open_meshes=find_open_meshes(parts),
    )
