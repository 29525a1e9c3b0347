"""A module's values on its camera object, numbers in float64.

Blender keeps places and properties as float32. `Object.mphdrr_module.exact` has the float64 numbers beside them; each is
valid as long as the visible one is its rounding. A number that the user has typed is read as the decimal typed.
"""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from operator import itemgetter
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeVar

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core import InputError, SystemSource
from ...core.geometry.columns import Column
from ...core.geometry.frames import module_poses
from ...core.geometry.scanner import Scanner
from ...core.scanner_kinds import scanner_kind
from ..blender import decimals, objects
from . import cameras, columns

FROM_ROI, TYPED = "FROM_ROI", "TYPED"  # `mphdrr_module.length_mode`
_AIMED = 1e-4  # of a rotation's matrix, about rad
_ROUNDING = 4e-6  # of a rotation's matrix: rotations kept as float32 angles agree to better than 1e-6

Item = TypeVar("Item")
Made = TypeVar("Made")
Kind = type[Scanner]
_Rows = dict[str, list[Any]]
"""Attribute of a scanner -> its values, module by module."""


class Placed(NamedTuple):
    """Where modules stand."""

    poses: NDArray[np.float64]  # (M, 4, 4), as imported where they have not moved; rotations are proper ones
    moved: NDArray[np.bool_]  # (M,): moved or turned since
    aims: NDArray[np.float64]  # (M, 4, 4): the poses that look at the isocentre from there (`_aims`)
    aimed: NDArray[np.bool_]  # (M,): which do so, up to rounding


def kind_of(collection: bpy.types.Collection) -> Kind:
    """The class of a scanner in the scene."""
    return scanner_kind(collection.mphdrr_scanner.kind)


def designed(kind: Kind) -> list[Column]:
    """The columns of a kind that follow from the others, if nobody types them: the collimator's length."""
    return [column for column in kind.columns.scalars.values() if callable(column.blank)]


def write_modules(cameras_: Sequence[bpy.types.Object], system: Scanner) -> None:
    """Make objects the cameras of a system's modules; `l` follows the ROI where the design formula gives it."""
    rows, rings = _rows(system), system.rings().tolist()
    follow = [column.is_default(system) for column in designed(type(system))]
    for m, camera in enumerate(cameras_):
        module = camera.mphdrr_module
        for name, column in system.columns.scalars.items():  # before is_module, which lets an edit rebuild the module
            setattr(module, name, columns.shown(column, rows[name][m]))
        module.length_mode = FROM_ROI if follow and all(defaults[m] for defaults in follow) else TYPED
        module.ring = rings[m]
        module.part, module.is_module = "CAMERA", True
    remember(cameras_, system)


def remember(cameras_: Sequence[bpy.types.Object], system: Scanner) -> None:
    """Store the modules of `system` as what those of the cameras were when they were imported or saved."""
    rows, poses = _rows(system), system.poses().tolist()
    for m, camera in enumerate(cameras_):
        module = camera.mphdrr_module
        module.number, module.index, module.added = rows["numbers"][m], m, False
        values = {name: row[m] for name, row in rows.items()}
        module.exact = json.dumps({**values, "pose": poses[m], "mode": module.length_mode})


def _rows(system: Scanner) -> _Rows:
    return {name: getattr(system, name).tolist() for name in ("numbers", *system.columns.fields)}


def exact_values(camera: bpy.types.Object) -> dict[str, Any]:
    """The module as imported, in float64: its attributes, its "pose" and "mode"; empty on other objects."""
    return _parsed(camera.mphdrr_module.exact)


@lru_cache(maxsize=4096)
def _parsed(text: str) -> dict[str, Any]:
    values: dict[str, Any] = json.loads(text or "{}")
    if "center" in values:  # by versions that knew no tilt
        center = values.pop("center")
        values |= {"centers": center, "tilt": [0.0] * 3, "pose": module_poses([center])[0].tolist()}
        values["numbers"] = values.pop("number")
    return values


