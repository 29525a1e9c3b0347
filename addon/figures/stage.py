"""Scenes for rendered figures: copies of scanner and volume in a scene of their own, so that the user's stays as it is.

The camera sees the figure's paper behind the scene. Each module can be lit, and fades where it would stand between the
viewer and the isocentre.
"""

from collections.abc import Iterable
from functools import partial

import bpy
import numpy as np
from mathutils import Color, Vector
from numpy.typing import NDArray

from ...core.figures.kinds import FigureKind
from ...core.figures.subject import FigureSubject
from ..blender import compat, ids
from ..scanner import collimators
from ..volumes import meshes
from . import studio
from .surfaces import Surface

Moment = tuple[float, list[int], list[int]]
"""Turn of the camera about the z axis, rad; numbers of the lit modules; numbers of the modules with visible rays."""
Points = NDArray[np.float64]
DIRECTION = np.array(Vector((0.45, -1.0, 0.75)).normalized())
"""Direction from the scanner to the camera."""
_SENSOR_WIDTH = 36.0  # of the camera, mm
_MARGIN = 0.04  # free margin around the scene, relative to the picture's shorter side
# Cosine between the directions to a module and to the camera at which the module begins to fade, and at which it is gone.
_SOLID, _GONE = 0.1, 0.5
_MIN_OPACITY = 0.3  # of a module that is lit alone
_TUBE_RADIUS = 0.0025  # of rays and the ROI's ring, relative to the radius of what is framed
_ACCENT = (0.09, 0.46, 0.62, 1.0)  # linear RGBA of rays and lit modules: a hue that no volume has
_RING = (0.55, 0.60, 0.66, 1.0)  # of the ROI's ring
# Attribute of the surface's colours; its own light, and the share of others' that it sends back.
_COLOR, _SHINE, _DULL = "Color", 0.3, 0.6
# Percentiles of the surface that is framed, and its least radius relative to the ROI's.
_BULK, _LEAST = (5.0, 95.0), 0.2
_ORIGINS = ("collimator", "source")  # parts from which rays begin
_METALLIC_FACTOR = 0.3  # factor on the metallic look of materials, which would mirror the surroundings
_GLOW, _TINT = 0.06, 0.45  # emission strength of lit modules, and share of the accent in their colour
_WORLD = 0.5  # brightness of the surroundings, which metal reflects

_SEGMENTS = 16  # of a ray: the boxes around short ones, by which Cycles finds what it hits, are small
_ANGLES = np.linspace(0.0, 2 * np.pi, 64, endpoint=False)
_SPHERE = np.stack(  # points (N, 3) of a sphere of radius 1
    [
        np.outer(np.cos(_ANGLES), np.sin(_ANGLES / 2)),
        np.outer(np.sin(_ANGLES), np.sin(_ANGLES / 2)),
        np.outer(np.ones(64), np.cos(_ANGLES / 2)),
    ],
    axis=-1,
).reshape(-1, 3)


