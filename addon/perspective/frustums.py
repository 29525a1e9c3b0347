"""Volumes as a module sees them, in its own coordinates: a frustum of pictures in the scene, or back on their own voxels.

A frustum is a mesh of lines, a child of its module's camera, and an image empty for each layer of depth, its children, in a
collection of their own. Layers are as far from the pinhole, and as large, as what they show: seen from the pinhole, they
lie on one another. They go with the module; what they show was true when they were made, and `changes` says what is not.
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
from ...core.geometry.frames import affine_matrix
from ...core.progress import Progress, Stages, stages_of, tell
from ...core.runs.mosaic import as_seen, png
from ...core.runs.run_recipe import recipe_views
from ...core.volumes.volume import Volume, outside_value
from ..blender import ids, jobs, objects
from ..phantoms import phantoms
from ..pictures import images
from ..runs import runs
from ..scanner import scanner, selection
from ..volumes import slices, stored_volumes, volume_materials, volumes

_KEY = "mphdrr_frustum"  # custom property of the lines: what the frustum was made of, JSON
_NEAREST = 0.1  # of the pinhole's distance from the isocentre: where layers begin at the nearest
_BYTES = 24.0  # a pixel of a layer: its number, its colours and Blender's copies
_PNG_LEVEL = 1  # fast
_OPACITY_POWER = 0.5  # of the relative value: layers are thick, and what is thin in them would hardly be seen

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Request:
    """What is asked for: a volume in a module's coordinates."""

    item: int  # session_uid of the volume's object
    camera: int  # and of the module's camera
    name: str
    module: str
    read: Callable[[], Volume]
    views: Views  # of this module alone
    nearest: float  # depth, mm, at which cells may begin
    state: dict[str, Any]


def showing(context: bpy.types.Context, planes: int, uniform: str) -> jobs.Job:
    """The job that shows the active volume as a frustum of the active module, in place of the one that it has.

    Raises InputError where there is no volume or module, the volume is not in front of the pinhole, or memory does not
    suffice.
    """
    asked = _request(context)
    low, high = _display_range(context.object)
    quantity, scene_uid = asked.state["quantity"], context.scene.session_uid
    rows, columns = asked.views.shape
    memory.require(_BYTES * planes * rows * columns, f"{planes} pictures of {columns} x {rows} pixels")

    def work(progress: Progress) -> tuple[PerspectiveGrid, list[bytes]]:
        stages = stages_of(progress)
        _, g, array = _followed(asked, planes, uniform, stages)
        packing, files = stages("packing"), list[bytes]()
        for layer in np.moveaxis(array, 2, 0):
            files.append(png(colored(as_seen(layer.T), quantity, low, high), _PNG_LEVEL))
            tell(packing, len(files), planes)
        return g, files

    def finish(made: tuple[PerspectiveGrid, list[bytes]]) -> str:
        scene, camera = jobs.find_by_uid(bpy.data.scenes, scene_uid), jobs.find_by_uid(bpy.data.objects, asked.camera)
        if scene is None or camera is None:
            raise InputError(f"{asked.module} is gone")
        g, files = made
        remove(scene, [camera])
        _build(scene, camera, asked, g, files)
        near, far = g.depths[[0, -1]]
        words = f"{near:.4g} to {far:.4g} mm" if planes > 1 else f"{near:.4g} mm"
        return f"{asked.name!r} as {asked.module} sees it: {planes} layers, {words} from the pinhole"

    return jobs.Job(f"{asked.name} in perspective", work, finish)