@lru_cache(maxsize=8)
def imported(kind: Kind, exact: tuple[str, ...]) -> Scanner:
    """Modules as they were imported, by their `exact` texts, without their numbers, which copies share."""
    known = [_parsed(text) for text in exact]
    names = [name for name in kind.columns.fields if all(name in values for values in known)]
    return kind.of({name: [values[name] for values in known] for name in names})


def with_design(camera: bpy.types.Object, module: Scanner) -> Scanner:
    """A copy of a camera's module with the values by formula that follow its own, if the camera's do."""
    if camera.mphdrr_module.length_mode != FROM_ROI:
        return module
    needed = module.columns.needed_values(module)
    return module.replace(**{column.field: column.default(needed) for column in designed(type(module))})


def read_modules(
    kind: Kind, cameras_: Sequence[bpy.types.Object], matrices: NDArray[np.float64], source: SystemSource | None = None
) -> Scanner:
    """Modules as they stand now; `matrices` (M, 4, 4) are the cameras' world matrices. Raises `InputError` if impossible.

    What has not changed is as imported. A camera that is turned has a tilted module, and none if it is aimed. An `l` that
    follows the ROI is calculated in float64 once a number in its formula has changed.
    """
    return _read(kind, cameras_, placed(kind, cameras_, matrices), source)


def placed(kind: Kind, cameras_: Sequence[bpy.types.Object], matrices: NDArray[np.float64]) -> Placed:
    """Where modules stand whose cameras have these world matrices (M, 4, 4)."""
    poses, moved, turned = _poses(cameras_, matrices, [exact_values(camera) for camera in cameras_])
    left, _, right = np.linalg.svd(poses[turned, :3, :3])
    poses[turned, :3, :3] = left @ right
    return Placed(poses, moved, *_aims(kind, poses))


def _read(
    kind: Kind, cameras_: Sequence[bpy.types.Object], places: Placed, source: SystemSource | None = None
) -> Scanner:
    known = [exact_values(camera) for camera in cameras_]
    rows = _shown(kind, cameras_, known)
    if places.moved.any():
        poses = np.where(places.aimed[:, None, None], places.aims, places.poses)  # without rounding
        _carry(kind, rows, cameras_, poses, np.flatnonzero(places.moved).tolist())
    _design(kind, rows, cameras_, known)
    return kind.of({name: np.array(row) for name, row in rows.items()} | {"source": source})


def together(which: list[Item], make: Callable[[list[Item]], Made]) -> Iterator[tuple[list[Item], Made | InputError]]:
    """Some things and what is made of them: of all together, but of one by one where that is refused."""
    try:
        yield which, make(which)
    except InputError as error:
        if len(which) == 1:
            yield which, error
            return
        for one in which:
            yield from together([one], make)


def readings(
    kind: Kind, cameras_: Sequence[bpy.types.Object], places: Placed
) -> Iterator[tuple[list[int], Scanner | InputError]]:
    """Indices of modules and what is read of them at their `places`, or why there are none."""

    def read(which: list[int]) -> Scanner:
        return _read(kind, [cameras_[m] for m in which], Placed(*map(itemgetter(which), places)))

    return together(list(range(len(cameras_))), read)


def _shown(kind: Kind, cameras_: Sequence[bpy.types.Object], known: Sequence[dict[str, Any]]) -> _Rows:
    """The modules' values by their properties, at their places as imported."""
    modules = [camera.mphdrr_module for camera in cameras_]
    rows: _Rows = {"numbers": [module.number for module in modules]}
    for name, (column, *_) in kind.columns.fields.items():
        if column.axis is None:
            rows[name] = [
                columns.value_of(column, getattr(module, name), exact.get(name))
                for module, exact in zip(modules, known, strict=True)
            ]
        else:
            rows[name] = [exact.get(name, [0.0] * 3) for exact in known]
    return rows


