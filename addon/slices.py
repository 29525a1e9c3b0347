"""Slice planes: three pictures of a volume's voxels, across its grid's axes, that go with the object.

Each plane is a mesh object, a child of the volume's, with an image of the slice in the colours of the display range; on a
sheared grid it is a parallelogram. Planes are named sagittal, coronal and axial by the world axis closest to their normal.
"""

import itertools
import json
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.volumes.volume import Volume
from . import vdb, volume_materials, volumes
from .cameras import remove_objects
from .compat import enable_nodes

_PLANES = ("Sagittal", "Coronal", "Axial")  # across world x, y, z
_KEY = "mphdrr_slice"  # custom property: the axis of the grid that a plane is across
_LATTICE = "mphdrr_slice_of"  # custom property: shape and affine that the planes were made for
_SHADES = 256

# The volume that slices were last taken of: reading it takes longer than all the rest.
_last: tuple[Path, Volume] | None = None


def add_slices(item: bpy.types.Object) -> list[bpy.types.Object]:
    """Three planes through a volume's middle, in the order of the grid's axes, in place of those that it has."""
    volumes.require_volume(item)
    volume = _stored(item)
    remove_slices(item)
    world = volumes.pose_of_object(item) @ volume.grid.affine
    toward = np.abs(np.linalg.inv(world[:3, :3]))  # row: normal of the plane across that axis of the grid
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    best = max(itertools.permutations(range(3)), key=lambda order: sum(toward[a, w] for a, w in enumerate(order)))
    planes = [_plane(item, volume, axis, _PLANES[best[axis]]) for axis in range(3)]
    item.mphdrr_volume.slices = [n // 2 for n in volume.grid.shape]  # which paints them
    return planes


def remove_slices(item: bpy.types.Object) -> None:
    """Remove a volume's planes, with their meshes, materials and images."""
    for plane in planes_of(item):
        materials = list(plane.data.materials)
        remove_objects([plane])
        for material in materials:
            if material is None or material.users:
                continue
            image = material.node_tree.nodes["Slice"].image
            bpy.data.materials.remove(material)
            if image is not None and image.users == 0:
                bpy.data.images.remove(image)


def planes_of(item: bpy.types.Object) -> list[bpy.types.Object]:
    """A volume's planes, in the order of the grid's axes."""
    return sorted((child for child in item.children if _KEY in child), key=lambda plane: plane[_KEY])


def names(item: bpy.types.Object) -> list[str]:
    """What a volume's planes across each axis of the grid are called."""
    by_axis = {plane[_KEY]: plane.name.removeprefix(f"{item.name} ").split(".")[0] for plane in planes_of(item)}
    return [by_axis.get(axis, "") for axis in range(3)]


def range_changed(item: bpy.types.Object) -> None:
    """Draw a volume and its planes in its display range."""
    volumes.show_range(item)
    update(item)


def update(item: bpy.types.Object) -> None:
    """Draw a volume's planes, if it has some, at `VolumeProperties.slices` and in its display range."""
    planes, settings = planes_of(item), item.mphdrr_volume
    if not planes:
        return
    try:
        volume = _stored(item)
    except InputError as error:
        print(f"mphDRR: the slices of {item.name} are not drawn: {error}")
        return
    if any(plane[_LATTICE] != _lattice(volume) for plane in planes):  # the volume has other voxels now
        add_slices(item)
        return
    for plane in planes:
        axis = plane[_KEY]
        index = min(settings.slices[axis], volume.grid.shape[axis] - 1)
        plane.location = volume.grid.affine[:3, axis] * index
        image = plane.data.materials[0].node_tree.nodes["Slice"].image
        low, high = settings.display_low, settings.display_high
        relative = (np.take(volume.array, index, axis).T - low) / max(high - low, 1e-30)
        shades = np.clip(relative * (_SHADES - 1), 0, _SHADES - 1).astype(np.uint8)
        image.pixels.foreach_set(_colors(settings.quantity)[shades].ravel())
        image.update()


@bpy.app.handlers.persistent
def before_load(*_: object) -> None:
    """Another file has other volumes."""
    global _last
    _last = None


@bpy.app.handlers.persistent
def after_frame_change(scene: bpy.types.Scene, *_: object) -> None:
    """The planes of a sequence show the current frame's state."""
    for item in volumes.volume_objects(scene):
        if item.data.is_sequence:
            update(item)


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
    image = bpy.data.images.new(name, volume.grid.shape[across], volume.grid.shape[up])
    mesh.materials.append(_material(name, image))
    plane = bpy.data.objects.new(name, mesh)
    plane[_KEY], plane[_LATTICE] = axis, _lattice(volume)
    plane.parent = item
    for collection in item.users_collection:
        collection.objects.link(plane)
    return plane


def _material(name: str, image: bpy.types.Image) -> bpy.types.Material:
    """A picture that shines by itself, seen from both sides, in colours that no light changes."""
    material = bpy.data.materials.new(name)
    enable_nodes(material)
    tree = material.node_tree
    tree.nodes.clear()
    texture = tree.nodes.new("ShaderNodeTexImage")
    texture.name, texture.image, texture.interpolation, texture.extension = "Slice", image, "Closest", "EXTEND"
    emission = tree.nodes.new("ShaderNodeEmission")
    emission.location = (300.0, 0.0)
    output = tree.nodes.new("ShaderNodeOutputMaterial")
    output.location = (500.0, 0.0)
    tree.links.new(texture.outputs["Color"], emission.inputs["Color"])
    tree.links.new(emission.outputs[0], output.inputs["Surface"])
    return material


def _colors(quantity: str) -> NDArray[np.float32]:
    """RGBA (256, 4) of the display range, as an sRGB image holds them."""
    positions, colors = zip(*volume_materials.ramp(quantity), strict=True)
    shades = np.linspace(0, 1, _SHADES)
    rgb = np.stack([np.interp(shades, positions, channel) for channel in np.transpose(colors)], axis=1)
    srgb = np.where(rgb <= 0.0031308, 12.92 * rgb, 1.055 * rgb ** (1 / 2.4) - 0.055)
    return np.concatenate([srgb, np.ones((_SHADES, 1))], axis=1).astype(np.float32)
