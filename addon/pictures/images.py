"""Projections as Blender images, shown as the pinhole sees them: +v up, +u left.

The arrays' column index grows along +u, so an image's columns are reversed; its rows start at the bottom, as the arrays'
do. Each module has two images: one holds the exact float32 numbers in R, G and B; the other one is coloured, as the mosaic
is.
"""

from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core import ProjectionRun, Views, memory
from ...core.progress import Progress, part_of, tell
from ...core.runs.display import Display
from ...core.runs.display import number_text as number_text  # for panels
from ...core.runs.exr import exr_bytes
from ...core.runs.mosaic import MosaicSheet, as_seen, block_means, draw_sheet, module_labels, png_bytes
from ..blender import ids, jobs, reports, windows

_KEY = "mphdrr_projection"  # custom property of images that a new run replaces: True of a run's, False of a file's
_ARRAYS = ("sources", "detector_centers", "u_steps", "v_steps")
_MAX_PIXELS = 2.2e7
"""Approximate limit of all pictures' pixels together, since drawing a picture takes memory again; larger ones shrink."""
_PNG_LEVEL = 1  # fast compression
BAR = 24
"""Height, pixels at a resolution scale of 1, that is left free at the bottom of an Image Editor for `run_notes`."""
_FILLED_SHARE = 0.97  # share of the editor that a zoomed picture fills, so that buttons at the edges do not cover it
_EDITOR_SHARE = 0.4  # share of the 3D view's height for an Image Editor that is opened below it
_WAIT = 0.005  # s between two checks of a worker thread
_SCANNER = "mphdrr_scanner"  # custom property of the mosaic: the collection of the run's scanner
_TEXT = "mphdrr_difference"  # custom property of a difference: its numbers, in words
PHOTONS = "mphdrr_photons"  # custom property of the mosaic: its part of the photons, see `core.runs.run.PHOTONS`
_LABELS = "mphdrr_labels"  # custom property of the mosaic: the label of each tile, line by line
_TILES = "mphdrr_tiles"  # custom property of the mosaic: its modules, its unit, and the position of each tile
_VIEWS = "mphdrr_views"  # custom property of the mosaic: the run's views, as arrays of `Views`, and their ROI radii

_names_before_undo: dict[
    bpy.types.Area, str
] = {}  # names of the pictures that Image Editors showed before an undo or redo


@dataclass(frozen=True)
class Pictures:
    """Files with the contents of a run's images, made in a worker thread."""

    display: Display
    exact: list[bytes]  # OpenEXR files of float32 numbers, one per module
    colored: list[bytes]  # PNG files, one per module
    mosaic: bytes  # PNG file
    layout: MosaicSheet  # layout of the mosaic's tiles


def make_pictures(run: ProjectionRun, display: Display, progress: Progress | None = None) -> Pictures:
    """Make the contents of a run's images without bpy; `progress` counts the files."""
    exact = _make_all(exr_bytes, as_seen(run.projections), part_of(progress, 0, 2))
    rings = run.system.rings().tolist()
    colored = _color(run.projections, display, part_of(progress, 1, 2))
    mosaic, layout = _draw_mosaic(run.projections, module_labels(run), rings, run.unit, display)
    return Pictures(display, exact, colored, mosaic, layout)


