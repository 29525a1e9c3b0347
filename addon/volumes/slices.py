"""Slice planes: three pictures of a volume's voxels, perpendicular to its grid's axes, that move with the object.

Each plane is a mesh object, a child of the volume's, with an image of the slice in the colours of the display range; on a
sheared grid it is a parallelogram. Voxels at the low end of the range are transparent. Planes are named sagittal, coronal
and axial by the world axis closest to their normal.
"""

import itertools
import json
from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from ...core import InputError, Volume
from ..blender import compat, objects
from . import looks, vdb, volume_materials, volumes

_PLANES = ("Sagittal", "Coronal", "Axial")  # perpendicular to world x, y, z
_KEY = "mphdrr_slice"  # custom property: the grid axis to which a plane is perpendicular
_LATTICE = "mphdrr_slice_of"  # custom property: shape and affine of the grid that a plane was made for
_MATERIAL = "mphdrr_material"  # custom property: a plane's own material, with its picture
_GROUP = "mphDRR Slice"  # the node group that draws all slices
_SHADES = 256
# Share of the display range below which activity is transparent on slices; from twice that on it is opaque.
_CLEAR = 0.2
_FRAME = 0.01, (0.75, 0.8, 0.88)  # width of a slice's frame, relative to its sides, and its linear RGB
FRONT = (0.7, -0.5, 0.5)  # direction towards the viewer of a new scene: the volume is cut open on that side

# The volume of which slices were drawn last, with its file: reading it takes longer than everything else.
_last_volume: tuple[Path, Volume] | None = None
# File, index, display range and colours with which each plane's image was painted, by the image's `session_uid`.
_painted: dict[int, tuple[Path, int, float, float, volume_materials.Ramp]] = {}


