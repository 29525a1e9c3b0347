"""Columns of pinhole modules: the numbers of the geometry workbook, typed and derived.

A new typed column is one more row of the table; one that the package computes with is also a field of `PinholeSystem`.
"""

from operator import attrgetter
from typing import Any

import numpy as np

from ..arrays import Floats
from .columns import Column, ColumnTable, Values
from .design_formulas import collimator_length
from .frames import principal_rays


def _coordinate(name: str, points: str) -> dict[str, Any]:
    """Return name, headings and hints of the column of a coordinate such as "x1"; `points` are nouns for its point."""
    axis = name[0]
    phrases = "coordinate value at", "coordinate at", "coordinate of", "position of"
    headings = [f"{axis} {phrase} {point}" for point in points.split(", ") for phrase in phrases]
    hints = f"{axis} {axis}1 {axis}2 coordinate coordinates position"
    return {"name": name, "headings": (name, *headings), "hints": hints}


def _designed_length(needed: Values) -> Floats:
    """Return the collimator length (M,), mm, by the design formula from the needed columns."""
    b = np.sqrt(sum(needed[name] ** 2 for name in ("x1", "y1", "z1")))
    return collimator_length(b, needed["d"], needed["Ld"], needed["R"])


_HOLES = "center of hole, centre of hole, center of pinhole, centre of pinhole, pinhole"


def _back_distance(system: Any) -> Floats:
    """Return the distance (M,) from the isocentre to the crystal's back, mm."""
    return system.pinhole_distance + system.collimator_length + system.detector_thickness


def _back_center(system: Any) -> Floats:
    """Return the middle (M, 3) of the crystal's back, mm."""
    aimed = system.centers * (_back_distance(system) / system.pinhole_distance)[:, None]
    if not system.tilt.any():  # to the last digit the value of the workbook's formula
        return aimed
    turn = system.principal_rays - principal_rays(system.centers)
    return aimed - turn * (system.collimator_length + system.detector_thickness)[:, None]


def _planar_range(system: Any) -> Floats:
    """Return the distance (M,) from the pinhole to the z axis, mm."""
    return np.hypot(system.centers[:, 0], system.centers[:, 1])


def _slope(system: Any) -> Floats:
    """Return the workbook's "3D slope" (M,), the ratio b / x1."""
    with np.errstate(divide="ignore", over="ignore"):
        return system.pinhole_distance / system.centers[:, 0]


# Causes stand before their effects, so that a message names the cell that causes an error.
PINHOLE_COLUMNS = ColumnTable(
    (
        *(
            Column(**_coordinate(f"{axis}1", _HOLES), field="centers", axis=i, place=f"Coordinates!{'BCD'[i]}")
            for i, axis in enumerate("xyz")
        ),
        Column("d", "pinhole_diameter", place="Main!P", hints="d diameter bore", plausible=(0.05, 50),
               headings=("d", "diameter of pinhole", "pinhole diameter", "diameter of hole", "hole diameter"),
               help="d: diameter of the hole"),
        Column("R", "roi_radius", place="Main!Q", hints="r radius roi", plausible=(5, 1000),
               headings=("R", "radius of spherical region of interest", "radius of region of interest",
                         "radius of roi", "roi radius"),
               help="R: radius of the sphere that the module must see"),
        Column("Ld", "detector_side", place="Main!S", hints="ld side width size edge", plausible=(1, 1000),
               headings=("Ld", "length of side of detector crystal", "side of detector crystal",
                         "side of crystal", "crystal side"),
               help="Ld: side of the square crystal"),
        Column("Td", "detector_thickness", place="Main!T", hints="td thickness", plausible=(0.1, 200),
               headings=("Td", "thickness of detector crystal", "thickness of crystal", "crystal thickness"),
               help="Td: thickness of the crystal"),
        Column("b", derived=attrgetter("pinhole_distance"), place="Coordinates!E", hints="b distance",
               headings=("b", *(f"distance from {middle} to center of heart" for middle in _HOLES.split(", ")[:4]),
                         *(f"distance from pinhole to {to}" for to in ("heart", "isocenter", "isocentre")),
                         *(f"pinhole to {to} distance" for to in ("heart", "isocenter", "isocentre"))),
               formula="=SQRT(SUMSQ({x1},{y1},{z1}))", plausible=(40, 2000)),
        Column("l", "collimator_length", place="Coordinates!G", hints="l length depth height", plausible=(1, 1000),
               headings=("l", "length of collimator", "collimator length"), blank=_designed_length,
               formula="=({Ld}-{d})*({b}^2-{R}^2)/({b}*{d}+2*{R}*SQRT({b}^2-{R}^2+{d}^2/4))",
               help="l: from the pinhole to the crystal's front face"),
        Column("H", derived=_back_distance, place="Coordinates!H", hints="td", rounded_with="l",
               headings=("l+b+Td", "b+l+Td"), titles=("l + b+Td", ""), formula="={b}+{l}+{Td}"),
        *(
            Column(**_coordinate(f"{axis}2", "end of detector"), place=f"Coordinates!{'IJK'[i]}", rounded_with="l",
                   derived=lambda s, i=i: _back_center(s)[:, i],  # type: ignore[misc]
                   formula=f"={{{axis}1}}*{{H}}/{{b}}", unlike_formula=lambda s: s.tilt.any(axis=1))
            for i, axis in enumerate("xyz")
        ),
        Column("range", derived=_planar_range, place="Coordinates!U", hints="range",
               headings=("pinhole range",), titles=("", "pinhole range"), formula="=SQRT(SUMSQ({x1},{y1}))"),
        Column("azimuth", derived=lambda s: np.arctan2(s.centers[:, 1], s.centers[:, 0]), place="Coordinates!V",
               headings=("pinhole azimuth",), titles=("", "pinhole azimuth (radians)"), kind="angle", hints="azimuth",
               formula="=(ATAN2({x1},{y1}))", undefined=lambda needed: np.hypot(needed["x1"], needed["y1"]) == 0),
        Column("elevation", derived=lambda s: np.arctan2(s.centers[:, 2], _planar_range(s)), place="Coordinates!W",
               headings=("pinhole elevation",), titles=("", "pinhole elevation (radians)"), kind="angle",
               formula="=(ATAN2({range},{z1}))", hints="elevation"),
        *(
            Column(f"tilt_{axis}", "tilt", axis=i, kind="angle", unit="deg", place=f"Coordinates!{'XYZ'[i]}",
                   hints="tilt", headings=(f"tilt_{axis}", f"tilt about {axis}", f"tilt {axis}"), plausible=(-0.5, 0.5),
                   titles=(f"tilt_{axis}", f"tilt about {axis} (degrees)"), blank=0.0,
                   help=f"turn of the module about its nominal {axis}")
            for i, axis in enumerate("uvk")
        ),
        Column("crystal", "crystal_material", kind="text", place="Main!U", hints="material", blank="",
               headings=("crystal", "crystal material", "material of crystal", "detector material"),
               help="material of the crystal; blank: the material of the model"),
    ),
    unread=(Column("slope", derived=_slope, headings=("S", "3D slope"), place="Coordinates!F", formula="={b}/{x1}"),),
)  # fmt: skip