def store_images(run: ProjectionRun, files: Pictures) -> Generator[tuple[str, int, int] | None, None, bpy.types.Image]:
    """Yield the steps that store a run's images, packed into the .blend, in place of an earlier run's; return the mosaic.

    For each module there is an image of the exact float32 numbers and a coloured one. `files` is the result of
    `make_pictures`. Between steps a window can be drawn; an exception thrown there leaves the earlier run's images as they
    are.
    """
    numbers = run.system.numbers.tolist()
    new_images: dict[str, bpy.types.Image] = {}
    try:
        for k, (number, exact, colored) in enumerate(zip(numbers, files.exact, files.colored, strict=True)):
            yield "storing", k, len(numbers)
            name = projection_name(number, numbers)
            new_images[name] = bpy.data.images.new(name, 1, 1, float_buffer=True, is_data=True)
            fill(new_images[name], exact)
            new_images[ids.picture_name(name)] = _new_picture(ids.picture_name(name), colored)
        yield "storing", len(numbers), len(numbers)
        new_images[ids.MOSAIC] = _new_picture(ids.MOSAIC, files.mosaic)  # in its own step: as large as all others
        yield "storing", len(numbers), len(numbers)
    except BaseException:
        bpy.data.batch_remove(new_images.values())
        raise
    _replace_images(new_images)
    mosaic = new_images[ids.MOSAIC]
    _store_tiles(mosaic, files.layout, numbers, run.system.rings().tolist(), run.unit, files.display)
    mosaic[_LABELS] = "\n".join(module_labels(run))
    arrays = {name: getattr(run.views, name).ravel().tolist() for name in _ARRAYS}
    mosaic[_VIEWS] = arrays | {"shape": run.views.shape, "roi_radius": run.system.roi_radii().tolist()}
    return mosaic


def recolor_images(display: Display, cached_projections: dict[int, NDArray[np.float32]]) -> Generator[bool, None, None]:
    """Yield while making the pictures of the shown run again from its exact images, as `display` says.

    Each yielded value says whether the mosaic, which is the first picture, is made. `cached_projections` keeps those that
    were read, by the mosaic's `session_uid`, for the next call.
    """
    mosaic = bpy.data.images.get(ids.MOSAIC)
    mosaic_tiles = tiles(mosaic)
    if mosaic is None or mosaic_tiles is None:
        return
    numbers, rings, unit = (mosaic_tiles[key] for key in ("numbers", "rings", "unit"))
    labels = str(mosaic[_LABELS]).split("\n") if _LABELS in mosaic else list(map(str, numbers))
    image_names, mosaic_uid = [projection_name(number, numbers) for number in numbers], mosaic.session_uid
    if mosaic_uid not in cached_projections:
        exact_arrays = []
        for image_name in image_names:
            if (exact_image := bpy.data.images.get(image_name)) is None:
                return
            exact_arrays.append(projection_array(exact_image))
            yield False
        cached_projections.clear()
        cached_projections[mosaic_uid] = np.stack(exact_arrays)
        del exact_arrays
    projections = cached_projections[mosaic_uid]
    png, layout = yield from _run_in_worker(lambda _: _draw_mosaic(projections, labels, rings, unit, display), False)
    mosaic = fill(bpy.data.images[ids.MOSAIC], png)
    _store_tiles(_load_pixels(mosaic), layout, numbers, rings, unit, None)
    pngs = yield from _run_in_worker(lambda progress: _color(projections, display, progress), True)
    for image_name, png in zip(image_names, pngs, strict=True):
        if (picture := bpy.data.images.get(ids.picture_name(image_name))) is not None:
            _load_pixels(fill(picture, png))
            yield True
    _store_tiles(bpy.data.images[ids.MOSAIC], layout, numbers, rings, unit, display)


def _run_in_worker(make: Callable[[Progress], Any], is_mosaic_made: bool) -> Generator[bool, None, Any]:
    """Run `make` in a worker thread and return its result; yield `is_mosaic_made` while waiting."""
    worker = jobs.Worker("Colours", make)
    worker.start()
    try:
        while worker.is_alive():
            worker.join(_WAIT)
            yield is_mosaic_made
    finally:
        worker.cancel.set()
    if worker.error is not None:
        raise worker.error
    return worker.result


def tiles(image: bpy.types.Image | None) -> dict[str, Any] | None:
    """Return the mosaic's tiles: `numbers` and `rings` of its modules, `unit`, tile size `tile` and `corners`; None without.

    Rows and columns count from the top left. `window` is that of the colours; `totals` are each image's "sum" or "mean", as
    `summed` says, and `maxima` its largest number; `half` tells whether these are of the middle halves, which are shown;
    `share` are the fractions of the images' width and height that the mosaic shows. `display` is the display of all
    pictures, "None" while they are being made. Files of earlier versions lack these seven.
    """
    return None if image is None or _TILES not in image else image[_TILES].to_dict()


