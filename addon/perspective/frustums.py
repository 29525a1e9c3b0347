"""Volumes in a module's own coordinates: as a frustum of pictures in the scene, or back on their own voxels.

A frustum is a mesh of lines, a child of its module's camera, and an image empty for each layer of depth, its children, in a
collection of their own. Layers have the distance from the pinhole, and the size, of the part that they show: seen from the
pinhole, they lie on one another. They move with the module; `changes` tells whether they still show the present scene.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ...core import InputError, PerspectiveGrid, Views, from_perspective, memory, to_perspective
from ...core.geometry.frames import affine_matrix, moved
from ...core.progress import Progress, Stages, stages_of, tell
from ...core.runs.mosaic import as_seen, png_bytes
from ...core.runs.run_recipe import recipe_views
from ...core.volumes.volume import Volume, outside_value
from ..blender import ids, jobs, objects
from ..phantoms import phantoms
from ..pictures import images
from ..runs import runs
from ..scanner import scanner, selection
from ..volumes import slices, stored_volumes, volume_materials, volumes

_KEY = "mphdrr_frustum"  # custom property of the lines: the state of volume and module that the frustum shows, JSON
_NEAREST = 0.1  # smallest depth of layers, relative to the pinhole's distance from the isocentre
_BYTES_PER_PIXEL = 24.0  # of a layer: number, colours and Blender's copies
_PNG_LEVEL = 1  # fast compression
_OPACITY_POWER = 0.5  # opacity = relative value ** this power: thin structures in a thick layer would be too faint

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Request:
    """Everything that a worker thread needs to put a volume into a module's coordinates."""

    item: int  # `session_uid` of the volume's object
    camera: int  # `session_uid` of the module's camera
    name: str  # name of the volume's object
    module: str  # name of the module's camera
    read: Callable[[], Volume]  # reader of the volume's voxels
    views: Views  # view of this module alone
    nearest: float  # smallest depth of cells, mm
    state: dict[str, Any]  # state that the frustum will show (`_frustum_state`)


def frustum_job(context: bpy.types.Context, planes: int, uniform: str) -> jobs.Job:
    """Return the job that shows the active volume as a frustum of the active module, in place of the module's present one.

    Raises InputError where there is no volume or module, the volume is not in front of the pinhole, or memory does not
    suffice.
    """
    request = _read_request(context)
    low, high = _display_range(context.object)
    quantity, scene_uid = request.state["quantity"], context.scene.session_uid
    rows, columns = request.views.shape
    memory.require(_BYTES_PER_PIXEL * planes * rows * columns, f"{planes} pictures of {columns} x {rows} pixels")

    def work(progress: Progress) -> tuple[PerspectiveGrid, list[bytes]]:
        """Resample the volume to the frustum; return its grid and a PNG file of each plane."""
        stages = stages_of(progress)
        _, g, array = _resample_to_frustum(request, planes, uniform, stages)
        packing, files = stages("packing"), list[bytes]()
        for layer in np.moveaxis(array, 2, 0):
            files.append(png_bytes(color_values(as_seen(layer.T), quantity, low, high), _PNG_LEVEL))
            tell(packing, len(files), planes)
        return g, files

    def finish(result: tuple[PerspectiveGrid, list[bytes]]) -> str:
        """Add the frustum to the scene in place of the camera's earlier one, and return the line to report."""
        scene, camera = jobs.find_by_uid(bpy.data.scenes, scene_uid), jobs.find_by_uid(bpy.data.objects, request.camera)
        if scene is None or camera is None:
            raise InputError(f"{request.module} is gone")
        g, files = result
        remove(scene, [camera])
        _add_frustum(scene, camera, request, g, files)
        near, far = g.depths[[0, -1]]
        words = f"{near:.4g} to {far:.4g} mm" if planes > 1 else f"{near:.4g} mm"
        return f"{request.name!r} as {request.module} sees it: {planes} layers, {words} from the pinhole"

    return jobs.Job(f"{request.name} in perspective", work, finish)


