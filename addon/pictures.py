"""Pictures of the scanner, rendered by Cycles on the processor: they need no window and no graphics card."""

from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector

from ..core.errors import InputError
from . import ids, scanner, studio

SIZE = (960, 560)
_DIRECTION = Vector((0.75, -1.0, 0.62))  # from the scanner's middle to the camera
_LENS, _SENSOR = 50.0, 36.0


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
    scene = bpy.data.scenes.new(ids.STUDIO)
    studio.furnish(scene)
    (lights,) = scene.collection.children
    try:
        scene.collection.children.link(collection)
        if volume is not None:
            scene.collection.objects.link(volume)
        scanner.show_modules(collection, first, last, "ONLY")
        render, cycles = scene.render, scene.cycles
        render.engine, cycles.device, cycles.samples, cycles.max_bounces = "CYCLES", "CPU", samples, 4
        cycles.use_denoising, cycles.denoising_prefilter = True, "FAST"
        render.resolution_x, render.resolution_y = SIZE
        render.image_settings.file_format, render.image_settings.color_mode = "PNG", "RGB"
        scene.view_settings.view_transform = "Standard"
        scene.camera = _camera(collection, zoom)
        scene.collection.objects.link(scene.camera)
        render.filepath = str(Path(path).absolute())
        bpy.ops.render.render(write_still=True, scene=scene.name)
    except RuntimeError as error:
        raise InputError(f"{path}: cannot be rendered ({str(error).strip().splitlines()[0]})") from error
    finally:
        for camera, visible in shown.items():
            scanner.set_visible(camera, visible)
        furniture = [item for item in (*lights.objects, *scene.collection.objects) if item != volume]
        bpy.data.batch_remove([*(item.data for item in furniture), *furniture, lights, scene.world])
        bpy.data.scenes.remove(scene)


def _camera(collection: bpy.types.Collection, zoom: float) -> bpy.types.Object:
    """A camera that looks at a scanner."""
    system = scanner.read_scanner(collection)
    outer = system.pinhole_distance + system.collimator_length + system.detector_thickness
    ends = np.concatenate([system.centers, -system.principal_rays * outer[:, None]])
    middle = Vector((ends.min(axis=0) + ends.max(axis=0)) / 2)
    reach = float(np.linalg.norm(ends - np.array(middle), axis=1).max() + system.detector_side.max() / 2)
    data = bpy.data.cameras.new(ids.STUDIO)
    data.lens, data.sensor_width = zoom * _LENS, _SENSOR
    # The sphere of radius `reach` just fits the picture's height, less what perspective and the arc leave empty.
    distance = 0.66 * reach / np.sin(np.arctan(_SENSOR / 2 * SIZE[1] / SIZE[0] / _LENS))
    data.clip_start, data.clip_end = 0.01 * distance, 10.0 * distance
    return studio.aimed(data, middle, middle + _DIRECTION.normalized() * distance)