def mosaic_views(mosaic: bpy.types.Image) -> tuple[Views, NDArray[np.float64]] | None:
    """Return the views of the mosaic's run, in its modules' order, and the radii of their ROIs (M,), mm.

    None in files of versions that did not keep them, until a run is shown anew.
    """
    if _VIEWS not in mosaic:
        return None
    stored = mosaic[_VIEWS].to_dict()
    arrays: dict[str, Any] = {name: np.reshape(stored[name], (-1, 3)) for name in _ARRAYS}
    n_v, n_u = stored["shape"]
    return Views(**arrays, shape=(n_v, n_u)), np.array(stored["roi_radius"])


def shown_fraction() -> tuple[float, float]:
    """Return the fractions of the exact images' width and height that their pictures, but for the mosaic, show."""
    mosaic_tiles = tiles(bpy.data.images.get(ids.MOSAIC)) or {}
    x, y = mosaic_tiles["share"] if mosaic_tiles.get("half") else (1.0, 1.0)
    return x, y


def set_scanner(mosaic: bpy.types.Image, collection: bpy.types.Collection | None) -> None:
    """Store the scanner of the mosaic's run."""
    if collection is not None:
        mosaic[_SCANNER] = collection
    elif _SCANNER in mosaic:
        del mosaic[_SCANNER]


def scanner_of(mosaic: bpy.types.Image) -> bpy.types.Collection | None:
    """Return the scanner of the mosaic's run; None where it has been removed."""
    return mosaic.get(_SCANNER)


def belong_to(scene: bpy.types.Scene) -> bool:
    """Return whether the images are of a run of a scene, or of an unknown one."""
    mosaic = bpy.data.images.get(ids.MOSAIC)
    owner = None if mosaic is None else scanner_of(mosaic)
    return owner is None or owner in scene.collection.children_recursive[:]


def projection_name(number: int, numbers: list[int]) -> str:
    """Return the name of the exact image of module `number` in a run of the modules `numbers`."""
    return ids.projection_name(number, max(numbers))


def _color(projections: NDArray[np.float32], display: Display, progress: Progress | None = None) -> list[bytes]:
    """Return the pictures of projections (M, n_v, n_u) in one window, as PNG files; `progress` counts them."""
    window = display.window(projections)
    shown_pictures = block_means(as_seen(display.part(projections)), _MAX_PIXELS)
    return _make_all(lambda picture: png_bytes(display.colored(picture, window), _PNG_LEVEL), shown_pictures, progress)


def _draw_mosaic(
    projections: NDArray[np.float32], texts: list[str], rings: list[int], unit: str, display: Display
) -> tuple[bytes, MosaicSheet]:
    """Return the mosaic of projections (M, n_v, n_u), with a text in each tile, as a PNG file, and its layout."""
    layout = draw_sheet(projections, texts, rings, unit, display)
    return png_bytes(layout.picture, _PNG_LEVEL), layout


def _make_all(make: Callable[[Any], bytes], pictures: NDArray[np.float32], progress: Progress | None) -> list[bytes]:
    """Return the files that `make` returns for the pictures, made in several threads."""
    files: list[bytes] = []
    with ThreadPoolExecutor(memory.cores()) as pool:
        for file in pool.map(make, pictures):
            files.append(file)
            tell(progress, len(files), len(pictures))
    return files


def _store_tiles(
    image: bpy.types.Image,
    layout: MosaicSheet,
    numbers: list[int],
    rings: list[int],
    unit: str,
    display: Display | None,
) -> None:
    """Store the mosaic's layout on its image, and the display of all pictures; None if they have different ones."""
    image[_TILES] = {
        "numbers": numbers, "rings": rings, "unit": unit, "corners": layout.corners.ravel().tolist(), "tile": layout.tile,
        "window": layout.window, "summed": layout.summed, "totals": layout.totals.tolist(), "maxima": layout.maxima.tolist(),
        "half": layout.half, "share": layout.share,
        "display": repr(display),
    }  # fmt: skip


def store_difference(layout: MosaicSheet, numbers: list[int], unit: str, text: str) -> bpy.types.Image:
    """Store the image of the difference of two runs until other projections are shown; `text` has its numbers."""
    image = _store_image(ids.DIFFERENCE, png_bytes(layout.picture, _PNG_LEVEL))
    _store_tiles(image, layout, numbers, [], unit, None)
    image[_TEXT] = text
    return image