def resample_job(context: bpy.types.Context, cells: int, uniform: str) -> jobs.Job:
    """Return the job that resamples the active volume onto the active module's cells and back, as a new volume of the scene.

    Raises InputError as `frustum_job`.
    """
    request, display_range = _read_request(context), _typed_range(context.object)
    rows, columns = request.views.shape
    voxels = float(np.prod(context.object.mphdrr_volume.shape))
    memory.require(8.0 * cells * rows * columns + 8.0 * voxels, f"{columns} x {rows} x {cells} cells")
    shape = [columns, rows, cells]
    provenance = {"volume": request.name, "through": request.module, "cells": shape, "evenly_in": uniform}

    def make(progress: Progress) -> Volume:
        """Return the volume resampled to the frustum's cells and back to its own voxels."""
        stages = stages_of(progress)
        volume, g, array = _resample_to_frustum(request, cells, uniform, stages)
        return to_voxels(array, g, volume, stages("back on voxels"))

    def finish(item: bpy.types.Object, stored: stored_volumes.StoredVolume) -> str:
        """Give the new volume the display range of the old one, and return the line to report."""
        item.mphdrr_volume.display_low, item.mphdrr_volume.display_high = display_range
        return f"Added {item.name!r}: {volumes.values_text(stored)}"

    name, item = f"{request.name} through {request.module}", context.object
    pose, collection = volumes.pose_of_object(item), item.users_collection[0]
    return volumes.add_volume_job(name, make, name, finish, pose, provenance, collection, [item])


def _resample_to_frustum(
    request: _Request, layers: int, uniform: str, stages: Stages
) -> tuple[Volume, PerspectiveGrid, NDArray[np.float32]]:
    """Read the volume and resample it onto the module's grid; return volume, grid and values (n_u, n_v, layers)."""
    stages("reading the voxels")
    volume = request.read()
    g = _perspective_grid(request, volume, layers, uniform)
    return volume, g, to_module_cells(volume, g, stages("following the rays"))


def to_module_cells(volume: Volume, g: PerspectiveGrid, progress: Progress | None = None) -> NDArray[np.float32]:
    """Return a volume's values in a module's cells by `to_perspective`; outside the volume, CT numbers are those of air."""
    outside = outside_value(volume)
    array = volume.array - np.float32(outside) if outside else volume.array
    values = np.asarray(to_perspective(array, g, grid=volume.grid, progress=progress))
    return values + np.float32(outside) if outside else values


def to_voxels(array: NDArray[np.float32], g: PerspectiveGrid, like: Volume, progress: Progress | None = None) -> Volume:
    """Return values in a module's cells on the voxels of `like`, by `from_perspective`."""
    outside = np.float32(outside_value(like))
    values = np.asarray(from_perspective(array - outside, g, like.grid, progress=progress))
    return Volume(values + outside, like.grid, like.quantity)


def color_values(values: NDArray[np.float32], quantity: str, low: float, high: float) -> NDArray[np.uint8]:
    """Return the colours (…, 4) of values as slices have them, and an opacity that rises with the value."""
    relative = np.clip((values - low) / max(high - low, 1e-30), 0.0, 1.0)
    colors = np.rint(255 * slices.color_table(quantity)[:, :3]).astype(np.uint8)
    result = np.empty((*values.shape, 4), np.uint8)
    result[..., :3] = colors[np.rint(relative * (len(colors) - 1)).astype(np.intp)]
    result[..., 3] = np.rint(255 * relative**_OPACITY_POWER)
    return result


