"""``mphdrr geometry map FILE -o FILE``."""

from __future__ import annotations

import argparse
import json

import numpy as np

from ...geometry.grid import Grid
from ...geometry.system import PinholeSystem
from ...physics.maps import MAPS
from ...validation import whole_shape
from ...volumes.volume import Volume
from ...volumes.volume_files import VOLUME_FORMATS, write_volume
from ..options import (
    add_command,
    add_workbook,
    chosen_modules,
    one_or_three,
    output_path,
    progress_bar,
    read_workbook,
    refuse,
)
from .arguments import MATERIAL_OPTIONS, add_json, add_materials, resolution_settings, sensitivity_settings

_OF_MATERIALS = ("sensitivity", "resolution")


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action."""
    parser = add_command(
        actions,
        "map",
        "make a volume of what the scanner does in every voxel",
        "mphdrr geometry map scanner.xlsx --quantity sensitivity --voxels 64 --spacing 3 -o sensitivity.nii.gz",
    )
    parser.add_argument(
        "--quantity", choices=MAPS, default="sensitivity",
        help="counts per decay; number of modules that see the voxel; expected FWHM, mm; completeness of the angular "
        "sampling, 1 where every plane through the voxel meets a pinhole that sees it",
    )  # fmt: skip
    parser.add_argument("--voxels", type=int, nargs="+", default=[64], metavar="N", help="voxels along x y z, or one")
    parser.add_argument(
        "--spacing", type=float, nargs="+", metavar="MM", help="voxel size, one or three; default: so that the ROI fits"
    )
    parser.add_argument("--center", type=float, nargs=3, default=[0, 0, 0], metavar="MM", help="of the grid, x y z")
    parser.add_argument("--modules", metavar="RANGE", help="such as 1-40 or 1-20,41; default: all")
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help=", ".join(VOLUME_FORMATS))
    add_materials(parser)
    add_workbook(parser)
    add_json(parser)
    parser.set_defaults(run=_run)


def _run(arguments: argparse.Namespace) -> None:
    path = output_path(arguments.output, VOLUME_FORMATS)
    if arguments.quantity not in _OF_MATERIALS:
        refuse(arguments, MATERIAL_OPTIONS, f"has no effect on --quantity {arguments.quantity}")
    system = chosen_modules(read_workbook(arguments), arguments.modules)
    voxels = whole_shape(one_or_three(arguments.voxels), "--voxels", 3)
    spacing = one_or_three(arguments.spacing) if arguments.spacing else 2 * system.roi_radius.max() / min(voxels)
    volume = _map(arguments, system, Grid.centered(voxels, spacing, arguments.center))
    write_volume(volume, path)
    low, high, mean = (float(f(volume.array)) for f in (np.min, np.max, np.mean))
    if arguments.json:
        record = {"file": str(path), "quantity": volume.quantity, "unit": volume.unit}
        print(json.dumps({**record, "minimum": low, "maximum": high, "mean": mean}, indent=1))
        return
    shape = " x ".join(map(str, volume.grid.shape))
    print(f"{path}: {shape} voxels, {volume.quantity} from {low:.4g} to {high:.4g} {volume.unit}".removesuffix(" 1"))


def _map(arguments: argparse.Namespace, system: PinholeSystem, grid: Grid) -> Volume:
    counting = sensitivity_settings(arguments, system)
    settings = {
        "sensitivity": counting,
        "resolution": {**resolution_settings(arguments, system), "crystal_mu": counting["crystal_mu"]},
    }
    return MAPS[arguments.quantity](
        system, grid, **settings.get(arguments.quantity, {}), progress=progress_bar("mapping")
    )
