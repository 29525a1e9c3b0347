"""Options that the actions share."""

from __future__ import annotations

import argparse

from ...volumes.volume import UNITS, Volume
from ...volumes.volume_files import read_volume
from ..options import progress_bar


def add_input(parser: argparse.ArgumentParser) -> None:
    """Add the volume to read."""
    parser.add_argument(
        "file",
        metavar="FILE",
        help="volume, folder of a DICOM series, or any file of one (docs/volumes.md has the formats)",
    )
    parser.add_argument(
        "--quantity", choices=tuple(UNITS), help="what its values are; default: what the file says, else CT numbers, hu"
    )
    parser.add_argument("--series", metavar="NAME", help="one of several DICOM series, by number, description or UID")
    parser.add_argument(
        "--affine",
        type=float,
        nargs=16,
        metavar="A",
        help="index to world mm, row by row, instead of the file's; .npy needs it",
    )


def read_input(arguments: argparse.Namespace) -> Volume:
    """The volume that the options of `add_input` describe."""
    rows = arguments.affine
    affine = None if rows is None else [rows[i : i + 4] for i in range(0, 16, 4)]
    return read_volume(
        arguments.file, arguments.quantity, affine=affine, series=arguments.series, progress=progress_bar("reading")
    )
