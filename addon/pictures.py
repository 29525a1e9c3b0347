"""Pictures of the scanner, rendered by Cycles on the processor: they need no window and no graphics card."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

from ..core.errors import InputError
from . import scanner

SIZE = (960, 560)
_SAMPLES = 12
_DIRECTION = Vector((0.75, -1.0, 0.62))  # from the scanner's middle to the camera
_LENS, _SENSOR = 50.0, 36.0
# Direction from the scanner's middle in units of its reach, power (W per mm^2 of reach^2) and size of each light.
_LIGHTS = (((-0.5, -1.8, 2.6), 45.0, 2.0), ((2.4, -0.4, 0.8), 25.0, 2.0), ((-0.8, 1.6, 1.6), 30.0, 1.5))


def render_scanner(
    scene: bpy.types.Scene,
    collection: bpy.types.Collection,
    path: Path,
    first: int,
    last: int,
    volume: bpy.types.Object | None = None,
    zoom: float = 1.0,
    samples: int = _SAMPLES,
) -> None:
    """Render modules `first` to `last` of a scanner to a PNG, with a volume or without; the scene stays as it was.

    Raises
    ------
    InputError
        The picture cannot be written.
    """
    shown = {camera: not camera.hide_viewport for camera in scanner.modules(collection)}
    with _studio(scene, collection, zoom, samples):
        try:
            scanner.show_modules(collection, first, last, "ONLY")
            if volume is not None:
                hidden, volume.hide_render = volume.hide_render, False
            scene.render.filepath = str(Path(path).absolute())
            try:
                bpy.ops.render.render(write_still=True, scene=scene.name)
            except RuntimeError as error:
                raise InputError(f"{path}: cannot be rendered ({str(error).strip().splitlines()[0]})") from error
        finally:
            for camera, visible in shown.items():
                scanner.set_visible(camera, visible)
            if volume is not None:
                volume.hide_render = hidden


@contextmanager
def _studio(scene: bpy.types.Scene, collection: bpy.types.Collection, zoom: float, samples: int) -> Iterator[None]:
    """A camera, lights and render settings for pictures of a scanner; all taken back at the end."""
    render, image, cycles = scene.render, scene.render.image_settings, scene.cycles
    view = scene.view_settings
    settings = [
        (render, "engine", "CYCLES"),
        (render, "resolution_x", SIZE[0]),
        (render, "resolution_y", SIZE[1]),
        (render, "resolution_percentage", 100),
        (render, "pixel_aspect_x", 1.0),
        (render, "pixel_aspect_y", 1.0),
        (render, "film_transparent", False),
        (render, "filepath", render.filepath),
        (render, "use_file_extension", True),
        (image, "file_format", "PNG"),
        (image, "color_mode", "RGB"),
        (cycles, "device", "CPU"),
        (cycles, "samples", samples),
        (cycles, "use_denoising", True),
        (cycles, "denoising_prefilter", "FAST"),
        (cycles, "max_bounces", 4),
        (view, "view_transform", "Standard"),
        (scene, "world", bpy.data.worlds.new("mphDRR studio")),
        (scene, "camera", None),
    ]
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in settings]
    objects: list[bpy.types.Object] = []
    try:
        for owner, name, value in settings:
            setattr(owner, name, value)
        scene.world.color = (0.055, 0.06, 0.07)
        system = scanner.read_scanner(collection)
        outer = system.pinhole_distance + system.collimator_length + system.detector_thickness
        ends = np.concatenate([system.centers, -system.principal_rays * outer[:, None]])
        middle = (ends.min(axis=0) + ends.max(axis=0)) / 2
        reach = float(np.linalg.norm(ends - middle, axis=1).max() + system.detector_side.max() / 2)
        scene.camera = _camera(scene, Vector(middle), reach, zoom, objects)
        for direction, power, size in _LIGHTS:
            _light(scene, Vector(middle), reach * Vector(direction), power * reach**2, size * reach, objects)
        yield
    finally:
        world = scene.world
        for owner, name, value in reversed(before):
            setattr(owner, name, value)
        bpy.data.worlds.remove(world)
        for item in objects:
            data = item.data
            bpy.data.batch_remove([item, data])


def _camera(
    scene: bpy.types.Scene, middle: Vector, reach: float, zoom: float, objects: list[bpy.types.Object]
) -> bpy.types.Object:
    data = bpy.data.cameras.new("mphDRR studio camera")
    data.lens, data.sensor_width = zoom * _LENS, _SENSOR
    # The sphere of radius `reach` just fits the picture's height, less what perspective and the arc leave empty.
    half_height = _SENSOR / 2 * SIZE[1] / SIZE[0] / _LENS
    distance = 0.66 * reach / np.sin(np.arctan(half_height))
    data.clip_start, data.clip_end = 0.01 * distance, 10.0 * distance
    return _aimed(scene, data, middle, middle + _DIRECTION.normalized() * distance, objects)


def _light(
    scene: bpy.types.Scene, middle: Vector, offset: Vector, power: float, size: float, objects: list[bpy.types.Object]
) -> None:
    data = bpy.data.lights.new("mphDRR studio light", "AREA")
    data.energy, data.size = power, size
    _aimed(scene, data, middle, middle + offset, objects)


def _aimed(
    scene: bpy.types.Scene, data: bpy.types.ID, target: Vector, place: Vector, objects: list[bpy.types.Object]
) -> bpy.types.Object:
    item = bpy.data.objects.new(data.name, data)
    objects.append(item)
    item.location = place
    item.rotation_mode = "QUATERNION"
    item.rotation_quaternion = (target - place).to_track_quat("-Z", "Y")
    scene.collection.objects.link(item)
    return item
