"""Looks of a volume: smoke or an isosurface, whole or cut open in front of its slices.

The solid viewport knows no materials of volumes and cannot cut their smoke: where a volume has a surface or slices, it draws
no smoke. The surface is a mesh that Blender makes of the shown voxels; it follows the object and changes of the voxels.
"""

from functools import partial

import bpy
from mathutils import Vector

from ...core.physics.ct_numbers import mu_of_hu
from ..blender import compat, objects
from . import vdb, volume_materials, volumes

_KEY = "mphdrr_surface"  # custom property of a surface's object: its number among those of its volume, from 1
# Exponent and gain of the extinction; looks without an entry draw a surface instead of smoke.
_SMOKE = {"DENSITY": (1.0, 1.0), "BRIGHTEST": (3.0, 0.4)}
_SURFACE_SHARE = {"SHELL": 0.6, "CUT": 0.1}  # the surface's value as a fraction of the display range
_TISSUES = {  # low and high end of the display range and the surface's value, HU; the surface's linear RGB
    "BONE": ((-160.0, 240.0, 250.0), (0.85, 0.76, 0.58)),
    "SOFT": ((-160.0, 240.0, -160.0), (0.72, 0.42, 0.30)),
    "LUNG": ((-1000.0, 150.0, -190.0), (0.62, 0.20, 0.17)),
}
_ENERGY = 140.5  # keV; assumed for a volume of mu whose file names no energy
_SURFACE_COLOR = 0.9  # place of a surface's colour among those of the ramp: activity is yellow
_MAX_SURFACE_VOXELS = 160  # along each side of the grid from which Blender makes a surface


def apply_presets(item: bpy.types.Object) -> None:
    """Set the value of a volume's surface, and for tissues also its display range, to those of its look."""
    settings = item.mphdrr_volume
    remove_surface(item)  # a new surface gets the look's colour
    if settings.look in _TISSUES and settings.quantity in volume_materials.XRAY:
        numbers, _ = _TISSUES[settings.look]
        if settings.quantity == "mu":
            path = volumes.file_of(item)
            provenance = vdb.read_provenance(path) if path.is_file() else {}
            numbers = mu_of_hu(numbers, float(provenance.get("energy_keV", _ENERGY))).tolist()
        settings.display_low, settings.display_high, settings.surface = numbers
        return
    share = _SURFACE_SHARE.get(settings.look, 0.6)
    settings.surface = settings.display_low + share * (settings.display_high - settings.display_low)


def apply_look(item: bpy.types.Object, cut: volume_materials.Cut | None) -> None:
    """Draw a volume in its look and display range; `cut` leaves out the part in front of its slices."""
    settings = item.mphdrr_volume
    factor = volume_materials.display_unit(settings.quantity)[1]
    low = settings.display_low / factor
    high = max(settings.display_high / factor, low + max(1e-30, 1e-6 * abs(low)))
    exponent, gain = _SMOKE.get(settings.look, (1.0, 0.0))
    for material in filter(None, item.data.materials):
        inputs = {"Low": low, "High": high, "Exponent": exponent, "Gain": gain, "Size": settings.extent}
        volume_materials.set_look_inputs(material, settings.quantity, **inputs)
        if material.node_tree is not None:
            volume_materials.set_cut(material.node_tree, cut)
    volume_materials.set_display(item.data, low, high, settings.extent, gain if cut is None else 0.0)
    if gain:
        remove_surface(item)
        return
    mode = "GRID" if max(settings.shape) <= _MAX_SURFACE_VOXELS else "VOXEL_AMOUNT"
    has_skin = settings.look == "BONE" and settings.quantity in volume_materials.XRAY
    surfaces = surfaces_of(item) or [_new_surface(item, number) for number in ((1, 2) if has_skin else (1,))]
    for surface, value in zip(surfaces, (settings.surface / factor, low), strict=False):
        is_cut = cut is not None and surface == surfaces[-1]  # bones stand whole in the skin
        objects.change(surface, location=_surface_offset(item))
        mesher, cutter = surface.modifiers
        grid, zero = settings.quantity, 0.0
        if value < 0 and vdb.SMOKE in item.data.grids:  # Blender draws no surface of a negative value
            grid, zero = vdb.SMOKE, volume_materials.default_range(grid, 0.0, 1.0)[0]
        objects.change(mesher, grid_name=grid, threshold=value - zero, resolution_mode=mode)
        volume_materials.set_cut(cutter.node_group, cut)
        objects.change(cutter, show_viewport=is_cut, show_render=is_cut)


