"""Projections as Blender images, shown as the pinhole sees them: +v up, +u left.

The arrays' column index grows along +u, so an image's columns are reversed; its rows start at the bottom, as the arrays' do.
Each module has two: one holds the exact float32 numbers in R, G and B, the other, as the mosaic, shows them in colours.
"""

from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core import PinholeSystem, ProjectionRun, Views, memory
from ...core.progress import Progress, part_of, tell
from ...core.runs.display import Display
from ...core.runs.exr import exr_bytes
from ...core.runs.mosaic import MosaicSheet, as_seen, block_means, draw_sheet, module_labels, png_bytes
from ..blender import ids, jobs, reports, windows

_KEY = "mphdrr_projection"  # custom property: marks the images that a new run replaces; False of those of no run
_ARRAYS = ("sources", "detector_centers", "u_steps", "v_steps")
_PIXELS = 2.2e7
"""About as many all pictures have together: larger images are shown smaller, since drawing a picture takes memory again."""
_PNG_LEVEL = 1  # fast
BAR = 24
"""Pixels at a resolution scale of 1 at the bottom of an Image Editor that are left free for notes (`run_notes`)."""
_SHARE = 0.97  # of its editor that a picture of another size takes: buttons at the edges do not cover it
_BELOW = 0.4  # of the 3D view's height: an Image Editor that is opened below it
_WAIT = 0.005  # s between two looks at a thread
_SCANNER = "mphdrr_scanner"  # custom property of the mosaic: the collection of the scanner that the run is of
_TEXT = "mphdrr_difference"  # custom property of a difference: its numbers, in words
_LABELS = "mphdrr_labels"  # custom property of the mosaic: what stands in each of its images, line by line
_TILES = "mphdrr_tiles"  # custom property of the mosaic: its modules, unit, and where in it which one's image is
_VIEWS = "mphdrr_views"  # custom property of the mosaic: the run's views, as arrays of `Views`, and their ROI radii


@dataclass(frozen=True)
class Pictures:
    """Files with what the images of a run hold, made in a thread."""

    display: Display
    exact: list[bytes]  # OpenEXR, of float32
    colored: list[bytes]  # PNG
    mosaic: bytes  # PNG
    drawn: MosaicSheet  # what is where in the mosaic


def pictures(run: ProjectionRun, display: Display, progress: Progress | None = None) -> Pictures:
    """Make the contents of a run's images; leaves bpy alone. `progress` counts the files."""
    exact = _in_threads(exr_bytes, as_seen(run.projections), part_of(progress, 0, 2))
    rings = run.system.rings().tolist()
    colored = _colored(run.projections, display, part_of(progress, 1, 2))
    return Pictures(display, exact, colored, *_mosaic(run.projections, module_labels(run), rings, run.unit, display))


def storing(run: ProjectionRun, made: Pictures) -> Generator[tuple[str, int, int] | None, None, bpy.types.Image]:
    """Make images of a run, packed into the .blend, in place of those of an earlier run.

    For each module one of the exact numbers, float32, and one to look at; and the mosaic, which is returned. Yields
    between steps, so that a window can be drawn; what ends it there leaves the earlier run's images as they are.
    `made` is what `pictures` has made.
    """
    numbers = run.system.numbers.tolist()
    new: dict[str, bpy.types.Image] = {}
    try:
        for k, (number, exact, colored) in enumerate(zip(numbers, made.exact, made.colored, strict=True)):
            yield "storing", k, len(numbers)
            name = projection_name(number, numbers)
            new[name] = bpy.data.images.new(name, 1, 1, float_buffer=True, is_data=True)
            filled(new[name], exact)
            new[ids.picture_name(name)] = _new_picture(ids.picture_name(name), colored)
        yield "storing", len(numbers), len(numbers)
        new[ids.MOSAIC] = _new_picture(ids.MOSAIC, made.mosaic)  # as large as all: it has a turn of its own
        yield "storing", len(numbers), len(numbers)
    except BaseException:
        bpy.data.batch_remove(new.values())
        raise
    _put_in_place(new)
    mosaic = new[ids.MOSAIC]
    _describe(mosaic, made.drawn, numbers, run.system.rings().tolist(), run.unit, made.display)
    mosaic[_LABELS] = "\n".join(module_labels(run))
    arrays = {name: getattr(run.views, name).ravel().tolist() for name in _ARRAYS}
    system = run.system
    radii = system.roi_radius if isinstance(system, PinholeSystem) else np.full(len(system), system.region_radius())
    mosaic[_VIEWS] = arrays | {"shape": run.views.shape, "roi_radius": radii.tolist()}
    return mosaic


