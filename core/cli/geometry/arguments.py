"""Arguments that the actions share."""

from __future__ import annotations

import argparse
import math
from typing import Any

from ...errors import InputError
from ...isotopes import CZT_MU, ISOTOPES, NAI_MU, TUNGSTEN_MU, isotope


def add_workbook(parser: argparse.ArgumentParser) -> None:
    """The workbook to read, and how to print the answer."""
    parser.add_argument("file", metavar="FILE", help="geometry workbook (.xlsx, .xlsm)")
    add_json(parser)


def add_json(parser: argparse.ArgumentParser) -> None:
    """How to print the answer."""
    parser.add_argument("--json", action="store_true", help="print JSON")


def add_materials(parser: argparse.ArgumentParser) -> None:
    """What the modules are made of and what decays, for `sensitivity_settings` and `resolution_settings`."""
    group = parser.add_argument_group("materials; without an option the module is ideal")
    group.add_argument(
        "--aperture-mu", type=float, metavar="MU",
        help=f"of the aperture, 1/mm: {TUNGSTEN_MU} for tungsten at 140.5 keV; without it, nothing penetrates",
    )  # fmt: skip
    group.add_argument("--opening-angle", type=float, default=90.0, metavar="DEG", help="full angle of the knife edge")
    group.add_argument(
        "--crystal-mu", type=float, metavar="MU",
        help=f"of the crystal, 1/mm: {NAI_MU} for NaI, {CZT_MU} for CZT at 140.5 keV; without it, all photons count",
    )  # fmt: skip
    group.add_argument(
        "--intrinsic-fwhm", type=float, default=0.0, metavar="MM", help="resolution of the detector, mm on the crystal"
    )
    group.add_argument("--isotope", metavar="NAME", help=f"{', '.join(ISOTOPES)}; without it, one photon per decay")


def sensitivity_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """The keywords of `sensitivity`."""
    photons = 1.0
    if arguments.isotope is not None:
        decaying = isotope(arguments.isotope)
        photons = decaying.photons_per_decay(*decaying.window)
    return {**_edge(arguments), "crystal_mu": arguments.crystal_mu, "photons_per_decay": photons}


def resolution_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """The keywords of `resolution`."""
    return {**_edge(arguments), "intrinsic_fwhm": arguments.intrinsic_fwhm}


def _edge(arguments: argparse.Namespace) -> dict[str, Any]:
    if not 0 < arguments.opening_angle < 180:
        raise InputError(
            f"--opening-angle {arguments.opening_angle:g}: expected degrees, more than 0 and less than 180"
        )
    return {"aperture_mu": arguments.aperture_mu, "opening_angle": math.radians(arguments.opening_angle)}
