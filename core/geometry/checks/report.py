"""Findings of the checks, as numbers and as one line each. Modules are named by their numbers in the workbook."""

import math
from dataclasses import asdict, dataclass
from typing import Any

from ..collimator import EdgePlace
from ..part_colors import PartKind
from ..scanner import Finding


@dataclass(frozen=True)
class PartOverlap(Finding):
    """Overlap of parts of two modules, taken as convex bodies."""

    first: int  # number of one module
    first_part: PartKind
    second: int  # number of the other module
    second_part: PartKind
    depth: float  # length of the shortest translation that separates the parts, mm
    point: tuple[float, float, float]  # a point inside both parts, world mm
    message = (
        "modules {0.first} and {0.second}: {0.first_part} and {0.second_part} overlap, {0.depth:.4g} mm deep at "
        "({0.point[0]:.1f}, {0.point[1]:.1f}, {0.point[2]:.1f}) mm"
    )


@dataclass(frozen=True)
class NearPair(Finding):
    """Pair of pinholes that are too close for the fronts of their collimators to stand side by side."""

    first: int  # number of one module
    second: int  # number of the other module
    distance: float  # distance from pinhole to pinhole, mm
    message = "modules {0.first} and {0.second}: nearly at one place, pinholes {0.distance:.4g} mm apart"


@dataclass(frozen=True)
class SwallowedPinhole(Finding):
    """Pinhole whose centre lies inside another module's part, taken as a convex body."""

    module: int  # number of the pinhole's module
    by: int  # number of the other module
    part: PartKind  # the other module's part
    depth: float  # depth of the pinhole's centre below the part's surface, mm
    message = "module {0.module}: its pinhole lies {0.depth:.4g} mm inside module {0.by}'s {0.part}"


@dataclass(frozen=True)
class Intrusion(Finding):
    """Collimator that reaches into the largest ROI."""

    module: int  # number of the module
    roi_radius: float  # radius of the largest ROI, mm
    depth: float  # depth of the collimator's nearest point below the surface of the ROI, mm
    message = "module {0.module}: its collimator reaches {0.depth:.4g} mm into the ROI of {0.roi_radius:.4g} mm"


@dataclass(frozen=True)
class Uncovered(Finding):
    """ROI that is partly outside its module's field of view."""

    module: int  # number of the module
    roi_radius: float  # mm
    seen_radius: float  # radius of the largest sphere at the isocentre in the field of view, mm
    unseen_share: float  # fraction of the ROI's volume outside the field of view
    message = (
        "module {0.module}: sees {0.seen_radius:.4g} mm around the isocentre, {0.shortage:.4g} mm less than its ROI radius; "
        "{0.unseen_share:.3%} of the ROI is outside its field of view"
    )

    @property
    def shortage(self) -> float:
        """Difference between the radius of the ROI and that of the seen sphere, mm."""
        return self.roi_radius - self.seen_radius


@dataclass(frozen=True)
class Blocked(Finding):
    """View that another module blocks partly."""

    module: int  # number of the module whose view is blocked
    by: int  # number of the module that stands in the way
    share: float  # blocked fraction of the solid angle of the rays from the ROI to the pinhole
    message = "module {0.module}: module {0.by} blocks {0.share:.2%} of the rays from its ROI"


@dataclass(frozen=True)
class Vignetted(Finding):
    """Hole that its plate, too thick for the opening angle, shades from part of the ROI."""

    module: int  # number of the module
    open_share: float  # fraction of the hole's area that is open to the steepest rays from the ROI
    plate_thickness: float  # mm
    opening_angle: float  # rad
    needed_angle: float  # opening angle with which a plate of any thickness would leave the hole open, rad
    message = (
        "module {0.module}: only {0.open_share:.1%} of its hole is open to the rim of its ROI: a plate of "
        "{0.plate_thickness:.4g} mm is too thick for an opening angle of {1:.4g} degrees, {2:.1f} are needed"
    )

    def __str__(self) -> str:
        # The angle is rounded up, so that a plate with the angle of the message passes the check.
        needed = math.ceil(math.degrees(self.needed_angle) * 10) / 10
        return self.message.format(self, math.degrees(self.opening_angle), needed)


@dataclass(frozen=True)
class ThinPlate(Finding):
    """Plate that is too thin to stop the photons beside the hole."""

    module: int  # number of the module
    plate_thickness: float  # mm
    transmission: float  # fraction of the photons along the axis that pass the plate
    share: float  # photons that pass the plate beside the hole, relative to those that pass the hole and its edge
    message = (
        "module {0.module}: its plate of {0.plate_thickness:.4g} mm lets {0.transmission:.2%} of the photons through: "
        "{0.share:.2%} as many pass beside the hole as pass the hole"
    )


@dataclass(frozen=True)
class OpenMesh(Finding):
    """Surface of a part that is not closed, not consistently oriented, or inside out."""

    module: int  # number of the module
    part: PartKind
    fault: str  # the fault as a phrase that follows "mesh" in the message
    message = "module {0.module}: its {0.part}'s mesh {0.fault}"


@dataclass(frozen=True)
class GeometryReport:
    """Report of `check_geometry`: the findings of each kind, in the order of the modules, and the construction."""

    n_modules: int
    plate_thickness: float  # mm
    wall_thickness: float  # mm
    opening_angle: float  # rad
    edge_at: EdgePlace
    overlaps: tuple[PartOverlap, ...] = ()
    near_pairs: tuple[NearPair, ...] = ()
    swallowed_pinholes: tuple[SwallowedPinhole, ...] = ()
    intrusions: tuple[Intrusion, ...] = ()
    uncovered: tuple[Uncovered, ...] = ()
    blocked: tuple[Blocked, ...] = ()
    vignetted: tuple[Vignetted, ...] = ()
    thin_plates: tuple[ThinPlate, ...] = ()
    open_meshes: tuple[OpenMesh, ...] = ()

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All findings, kind by kind."""
        return tuple(finding for kind in vars(self).values() if isinstance(kind, tuple) for finding in kind)

    @property
    def ok(self) -> bool:
        """Whether there are no findings."""
        return not self.findings

    def messages(self, module: int | None = None) -> list[str]:
        """Return one line for each finding, or only for those that concern the module with the number `module`."""
        return [str(finding) for finding in self.findings if module is None or module in finding.modules]

    def as_dict(self) -> dict[str, Any]:
        """Return the report as numbers, strings and lists, for JSON."""
        return {**asdict(self), "ok": self.ok}