def showing_again(display: Display, kept: dict[int, NDArray[np.float32]]) -> Generator[bool, None, None]:
    """Make the pictures anew from the exact images, as `display` says; nothing where there is no run.

    Yields between its steps whether the mosaic, which is the first, is made. `kept` holds the numbers that were read, by the
    mosaic's `session_uid`, for the next time.
    """
    mosaic = bpy.data.images.get(ids.MOSAIC)
    shown = tiles(mosaic)
    if mosaic is None or shown is None:
        return
    numbers, rings, unit = (shown[name] for name in ("numbers", "rings", "unit"))
    texts = str(mosaic[_LABELS]).split("\n") if _LABELS in mosaic else list(map(str, numbers))
    names, uid = [projection_name(number, numbers) for number in numbers], mosaic.session_uid
    if uid not in kept:
        found = []
        for name in names:
            if (exact := bpy.data.images.get(name)) is None:
                return
            found.append(projection_array(exact))
            yield False
        kept.clear()
        kept[uid] = np.stack(found)
        del found
    projections = kept[uid]
    file, drawn = yield from _in_thread(lambda progress: _mosaic(projections, texts, rings, unit, display), False)
    mosaic = filled(bpy.data.images[ids.MOSAIC], file)
    _describe(_read_now(mosaic), drawn, numbers, rings, unit, None)
    files = yield from _in_thread(lambda progress: _colored(projections, display, progress), True)
    for name, file in zip(names, files, strict=True):
        picture = bpy.data.images.get(ids.picture_name(name))
        if picture is not None:
            _read_now(filled(picture, file))
            yield True
    _describe(bpy.data.images[ids.MOSAIC], drawn, numbers, rings, unit, display)


def _in_thread(make: Callable[[Progress], Any], is_mosaic_made: bool) -> Generator[bool, None, Any]:
    """What `make` makes in a thread; yields `is_mosaic_made` meanwhile."""
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
    """What the mosaic shows: `numbers` and `rings` of its modules, `unit`, the tiles' size `tile` and `corners`; else None.

    Rows and columns are counted from the top left. `window` is that of the colours; `totals` are what `summed` says of each
    image, "sum" or "mean", `maxima` their largest numbers, and `half` whether only their middle halves are meant and shown.
    `display` is how all pictures are shown, "None" while they are made. Files
    of earlier versions lack these six.
    """
    return None if image is None or _TILES not in image else image[_TILES].to_dict()


def views_of(mosaic: bpy.types.Image) -> tuple[Views, NDArray[np.float64]] | None:
    """The views of the mosaic's run, in its modules' order, and the radii of their ROIs (M,), mm.

    None in files of versions that did not keep them, until a run is shown anew.
    """
    if _VIEWS not in mosaic:
        return None
    kept = mosaic[_VIEWS].to_dict()
    arrays: dict[str, Any] = {name: np.reshape(kept[name], (-1, 3)) for name in _ARRAYS}
    n_v, n_u = kept["shape"]
    return Views(**arrays, shape=(n_v, n_u)), np.array(kept["roi_radius"])


def share_shown() -> tuple[float, float]:
    """What the pictures show of the width and height of the exact images."""
    mosaic = bpy.data.images.get(ids.MOSAIC)
    x, y = (1.0, 1.0) if mosaic is None or _TILES not in mosaic else mosaic[_TILES].get("share", (1.0, 1.0))
    return x, y


def set_scanner(mosaic: bpy.types.Image, collection: bpy.types.Collection | None) -> None:
    """Note which scanner the mosaic's run is of."""
    if collection is not None:
        mosaic[_SCANNER] = collection
    elif _SCANNER in mosaic:
        del mosaic[_SCANNER]


def scanner_of(mosaic: bpy.types.Image) -> bpy.types.Collection | None:
    """The scanner that the mosaic's run is of; None where it has been removed."""
    return mosaic.get(_SCANNER)


def is_of(scene: bpy.types.Scene) -> bool:
    """Whether the images are of a run of that scene, as far as is known."""
    mosaic = bpy.data.images.get(ids.MOSAIC)
    owner = None if mosaic is None else scanner_of(mosaic)
    return owner is None or owner in scene.collection.children_recursive[:]


def projection_name(number: int, numbers: list[int]) -> str:
    """Name of the exact image of the module `number` of a run of the modules `numbers`."""
    return ids.projection_name(number, max(numbers))


