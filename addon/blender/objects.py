"""Objects of the scene: their positions in float64, and their removal together with data that only they use."""

from collections.abc import Iterable, Sequence
from typing import Any

import bpy
import numpy as np
from mathutils import Euler, Matrix
from numpy.typing import NDArray

from ...core.errors import InputError
from . import decimals

_ROUNDING = 4e-7  # relative rounding of an element of the product of two float32 matrices


def world_matrix(item: bpy.types.Object) -> NDArray[np.float64]:
    """Return the current world matrix (4, 4) of an object in float64, its translation in the decimals that were typed.

    `Object.matrix_world` is out of date after a script has set a location, and while the object is hidden: it is used
    only for objects with constraints or physics.
    """
    if any(not c.mute for c in item.constraints) or item.rigid_body is not None:
        return _as_typed(item.matrix_world)
    if item.parent is None and not any(item.delta_location):
        return _as_typed(item.matrix_basis)
    basis = np.array(item.matrix_basis, dtype=np.float64)
    basis[:3, 3] = [
        decimals.typed(x) + decimals.typed(delta) for x, delta in zip(item.location, item.delta_location, strict=True)
    ]
    return _as_typed(_parent_matrix(item) @ basis)


def _as_typed(matrix: Any) -> NDArray[np.float64]:
    """Return a matrix (4, 4) in float64 whose translation has the shortest decimals of Blender's float32 numbers."""
    values = np.array(matrix, dtype=np.float64)
    values[:3, 3] = [decimals.typed(x) for x in values[:3, 3]]
    return values


def _parent_matrix(item: bpy.types.Object) -> NDArray[np.float64]:
    """Return the matrix (4, 4), in float64, that leads from an object's own transform to the world."""
    if item.parent is None:
        return np.eye(4)
    if _is_deformed_with_parent(item):  # as Blender has evaluated the parent; the object itself may be out of date
        evaluated = item.evaluated_get(bpy.context.view_layer.depsgraph or bpy.context.evaluated_depsgraph_get())
        is_evaluated = evaluated.is_evaluated  # else it is hidden
        local = evaluated.matrix_local if is_evaluated else item.matrix_parent_inverse @ item.matrix_basis
        parent = np.array(evaluated.matrix_world, np.float64) @ np.linalg.inv(np.array(local, np.float64))
    else:
        parent = world_matrix(item.parent)
    inverse = _as_typed(item.matrix_parent_inverse)
    matrix = parent @ inverse
    # Right angles, and parents whose inverse keeps an object in its place, are exact apart from float32 rounding.
    rounding = _ROUNDING * (np.abs(parent) @ np.abs(inverse) + np.linalg.norm(matrix[:3], axis=0))
    return np.where(np.abs(matrix - np.rint(matrix)) <= rounding, np.rint(matrix), matrix)


def _is_deformed_with_parent(item: bpy.types.Object) -> bool:
    """Return whether an object follows a bone, vertices, a lattice or a curve's path, not its parent's own transform."""
    return item.parent_type != "OBJECT" or (item.parent.type == "CURVE" and item.parent.data.use_path)


def is_free(item: bpy.types.Object) -> bool:
    """Return whether only the user moves an object: no animation, driver, constraint or physics does."""
    data = item.animation_data
    is_animated = data is not None and (data.action is not None or len(data.drivers) or len(data.nla_tracks))
    return not is_animated and not len(item.constraints) and item.rigid_body is None


def is_moved_by_hand(item: bpy.types.Object) -> bool:
    """Return whether an object `is_free`, and is carried by nothing but free parents as a whole."""
    is_carried = item.parent is not None and (_is_deformed_with_parent(item) or not is_moved_by_hand(item.parent))
    return is_free(item) and not is_carried


def require_evaluated(items: Iterable[bpy.types.Object]) -> None:
    """Bring objects up to date that are not moved by hand; raise `InputError` where Blender leaves one out as hidden."""
    for item in [item for item in items if not is_moved_by_hand(item)]:
        if not item.evaluated_get(bpy.context.evaluated_depsgraph_get()).is_evaluated:
            raise InputError(f"{item.name!r} is hidden, so Blender does not evaluate what moves it: show it first")


def world_matrices(items: Sequence[bpy.types.Object]) -> NDArray[np.float64]:
    """Return the current world matrices (N, 4, 4) of objects in float64."""
    return np.array([world_matrix(item) for item in items]).reshape(-1, 4, 4)


