"""The table of what the columns of a geometry workbook may hold.

A new column is one more entry in it; one that is typed is also a field of `PinholeSystem`.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..geometry.design_formulas import collimator_length
from ..geometry.system import PinholeSystem

Numbers = Mapping[str, NDArray[np.float64]]
"""Quantity -> its numbers (M,)."""

MAP_UNITS = {"dm": 100.0, "ft": 304.8, "mil": 0.0254, "0.1 mm": 0.1}
"""Unit -> mm, of units that only a column map may name."""
LENGTH_UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4, "µm": 1e-3, **MAP_UNITS}
"""Unit -> mm."""
ANGLE_UNITS = {"rad": 1.0, "deg": math.pi / 180}
"""Unit -> rad."""

EXACT = 1e-6
"""Two numbers of one quantity agree if they differ less: relative, and absolute in mm or rad."""
AGREEING = 1e-9
"""Relative: a formula's result nearer to a number than this gives that number."""
_COARSEST_ROUNDING = {unit: 0.005 / factor for unit, factor in LENGTH_UNITS.items()} | {
    "rad": 5e-4,
    "deg": 5e-3,
    "": 5e-3,
}
"""Unit -> the largest rounding error that a typed number is granted."""


@dataclass(frozen=True)
class Quantity:
    """One row of the table."""

    name: str
    """Its symbol, which is also its name in messages and column maps."""
    source: str | Callable[[PinholeSystem], NDArray[np.float64]]
    """Its attribute of a `PinholeSystem`, its field if it is typed, or a function of the system: (M,), mm or rad."""
    headings: tuple[str, ...]
    """The texts that head its column. Texts of one letter are case-sensitive, others are not."""
    place: str
    """Sheet and column in a new workbook."""
    titles: tuple[str, str] | None = None
    """The symbol and the description that head it in a new workbook; by default the first two headings."""
    role: Literal["needed", "optional", "derived"] = "derived"
    """Whether the column must be there, may be, or only repeats what follows from the others and is compared."""
    kind: Literal["length", "angle", "number"] = "length"
    formula: str = ""
    """Its formula in a spreadsheet, with other quantities in braces; "" for one that is typed."""
    hints: str = ""
    """Words that suggest this quantity in a heading that is not understood."""
    plausible: tuple[float, float] = (-math.inf, math.inf)
    """mm or rad; a warning is given of numbers outside. If all of them are above 0, a typed one that is not is refused."""
    blank: float | Callable[[Numbers], NDArray[np.float64]] = math.nan
    """The number of an optional one where its cell is blank, or a function of the needed ones, mm, that gives it (M,)."""
    depends_on_length: bool = False
    """Whether it is derived from l, and hence from all the digits of an l that is shown rounded."""

    @property
    def units(self) -> dict[str, float]:
        """Unit -> mm or rad; the first is that of a heading without one. "" is that of a plain number."""
        return {"length": LENGTH_UNITS, "angle": ANGLE_UNITS, "number": {"": 1.0}}[self.kind]

    @property
    def title(self) -> str:
        """What messages call it: "collimator length"."""
        return self.source.replace("_", " ") if isinstance(self.source, str) else self.name

    @property
    def blank_is(self) -> str:
        """Whose number messages say that of a blank cell is."""
        return "the design formula's" if callable(self.blank) else self.said(self.blank)

    def said(self, number: float, digits: int = 6) -> str:
        """A number of it, in mm or rad, as messages show it."""
        return f"{number:.{digits}g} {next(iter(self.units))}".rstrip()

    def of(self, system: PinholeSystem) -> NDArray[np.float64]:
        """Its numbers (M,) in a system, mm or rad."""
        return getattr(system, self.source) if isinstance(self.source, str) else self.source(system)

    def default(self, needed: Numbers) -> NDArray[np.float64]:
        """The numbers (M,) of an optional one where its cells are blank, by the `needed` ones, mm."""
        return self.blank(needed) if callable(self.blank) else np.full(len(needed["x1"]), self.blank)

    def is_default(self, system: PinholeSystem) -> NDArray[np.bool_]:
        """Which modules (M,) have the number of a blank cell."""
        numbers = self.of(system)
        return np.abs(self.default(needed_numbers(system)) - numbers) <= AGREEING * np.abs(numbers)


def _coordinate(axis: str, places: str) -> dict[str, Any]:
    """Name, headings and hints of a coordinate: "x1" and the places that it may be of."""
    phrases = "coordinate value at", "coordinate at", "coordinate of", "position of"
    headings = [f"{axis[0]} {of} {place}" for place in places.split(", ") for of in phrases]
    hints = f"{axis[0]} {axis[0]}1 {axis[0]}2 coordinate coordinates position"
    return {"name": axis, "headings": (axis, *headings), "hints": hints}


def _designed(needed: Numbers) -> NDArray[np.float64]:
    """The collimator length (M,), mm, of the design formula."""
    b = np.sqrt(sum(needed[name] ** 2 for name in POSITION))
    return collimator_length(b, needed["d"], needed["Ld"], needed["R"])


_HOLES = "center of hole, centre of hole, center of pinhole, centre of pinhole, pinhole"


def _detector_back(system: PinholeSystem) -> NDArray[np.float64]:
    """Distance (M,) from the isocentre to the crystal's back, mm."""
    return system.pinhole_distance + system.collimator_length + system.detector_thickness


def _planar_range(system: PinholeSystem) -> NDArray[np.float64]:
    """Distance (M,) from the pinhole to the z axis, mm."""
    return np.hypot(system.centers[:, 0], system.centers[:, 1])