def store_png(name: str, file: bytes) -> bpy.types.Image:
    """Store a PNG of a reconstruction or of residuals as the image of that name, until other projections are shown."""
    image = _store_image(name, file)
    windows.redraw("IMAGE_EDITOR")
    return image


def _store_image(name: str, file: bytes) -> bpy.types.Image:
    """Return our image of that name with the contents of a PNG; it is saved even while nothing shows it."""
    old = bpy.data.images.get(name)
    image = _new_picture(name, file) if old is None else fill(old, file)
    image.use_fake_user, image[_KEY] = True, True
    return image


def difference_text() -> str:
    """Return the text with the numbers of the difference between runs that was drawn last; "" where there is none."""
    image = bpy.data.images.get(ids.DIFFERENCE)
    return str(image.get(_TEXT, "")) if image is not None else ""


def is_ours(image: bpy.types.Image | None) -> bool:
    """Return whether an image is of a run."""
    return image is not None and bool(image.get(_KEY))


def clear() -> None:
    """Remove all images of runs."""
    bpy.data.batch_remove([image for image in bpy.data.images if _KEY in image])


def is_exact(image: bpy.types.Image) -> bool:
    """Return whether an image holds the exact numbers of a module's projection."""
    return _KEY in image and image.is_float


def projection_array(image: bpy.types.Image) -> NDArray[np.float32]:
    """Return the projection (n_v, n_u) that a module's exact image holds, in the arrays' order."""
    was_read = image.has_data
    width, height = image.size
    pixels = np.empty(4 * width * height, np.float32)
    image.pixels.foreach_get(pixels)
    if not was_read and image.packed_file is not None:
        image.buffers_free()  # the buffer has four times the size of the numbers
    return np.ascontiguousarray(pixels.reshape(height, width, 4)[:, ::-1, 0])


def show(image: bpy.types.Image, context: bpy.types.Context) -> bool:
    """Show an image in an Image Editor that shows it, or else in the largest free one; return False if there is none."""
    editors = _editors(context)
    targets = [editor for editor in editors if editor[1].spaces.active.image == image] or editors[-1:]
    for window, area in targets:
        area.spaces.active.image = image
        _fit(window, area)
    return bool(targets)


def show_file(path: Path, context: bpy.types.Context) -> None:
    """Show a picture file until other projections are shown."""
    existing = set(bpy.data.images)
    image = bpy.data.images.load(str(path), check_existing=True)
    image.reload()  # the file may be newer
    if image not in existing:
        image[_KEY] = False
    show_below(image, context)


def _editors(context: bpy.types.Context) -> list[tuple[bpy.types.Window, bpy.types.Area]]:
    """Return the free Image Editors: those that show no image, or one of ours; the largest is the last."""
    editors = []
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            space = area.spaces.active
            if area.type == "IMAGE_EDITOR" and space.mode == "VIEW" and (space.image is None or _KEY in space.image):
                editors.append((window, area))
    return sorted(editors, key=lambda editor: editor[1].width * editor[1].height)


def before_undo(*_: Any) -> None:
    """Note the pictures in the free Image Editors: those whose image an undo or redo makes anew would show none."""
    pictures = ((area, area.spaces.active.image) for _, area in _editors(bpy.context))
    _names_before_undo.update({area: image.name for area, image in pictures if image is not None})


def after_undo(*_: Any) -> None:
    """Show pictures again in the editors that had them, when an undo or redo has brought them back."""
    for window, area in _editors(bpy.context):
        image = bpy.data.images.get(_names_before_undo.get(area, ""))
        if image not in (None, area.spaces.active.image):
            area.spaces.active.image = image
            _fit(window, area)


def editor_size(context: bpy.types.Context) -> tuple[int, int, float] | None:
    """Return width and height, pixels, that `show` gives a picture, and the scale of its texts; None without an editor."""
    editors = _editors(context)
    return (*_picture_size(editors[-1][1]), context.preferences.system.ui_scale) if editors else None


