"""Slice planes: three pictures of a volume's voxels, across its grid's axes, that go with the object.

Each plane is a mesh object, a child of the volume's, with an image of the slice in the colours of the display range; on a
sheared grid it is a parallelogram. Where nothing is shown, it is transparent. Planes are named sagittal, coronal and axial
by the world axis closest to their normal.
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

_PLANES = ("Sagittal", "Coronal", "Axial")  # across world x, y, z
_KEY = "mphdrr_slice"  # custom property: the axis of the grid that a plane is across
_LATTICE = "mphdrr_slice_of"  # custom property: shape and affine that the planes were made for
_MATERIAL = "mphdrr_material"  # custom property: a plane's own material, with its picture
_GROUP = "mphDRR Slice"  # of nodes, which draws all slices
_SHADES = 256
_FRONT = (0.7, -0.5, 0.5)  # direction from which a scene is looked at first: the volume is cut open on that side

# The volume that slices were last taken of: reading it takes longer than all the rest.
_last: tuple[Path, Volume] | None = None
# By the session's number of a plane's image: the file, index and display range that it was painted of.
_painted: dict[int, tuple[Path, int, float, float, volume_materials.Ramp]] = {}


def add_slices(item: bpy.types.Object, at: Sequence[int] | None = None) -> list[bpy.types.Object]:
    """Three planes through a volume's voxel `at`, by default its middle one, in place of those that it has.

    They are in the order of the grid's axes.
    """
    volumes.require_volume(item)
    volume = _stored(item)
    remove_slices(item)
    world = volumes.pose_of_object(item) @ volume.grid.affine
    toward = np.abs(np.linalg.inv(world[:3, :3]))  # row: normal of the plane across that axis of the grid
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    best = max(itertools.permutations(range(3)), key=lambda order: sum(toward[a, w] for a, w in enumerate(order)))
    planes = [_plane(item, volume, axis, _PLANES[best[axis]]) for axis in range(3)]
    item.mphdrr_volume.slices = at or [n // 2 for n in volume.grid.shape]  # which paints them
    for screen in bpy.data.screens:
        for area in screen.areas:
            if area.type == "VIEW_3D":
                area.spaces.active.shading.color_type = "TEXTURE"  # the solid viewport's default shows no pictures
    return planes


def remove_slices(item: bpy.types.Object) -> None:
    """Remove a volume's planes, with their meshes, materials and images; the volume is whole again."""
    for plane in planes_of(item):
        materials = list(plane.data.materials)
        trees = [material.node_tree for material in materials if material and material.node_tree]
        pictures = [tree.nodes["Slice"].image for tree in trees if "Slice" in tree.nodes]
        objects.remove_objects([plane])
        objects.remove_unused(materials)
        objects.remove_unused([*pictures, bpy.data.node_groups.get(_GROUP)])
    looks.show(item, None)


def planes_of(item: bpy.types.Object) -> list[bpy.types.Object]:
    """A volume's planes, in the order of the grid's axes."""
    return sorted((child for child in item.children if _KEY in child), key=lambda plane: plane[_KEY])


def sliced(context: bpy.types.Context) -> bpy.types.Object | None:
    """The active volume, if it has planes; also where one of them is active."""
    item = context.object
    if item is not None and _KEY in item:
        item = item.parent
    return item if volumes.is_volume(item) and planes_of(item) else None


def way(item: bpy.types.Object, axis: int) -> tuple[Vector, Vector]:
    """Along which a plane moves: a corner, in front, of the first plane across an axis, and the step to the next, mm."""
    shape, affine = json.loads(planes_of(item)[0][_LATTICE])  # the same of all; the user may have deleted one
    world = np.array(item.matrix_world) @ affine
    corner = np.where(np.linalg.inv(world)[:3, :3] @ _FRONT >= 0, np.array(shape) - 0.5, -0.5)
    corner[axis] = 0.0
    return Vector((world @ [*corner, 1.0])[:3]), Vector(world[:3, axis])


def move(item: bpy.types.Object, axis: int, index: float) -> None:
    """Move a plane to the voxel nearest to an index, if it is not there yet."""
    settings = item.mphdrr_volume
    nearest = min(max(round(index), 0), settings.shape[axis] - 1)
    if settings.slices[axis] != nearest:
        settings.slices[axis] = nearest


def names(item: bpy.types.Object) -> list[str]:
    """What a volume's planes across each axis of the grid are called."""
    by_axis = {plane[_KEY]: plane.name.removeprefix(f"{item.name} ").split(".")[0] for plane in planes_of(item)}
    return [by_axis.get(axis, "") for axis in range(3)]


