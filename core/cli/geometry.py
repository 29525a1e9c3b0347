"""``mphdrr geometry show|check FILE``."""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from typing import Any

import numpy as np

from ..errors import InputWarning
from ..system import PinholeSystem
from ..workbook import read_system
from .options import add_command, chosen_modules


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    geometry = add_command(subparsers, "geometry", "look at a geometry workbook", "mphdrr geometry check scanner.xlsx")
    actions = geometry.add_subparsers(metavar="ACTION", required=True)
    show = add_command(
        actions, "show", "print every module's numbers", "mphdrr geometry show scanner.xlsx --modules 1-20"
    )
    show.add_argument("--modules", metavar="RANGE", help="such as 1-40 or 1-20,41; default: all")
    show.set_defaults(run=_show)
    check = add_command(
        actions, "check", "compare the workbook with the design formulas", "mphdrr geometry check a.xlsx"
    )
    check.set_defaults(run=_check)
    for parser in (show, check):
        parser.add_argument("file", metavar="FILE", help="geometry workbook (.xlsx, .xlsm)")
        parser.add_argument("--json", action="store_true", help="print JSON")


def _show(arguments: argparse.Namespace) -> None:
    system = read_system(arguments.file)
    chosen = set(chosen_modules(system, arguments.modules).numbers.tolist())
    rows = [row for row in _rows(system) if row["number"] in chosen]  # rings are those of the whole scanner
    if arguments.json:
        print(json.dumps({"modules": rows, "units": "mm, radians"}, indent=1))
        return
    print(" module  ring        x        y        z        b        l   azimuth elevation     d     Ld     Td      R")
    for row in rows:
        print(
            "{number:7d} {ring:5d} {x:8.2f} {y:8.2f} {z:8.2f} {b:8.2f} {l:8.3f} {azimuth:9.4f} {elevation:9.4f} "
            "{d:5.2f} {Ld:6.2f} {Td:6.2f} {R:6.2f}".format(**row)
        )
    print("lengths in mm, angles in radians")


def _check(arguments: argparse.Namespace) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        system = read_system(arguments.file)
    messages = [str(w.message) for w in caught if issubclass(w.category, InputWarning)]
    if arguments.json:
        print(json.dumps({"summary": _summary(system), "warnings": messages}, indent=1))
        return
    for message in messages:
        sys.stderr.write(f"mphdrr: warning: {message}\n")
    for name, text in _summary(system).items():
        print(f"{name:22s} {text}")
    print(f"{len(messages)} warning{'' if len(messages) == 1 else 's'}")


def _rows(system: PinholeSystem) -> list[dict[str, Any]]:
    x, y, z = system.centers.T
    columns = {
        "number": system.numbers,
        "ring": system.rings() + 1,
        "x": x,
        "y": y,
        "z": z,
        "b": system.pinhole_distance,
        "l": system.collimator_length,
        "azimuth": np.arctan2(y, x),
        "elevation": np.arctan2(z, np.hypot(x, y)),
        "d": system.pinhole_diameter,
        "Ld": system.detector_side,
        "Td": system.detector_thickness,
        "R": system.roi_radius,
    }
    return [
        dict(zip(columns, values, strict=True)) for values in zip(*(c.tolist() for c in columns.values()), strict=True)
    ]


def _summary(system: PinholeSystem) -> dict[str, str]:
    counts = np.bincount(system.rings())
    return {
        "modules": str(len(system)),
        "rings": " + ".join(map(str, counts)),
        "b, pinhole distance": _range(system.pinhole_distance),
        "l, collimator length": _range(system.collimator_length),
        "d, pinhole diameter": _range(system.pinhole_diameter),
        "Ld, crystal side": _range(system.detector_side),
        "Td, crystal thickness": _range(system.detector_thickness),
        "R, ROI radius": _range(system.roi_radius),
    }


def _range(values: np.ndarray) -> str:
    low, high = values.min(), values.max()
    return f"{low:g} mm" if low == high else f"{low:.2f} to {high:.2f} mm"
