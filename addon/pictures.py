"""Pictures of the scanner, rendered by Cycles on the processor: they need no window and no graphics card."""

from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

from ..core.errors import InputError
from . import scanner

SIZE = (960, 560)
_DIRECTION = Vector((0.75, -1.0, 0.62))  # from the scanner's middle to the camera
_LENS, _SENSOR = 50.0, 36.0
# Direction from the scanner's middle in units of its reach, power (W per mm^2 of reach^2) and size of each light.
_LIGHTS = (((-0.5, -1.8, 2.6), 45.0, 2.0), ((2.4, -0.4, 0.8), 25.0, 2.0), ((-0.8, 1.6, 1.6), 30.0, 1.5))


def render_scanner(
    collection: bpy.types.Collection,
    path: Path,
    first: int,
    last: int,
    volume: bpy.types.Object | None = None,
    zoom: float = 1.0,
    samples: int = 12,
) -> None:
    """Render modules `first` to `last` of a scanner to a PNG, with a volume or without; the scene stays as it was."""
    shown = {camera: not camera.hide_viewport for camera in scanner.modules(collection)}
    studio = bpy.data.scenes.new("mphDRR studio")
    studio.world = bpy.data.worlds.new("mphDRR studio")
    try:
        studio.world.color = (0.055, 0.06, 0.07)
        studio.collection.children.link(collection)
        if volume is not None:
            studio.collection.objects.link(volume)
        scanner.show_modules(collection, first, last, "ONLY")
        render, cycles = studio.render, studio.cycles
        render.engine, cycles.device, cycles.samples, cycles.max_bounces = "CYCLES", "CPU", samples, 4
        cycles.use_denoising, cycles.denoising_prefilter = True, "FAST"
        render.resolution_x, render.resolution_y = SIZE
        render.image_settings.file_format, render.image_settings.color_mode = "PNG", "RGB"
        studio.view_settings.view_transform = "Standard"
        _furnish(studio, collection, zoom)
        studio.render.filepath = str(Path(path).absolute())
        bpy.ops.render.render(write_still=True, scene=studio.name)
    except RuntimeError as error:
        raise InputError(f"{path}: cannot be rendered ({str(error).strip().splitlines()[0]})") from error
    finally:
        for camera, visible in shown.items():
            scanner.set_visible(camera, visible)
        furniture = [item for item in studio.collection.objects if item != volume]
        bpy.data.batch_remove([*(item.data for item in furniture), *furniture, studio.world])
        bpy.data.scenes.remove(studio)


def _furnish(studio: bpy.types.Scene, collection: bpy.types.Collection, zoom: float) -> None:
    """A camera and lights around a scanner."""
    system = scanner.read_scanner(collection)
    outer = system.pinhole_distance + system.collimator_length + system.detector_thickness
    ends = np.concatenate([system.centers, -system.principal_rays * outer[:, None]])
    middle = Vector((ends.min(axis=0) + ends.max(axis=0)) / 2)
    reach = float(np.linalg.norm(ends - np.array(middle), axis=1).max() + system.detector_side.max() / 2)
    data = bpy.data.cameras.new("mphDRR studio camera")
    data.lens, data.sensor_width = zoom * _LENS, _SENSOR
    # The sphere of radius `reach` just fits the picture's height, less what perspective and the arc leave empty.
    distance = 0.66 * reach / np.sin(np.arctan(_SENSOR / 2 * SIZE[1] / SIZE[0] / _LENS))
    data.clip_start, data.clip_end = 0.01 * distance, 10.0 * distance
    studio.camera = _aimed(studio, data, middle, middle + _DIRECTION.normalized() * distance)
    for direction, power, size in _LIGHTS:
        light = bpy.data.lights.new("mphDRR studio light", "AREA")
        light.energy, light.size = power * reach**2, size * reach
        _aimed(studio, light, middle, middle + reach * Vector(direction))


def _aimed(studio: bpy.types.Scene, data: bpy.types.ID, target: Vector, place: Vector) -> bpy.types.Object:
    item = bpy.data.objects.new(data.name, data)
    item.location = place
    item.rotation_mode = "QUATERNION"
    item.rotation_quaternion = (target - place).to_track_quat("-Z", "Y")
    studio.collection.objects.link(item)
    return item