def look_changed(item: bpy.types.Object) -> None:
    """Draw a volume in the look that was chosen."""
    looks.choose(item)
    if item.mphdrr_volume.look == "CUT" and not planes_of(item):
        try:
            add_slices(item)
        except InputError as error:
            print(f"mphDRR: {item.name} is not cut open: {error}")


def update(item: bpy.types.Object) -> None:
    """Draw a volume, and its planes if it has some: at `VolumeProperties.slices`, in its look and display range."""
    planes, settings = planes_of(item), item.mphdrr_volume
    if not planes:
        looks.show(item, None)
        return
    try:
        volume = _stored(item)
    except InputError as error:
        print(f"mphDRR: the slices of {item.name} are not drawn: {error}")
        return
    if any(plane[_LATTICE] != _lattice(volume) for plane in planes):  # the volume has other voxels now
        add_slices(item)
        return
    normals = np.linalg.inv(volume.grid.affine)  # rows: from the object's space to the grid's indices
    front = np.array(_FRONT) @ volumes.pose_of_object(item)[:3, :3]
    cut = []
    for plane in planes:
        axis = plane[_KEY]
        index = min(settings.slices[axis], volume.grid.shape[axis] - 1)
        plane.location = volume.grid.affine[:3, axis] * index
        side = 1.0 if normals[axis, :3] @ front >= 0 else -1.0
        cut.append(((side * normals[axis, :3]).tolist(), float(side * (index - normals[axis, 3]))))
        _paint(item, plane)
    looks.show(item, cut)


def _paint(item: bpy.types.Object, plane: bpy.types.Object) -> None:
    """Paint a plane's image, unless it is so; raises InputError where the voxels' file is missing."""
    settings, axis = item.mphdrr_volume, plane[_KEY]
    image = _image(plane)
    ramp = volume_materials.ramp_of(item)
    wanted = volumes.file_of(item), settings.slices[axis], settings.display_low, settings.display_high, ramp
    if image is None or _painted.get(image.session_uid) == wanted:
        return
    array = _stored(item).array
    factor = volume_materials.shown_unit(settings.quantity)[1]
    low, high = settings.display_low / factor, settings.display_high / factor
    relative = (np.take(array, min(settings.slices[axis], array.shape[axis] - 1), axis).T - low) / max(
        high - low, 1e-30
    )
    shades = np.clip(relative * (_SHADES - 1), 0, _SHADES - 1).astype(np.uint8)
    image.pixels.foreach_set(colors(settings.quantity, ramp)[shades].ravel())
    image.update()
    _painted[image.session_uid] = wanted


def after_undo(*_: object) -> None:
    """Undo and redo restore planes and their settings, but not what was painted."""
    for gone in _painted.keys() - {image.session_uid for image in bpy.data.images}:
        del _painted[gone]
    for plane in [item for item in bpy.data.objects if _KEY in item]:
        if volumes.is_volume(plane.parent):
            try:
                _paint(plane.parent, plane)
            except InputError as error:
                print(f"mphDRR: {plane.name} is not painted: {error}")


def before_load(*_: object) -> None:
    """Another file has other volumes."""
    global _last
    _last = None
    _painted.clear()


def before_save(*_: object) -> None:
    """Pack the planes' images: Blender does not save what was painted."""
    for item in bpy.data.objects:
        if _KEY in item:
            image = _image(item)
            if image is not None and image.is_dirty:
                image.pack()


