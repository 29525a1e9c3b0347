"""``mphdrr phantom derenzo -o FILE``."""

from __future__ import annotations

import argparse
import dataclasses
from typing import Any

import numpy as np

from ..checks import whole_shape
from ..frames import euler_pose
from ..grid import Grid
from ..phantoms.derenzo import DerenzoPhantom
from ..volume import Volume
from ..volume_io import VOLUME_FORMATS, write_volume
from .options import add_command, add_phantom_options, output_path, progress_bar


def add_parser(subparsers) -> None:  # type: ignore[no-untyped-def]
    """Add the command."""
    phantom = add_command(subparsers, "phantom", "make a phantom volume", "mphdrr phantom derenzo -o derenzo.nii.gz")
    kinds = phantom.add_subparsers(metavar="KIND", required=True)
    derenzo = add_command(
        kinds,
        "derenzo",
        "make a Derenzo phantom: six sectors of hot rods",
        "mphdrr phantom derenzo --radius 40 --rods 8 6 5 4 3 2 --euler 30 0 0 -o derenzo.nii.gz",
    )
    add_phantom_options(derenzo)
    derenzo.add_argument("-o", "--output", required=True, metavar="FILE", help=", ".join(VOLUME_FORMATS))
    derenzo.set_defaults(run=_run)


def derenzo_volume(arguments: argparse.Namespace) -> tuple[Volume, dict[str, Any]]:
    """The phantom that the options of `add_phantom_options` describe, and what it was made from."""
    phantom = DerenzoPhantom(arguments.radius, tuple(arguments.rods), arguments.height, arguments.activity)
    voxels = whole_shape(_one_or_three(arguments.voxels), "--voxels", 3)
    spacing = _one_or_three(arguments.spacing) if arguments.spacing else phantom.extent / max(1, min(voxels) - 2)
    grid = Grid.centered(voxels, spacing, arguments.position)
    phi, theta, psi = np.deg2rad(arguments.euler)
    pose = euler_pose(phi, theta, psi, arguments.position)
    recipe = {
        "phantom": {"kind": "derenzo", **dataclasses.asdict(phantom)},
        "position_mm": list(arguments.position),
        "euler_degrees": list(arguments.euler),
    }
    return phantom.voxelize(grid, pose, progress_bar("voxelizing")), recipe


def _one_or_three(values: list) -> list:
    return values * 3 if len(values) == 1 else values


def _run(arguments: argparse.Namespace) -> None:
    path = output_path(arguments.output, VOLUME_FORMATS)
    volume, _ = derenzo_volume(arguments)
    write_volume(volume, path)
    total = volume.array.sum(dtype=np.float64) * volume.grid.voxel_volume * 1e-3
    print(f"{path}: {' x '.join(map(str, volume.grid.shape))} voxels, {total:.4g} kBq in all")
