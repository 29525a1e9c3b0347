"""The findings of the checks, as numbers and as one line each. Modules are named by their users' numbers."""

import math
from dataclasses import asdict, dataclass
from typing import Any

from ..collimator import EdgePlace
from ..finding import Finding
from ..part_colors import PartKind


@dataclass(frozen=True)
class Overlap(Finding):
    """Parts of two modules, taken as convex bodies, penetrate each other."""

    first: int
    first_part: PartKind
    second: int
    second_part: PartKind
    depth: float  # mm, of the shortest translation that separates them
    point: tuple[float, float, float]  # inside both, world mm
    message = (
        "modules {0.first} and {0.second}: {0.first_part} and {0.second_part} overlap, {0.depth:.4g} mm deep at "
        "({0.point[0]:.1f}, {0.point[1]:.1f}, {0.point[2]:.1f}) mm"
    )


@dataclass(frozen=True)
class NearPair(Finding):
    """Two pinholes are `distance` mm apart, which is too close for their fronts to stand side by side."""

    first: int
    second: int
    distance: float
    message = "modules {0.first} and {0.second}: nearly at one place, pinholes {0.distance:.4g} mm apart"


@dataclass(frozen=True)
class SwallowedPinhole(Finding):
    """A pinhole's centre lies `depth` mm below the surface of another module's part, taken as a convex body."""

    module: int
    by: int
    part: PartKind
    depth: float
    message = "module {0.module}: its pinhole lies {0.depth:.4g} mm inside module {0.by}'s {0.part}"


@dataclass(frozen=True)
class Intrusion(Finding):
    """A module's collimator reaches `depth` mm into the largest ROI, whose radius is `roi_radius` mm."""

    module: int
    roi_radius: float
    depth: float
    message = "module {0.module}: its collimator reaches {0.depth:.4g} mm into the ROI of {0.roi_radius:.4g} mm"


@dataclass(frozen=True)
class Uncovered(Finding):
    """A module's field of view does not hold its ROI."""

    module: int
    roi_radius: float  # mm
    seen_radius: float  # mm, of the largest sphere at the isocentre in the field of view
    unseen_share: float  # fraction of the ROI's volume outside the field of view
    message = (
        "module {0.module}: sees {0.seen_radius:.4g} mm around the isocentre, {0.shortage:.4g} mm less than its ROI radius; "
        "{0.unseen_share:.3%} of the ROI is outside its field of view"
    )

    @property
    def shortage(self) -> float:
        """Missing radius, mm."""
        return self.roi_radius - self.seen_radius


@dataclass(frozen=True)
class Blocked(Finding):
    """Another module stands in the way of a fraction `share` of the rays (of the solid angle) from ROI to pinhole."""

    module: int
    by: int
    share: float
    message = "module {0.module}: module {0.by} blocks {0.share:.2%} of the rays from its ROI"


@dataclass(frozen=True)
class Vignetted(Finding):
    """The plate is too thick for the hole's opening angle and shades the hole from part of the ROI."""

    module: int
    open_share: float  # fraction of the hole's area that is open to the steepest rays from the ROI
    plate_thickness: float  # mm
    opening_angle: float  # rad
    needed_angle: float  # rad; with it, a plate of any thickness would leave the hole open
    message = (
        "module {0.module}: only {0.open_share:.1%} of its hole is open to the rim of its ROI: a plate of "
        "{0.plate_thickness:.4g} mm is too thick for an opening angle of {1:.4g} degrees, {2:.1f} are needed"
    )

    def __str__(self) -> str:
        # Rounded up, so that a plate of that angle passes.
        needed = math.ceil(math.degrees(self.needed_angle) * 10) / 10
        return self.message.format(self, math.degrees(self.opening_angle), needed)


@dataclass(frozen=True)
class ThinPlate(Finding):
    """The plate lets through a fraction `transmission` of the photons along the axis."""

    module: int
    plate_thickness: float  # mm
    transmission: float
    share: float  # photons that pass the plate beside the hole, relative to those that pass the hole and its edge
    message = (
        "module {0.module}: its plate of {0.plate_thickness:.4g} mm lets {0.transmission:.2%} of the photons through: "
        "{0.share:.2%} as many pass beside the hole as pass the hole"
    )


@dataclass(frozen=True)
class OpenMesh(Finding):
    """The surface of a part is not closed, not consistently wound, or inside out."""

    module: int
    part: PartKind
    fault: str
    message = "module {0.module}: its {0.part}'s mesh {0.fault}"


@dataclass(frozen=True)
class GeometryReport:
    """What `check_geometry` found in so many modules of that construction (mm, mm, rad).

    The findings of each kind are in the order of the modules.
    """

    n_modules: int
    plate_thickness: float
    wall_thickness: float
    opening_angle: float
    edge_at: EdgePlace
    overlaps: tuple[Overlap, ...] = ()
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
        """All findings."""
        return tuple(finding for kind in vars(self).values() if isinstance(kind, tuple) for finding in kind)

    @property
    def ok(self) -> bool:
        """Whether nothing was found."""
        return not self.findings

    def messages(self, module: int | None = None) -> list[str]:
        """One line for each finding, or only for those that concern the module of the given number."""
        return [str(finding) for finding in self.findings if module is None or module in finding.modules]

    def as_dict(self) -> dict[str, Any]:
        """The report as numbers, strings and lists, for JSON."""
        return {**asdict(self), "ok": self.ok}