def after_update(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Volumes were hidden or shown: their planes, too."""
    if scene != bpy.context.scene:
        return
    if depsgraph.id_type_updated("MATERIAL") or depsgraph.id_type_updated("NODETREE"):  # another look, or an edited one
        for item in volumes.volume_objects(scene):
            for plane in planes_of(item):
                _pass_on(item, plane)
            update(item)
    if not depsgraph.id_type_updated("SCENE"):
        return
    for item in volumes.volume_objects(scene):
        for plane in planes_of(item):
            objects.change(plane, hide_viewport=not item.visible_get())


def after_frame_change(scene: bpy.types.Scene, *_: object) -> None:
    """The planes of a sequence show the current frame's state."""
    for item in volumes.volume_objects(scene):
        if item.data.is_sequence:
            update(item)


def _image(plane: bpy.types.Object) -> bpy.types.Image | None:
    """A plane's picture; None where the user has given it another material."""
    material = next(iter(plane.data.materials), None)
    node = material.node_tree.nodes.get("Slice") if material and material.node_tree else None
    return node.image if node else None


def _pass_on(item: bpy.types.Object, plane: bpy.types.Object) -> None:
    """Give a look that was dropped on a plane to its volume, and the plane its own material again."""
    material, own = next(iter(plane.data.materials), None), plane.get(_MATERIAL)
    if material is not None and own not in (None, material) and volume_materials.is_look(material):
        item.data.materials[0], plane.data.materials[0] = material, own


def _stored(item: bpy.types.Object) -> Volume:
    """Every voxel of an object, in its own space."""
    global _last
    path = volumes.file_of(item)
    if _last is None or _last[0] != path:
        _last = None  # frees the other one's memory first
        _last = path, vdb.read_vdb(path)
    return _last[1]


def _lattice(volume: Volume) -> str:
    return json.dumps([volume.grid.shape, volume.grid.affine.tolist()])


def _plane(item: bpy.types.Object, volume: Volume, axis: int, name: str) -> bpy.types.Object:
    name = f"{item.name} {name}"
    across, up = (a for a in range(3) if a != axis)
    corners = np.zeros((4, 4))
    corners[:, 3] = 1.0
    uv = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0))
    corners[:, [across, up]] = np.array(uv) * [volume.grid.shape[across], volume.grid.shape[up]] - 0.5
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata((corners @ volume.grid.affine.T)[:, :3].tolist(), [], [(0, 1, 2, 3)])
    mesh.uv_layers.new(name="Slice").data.foreach_set("uv", np.array(uv, np.float32).ravel())
    image = bpy.data.images.new(name, volume.grid.shape[across], volume.grid.shape[up], alpha=True)
    mesh.materials.append(_material(name, image))
    plane = bpy.data.objects.new(name, mesh)
    plane[_KEY], plane[_LATTICE], plane[_MATERIAL] = axis, _lattice(volume), mesh.materials[0]
    plane.parent = item
    objects.link_beside(plane, item)
    return plane


def _material(name: str, image: bpy.types.Image) -> bpy.types.Material:
    """A picture drawn by the group of nodes that all slices share."""
    material = compat.blank_material(name)
    tree, shown = material.node_tree, {"image": image, "interpolation": "Closest", "extension": "EXTEND"}
    texture = compat.add_node(tree, "ShaderNodeTexImage", (0.0, 0.0), name="Slice", **shown)
    given = {name: texture.outputs[name] for name in ("Color", "Alpha")}
    drawn = compat.add_node(tree, "ShaderNodeGroup", (300.0, 0.0), given, node_tree=_group())
    compat.add_node(tree, "ShaderNodeOutputMaterial", (500.0, 0.0), {"Surface": drawn.outputs[0]})
    return material


def _group() -> bpy.types.NodeTree:
    """What makes a picture shine by itself, seen from both sides, in colours that no light changes."""
    if (tree := bpy.data.node_groups.get(_GROUP)) is not None:
        return tree
    tree = bpy.data.node_groups.new(_GROUP, "ShaderNodeTree")
    tree.interface.new_socket("Color", in_out="INPUT", socket_type="NodeSocketColor")
    for name in ("Alpha", "Strength", "Opacity"):
        tree.interface.new_socket(name, in_out="INPUT", socket_type="NodeSocketFloat").default_value = 1.0
    tree.interface.new_socket("Surface", in_out="OUTPUT", socket_type="NodeSocketShader")
    given = compat.add_node(tree, "NodeGroupInput", (0.0, 0.0)).outputs
    shining = {name: given[name] for name in ("Color", "Strength")}
    emission = compat.add_node(tree, "ShaderNodeEmission", (300.0, 0.0), shining)
    nothing = compat.add_node(tree, "ShaderNodeBsdfTransparent", (300.0, -150.0))
    seen = compat.add_math(tree, "MULTIPLY", (300.0, 150.0), given["Alpha"], given["Opacity"])
    mixed = {0: seen, 1: nothing.outputs[0], 2: emission.outputs[0]}
    mix = compat.add_node(tree, "ShaderNodeMixShader", (500.0, 0.0), mixed)
    compat.add_node(tree, "NodeGroupOutput", (700.0, 0.0), {0: mix.outputs[0]})
    return tree


def colors(quantity: str, ramp: volume_materials.Ramp | None = None) -> NDArray[np.float32]:
    """RGBA (256, 4) of the display range, as an sRGB image holds them, of a ramp or else the quantity's; the lowest is
    transparent.
    """
    positions, colors = zip(*(ramp or volume_materials.ramp(quantity)), strict=True)
    shades = np.linspace(0, 1, _SHADES)
    rgb = np.stack([np.interp(shades, positions, channel) for channel in np.transpose(colors)], axis=1)
    srgb = np.where(rgb <= 0.0031308, 12.92 * rgb, 1.055 * rgb ** (1 / 2.4) - 0.055)
    return np.column_stack([srgb, np.arange(_SHADES) > 0]).astype(np.float32)