def add_slices(item: bpy.types.Object, indices: Sequence[int] | None = None) -> list[bpy.types.Object]:
    """Add three planes through the voxel `indices` of a volume, by default its middle one, and return them.

    The planes are in the order of the grid's axes; planes that the volume has already are replaced.
    """
    volumes.require_volume(item)
    volume = _read_volume(item)
    remove_slices(item)
    world = volumes.pose_of_object(item) @ volume.grid.affine
    alignment = np.abs(np.linalg.inv(world[:3, :3]))  # row a: normal of the planes of grid axis a
    alignment /= np.linalg.norm(alignment, axis=1, keepdims=True)
    axes = max(itertools.permutations(range(3)), key=lambda order: sum(alignment[a, w] for a, w in enumerate(order)))
    planes = [_plane(item, volume, axis, _PLANES[axes[axis]]) for axis in range(3)]
    item.mphdrr_volume.slices = indices or [n // 2 for n in volume.grid.shape]  # its update paints the planes
    for screen in bpy.data.screens:
        for area in screen.areas:
            if area.type == "VIEW_3D":
                area.spaces.active.shading.color_type = "TEXTURE"  # the solid viewport's default shows no pictures
    return planes


def remove_slices(item: bpy.types.Object) -> None:
    """Remove a volume's planes, with their meshes, materials and images, and close the cut."""
    for plane in planes_of(item):
        materials, picture = list(plane.data.materials), _image(plane)
        objects.remove_objects([plane])
        objects.remove_unused(materials)
        objects.remove_unused([picture, bpy.data.node_groups.get(_GROUP)])
    looks.apply_look(item, None)


def planes_of(item: bpy.types.Object) -> list[bpy.types.Object]:
    """Return a volume's planes, in the order of the grid's axes."""
    return sorted((child for child in item.children if _KEY in child), key=lambda plane: plane[_KEY])


def active_sliced_volume(context: bpy.types.Context) -> bpy.types.Object | None:
    """Return the active volume if it has planes; also where one of its planes is active."""
    item = context.object
    if item is not None and _KEY in item:
        item = item.parent
    return item if volumes.is_volume(item) and planes_of(item) else None


def slice_track(item: bpy.types.Object, axis: int) -> tuple[Vector, Vector]:
    """Return a front corner of the first plane across a grid axis, and the step to the next plane; in world mm."""
    shape, affine = json.loads(planes_of(item)[0][_LATTICE])  # of any plane: the user may have deleted others
    world = np.array(item.matrix_world) @ affine
    corner = np.where(np.linalg.inv(world)[:3, :3] @ FRONT >= 0, np.array(shape) - 0.5, -0.5)
    corner[axis] = 0.0
    return Vector((world @ [*corner, 1.0])[:3]), Vector(world[:3, axis])


def move_slice(item: bpy.types.Object, axis: int, index: float) -> None:
    """Move the plane across a grid axis to the voxel nearest to an index."""
    settings = item.mphdrr_volume
    voxel = min(max(round(index), 0), settings.shape[axis] - 1)
    if settings.slices[axis] != voxel:
        settings.slices[axis] = voxel


def plane_names(item: bpy.types.Object) -> list[str]:
    """Return the names of a volume's planes, such as "Axial", by grid axis; "" where a plane is missing."""
    by_axis = {plane[_KEY]: plane.name.removeprefix(f"{item.name} ").split(".")[0] for plane in planes_of(item)}
    return [by_axis.get(axis, "") for axis in range(3)]


def look_changed(item: bpy.types.Object) -> None:
    """Draw a volume in a newly chosen look."""
    looks.apply_presets(item)
    if item.mphdrr_volume.look in ("CUT", "BONE") and not planes_of(item):
        try:
            add_slices(item)
        except InputError as error:
            print(f"mphDRR: {item.name} is not cut open: {error}")


def update(item: bpy.types.Object) -> None:
    """Draw a volume, and its planes if it has some, at `VolumeProperties.slices`, in its look and display range."""
    planes, settings = planes_of(item), item.mphdrr_volume
    if not planes:
        looks.apply_look(item, None)
        return
    try:
        volume = _read_volume(item)
    except InputError as error:
        print(f"mphDRR: the slices of {item.name} are not drawn: {error}")
        return
    if any(plane[_LATTICE] != _grid_key(volume) for plane in planes):  # the volume's grid has changed
        add_slices(item)
        return
    normals = np.linalg.inv(volume.grid.affine)  # grid indices from the object's space, mm
    front = np.array(FRONT) @ volumes.pose_of_object(item)[:3, :3]
    cut = []
    for plane in planes:
        axis = plane[_KEY]
        index = min(settings.slices[axis], volume.grid.shape[axis] - 1)
        plane.location = volume.grid.affine[:3, axis] * index
        side = 1.0 if normals[axis, :3] @ front >= 0 else -1.0
        cut.append(((side * normals[axis, :3]).tolist(), float(side * (index - normals[axis, 3]))))
        _paint(item, plane)
    looks.apply_look(item, cut)


def _paint(item: bpy.types.Object, plane: bpy.types.Object) -> None:
    """Paint a plane's image unless it is up to date; raise `InputError` where the voxels' file is missing."""
    settings, axis = item.mphdrr_volume, plane[_KEY]
    image = _image(plane)
    ramp = volume_materials.item_ramp(item)
    state = volumes.file_of(item), settings.slices[axis], settings.display_low, settings.display_high, ramp
    if image is None or _painted.get(image.session_uid) == state:
        return
    array = _read_volume(item).array
    factor = volume_materials.display_unit(settings.quantity)[1]
    low, high = settings.display_low / factor, settings.display_high / factor
    values = np.take(array, min(settings.slices[axis], array.shape[axis] - 1), axis).T
    relative = (values - low) / max(high - low, 1e-30)
    shades = np.clip(relative * (_SHADES - 1), 0, _SHADES - 1).astype(np.uint8)
    image.pixels.foreach_set(color_table(settings.quantity, ramp)[shades].ravel())
    image.update()
    _painted[image.session_uid] = state


def after_undo(*_: object) -> None:
    """Paint the planes anew: Undo and Redo restore them and their settings, but not the pixels of their images."""
    for uid in _painted.keys() - {image.session_uid for image in bpy.data.images}:
        del _painted[uid]
    for plane in [item for item in bpy.data.objects if _KEY in item]:
        if volumes.is_volume(plane.parent):
            try:
                _paint(plane.parent, plane)
            except InputError as error:
                print(f"mphDRR: {plane.name} is not painted: {error}")


def before_load(*_: object) -> None:
    """Forget the present file's volumes and images."""
    global _last_volume
    _last_volume = None
    _painted.clear()


def before_save(*_: object) -> None:
    """Pack the planes' images: Blender does not save painted pixels otherwise."""
    for item in bpy.data.objects:
        if _KEY in item and (image := _image(item)) is not None and image.is_dirty:
            image.pack()


def after_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Update the planes where a look has changed, and hide or show them and surfaces with their volumes."""
    if scene != bpy.context.scene:
        return
    if depsgraph.id_type_updated("MATERIAL") or depsgraph.id_type_updated("NODETREE"):  # a look was replaced or edited
        for item in volumes.volume_objects(scene):
            for plane in planes_of(item):
                _move_look_to_volume(item, plane)
            update(item)
    if not depsgraph.id_type_updated("SCENE"):
        return
    for item in volumes.volume_objects(scene):
        for part in (*planes_of(item), *looks.surfaces_of(item)):
            objects.change(part, hide_viewport=not item.visible_get())


def after_frame_change(scene: bpy.types.Scene, *_: object) -> None:
    """Draw the planes of sequences at the current frame's state."""
    for item in volumes.volume_objects(scene):
        if item.data.is_sequence:
            update(item)


def _image(plane: bpy.types.Object) -> bpy.types.Image | None:
    """Return a plane's picture; None where the user has given it another material."""
    material = next(iter(plane.data.materials), None)
    node = material.node_tree.nodes.get("Slice") if material and material.node_tree else None
    return node.image if node else None


def _move_look_to_volume(item: bpy.types.Object, plane: bpy.types.Object) -> None:
    """Give a look that the user has dropped on a plane to its volume, and the plane its own material again."""
    material, plane_material = next(iter(plane.data.materials), None), plane.get(_MATERIAL)
    if material is not None and plane_material not in (None, material) and volume_materials.is_look(material):
        item.data.materials[0], plane.data.materials[0] = material, plane_material


def _read_volume(item: bpy.types.Object) -> Volume:
    """Return a volume with every voxel, in its object's space; the last one is kept in memory."""
    global _last_volume
    path = volumes.file_of(item)
    if _last_volume is None or _last_volume[0] != path:
        _last_volume = None  # frees the old volume's memory before the new one is read
        _last_volume = path, vdb.read_vdb(path)
    return _last_volume[1]


def _grid_key(volume: Volume) -> str:
    """Return a text that identifies a volume's grid."""
    return json.dumps([volume.grid.shape, volume.grid.affine.tolist()])


def _plane(item: bpy.types.Object, volume: Volume, axis: int, name: str) -> bpy.types.Object:
    """Return a new plane of a volume, perpendicular to a grid axis, at index 0."""
    name = f"{item.name} {name}"
    column, row = (a for a in range(3) if a != axis)
    uv = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    uv = np.concatenate([uv, (1 + 2 * _FRAME[0]) * uv - _FRAME[0]])
    corners = np.zeros((8, 4))
    corners[:, 3] = 1.0
    corners[:, [column, row]] = uv * [volume.grid.shape[column], volume.grid.shape[row]] - 0.5
    mesh, faces = bpy.data.meshes.new(name), [(0, 1, 2, 3), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
    mesh.from_pydata((corners @ volume.grid.affine.T)[:, :3].tolist(), [], faces)
    mesh.uv_layers.new(name="Slice").data.foreach_set("uv", uv[np.ravel(faces)].astype(np.float32).ravel())
    mesh.polygons.foreach_set("material_index", [0, 1, 1, 1, 1])
    image = bpy.data.images.new(name, volume.grid.shape[column], volume.grid.shape[row], alpha=True)
    mesh.materials.append(_material(name, image))
    mesh.materials.append(looks.new_material(name + " frame", (), _FRAME[1]))
    plane = bpy.data.objects.new(name, mesh)
    plane[_KEY], plane[_LATTICE], plane[_MATERIAL] = axis, _grid_key(volume), mesh.materials[0]
    plane.parent = item
    objects.link_beside(plane, item)
    return plane


def _material(name: str, image: bpy.types.Image) -> bpy.types.Material:
    """Return a material that draws a picture by the node group that all slices share."""
    material = compat.blank_material(name)
    tree, settings = material.node_tree, {"image": image, "interpolation": "Closest", "extension": "EXTEND"}
    texture = compat.add_node(tree, "ShaderNodeTexImage", (0.0, 0.0), name="Slice", **settings)
    texture_outputs = {name: texture.outputs[name] for name in ("Color", "Alpha")}
    group = compat.add_node(tree, "ShaderNodeGroup", (300.0, 0.0), texture_outputs, node_tree=_node_group())
    compat.add_node(tree, "ShaderNodeOutputMaterial", (500.0, 0.0), {"Surface": group.outputs[0]})
    return material


def _node_group() -> bpy.types.NodeTree:
    """Return the shader node group for slices: unlit emission, visible from both sides, with opacity."""
    if (tree := bpy.data.node_groups.get(_GROUP)) is not None:
        return tree
    tree = bpy.data.node_groups.new(_GROUP, "ShaderNodeTree")
    tree.interface.new_socket("Color", in_out="INPUT", socket_type="NodeSocketColor")
    for name in ("Alpha", "Strength", "Opacity"):
        tree.interface.new_socket(name, in_out="INPUT", socket_type="NodeSocketFloat").default_value = 1.0
    tree.interface.new_socket("Surface", in_out="OUTPUT", socket_type="NodeSocketShader")
    inputs = compat.add_node(tree, "NodeGroupInput", (0.0, 0.0)).outputs
    emission_inputs = {name: inputs[name] for name in ("Color", "Strength")}
    emission = compat.add_node(tree, "ShaderNodeEmission", (300.0, 0.0), emission_inputs)
    transparent = compat.add_node(tree, "ShaderNodeBsdfTransparent", (300.0, -150.0))
    opacity = compat.add_math(tree, "MULTIPLY", (300.0, 150.0), inputs["Alpha"], inputs["Opacity"])
    shaders = {0: opacity, 1: transparent.outputs[0], 2: emission.outputs[0]}
    mix = compat.add_node(tree, "ShaderNodeMixShader", (500.0, 0.0), shaders)
    compat.add_node(tree, "NodeGroupOutput", (700.0, 0.0), {0: mix.outputs[0]})
    return tree


def color_table(quantity: str, ramp: volume_materials.Ramp | None = None) -> NDArray[np.float32]:
    """Return the colours (256, 4) of the display range, RGBA as an sRGB image holds them; the lowest is transparent.

    Dim activity is transparent, too, so that slices do not hide what is behind them. The colours are interpolated from
    `ramp`, by default from the quantity's.
    """
    positions, ramp_colors = zip(*(ramp or volume_materials.ramp(quantity)), strict=True)
    shades = np.linspace(0, 1, _SHADES)
    rgb = np.stack([np.interp(shades, positions, channel) for channel in np.transpose(ramp_colors)], axis=1)
    srgb = np.where(rgb <= 0.0031308, 12.92 * rgb, 1.055 * rgb ** (1 / 2.4) - 0.055)
    opacity = np.clip((shades - _CLEAR) / _CLEAR, 0, 1) if quantity == "activity" else shades > 0
    return np.column_stack([srgb, opacity]).astype(np.float32)