def frustums(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Return the frustums in the scene: their line objects, whose children are the layers."""
    collections = objects.collections_named(scene, ids.PERSPECTIVES)
    return sorted((o for collection in collections for o in collection.objects if _KEY in o), key=lambda o: o.name)


def layers(frustum: bpy.types.Object) -> list[bpy.types.Object]:
    """Return a frustum's layers, from the pinhole outwards."""
    return sorted(frustum.children, key=lambda layer: layer.name)


def volume_name(frustum: bpy.types.Object) -> str:
    """Return the name that a frustum's volume had when the frustum was made."""
    return str(json.loads(frustum[_KEY])["volume"])


def changes(scene: bpy.types.Scene, frustum: bpy.types.Object) -> str:
    """Return in words what differs between a frustum and the present scene; "" for no difference."""
    old, camera = json.loads(frustum[_KEY]), frustum.parent
    if camera is None:
        return "its module is gone"
    item = scene.objects.get(old["volume"])
    if not volumes.is_volume(item):
        return f"{old['volume']} is gone"
    try:
        current = _frustum_state(scene, item, camera)
    except InputError as error:
        return str(error)
    words = {"voxels": "voxels", "pose": "place", "colors": "colours"}
    changed = [text for key, text in words.items() if current[key] != old[key]]
    text = [f"other {' and '.join(changed)} of {old['volume']}"] if changed else []
    if current["views"] != old["views"]:
        text.append(f"{camera.name} has moved, or has other pixels")
    return "; ".join(text)


def visible_volumes(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Return the volumes of visible frustums whose display range has not changed."""
    result = []
    for frustum in frustums(scene):
        old, item = json.loads(frustum[_KEY]), scene.objects.get(volume_name(frustum))
        if frustum.visible_get() and volumes.is_volume(item) and old["colors"] == list(_typed_range(item)):
            result.append(item)
    return result


def remove(scene: bpy.types.Scene, modules: list[bpy.types.Object] | None = None) -> int:
    """Remove the frustums of modules, given as cameras, or of all, with their layers, and return how many."""
    removed = [frustum for frustum in frustums(scene) if modules is None or frustum.parent in modules]
    for frustum in removed:
        objects.remove_objects([*frustum.children, frustum])
    objects.remove_empty_collections(scene, ids.PERSPECTIVES)
    return len(removed)


def after_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Show, hide frustums with their modules, and hide those whose module was deleted."""
    if not depsgraph.id_type_updated("SCENE") or scene != bpy.context.scene:
        return
    for frustum in frustums(scene):
        is_hidden = frustum.parent is None or frustum.parent.hide_viewport
        for item in (frustum, *frustum.children):
            objects.change(item, hide_viewport=is_hidden)


def _read_request(context: bpy.types.Context) -> _Request:
    """Return the request for the active volume and module; raise `InputError` where one is missing."""
    item, camera = context.object, selection.active_module(context)
    volumes.require_volume(item)
    if camera is None:
        raise InputError("no module is active: select its camera, or choose it in the Modules panel")
    phantoms.require_current(item)
    views, read = _module_views(context.scene, camera), volumes.reader(item)
    nearest = _NEAREST * float(np.linalg.norm(views.sources[0]))
    state = _frustum_state(context.scene, item, camera)
    return _Request(item.session_uid, camera.session_uid, item.name, camera.name, read, views, nearest, state)


def _module_views(scene: bpy.types.Scene, camera: bpy.types.Object) -> Views:
    """Return the view of one module, with the pixels of the Projections panel."""
    if (collection := scanner.scanner_of(scene, camera)) is None:
        raise InputError(f"{camera.name!r} is in no scanner of the scene")
    return recipe_views(runs.panel_recipe(scene), scanner.read_module(collection, camera))


def _frustum_state(scene: bpy.types.Scene, item: bpy.types.Object, camera: bpy.types.Object) -> dict[str, Any]:
    """Return the state of volume and module that a frustum shows, as JSON holds it."""
    path, pose = volumes.file_and_pose(item)
    views = _module_views(scene, camera)
    arrays = views.sources, views.detector_centers, views.u_steps, views.v_steps
    return {
        "volume": item.name, "quantity": volumes.quantity_of(item), "voxels": Path(path).name, "pose": pose.tolist(),
        "colors": list(_typed_range(item)),
        "views": [list(views.shape), *(array[0].tolist() for array in arrays)],
    }  # fmt: skip


def _typed_range(item: bpy.types.Object) -> tuple[float, float]:
    """Return the display range of a volume, in the window's unit."""
    return item.mphdrr_volume.display_low, item.mphdrr_volume.display_high


def _display_range(item: bpy.types.Object) -> tuple[float, float]:
    """Return the display range of a volume, in the voxels' own unit."""
    factor = volume_materials.display_unit(volumes.quantity_of(item))[1]
    low, high = _typed_range(item)
    return low / factor, high / factor


def _perspective_grid(request: _Request, volume: Volume, layers: int, uniform: str) -> PerspectiveGrid:
    """Return the module's cells between the depths of the volume, but not too close to the pinhole."""
    begin, end = _depth_range(request.views, volume)
    near = max(begin, request.nearest)
    if not near < end:
        raise InputError(f"{request.name!r} is not in front of the pinhole of {request.module}")
    return PerspectiveGrid(request.views, 0, layers, near, end, uniform.lower())


def _depth_range(views: Views, volume: Volume) -> tuple[float, float]:
    """Return the smallest and the largest depth, mm, of a volume's non-empty voxels, or of all if all are empty."""
    normal = np.cross(views.u_steps[0], views.v_steps[0])
    normal *= np.sign(normal @ (views.detector_centers[0] - views.sources[0])) / np.linalg.norm(normal)
    steps, grid = normal @ volume.grid.affine[:3, :3], volume.grid
    is_filled = volume.array != outside_value(volume)
    if not is_filled.any():
        is_filled = np.ones(grid.shape, bool)
    offsets = steps[1] * np.arange(grid.shape[1])[:, None] + steps[2] * np.arange(grid.shape[2])
    planes = ((n, offsets[plane]) for n, plane in enumerate(is_filled) if plane.any())  # one at a time, to save memory
    ends = np.array([[n * steps[0] + plane.min(), n * steps[0] + plane.max()] for n, plane in planes])
    first = float(normal @ (grid.affine[:3, 3] - views.sources[0]))
    half_voxel = 0.5 * float(np.abs(steps).sum())
    return first + float(ends.min()) - half_voxel, first + float(ends.max()) + half_voxel


def _add_frustum(
    scene: bpy.types.Scene, camera: bpy.types.Object, request: _Request, g: PerspectiveGrid, files: list[bytes]
) -> None:
    """Add a frustum to the scene: lines around the layers and from the pinhole, and a picture for each layer."""
    collection = objects.ensure_collection(scene, ids.PERSPECTIVES)
    corners = moved(np.linalg.inv(objects.world_matrix(camera)), _corners(g))  # (n_k, 4, 3)
    name = ids.part_name(camera.name, "perspective")
    frustum = bpy.data.objects.new(name, _line_mesh(name, corners))
    frustum[_KEY] = json.dumps(request.state)
    frustum.parent, frustum.hide_select, frustum.hide_render = camera, True, True
    frustum.lock_location = frustum.lock_rotation = frustum.lock_scale = (True, True, True)
    collection.objects.link(frustum)
    n_v, n_u = g.views.shape
    digits = len(str(len(files)))
    for n, (file, (origin, along_u, _, along_v)) in enumerate(zip(files, corners, strict=True), start=1):
        text = f"{name} layer {n:0{digits}d}"
        picture = images.fill(bpy.data.images.new(text, 1, 1, alpha=True), file)
        layer = objects.picture_empty(text, frustum, picture, "DOUBLE_SIDED")
        layer.empty_display_size = max(n_u, n_v)
        across, up = origin - along_u, along_v - origin  # a picture's columns run along -u, as the pinhole sees it
        normal = np.cross(across, up) / np.linalg.norm(np.cross(across, up))
        matrix = affine_matrix(np.column_stack([across / n_u, up / n_v, normal]), (along_u + along_v) / 2)
        layer.hide_select, layer.matrix_basis = True, Matrix(matrix)
        collection.objects.link(layer)


def _corners(g: PerspectiveGrid) -> Floats:
    """Return the corners (n_k, 4, 3), world mm, of the layers' outermost pixels: from (0, 0) along u, then along v."""
    n_u, n_v, _ = g.shape
    pixels = np.array([[0, 0], [n_u, 0], [n_u, n_v], [0, n_v]]) - 0.5
    return g.to_world([[[*pixel, plane] for pixel in pixels] for plane in g.planes])


def _line_mesh(name: str, corners: Floats) -> bpy.types.Mesh:
    """Return a mesh of lines around the layers' `corners` (n_k, 4, 3), and from the pinhole to the last ones."""
    points = [[0.0, 0.0, 0.0], *corners.reshape(-1, 3).tolist()]
    around = [(4 * n + a, 4 * n + a % 4 + 1) for n in range(len(corners)) for a in range(1, 5)]
    last = 4 * len(corners)
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(points, [*around, *((0, last - a) for a in range(4))], [])
    return mesh
