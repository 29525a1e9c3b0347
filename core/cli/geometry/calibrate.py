"""Action ``mphdrr geometry calibrate RECIPE -o FILE``: module positions and tilts from images of point sources."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from .... import core as mph
from ...files import write_bytes
from ...progress import StagedProgress
from ...runs.mosaic import write_png
from ..options import add_run, count_text, output_path, print_answer, progress_bar

_MAX_LISTED_MODULES = 5


def add_parser(actions: Any) -> None:
    """Add the action ``geometry calibrate``."""
    parser = add_run(actions, "calibrate", _run)
    parser.add_argument("recipe", metavar="RECIPE", help="recipe of the calibration (.toml)")
    text = "the calibrated workbook (.xlsx, .xlsm); covariances (.json) and residuals (.png) are written beside it"
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help=text)
    parser.add_argument("--json", action="store_true", help="print JSON")


def _run(arguments: argparse.Namespace) -> None:
    """Find the positions and tilts of the modules from images of point sources, and write the workbook with them.

    mphdrr geometry calibrate points.toml -o calibrated.xlsx
    """
    from ...design.calibration_recipe import run_calibration  # this import takes a while, which --help does not need

    path = output_path(arguments.output, (".xlsx", ".xlsm"))
    record_path, picture_path = (output_path(str(path.with_suffix(suffix))) for suffix in (".json", ".png"))
    calibration = run_calibration(arguments.recipe, StagedProgress(progress_bar, "calibrating"))
    source = calibration.system.source
    mph.write_system(calibration.system, path, None if source is None else source.path)
    record = _record(calibration)
    write_bytes(record_path, json.dumps(record, indent=1).encode())
    write_png(calibration.residual_sheet().picture, picture_path)
    print_answer(arguments, record, _lines(calibration, path))


def _record(calibration: mph.Calibration) -> dict[str, Any]:
    """Return the calibration as JSON: angles in rad, None for NaN."""
    fields = "points covariance chi_square misfit used spread told detector_offset blur blur_sd"
    record = {name: _json_value(getattr(calibration, name).tolist()) for name in fields.split()}
    record |= {name: list(getattr(calibration, name)) for name in ("names", "misfitting", "gauge")}
    module_names = ("numbers", "centers", "tilt", "collimator_length")
    geometry = {name: getattr(calibration.system, name).tolist() for name in module_names}
    return {**geometry, **record, "untold": calibration.untold(), "units": "mm, rad"}


def _json_value(value: Any) -> Any:
    """Return a number or nested lists of numbers with None for NaN, which JSON lacks."""
    return [_json_value(item) for item in value] if isinstance(value, list) else None if value != value else value


def _lines(fit: mph.Calibration, path: Path) -> Iterator[str]:
    """Yield the lines of the calibration's summary, with the modules that fit worst."""
    unit = np.where([name.startswith("tilt") for name in fit.names], np.degrees(1.0), 1.0)
    deviations = np.sqrt((fit.spread**2).mean(axis=0)) * unit
    images = f"{fit.used.sum()} of {fit.used.size} images"
    yield f"{path}: {count_text(len(fit.system), 'module')} by {count_text(len(fit.points), 'point')}, {images}"
    for name, sd in zip(fit.names, deviations, strict=True):
        yield f"  {name:12s} known to {sd:.3f} {'degrees' if name.startswith('tilt') else 'mm'}"
    for line in fit.summary():
        yield f"  {line}"
    if np.isfinite(fit.chi_square).any():
        yield f"  chi-square {np.nanmin(fit.chi_square):.2f} to {np.nanmax(fit.chi_square):.2f} per degree of freedom"
    yield " module  chi-square  misfit  images"
    for m in np.argsort(-np.nan_to_num(fit.misfit))[:_MAX_LISTED_MODULES]:
        yield f"{fit.system.numbers[m]:7d} {fit.chi_square[m]:11.2f} {fit.misfit[m]:7.2f} {fit.used[:, m].sum():7d}"
