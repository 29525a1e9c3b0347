"""``mphdrr volume info FILE``."""

from __future__ import annotations

import argparse
import json
from typing import Any

import numpy as np

from ...volumes.volume import Volume
from ..options import add_command
from .arguments import add_input, read_input


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action."""
    parser = add_command(actions, "info", "show a volume's place, grid and values", "mphdrr volume info ct.nii.gz")
    add_input(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    facts = _facts(read_input(arguments))
    if arguments.json:
        print(json.dumps(facts, indent=1))
        return
    for name, value in facts.items():
        if name == "affine":
            continue
        text = " ".join(f"{x:g}" if isinstance(x, float) else str(x) for x in np.atleast_1d(value).tolist())
        print(f"{name:16s} {text}")


def _facts(volume: Volume) -> dict[str, Any]:
    array, grid = volume.array, volume.grid
    corners = grid.corners()
    return {
        "quantity": volume.quantity,
        "unit": volume.unit,
        "voxels": list(grid.shape),
        "spacing_mm": grid.spacing.tolist(),
        "axes": _axes(grid.affine),
        "center_mm": grid.center.tolist(),
        "low_mm": corners.min(axis=0).tolist(),
        "high_mm": corners.max(axis=0).tolist(),
        "smallest": float(array.min()),
        "mean": float(array.mean(dtype=np.float64)),
        "largest": float(array.max()),
        "affine": grid.affine.tolist(),
    }


def _axes(affine: np.ndarray) -> str:
    """The direction of each index axis in the patient, such as ``RAS``: the closest of R, L, A, P, S, I."""
    letters = []
    for axis in affine[:3, :3].T:
        world = int(np.abs(axis).argmax())
        letters.append(("LPI", "RAS")[int(axis[world] > 0)][world])
    return "".join(letters)
