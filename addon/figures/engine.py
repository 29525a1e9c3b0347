"""Blender as a renderer: scenes rendered by Cycles to pictures, and pictures joined to films."""

import re
import tempfile
import time
from collections.abc import Generator, Sequence
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core import Cancelled
from ...core.errors import InputError, first_line
from ...core.figures.page import Page
from ...core.files import write_bytes
from ..blender import compat, ids, jobs

_PAUSE = 0.02  # s between two checks of Blender's render job
_MAX_TRANSPARENT = 64  # number of surfaces of faded modules, one behind another, that stay transparent


def set_up(scene: bpy.types.Scene, size: tuple[int, int], samples: int) -> None:
    """Set a scene up for rendering 8-bit colours by Cycles, the same on every machine."""
    render = scene.render
    try:
        render.engine = "CYCLES"
    except TypeError:
        raise InputError("Cycles is disabled: enable Cycles Render Engine in Edit > Preferences > Add-ons") from None
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.max_bounces, cycles.seed = "CPU", samples, 4, 0
    cycles.use_adaptive_sampling, cycles.adaptive_threshold, cycles.adaptive_min_samples = True, 0.05, 4
    cycles.use_denoising, cycles.denoising_prefilter = True, "ACCURATE"
    (render.resolution_x, render.resolution_y), render.resolution_percentage = size, 100
    cycles.transparent_max_bounces = _MAX_TRANSPARENT
    render.image_settings.file_format, render.image_settings.color_mode = "PNG", "RGB"
    render.dither_intensity = 0.0
    scene.view_settings.view_transform = "Standard"


def render_to_file(scene: bpy.types.Scene, path: Path, animation: bool = False) -> Generator[float, None, None]:
    """Yield the share of the samples that is done while rendering a scene to a file.

    In a window, Blender's own job renders, which the status bar shows and Esc ends; where the user cancels ours, it ends
    with that job.
    """
    is_cancelled, shares = False, [0.0]

    def note(text: str, _: None = None) -> None:
        """Note the share of the samples that Blender tells of."""
        if sample := re.search(r"Sample (\d+)/(\d+)", text):
            shares.append(int(sample[1]) / int(sample[2]))

    arguments = {"animation" if animation else "write_still": True, "scene": scene.name}
    scene.render.filepath = str(path)
    try:
        if not jobs.is_running():
            bpy.ops.render.render(**arguments)
            return
        view = bpy.context.preferences.view
        old_display_type, view.render_display_type = view.render_display_type, "NONE"
        try:
            bpy.ops.render.render("INVOKE_DEFAULT", **arguments)
        finally:
            view.render_display_type = old_display_type
    except RuntimeError as error:
        raise InputError(f"Blender cannot render the figure: {first_line(error)}") from error
    bpy.app.handlers.render_stats.append(note)
    try:
        while bpy.app.is_job_running("RENDER"):
            time.sleep(_PAUSE)
            try:
                yield max(shares)
            except Cancelled:
                is_cancelled = True
    finally:
        bpy.app.handlers.render_stats.remove(note)
    if is_cancelled or not path.is_file():  # the user has pressed Esc
        raise Cancelled


def read_pixels(path: Path) -> NDArray[np.uint8]:
    """Return the colours (height, width, 3) of a PNG, row 0 at the top."""
    image = bpy.data.images.load(str(path))
    width, height = image.size
    values = np.empty(4 * width * height, np.float32)
    image.pixels.foreach_get(values)
    bpy.data.images.remove(image)
    return np.rint(values.reshape(height, width, 4)[::-1, :, :3] * 255).astype(np.uint8)


def write_film(pictures: Sequence[Path], path: Path, fps: int, page: Page) -> Generator[None, None, None]:
    """Yield while joining pictures of a page's size, files of one folder, to an MP4, written whole or not at all."""
    scene = bpy.data.scenes.new(ids.STUDIO)
    try:
        strip = scene.sequence_editor_create().strips.new_image("Film", str(pictures[0]), 1, 1)
        for picture in pictures[1:]:
            strip.elements.append(picture.name)
        scene.frame_start, scene.frame_end = 1, len(pictures)
        scene.view_settings.view_transform = "Standard"
        render = scene.render
        render.resolution_x, render.resolution_y, render.resolution_percentage = page.width, page.height, 100
        render.fps, render.use_file_extension = fps, False
        compat.write_films(render.image_settings)
        render.ffmpeg.format, render.ffmpeg.codec, render.ffmpeg.constant_rate_factor = "MPEG4", "H264", "HIGH"
        with tempfile.TemporaryDirectory(prefix="mphdrr-") as folder:
            film = Path(folder) / "film.mp4"
            yield from (None for _ in render_to_file(scene, film, animation=True))
            write_bytes(path, film.read_bytes())
    finally:
        bpy.data.scenes.remove(scene)
