"""``mphdrr volume convert IN -o OUT``."""

from __future__ import annotations

import argparse

import numpy as np

from ...errors import InputError
from ...geometry.grid import Grid
from ...physics.ct_numbers import hu_to_mu
from ...volumes.rearranging import canonical, centered, crop_to_box, pad
from ...volumes.resampling import resample
from ...volumes.volume import Volume
from ...volumes.volume_files import VOLUME_FORMATS, write_volume
from ..options import add_command, output_path, photon_energy, progress_bar
from .arguments import add_input, read_input


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action."""
    parser = add_command(
        actions,
        "convert",
        "convert a volume to another format, and crop, move, resample it or convert it to attenuation",
        "mphdrr volume convert dicom_folder --center --spacing 2 --to-mu --energy Tc-99m -o mu.nii.gz",
    )
    add_input(parser)
    steps = parser.add_argument_group("changes, in this order")
    steps.add_argument(
        "--canonical", action="store_true", help="index axes to the right, front and head: flip, transpose"
    )
    steps.add_argument(
        "--crop",
        type=float,
        nargs=6,
        metavar=("X0", "X1", "Y0", "Y1", "Z0", "Z1"),
        help="to a box, mm, in FILE's world",
    )
    steps.add_argument("--pad", type=int, default=0, metavar="N", help="voxels more on every side")
    steps.add_argument("--center", action="store_true", help="move the middle to the isocentre")
    steps.add_argument(
        "--spacing", type=float, nargs="+", metavar="MM", help="resample to this voxel size, one or three"
    )
    steps.add_argument(
        "--method", choices=("linear", "nearest", "mean"),
        help="of resampling; default: mean for coarser voxels, else linear; labels need nearest",
    )  # fmt: skip
    steps.add_argument("--to-mu", action="store_true", help="CT numbers to attenuation, 1/mm, at --energy")
    parser.add_argument(
        "--energy", metavar="KEV", help="of the photons, or an isotope's name: its strongest line (default: 140.5)"
    )
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help=", ".join(VOLUME_FORMATS))
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    path = output_path(arguments.output, VOLUME_FORMATS)
    if arguments.energy is not None and not arguments.to_mu:
        raise InputError("--energy needs --to-mu")
    if arguments.method is not None and not arguments.spacing:
        raise InputError("--method needs --spacing")
    energy = photon_energy(arguments.energy or "140.5")
    volume = read_input(arguments)
    if arguments.canonical:
        volume = canonical(volume)
    if arguments.crop:
        volume = crop_to_box(volume, arguments.crop[::2], arguments.crop[1::2])
    if arguments.pad:
        volume = pad(volume, arguments.pad, arguments.pad)
    if arguments.center:
        volume = centered(volume)
    if arguments.spacing:
        volume = _respaced(volume, arguments.spacing, arguments.method)
    if arguments.to_mu:
        volume = hu_to_mu(volume, energy)
    write_volume(volume, path)
    low, high = float(volume.array.min()), float(volume.array.max())
    print(f"{path}: {' x '.join(map(str, volume.grid.shape))} voxels, {low:.4g} to {high:.4g} {volume.unit}")


def _respaced(volume: Volume, spacing: list[float], method: str | None) -> Volume:
    """The volume on a grid with the same axes and first faces, and at least the same extent."""
    if len(spacing) not in (1, 3) or not min(spacing) > 0:
        raise InputError(f"--spacing: expected one or three numbers above 0, got {' '.join(f'{x:g}' for x in spacing)}")
    old = volume.grid
    steps = np.broadcast_to(spacing, 3) / old.spacing  # in old voxels
    n_x, n_y, n_z = (max(1, int(np.ceil(n / step - 1e-6))) for n, step in zip(old.shape, steps, strict=True))
    index = np.diag([*steps, 1.0])
    index[:3, 3] = (steps - 1) / 2
    grid = Grid((n_x, n_y, n_z), old.affine @ index)
    method = method or ("mean" if steps.max() > 1 else "linear")
    # Label files say no quantity and are taken for CT numbers, but outside them is 0 and not air.
    outside = 0.0 if method == "nearest" and volume.array.min() >= 0 else None
    return resample(volume, grid, method, outside, progress_bar("resampling"))