def _colored(projections: NDArray[np.float32], display: Display, progress: Progress | None = None) -> list[bytes]:
    """The pictures of projections (M, n_v, n_u) in one window, as PNG files; `progress` counts them."""
    window = display.window(projections)
    shown = block_means(as_seen(display.part(projections)), _PIXELS)
    return _in_threads(lambda picture: png_bytes(display.colored(picture, window), _PNG_LEVEL), shown, progress)


def _mosaic(
    projections: NDArray[np.float32], texts: list[str], rings: list[int], unit: str, display: Display
) -> tuple[bytes, MosaicSheet]:
    """The mosaic of projections (M, n_v, n_u), with a text in each, as a PNG file, and what is where in it."""
    drawn = draw_sheet(projections, texts, rings, unit, display)
    return png_bytes(drawn.picture, _PNG_LEVEL), drawn


def _in_threads(make: Callable[[Any], bytes], pictures: NDArray[np.float32], progress: Progress | None) -> list[bytes]:
    """What `make` makes of each picture."""
    files: list[bytes] = []
    with ThreadPoolExecutor(memory.cores()) as pool:
        for file in pool.map(make, pictures):
            files.append(file)
            tell(progress, len(files), len(pictures))
    return files


def _describe(
    image: bpy.types.Image, drawn: MosaicSheet, numbers: list[int], rings: list[int], unit: str, display: Display | None
) -> None:
    """Note on the mosaic what is where in it, and which display the pictures show; None: not all of them one."""
    image[_TILES] = {
        "numbers": numbers, "rings": rings, "unit": unit, "corners": drawn.corners.ravel().tolist(), "tile": drawn.tile,
        "window": drawn.window, "summed": drawn.summed, "totals": drawn.totals.tolist(), "maxima": drawn.maxima.tolist(),
        "half": drawn.half, "share": drawn.share,
        "display": repr(display),
    }  # fmt: skip


def store_difference(drawn: MosaicSheet, numbers: list[int], unit: str, text: str) -> bpy.types.Image:
    """Make the image of a difference of two runs, until other projections are shown; `text` says its numbers."""
    image = _store(ids.DIFFERENCE, png_bytes(drawn.picture, _PNG_LEVEL))
    _describe(image, drawn, numbers, [], unit, None)
    image[_TEXT] = text
    return image


def store_drawn(name: str, file: bytes) -> bpy.types.Image:
    """Make the image of that name, of a PNG, until other projections are shown: of a reconstruction, or of residuals."""
    image = _store(name, file)
    windows.redraw("IMAGE_EDITOR")
    return image


def _store(name: str, file: bytes) -> bpy.types.Image:
    """One of our images of that name, showing a PNG; saved while nothing shows it."""
    old = bpy.data.images.get(name)
    image = _new_picture(name, file) if old is None else filled(old, file)
    image.use_fake_user, image[_KEY] = True, True
    return image


def difference_text() -> str:
    """The numbers of the difference that was drawn last; "" where there is none."""
    image = bpy.data.images.get(ids.DIFFERENCE)
    return str(image.get(_TEXT, "")) if image is not None else ""


def is_ours(image: bpy.types.Image | None) -> bool:
    """Whether an image is of a run."""
    return image is not None and bool(image.get(_KEY))


def clear() -> None:
    """Remove all images of runs."""
    bpy.data.batch_remove([image for image in bpy.data.images if _KEY in image])


def is_exact(image: bpy.types.Image) -> bool:
    """Whether an image holds the exact numbers of a module's projection."""
    return _KEY in image and image.is_float


def projection_array(image: bpy.types.Image) -> NDArray[np.float32]:
    """The projection (n_v, n_u) that a module image holds, in the arrays' order."""
    was_read = image.has_data
    width, height = image.size
    pixels = np.empty(4 * width * height, np.float32)
    image.pixels.foreach_get(pixels)
    if not was_read and image.packed_file is not None:
        image.buffers_free()  # four times the size of the numbers
    return np.ascontiguousarray(pixels.reshape(height, width, 4)[:, ::-1, 0])


def show(image: bpy.types.Image, context: bpy.types.Context) -> bool:
    """Show an image in an Image Editor that shows it, or the largest one that shows none or one of ours; False without."""
    editors = _editors(context)
    chosen = [each for each in editors if each[1].spaces.active.image == image] or editors[-1:]
    for window, area in chosen:
        area.spaces.active.image = image
        _fit(window, area)
    return bool(chosen)


def show_file(path: Path, context: bpy.types.Context) -> None:
    """Show a picture that was written to a file, until other projections are shown."""
    known = set(bpy.data.images)
    image = bpy.data.images.load(str(path), check_existing=True)
    image.reload()  # the file may be newer
    if image not in known:
        image[_KEY] = False
    show_below(image, context)