def resampling(context: bpy.types.Context, cells: int, uniform: str) -> jobs.Job:
    """The job that takes the active volume through the cells of the active module and back, as a new volume of the scene.

    Raises InputError as `showing`.
    """
    asked, shown = _request(context), _shown_range(context.object)
    rows, columns = asked.views.shape
    voxels = float(np.prod(context.object.mphdrr_volume.shape))
    memory.require(8.0 * cells * rows * columns + 8.0 * voxels, f"{columns} x {rows} x {cells} cells")
    provenance = {"volume": asked.name, "through": asked.module, "cells": [columns, rows, cells], "evenly_in": uniform}

    def make(progress: Progress) -> Volume:
        stages = stages_of(progress)
        volume, g, array = _followed(asked, cells, uniform, stages)
        return on_voxels(array, g, volume, stages("back on voxels"))

    def finish(item: bpy.types.Object, stored: stored_volumes.StoredVolume) -> str:
        item.mphdrr_volume.display_low, item.mphdrr_volume.display_high = shown
        return f"Added {item.name!r}: {volumes.values_text(stored)}"

    name, pose = f"{asked.name} through {asked.module}", volumes.pose_of_object(context.object)
    return volumes.add_volume_job(name, make, name, finish, pose, provenance, context.object.users_collection[0])


def _followed(
    asked: _Request, layers: int, uniform: str, stages: Stages
) -> tuple[Volume, PerspectiveGrid, NDArray[np.float32]]:
    """The volume, the module's cells, and what these see of it."""
    stages("reading the voxels")
    volume = asked.read()
    g = _grid(asked, volume, layers, uniform)
    return volume, g, in_perspective(volume, g, stages("following the rays"))


def in_perspective(volume: Volume, g: PerspectiveGrid, progress: Progress | None = None) -> NDArray[np.float32]:
    """`to_perspective`, keeping density, of a volume of any quantity; outside its grid CT numbers are those of air."""
    outside = outside_value(volume)
    array = volume.array - np.float32(outside) if outside else volume.array
    found = np.asarray(to_perspective(array, g, grid=volume.grid, progress=progress))
    return found + np.float32(outside) if outside else found


def on_voxels(array: NDArray[np.float32], g: PerspectiveGrid, like: Volume, progress: Progress | None = None) -> Volume:
    """The way back from `in_perspective`: `from_perspective`, keeping density, on the voxels of `like`."""
    outside = np.float32(outside_value(like))
    found = np.asarray(from_perspective(array - outside, g, like.grid, progress=progress))
    return Volume(found + outside, like.grid, like.quantity)


def colored(values: NDArray[np.float32], quantity: str, low: float, high: float) -> NDArray[np.uint8]:
    """Colours (…, 4) of values, those of slices; the lower a value in the display range, the more transparent."""
    relative = np.clip((values - low) / max(high - low, 1e-30), 0.0, 1.0)
    colors = np.rint(255 * slices.color_table(quantity)[:, :3]).astype(np.uint8)
    shown = np.empty((*values.shape, 4), np.uint8)
    shown[..., :3] = colors[np.rint(relative * (len(colors) - 1)).astype(np.intp)]
    shown[..., 3] = np.rint(255 * relative**_OPACITY_POWER)
    return shown


