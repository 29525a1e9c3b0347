"""A module's numbers on its camera object, in float64.

Blender keeps places and properties as float32. `Object.mphdrr_module.exact` has the float64 numbers beside them; each is
valid as long as the visible one is its rounding. A number that the user has typed is read as the decimal typed.
"""

import json
from collections import namedtuple
from collections.abc import Iterable
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.geometry.design_formulas import collimator_length
from ..core.geometry.system import LENGTHS, PinholeSystem
from . import cameras
from .decimals import typed

FROM_ROI, TYPED = "FROM_ROI", "TYPED"  # `mphdrr_module.length_mode`
_DESIGNED_FROM = ("pinhole_diameter", "detector_side", "roi_radius")  # with b, what the design formula takes
_TURNED = 1e-4  # rad: rotations kept as float32 angles agree to better than 1e-6
_FORMULA = 1e-9  # of l: an imported l this close to the design formula's was calculated with it


_made_of: Any = namedtuple  # Any: mypy knows only fields that are written out
_Fields: Any = _made_of("_Fields", ("number", "center", *LENGTHS))


class ModuleNumbers(_Fields):
    """A module's number, its pinhole's place (3,) in the world and its dimensions, in float64 and mm."""

    @property
    def pinhole_distance(self) -> float:
        """b: pinhole centre to isocentre."""
        return float(np.linalg.norm(self.center))

    def system(self) -> PinholeSystem:
        """A system of this module alone; raises `InputError` where the numbers are impossible."""
        lengths = {name: np.array([getattr(self, name)]) for name in LENGTHS}
        return PinholeSystem(self.center[None], **lengths, numbers=np.array([self.number]), source=None)


def write_module(camera: bpy.types.Object, system: PinholeSystem, m: int, ring: int) -> None:
    """Make an object the camera of module `m`; `l` follows the ROI where the design formula gives it."""
    module = camera.mphdrr_module
    values = {name: float(getattr(system, name)[m]) for name in LENGTHS}
    for name, value in values.items():  # before is_module, which lets an edit rebuild the module
        setattr(module, name, value)
    d, side, roi = (values[name] for name in _DESIGNED_FROM)
    error = abs(float(collimator_length(float(system.pinhole_distance[m]), d, side, roi)) - values["collimator_length"])
    module.length_mode = FROM_ROI if error <= _FORMULA * values["collimator_length"] else TYPED
    module.ring = ring
    remember(camera, system, m)
    module.part, module.is_module = "CAMERA", True


def remember(camera: bpy.types.Object, system: PinholeSystem, m: int) -> None:
    """Store module `m` of `system` as what the camera's module was when it was imported or saved."""
    module = camera.mphdrr_module
    module.number, module.index, module.added = int(np.asarray(system.numbers)[m]), m, False
    _write_exact(
        camera, ModuleNumbers(module.number, system.centers[m], *(float(getattr(system, name)[m]) for name in LENGTHS))
    )


def add_module(camera: bpy.types.Object, number: int, index: int, center: NDArray[np.float64] | None = None) -> None:
    """Make the copy of a module's camera a module of its own, at `center` (3,), mm, by default where it stands."""
    module, numbers = camera.mphdrr_module, module_numbers(camera)
    numbers = numbers._replace(number=number, center=numbers.center if center is None else center)
    if module.length_mode == FROM_ROI:
        numbers = _with_length(numbers)
    module.number, module.index, module.added = number, index, True
    _write_exact(camera, numbers)


def _write_exact(camera: bpy.types.Object, numbers: ModuleNumbers) -> None:
    values = {**numbers._asdict(), "center": numbers.center.tolist(), "mode": camera.mphdrr_module.length_mode}
    camera.mphdrr_module.exact = json.dumps(values)


def exact_values(camera: bpy.types.Object) -> dict[str, Any]:
    """The numbers as imported, in float64: the fields of `ModuleNumbers` and "mode"; empty on other objects."""
    return json.loads(camera.mphdrr_module.exact or "{}")


def module_numbers(camera: bpy.types.Object) -> ModuleNumbers:
    """The module as it stands now.

    Numbers that have not changed are as imported. An `l` that follows the ROI is calculated in float64 once a number in
    its formula has changed; where the formula has no solution (a pinhole inside the ROI) `l` keeps its last value.
    """
    module, exact = camera.mphdrr_module, exact_values(camera)
    center = _center(camera, exact.get("center"))
    values = {name: typed(getattr(module, name)) for name in LENGTHS}
    values |= {
        name: exact[name] for name in LENGTHS if name in exact and np.float32(exact[name]) == getattr(module, name)
    }
    numbers = ModuleNumbers(module.number, center, **values)
    if module.length_mode != FROM_ROI:
        return numbers
    now = [FROM_ROI, center.tolist(), *(values[name] for name in _DESIGNED_FROM)]
    if now == [exact.get(name) for name in ("mode", "center", *_DESIGNED_FROM)]:
        return numbers._replace(collimator_length=exact["collimator_length"])
    return _with_length(numbers)


def _with_length(numbers: ModuleNumbers) -> ModuleNumbers:
    given = [getattr(numbers, name) for name in _DESIGNED_FROM]
    try:
        return numbers._replace(collimator_length=float(collimator_length(numbers.pinhole_distance, *given)))
    except InputError:
        return numbers  # `read_scanner` and the module's `problem` say what is wrong


def _center(camera: bpy.types.Object, exact: list[float] | None) -> NDArray[np.float64]:
    """Pinhole centre (3,), mm: the coordinates of `exact` as long as they are those of the camera."""
    place = cameras.world_matrix(camera)[:3, 3]
    if camera.parent is None and not len(camera.constraints):
        place = np.array([typed(x) for x in place])
    if exact is None:
        return place
    rounding = 4 * float(np.spacing(np.float32(np.abs(exact).max())))
    return np.where(np.abs(place - exact) <= rounding, exact, place)


def is_moved(camera: bpy.types.Object) -> bool:
    """Whether the pinhole is not where it was imported."""
    center = exact_values(camera).get("center")
    return _center(camera, center).tolist() != center


def is_edited(camera: bpy.types.Object) -> bool:
    """Whether the module's number, or one of its lengths, is not as it was imported."""
    exact, numbers = exact_values(camera), module_numbers(camera)
    return any(getattr(numbers, name) != exact.get(name) for name in ("number", *LENGTHS))


def off_aim(cameras_: Iterable[bpy.types.Object]) -> list[int]:
    """Numbers of the modules whose cameras do not look at the isocentre, or are rolled."""
    return [camera.mphdrr_module.number for camera in cameras_ if not _is_aimed(cameras.world_matrix(camera))]


def _is_aimed(matrix: NDArray[np.float64]) -> bool:
    if not np.any(matrix[:3, 3]):
        return False  # at the isocentre there is no direction to it
    rotation = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)
    aimed = cameras.camera_matrices(matrix[None, :3, 3])[0, :3, :3]
    return bool(np.abs(rotation - aimed).max() <= _TURNED)
