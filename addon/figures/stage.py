"""What figures are rendered of: a scene of its own with copies of what is shown, so that the user's stays as it is.

The camera sees the figure's paper behind it. Each module can be lit, and fades where it would stand between the viewer and
the isocentre.
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
"""The camera's turn about the z axis, radians; the modules that are lit, and those whose rays are seen."""
Points = NDArray[np.float64]
DIRECTION = np.array(Vector((0.45, -1.0, 0.75)).normalized())
"""From the scanner to the camera."""
_FILM = 36.0  # mm, of the camera
_MARGIN = 0.04  # of the picture's shorter side, free around what is shown
_SOLID, _GONE = 0.1, 0.5  # how far to the front, of 1, a pinhole's module begins to fade, and is cut away
_GHOST = 0.3  # how much of a module that is lit is there at least
_RAY_RADIUS = 0.006  # of the ROI's radius
_ACCENT = (1.0, 0.40, 0.03, 1.0)  # linear RGBA: rays, and modules that are lit
_DULL = 0.3  # how much of the metal's gloss is left
_SHINE, _TINT = 0.3, 0.8  # of lit modules: how much they glow, and how far they are of the accent's colour
_WORLD = 0.9  # how bright the surroundings are, which metal reflects

_TURNS = np.linspace(0.0, 2 * np.pi, 64, endpoint=False)
_BALL = np.stack(  # points (N, 3) of a sphere of radius 1
    [
        np.outer(np.cos(_TURNS), np.sin(_TURNS / 2)),
        np.outer(np.sin(_TURNS), np.sin(_TURNS / 2)),
        np.outer(np.ones(64), np.cos(_TURNS / 2)),
    ],
    axis=-1,
).reshape(-1, 3)


