"""The columns of pinhole modules: what the geometry workbook holds of them, and what follows from it.

A new typed column is one more row; one that the package computes with is also a field of `PinholeSystem`.
"""

from operator import attrgetter
from typing import Any

import numpy as np

from ..arrays import Floats
from .columns import Column, ColumnTable, Values
from .design_formulas import collimator_length
from .frames import principal_rays


def _coordinate(axis: str, places: str) -> dict[str, Any]:
    """Name, headings and hints of a coordinate: "x1" and the places that it may be of."""
    phrases = "coordinate value at", "coordinate at", "coordinate of", "position of"
    headings = [f"{axis[0]} {of} {place}" for place in places.split(", ") for of in phrases]
    hints = f"{axis[0]} {axis[0]}1 {axis[0]}2 coordinate coordinates position"
    return {"name": axis, "headings": (axis, *headings), "hints": hints}


def _designed(needed: Values) -> Floats:
    """The collimator length (M,), mm, of the design formula."""
    b = np.sqrt(sum(needed[name] ** 2 for name in ("x1", "y1", "z1")))
    return collimator_length(b, needed["d"], needed["Ld"], needed["R"])


_HOLES = "center of hole, centre of hole, center of pinhole, centre of pinhole, pinhole"


def _detector_back(system: Any) -> Floats:
    """Distance (M,) from the isocentre to the crystal's back, mm."""
    return system.pinhole_distance + system.collimator_length + system.detector_thickness


def _detector_end(system: Any) -> Floats:
    """Middle (M, 3) of the crystal's back, mm."""
    aimed = system.centers * (_detector_back(system) / system.pinhole_distance)[:, None]
    if not system.tilt.any():  # as the workbook's formula has it, to the last digit
        return aimed
    off = system.principal_rays - principal_rays(system.centers)
    return aimed - off * (system.collimator_length + system.detector_thickness)[:, None]


def _planar_range(system: Any) -> Floats:
    """Distance (M,) from the pinhole to the z axis, mm."""
    return np.hypot(system.centers[:, 0], system.centers[:, 1])


def _slope(system: Any) -> Floats:
    """The users' "3D slope" (M,): the distance to the isocentre, in units of x1."""
    with np.errstate(divide="ignore", over="ignore"):
        return system.pinhole_distance / system.centers[:, 0]


# Causes stand before their effects, so that the cause of an error is the cell that is refused.
PINHOLE_COLUMNS = ColumnTable(
    (
        *(
            Column(**_coordinate(f"{axis}1", _HOLES), field="centers", axis=i, place=f"Coordinates!{'BCD'[i]}")
            for i, axis in enumerate("xyz")
        ),
        Column(
            "d",
            "pinhole_diameter",
            headings=("d", "diameter of pinhole", "pinhole diameter", "diameter of hole", "hole diameter"),
            help="d: diameter of the hole",
            place="Main!P",
            hints="d diameter bore",
            plausible=(0.05, 50),
        ),
        Column(
            "R",
            "roi_radius",
            headings=(
                "R",
                "radius of spherical region of interest",
                "radius of region of interest",
                "radius of roi",
                "roi radius",
            ),
            help="R: radius of the sphere that the module must see",
            place="Main!Q",
            hints="r radius roi",
            plausible=(5, 1000),
        ),
        Column(
            "Ld",
            "detector_side",
            headings=(
                "Ld",
                "length of side of detector crystal",
                "side of detector crystal",
                "side of crystal",
                "crystal side",
            ),
            help="Ld: side of the square crystal",
            place="Main!S",
            hints="ld side width size edge",
            plausible=(1, 1000),
        ),
        Column(
            "Td",
            "detector_thickness",
            headings=("Td", "thickness of detector crystal", "thickness of crystal", "crystal thickness"),
            help="Td: thickness of the crystal",
            place="Main!T",
            hints="td thickness",
            plausible=(0.1, 200),
        ),
        Column(
            "b",
            derived=attrgetter("pinhole_distance"),
            headings=(
                "b",
                *(f"distance from {middle} to center of heart" for middle in _HOLES.split(", ")[:4]),
                *(f"distance from pinhole to {to}" for to in ("heart", "isocenter", "isocentre")),
                *(f"pinhole to {to} distance" for to in ("heart", "isocenter", "isocentre")),
            ),
            place="Coordinates!E",
            formula="=SQRT(SUMSQ({x1},{y1},{z1}))",
            hints="b distance",
            plausible=(40, 2000),
        ),
        Column(
            "l",
            "collimator_length",
            headings=("l", "length of collimator", "collimator length"),
            help="l: from the pinhole to the crystal's front face",
            place="Coordinates!G",
            formula="=({Ld}-{d})*({b}^2-{R}^2)/({b}*{d}+2*{R}*SQRT({b}^2-{R}^2+{d}^2/4))",
            hints="l length depth height",
            plausible=(1, 1000),
            blank=_designed,
        ),
        Column(
            "H",
            derived=_detector_back,
            headings=("l+b+Td", "b+l+Td"),
            place="Coordinates!H",
            titles=("l + b+Td", ""),
            formula="={b}+{l}+{Td}",
            hints="td",
            rounded_with="l",
        ),
        *(
            Column(
                **_coordinate(f"{axis}2", "end of detector"),
                derived=lambda s, i=i: _detector_end(s)[:, i],  # type: ignore[misc]
                place=f"Coordinates!{'IJK'[i]}",
                formula=f"={{{axis}1}}*{{H}}/{{b}}",
                unlike_formula=lambda s: s.tilt.any(axis=1),
                rounded_with="l",
            )
            for i, axis in enumerate("xyz")
        ),
        Column(
            "range",
            derived=_planar_range,
            headings=("pinhole range",),
            place="Coordinates!U",
            titles=("", "pinhole range"),
            formula="=SQRT(SUMSQ({x1},{y1}))",
            hints="range",
        ),
        Column(
            "azimuth",
            derived=lambda s: np.arctan2(s.centers[:, 1], s.centers[:, 0]),
            headings=("pinhole azimuth",),
            place="Coordinates!V",
            titles=("", "pinhole azimuth (radians)"),
            kind="angle",
            formula="=(ATAN2({x1},{y1}))",
            undefined=lambda needed: np.hypot(needed["x1"], needed["y1"]) == 0,
            hints="azimuth",
        ),
        Column(
            "elevation",
            derived=lambda s: np.arctan2(s.centers[:, 2], _planar_range(s)),
            headings=("pinhole elevation",),
            place="Coordinates!W",
            titles=("", "pinhole elevation (radians)"),
            kind="angle",
            formula="=(ATAN2({range},{z1}))",
            hints="elevation",
        ),
        *(
            Column(
                f"tilt_{axis}",
                "tilt",
                axis=i,
                kind="angle",
                unit="deg",
                headings=(f"tilt_{axis}", f"tilt about {axis}", f"tilt {axis}"),
                titles=(f"tilt_{axis}", f"tilt about {axis} (degrees)"),
                place=f"Coordinates!{'XYZ'[i]}",
                hints="tilt",
                plausible=(-0.5, 0.5),
                blank=0.0,
                help=f"turn of the module about its nominal {axis}",
            )
            for i, axis in enumerate("uvk")
        ),
        Column(
            "crystal",
            "crystal_material",
            kind="text",
            headings=("crystal", "crystal material", "material of crystal", "detector material"),
            place="Main!U",
            hints="material",
            blank="",
            help="material of the crystal; blank: that of the model for all",
        ),
    ),
    unread=(Column("slope", derived=_slope, headings=("S", "3D slope"), place="Coordinates!F", formula="={b}/{x1}"),),
)