def frustums(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The frustums in the scene: their lines, which have the layers as children."""
    homes = objects.collections_named(scene, ids.PERSPECTIVES)
    return sorted((o for home in homes for o in home.objects if _KEY in o), key=lambda o: o.name)


def layers(frustum: bpy.types.Object) -> list[bpy.types.Object]:
    """A frustum's layers, from the pinhole outwards."""
    return sorted(frustum.children, key=lambda layer: layer.name)


def volume_of(frustum: bpy.types.Object) -> str:
    """The name that the volume had of which a frustum was made."""
    return str(json.loads(frustum[_KEY])["volume"])


def changes(scene: bpy.types.Scene, frustum: bpy.types.Object) -> str:
    """What is not any more as it was when a frustum was made, in words; "" where all is."""
    was, camera = json.loads(frustum[_KEY]), frustum.parent
    if camera is None:
        return "its module is gone"
    item = scene.objects.get(was["volume"])
    if not volumes.is_volume(item):
        return f"{was['volume']} is gone"
    try:
        now = _state(scene, item, camera)
    except InputError as error:
        return str(error)
    words = {"voxels": "voxels", "pose": "place", "colors": "colours"}
    found = [text for key, text in words.items() if now[key] != was[key]]
    text = [f"other {' and '.join(found)} of {was['volume']}"] if found else []
    if now["views"] != was["views"]:
        text.append(f"{camera.name} has moved, or has other pixels")
    return "; ".join(text)


def seen_volumes(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """The volumes of frustums that are seen, where these have the colours that the volumes have now."""
    found = []
    for frustum in frustums(scene):
        was, item = json.loads(frustum[_KEY]), scene.objects.get(volume_of(frustum))
        if frustum.visible_get() and volumes.is_volume(item) and was["colors"] == list(_shown_range(item)):
            found.append(item)
    return found


def remove(scene: bpy.types.Scene, modules: list[bpy.types.Object] | None = None) -> int:
    """Remove the frustums of modules (their cameras), or of all, with what belongs to them; returns how many."""
    found = [frustum for frustum in frustums(scene) if modules is None or frustum.parent in modules]
    for frustum in found:
        objects.remove_objects([*frustum.children, frustum])
    objects.remove_empty_collections(scene, ids.PERSPECTIVES)
    return len(found)


def after_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Modules were shown, hidden or deleted: their frustums, too."""
    if not depsgraph.id_type_updated("SCENE") or scene != bpy.context.scene:
        return
    for frustum in frustums(scene):
        hidden = frustum.parent is None or frustum.parent.hide_viewport
        for item in (frustum, *frustum.children):
            objects.change(item, hide_viewport=hidden)


def _request(context: bpy.types.Context) -> _Request:
    item, camera = context.object, selection.active_module(context)
    volumes.require_volume(item)
    if camera is None:
        raise InputError("no module is active: select its camera, or choose it in the Modules panel")
    phantoms.require_current(item)
    views, read = _views(context.scene, camera), volumes.reader(item)
    nearest = _NEAREST * float(np.linalg.norm(views.sources[0]))
    state = _state(context.scene, item, camera)
    return _Request(item.session_uid, camera.session_uid, item.name, camera.name, read, views, nearest, state)


def _views(scene: bpy.types.Scene, camera: bpy.types.Object) -> Views:
    """The view of one module, with the pixels that the Projections panel asks for."""
    collection = scanner.scanner_of(scene, camera)
    if collection is None:
        raise InputError(f"{camera.name!r} is in no scanner of the scene")
    return recipe_views(runs.panel_recipe(scene), scanner.read_module(collection, camera))


def _state(scene: bpy.types.Scene, item: bpy.types.Object, camera: bpy.types.Object) -> dict[str, Any]:
    """What a frustum shows, as JSON holds it."""
    path, pose = volumes.file_and_pose(item)
    views = _views(scene, camera)
    arrays = views.sources, views.detector_centers, views.u_steps, views.v_steps
    return {
        "volume": item.name, "quantity": volumes.quantity_of(item), "voxels": Path(path).name, "pose": pose.tolist(),
        "colors": list(_shown_range(item)),
        "views": [list(views.shape), *(array[0].tolist() for array in arrays)],
    }  # fmt: skip


def _shown_range(item: bpy.types.Object) -> tuple[float, float]:
    return item.mphdrr_volume.display_low, item.mphdrr_volume.display_high


def _display_range(item: bpy.types.Object) -> tuple[float, float]:
    """The values, in the voxels' own unit, that have the first and the last colour."""
    factor = volume_materials.display_unit(volumes.quantity_of(item))[1]
    low, high = _shown_range(item)
    return low / factor, high / factor


def _grid(asked: _Request, volume: Volume, layers: int, uniform: str) -> PerspectiveGrid:
    """The module's cells from where the volume begins, or at least is not too close to the pinhole, to where it ends."""
    begin, end = _depths(asked.views, volume)
    near = max(begin, asked.nearest)
    if not near < end:
        raise InputError(f"{asked.name!r} is not in front of the pinhole of {asked.module}")
    return PerspectiveGrid(asked.views, 0, layers, near, end, uniform.lower())


def _depths(views: Views, volume: Volume) -> tuple[float, float]:
    """Between which depths a volume's voxels are that are not empty, or all of them if none is; mm."""
    normal = np.cross(views.u_steps[0], views.v_steps[0])
    normal *= np.sign(normal @ (views.detector_centers[0] - views.sources[0])) / np.linalg.norm(normal)
    per_step, grid = normal @ volume.grid.affine[:3, :3], volume.grid
    filled = volume.array != outside_value(volume)
    if not filled.any():
        filled = np.ones(grid.shape, bool)
    across = per_step[1] * np.arange(grid.shape[1])[:, None] + per_step[2] * np.arange(grid.shape[2])
    planes = ((n, across[plane]) for n, plane in enumerate(filled) if plane.any())  # one by one, in little memory
    ends = np.array([[n * per_step[0] + found.min(), n * per_step[0] + found.max()] for n, found in planes])
    first = float(normal @ (grid.affine[:3, 3] - views.sources[0]))
    half = 0.5 * float(np.abs(per_step).sum())
    return first + float(ends.min()) - half, first + float(ends.max()) + half


def _build(
    scene: bpy.types.Scene, camera: bpy.types.Object, asked: _Request, g: PerspectiveGrid, files: list[bytes]
) -> None:
    """Put a frustum into the scene: lines around the layers and from the pinhole, and a picture for each layer."""
    home = objects.ensure_collection(scene, ids.PERSPECTIVES)
    to_camera = np.linalg.inv(objects.world_matrix(camera))
    corners = _corners(g) @ to_camera[:3, :3].T + to_camera[:3, 3]  # (n_k, 4, 3)
    name = ids.part_name(camera.name, "perspective")
    frustum = bpy.data.objects.new(name, _lines(name, corners))
    frustum[_KEY] = json.dumps(asked.state)
    frustum.parent, frustum.hide_select, frustum.hide_render = camera, True, True
    frustum.lock_location = frustum.lock_rotation = frustum.lock_scale = (True, True, True)
    home.objects.link(frustum)
    n_v, n_u = g.views.shape
    digits = len(str(len(files)))
    for n, (file, (origin, along_u, _, along_v)) in enumerate(zip(files, corners, strict=True), start=1):
        text = f"{name} layer {n:0{digits}d}"
        picture = images.fill(bpy.data.images.new(text, 1, 1, alpha=True), file)
        layer = objects.picture_empty(text, frustum, picture, "DOUBLE_SIDED")
        layer.empty_display_size = max(n_u, n_v)
        across, up = origin - along_u, along_v - origin  # a picture's columns go against u, as the pinhole sees it
        normal = np.cross(across, up) / np.linalg.norm(np.cross(across, up))
        matrix = affine_matrix(np.column_stack([across / n_u, up / n_v, normal]), (along_u + along_v) / 2)
        layer.hide_select, layer.matrix_basis = True, Matrix(matrix)
        home.objects.link(layer)


def _corners(g: PerspectiveGrid) -> Floats:
    """World points (n_k, 4, 3), mm, around the layers' outermost pixels: from (0, 0) along u, then along v."""
    n_u, n_v, _ = g.shape
    pixels = np.array([[0, 0], [n_u, 0], [n_u, n_v], [0, n_v]]) - 0.5
    return g.to_world([[[*pixel, plane] for pixel in pixels] for plane in g.planes])


def _lines(name: str, corners: Floats) -> bpy.types.Mesh:
    points = [[0.0, 0.0, 0.0], *corners.reshape(-1, 3).tolist()]
    around = [(4 * n + a, 4 * n + a % 4 + 1) for n in range(len(corners)) for a in range(1, 5)]
    last = 4 * len(corners)
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(points, [*around, *((0, last - a) for a in range(4))], [])
    return mesh
