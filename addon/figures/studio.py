"""Studio light, for pictures and the user's scene: three suns that show the shapes of modules, and a dim world."""

import bpy
from mathutils import Vector

from ..blender import ids, objects

# Direction from which each sun shines, its strength, W/m^2, and its angular size, rad: soft shadows.
_SUNS = (((-0.5, -1.8, 2.6), 0.8, 0.6), ((2.4, -0.4, 0.8), 0.9, 0.8), ((-0.8, 1.6, 1.6), 0.9, 0.6))
_WORLD = (0.055, 0.06, 0.07)
_PLACE = 600.0  # mm from the isocentre to a sun's icon; it shines from everywhere alike
_STARTUP = ("Light", "POINT")  # name and type of the lamp of Blender's own startup file, a few mm from the isocentre


def light(scene: bpy.types.Scene) -> None:
    """Give a scene studio light, unless it has light of the user's own; a world only where it has none."""
    lamps = [item for item in scene.objects if item.type == "LIGHT"]
    if all((item.name, item.data.type) == _STARTUP for item in lamps):
        furnish(scene)


def furnish(scene: bpy.types.Scene) -> None:
    """Put the suns into a scene, in a collection that can be hidden or deleted; and a world where there is none."""
    home = objects.ensure_collection(scene, ids.STUDIO)
    for direction, strength, angle in _SUNS:
        sun = bpy.data.lights.new(ids.STUDIO, "SUN")
        sun.energy, sun.angle = strength, angle
        home.objects.link(aimed(sun, Vector(), _PLACE * Vector(direction).normalized()))
    if scene.world is None:
        world = scene.world = bpy.data.worlds.new(ids.STUDIO)
        world.color = _WORLD
        if world.node_tree is not None:  # from Blender 5 on; then it counts
            world.node_tree.nodes["Background"].inputs["Color"].default_value = (*_WORLD, 1.0)


def aimed(data: bpy.types.ID, target: Vector, place: Vector) -> bpy.types.Object:
    """A new object for a light or camera at a place, looking at another."""
    item = bpy.data.objects.new(data.name, data)
    item.location = place
    item.rotation_mode = "QUATERNION"
    item.rotation_quaternion = (target - place).to_track_quat("-Z", "Y")
    return item