def _poses(
    cameras_: Sequence[bpy.types.Object], matrices: NDArray[np.float64], known: Sequence[dict[str, Any]]
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
    """The modules' poses (M, 4, 4), as imported where the cameras stand so; which (M,) are moved or turned, and turned."""
    was = np.reshape([exact["pose"] for exact in known], (-1, 4, 4))
    now = cameras.poses_of(matrices)
    place, old = now[:, :3, 3], was[:, :3, 3]
    for m, axis in np.argwhere(place.astype(np.float32) != old.astype(np.float32)).tolist():
        if cameras_[m].parent is None and not len(cameras_[m].constraints):
            place[m, axis] = decimals.typed(place[m, axis])
    rounding = 4 * np.spacing(np.abs(old).max(axis=1).astype(np.float32))
    stays = np.abs(place - old) <= rounding[:, None]
    turned = np.abs(now[:, :3, :3] - was[:, :3, :3]).max(axis=(1, 2)) > _ROUNDING
    place[stays] = old[stays]
    now[~turned, :3, :3] = was[~turned, :3, :3]
    return now, turned | ~stays.all(axis=1), turned


def _aims(kind: Kind, poses: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """The poses (M, 4, 4) that look at the isocentre from the places of `poses` (M, 4, 4), and which of these do so.

    Rolled ones do not. Of a kind that is not aimed, and at the isocentre itself, all are right.
    """
    found, aimed, away = poses.copy(), np.ones(len(poses), bool), np.any(poses[:, :3, 3], axis=1)
    exact = kind.aimed(poses[away, :3, 3])
    if exact is not None:
        found[away], aimed[away] = exact, np.abs(poses[away] - exact).max(axis=(1, 2)) <= _AIMED
    return found, aimed


def _carry(
    kind: Kind, rows: _Rows, cameras_: Sequence[bpy.types.Object], poses: NDArray[np.float64], which: list[int]
) -> None:
    """Write the attributes into `rows` that modules have at their poses; one by one where they cannot be together."""

    def carried(which: list[int]) -> Mapping[str, NDArray[Any]]:
        return imported(kind, tuple(cameras_[m].mphdrr_module.exact for m in which)).attributes_at(poses[which])

    for some, there in together(which, carried):
        if isinstance(there, InputError):
            raise there
        for name, values in there.items():
            for m, value in zip(some, values.tolist(), strict=True):
                rows[name][m] = value


def _design(kind: Kind, rows: _Rows, cameras_: Sequence[bpy.types.Object], known: Sequence[dict[str, Any]]) -> None:
    """Write the values that follow from the others into `rows`, as imported where these have not changed."""
    needed = {kind.columns[name].field for name in kind.columns.needed}
    changed = []
    for m, (camera, exact) in enumerate(zip(cameras_, known, strict=True)):
        if camera.mphdrr_module.length_mode != FROM_ROI:
            continue
        if exact.get("mode") == FROM_ROI and all(rows[name][m] == exact[name] for name in needed):
            for column in designed(kind):
                rows[column.field][m] = exact[column.field]
        else:
            changed.append(m)
    given = SimpleNamespace(**{name: np.array([rows[name][m] for m in changed]) for name in needed})
    for column in designed(kind) if changed else ():
        with suppress(InputError):  # the system itself is refused for the same reason
            for m, value in zip(changed, column.default(kind.columns.needed_values(given)).tolist(), strict=True):
                rows[column.field][m] = value


def changes(found: Sequence[bpy.types.Object]) -> tuple[list[bool], list[bool]]:
    """Which modules were moved or turned since they were imported, and of which the number or other values changed."""
    if not found:
        return [], []
    known = [exact_values(camera) for camera in found]
    _, moved, _ = _poses(found, objects.world_matrices(found), known)
    shown = {"numbers": None} | columns.known_columns()
    edited = [
        any(
            columns.value_of(column, getattr(camera.mphdrr_module, name), exact[name]) != exact[name]
            if column else camera.mphdrr_module.number != exact[name]
            for name, column in shown.items() if name in exact
        )
        for camera, exact in zip(found, known, strict=True)
    ]  # fmt: skip
    return moved.tolist(), edited


def off_aim(collection: bpy.types.Collection, cameras_: Iterable[bpy.types.Object]) -> list[int]:
    """Numbers of a scanner's modules whose cameras do not look at the isocentre, or are rolled."""
    found = list(cameras_)
    aimed = placed(kind_of(collection), found, objects.world_matrices(found)).aimed
    return [camera.mphdrr_module.number for camera, is_aimed in zip(found, aimed, strict=True) if not is_aimed]