def _editors(context: bpy.types.Context) -> list[tuple[bpy.types.Window, bpy.types.Area]]:
    """The Image Editors that nobody works in: they show none, or one of our pictures; the largest is the last."""
    found = []
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            space = area.spaces.active
            if area.type == "IMAGE_EDITOR" and space.mode == "VIEW" and (space.image is None or _KEY in space.image):
                found.append((window, area))
    return sorted(found, key=lambda each: each[1].width * each[1].height)


def room(context: bpy.types.Context) -> tuple[int, int, float] | None:
    """Width and height, pixels, that a picture fills in the editor in which `show` shows it, and the scale of its texts.

    None where no such editor is open.
    """
    editors = _editors(context)
    return (*_room(editors[-1][1]), context.preferences.system.ui_scale) if editors else None


def _room(area: bpy.types.Area) -> tuple[int, int]:
    region = next(region for region in area.regions if region.type == "WINDOW")
    return region.width, region.height - round(BAR * bpy.context.preferences.system.ui_scale)


PROJECTED: reports.Need = (lambda context: ids.MOSAIC in bpy.data.images, "No projections yet: render them first")


def show_below(image: bpy.types.Image, context: bpy.types.Context) -> bool:
    """Like `show`, but open an Image Editor below the largest 3D view if none is free; False without a window."""
    return open_editor(context) and show(image, context)


def open_editor(context: bpy.types.Context) -> bool:
    """Open an Image Editor below the largest 3D view, unless there is one that nobody works in; False without a window."""
    window = context.window
    views = [a for a in window.screen.areas if a.type == "VIEW_3D"] if window else []
    if _editors(context) or not views:
        return bool(_editors(context))
    view = max(views, key=lambda a: a.width * a.height)
    before = set(window.screen.areas)
    with context.temp_override(window=window, area=view, region=view.regions[-1]):
        bpy.ops.screen.area_split(direction="HORIZONTAL", factor=_BELOW)
    new = [a for a in window.screen.areas if a not in before]
    area = min([*new, view], key=lambda a: a.y)
    area.type = "IMAGE_EDITOR"
    area.spaces.active.image, area.spaces.active.show_gizmo = None, False  # they would hide the colour bar
    return True


def _fit(window: bpy.types.Window, area: bpy.types.Area) -> None:
    """Show all of an editor's image, above the bar where notes stand; one that is as large as its room, pixel by pixel."""
    region = next((r for r in area.regions if r.type == "WINDOW"), None)
    if region is None or bpy.app.background:
        return
    area.tag_redraw()

    def fit() -> None:  # after the redraw, when a new editor knows its size
        try:
            with bpy.context.temp_override(window=window, area=area, region=region):
                width, height = area.spaces.active.image.size
                (across, up), whole = _room(area), region.height
                zoom = min(across / width, up / height) * (1.0 if (width, height) == (across, up) else _SHARE)
                bpy.ops.image.view_all(fit_view=True)  # its middle is the region's
                bpy.ops.image.view_zoom_ratio(ratio=zoom)
                bpy.ops.image.view_pan(offset=(0.0, -(whole - up) / 2 / zoom))
        except (RuntimeError, ReferenceError, TypeError, AttributeError):
            pass  # the window or the editor was closed meanwhile

    bpy.app.timers.register(fit, first_interval=0.2)


def _new_picture(name: str, png: bytes) -> bpy.types.Image:
    return _read_now(filled(bpy.data.images.new(name, 1, 1), png))


def _read_now(image: bpy.types.Image) -> bpy.types.Image:
    """Have an image's pixels read in a step of its own, and not when all are first drawn."""
    len(image.pixels)
    return image


def filled(image: bpy.types.Image, file: bytes) -> bpy.types.Image:
    """Pack the contents of a file into an image, which shows it from now on."""
    image.pack(data=file, data_len=len(file))
    if image.source != "FILE":
        image.source = "FILE"
    else:
        image.buffers_free()
        image.update()
    return image


def _put_in_place(new: dict[str, bpy.types.Image]) -> None:
    """Give new images their names; they replace all our images of before."""
    old = {image for image in bpy.data.images if _KEY in image}
    for name, image in new.items():
        before = bpy.data.images.get(name)
        if before in old and before.users > before.use_fake_user:
            before.user_remap(image)
        elif before is not None and before not in old and before != image:  # somebody else's image has our name
            before.name = f"{name}.other"
        image.use_fake_user = True  # or it is not saved while nothing shows it
    bpy.data.batch_remove(old)
    for name, image in new.items():
        image.name, image[_KEY] = name, True