def set_world_matrix(item: bpy.types.Object, matrix: NDArray[np.float64], unchanged: Sequence[str] = ()) -> None:
    """Move an object to a world matrix (4, 4), under whatever parent it has, but for `unchanged`: "location", "scale"."""
    values = {name: getattr(item, name).copy() for name in unchanged}
    if item.parent is not None:
        matrix = np.linalg.inv(_parent_matrix(item)) @ matrix
    if "scale" in unchanged and np.linalg.det(matrix) < 0:  # under a mirrored parent
        matrix = matrix * [-1.0, 1.0, 1.0, 1.0]
    item.matrix_basis = Matrix(matrix)
    if item.parent is None and item.rotation_mode == "XYZ":
        angles = Euler(euler_angles(matrix))
        # The angles of a scaled, mirrored or doubly rotated (`delta_rotation_euler`) object are not those of its matrix.
        if np.allclose(angles.to_matrix(), item.rotation_euler.to_matrix(), rtol=0, atol=1e-5):
            item.rotation_euler = angles
    for name, value in values.items():
        setattr(item, name, value)


def mirror_signs(item: bpy.types.Object) -> list[float]:
    """Return the signs of an object's own scale along x, y and z, and 1."""
    return [*(-1.0 if x * delta < 0 else 1.0 for x, delta in zip(item.scale, item.delta_scale, strict=True)), 1.0]


def unparent(item: bpy.types.Object) -> None:
    """Remove an object's parent without moving the object."""
    matrix = world_matrix(item)
    item.parent = None
    set_world_matrix(item, matrix)


def remove_objects(items: Sequence[bpy.types.Object]) -> None:
    """Remove objects, and their meshes or cameras if nothing else uses these."""
    datablocks = {item.data for item in items}
    bpy.data.batch_remove(list(items))
    update_hidden_scenes()
    remove_unused(datablocks)


def update_hidden_scenes() -> None:
    """Bring the scenes that no window shows up to date after objects were removed.

    Blender does so only when it shows them, but looks through their objects once a minute (`DRW_cache_free_old_batches`),
    and would crash on removed ones.
    """
    visible_scenes = {window.scene for window in bpy.context.window_manager.windows}
    for layer in [layer for scene in bpy.data.scenes if scene not in visible_scenes for layer in scene.view_layers]:
        if layer.depsgraph is not None:
            layer.update()


def remove_unused(datablocks: Iterable[bpy.types.ID | None]) -> None:
    """Remove the datablocks that have no user any more; None entries are skipped."""
    bpy.data.batch_remove([datablock for datablock in datablocks if datablock is not None and datablock.users == 0])


def euler_angles(matrix: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return a matrix's XYZ Euler angles, rad, in float64: Blender's float32 angles show -0.000007 degrees for 0."""
    r = matrix[:3, :3]
    y = -np.arcsin(np.clip(r[2, 0], -1.0, 1.0))
    x, z = np.arctan2(r[2, 1], r[2, 2]), np.arctan2(r[1, 0], r[0, 0])
    return float(x), 0.0 if abs(y) < 1e-12 else float(y), float(z)


def collections_named(scene: bpy.types.Scene, name: str) -> list[bpy.types.Collection]:
    """Return a scene's collections whose name begins with `name`: Blender numbers further ones, as in "name.001"."""
    return [collection for collection in scene.collection.children if collection.name.startswith(name)]


def ensure_collection(scene: bpy.types.Scene, name: str) -> bpy.types.Collection:
    """Return the scene's first collection whose name begins with `name`; make one if there is none."""
    collections = collections_named(scene, name) or [bpy.data.collections.new(name)]
    if collections[0].name not in scene.collection.children:
        scene.collection.children.link(collections[0])
    return collections[0]


def remove_empty_collections(scene: bpy.types.Scene, name: str) -> None:
    """Remove those of a scene's collections called `name`, numbered ones included, that hold no object any more."""
    for collection in [collection for collection in collections_named(scene, name) if not collection.all_objects]:
        bpy.data.collections.remove(collection)


def link_beside(item: bpy.types.Object, neighbour: bpy.types.Object) -> None:
    """Link a new object to all collections of another object."""
    for collection in neighbour.users_collection:
        collection.objects.link(item)


def picture_empty(name: str, parent: bpy.types.Object, picture: bpy.types.Image | None, side: str) -> bpy.types.Object:
    """Return a new empty, a child of `parent` in no collection yet, that shows a picture on its `side` "FRONT" or "BACK"."""
    item = bpy.data.objects.new(name, None)
    item.empty_display_type, item.data, item.use_empty_image_alpha, item.empty_image_side = "IMAGE", picture, True, side
    item.parent = parent
    return item


def hide(*items: bpy.types.Object | None) -> list[int]:
    """Hide objects by the eye beside their names and return the `session_uid` of those that were visible."""
    layer = bpy.context.view_layer
    visible_items = [item for item in items if item is not None and item.name in layer.objects and not item.hide_get()]
    for item in visible_items:
        item.hide_set(True)
    return [item.session_uid for item in visible_items]


def change(owner: Any, **values: Any) -> None:
    """Set only those properties that differ: setting one makes Blender calculate and draw the scene again."""
    for name, value in values.items():
        current = getattr(owner, name)
        # Blender keeps numbers as float32.
        equal = current == value if isinstance(value, str | bool) else np.allclose(current, value, rtol=1e-6, atol=0)
        if not equal:
            setattr(owner, name, value)
