"""Can the scanner be built, and does every module see what it should?

hulls.py     the parts' convex hulls
overlaps.py  parts that penetrate each other, by separating axes
coverage.py  the field of view beside the ROI
plates.py    holes that their plate shades from the ROI, and plates that let photons through
blocking.py  rays from the ROI that meet another module
places.py    pinholes and modules where none can be
meshes.py    closed surfaces, by trimesh
report.py    what was found
"""

from __future__ import annotations

from ...validation import instance
from ..collimator import OPENING_ANGLE, Construction, EdgePlace
from ..module_parts import module_collimators, module_parts
from ..system import PinholeSystem
from .blocking import find_blocked
from .coverage import find_uncovered
from .hulls import Hulls
from .meshes import find_open_meshes
from .overlaps import find_overlaps
from .places import find_intrusions, find_near_pairs, find_swallowed_pinholes
from .plates import find_thin_plates, find_vignetted
from .report import GeometryReport

__all__ = ["GeometryReport", "check_geometry"]


def check_geometry(
    system: PinholeSystem,
    *,
    plate_thickness: float = 2.0,
    wall_thickness: float = 2.0,
    opening_angle: float = OPENING_ANGLE,
    edge_at: EdgePlace = "middle",
    aperture_mu: float | None = None,
) -> GeometryReport:
    """Look for parts that overlap, an ROI that is not seen, blocked holes, unfit plates, and surfaces that are not closed.

    Parameters
    ----------
    system
        The modules.
    plate_thickness, wall_thickness
        Of the aperture plates and of the collimators' walls, mm: the solids are those of `core.collimator`.
    opening_angle, edge_at
        Full angle of the holes' double cone, rad, and where in the plate its edge is: "middle", or the face in "front",
        towards the ROI, or "back".
    aperture_mu
        Of the plates' material at the photons' energy, 1/mm (`attenuation`): to see whether they are thick enough. None:
        they stop everything.

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
    construction = Construction(plate_thickness, wall_thickness, opening_angle, edge_at)
    collimators = module_collimators(system, construction)
    parts = module_parts(system, construction)
    hulls = Hulls.of(parts)
    return GeometryReport(
        n_modules=len(system),
        plate_thickness=construction.plate_thickness,
        wall_thickness=construction.wall_thickness,
        opening_angle=construction.opening_angle,
        edge_at=construction.edge_at,
        overlaps=find_overlaps(hulls),
        near_pairs=find_near_pairs(system, collimators),
        swallowed_pinholes=find_swallowed_pinholes(system, hulls),
        intrusions=find_intrusions(system, construction),
        uncovered=find_uncovered(system),
        blocked=find_blocked(system, hulls),
        vignetted=find_vignetted(system, collimators),
        thin_plates=() if aperture_mu is None else find_thin_plates(system, collimators, aperture_mu),
        open_meshes=find_open_meshes(parts),
    )
