"""``mphdrr geometry check FILE``."""

from __future__ import annotations

import argparse
import json
import sys
import warnings

import numpy as np

from ...errors import InputWarning
from ...system import PinholeSystem
from ...workbook import read_system
from ..options import add_command
from .arguments import add_workbook


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action."""
    parser = add_command(
        actions, "check", "compare the workbook with the design formulas", "mphdrr geometry check a.xlsx"
    )
    add_workbook(parser)
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
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
