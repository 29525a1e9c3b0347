"""A module's numbers on its camera object, exact and as the user has changed them.

Blender keeps places and properties as float32. `Object.mphdrr_module.exact` has the float64 numbers beside them,
which count as long as the visible ones are their roundings.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.system import PinholeSystem
from . import cameras

LENGTHS = ("pinhole_diameter", "collimator_length", "detector_side", "detector_thickness", "roi_radius")
_TURNED = 1e-4  # rad: rotations kept as float32 angles agree to better than 1e-6


def write_module(camera: bpy.types.Object, system: PinholeSystem, m: int, ring: int) -> None:
    """Make an object the camera of module `m`."""
    module = camera.mphdrr_module
    values = {name: float(getattr(system, name)[m]) for name in LENGTHS}
    for name, value in values.items():  # before is_module, which lets an edit rebuild the module
        setattr(module, name, value)
    module.number, module.index, module.ring = int(np.asarray(system.numbers)[m]), m, ring
    module.exact = json.dumps({"number": module.number, "center": system.centers[m].tolist(), **values})
    module.pinhole_distance = float(system.pinhole_distance[m])
    module.part, module.is_module = "CAMERA", True


def exact_values(camera: bpy.types.Object) -> dict[str, Any]:
    """What was imported, in float64: "number", "center" and the `LENGTHS`; empty on other objects."""
    return json.loads(camera.mphdrr_module.exact or "{}")


def length(camera: bpy.types.Object, name: str) -> float:
    """A length of a module: the float64 one as long as the visible float32 is its rounding."""
    visible = getattr(camera.mphdrr_module, name)
    exact = exact_values(camera).get(name)
    return exact if exact is not None and float(np.float32(exact)) == visible else visible


def pinhole_center(camera: bpy.types.Object) -> NDArray[np.float64]:
    """Pinhole centre (3,), mm: the float64 one as long as the camera stands there."""
    place = cameras.world_matrix(camera)[:3, 3]
    exact = exact_values(camera).get("center")
    if exact is None:
        return place
    rounding = 4 * float(np.spacing(np.float32(np.abs(exact).max())))
    return np.array(exact) if np.abs(place - exact).max() <= rounding else place


def is_moved(camera: bpy.types.Object) -> bool:
    """Whether the pinhole is elsewhere than it was imported."""
    return pinhole_center(camera).tolist() != exact_values(camera).get("center")


def is_turned(camera: bpy.types.Object) -> bool:
    """Whether the camera does not look at the isocentre, or is rolled."""
    return bool(off_aim([camera]))


def is_edited(camera: bpy.types.Object) -> bool:
    """Whether the module has another number, or other lengths, than were imported."""
    exact = exact_values(camera)
    return camera.mphdrr_module.number != exact.get("number") or any(
        length(camera, name) != exact.get(name) for name in LENGTHS
    )


def off_aim(cameras_: Iterable[bpy.types.Object]) -> list[int]:
    """Numbers of the modules whose cameras do not look at the isocentre, or are rolled."""
    off = []
    for camera in cameras_:
        matrix = cameras.world_matrix(camera)
        rotation = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)
        aimed = cameras.camera_matrices(matrix[None, :3, 3])[0, :3, :3]
        if np.abs(rotation - aimed).max() > _TURNED:
            off.append(camera.mphdrr_module.number)
    return off
