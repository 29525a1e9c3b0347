"""What the Design panel shows of a module and of its scanner: calculated when something changes, never while drawing."""

from __future__ import annotations

from collections.abc import Sequence

import bpy

from ..core.errors import InputError
from ..core.physics.performance import isocentre_performance
from .module_values import LENGTHS, ModuleNumbers

_COVERED = 1 - 1e-6  # share of R: an `l` from the ROI sees R up to rounding


def update_module(module: bpy.types.PropertyGroup, numbers: ModuleNumbers, aimed: bool, intrinsic_fwhm: float) -> None:
    """Write a module's readouts; where its numbers make no module they are 0, and `problem` says why."""
    module.pinhole_distance, module.aimed = numbers.pinhole_distance, aimed
    _, _, d, l, side, thickness, _ = numbers
    try:
        numbers.system()  # refuses what makes no module
        at = isocentre_performance(numbers.pinhole_distance, d, l, side, thickness, intrinsic_fwhm=intrinsic_fwhm)
    except InputError as error:
        module.problem = str(error)
        module.sensitivity = module.resolution = module.magnification = module.roi_seen = 0.0
        return
    module.problem = ""
    module.sensitivity, module.resolution = 1e6 * float(at.sensitivity), float(at.resolution)
    module.magnification, module.roi_seen = float(at.magnification), float(at.roi_radius_seen)


def covers_roi(module: bpy.types.PropertyGroup) -> bool:
    """Whether a module sees its whole ROI sphere."""
    return not module.problem and module.roi_seen >= _COVERED * module.roi_radius


def update_scanner(scanner: bpy.types.PropertyGroup, modules: Sequence[bpy.types.PropertyGroup]) -> None:
    """Write the readouts of all modules together, and the numbers that they share."""
    good = [module for module in modules if not module.problem]
    scanner.count = len(modules)
    scanner.sensitivity = sum(module.sensitivity for module in good)
    scanner.resolution = sum(module.resolution for module in good) / max(1, len(good))
    scanner.n_covering = sum(covers_roi(module) for module in good)
    scanner.findings = ""
    mixed = []
    for name in (*LENGTHS, "length_mode") if modules else ():
        values = {getattr(module, name) for module in modules}
        setattr(scanner, name, getattr(modules[0], name))
        if len(values) > 1:
            mixed.append(name)
    scanner.mixed = " ".join(mixed)
