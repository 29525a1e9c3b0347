"""What the checks found: plain numbers, modules by the numbers that their users know."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from ..collimator import EdgePlace
from ..module_parts import Kind


@dataclass(frozen=True)
class Overlap:
    """Two parts of different modules penetrate each other.

    Attributes
    ----------
    first, second : int
        The modules.
    first_part, second_part : "collimator" or "crystal"
        Their parts, as convex bodies: a collimator is filled.
    depth : float
        The shortest translation that separates them, mm.
    point : (x, y, z)
        A point inside both, world mm: the mean of the common body's corners.
    """

    first: int
    first_part: Kind
    second: int
    second_part: Kind
    depth: float
    point: tuple[float, float, float]

    @property
    def modules(self) -> tuple[int, ...]:
        """Those that it is about."""
        return self.first, self.second

    def __str__(self) -> str:
        at = ", ".join(f"{x:.1f}" for x in self.point)
        return (
            f"modules {self.first} and {self.second}: {self.first_part} and {self.second_part} overlap, "
            f"{_mm(self.depth)} deep at ({at}) mm"
        )


@dataclass(frozen=True)
class NearPair:
    """Two modules are nearly at one place: their fronts have no room side by side.

    Attributes
    ----------
    first, second : int
        The modules.
    distance : float
        Between their pinhole centres, mm.
    """

    first: int
    second: int
    distance: float

    @property
    def modules(self) -> tuple[int, ...]:
        """Those that it is about."""
        return self.first, self.second

    def __str__(self) -> str:
        return f"modules {self.first} and {self.second}: nearly at one place, pinholes {_mm(self.distance)} apart"


@dataclass(frozen=True)
class SwallowedPinhole:
    """A pinhole's centre lies inside another module's part.

    Attributes
    ----------
    module, by : int
        The pinhole's module and the other one.
    part : "collimator" or "crystal"
        Of the other one, as a convex body.
    depth : float
        From the pinhole centre to that body's surface, mm.
    """

    module: int
    by: int
    part: Kind
    depth: float

    @property
    def modules(self) -> tuple[int, ...]:
        """Those that it is about."""
        return self.module, self.by

    def __str__(self) -> str:
        return f"module {self.module}: its pinhole lies {_mm(self.depth)} inside module {self.by}'s {self.part}"


@dataclass(frozen=True)
class Intrusion:
    """A module's collimator reaches into the ROI, the largest of the modules'.

    Attributes
    ----------
    module : int
        The module.
    roi_radius : float
        R of that ROI, mm.
    depth : float
        How far the collimator reaches into it, mm.
    """

    module: int
    roi_radius: float
    depth: float

    @property
    def modules(self) -> tuple[int, ...]:
        """Those that it is about."""
        return (self.module,)

    def __str__(self) -> str:
        return f"module {self.module}: its collimator reaches {_mm(self.depth)} into the ROI of {_mm(self.roi_radius)}"


@dataclass(frozen=True)
class Uncovered:
    """A module's field of view does not hold its ROI.

    Attributes
    ----------
    module : int
        The module.
    roi_radius, seen_radius : float
        R, and the radius of the largest sphere at the isocentre that the field of view holds, mm; 0 if none.
    unseen_share : float
        The ROI's volume outside the field of view, as a share of 1.
    """

    module: int
    roi_radius: float
    seen_radius: float
    unseen_share: float

    @property
    def shortage(self) -> float:
        """By how much the radius falls short, mm."""
        return self.roi_radius - self.seen_radius

    @property
    def modules(self) -> tuple[int, ...]:
        """Those that it is about."""
        return (self.module,)

    def __str__(self) -> str:
        return (
            f"module {self.module}: sees {_mm(self.seen_radius)} around the isocentre, {_mm(self.shortage)} less than "
            f"its ROI radius; {_percent(self.unseen_share)} of the ROI is outside its field of view"
        )


@dataclass(frozen=True)
class Blocked:
    """Another module stands between a pinhole and its ROI.

    Attributes
    ----------
    module, by : int
        The pinhole's module and the one in its way.
    share : float
        Rays of the pinhole's ROI that meet the other module, as a share of 1 (of the solid angle).
    """

    module: int
    by: int
    share: float

    @property
    def modules(self) -> tuple[int, ...]:
        """Those that it is about."""
        return self.module, self.by

    def __str__(self) -> str:
        return f"module {self.module}: module {self.by} blocks {_percent(self.share)} of the rays from its ROI"


@dataclass(frozen=True)
class Vignetted:
    """The plate shades its hole from a part of the ROI: it is too thick for its opening angle.

    Attributes
    ----------
    module : int
        The module.
    open_share : float
        Of the hole's area, as a share of 1: what is open to the rays from the ROI that come in at the steepest.
    plate_thickness : float
        mm.
    opening_angle, needed_angle : float
        Of the hole's double cone, and from which on no plate shades it, rad.
    """

    module: int
    open_share: float
    plate_thickness: float
    opening_angle: float
    needed_angle: float

    @property
    def modules(self) -> tuple[int, ...]:
        """Those that it is about."""
        return (self.module,)

    def __str__(self) -> str:
        return (
            f"module {self.module}: only {_percent(self.open_share)} of its hole is open to the rim of its ROI: a plate of "
            f"{_mm(self.plate_thickness)} is too thick for an opening angle of {math.degrees(self.opening_angle):.4g} "
            f"degrees, {math.ceil(math.degrees(self.needed_angle) * 10) / 10:g} are needed"
        )


@dataclass(frozen=True)
class ThinPlate:
    """The plate around the hole lets so many photons through that the hole's own no longer say what is counted.

    Attributes
    ----------
    module : int
        The module.
    plate_thickness : float
        mm.
    transmission : float
        Of the plate along the axis, as a share of 1.
    share : float
        Photons that pass the plate beside the hole, as a share of those that pass the hole and its edge.
    """

    module: int
    plate_thickness: float
    transmission: float
    share: float

    @property
    def modules(self) -> tuple[int, ...]:
        """Those that it is about."""
        return (self.module,)

    def __str__(self) -> str:
        return (
            f"module {self.module}: its plate of {_mm(self.plate_thickness)} lets {_percent(self.transmission)} of the "
            f"photons through: beside the hole pass {_percent(self.share)} of those that pass the hole"
        )


@dataclass(frozen=True)
class OpenMesh:
    """A surface is not closed, not consistently oriented, or looks inwards.

    Attributes
    ----------
    module : int
        The module.
    part : str
        "collimator", "crystal" or "module" for both together.
    fault : str
        What is wrong with it.
    """

    module: int
    part: str
    fault: str

    @property
    def modules(self) -> tuple[int, ...]:
        """Those that it is about."""
        return (self.module,)

    def __str__(self) -> str:
        what = "its mesh" if self.part == "module" else f"its {self.part}'s mesh"
        return f"module {self.module}: {what} {self.fault}"


Finding = Overlap | NearPair | SwallowedPinhole | Intrusion | Uncovered | Blocked | Vignetted | ThinPlate | OpenMesh


@dataclass(frozen=True)
class GeometryReport:
    """What `check_geometry` found, each kind in the order of the modules.

    Attributes
    ----------
    n_modules : int
        How many modules were looked at.
    plate_thickness, wall_thickness : float
        With which the solids were built, mm.
    opening_angle : float
        Of their holes, rad.
    edge_at : "middle", "front" or "back"
        Where in the plates the knife edge is.
    overlaps, near_pairs, swallowed_pinholes, intrusions, uncovered, blocked, vignetted, thin_plates, open_meshes : tuple
        The findings.
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
        """All of them."""
        return (
            *self.overlaps,
            *self.near_pairs,
            *self.swallowed_pinholes,
            *self.intrusions,
            *self.uncovered,
            *self.blocked,
            *self.vignetted,
            *self.thin_plates,
            *self.open_meshes,
        )

    @property
    def ok(self) -> bool:
        """Whether nothing was found."""
        return not self.findings

    def messages(self, module: int | None = None) -> list[str]:
        """One line for each finding; only those about the module of that number if one is given."""
        return [str(f) for f in self.findings if module is None or module in f.modules]

    def as_dict(self) -> dict[str, Any]:
        """Everything as numbers, strings and lists, for JSON."""
        return {**asdict(self), "ok": self.ok}


def _mm(value: float) -> str:
    return f"{value:.4g} mm"


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"
