"""Scenes for rendered figures: copies of scanner and volume in a scene of their own, so that the user's stays as it is.

The camera sees the figure's paper behind the scene. Each module can be lit, and fades where it would stand between the
viewer and the isocentre.
"""

from functools import partial

import bpy
import numpy as np
from mathutils import Color, Vector
from numpy.typing import NDArray

from ...core.figures.kinds import FigureKind
from ...core.figures.page import Page
from ...core.figures.subject import FigureSubject
from ...core.volumes.meshes.mesh import Mesh
from ..blender import compat, ids
from ..scanner import collimators
from ..volumes import looks, meshes, volume_materials
from . import studio

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
_RAY_RADIUS = 0.006  # relative to the ROI's radius
_ACCENT = (1.0, 0.40, 0.03, 1.0)  # linear RGBA of rays and lit modules
_METALLIC_FACTOR = 0.3  # factor on the metallic look of materials, which would mirror the surroundings
_GLOW, _TINT = 0.3, 0.8  # emission strength of lit modules, and share of the accent in their colour
_WORLD = 0.9  # brightness of the surroundings, which metal reflects

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
        self, subject: FigureSubject, kind: FigureKind, item: bpy.types.Object | None, page: Page, top: int
    ) -> None:
        assert subject.scanner is not None and kind.studio is not None
        self.subject, self.item, self.page, self.top = subject, item, page, top
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
        self.volume_objects: list[bpy.types.Object] = []
        self._meshes = list[tuple[bpy.types.Mesh, NDArray[np.intp]]]()  # each with the index of every face's module
        try:
            studio.furnish(scene)
            scene.frame_set(bpy.context.scene.frame_current)
            _set_backdrop(scene.world, page.paper)
            self._add_modules()
            roi = self.add_object(collimators.new_sphere(ids.STUDIO, self.radius, collimators.part_material("ROI")))
            roi.visible_shadow = False
            if view.volume and item is not None:
                self._add_volume(item)
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
        points = (self.studio.near or 1.0) * self.radius * _SPHERE
        if not self.studio.near:
            points = np.concatenate([points, *(part.vertices for part in self.full_system.parts())])
        aim_camera(self.camera, direction, self.page, points, self.top)
        longer_side = max(self.page.width, self.page.height)
        distance = float(np.array(self.camera.location) @ direction)
        self.pixels_per_mm = longer_side * self.studio.lens / _SENSOR_WIDTH / distance  # at the isocentre
        numbers, self.ray_numbers = self.system.numbers, rays
        facing = -self.system.frames()[:, 2] @ direction
        fades = np.clip((_GONE - facing) / (_GONE - _SOLID), 0.0, 1.0)
        opacities = fades if self.studio.cut else np.ones(len(numbers))
        opacities = np.maximum(opacities, _MIN_OPACITY * np.isin(numbers, rays) * (len(rays) == 1))
        attribute_values = {"lit": _TINT * np.isin(numbers, lit) * self.studio.lit, "opacity": opacities}
        for mesh, face_modules in self._meshes:
            for name, module_values in attribute_values.items():
                mesh.attributes[name].data.foreach_set("value", module_values[face_modules].astype(np.float32))
            mesh.update()
        for number, opacity in zip(numbers.tolist(), opacities, strict=True):
            if number in self.rays:
                self.rays[number].hide_render = number not in rays or not opacity

    def moment(self, fraction: float) -> Moment:
        """Return camera angle, lit modules and modules with rays after a fraction, 0 to 1, of the animation's time."""
        if self._motion == "turn":
            return 2 * np.pi * fraction, self.numbers, self.numbers
        index = int(fraction * len(self.numbers))
        return 0.0, self.numbers[: index + 1], [self.numbers[index]]

    def draw_surface(self, mesh: Mesh, colors: volume_materials.Ramp) -> None:
        """Draw a mesh in the place of the volume."""
        for part in self.volume_objects:
            part.hide_render = True
        surface = meshes.add_mesh(mesh, ids.STUDIO, np.eye(4), self.scene.collection)
        surface.data.materials.append(looks.new_material(ids.STUDIO, colors))
        self.volume_objects = [surface]

    def remove(self) -> None:
        """Remove the scene and everything in it, except the volume's data."""
        scene = self.scene
        items = list(scene.collection.all_objects)
        datablocks = {item.data for item in items if item.type != "VOLUME"}
        materials = {m for data in datablocks for m in getattr(data, "materials", ()) if m.name.startswith(ids.STUDIO)}
        collections, world = list(scene.collection.children), scene.world
        bpy.data.scenes.remove(scene)
        bpy.data.batch_remove([*items, *datablocks, *materials, *collections, *filter(None, [world])])

    def _add_modules(self) -> None:
        """Add all collimators as one object, and all crystals as another."""
        module_index = dict(zip(self.system.numbers.tolist(), range(len(self.system)), strict=True))
        parts = self.system.parts(self.subject.construction)
        for kind in dict.fromkeys(part.kind for part in parts):
            kind_parts = [part for part in parts if part.kind == kind]
            first_vertices = np.cumsum([0, *(len(part.vertices) for part in kind_parts)])
            faces = [part.solid[1] + first for part, first in zip(kind_parts, first_vertices[:-1], strict=True)]
            mesh = bpy.data.meshes.new(ids.STUDIO)
            vertices = np.concatenate([part.vertices for part in kind_parts])
            collimators.reshape_mesh(mesh, (vertices, np.concatenate(faces)))
            mesh.materials.append(_figure_material(kind.upper()))
            for name in ("lit", "opacity"):
                mesh.attributes.new(name, "FLOAT", "FACE")
            face_modules = np.repeat([module_index[part.number] for part in kind_parts], [len(f) for f in faces])
            self._meshes.append((mesh, face_modules))
            self.add_object(mesh)

    def _add_volume(self, item: bpy.types.Object) -> None:
        """Add the volume's object, with a copy of its surfaces if it has some."""
        self.volume_objects = [self.add_object(item.data)]
        self.volume_objects[0].matrix_world = item.matrix_world
        for surface in looks.surfaces_of(item):  # its look draws surfaces instead of smoke
            copy = surface.copy()
            copy.data, copy.parent = surface.data.copy(), None
            self.scene.collection.objects.link(copy)
            copy.matrix_world = surface.matrix_world
            self.volume_objects.append(copy)

    def _add_rays(self) -> dict[int, bpy.types.Object]:
        """Return the principal rays by module number: thin shining tubes from each pinhole to the isocentre."""
        material, emission = compat.surface_material(ids.STUDIO, "ShaderNodeEmission")
        emission.inputs["Color"].default_value = _ACCENT
        rays = {}
        for number, center in zip(self.system.numbers.tolist(), self.system.poses()[:, :3, 3], strict=True):
            curve = bpy.data.curves.new(ids.STUDIO, "CURVE")
            curve.dimensions, curve.bevel_depth = "3D", _RAY_RADIUS * self.radius
            spline = curve.splines.new("POLY")
            spline.points.add(1)
            spline.points[0].co, spline.points[1].co = (*center, 1.0), (0.0, 0.0, 0.0, 1.0)
            curve.materials.append(material)
            rays[number] = self.add_object(curve)
            rays[number].visible_shadow = False
        return rays


