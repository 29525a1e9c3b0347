"""The findings of the checks, as numbers and as one line each. Modules are named by their users' numbers."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from ..collimator import EdgePlace
from ..module_parts import Kind


class Finding:
    """Something wrong with one module or with a pair of modules; ``str`` gives it in one line."""

    @property
    def modules(self) -> tuple[int, ...]:
        """Numbers of the modules concerned."""
        return tuple(getattr(self, name) for name in ("first", "second", "module", "by") if hasattr(self, name))


@dataclass(frozen=True)
class Overlap(Finding):
    """Parts of two modules, taken as convex bodies, penetrate each other.

    `depth`, mm, is the shortest translation that separates them, and `point`, world mm, lies inside both.
    """

    first: int
    first_part: Kind
    second: int
    second_part: Kind
    depth: float
    point: tuple[float, float, float]

    def __str__(self) -> str:
        at = ", ".join(f"{x:.1f}" for x in self.point)
        return (
            f"modules {self.first} and {self.second}: {self.first_part} and {self.second_part} overlap, "
            f"{_mm(self.depth)} deep at ({at}) mm"
        )


@dataclass(frozen=True)
class NearPair(Finding):
    """Two pinholes are `distance` mm apart, which is too close for their fronts to stand side by side."""

    first: int
    second: int
    distance: float

    def __str__(self) -> str:
        return f"modules {self.first} and {self.second}: nearly at one place, pinholes {_mm(self.distance)} apart"


@dataclass(frozen=True)
class SwallowedPinhole(Finding):
    """A pinhole's centre lies `depth` mm below the surface of another module's part, taken as a convex body."""

    module: int
    by: int
    part: Kind
    depth: float

    def __str__(self) -> str:
        return f"module {self.module}: its pinhole lies {_mm(self.depth)} inside module {self.by}'s {self.part}"


@dataclass(frozen=True)
class Intrusion(Finding):
    """A module's collimator reaches `depth` mm into the largest ROI, whose radius is `roi_radius` mm."""

    module: int
    roi_radius: float
    depth: float

    def __str__(self) -> str:
        return f"module {self.module}: its collimator reaches {_mm(self.depth)} into the ROI of {_mm(self.roi_radius)}"


@dataclass(frozen=True)
class Uncovered(Finding):
    """A module's field of view does not hold its ROI.

    `seen_radius`, mm, is that of the largest sphere at the isocentre in the field of view, and `unseen_share` the fraction
    of the ROI's volume outside the field of view.
    """

    module: int
    roi_radius: float
    seen_radius: float
    unseen_share: float

    @property
    def shortage(self) -> float:
        """Missing radius, mm."""
        return self.roi_radius - self.seen_radius

    def __str__(self) -> str:
        return (
            f"module {self.module}: sees {_mm(self.seen_radius)} around the isocentre, {_mm(self.shortage)} less than "
            f"its ROI radius; {_percent(self.unseen_share)} of the ROI is outside its field of view"
        )


@dataclass(frozen=True)
class Blocked(Finding):
    """Another module stands in the way of a fraction `share` of the rays (of the solid angle) from ROI to pinhole."""

    module: int
    by: int
    share: float

    def __str__(self) -> str:
        return f"module {self.module}: module {self.by} blocks {_percent(self.share)} of the rays from its ROI"


@dataclass(frozen=True)
class Vignetted(Finding):
    """The plate is too thick for the hole's opening angle and shades the hole from part of the ROI.

    Only the fraction `open_share` of the hole's area is open to the steepest rays from the ROI; with `needed_angle`, rad,
    a plate of any thickness would leave the hole open.
    """

    module: int
    open_share: float
    plate_thickness: float
    opening_angle: float
    needed_angle: float

    def __str__(self) -> str:
        return (
            f"module {self.module}: only {_percent(self.open_share)} of its hole is open to the rim of its ROI: a plate of "
            f"{_mm(self.plate_thickness)} is too thick for an opening angle of {math.degrees(self.opening_angle):.4g} "
            f"degrees, {math.ceil(math.degrees(self.needed_angle) * 10) / 10:g} are needed"
        )


@dataclass(frozen=True)
class ThinPlate(Finding):
    """The plate lets through a fraction `transmission` of the photons along the axis.

    `share` is the number of photons that pass the plate beside the hole, relative to those that pass the hole and its edge.
    """

    module: int
    plate_thickness: float
    transmission: float
    share: float

    def __str__(self) -> str:
        return (
            f"module {self.module}: its plate of {_mm(self.plate_thickness)} lets {_percent(self.transmission)} of the "
            f"photons through: {_percent(self.share)} as many pass beside the hole as pass the hole"
        )


@dataclass(frozen=True)
class OpenMesh(Finding):
    """The surface of a part is not closed, not consistently wound, or inside out."""

    module: int
    part: Kind
    fault: str

    def __str__(self) -> str:
        return f"module {self.module}: its {self.part}'s mesh {self.fault}"


@dataclass(frozen=True)
class GeometryReport:
    """What `check_geometry` found.

    Attributes
    ----------
    n_modules : int
        Number of modules checked.
    plate_thickness, wall_thickness, opening_angle, edge_at
        The construction that was checked: mm, mm, rad, and "middle", "front" or "back".
    overlaps, near_pairs, swallowed_pinholes, intrusions, uncovered, blocked, vignetted, thin_plates, open_meshes : tuple
        The findings of each kind, in the order of the modules.
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


def _mm(value: float) -> str:
    return f"{value:.4g} mm"


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"