class FigureScene:
    """Scanner of a subject and volume of an object in a scene of their own, with a camera that frames them on a page."""

    def __init__(
        self, subject: FigureSubject, kind: FigureKind, surface: Surface | None, size: tuple[int, int], paper: str
    ) -> None:
        assert subject.scanner is not None and kind.studio is not None
        self.subject, self.surface, self.size = subject, surface, size
        self.studio, self._motion = view, motion = kind.studio, kind.motion
        self.full_system = subject.scanner
        chosen_system = subject.select_modules(self.full_system)
        if view.lit and subject.modules is None and motion != "light":  # all rays together could not be told apart
            chosen_system = chosen_system[chosen_system.rings() == chosen_system.rings().max() // 2]
        self.numbers: list[int] = chosen_system.numbers.tolist()
        """Numbers of the chosen modules."""
        self.system = self.full_system if view.lit else chosen_system
        self.scene = scene = bpy.data.scenes.new(ids.STUDIO)
        self.radius = self.full_system.region_radius()
        self._materials = dict[tuple[str, bool], bpy.types.Material]()  # by the part's kind, and whether it fades
        self._parts = list[tuple[bpy.types.Object, int, Points]]()  # each with its module's number, and its direction
        try:
            studio.furnish(scene)
            scene.frame_set(bpy.context.scene.frame_current)
            _set_backdrop(scene.world, paper)
            self._add_modules()
            center, extent = np.zeros(3), self.radius
            if surface is not None:
                center, extent = self._add_surface(surface)
            reach = (view.near or 4.0) * extent
            self._near_points, self._tube_radius = center + reach * _SPHERE, _TUBE_RADIUS * reach
            angles = np.linspace(0.0, 2 * np.pi, 240, endpoint=False)
            ring = self.radius * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
            self._add_tubes([ring], _RING, is_closed=True)
            self.rays = self._add_rays() if view.rays else {}
            self.camera = scene.camera = self.add_object(bpy.data.cameras.new(ids.STUDIO))
            self.camera.data.lens, self.camera.data.sensor_width = view.lens, _SENSOR_WIDTH
            self.show(0.0, self.numbers, self.numbers)
        except BaseException:
            self.remove()
            raise

    def add_object(self, data: bpy.types.ID) -> bpy.types.Object:
        """Return a new object in the scene."""
        item = bpy.data.objects.new(ids.STUDIO, data)
        self.scene.collection.objects.link(item)
        return item

    def show(self, turn: float, lit: list[int], rays: list[int]) -> None:
        """Show a moment of the animation: the camera's place, lit modules, rays, and faded modules in the camera's way.

        `turn` is the camera's angle around z, rad; `lit` and `rays` are the numbers of modules that are lit, or whose rays
        are shown.
        """
        cos, sin = np.cos(turn), np.sin(turn)
        direction = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ DIRECTION
        points = self._near_points
        if not self.studio.near:
            points = np.concatenate([self.radius * _SPHERE, *(part.vertices for part in self.full_system.parts())])
        aim_camera(self.camera, direction, self.size, points)
        longer_side = max(self.size)
        distance = float(np.array(self.camera.location) @ direction)
        self.pixels_per_mm = longer_side * self.studio.lens / _SENSOR_WIDTH / distance  # at the isocentre
        self.ray_numbers = rays
        for part, number, outward in self._parts:
            opacity = (
                float(np.clip((_GONE - outward @ direction) / (_GONE - _SOLID), 0.0, 1.0)) if self.studio.cut else 1.0
            )
            if rays == [number]:
                opacity = max(opacity, _MIN_OPACITY)
            part.color = (_TINT * (number in lit and self.studio.lit), 0.0, 0.0, opacity)
            part.hide_render = not opacity
            part.data.materials[0] = self._materials[part["kind"], opacity < 1]
            if number in self.rays and part["kind"] in _ORIGINS:
                self.rays[number].hide_render = number not in rays or not opacity

    def moment(self, fraction: float) -> Moment:
        """Return camera angle, lit modules and modules with rays after a fraction, 0 to 1, of the animation's time."""
        if self._motion == "turn":
            return 2 * np.pi * fraction, self.numbers, self.numbers
        index = int(fraction * len(self.numbers))
        return 0.0, self.numbers[: index + 1], [self.numbers[index]]

    def remove(self) -> None:
        """Remove the scene and everything in it, except the volume's data."""
        scene = self.scene
        items = list(scene.collection.all_objects)
        datablocks = {item.data for item in items if item.type != "VOLUME"}
        materials = {
            m for data in datablocks for m in getattr(data, "materials", ()) if m and m.name.startswith(ids.STUDIO)
        }
        materials.update(self._materials.values())
        collections, world = list(scene.collection.children), scene.world
        bpy.data.scenes.remove(scene)
        bpy.data.batch_remove([*items, *datablocks, *materials, *collections, *filter(None, [world])])

    def _add_modules(self) -> None:
        """Add the parts of all modules, and the materials of whole and of fading parts."""
        for part in self.system.parts(self.subject.construction):
            if (part.kind, True) not in self._materials:
                self._materials |= {
                    (part.kind, fades): _figure_material(part.kind.upper(), fades) for fades in (False, True)
                }
            mesh = bpy.data.meshes.new(ids.STUDIO)
            collimators.reshape_mesh(mesh, (part.vertices, part.solid[1]))
            mesh.materials.append(None)
            item = self.add_object(mesh)
            item["kind"] = part.kind
            center = part.vertices.mean(axis=0)
            self._parts.append((item, part.number, center / max(float(np.linalg.norm(center)), 1e-9)))

    def _add_surface(self, surface: Surface) -> tuple[Points, float]:
        """Add the volume's surface, and return its centre and the radius, mm, within which nearly all of it lies."""
        item = meshes.add_mesh(surface.mesh, ids.STUDIO, np.eye(4), self.scene.collection)
        colors = np.column_stack([surface.colors / 255, np.ones(len(surface.colors))]).astype(np.float32)
        item.data.attributes.new(_COLOR, "BYTE_COLOR", "POINT").data.foreach_set("color_srgb", colors.ravel())
        material, shader = compat.surface_material(ids.STUDIO, "ShaderNodeBsdfPrincipled")
        color = compat.add_node(material.node_tree, "ShaderNodeAttribute", (-300, 0), attribute_name=_COLOR).outputs[
            "Color"
        ]
        dulled = compat.add_node(
            material.node_tree, "ShaderNodeVectorMath", (-150, 0), {0: color, "Scale": _DULL}, operation="SCALE"
        )
        material.node_tree.links.new(dulled.outputs[0], shader.inputs["Base Color"])
        material.node_tree.links.new(color, shader.inputs["Emission Color"])
        shader.inputs["Emission Strength"].default_value, shader.inputs["Roughness"].default_value = _SHINE, 0.45
        item.data.materials.append(material)
        low, high = np.percentile(surface.mesh.vertices, _BULK, axis=0)
        center = (low + high) / 2
        distances = np.linalg.norm(surface.mesh.vertices - center, axis=1)
        return center, max(float(np.percentile(distances, _BULK[1])), _LEAST * self.radius)

    def _add_rays(self) -> dict[int, bpy.types.Object]:
        """Return the principal rays by module number: thin shining tubes from each pinhole to the isocentre."""
        centers = self.system.poses()[:, :3, 3]
        return dict(
            zip(
                self.system.numbers.tolist(),
                self._add_tubes(np.linspace(centers, 0 * centers, _SEGMENTS, axis=1), _ACCENT),
                strict=True,
            )
        )

    def _add_tubes(
        self, lines: Iterable[Points], color: tuple[float, ...], is_closed: bool = False
    ) -> list[bpy.types.Object]:
        """Return thin shining tubes along lines of points (N, 3), mm, which cast no shadows."""
        material, emission = compat.surface_material(ids.STUDIO, "ShaderNodeEmission")
        emission.inputs["Color"].default_value, tubes = color, []
        for line in lines:
            curve = bpy.data.curves.new(ids.STUDIO, "CURVE")
            curve.dimensions, curve.bevel_depth, curve.bevel_resolution = "3D", self._tube_radius, 1
            spline = curve.splines.new("POLY")
            spline.points.add(len(line) - 1)
            spline.points.foreach_set("co", np.column_stack([line, np.ones(len(line))]).ravel())
            spline.use_cyclic_u = is_closed
            curve.materials.append(material)
            tubes.append(self.add_object(curve))
            tubes[-1].visible_shadow = False
        return tubes


def aim_camera(camera: bpy.types.Object, direction: Points, size: tuple[int, int], points: Points) -> None:
    """Place a camera in a direction so that points (N, 3) just fit a picture of `size`, pixels, with even margins."""
    turn = (-Vector(direction)).to_track_quat("-Z", "Y")
    right, up, back = np.array(turn.to_matrix()).T
    per_pixel = _SENSOR_WIDTH / camera.data.lens / max(size)  # tangent of the angle of a pixel
    half_width, half_height = per_pixel * (np.array(size) / 2 - _MARGIN * min(size))
    depth = -points @ back
    x, y = points @ right, points @ up
    # Seen from (cx, cy) at a distance d, a point is inside if x - cx <= half_width (depth + d), and so on for each side.
    x_high, x_low = np.max(x - half_width * depth), np.max(-x - half_width * depth)
    y_high, y_low = np.max(y - half_height * depth), np.max(-y - half_height * depth)
    distance = max((x_high + x_low) / (2 * half_width), (y_high + y_low) / (2 * half_height))
    cx, cy = (x_high - x_low) / 2, (y_high - y_low) / 2
    for _ in range(10):  # centre the points where one direction leaves room
        view_x, view_y = (x - cx) / (depth + distance), (y - cy) / (depth + distance)
        cx += distance * (view_x.max() + view_x.min()) / 2
        cy += distance * (view_y.max() + view_y.min()) / 2
    camera.location = cx * right + cy * up + distance * back
    camera.rotation_mode, camera.rotation_quaternion = "QUATERNION", turn
    camera.data.clip_start, camera.data.clip_end = 0.01 * distance, 10.0 * distance


def _set_backdrop(world: bpy.types.World, paper: str) -> None:
    """Make the camera see paper behind the scene, and metal reflect surroundings that are brighter."""
    compat.use_nodes(world)
    tree = world.node_tree
    tree.nodes.clear()
    add_node, rgb = partial(compat.add_node, tree), bytes.fromhex(paper.removeprefix("#"))
    color = [*Color([n / 255 for n in rgb]).from_srgb_to_scene_linear(), 1.0]
    light = add_node("ShaderNodeBackground", (0, 0), {"Color": [*[_WORLD] * 3, 1.0]})
    paper_light = add_node("ShaderNodeBackground", (0, -150), {"Color": color})
    is_camera_ray = add_node("ShaderNodeLightPath", (0, 350)).outputs["Is Camera Ray"]
    mix = add_node("ShaderNodeMixShader", (250, 0), {0: is_camera_ray, 1: light.outputs[0], 2: paper_light.outputs[0]})
    add_node("ShaderNodeOutputWorld", (450, 0), {"Surface": mix.outputs[0]})


def _figure_material(part: str, fades: bool) -> bpy.types.Material:
    """Return a copy of a part's material that follows its object's colour: red is the tint by the accent, alpha the opacity.

    Only that of parts that `fades` is transparent, since light takes long through what may be.
    """
    material = collimators.part_material(part).copy()
    material.name, tree = ids.STUDIO, material.node_tree
    output = tree and tree.get_output_node("CYCLES")
    if output is None or not output.inputs["Surface"].links:  # a material of the user's own
        return material
    add_node, surface = partial(compat.add_node, tree), output.inputs["Surface"]
    info = add_node("ShaderNodeObjectInfo", (400, 300)).outputs
    tint = add_node("ShaderNodeSeparateColor", (600, 300), {0: info["Color"]}).outputs[0]
    tint_inputs = {"Base Color": _ACCENT, "Roughness": 0.5, "Emission Color": _ACCENT, "Emission Strength": _GLOW}
    accent = add_node("ShaderNodeBsdfPrincipled", (600, -200), tint_inputs).outputs[0]
    if principled := next((node for node in tree.nodes if node.type == "BSDF_PRINCIPLED"), None):
        principled.inputs["Metallic"].default_value *= _METALLIC_FACTOR  # metal would mirror the surroundings
    shader = add_node("ShaderNodeMixShader", (800, 0), {0: tint, 1: surface.links[0].from_socket, 2: accent}).outputs[0]
    if fades:
        clear = add_node("ShaderNodeBsdfTransparent", (800, 200)).outputs[0]
        shader = add_node("ShaderNodeMixShader", (1000, 0), {0: info["Alpha"], 1: clear, 2: shader}).outputs[0]
    tree.links.new(shader, surface)
    return material