def aim_camera(camera: bpy.types.Object, direction: Points, page: Page, points: Points, top: int) -> None:
    """Place a camera in a direction so that points (N, 3) just fit the page below row `top`, with even margins."""
    turn = (-Vector(direction)).to_track_quat("-Z", "Y")
    right, up, back = np.array(turn.to_matrix()).T
    longer, margin = max(page.width, page.height), _MARGIN * min(page.width, page.height)
    per_pixel = _SENSOR_WIDTH / camera.data.lens / longer  # tangent of the angle of a pixel
    half_width, top_edge, bottom_edge = (
        per_pixel * (half - free)
        for half, free in ((page.width / 2, margin), (page.height / 2, max(top, margin)), (page.height / 2, margin))
    )
    depth = -points @ back
    x, y = points @ right, points @ up
    # Seen from (cx, cy) at a distance d, a point is inside if x - cx <= half_width (depth + d), and so on for each side.
    x_high, x_low = np.max(x - half_width * depth), np.max(-x - half_width * depth)
    y_high, y_low = np.max(y - top_edge * depth), np.max(-y - bottom_edge * depth)
    distance = max((x_high + x_low) / (2 * half_width), (y_high + y_low) / (top_edge + bottom_edge))
    cx, cy = (x_high - x_low) / 2, (y_high - top_edge * distance + bottom_edge * distance - y_low) / 2
    for _ in range(10):  # centre the points where one direction leaves room
        view_x, view_y = (x - cx) / (depth + distance), (y - cy) / (depth + distance)
        cx += distance * (view_x.max() + view_x.min()) / 2
        cy += distance * (view_y.max() - top_edge + view_y.min() + bottom_edge) / 2
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


def _figure_material(part: str) -> bpy.types.Material:
    """Return a copy of a part's material that follows two attributes of faces.

    Attribute "lit" mixes in the accent's colour; attribute "opacity" is the opacity, 0 to 1.
    """
    material = collimators.part_material(part).copy()
    material.name, tree = ids.STUDIO, material.node_tree
    output = tree and tree.get_output_node("CYCLES")
    if output is None or not output.inputs["Surface"].links:  # a material of the user's own
        return material
    add_node, surface = partial(compat.add_node, tree), output.inputs["Surface"]
    lit, opacity = (
        add_node("ShaderNodeAttribute", (600, y), attribute_name=name).outputs["Fac"]
        for name, y in (("lit", 300), ("opacity", 500))
    )
    lit_inputs = {"Base Color": _ACCENT, "Roughness": 0.5, "Emission Color": _ACCENT, "Emission Strength": _GLOW}
    accent = add_node("ShaderNodeBsdfPrincipled", (600, -200), lit_inputs).outputs[0]
    if principled := next((node for node in tree.nodes if node.type == "BSDF_PRINCIPLED"), None):
        principled.inputs["Metallic"].default_value *= _METALLIC_FACTOR  # metal would mirror the surroundings
    tinted = add_node("ShaderNodeMixShader", (800, 0), {0: lit, 1: surface.links[0].from_socket, 2: accent}).outputs[0]
    clear = add_node("ShaderNodeBsdfTransparent", (800, 200)).outputs[0]
    tree.links.new(add_node("ShaderNodeMixShader", (1000, 0), {0: opacity, 1: clear, 2: tinted}).outputs[0], surface)
    return material
