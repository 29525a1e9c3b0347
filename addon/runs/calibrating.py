"""Calibration in the window: modules move to the positions fitted to images of point sources."""

import json
from pathlib import Path

import bpy
import numpy as np

from ...core.design.calibration import Calibration
from ...core.design.calibration_recipe import run_calibration
from ...core.errors import InputError
from ...core.progress import Progress
from ...core.runs.mosaic import png_bytes
from ..blender import ids, jobs
from ..pictures import images
from ..scanner import arrows, module_edits, scanner

_MAX_DISTANCE = 25.0  # mm from the recipe's position; a module farther away belongs to another scanner


def calibrate_job(context: bpy.types.Context, path: Path, apply: bool = True, exaggeration: float = 0.0) -> jobs.Job:
    """Return the job that calibrates the active scanner by a recipe (.toml), with the same numbers as `run_calibration`.

    With `apply` the modules move and turn to the result. Arrows lead from nominal to calibrated pinholes, `exaggeration`
    times as long, or, if 0, the longest about 50 mm. Modules that do not fit are marked. Raises InputError where there is
    no scanner with pinholes.
    """
    collection = scanner.required_scanner(context.scene)
    scanner.read_pinholes(collection)  # raises its error before the work begins
    uid = collection.session_uid

    def work(progress: Progress) -> tuple[Calibration, bytes]:
        """Calibrate the scanner; return the calibration and a picture of its residuals as a PNG file."""
        calibration = run_calibration(path, progress)
        return calibration, png_bytes(calibration.residual_sheet().picture)

    def finish(result: tuple[Calibration, bytes]) -> str:
        """Show the shifts, move the modules if `apply` is set, and return the line to report."""
        calibration, picture = result
        if (collection := jobs.find_by_uid(bpy.data.collections, uid)) is None:
            raise InputError("the scanner that was calibrated is gone")
        _require_same_scanner(collection, calibration)
        if apply:
            module_edits.move_modules(collection, calibration.system)
        factor = arrows.show(collection, calibration.nominal.centers, calibration.system.centers, exaggeration)
        lines = [*calibration.summary(), *([f"arrows: {factor:g} times the shift"] if factor else [])]
        collection.mphdrr_scanner.calibration = json.dumps(lines)
        _mark_misfits(collection, calibration)
        images.show_below(images.store_png(ids.RESIDUALS, picture), bpy.context)
        return f"{'Calibrated' if apply else 'Not applied'}: {'; '.join(lines[:3])}"

    return jobs.Job("Calibrating", work, finish)


def _require_same_scanner(collection: bpy.types.Collection, calibration: Calibration) -> None:
    """Raise `InputError` for a recipe of another scanner, which has other module numbers or positions."""
    system = scanner.read_pinholes(collection)
    positions = dict(zip(system.numbers.tolist(), system.centers, strict=True))
    nominal, fitted = calibration.nominal.centers, calibration.system.centers
    for number, *pair in zip(calibration.system.numbers.tolist(), nominal, fitted, strict=True):
        if number not in positions or np.linalg.norm(pair - positions[number], axis=1).min() > _MAX_DISTANCE:
            expected = f"module {number} within {_MAX_DISTANCE:g} mm of where the recipe has it"
            raise InputError(f"scanner '{collection.name}' has no {expected}: choose the recipe's scanner")


def _mark_misfits(collection: bpy.types.Collection, calibration: Calibration) -> None:
    """Write into each module's `finding` why its images do not fit the calibration; an empty text where they do."""
    for number, misfit in zip(calibration.system.numbers.tolist(), calibration.misfit.tolist(), strict=True):
        reason = f"misfit {misfit:.1f}, where 1 is usual" if np.isfinite(misfit) else "its images fit no place nearby"
        text = f"Does not fit its calibration: {reason}" if number in calibration.misfitting else ""
        scanner.module(collection, number).mphdrr_module.finding = text
