"""A part of a module that is moved takes its module along: a collimator, a crystal or a plane with a projection.

While a tool drags a part, the tool writes the part's own place again and again, as seen from where its camera stood at
first: the part remembers that (`_START`), the camera goes where the part leads it, and the part's parent inverse keeps it
at its place on the camera. Nothing is lost if Blender stores an undo step before a handler has seen the last motion:
the part's place and where the camera started say where the module is.
"""

from collections.abc import Iterable
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..blender import objects
from . import collimators, following

_HOME = "mphdrr_home"  # custom property of a plane: its place on its camera (4, 4)
_START = "mphdrr_start"  # custom property of a part that is dragged: world matrix (4, 4) of its camera when that began
_NEAR = 1e-5  # mm, or of a rotation's matrix: rounding
_AT_HOME = Matrix()


def place(item: bpy.types.Object, matrix: Matrix) -> None:
    """Give a plane its place on its module's camera."""
    item.matrix_basis = matrix
    item[_HOME] = [x for row in matrix for x in row]


def is_part(item: bpy.types.Object) -> bool:
    """Whether a module is moved by it."""
    return item.mphdrr_module.part in collimators.PARTS or _HOME in item


def is_dragging() -> bool:
    """Whether one of Blender's tools is moving something."""
    windows = bpy.context.window_manager.windows
    return any(o.bl_idname.startswith(("TRANSFORM_OT", "OBJECT_OT")) for w in windows for o in w.modal_operators)


def is_dragged(item: bpy.types.Object) -> bool:
    """Whether a part is dragged, or was and is not back."""
    return _START in item


def is_off(item: bpy.types.Object) -> bool:
    """Whether a part is not at its place on its module's camera, and may take the module along."""
    camera = item.parent
    if camera is None or not camera.mphdrr_module.is_module or item.library or camera.library:
        return False
    place = item.matrix_parent_inverse @ item.matrix_basis
    home = _home(item)
    if place == home:  # as nearly all are: numpy takes ten times as long
        return False
    if np.abs(np.array(place) - np.array(home)).max() <= _NEAR:
        return False
    kind = item.mphdrr_module.part
    is_copy = sum(o.mphdrr_module.part == kind for o in camera.children) > 1  # which of them would it be?
    return following.is_free(item) and item.parent_type == "OBJECT" and not is_copy


def carry(items: Iterable[bpy.types.Object], dragging: bool) -> set[bpy.types.Object]:
    """Bring parts that are off back to their places on their cameras; returns the cameras that have moved for it.

    A camera goes where the first of its parts leads it, but not if it moves by itself.
    """
    starts: dict[bpy.types.Object, NDArray[np.float64]] = {}
    for item in filter(is_off, items):
        camera, home = item.parent, _home(item)
        if camera not in starts and (is_dragged(item) or not _moves_itself(camera, dragging)):
            start = np.reshape(item[_START], (4, 4)) if is_dragged(item) else objects.world_matrix(camera)
            motion: Any = np.array(item.matrix_basis, np.float64) @ np.linalg.inv(home)
            motion[:3, :3] /= np.linalg.norm(motion[:3, :3], axis=0)
            _move(camera, start @ motion)
            starts[camera] = start
        if not dragging:
            put_back(item)
            continue
        item.matrix_parent_inverse = home @ item.matrix_basis.inverted_safe()
        if camera in starts:
            item[_START] = starts[camera].ravel().tolist()
    return set(starts)


def finish(item: bpy.types.Object) -> None:
    """End the drag of a part: its camera goes where the last motion led it, and the part to its place on it."""
    carry([item], dragging=False)
    put_back(item)


def put_back(item: bpy.types.Object) -> None:
    """Put a part to its place on its camera, where that stands now."""
    item.matrix_basis, item.matrix_parent_inverse = _home(item), Matrix()
    if _START in item:
        del item[_START]


def _moves_itself(camera: bpy.types.Object, dragging: bool) -> bool:
    """Whether a camera has been moved, or is animated or under a constraint."""
    place = objects.world_matrix(camera)[:3, 3].astype(np.float32)
    was_moved = np.any(np.array(camera.mphdrr_module.placed, np.float32) != place)
    return bool(was_moved) or (dragging and camera.select_get()) or not following.is_free(camera)


def _home(item: bpy.types.Object) -> Matrix:
    values = item.get(_HOME)
    return _AT_HOME if values is None else Matrix([values[row : row + 4] for row in range(0, 16, 4)])


def _move(camera: bpy.types.Object, matrix: NDArray[np.float64]) -> None:
    """Put a camera at a world matrix, as far as its locks allow."""
    location, rotation = camera.location.copy(), camera.rotation_euler.copy()
    objects.set_world_matrix(camera, matrix)
    for axis in range(3):
        if camera.lock_location[axis]:
            camera.location[axis] = location[axis]
        if camera.lock_rotation[axis]:
            camera.rotation_euler[axis] = rotation[axis]