# Causes stand before their effects, so that the cause of an error is the cell that is refused.
_TABLE = (
    *(
        Quantity(
            **_coordinate(f"{axis}1", _HOLES),
            source=lambda s, i=i: s.centers[:, i],  # type: ignore[misc]
            place=f"Coordinates!{'BCD'[i]}",
            role="needed",
        )
        for i, axis in enumerate("xyz")
    ),
    Quantity(
        "d",
        "pinhole_diameter",
        ("d", "diameter of pinhole", "pinhole diameter", "diameter of hole", "hole diameter"),
        "Main!P",
        role="needed",
        hints="d diameter bore",
        plausible=(0.05, 50),
    ),
    Quantity(
        "R",
        "roi_radius",
        ("R", "radius of spherical region of interest", "radius of region of interest", "radius of roi", "roi radius"),
        "Main!Q",
        role="needed",
        hints="r radius roi",
        plausible=(5, 1000),
    ),
    Quantity(
        "Ld",
        "detector_side",
        ("Ld", "length of side of detector crystal", "side of detector crystal", "side of crystal", "crystal side"),
        "Main!S",
        role="needed",
        hints="ld side width size edge",
        plausible=(1, 1000),
    ),
    Quantity(
        "Td",
        "detector_thickness",
        ("Td", "thickness of detector crystal", "thickness of crystal", "crystal thickness"),
        "Main!T",
        role="needed",
        hints="td thickness",
        plausible=(0.1, 200),
    ),
    Quantity(
        "b",
        "pinhole_distance",
        (
            "b",
            *(f"distance from {middle} to center of heart" for middle in _HOLES.split(", ")[:4]),
            *(f"distance from pinhole to {to}" for to in ("heart", "isocenter", "isocentre")),
            *(f"pinhole to {to} distance" for to in ("heart", "isocenter", "isocentre")),
        ),
        "Coordinates!E",
        formula="=SQRT(SUMSQ({x1},{y1},{z1}))",
        hints="b distance",
        plausible=(40, 2000),
    ),
    Quantity(
        "l",
        "collimator_length",
        ("l", "length of collimator", "collimator length"),
        "Coordinates!G",
        role="optional",
        formula="=({Ld}-{d})*({b}^2-{R}^2)/({b}*{d}+2*{R}*SQRT({b}^2-{R}^2+{d}^2/4))",
        hints="l length depth height",
        plausible=(1, 1000),
        blank=_designed,
    ),
    Quantity(
        "H",
        _detector_back,
        ("l+b+Td", "b+l+Td"),
        "Coordinates!H",
        titles=("l + b+Td", ""),
        formula="={b}+{l}+{Td}",
        hints="td",
        depends_on_length=True,
    ),
    *(
        Quantity(
            **_coordinate(f"{axis}2", "end of detector"),
            source=lambda s, i=i: s.centers[:, i] * (_detector_back(s) / s.pinhole_distance),  # type: ignore[misc]
            place=f"Coordinates!{'IJK'[i]}",
            formula=f"={{{axis}1}}*{{H}}/{{b}}",
            depends_on_length=True,
        )
        for i, axis in enumerate("xyz")
    ),
    Quantity(
        "range",
        _planar_range,
        ("pinhole range",),
        "Coordinates!U",
        titles=("", "pinhole range"),
        formula="=SQRT(SUMSQ({x1},{y1}))",
        hints="range",
    ),
    Quantity(
        "azimuth",
        lambda s: np.arctan2(s.centers[:, 1], s.centers[:, 0]),
        ("pinhole azimuth",),
        "Coordinates!V",
        titles=("", "pinhole azimuth (radians)"),
        kind="angle",
        formula="=(ATAN2({x1},{y1}))",
        hints="azimuth",
    ),
    Quantity(
        "elevation",
        lambda s: np.arctan2(s.centers[:, 2], _planar_range(s)),
        ("pinhole elevation",),
        "Coordinates!W",
        titles=("", "pinhole elevation (radians)"),
        kind="angle",
        formula="=(ATAN2({range},{z1}))",
        hints="elevation",
    ),
)
QUANTITIES = {quantity.name: quantity for quantity in _TABLE}
NEEDED = tuple(quantity.name for quantity in _TABLE if quantity.role == "needed")
OPTIONAL = tuple(quantity.name for quantity in _TABLE if quantity.role == "optional")
DERIVED = tuple(quantity.name for quantity in _TABLE if quantity.role == "derived")
POSITION = NEEDED[:3]
"""x1, y1, z1: what must stand in one table, which has a row for each module."""
DIMENSIONS = NEEDED[3:]
"""d, R, Ld, Td: what may be given once for all modules."""
TYPED = (*NEEDED, *OPTIONAL)
"""What a `PinholeSystem` is made of."""


def needed_numbers(system: PinholeSystem) -> Numbers:
    """The numbers of a system that a workbook must have."""
    return {name: QUANTITIES[name].of(system) for name in NEEDED}


def tolerance(number: float, expected: float, unit: str) -> float:
    """By how much a number in a cell may differ from the expected one, all in `unit`.

    That is `EXACT`, or half a unit of the number's last decimal, whichever is more.
    """
    text = f"{number:.12g}"
    decimals = len(text.partition(".")[2]) if "e" not in text else 12
    # Trailing zeros are lost: 89.1 may be 89.10, so few decimals stand for the coarsest rounding.
    rounding = min(0.5 * 10.0**-decimals, _COARSEST_ROUNDING[unit])
    return max(EXACT * max(1.0 / LENGTH_UNITS.get(unit, 1.0), abs(expected)), rounding * (1 + 1e-9))


def agree(value: object, wanted: float, at_least: float = 0.0) -> bool:
    """Whether a cell's value is the number `wanted`, relative to it and `at_least`."""
    return type(value) is float and abs(value - wanted) <= AGREEING * max(abs(wanted), at_least)
