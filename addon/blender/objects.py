"""Objects of the scene: where they stand in float64, and how they are removed with what is theirs alone."""

from collections.abc import Iterable, Sequence
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray


def world_matrix(item: bpy.types.Object) -> NDArray[np.float64]:
    """World matrix (4, 4) of an object as it stands now, in float64.

    `Object.matrix_world` is out of date after a script has set a location, and while the object is hidden: it is used
    only for objects with constraints or a parent that is not a plain object.
    """
    if any(not c.mute for c in item.constraints) or (item.parent is not None and item.parent_type != "OBJECT"):
        return np.array(item.matrix_world, dtype=np.float64)
    local = np.array(item.matrix_basis, dtype=np.float64)
    if item.parent is None:
        return local
    return world_matrix(item.parent) @ np.array(item.matrix_parent_inverse, dtype=np.float64) @ local


def world_matrices(items: Sequence[bpy.types.Object]) -> NDArray[np.float64]:
    """`world_matrix` of each object: (N, 4, 4)."""
    return np.array([world_matrix(item) for item in items]).reshape(-1, 4, 4)


def set_world_matrix(item: bpy.types.Object, matrix: NDArray[np.float64]) -> None:
    """Put an object at a world matrix (4, 4), under whatever parent it has."""
    if item.parent is not None:
        parent = world_matrix(item.parent) @ np.array(item.matrix_parent_inverse, dtype=np.float64)
        matrix = np.linalg.inv(parent) @ matrix
    item.matrix_basis = Matrix(matrix)
    if item.parent is None and item.rotation_mode == "XYZ":
        item.rotation_euler = euler_angles(matrix)


def unparent(item: bpy.types.Object) -> None:
    """Take an object off its parent and leave it where it is."""
    matrix = world_matrix(item)
    item.parent = None
    set_world_matrix(item, matrix)


def remove_objects(items: Sequence[bpy.types.Object]) -> None:
    """Remove objects, and their meshes or cameras that nothing else uses."""
    datas = {item.data for item in items}
    bpy.data.batch_remove(list(items))
    remove_unused(datas)


def remove_unused(datablocks: Iterable[bpy.types.ID | None]) -> None:
    """Remove those of some datablocks that nothing uses any more."""
    bpy.data.batch_remove([each for each in datablocks if each is not None and each.users == 0])


def euler_angles(matrix: NDArray[np.float64]) -> tuple[float, float, float]:
    """XYZ Euler angles, radians, of a matrix, in float64: Blender's float32 angles show -0.000007 degrees for 0."""
    r = matrix[:3, :3]
    y = -np.arcsin(np.clip(r[2, 0], -1.0, 1.0))
    return (
        float(np.arctan2(r[2, 1], r[2, 2])),
        0.0 if abs(y) < 1e-12 else float(y),
        float(np.arctan2(r[1, 0], r[0, 0])),
    )


def homes(scene: bpy.types.Scene, name: str) -> list[bpy.types.Collection]:
    """A scene's collections of that name, which Blender may have numbered."""
    return [home for home in scene.collection.children if home.name.startswith(name)]


def home(scene: bpy.types.Scene, name: str) -> bpy.types.Collection:
    """The first of a scene's `homes`, made if need be."""
    found = homes(scene, name) or [bpy.data.collections.new(name)]
    if found[0].name not in scene.collection.children:
        scene.collection.children.link(found[0])
    return found[0]


def remove_empty_homes(scene: bpy.types.Scene, name: str) -> None:
    """Remove those of a scene's `homes` that hold nothing any more."""
    for empty in [home for home in homes(scene, name) if not home.all_objects]:
        bpy.data.collections.remove(empty)


def link_beside(item: bpy.types.Object, other: bpy.types.Object) -> None:
    """Put a new object into the collections of another one."""
    for collection in other.users_collection:
        collection.objects.link(item)


def picture_empty(name: str, parent: bpy.types.Object, picture: bpy.types.Image | None, side: str) -> bpy.types.Object:
    """A new empty that shows a picture on a side of it, a child of another object; in no collection yet."""
    item = bpy.data.objects.new(name, None)
    item.empty_display_type, item.data, item.use_empty_image_alpha, item.empty_image_side = "IMAGE", picture, True, side
    item.parent = parent
    return item


def change(owner: Any, **values: Any) -> None:
    """Set properties that have other values: setting one has the scene calculated and drawn again."""
    for name, value in values.items():
        now = getattr(owner, name)
        same = now == value if isinstance(value, str | bool) else np.allclose(now, value, rtol=1e-6, atol=0)  # float32
        if not same:
            setattr(owner, name, value)
