"""Values of modules, stored on their camera objects and read in float64.

Blender keeps positions and properties as float32. `Object.mphdrr_module.exact` has the float64 numbers beside them; each is
valid as long as the visible number is its rounding. A number that the user has typed is read as the decimal typed.
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
from ..blender import objects
from . import cameras, columns

FROM_ROI, TYPED = "FROM_ROI", "TYPED"  # values of `mphdrr_module.length_mode`
_AIM_ERROR = 1e-4  # largest difference of a rotation matrix's elements for an aimed module, about rad
_ROUNDING = 4e-6  # of a rotation matrix's elements: rotations kept as float32 angles agree to better than 1e-6

T = TypeVar("T")
R = TypeVar("R")
ScannerType = type[Scanner]
Cameras = Sequence[bpy.types.Object]
"""Camera objects of modules."""
_Rows = dict[str, list[Any]]
"""Values of modules by the scanner's attribute, one list entry for each module."""


class Placement(NamedTuple):
    """Positions and directions of modules."""

    poses: NDArray[np.float64]  # poses (M, 4, 4) with proper rotations; as imported where not moved
    moved: NDArray[np.bool_]  # mask (M,) of the modules moved or turned since the import
    aims: NDArray[np.float64]  # isocentre-aimed poses (M, 4, 4) at the same positions (`_aimed_poses`)
    aimed: NDArray[np.bool_]  # mask (M,) of the modules that are aimed already, up to rounding


def kind_of(collection: bpy.types.Collection) -> ScannerType:
    """Return the class of a scanner in the scene."""
    return scanner_kind(collection.mphdrr_scanner.kind)


def formula_columns(kind: ScannerType) -> list[Column]:
    """Return the columns of a kind that a formula fills where nobody types them: the collimator's length."""
    return [column for column in kind.columns.scalars.values() if callable(column.blank)]


def write_modules(cameras_: Cameras, system: Scanner) -> None:
    """Make objects the cameras of a system's modules; `l` follows the ROI where it is equal to the design formula's."""
    rows, rings = _rows(system), system.rings().tolist()
    is_default = [column.is_default(system) for column in formula_columns(type(system))]
    for m, camera in enumerate(cameras_):
        module = camera.mphdrr_module
        for name, column in system.columns.scalars.items():  # before `is_module`: then edits rebuild the module
            setattr(module, name, columns.property_value(column, rows[name][m]))
        module.length_mode = FROM_ROI if is_default and all(defaults[m] for defaults in is_default) else TYPED
        module.ring = rings[m]
        module.part, module.is_module = "CAMERA", True
    store_exact_values(cameras_, system)


def store_exact_values(cameras_: Cameras, system: Scanner) -> None:
    """Store the float64 values of `system` in its modules' cameras, as those of the last import or save."""
    rows, poses = _rows(system), system.poses().tolist()
    for m, camera in enumerate(cameras_):
        module = camera.mphdrr_module
        module.number, module.index, module.added = rows["numbers"][m], m, False
        values = {name: row[m] for name, row in rows.items()}
        module.exact = json.dumps({**values, "pose": poses[m], "mode": module.length_mode})


def _rows(system: Scanner) -> _Rows:
    """Return the values of all columns of a system, by attribute."""
    return {name: getattr(system, name).tolist() for name in ("numbers", *system.columns.fields)}


def exact_values(camera: bpy.types.Object) -> dict[str, Any]:
    """Return a module's float64 values at its last import or save: attributes, "pose", "mode"; empty for other objects."""
    return _parse_exact(camera.mphdrr_module.exact)


@lru_cache(maxsize=4096)
def _parse_exact(text: str) -> dict[str, Any]:
    """Return the values of an `exact` text, in today's form."""
    values: dict[str, Any] = json.loads(text or "{}")
    if "center" in values:  # written by a version without tilts
        center = values.pop("center")
        values |= {"centers": center, "tilt": [0.0] * 3, "pose": module_poses([center])[0].tolist()}
        values["numbers"] = values.pop("number")
    return values


@lru_cache(maxsize=8)
def as_imported(kind: ScannerType, exact: tuple[str, ...]) -> Scanner:
    """Return modules as they were imported, from their `exact` texts; without their numbers, which copies share."""
    values = [_parse_exact(text) for text in exact]
    names = [name for name in kind.columns.fields if all(name in entry for entry in values)]
    return kind.of({name: [entry[name] for entry in values] for name in names})


