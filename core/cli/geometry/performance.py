"""Action ``mphdrr geometry performance FILE``: sensitivity, resolution and field of view of each module."""

import argparse
import math

import numpy as np

from .... import core as mph
from ...arrays import table_rows
from ..options import print_answer
from ..scanners import read_pinhole_system
from .arguments import add_action, add_materials, chosen_optics


def add_parser(actions) -> None:  # type: ignore[no-untyped-def]
    """Add the action ``geometry performance``."""
    parser = add_action(actions, "performance", _run)
    add = parser.add_argument
    add("--point", type=float, nargs=3, default=[0, 0, 0], metavar="MM", help="position of the source, x y z")
    add_materials(parser)


def _run(arguments: argparse.Namespace) -> None:
    """Print each module's sensitivity, resolution and field of view at the isocentre, or at a point.

    mphdrr geometry performance scanner.xlsx --isotope Tc-99m --aperture-mu tungsten --crystal-mu NaI
    """
    system = read_pinhole_system(arguments)
    points, optics = [arguments.point], chosen_optics(arguments, system)
    counts = 1e6 * mph.sensitivity(system, points, optics=optics)[0]
    fwhm = mph.resolution(system, points, optics=optics)[0]
    radius = system.roi_radius_seen()
    columns = {
        "number": system.numbers,
        "ring": system.rings() + 1,
        "sensitivity": counts,
        "resolution": fwhm,
        "magnification": mph.magnification(system, points)[0],
        "roi_radius_seen": radius,
        "roi_radius": system.roi_radius,
    }
    is_seeing = counts > 0
    rms = math.sqrt(np.average(fwhm[is_seeing] ** 2, weights=counts[is_seeing])) if is_seeing.any() else None
    total = {
        "sensitivity": float(counts.sum()),
        "resolution": rms,
        "modules_seeing": int(is_seeing.sum()),
        # Up to the rounding of l in the workbook.
        "modules_holding_roi": int(np.count_nonzero(radius >= system.roi_radius - 1e-3)),
        "sampling_gap_degrees": math.degrees(mph.sampling_gaps(system, points)[0]),
    }
    rows = table_rows(columns)
    modules = [{name: None if x != x else x for name, x in row.items()} for row in rows]  # no NaN in JSON
    units = "sensitivity cps/MBq; resolution and radii mm"
    lines = [" module  ring  cps/MBq  FWHM mm  magnification  sees R mm     R mm"]
    lines += ["{:7d} {:5d} {:8.3f} {:8.2f} {:14.4f} {:10.2f} {:8.2f}".format(*row.values()) for row in rows]
    lines += [f"total {total['sensitivity']:.1f} cps/MBq from {total['modules_seeing']} of {len(system)} modules"]
    if rms is not None:
        lines += [f"resolution {rms:.2f} mm FWHM, the modules' root mean square weighted by counts"]
    lines += [f"planes through the point miss all pinholes by up to {total['sampling_gap_degrees']:.1f} degrees"]
    lines += [f"{total['modules_holding_roi']} of {len(system)} modules see their whole ROI"]
    print_answer(arguments, {"point": arguments.point, "modules": modules, "total": total, "units": units}, lines)
