"""Action ``mphdrr geometry fit FILE``: ellipses fitted to the rings of modules."""

import argparse
from collections.abc import Iterator
from typing import Any

import numpy as np

from ...geometry.ring_fits import RingFit, fit_rings
from ..options import print_answer
from ..scanners import read_pinhole_system
from .arguments import add_action

_LARGEST_DEVIATION = 0.1
"""Largest distance from the ellipse, mm, that rounding in a workbook explains."""


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action ``geometry fit``."""
    add_action(actions, "fit", _run)


def _run(arguments: argparse.Namespace) -> None:
    """Find the ellipse that each ring of modules follows, and the modules' distances from it.

    mphdrr geometry fit scanner.xlsx
    """
    rings = [_record(fit) for fit in fit_rings(read_pinhole_system(arguments))]
    print_answer(arguments, {"rings": rings, "units": "mm, degrees"}, _lines(rings))


def _lines(rings: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of text about each ring's fit."""
    for i, ring in enumerate(rings, 1):
        (a, b), (x, y), azimuths, z = (ring[name] for name in ("semi_axes", "center", "azimuths", "z"))
        yield f"ring {i}: {len(azimuths)} modules, {ring['numbers'][0]} to {ring['numbers'][-1]}"
        yield f"  ellipse     semi-axes {a:.3f} and {b:.3f} mm, turned by {ring['rotation']:.4f} degrees"
        yield f"              centre at x = {x:.3f}, y = {y:.3f} mm"
        yield f"  azimuths    from {azimuths[0]:.4f} to {azimuths[-1]:.4f} degrees"
        yield f"  z           from {min(z):.4f} to {max(z):.4f} mm"
        verdict = "" if ring["curve_deviation"] <= _LARGEST_DEVIATION else ": these modules follow no ellipse"
        yield f"  deviation   {ring['curve_deviation']:.2g} mm at most from the ellipse{verdict}"
        even = f"if at equal steps of {ring['spacing']} and at one z, {np.mean(z):.4f} mm"
        yield f"              {ring['even_deviation']:.2g} mm at most {even}"


def _record(fit: RingFit) -> dict[str, Any]:
    """Return a ring's fit as JSON, angles in degrees."""
    record = {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in vars(fit).items()}
    return {**record, "rotation": float(np.degrees(fit.rotation)), "azimuths": np.degrees(fit.azimuths).tolist()}
