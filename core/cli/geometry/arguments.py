"""Options that several actions of ``mphdrr geometry`` share."""

import argparse
from typing import Any

from .... import core as mph
from ...geometry.collimator import angle_from_degrees
from ...geometry.scanner import Scanner
from ...physics.materials import APERTURES, CRYSTALS
from ..options import add_run, parse_number_or_name
from ..scanners import add_workbook

MATERIAL_OPTIONS = ("aperture_mu", "opening_angle", "crystal_mu", "intrinsic_fwhm", "isotope")
"""Names under which the parsed arguments hold the options of `add_materials`."""


def add_action(actions: Any, name: str, run: Any) -> argparse.ArgumentParser:
    """Add an action on a workbook, with ``--json``, and return its parser; the docstring of `run` is its help."""
    parser = add_run(actions, name, run)
    add_workbook(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser


def add_views(parser: argparse.ArgumentParser, pixels: str) -> None:
    """Add the options of the images, for `chosen_views`; `pixels` is the help text of their size."""
    add = parser.add_argument
    size = f"{pixels}; default: 256 256, or the X-ray panels'"
    add("--size", type=int, nargs=2, metavar=("ROWS", "COLUMNS"), help=size)
    add("--detector", choices=("virtual", "real"), default="virtual", help="plane in front (upright image), or crystal")
    add("--magnification", type=float, default=10.0, help="virtual detector's distance in units of l")
    add("--pitch", type=float, metavar="MM", help="pixel size; default: the crystal's whole side")


def chosen_views(system: Scanner, arguments: argparse.Namespace) -> mph.Views:
    """Return the views of a scanner that the options of `add_views` ask for."""
    shape = tuple(arguments.size) if arguments.size else system.pixels or (256, 256)
    return system.views(shape, arguments.detector, arguments.magnification, arguments.pitch)


def add_materials(parser: argparse.ArgumentParser) -> None:
    """Add the options of the materials and the isotope, for `chosen_optics`."""
    group = parser.add_argument_group("materials; without an option the module is ideal")
    add_edge(group)
    crystal = f"{', '.join(CRYSTALS)} at the isotope's photons, or the coefficient, 1/mm; without it, all are detected"
    add = group.add_argument
    add("--crystal-mu", type=parse_number_or_name, metavar="MATERIAL", help=crystal)
    add("--intrinsic-fwhm", type=float, default=0.0, metavar="MM", help="resolution of the detector, mm on the crystal")
    add("--isotope", metavar="NAME", help=f"{', '.join(mph.ISOTOPES)}; without it, one photon per decay")


def add_edge(parser: argparse._ActionsContainer) -> None:
    """Add the options of the knife edge, for `chosen_optics`, which needs an option ``--isotope`` as well."""
    edge = f"{', '.join(APERTURES)} at the isotope's photons, or the coefficient, 1/mm; without it, nothing penetrates"
    parser.add_argument("--aperture-mu", type=parse_number_or_name, metavar="MATERIAL", help=edge)
    parser.add_argument("--opening-angle", type=float, default=90.0, metavar="DEG", help="full angle of the knife edge")


def chosen_optics(arguments: argparse.Namespace, system: mph.PinholeSystem) -> mph.Optics:
    """Return the optics of a scanner's modules by the options of `add_materials`, or of `add_edge` and ``--isotope``."""
    lines: tuple[tuple[float, float], ...] = ()
    if arguments.isotope is not None:
        isotope = mph.isotope(arguments.isotope)
        lines = isotope.lines_within(*isotope.window)
    settings = {name: value for name, value in vars(arguments).items() if name in MATERIAL_OPTIONS[:-1]}
    angle = angle_from_degrees(settings.pop("opening_angle"), "--opening-angle")
    return mph.Optics.of(system, lines, **settings, opening_angle=angle)
