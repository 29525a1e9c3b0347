"""What of a scanner in the scene only pinholes have: collimators' construction, the ROI sphere, readouts, checks."""

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
from . import collimators, module_values

_READOUTS = ("sensitivity", "resolution", "magnification", "roi_seen")
# Both take long to be checked, and are asked for whenever a module moves.
_construction = lru_cache(maxsize=8)(Construction)
_optics = lru_cache(maxsize=8)(lambda intrinsic_fwhm: Optics(intrinsic_fwhm=intrinsic_fwhm))


def has_pinholes(kind: module_values.Kind) -> bool:
    """Whether scanners of a kind have pinholes."""
    return issubclass(kind, PinholeSystem)


def construction_values(scanner: bpy.types.PropertyGroup) -> tuple[float, float, float, EdgePlace]:
    """The arguments of `Construction`, which may refuse them."""
    lengths = typed(scanner.plate_thickness), typed(scanner.wall_thickness)
    return *lengths, typed(scanner.opening_angle), scanner.edge_at.lower()


def settings(scanner: bpy.types.PropertyGroup) -> tuple[float | str, ...]:
    """The settings of all modules that their readouts and shapes follow."""
    return *construction_values(scanner), typed(scanner.intrinsic_fwhm)


def construction(scanner: bpy.types.PropertyGroup, kind: module_values.Kind = PinholeSystem) -> Construction | None:
    """How the scanner's collimators are built, None for a kind without; raises `InputError` where they cannot be."""
    return _construction(*construction_values(scanner)) if has_pinholes(kind) else None


def new_roi(system: Scanner, material: bpy.types.Material) -> bpy.types.Object | None:
    """The ROI's sphere, of a system that has one."""
    if not isinstance(system, PinholeSystem):
        return None
    roi = bpy.data.objects.new("ROI", collimators.new_sphere("ROI", system.region_radius(), material))
    roi.mphdrr_module.part = "ROI"
    roi.hide_select = True
    # Circles: the solid viewport draws no volume behind or inside a transparent surface. Renders show the sphere.
    roi.display_type, roi.display_bounds_type = "BOUNDS", "SPHERE"
    roi.lock_location = roi.lock_rotation = roi.lock_scale = (True, True, True)
    roi.visible_shadow = False
    return roi


def resize_roi(collection: bpy.types.Collection, modules: Sequence[bpy.types.Object]) -> None:
    """Make the ROI's sphere, if there is one, as large as the modules' largest."""
    for item in collection.objects:
        if item.mphdrr_module.part == "ROI":
            radius = max((camera.mphdrr_module.roi_radius for camera in modules), default=0.0)
            if radius > 0:
                collimators.resize_sphere(item.data, radius)


def write_readouts(
    found: Scanner | InputError,
    modules: Sequence[bpy.types.PropertyGroup],
    which: Sequence[int],
    scanner: bpy.types.PropertyGroup,
) -> None:
    """Write the readouts of the modules `which` of a system, 0 where there is none."""
    values = np.zeros((len(modules), len(_READOUTS)))
    if isinstance(found, PinholeSystem):
        values = _readouts(found, _optics(typed(scanner.intrinsic_fwhm)))[which]
    for module, row in zip(modules, values.tolist(), strict=True):
        for name, value in zip(_READOUTS, row, strict=True):
            setattr(module, name, value)


def _readouts(system: PinholeSystem, optics: Optics) -> NDArray[np.float64]:
    """The `_READOUTS` of the modules at the isocentre, (M, 4)."""
    at = isocentre_performance(
        system.pinhole_distance, system.pinhole_diameter, system.collimator_length, system.detector_side,
        system.detector_thickness, optics=optics,
    )  # fmt: skip
    counts, fwhm, magnification, seen = at
    if system.tilt.any():  # else the dimensions alone say it, which is faster
        counts, seen = sensitivity(system, np.zeros((1, 3)))[0], system.roi_radius_seen()
        fwhm = resolution(system, np.zeros((1, 3)), optics=optics)[0]
    return np.stack([1e6 * counts, fwhm, magnification, seen], axis=1)


def write_totals(scanner: bpy.types.PropertyGroup, modules: Sequence[bpy.types.PropertyGroup]) -> None:
    """Write the readouts of all modules together."""
    scanner.sensitivity = sum(module.sensitivity for module in modules)
    scanner.resolution = sum(module.resolution for module in modules) / max(1, len(modules))
    scanner.n_covering = sum(module.sees_roi for module in modules)


def check(scanner: bpy.types.PropertyGroup, system: PinholeSystem) -> tuple[Finding, ...]:
    """What a check for overlaps, blocked holes and ROIs that are not seen finds."""
    return checks.check_geometry(system, **asdict(_construction(*construction_values(scanner)))).findings
