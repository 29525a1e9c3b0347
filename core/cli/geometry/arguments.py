"""Options that the actions share."""

import argparse
from typing import Any

from .... import core as mph
from ...geometry.collimator import angle_from_degrees
from ...geometry.scanner import Scanner
from ...physics.materials import APERTURES, CRYSTALS
from ..options import add_run, number_or_name
from ..scanners import add_workbook

MATERIAL_OPTIONS = ("aperture_mu", "opening_angle", "crystal_mu", "intrinsic_fwhm", "isotope")
"""Destinations of the options of `add_materials`."""


def add_action(actions: Any, name: str, run: Any) -> argparse.ArgumentParser:
    """The parser of an action on a workbook, with ``--json``; its help is the docstring of `run`."""
    parser = add_run(actions, name, run)
    add_workbook(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser


def add_views(parser: argparse.ArgumentParser, pixels: str) -> None:
    """Add the images, for `views_of`; `pixels` is the help of their size."""
    add = parser.add_argument
    size = f"{pixels}; default: 256 256, or those of X-ray panels"
    add("--size", type=int, nargs=2, metavar=("ROWS", "COLUMNS"), help=size)
    add("--detector", choices=("virtual", "real"), default="virtual", help="upright in front, or crystal")
    add("--magnification", type=float, default=10.0, help="virtual detector's distance in units of l")
    add("--pitch", type=float, metavar="MM", help="pixel size; default: the crystal's whole side")


def views_of(system: Scanner, arguments: argparse.Namespace) -> mph.Views:
    """The views of a scanner that the options of `add_views` ask for."""
    shape = tuple(arguments.size) if arguments.size else system.pixels or (256, 256)
    return system.views(shape, arguments.detector, arguments.magnification, arguments.pitch)


def add_materials(parser: argparse.ArgumentParser) -> None:
    """Add the materials and the isotope, for `optics_of`."""
    group = parser.add_argument_group("materials; without an option the module is ideal")
    add_edge(group)
    crystal = f"{', '.join(CRYSTALS)} at the isotope's photons, or the coefficient, 1/mm; without it, all photons count"
    add = group.add_argument
    add("--crystal-mu", type=number_or_name, metavar="MATERIAL", help=crystal)
    add("--intrinsic-fwhm", type=float, default=0.0, metavar="MM", help="resolution of the detector, mm on the crystal")
    add("--isotope", metavar="NAME", help=f"{', '.join(mph.ISOTOPES)}; without it, one photon per decay")


def add_edge(parser: argparse._ActionsContainer) -> None:
    """Add the knife edge's material and angle, for `optics_of`, which needs an option ``--isotope`` too."""
    edge = f"{', '.join(APERTURES)} at the isotope's photons, or the coefficient, 1/mm; without it, nothing penetrates"
    parser.add_argument("--aperture-mu", type=number_or_name, metavar="MATERIAL", help=edge)
    parser.add_argument("--opening-angle", type=float, default=90.0, metavar="DEG", help="full angle of the knife edge")


def optics_of(arguments: argparse.Namespace, system: mph.PinholeSystem) -> mph.Optics:
    """What the options of `add_materials`, or of `add_edge` and ``--isotope``, say of a scanner's modules."""
    lines: tuple[tuple[float, float], ...] = ()
    if arguments.isotope is not None:
        decaying = mph.isotope(arguments.isotope)
        lines = decaying.lines_within(*decaying.window)
    settings = {name: value for name, value in vars(arguments).items() if name in MATERIAL_OPTIONS[:-1]}
    angle = angle_from_degrees(settings.pop("opening_angle"), "--opening-angle")
    return mph.Optics.of(system, lines, **settings, opening_angle=angle)