def with_formula_values(camera: bpy.types.Object, module: Scanner) -> Scanner:
    """Return a module with its formula values calculated from its numbers, if the camera's length follows the formula."""
    if camera.mphdrr_module.length_mode != FROM_ROI:
        return module
    inputs = module.columns.needed_values(module)
    return module.replace(**{column.field: column.default(inputs) for column in formula_columns(type(module))})


def read_modules(
    kind: ScannerType, cameras_: Cameras, matrices: NDArray[np.float64], source: SystemSource | None = None
) -> Scanner:
    """Return modules as they stand now; `matrices` (M, 4, 4) are the cameras' world matrices.

    Unchanged values are as imported. A turned camera yields a tilted module, an aimed one a module without tilt. An `l`
    that follows the ROI is calculated in float64 once a number in its formula has changed. `InputError` for impossible
    values.
    """
    return _read_at(kind, cameras_, read_placement(kind, cameras_, matrices), source)


def read_placement(kind: ScannerType, cameras_: Cameras, matrices: NDArray[np.float64]) -> Placement:
    """Return the positions and directions of modules whose cameras have these world matrices (M, 4, 4)."""
    poses, moved, turned = _current_poses(cameras_, matrices, [exact_values(camera) for camera in cameras_])
    u, _, vt = np.linalg.svd(poses[turned, :3, :3])
    poses[turned, :3, :3] = u @ vt
    return Placement(poses, moved, *_aimed_poses(kind, poses))


def _read_at(kind: ScannerType, cameras_: Cameras, placement: Placement, source: SystemSource | None = None) -> Scanner:
    """Return the modules of cameras at a placement."""
    exact = [exact_values(camera) for camera in cameras_]
    rows = _property_rows(kind, cameras_, exact)
    if placement.moved.any():
        poses = np.where(placement.aimed[:, None, None], placement.aims, placement.poses)  # free of rounding
        _write_pose_attributes(kind, rows, cameras_, poses, np.flatnonzero(placement.moved).tolist())
    _write_formula_values(kind, rows, cameras_, exact)
    return kind.of({name: np.array(row) for name, row in rows.items()} | {"source": source})


def make_groups(items: list[T], make: Callable[[list[T]], R]) -> Iterator[tuple[list[T], R | InputError]]:
    """Yield all items with what `make` returns for them or, where it refuses, each item with its result or error."""
    try:
        yield items, make(items)
    except InputError as error:
        if len(items) == 1:
            yield items, error
            return
        for item in items:
            yield from make_groups([item], make)


def read_in_groups(
    kind: ScannerType, cameras_: Cameras, placement: Placement
) -> Iterator[tuple[list[int], Scanner | InputError]]:
    """Yield groups of module indices with the modules read at their placement, or the error that refuses a module."""

    def read(indices: list[int]) -> Scanner:
        """Return the scanner of the modules with these indices."""
        return _read_at(kind, [cameras_[m] for m in indices], Placement(*map(itemgetter(indices), placement)))

    return make_groups(list(range(len(cameras_))), read)


def _property_rows(kind: ScannerType, cameras_: Cameras, exact: Sequence[dict[str, Any]]) -> _Rows:
    """Return the values in the modules' properties, at their positions as imported."""
    modules = [camera.mphdrr_module for camera in cameras_]
    rows: _Rows = {"numbers": [module.number for module in modules]}
    for name, (column, *_) in kind.columns.fields.items():
        if column.axis is None:
            rows[name] = [
                columns.column_value(column, getattr(module, name), values.get(name))
                for module, values in zip(modules, exact, strict=True)
            ]
        else:
            rows[name] = [values.get(name, [0.0] * 3) for values in exact]
    return rows


