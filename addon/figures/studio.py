"""Studio light for pictures and the user's scene: three suns that show the shapes of modules, and a dim world."""

import bpy
from mathutils import Vector

from ..blender import ids, objects

# Direction from which each sun shines, its strength, W/m^2, and its angular size, rad, for soft shadows.
_SUNS = (((-0.5, -1.8, 2.6), 0.8, 0.6), ((2.4, -0.4, 0.8), 0.9, 0.8), ((-0.8, 1.6, 1.6), 0.9, 0.6))
_WORLD = (0.055, 0.06, 0.07)
_SUN_DISTANCE = 600.0  # mm from the isocentre to a sun's icon; its light does not depend on the distance
_STARTUP = ("Light", "POINT")  # name and type of the lamp of Blender's own startup file, a few mm from the isocentre


def light(scene: bpy.types.Scene) -> None:
    """Add studio light to a scene without light of the user's own, and a world where there is none."""
    lamps = [item for item in scene.objects if item.type == "LIGHT"]
    if all((item.name, item.data.type) == _STARTUP for item in lamps):
        furnish(scene)


def furnish(scene: bpy.types.Scene) -> None:
    """Add the suns to a scene, in a collection that can be hidden or deleted, and a world where there is none."""
    collection = objects.ensure_collection(scene, ids.STUDIO)
    for direction, strength, angle in _SUNS:
        sun = bpy.data.lights.new(ids.STUDIO, "SUN")
        sun.energy, sun.angle = strength, angle
        collection.objects.link(new_aimed_object(sun, Vector(), _SUN_DISTANCE * Vector(direction).normalized()))
    if scene.world is None:
        world = scene.world = bpy.data.worlds.new(ids.STUDIO)
        world.color = _WORLD
        if world.node_tree is not None:  # in Blender 5, which renders these nodes and not `color`
            world.node_tree.nodes["Background"].inputs["Color"].default_value = (*_WORLD, 1.0)


def new_aimed_object(data: bpy.types.ID, target: Vector, position: Vector) -> bpy.types.Object:
    """Return a new object for a light or camera at a position, looking at a target."""
    item = bpy.data.objects.new(data.name, data)
    item.location = position
    item.rotation_mode = "QUATERNION"
    item.rotation_quaternion = (target - position).to_track_quat("-Z", "Y")
    return item