class Stage:
    """A subject's scanner and the volume of an object, in a scene of their own, with a camera that sees them on a page."""

    def __init__(
        self, subject: FigureSubject, kind: FigureKind, item: bpy.types.Object | None, page: Page, top: int
    ) -> None:
        assert subject.scanner is not None and kind.studio is not None
        self.subject, self.item, self.page, self.top = subject, item, page, top
        self.shown, self._motion = shown, motion = kind.studio, kind.motion
        self.whole = subject.scanner
        chosen = subject.select_modules(self.whole)
        if shown.lit and subject.modules is None and motion != "light":  # of all rays none could be told apart
            chosen = chosen[chosen.rings() == chosen.rings().max() // 2]
        self.numbers: list[int] = chosen.numbers.tolist()
        """Of the chosen modules."""
        self.system = self.whole if shown.lit else chosen
        self.scene = scene = bpy.data.scenes.new(ids.STUDIO)
        self.radius = self.whole.region_radius()
        self.drawn: list[bpy.types.Object] = []
        self._modules = list[tuple[bpy.types.Mesh, NDArray[np.intp]]]()
        try:
            studio.furnish(scene)
            scene.frame_set(bpy.context.scene.frame_current)
            _backdrop(scene.world, page.paper)
            self._put_modules()
            roi = self.put(collimators.new_sphere(ids.STUDIO, self.radius, collimators.part_material("ROI")))
            roi.visible_shadow = False
            if shown.volume and item is not None:
                self._put_volume(item)
            self.rays = self._put_rays() if shown.rays else {}
            self.camera = scene.camera = self.put(bpy.data.cameras.new(ids.STUDIO))
            self.camera.data.lens, self.camera.data.sensor_width = shown.lens, _FILM
            self.show(0.0, self.numbers, self.numbers)
        except BaseException:
            self.remove()
            raise

    def put(self, data: bpy.types.ID) -> bpy.types.Object:
        """A new object in the scene."""
        item = bpy.data.objects.new(ids.STUDIO, data)
        self.scene.collection.objects.link(item)
        return item

    def show(self, turn: float, lit: list[int], rays: list[int]) -> None:
        """Show a moment: the camera where it is then, and let those modules fade that stand in its way."""
        cos, sin = np.cos(turn), np.sin(turn)
        direction = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ DIRECTION
        points = (self.shown.near or 1.0) * self.radius * _BALL
        if not self.shown.near:
            points = np.concatenate([points, *(part.vertices for part in self.whole.parts())])
        aim(self.camera, direction, self.page, points, self.top)
        # What is at the isocentre is shown as large:
        longer, distance = max(self.page.width, self.page.height), float(np.array(self.camera.location) @ direction)
        self.pixels_per_mm = longer * self.shown.lens / _FILM / distance
        numbers, self.shining = self.system.numbers, rays
        front = -self.system.frames()[:, 2] @ direction
        there = np.clip((_GONE - front) / (_GONE - _SOLID), 0.0, 1.0) if self.shown.cut else np.ones(len(numbers))
        there = np.maximum(there, _GHOST * np.isin(numbers, rays) * (len(rays) == 1))
        values = {"lit": _TINT * np.isin(numbers, lit) * self.shown.lit, "there": there}
        for mesh, module in self._modules:
            for name, value in values.items():
                mesh.attributes[name].data.foreach_set("value", value[module].astype(np.float32))
            mesh.update()
        for number, share in zip(numbers.tolist(), there, strict=True):
            if number in self.rays:
                self.rays[number].hide_render = number not in rays or not share

    def moment(self, share: float) -> Moment:
        """What an animation shows after a share of its time."""
        if self._motion == "turn":
            return 2 * np.pi * share, self.numbers, self.numbers
        now = int(share * len(self.numbers))
        return 0.0, self.numbers[: now + 1], [self.numbers[now]]

    def draw_surface(self, mesh: Mesh, colors: volume_materials.Ramp) -> None:
        """Draw a mesh in the place of the volume."""
        for part in self.drawn:
            part.hide_render = True
        surface = meshes.add_mesh(mesh, ids.STUDIO, np.eye(4), self.scene.collection)
        surface.data.materials.append(looks.new_material(ids.STUDIO, colors))
        self.drawn = [surface]

    def remove(self) -> None:
        """Remove the studio, all but the volume's data."""
        scene = self.scene
        found = list(scene.collection.all_objects)
        datas = {item.data for item in found if item.type != "VOLUME"}
        materials = {m for data in datas for m in getattr(data, "materials", ()) if m.name.startswith(ids.STUDIO)}
        homes, world = list(scene.collection.children), scene.world
        bpy.data.scenes.remove(scene)
        bpy.data.batch_remove([*found, *datas, *materials, *homes, *filter(None, [world])])

    def _put_modules(self) -> None:
        """All collimators as one object, and all crystals."""
        numbered = dict(zip(self.system.numbers.tolist(), range(len(self.system)), strict=True))
        parts = self.system.parts(self.subject.construction)
        for kind in dict.fromkeys(part.kind for part in parts):
            chosen = [part for part in parts if part.kind == kind]
            firsts = np.cumsum([0, *(len(part.vertices) for part in chosen)])
            faces = [part.solid[1] + first for part, first in zip(chosen, firsts[:-1], strict=True)]
            mesh = bpy.data.meshes.new(ids.STUDIO)
            vertices = np.concatenate([part.vertices for part in chosen])
            collimators.reshape_mesh(mesh, (vertices, np.concatenate(faces)))
            mesh.materials.append(_material(kind.upper()))
            for name in ("lit", "there"):
                mesh.attributes.new(name, "FLOAT", "FACE")
            module = np.repeat([numbered[part.number] for part in chosen], [len(f) for f in faces])
            self._modules.append((mesh, module))
            self.put(mesh)

    def _put_volume(self, item: bpy.types.Object) -> None:
        self.drawn = [self.put(item.data)]
        self.drawn[0].matrix_world = item.matrix_world
        surface = looks.surface_of(item)
        if surface is not None:  # of a look that draws no smoke
            copy = surface.copy()
            copy.data, copy.parent = surface.data.copy(), None
            self.scene.collection.objects.link(copy)
            copy.matrix_world = surface.matrix_world
            self.drawn.append(copy)

    def _put_rays(self) -> dict[int, bpy.types.Object]:
        """The principal rays by modules' numbers, from each pinhole to the isocentre, as thin shining tubes."""
        material, shine = compat.surface_material(ids.STUDIO, "ShaderNodeEmission")
        shine.inputs["Color"].default_value = _ACCENT
        rays = {}
        for number, center in zip(self.system.numbers.tolist(), self.system.poses()[:, :3, 3], strict=True):
            curve = bpy.data.curves.new(ids.STUDIO, "CURVE")
            curve.dimensions, curve.bevel_depth = "3D", _RAY_RADIUS * self.radius
            spline = curve.splines.new("POLY")
            spline.points.add(1)
            spline.points[0].co, spline.points[1].co = (*center, 1.0), (0.0, 0.0, 0.0, 1.0)
            curve.materials.append(material)
            rays[number] = self.put(curve)
            rays[number].visible_shadow = False
        return rays


def aim(camera: bpy.types.Object, direction: Points, page: Page, points: Points, top: int) -> None:
    """Place a camera in a direction so that points (N, 3) just fit the page below row `top`, with even margins."""
    turn = (-Vector(direction)).to_track_quat("-Z", "Y")
    right, up, back = np.array(turn.to_matrix()).T
    longer, margin = max(page.width, page.height), _MARGIN * min(page.width, page.height)
    per_pixel = _FILM / camera.data.lens / longer  # tangents of angles
    across, above, below = (
        per_pixel * (half - free)
        for half, free in ((page.width / 2, margin), (page.height / 2, max(top, margin)), (page.height / 2, margin))
    )
    depth = -points @ back
    x, y = points @ right, points @ up
    # Seen from (cx, cy) at a distance d, a point is inside where x - cx <= across (depth + d), and so on for each side.
    x_high, x_low = np.max(x - across * depth), np.max(-x - across * depth)
    y_high, y_low = np.max(y - above * depth), np.max(-y - below * depth)
    distance = max((x_high + x_low) / (2 * across), (y_high + y_low) / (above + below))
    cx, cy = (x_high - x_low) / 2, (y_high - above * distance + below * distance - y_low) / 2
    for _ in range(10):  # into the middle, where one direction leaves room
        seen_x, seen_y = (x - cx) / (depth + distance), (y - cy) / (depth + distance)
        cx += distance * (seen_x.max() + seen_x.min()) / 2
        cy += distance * (seen_y.max() - above + seen_y.min() + below) / 2
    camera.location = cx * right + cy * up + distance * back
    camera.rotation_mode, camera.rotation_quaternion = "QUATERNION", turn
    camera.data.clip_start, camera.data.clip_end = 0.01 * distance, 10.0 * distance


def _backdrop(world: bpy.types.World, paper: str) -> None:
    """Have the camera see paper behind the scene, and metal reflect surroundings that are brighter."""
    compat.use_nodes(world)
    tree = world.node_tree
    tree.nodes.clear()
    add_node, rgb = partial(compat.add_node, tree), bytes.fromhex(paper.removeprefix("#"))
    color = [*Color([n / 255 for n in rgb]).from_srgb_to_scene_linear(), 1.0]
    light = add_node("ShaderNodeBackground", (0, 0), {"Color": [*[_WORLD] * 3, 1.0]})
    back = add_node("ShaderNodeBackground", (0, -150), {"Color": color})
    seen = add_node("ShaderNodeLightPath", (0, 350)).outputs["Is Camera Ray"]
    mixed = add_node("ShaderNodeMixShader", (250, 0), {0: seen, 1: light.outputs[0], 2: back.outputs[0]})
    add_node("ShaderNodeOutputWorld", (450, 0), {"Surface": mixed.outputs[0]})


def _material(part: str) -> bpy.types.Material:
    """A copy of the material of parts: in the accent's colour by the faces' attribute "lit", and clear without "there"."""
    material = collimators.part_material(part).copy()
    material.name, tree = ids.STUDIO, material.node_tree
    output = tree and tree.get_output_node("CYCLES")
    if output is None or not output.inputs["Surface"].links:  # the user's own
        return material
    add_node, surface = partial(compat.add_node, tree), output.inputs["Surface"]
    lit, there = (
        add_node("ShaderNodeAttribute", (600, y), attribute_name=name).outputs["Fac"]
        for name, y in (("lit", 300), ("there", 500))
    )
    shine = {"Base Color": _ACCENT, "Roughness": 0.5, "Emission Color": _ACCENT, "Emission Strength": _SHINE}
    bright = add_node("ShaderNodeBsdfPrincipled", (600, -200), shine).outputs[0]
    if plain := next((node for node in tree.nodes if node.type == "BSDF_PRINCIPLED"), None):
        plain.inputs["Metallic"].default_value *= _DULL  # of metal one would see what it reflects
    either = add_node("ShaderNodeMixShader", (800, 0), {0: lit, 1: surface.links[0].from_socket, 2: bright}).outputs[0]
    clear = add_node("ShaderNodeBsdfTransparent", (800, 200)).outputs[0]
    tree.links.new(add_node("ShaderNodeMixShader", (1000, 0), {0: there, 1: clear, 2: either}).outputs[0], surface)
    return material