def _current_poses(
    cameras_: Cameras, matrices: NDArray[np.float64], exact: Sequence[dict[str, Any]]
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the modules' present poses (M, 4, 4), a mask (M,) of moved or turned modules, and one of turned modules.

    Unmoved modules have their poses as imported.
    """
    imported = np.reshape([values["pose"] for values in exact], (-1, 4, 4))
    signs = np.reshape([objects.mirror_signs(camera) for camera in cameras_], (-1, 1, 4))
    current = cameras.module_poses(matrices * signs)
    position, imported_position = current[:, :3, 3], imported[:, :3, 3]
    rounding = 4 * np.spacing(np.abs(imported_position).max(axis=1).astype(np.float32))
    is_unmoved = np.abs(position - imported_position) <= rounding[:, None]
    is_turned = np.abs(current[:, :3, :3] - imported[:, :3, :3]).max(axis=(1, 2)) > _ROUNDING
    position[is_unmoved] = imported_position[is_unmoved]
    current[~is_turned, :3, :3] = imported[~is_turned, :3, :3]
    return current, is_turned | ~is_unmoved.all(axis=1), is_turned


def _aimed_poses(kind: ScannerType, poses: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the isocentre-aimed poses (M, 4, 4) at the positions of `poses`, and a mask (M,) of modules already aimed.

    A rolled module is not aimed. Kinds without aiming, and modules at the isocentre or nowhere (NaN), are taken as aimed.
    """
    aims, aimed = poses.copy(), np.ones(len(poses), bool)
    is_away = np.any(poses[:, :3, 3], axis=1) & np.isfinite(poses).all(axis=(1, 2))
    if (away_aims := kind.aimed(poses[is_away, :3, 3])) is not None:
        aims[is_away], aimed[is_away] = away_aims, np.abs(poses[is_away] - away_aims).max(axis=(1, 2)) <= _AIM_ERROR
    return aims, aimed


def _write_pose_attributes(
    kind: ScannerType, rows: _Rows, cameras_: Cameras, poses: NDArray[np.float64], indices: list[int]
) -> None:
    """Write the attributes of modules at their poses into `rows`, one by one where that is not possible together."""

    def read_attributes(indices: list[int]) -> Mapping[str, NDArray[Any]]:
        """Return the attributes of poses of the modules with these indices, by name."""
        return as_imported(kind, tuple(cameras_[m].mphdrr_module.exact for m in indices)).attributes_at(poses[indices])

    for group, attributes in make_groups(indices, read_attributes):
        if isinstance(attributes, InputError):
            raise attributes
        for name, values in attributes.items():
            for m, value in zip(group, values.tolist(), strict=True):
                rows[name][m] = value


def _write_formula_values(kind: ScannerType, rows: _Rows, cameras_: Cameras, exact: Sequence[dict[str, Any]]) -> None:
    """Write the values that follow from a formula into `rows`, as imported where the numbers in it have not changed."""
    inputs = {kind.columns[name].field for name in kind.columns.needed}
    stale = []
    for m, (camera, values) in enumerate(zip(cameras_, exact, strict=True)):
        if camera.mphdrr_module.length_mode != FROM_ROI:
            continue
        if values.get("mode") == FROM_ROI and all(rows[name][m] == values[name] for name in inputs):
            for column in formula_columns(kind):
                rows[column.field][m] = values[column.field]
        else:
            stale.append(m)
    arguments = SimpleNamespace(**{name: np.array([rows[name][m] for m in stale]) for name in inputs})
    for column in formula_columns(kind) if stale else ():
        with suppress(InputError):  # constructing the system refuses the same values
            for m, value in zip(stale, column.default(kind.columns.needed_values(arguments)).tolist(), strict=True):
                rows[column.field][m] = value


def changed_modules(cameras_: Cameras) -> tuple[list[bool], list[bool]]:
    """Return for each module whether it was moved or turned since the import, and whether its number or values changed."""
    if not cameras_:
        return [], []
    exact = [exact_values(camera) for camera in cameras_]
    _, moved, _ = _current_poses(cameras_, objects.world_matrices(cameras_), exact)
    columns_ = {"numbers": None} | columns.all_columns()
    is_edited = [
        any(
            columns.column_value(column, getattr(camera.mphdrr_module, name), values[name]) != values[name]
            if column else camera.mphdrr_module.number != values[name]
            for name, column in columns_.items() if name in values
        )
        for camera, values in zip(cameras_, exact, strict=True)
    ]  # fmt: skip
    return moved.tolist(), is_edited


def unaimed_numbers(collection: bpy.types.Collection, cameras_: Iterable[bpy.types.Object]) -> list[int]:
    """Return the numbers of a scanner's modules whose cameras do not look at the isocentre, or are rolled."""
    camera_list = list(cameras_)
    aimed = read_placement(kind_of(collection), camera_list, objects.world_matrices(camera_list)).aimed
    return [camera.mphdrr_module.number for camera, is_aimed in zip(camera_list, aimed, strict=True) if not is_aimed]
