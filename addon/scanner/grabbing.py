"""Parts that take their module along when they are moved: a collimator, a crystal or a plane with a projection.

While a tool drags a part, it writes the part's own matrix again and again, relative to where the part's camera was at the
start: the part stores that camera matrix (`_START`), the camera goes where the part leads it, and the part's parent inverse
keeps the part at its position on the camera. Nothing is lost if Blender stores an undo step before a handler has seen the
last motion: the part's own matrix and the camera's start matrix determine the module's position.
"""

from collections.abc import Iterable
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..blender import objects
from . import collimators

_HOME = "mphdrr_home"  # custom property of a plane: its matrix (4, 4) relative to its camera
_START = "mphdrr_start"  # custom property of a dragged part: its camera's world matrix (4, 4) at the start of the drag
_TOLERANCE = 1e-5  # rounding of a matrix: mm of its translation, and of its rotation's elements
_AT_HOME = Matrix()


def set_home(item: bpy.types.Object, matrix: Matrix) -> None:
    """Place a plane on its module's camera, at a matrix relative to the camera."""
    item.matrix_basis = matrix
    item[_HOME] = [x for row in matrix for x in row]


def is_module_part(item: bpy.types.Object) -> bool:
    """Return whether an object is a collimator, a crystal or a plane with a projection, and so takes its module along."""
    return item.mphdrr_module.part in collimators.PARTS or _HOME in item


def is_dragging() -> bool:
    """Return whether one of Blender's tools is moving something."""
    windows = bpy.context.window_manager.windows
    return any(o.bl_idname.startswith(("TRANSFORM_OT", "OBJECT_OT")) for w in windows for o in w.modal_operators)


def is_dragged(item: bpy.types.Object) -> bool:
    """Return whether a part is being dragged, or has been and is not back at its home."""
    return _START in item


def is_displaced(item: bpy.types.Object) -> bool:
    """Return whether a part is away from its home on its module's camera, and may take the module along."""
    camera = item.parent
    if camera is None or not camera.mphdrr_module.is_module or item.library or camera.library:
        return False
    matrix = item.matrix_parent_inverse @ item.matrix_basis
    home = _home(item)
    if matrix == home:  # true of nearly all parts, and ten times as fast as numpy
        return False
    if np.abs(np.array(matrix) - np.array(home)).max() <= _TOLERANCE:
        return False
    part = item.mphdrr_module.part
    has_copy = sum(o.mphdrr_module.part == part for o in camera.children) > 1  # then it is unclear which one leads
    return objects.is_free(item) and item.parent_type == "OBJECT" and not has_copy


def move_modules_with(items: Iterable[bpy.types.Object], dragging: bool) -> set[bpy.types.Object]:
    """Bring displaced parts back to their homes on their cameras, and return the cameras moved for that.

    A camera goes where the first of its parts leads it, unless the camera itself is being moved.
    """
    starts: dict[bpy.types.Object, NDArray[np.float64]] = {}
    for item in filter(is_displaced, items):
        camera, home = item.parent, _home(item)
        if camera not in starts and (is_dragged(item) or not _is_moved_itself(camera, dragging)):
            start = np.reshape(item[_START], (4, 4)) if is_dragged(item) else objects.world_matrix(camera)
            motion: Any = np.array(item.matrix_basis, np.float64) @ np.linalg.inv(home)
            motion[:3, :3] /= np.linalg.norm(motion[:3, :3], axis=0)
            _move(camera, start @ motion * objects.mirror_signs(camera))
            starts[camera] = start
        if not dragging:
            put_back(item)
            continue
        item.matrix_parent_inverse = home @ item.matrix_basis.inverted_safe()
        if camera in starts:
            item[_START] = starts[camera].ravel().tolist()
    return set(starts)


def finish_drag(item: bpy.types.Object) -> None:
    """End the drag of a part: move its camera by the last motion, and the part back to its home on the camera."""
    move_modules_with([item], dragging=False)
    put_back(item)


def put_back(item: bpy.types.Object) -> None:
    """Put a part at its home on its camera, at the camera's present position."""
    item.matrix_basis, item.matrix_parent_inverse = _home(item), Matrix()
    if _START in item:
        del item[_START]


def _is_moved_itself(camera: bpy.types.Object, dragging: bool) -> bool:
    """Return whether a module's camera does not follow its parts.

    It has left the position where it was last built, is selected while something is dragged (`dragging`), or is animated or
    constrained.
    """
    position = objects.world_matrix(camera)[:3, 3].astype(np.float32)
    was_moved = np.any(np.array(camera.mphdrr_module.placed, np.float32) != position)
    return bool(was_moved) or (dragging and camera.select_get()) or not objects.is_free(camera)


def _home(item: bpy.types.Object) -> Matrix:
    """Return the matrix of a part's home relative to its camera."""
    values = item.get(_HOME)
    return _AT_HOME if values is None else Matrix([values[row : row + 4] for row in range(0, 16, 4)])


def _move(camera: bpy.types.Object, matrix: NDArray[np.float64]) -> None:
    """Move a camera to a world matrix, as far as its locks allow."""
    location, rotation = camera.location.copy(), camera.rotation_euler.copy()
    objects.set_world_matrix(camera, matrix, ("scale",))
    for axis in range(3):
        if camera.lock_location[axis]:
            camera.location[axis] = location[axis]
        if camera.lock_rotation[axis]:
            camera.rotation_euler[axis] = rotation[axis]
