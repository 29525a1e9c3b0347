"""Checks of a system of pinhole modules: whether it can be built, and whether every module sees its ROI.

`check_geometry` runs all checks and returns a `GeometryReport`, whose `messages` are one line for each finding.

To add a check, write a `Finding` with its message in report.py, a function ``find_...`` that returns a tuple of them, in one
of the files below, and a field of `GeometryReport` that `check_geometry` fills. The command line and the window follow.

hulls.py          convex hulls of the modules' parts
overlaps.py       parts that overlap, pinholes in other modules, collimators in the ROI
field_of_view.py  ROIs outside the field of view, modules in the way
plates.py         aperture plates that are too thick or too thin
report.py         the findings
"""

from ...validation import instance
from ..collimator import OPENING_ANGLE, Construction, EdgePlace
from ..module_parts import surface_fault
from ..system import PinholeSystem
from .field_of_view import find_blocked, find_uncovered
from .hulls import Hulls
from .overlaps import find_intrusions, find_near_pairs, find_overlaps, find_swallowed_pinholes
from .plates import find_thin_plates, find_vignetted
from .report import GeometryReport, OpenMesh

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
    """Find parts that overlap, ROIs that are not seen whole, blocked holes, unsuitable plates and open surfaces.

    The first four settings are those of `core.geometry.collimator.Construction`: thicknesses in mm, the angle in rad, and
    the place of the knife edge in the plate. With `aperture_mu`, the plates' attenuation coefficient, 1/mm (see
    `attenuation`), plates that are too thin are found, too.

    >>> check_geometry(system).ok
    True
    """
    instance(system, PinholeSystem, "check_geometry")
    construction = Construction(plate_thickness, wall_thickness, opening_angle, edge_at)
    collimators = system.collimators(construction)
    parts = system.parts(construction)
    hulls = Hulls.from_parts(parts)
    faults = [(part, surface_fault(part.solid)) for part in parts]
    return GeometryReport(
        n_modules=len(system),
        **vars(construction),
        overlaps=find_overlaps(hulls),
        near_pairs=find_near_pairs(system, collimators),
        swallowed_pinholes=find_swallowed_pinholes(system, hulls),
        intrusions=find_intrusions(system, collimators),
        uncovered=find_uncovered(system),
        blocked=find_blocked(system, hulls),
        vignetted=find_vignetted(system, collimators),
        thin_plates=() if aperture_mu is None else find_thin_plates(system, collimators, aperture_mu),
        open_meshes=tuple(OpenMesh(part.number, part.kind, fault) for part, fault in faults if fault),
    )
