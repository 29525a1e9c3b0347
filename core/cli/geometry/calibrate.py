"""``mphdrr geometry calibrate RECIPE -o FILE``."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .... import core as mph
from ...files import write_bytes
from ...runs.mosaic import write_png
from ..options import add_run, counted, output_path, print_answer, progress_bar

_LISTED = 5


def add_parser(actions: Any) -> None:
    """Add the action."""
    parser = add_run(actions, "calibrate", _run)
    parser.add_argument("recipe", metavar="RECIPE", help="recipe of the calibration (.toml)")
    text = "the calibrated workbook (.xlsx, .xlsm); covariances (.json) and residuals (.png) are written beside it"
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help=text)
    parser.add_argument("--json", action="store_true", help="print JSON")


def _run(arguments: argparse.Namespace) -> None:
    """Find where the modules are from images of point sources, and write the workbook with their places and tilts.

    mphdrr geometry calibrate points.toml -o calibrated.xlsx
    """
    from ...design.calibration_recipe import run_calibration  # takes a while, as for --help

    path = output_path(arguments.output, (".xlsx", ".xlsm"))
    found = run_calibration(arguments.recipe, progress_bar("finding spots"))
    source = found.system.source
    mph.write_system(found.system, path, None if source is None else source.path)
    record = _record(found)
    write_bytes(path.with_suffix(".json"), json.dumps(record, indent=1).encode())
    write_png(found.residual_sheet().picture, path.with_suffix(".png"))
    print_answer(arguments, record, _lines(found, path))


def _record(found: mph.Calibration) -> dict[str, Any]:
    """The calibration as JSON has it: no NaN, angles in rad."""
    names = ("points", "covariance", "chi_square", "misfit", "used", "spread", "told", "detector_offset")
    record = {name: _plain(getattr(found, name).tolist()) for name in names}
    record |= {name: list(getattr(found, name)) for name in ("names", "misfitting", "gauge")}
    of_modules = ("numbers", "centers", "tilt", "collimator_length")
    geometry = {name: getattr(found.system, name).tolist() for name in of_modules}
    return {**geometry, **record, "untold": found.untold(), "units": "mm, rad"}


def _plain(value: Any) -> Any:
    return [_plain(each) for each in value] if isinstance(value, list) else None if value != value else value


def _lines(found: mph.Calibration, path: Path) -> Iterator[str]:
    unit = np.where([name.startswith("tilt") for name in found.names], np.degrees(1.0), 1.0)
    spread = np.sqrt((found.spread**2).mean(axis=0)) * unit
    images = f"{found.used.sum()} of {found.used.size} images"
    yield f"{path}: {counted(len(found.system), 'module')} by {counted(len(found.points), 'point')}, {images}"
    for name, sd in zip(found.names, spread, strict=True):
        yield f"  {name:12s} known to {sd:.3f} {'degrees' if name.startswith('tilt') else 'mm'}"
    for line in found.summary():
        yield f"  {line}"
    if np.isfinite(found.chi_square).any():
        yield f"  chi-square {np.nanmin(found.chi_square):.2f} to {np.nanmax(found.chi_square):.2f} per degree of freedom"
    yield " module  chi-square  misfit  images"
    for m in np.argsort(-np.nan_to_num(found.misfit))[:_LISTED]:
        yield f"{found.system.numbers[m]:7d} {found.chi_square[m]:11.2f} {found.misfit[m]:7.2f} {found.used[:, m].sum():7d}"
