"""Action ``mphdrr geometry map FILE -o FILE``: volumes of sensitivity, resolution, visibility or sampling."""

import argparse

import numpy as np

from .... import core as mph
from ...physics.maps import MAPS
from ...validation import shape_text, whole_shape
from ...volumes.volume_files import VOLUME_FORMATS
from ..options import expand_to_three, output_path, print_answer, progress_bar, refuse
from ..scanners import chosen_modules, read_pinhole_system
from .arguments import MATERIAL_OPTIONS, add_action, add_materials, chosen_optics

_MATERIAL_QUANTITIES = ("sensitivity", "resolution")
"""Quantities that depend on the materials."""


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action ``geometry map``."""
    parser = add_action(actions, "map", _run)
    add = parser.add_argument
    quantity = (
        "counts per decay; number of modules that see the voxel; expected FWHM, mm; completeness of the angular "
        "sampling, 1 where every plane through the voxel meets a pinhole that sees it"
    )
    add("--quantity", choices=MAPS, default="sensitivity", help=quantity)
    add("--voxels", type=int, nargs="+", default=[64], metavar="N", help="voxels along x y z, or one number for all")
    add("--spacing", type=float, nargs="+", metavar="MM", help="voxel size, one or three; default: fits the ROI")
    add("--center", type=float, nargs=3, default=[0, 0, 0], metavar="MM", help="centre of the grid, x y z")
    add("--modules", metavar="RANGE", help="modules to use, such as 1-40 or 1-20,41; default: all")
    add("-o", "--output", required=True, metavar="FILE", help=", ".join(VOLUME_FORMATS))
    add_materials(parser)


def _run(arguments: argparse.Namespace) -> None:
    """Make a volume of a property of the scanner in every voxel, such as its sensitivity.

    mphdrr geometry map scanner.xlsx --quantity sensitivity --voxels 64 --spacing 3 -o sensitivity.nii.gz
    """
    path = output_path(arguments.output, VOLUME_FORMATS)
    if arguments.quantity not in _MATERIAL_QUANTITIES:
        refuse(arguments, MATERIAL_OPTIONS, f"has no effect on --quantity {arguments.quantity}")
    system = chosen_modules(read_pinhole_system(arguments), arguments.modules)
    voxels = whole_shape(expand_to_three(arguments.voxels), "--voxels", 3)
    spacing = expand_to_three(arguments.spacing) if arguments.spacing else 2 * system.roi_radius.max() / min(voxels)
    settings = {"optics": chosen_optics(arguments, system)} if arguments.quantity in _MATERIAL_QUANTITIES else {}
    grid = mph.Grid.centered(voxels, spacing, arguments.center)
    volume = MAPS[arguments.quantity](system, grid, **settings, progress=progress_bar("mapping"))
    mph.write_volume(volume, path)
    low, high, mean = (float(f(volume.array)) for f in (np.min, np.max, np.mean))
    record = {"file": str(path), "quantity": volume.quantity, "unit": volume.unit}
    shape = shape_text(volume.grid.shape)
    text = f"{path}: {shape} voxels, {volume.quantity} from {low:.4g} to {high:.4g} {volume.unit}".removesuffix(" 1")
    print_answer(arguments, {**record, "minimum": low, "maximum": high, "mean": mean}, [text])
