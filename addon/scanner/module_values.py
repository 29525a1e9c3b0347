"""A module's numbers on its camera object, in float64.

Blender keeps places and properties as float32. `Object.mphdrr_module.exact` has the float64 numbers beside them; each is
valid as long as the visible one is its rounding. A number that the user has typed is read as the decimal typed.
"""

import json
from collections import namedtuple
from collections.abc import Iterable, Sequence
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError
from ...core.geometry.design_formulas import collimator_length
from ...core.geometry.system import LENGTHS, PinholeSystem
from ..blender import objects
from ..blender.decimals import typed
from . import cameras

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


def system_of(modules: Sequence[ModuleNumbers], source: Any = None) -> PinholeSystem:
    """A system of these modules; raises `InputError` where their numbers are impossible."""
    lengths: Any = {name: np.array([getattr(numbers, name) for numbers in modules]) for name in LENGTHS}
    centers, own = np.array([numbers.center for numbers in modules]), np.array([numbers.number for numbers in modules])
    return PinholeSystem(centers, **lengths, numbers=own, source=source)


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
        (numbers,) = _with_lengths([numbers])
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
    return numbers_of([camera], objects.world_matrix(camera)[None])[0]


def numbers_of(cameras_: Sequence[bpy.types.Object], matrices: NDArray[np.float64]) -> list[ModuleNumbers]:
    """`module_numbers` of each module; `matrices` (M, 4, 4) are the cameras' world matrices."""
    found: list[ModuleNumbers] = []
    designed = []
    for camera, place in zip(cameras_, matrices[:, :3, 3].tolist(), strict=True):
        module, exact = camera.mphdrr_module, exact_values(camera)
        values = {name: getattr(module, name) for name in LENGTHS}
        for name, value in values.items():
            known = exact.get(name)
            values[name] = known if known is not None and np.float32(known) == value else typed(value)
        numbers = ModuleNumbers(module.number, _center(camera, place, exact.get("center")), **values)
        if module.length_mode == FROM_ROI:
            now = [FROM_ROI, numbers.center.tolist(), *(values[name] for name in _DESIGNED_FROM)]
            if now == [exact.get(name) for name in ("mode", "center", *_DESIGNED_FROM)]:
                numbers = numbers._replace(collimator_length=exact["collimator_length"])
            else:
                designed.append(len(found))
        found.append(numbers)
    for i, numbers in zip(designed, _with_lengths([found[i] for i in designed]), strict=True):
        found[i] = numbers
    return found


def _with_lengths(modules: Sequence[ModuleNumbers]) -> list[ModuleNumbers]:
    """The modules with the design formula's `l`."""
    given = [[numbers.pinhole_distance for numbers in modules]]
    given += [[getattr(numbers, name) for numbers in modules] for name in _DESIGNED_FROM]
    try:
        lengths = collimator_length(*given).tolist()
    except InputError:  # `read_scanner` and the module's `problem` say what is wrong
        return list(modules) if len(modules) == 1 else [_with_lengths([numbers])[0] for numbers in modules]
    return [numbers._replace(collimator_length=l) for numbers, l in zip(modules, lengths, strict=True)]


def _center(camera: bpy.types.Object, place: list[float], exact: list[float] | None) -> NDArray[np.float64]:
    """Pinhole centre (3,), mm: the coordinates of `exact` as long as they are those of the camera's `place`."""
    is_free = camera.parent is None and not len(camera.constraints)
    if exact is None:
        return np.array([typed(x) if is_free else x for x in place])
    rounding = 4 * float(np.spacing(np.float32(max(map(abs, exact)))))
    now = []
    for x, known in zip(place, exact, strict=True):
        x = typed(x) if is_free else x
        now.append(known if abs(x - known) <= rounding else x)
    return np.array(now)


def is_moved(camera: bpy.types.Object) -> bool:
    """Whether the pinhole is not where it was imported."""
    center = exact_values(camera).get("center")
    return _center(camera, objects.world_matrix(camera)[:3, 3].tolist(), center).tolist() != center


def is_edited(camera: bpy.types.Object) -> bool:
    """Whether the module's number, or one of its lengths, is not as it was imported."""
    exact, numbers = exact_values(camera), module_numbers(camera)
    return any(getattr(numbers, name) != exact.get(name) for name in ("number", *LENGTHS))


def off_aim(cameras_: Iterable[bpy.types.Object]) -> list[int]:
    """Numbers of the modules whose cameras do not look at the isocentre, or are rolled."""
    found = list(cameras_)
    aimed = are_aimed(objects.world_matrices(found))
    return [camera.mphdrr_module.number for camera, is_aimed in zip(found, aimed, strict=True) if not is_aimed]


def are_aimed(matrices: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether cameras of these world matrices (M, 4, 4) look at the isocentre, upright: (M,)."""
    aimed = np.any(matrices[:, :3, 3], axis=1)  # at the isocentre there is no direction to it
    rotation = matrices[aimed, :3, :3]
    rotation /= np.linalg.norm(rotation, axis=1, keepdims=True)
    error = np.abs(rotation - cameras.camera_matrices(matrices[aimed, :3, 3])[:, :3, :3])
    aimed[aimed] = error.max(axis=(1, 2)) <= _TURNED
    return aimed
