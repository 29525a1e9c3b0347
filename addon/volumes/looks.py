"""How a volume is drawn: as smoke, or as the surface at a value; whole, or cut open in front of its slices.

The solid viewport knows no materials of volumes and cannot cut their smoke: where a volume has a surface or slices, it draws
none. The surface is a mesh that Blender makes of the voxels that are shown; it goes with the object and with their changes.
"""

from functools import partial

import bpy
from mathutils import Vector

from ...core.physics.ct_numbers import mu_of_hu
from ..blender import compat, objects
from . import vdb, volume_materials, volumes

_KEY = "mphdrr_surface"  # custom property of a surface's object
# Exponent and gain of the extinction; where a surface is drawn, the volume itself is not.
_SMOKE = {"DENSITY": (1.0, 1.0), "BRIGHTEST": (3.0, 0.4)}
_ON_SURFACE = {"SHELL": 0.6, "CUT": 0.1}  # share of the display range
_TISSUES = {  # HU: display range and surface; linear RGB
    "BONE": ((150.0, 1300.0, 250.0), (0.80, 0.68, 0.46)),
    "SOFT": ((-160.0, 240.0, -160.0), (0.72, 0.33, 0.20)),
    "LUNG": ((-1000.0, 150.0, -500.0), (0.62, 0.20, 0.17)),
}
_ENERGY = 140.5  # keV, at which a volume's mu is taken to hold where its file does not say
_FINE = 160  # voxels along a side of a surface, at most


def choose(item: bpy.types.Object) -> None:
    """Set the surface, and of tissues the display range, to where `VolumeProperties.look` has them."""
    settings = item.mphdrr_volume
    remove_surface(item)  # the next has the look's own colour
    if settings.look in _TISSUES and settings.quantity in volume_materials.XRAY:
        numbers, _ = _TISSUES[settings.look]
        if settings.quantity == "mu":
            path = volumes.file_of(item)
            known = vdb.provenance_of(path) if path.is_file() else {}
            numbers = mu_of_hu(numbers, float(known.get("energy_keV", _ENERGY))).tolist()
        settings.display_low, settings.display_high, settings.surface = numbers
        return
    share = _ON_SURFACE.get(settings.look, 0.6)
    settings.surface = settings.display_low + share * (settings.display_high - settings.display_low)


def show(item: bpy.types.Object, cut: volume_materials.Cut | None) -> None:
    """Draw a volume in its look and display range, cut open or whole."""
    settings = item.mphdrr_volume
    factor = volume_materials.shown_unit(settings.quantity)[1]
    low = settings.display_low / factor
    high = max(settings.display_high / factor, low + max(1e-30, 1e-6 * abs(low)))
    exponent, gain = _SMOKE.get(settings.look, (1.0, 0.0))
    for material in filter(None, item.data.materials):
        inputs = {"Low": low, "High": high, "Exponent": exponent, "Gain": gain, "Size": settings.extent}
        volume_materials.set_look(material, settings.quantity, **inputs)
        if material.node_tree is not None:
            volume_materials.set_cut(material.node_tree, cut)
    volume_materials.set_display(item.data, low, high, settings.extent, gain if cut is None else 0.0)
    if gain:
        remove_surface(item)
        return
    surface = surface_of(item) or _new_surface(item)
    objects.change(surface, location=_shift(item))
    made, opened = surface.modifiers
    voxels = "GRID" if max(settings.shape) <= _FINE else "VOXEL_AMOUNT"
    objects.change(made, grid_name=settings.quantity, threshold=settings.surface / factor, resolution_mode=voxels)
    volume_materials.set_cut(opened.node_group, cut)
    objects.change(opened, show_viewport=cut is not None, show_render=cut is not None)


def surface_of(item: bpy.types.Object) -> bpy.types.Object | None:
    """A volume's surface, if it is drawn."""
    return next((child for child in item.children if _KEY in child), None)


def remove_surface(item: bpy.types.Object) -> None:
    """Remove a volume's surface, if it has one, with all that belongs to it."""
    surface = surface_of(item)
    if surface is not None:
        rest = [surface.modifiers[1].node_group, *surface.data.materials]
        objects.remove_objects([surface])
        objects.remove_unused(rest)


def _shift(item: bpy.types.Object) -> Vector:
    """What puts a surface back where the voxels' centres are: Blender makes it where it would draw their files."""
    item.data.grids.load()
    grid = item.data.grids.get(item.mphdrr_volume.quantity)
    if grid is None:  # its file is missing
        return Vector()
    return grid.matrix_object.to_3x3() @ Vector([-compat.VDB_CENTER_SHIFT] * 3)


def _new_surface(item: bpy.types.Object) -> bpy.types.Object:
    name = f"{item.name} surface"
    mesh = bpy.data.meshes.new(name)
    settings = item.mphdrr_volume
    tissue = _TISSUES.get(settings.look) if settings.quantity in volume_materials.XRAY else None
    mesh.materials.append(new_material(name, volume_materials.ramp_of(item, smoke=True), tissue and tissue[1]))
    surface = bpy.data.objects.new(name, mesh)
    surface[_KEY] = True
    surface.parent, surface.hide_select = item, True
    made = surface.modifiers.new("Surface", "VOLUME_TO_MESH")
    made.object, made.use_smooth_shade, made.voxel_amount = item, True, _FINE
    surface.modifiers.new("Cut", "NODES").node_group = _cutting(name)
    objects.link_beside(surface, item)
    return surface


def _cutting(name: str) -> bpy.types.NodeTree:
    """A tree of geometry nodes that leaves out what is cut away."""
    tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    add_node = partial(compat.add_node, tree)
    start = add_node("NodeGroupInput", (200, 0))
    place = add_node("GeometryNodeInputPosition", (-440, -660))
    deleted = {"Geometry": start.outputs[0], "Selection": volume_materials.in_front(tree, place.outputs[0])}
    delete = add_node("GeometryNodeDeleteGeometry", (440, 0), deleted, domain="FACE")
    add_node("NodeGroupOutput", (680, 0), {0: delete.outputs[0]})
    return tree


def new_material(
    name: str, colors: volume_materials.Ramp, rgb: tuple[float, float, float] | None = None
) -> bpy.types.Material:
    """A dull surface in the brighter of some colours, or in a linear colour."""
    material, shader = compat.surface_material(name, "ShaderNodeBsdfPrincipled")
    color = (*(rgb or colors[-2][1]), 1.0)
    material.diffuse_color = color
    shader.inputs["Base Color"].default_value, shader.inputs["Roughness"].default_value = color, 0.6
    return material
