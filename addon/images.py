"""Projections as Blender images, shown as the pinhole sees them: +v up, +u left.

The arrays' column index grows along +u, so an image's columns are reversed; its rows start at the bottom, as the arrays' do.
Module images hold the exact float32 values in R, G and B; the mosaic is scaled for display.
"""

from collections.abc import Generator, Iterable

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.runs.mosaic import COLUMNS, as_seen, mosaic
from . import ids

_KEY = "mphdrr_projection"  # custom property: marks the images that a new run replaces
_MOSAIC_PIXELS = 6e6  # 80 views of 256 x 256 are shown pixel by pixel, larger ones reduced


def storing(projections: NDArray[np.float32], numbers: Iterable[int]) -> Generator[None, None, bpy.types.Image]:
    """Make a float image of each module and the mosaic, packed into the .blend, in place of those of an earlier run.

    `projections` are (M, n_v, n_u), the modules' `numbers` (M,) name the images. Yields between steps, so that a window
    can be drawn, and returns the mosaic, scaled so that its largest value is white.
    """
    numbers = [int(number) for number in numbers]
    names = [ids.projection_name(number, max(numbers)) for number in numbers]
    for picture, name in zip(as_seen(projections), names, strict=True):
        _store(name, picture, exact=True)
        yield
    count, n_v, n_u = projections.shape
    pixels = -(-count // COLUMNS) * COLUMNS * n_v * n_u
    factor = min(int(np.ceil(np.sqrt(pixels / _MOSAIC_PIXELS))), n_v, n_u)
    if factor > 1:  # too large to look at: means over blocks of pixels
        rows, width = n_v // factor, n_u // factor
        blocks = projections[:, : rows * factor, : width * factor].reshape(count, rows, factor, width, factor)
        projections = blocks.mean(axis=(2, 4), dtype=np.float32)
    sheet = np.maximum(mosaic(projections), 0.0)
    yield
    image = _store(ids.MOSAIC, sheet / (float(sheet.max(initial=0.0)) or 1.0), exact=False)
    kept = {*names, ids.MOSAIC}
    for other in [image for image in bpy.data.images if _KEY in image and image.name not in kept]:
        bpy.data.images.remove(other)
    return image


def projection_array(image: bpy.types.Image) -> NDArray[np.float32]:
    """The projection (n_v, n_u) that a module image holds, in the arrays' order."""
    width, height = image.size
    pixels = np.empty(4 * width * height, np.float32)
    image.pixels.foreach_get(pixels)
    return np.ascontiguousarray(pixels.reshape(height, width, 4)[:, ::-1, 0])


def show(image: bpy.types.Image, context: bpy.types.Context) -> bool:
    """Show an image in the Image Editors that show none or one of ours; False if no such editor is open."""
    shown = False
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            space = area.spaces.active
            if area.type == "IMAGE_EDITOR" and (space.image is None or _KEY in space.image):
                space.image = image
                _fit(context, window, area)
                shown = True
    return shown


def show_below(image: bpy.types.Image, context: bpy.types.Context) -> bool:
    """Like `show`, but open an Image Editor below the largest 3D view if none is open; False without a window."""
    if show(image, context):
        return True
    window = context.window
    views = [a for a in window.screen.areas if a.type == "VIEW_3D"] if window else []
    if not views:
        return False
    view = max(views, key=lambda a: a.width * a.height)
    before = set(window.screen.areas)
    with context.temp_override(window=window, area=view, region=view.regions[-1]):
        bpy.ops.screen.area_split(direction="HORIZONTAL", factor=0.3)
    new = [a for a in window.screen.areas if a not in before]
    area = min([*new, view], key=lambda a: a.y)
    area.type = "IMAGE_EDITOR"
    area.spaces.active.image = None
    return show(image, context)


def _fit(context: bpy.types.Context, window: bpy.types.Window, area: bpy.types.Area) -> None:
    region = next((r for r in area.regions if r.type == "WINDOW"), None)
    if region is None or bpy.app.background:
        return
    area.tag_redraw()

    def fit() -> None:  # after the redraw, when a new editor knows its size
        try:
            with bpy.context.temp_override(window=window, area=area, region=region):
                bpy.ops.image.view_all(fit_view=True)
        except (RuntimeError, ReferenceError, TypeError):
            pass  # the window or the editor was closed meanwhile

    bpy.app.timers.register(fit, first_interval=0.2)


def _store(name: str, picture: NDArray[np.float32], *, exact: bool) -> bpy.types.Image:
    """Make or replace our image `name`, from a picture whose row 0 is the top."""
    height, width = picture.shape
    image = old = bpy.data.images.get(name)
    if old is None or _KEY not in old or tuple(old.size) != (width, height) or old.is_float != exact:
        image = bpy.data.images.new(name, width, height, float_buffer=exact, is_data=True)
        if old is not None and _KEY in old:
            old.user_remap(image)
            bpy.data.images.remove(old)
            image.name = name
        elif old is not None:  # somebody else's image has our name
            old.name = f"{name}.other"
            image.name = name
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = picture[::-1, :, None]
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    image.use_fake_user = True  # or it is not saved while nothing shows it
    image[_KEY] = True
    image.pack()
    return image
