"""Features of pinhole scanners in the scene: collimators' construction, the ROI sphere, readouts, checks."""

from collections.abc import Sequence
from dataclasses import asdict
from functools import lru_cache

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Optics, PinholeSystem, isocentre_performance, resolution, sensitivity
from ...core.geometry import checks
from ...core.geometry.collimator import Construction, EdgePlace
from ...core.geometry.scanner import Finding, Scanner
from ..blender.decimals import typed
from . import collimators
from .module_values import ScannerType

_READOUTS = ("sensitivity", "resolution", "magnification", "roi_seen")
# Constructing either takes long, and both are needed whenever a module moves.
_construction = lru_cache(maxsize=8)(Construction)
_optics = lru_cache(maxsize=8)(lambda intrinsic_fwhm: Optics(intrinsic_fwhm=intrinsic_fwhm))


def has_pinholes(kind: ScannerType) -> bool:
    """Return whether scanners of a kind have pinholes."""
    return issubclass(kind, PinholeSystem)


def construction_values(scanner: bpy.types.PropertyGroup) -> tuple[float, float, float, EdgePlace]:
    """Return the arguments of `Construction`, which may refuse them."""
    lengths = typed(scanner.plate_thickness), typed(scanner.wall_thickness)
    return *lengths, typed(scanner.opening_angle), scanner.edge_at.lower()


def readout_settings(scanner: bpy.types.PropertyGroup) -> tuple[float | str, ...]:
    """Return the scanner's settings on which its modules' readouts and shapes depend."""
    return *construction_values(scanner), typed(scanner.intrinsic_fwhm)


def construction(scanner: bpy.types.PropertyGroup, kind: ScannerType = PinholeSystem) -> Construction | None:
    """Return the construction of the scanner's collimators, None for a kind without; raise `InputError` if impossible."""
    return _construction(*construction_values(scanner)) if has_pinholes(kind) else None


def new_roi(system: Scanner, material: bpy.types.Material) -> bpy.types.Object | None:
    """Return a new ROI sphere for a system that has one, else None."""
    if not isinstance(system, PinholeSystem):
        return None
    roi = bpy.data.objects.new("ROI", collimators.new_sphere("ROI", system.region_radius(), material))
    roi.mphdrr_module.part = "ROI"
    roi.hide_select = True
    # Drawn as circles: the solid viewport draws no volume behind or inside a transparent surface. Renders show the sphere.
    roi.display_type, roi.display_bounds_type = "BOUNDS", "SPHERE"
    roi.lock_location = roi.lock_rotation = roi.lock_scale = (True, True, True)
    roi.visible_shadow = False
    return roi


def resize_roi(collection: bpy.types.Collection, modules: Sequence[bpy.types.Object]) -> None:
    """Make the ROI sphere, if there is one, as large as the largest ROI of the modules."""
    for item in collection.objects:
        if item.mphdrr_module.part == "ROI":
            radius = max((camera.mphdrr_module.roi_radius for camera in modules), default=0.0)
            if radius > 0:
                collimators.resize_sphere(item.data, radius)


def write_readouts(
    system: Scanner | InputError,
    modules: Sequence[bpy.types.PropertyGroup],
    indices: Sequence[int],
    scanner: bpy.types.PropertyGroup,
) -> None:
    """Write the readouts of the modules `indices` of a system; 0 where there is an error or no pinhole."""
    values = np.zeros((len(modules), len(_READOUTS)))
    if isinstance(system, PinholeSystem):
        values = _readouts(system, _optics(typed(scanner.intrinsic_fwhm)))[indices]
    for module, row in zip(modules, values.tolist(), strict=True):
        for name, value in zip(_READOUTS, row, strict=True):
            setattr(module, name, value)


def _readouts(system: PinholeSystem, optics: Optics) -> NDArray[np.float64]:
    """Return the `_READOUTS` of the modules at the isocentre, (M, 4)."""
    performance = isocentre_performance(
        system.pinhole_distance, system.pinhole_diameter, system.collimator_length, system.detector_side,
        system.detector_thickness, optics=optics,
    )  # fmt: skip
    counts, fwhm, magnification, roi_seen = performance
    if system.tilt.any():  # without tilt, the dimensions alone suffice, which is faster
        counts, roi_seen = sensitivity(system, np.zeros((1, 3)))[0], system.roi_radius_seen()
        fwhm = resolution(system, np.zeros((1, 3)), optics=optics)[0]
    return np.stack([1e6 * counts, fwhm, magnification, roi_seen], axis=1)


def write_totals(scanner: bpy.types.PropertyGroup, modules: Sequence[bpy.types.PropertyGroup]) -> None:
    """Write the readouts of all modules together."""
    scanner.sensitivity = sum(module.sensitivity for module in modules)
    scanner.resolution = sum(module.resolution for module in modules) / max(1, len(modules))
    scanner.n_covering = sum(module.sees_roi for module in modules)


def find_problems(scanner: bpy.types.PropertyGroup, system: PinholeSystem) -> tuple[Finding, ...]:
    """Return the findings of a check for overlaps, blocked holes and ROIs that are not seen whole."""
    return checks.check_geometry(system, **asdict(_construction(*construction_values(scanner)))).findings
