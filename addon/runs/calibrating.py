"""Calibration in the window: modules move to where images of point sources have them."""

import json
from pathlib import Path

import bpy
import numpy as np

from ...core.design.calibration import Calibration
from ...core.design.calibration_recipe import run_calibration
from ...core.errors import InputError
from ...core.progress import Progress
from ...core.runs.mosaic import png
from ..blender import ids, jobs
from ..pictures import images
from ..scanner import arrows, module_edits, scanner

_FAR = 25.0  # mm: a module that is as far from the recipe's is another scanner's


def calibrating(context: bpy.types.Context, path: Path, apply: bool = True, exaggeration: float = 0.0) -> jobs.Job:
    """The job that calibrates the active scanner as a recipe (.toml) says, by the same numbers as `run_calibration`.

    With `apply` the modules move and turn to what is found. Arrows lead from nominal to found pinholes, `exaggeration`
    times as long, or, if 0, the longest about 50 mm. Modules that do not fit are marked. Raises InputError where there is no
    scanner of pinholes.
    """
    collection = scanner.required_scanner(context.scene)
    scanner.read_pinholes(collection)  # or an error before the work begins
    uid = collection.session_uid

    def work(progress: Progress) -> tuple[Calibration, bytes]:
        found = run_calibration(path, progress)
        return found, png(found.residual_sheet().picture)

    def finish(result: tuple[Calibration, bytes]) -> str:
        found, picture = result
        collection = jobs.find_by_uid(bpy.data.collections, uid)
        if collection is None:
            raise InputError("the scanner that was calibrated is gone")
        _require_same(collection, found)
        if apply:
            module_edits.move_modules(collection, found.system)
        factor = arrows.show(collection, found.nominal.centers, found.system.centers, exaggeration)
        lines = [*found.summary(), *([f"arrows: {factor:g} times the shift"] if factor else [])]
        collection.mphdrr_scanner.calibration = json.dumps(lines)
        _mark_misfits(collection, found)
        images.show_below(images.store_png(ids.RESIDUALS, picture), bpy.context)
        return f"{'Calibrated' if apply else 'Not applied'}: {'; '.join(lines[:3])}"

    return jobs.Job("Calibrating", work, finish)


def _require_same(collection: bpy.types.Collection, found: Calibration) -> None:
    """Refuse a recipe of another scanner: its modules, or their places, are others."""
    system = scanner.read_pinholes(collection)
    places = dict(zip(system.numbers.tolist(), system.centers, strict=True))
    for number, *known in zip(found.system.numbers.tolist(), found.nominal.centers, found.system.centers, strict=True):
        if number not in places or np.linalg.norm(known - places[number], axis=1).min() > _FAR:
            where = f"module {number} within {_FAR:g} mm of where the recipe has it"
            raise InputError(f"scanner '{collection.name}' has no {where}: choose the recipe's scanner")


def _mark_misfits(collection: bpy.types.Collection, found: Calibration) -> None:
    """Note at each module whether it fits."""
    for number, misfit in zip(found.system.numbers.tolist(), found.misfit.tolist(), strict=True):
        why = f"misfit {misfit:.1f}, where 1 is usual" if np.isfinite(misfit) else "its images fit no place nearby"
        text = f"Does not fit its calibration: {why}" if number in found.misfitting else ""
        scanner.module(collection, number).mphdrr_module.finding = text