def surfaces_of(item: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the objects of a volume's surfaces: none of smoke; of bones also the skin, at the display range's low end."""
    return sorted((child for child in item.children if _KEY in child), key=lambda surface: surface[_KEY])


def remove_surface(item: bpy.types.Object) -> None:
    """Remove a volume's surfaces, if it has some, with their meshes, materials and nodes."""
    for surface in surfaces_of(item):
        unused = [surface.modifiers[1].node_group, *surface.data.materials]
        objects.remove_objects([surface])
        objects.remove_unused(unused)


def _surface_offset(item: bpy.types.Object) -> Vector:
    """Return the offset, mm, from where Blender places a surface, that of the drawn voxels, to the voxels' centres."""
    if not item.data.grids.load():  # of a sequence whose frame is not known yet: the error would stay
        item.data.grids.unload()
    if (grid := item.data.grids.get(item.mphdrr_volume.quantity)) is None:  # its file is missing
        return Vector()
    return grid.matrix_object.to_3x3() @ Vector([-compat.VDB_CENTER_SHIFT] * 3)


def _new_surface(item: bpy.types.Object, number: int) -> bpy.types.Object:
    """Return a new surface of a volume: an object with a mesh of the volume and with nodes that cut it."""
    name = f"{item.name} surface"
    mesh = bpy.data.meshes.new(name)
    settings = item.mphdrr_volume
    look = settings.look if number == 1 else "SOFT"
    tissue = _TISSUES.get(look) if settings.quantity in volume_materials.XRAY else None
    mesh.materials.append(new_material(name, volume_materials.item_ramp(item, smoke=True), tissue and tissue[1]))
    surface = bpy.data.objects.new(name, mesh)
    surface[_KEY] = number
    surface.parent, surface.hide_select = item, True
    modifier = surface.modifiers.new("Surface", "VOLUME_TO_MESH")
    modifier.object, modifier.use_smooth_shade, modifier.voxel_amount = item, True, _MAX_SURFACE_VOXELS
    surface.modifiers.new("Cut", "NODES").node_group = _cut_node_tree(name)
    objects.link_beside(surface, item)
    return surface


def _cut_node_tree(name: str) -> bpy.types.NodeTree:
    """Return a tree of geometry nodes that deletes the faces in front of the cut."""
    tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    add_node = partial(compat.add_node, tree)
    start = add_node("NodeGroupInput", (200, 0))
    position = add_node("GeometryNodeInputPosition", (-440, -660))
    selection = {"Geometry": start.outputs[0], "Selection": volume_materials.add_cut_nodes(tree, position.outputs[0])}
    delete = add_node("GeometryNodeDeleteGeometry", (440, 0), selection, domain="FACE")
    add_node("NodeGroupOutput", (680, 0), {0: delete.outputs[0]})
    return tree


def new_material(
    name: str, colors: volume_materials.Ramp, rgb: tuple[float, float, float] | None = None
) -> bpy.types.Material:
    """Return a dull material in the linear colour `rgb`, by default one of the brighter colours of a ramp."""
    material, shader = compat.surface_material(name, "ShaderNodeBsdfPrincipled")
    color = (*(rgb or colors[int(_SURFACE_COLOR * (len(colors) - 1))][1]), 1.0)
    material.diffuse_color = color
    shader.inputs["Base Color"].default_value, shader.inputs["Roughness"].default_value = color, 0.6
    return material
