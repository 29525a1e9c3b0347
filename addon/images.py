"""Projections as Blender images, shown as the pinhole sees them: +v up, +u left.

The arrays' column index grows along +u, so an image's columns are reversed; its rows start at the bottom, as the arrays' do.
Each module has two: one holds the exact float32 numbers in R, G and B, the other, as the mosaic, shows them in colours.
"""

from collections.abc import Generator
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.runs.display import Display
from ..core.runs.mosaic import Sheet, as_seen, sheet
from ..core.runs.run import ProjectionRun
from . import ids

_KEY = "mphdrr_projection"  # custom property: marks the images that a new run replaces
_TEXT = "mphdrr_difference"  # custom property of a difference: its numbers, in words
_TILES = "mphdrr_tiles"  # custom property of the mosaic: its modules, unit, and where in it which one's image is


def storing(run: ProjectionRun, display: Display) -> Generator[None, None, bpy.types.Image]:
    """Make images of a run, packed into the .blend, in place of those of an earlier run.

    For each module one of the exact numbers, float32, and one to look at; and the mosaic, which is returned. Yields
    between steps, so that a window can be drawn.
    """
    numbers = run.system.numbers.tolist()
    names = [projection_name(number, numbers) for number in numbers]
    for picture, name in zip(as_seen(run.projections), names, strict=True):
        _store(name, picture, exact=True)
        yield
    kept = {*names, *map(ids.picture_name, names), ids.MOSAIC}
    for other in [image for image in bpy.data.images if _KEY in image and image.name not in kept]:
        bpy.data.images.remove(other)
    return (yield from _showing(run.projections, numbers, run.system.rings().tolist(), run.unit, display))


def show_again(display: Display) -> None:
    """Make the pictures anew from the exact images, as `display` says; nothing where there is no run."""
    shown = tiles(bpy.data.images.get(ids.MOSAIC))
    if shown is None:
        return
    numbers = shown["numbers"]
    found = [bpy.data.images.get(projection_name(number, numbers)) for number in numbers]
    if None not in found:
        projections = np.stack([projection_array(image) for image in found])
        for _ in _showing(projections, numbers, shown["rings"], shown["unit"], display):
            pass


def tiles(image: bpy.types.Image | None) -> dict[str, Any] | None:
    """Of the mosaic: `numbers` and `rings` of its modules, `unit`, the tiles' size `tile` and their `corners`; else None.

    Rows and columns are counted from the top left.
    """
    return None if image is None or _TILES not in image else image[_TILES].to_dict()


def projection_name(number: int, numbers: list[int]) -> str:
    """Name of the exact image of the module `number` of a run of the modules `numbers`."""
    return ids.projection_name(number, max(numbers))


def _showing(
    projections: NDArray[np.float32], numbers: list[int], rings: list[int], unit: str, display: Display
) -> Generator[None, None, bpy.types.Image]:
    """Make the pictures of projections (M, n_v, n_u) as `display` says; returns the mosaic."""
    window = display.window(projections)
    for picture, number in zip(as_seen(projections), numbers, strict=True):
        name = ids.picture_name(projection_name(number, numbers))
        _store(name, display.colored(picture, window), exact=False)
        yield
    drawn = sheet(projections, numbers, rings, unit, display)
    image = _store(ids.MOSAIC, drawn.picture, exact=False)
    _note_tiles(image, drawn, numbers, rings, unit)
    return image


def _note_tiles(image: bpy.types.Image, drawn: Sheet, numbers: list[int], rings: list[int], unit: str) -> None:
    image[_TILES] = {
        "numbers": numbers, "rings": rings, "unit": unit, "corners": drawn.corners.ravel().tolist(), "tile": drawn.tile,
    }  # fmt: skip


def store_difference(drawn: Sheet, numbers: list[int], unit: str, text: str) -> bpy.types.Image:
    """Make the image of a difference of two runs, until other projections are shown; `text` says its numbers."""
    image = _store(ids.DIFFERENCE, drawn.picture, exact=False)
    _note_tiles(image, drawn, numbers, [], unit)
    image[_TEXT] = text
    return image


def difference_text() -> str:
    """The numbers of the difference that was drawn last; "" where there is none."""
    image = bpy.data.images.get(ids.DIFFERENCE)
    return str(image.get(_TEXT, "")) if image is not None else ""


def is_ours(image: bpy.types.Image | None) -> bool:
    """Whether an image is of a run."""
    return image is not None and _KEY in image


def clear() -> None:
    """Remove all images of runs."""
    bpy.data.batch_remove([image for image in bpy.data.images if _KEY in image])


def projection_array(image: bpy.types.Image) -> NDArray[np.float32]:
    """The projection (n_v, n_u) that a module image holds, in the arrays' order."""
    width, height = image.size
    pixels = np.empty(4 * width * height, np.float32)
    image.pixels.foreach_get(pixels)
    return np.ascontiguousarray(pixels.reshape(height, width, 4)[:, ::-1, 0])


def redraw_mosaic() -> None:
    """Have the Image Editors that show the mosaic drawn again: another module is active."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "IMAGE_EDITOR" and tiles(area.spaces.active.image) is not None:
                area.tag_redraw()


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


def _store(name: str, picture: NDArray[Any], *, exact: bool) -> bpy.types.Image:
    """Make or replace our image `name`, from numbers (height, width) or 8-bit colours (…, 3), row 0 at the top."""
    height, width = picture.shape[:2]
    image = old = bpy.data.images.get(name)
    if old is None or _KEY not in old or tuple(old.size) != (width, height) or old.is_float != exact:
        image = bpy.data.images.new(name, width, height, float_buffer=exact, is_data=exact)
        if old is not None and _KEY in old:
            old.user_remap(image)
            bpy.data.images.remove(old)
            image.name = name
        elif old is not None:  # somebody else's image has our name
            old.name = f"{name}.other"
            image.name = name
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = picture[::-1, :, None] if exact else picture[::-1] / np.float32(255)
    image.pixels.foreach_set(pixels.ravel())
    image.update()
    image.use_fake_user = True  # or it is not saved while nothing shows it
    image[_KEY] = True
    if exact:
        image.pack()
    return image


@bpy.app.handlers.persistent
def before_save(*_: object) -> None:
    """Pack the pictures to look at: only now, since each edit of the display makes them anew."""
    for image in bpy.data.images:
        if _KEY in image and image.is_dirty:
            image.pack()