def _picture_size(area: bpy.types.Area) -> tuple[int, int]:
    """Return width and height, pixels, of an Image Editor above the bar for notes."""
    region = next(region for region in area.regions if region.type == "WINDOW")
    return region.width, region.height - round(BAR * bpy.context.preferences.system.ui_scale)


PROJECTED: reports.Need = (lambda context: ids.MOSAIC in bpy.data.images, "No projections yet: render them first")
"""Requirement of an operator: there are projections."""


def show_below(image: bpy.types.Image, context: bpy.types.Context) -> bool:
    """Show an image, in a new Image Editor below the largest 3D view if none is free; return False without a window."""
    return open_editor(context) and show(image, context)


def open_editor(context: bpy.types.Context) -> bool:
    """Open an Image Editor below the largest 3D view unless one is free; return False without a window."""
    window = context.window
    views = [a for a in window.screen.areas if a.type == "VIEW_3D"] if window else []
    if _editors(context) or not views:
        return bool(_editors(context))
    view = max(views, key=lambda a: a.width * a.height)
    old_areas = set(window.screen.areas)
    with context.temp_override(window=window, area=view, region=view.regions[-1]):
        bpy.ops.screen.area_split(direction="HORIZONTAL", factor=_EDITOR_SHARE)
    new_areas = [a for a in window.screen.areas if a not in old_areas]
    area = min([*new_areas, view], key=lambda a: a.y)
    area.type = "IMAGE_EDITOR"
    area.spaces.active.image, area.spaces.active.show_gizmo = None, False  # gizmos would hide the colour bar
    return True


def _fit(window: bpy.types.Window, area: bpy.types.Area) -> None:
    """Show all of an editor's image above the bar for notes; pixel by pixel if it has just that size."""
    region = next((r for r in area.regions if r.type == "WINDOW"), None)
    if region is None or bpy.app.background:
        return
    area.tag_redraw()

    def fit() -> None:  # called after the redraw, when a new editor knows its size
        """Fit the image to the editor."""
        try:
            with bpy.context.temp_override(window=window, area=area, region=region):
                size, free = tuple(area.spaces.active.image.size), _picture_size(area)
                zoom = min(free[0] / size[0], free[1] / size[1]) * (1.0 if size == free else _FILLED_SHARE)
                bpy.ops.image.view_all(fit_view=True)  # centres it in the region
                bpy.ops.image.view_zoom_ratio(ratio=zoom)
                bpy.ops.image.view_pan(offset=(0.0, -(region.height - free[1]) / 2 / zoom))
        except (RuntimeError, ReferenceError, TypeError, AttributeError):
            pass  # the window or the editor has been closed

    bpy.app.timers.register(fit, first_interval=0.2)


def _new_picture(name: str, png: bytes) -> bpy.types.Image:
    """Return a new image with the contents of a PNG file."""
    return _load_pixels(fill(bpy.data.images.new(name, 1, 1), png))


def _load_pixels(image: bpy.types.Image) -> bpy.types.Image:
    """Make Blender read an image's pixels now, in a step of its own, and not when all images are first drawn."""
    len(image.pixels)
    return image


def fill(image: bpy.types.Image, file: bytes) -> bpy.types.Image:
    """Pack the contents of a file into an image, so that it shows them, and return the image."""
    image.pack(data=file, data_len=len(file))
    if image.source != "FILE":
        image.source = "FILE"
    else:
        image.buffers_free()
        image.update()
    return image


def _replace_images(new: dict[str, bpy.types.Image]) -> None:
    """Give new images their names, in place of all our earlier images."""
    old = {image for image in bpy.data.images if _KEY in image}
    for name, image in new.items():
        namesake = bpy.data.images.get(name)
        if namesake in old and namesake.users > namesake.use_fake_user:
            namesake.user_remap(image)
        elif namesake is not None and namesake not in old and namesake != image:  # the user's image has our name
            namesake.name = f"{name}.other"
        image.use_fake_user = True  # saves the image even while nothing shows it
    bpy.data.batch_remove(old)
    for name, image in new.items():
        image.name, image[_KEY] = name, True
