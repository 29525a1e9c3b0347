"""Action ``mphdrr geometry check FILE``: design formulas and mechanical problems of a scanner."""

import argparse
from typing import get_args

import numpy as np

from .... import core as mph
from ...geometry.collimator import Construction, EdgePlace, angle_from_degrees
from ...geometry.scanner import Scanner
from ...recording import recorded_warnings
from ..options import count_text, print_answer, refuse
from ..scanners import read_any_scanner
from .arguments import add_action, add_edge, chosen_optics


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action ``geometry check``."""
    parser = add_action(actions, "check", _run)
    add = parser.add_argument
    add("--plate", type=float, default=2.0, metavar="MM", help="thickness of the aperture plates")
    add("--wall", type=float, default=2.0, metavar="MM", help="thickness of the collimators' walls")
    place = "position of the knife edge in the plate; front is the face towards the ROI"
    add("--edge-at", choices=get_args(EdgePlace), default="middle", help=place)
    add_edge(parser)
    add("--isotope", metavar="NAME", help=f"{', '.join(mph.ISOTOPES)}: its photons must be stopped by the plates")
    add("--bore", type=float, metavar="MM", help="of X-ray systems: radius of the patient's bore around the z axis")
    add("--strict", action="store_true", help="exit with status 1 if there is any warning or finding")


def _run(arguments: argparse.Namespace) -> None:
    """Check the design formulas, and find modules that overlap, miss their ROI, block each other or have unsuitable plates.

    mphdrr geometry check scanner.xlsx --wall 3 --strict
    """
    if arguments.aperture_mu is None:
        refuse(arguments, ("isotope",), "needs --aperture-mu")
    with recorded_warnings() as messages:
        system = read_any_scanner(arguments)
        kinds = () if isinstance(system, mph.PinholeSystem) else mph.kinds_in(arguments.workbook)
        other_scanners = [mph.read_scanner(arguments.workbook, kind) for kind in kinds if kind != system.kind]
    parts = {"plate_thickness": arguments.plate, "wall_thickness": arguments.wall, "edge_at": arguments.edge_at}
    if isinstance(system, mph.PinholeSystem):
        refuse(arguments, ("bore",), "is of X-ray systems")
        optics = chosen_optics(arguments, system)
        report = mph.check_geometry(system, **parts, aperture_mu=optics.aperture_mu, opening_angle=optics.opening_angle)
        findings, geometry = report.messages(), report.as_dict()
    else:
        angle = angle_from_degrees(arguments.opening_angle, "--opening-angle")
        problems = system.findings(other_scanners, Construction(**parts, opening_angle=angle), arguments.bore)
        findings, geometry = [str(finding) for finding in problems], {"ok": not problems}
    total = f"{count_text(len(messages), 'warning')} of the workbook, {count_text(len(findings), 'finding')} in the geometry"
    summary = _summary(system)
    answer = {"summary": summary, "warnings": messages, "findings": findings, "geometry": geometry}
    lines = [*(f"{name:22s} {text}" for name, text in summary.items()), *findings, total]
    print_answer(arguments, answer, lines, [f"warning: {message}" for message in messages])
    if arguments.strict and (messages or findings):
        raise mph.InputError(f"{arguments.workbook}: {total}")


def _summary(system: Scanner) -> dict[str, str]:
    """Return name -> value of the scanner's sizes, as texts."""
    lines = {"modules": str(len(system)), "rings": " + ".join(map(str, np.bincount(system.rings())))}
    if not isinstance(system, mph.PinholeSystem):
        return lines | {"kind": system.kind}
    for name, values in {
        "b, pinhole distance": system.pinhole_distance,
        "l, collimator length": system.collimator_length,
        "d, pinhole diameter": system.pinhole_diameter,
        "Ld, crystal side": system.detector_side,
        "Td, crystal thickness": system.detector_thickness,
        "R, ROI radius": system.roi_radius,
    }.items():
        low, high = values.min(), values.max()
        lines[name] = f"{low:g} mm" if low == high else f"{low:.2f} to {high:.2f} mm"
    return lines
