"""Figures of the scene: those of `core.figures`, and those that Blender renders by Cycles in a scene of their own.

Neither needs a window or a graphics card.
"""

import glob
import sys
import tempfile
import threading
from collections.abc import Callable, Generator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from ...core import PinholeSystem, Progress, files, read_run
from ...core.cli.options import output_path
from ...core.errors import InputError
from ...core.figures.kinds import KINDS, SAMPLES, FigureKind, Rendering, figure_kind
from ...core.figures.page import DARK, Page
from ...core.figures.parts import bar_width, color_bar, heading, heading_height
from ...core.figures.subject import FigureSubject, require
from ...core.runs.display import resize_picture
from ..blender import ids, jobs, storage, timers, windows
from ..blender.choices import items
from ..phantoms import phantoms
from ..pictures import images
from ..scanner import pinholes, scanner, selection
from ..volumes import looks, volumes
from . import engine, surfaces
from .stage import DIRECTION, FigureScene

Step = tuple[str, int, int] | None
"""Progress of a figure, as a job's finishing yields it (`jobs.Finishing`)."""
_MISSING = {
    "scanner": "no scanner in the scene: import a workbook first",
    "volume": "no volume in the scene: add a phantom first",
    "run": "no projections: render them first",
}
_MAX_RUNS = 6  # number of ranges of module numbers that a title lists
_PAUSE = 0.5  # s between two checks of Blender's own render job
# A volume is visible if it changes a small picture, so many pixels wide, by more than this, of 255.
_SMALL_SIZE, _THRESHOLD = 240, 8
_known_visible: set[tuple[str, str, float, float]] = set()  # files and looks of volumes that Cycles has drawn
_UNSEEN = ": its file is missing, Low and High draw none of its values, or this Blender's Cycles draws no volumes"
_DRAWING = "Drawing the figure"
_PERCENT = 100  # of the progress of a picture, of which the first part is the reading of what it shows
_READING = 15
_AXES = {"dark": ("#ff8a80", "#8ee59a", "#8cb8ff"), "light": ("#c62828", "#2e7d32", "#1f57c3")}  # x, y and z
_STEPS = (1.0, 2.0, 5.0)  # leading digits of scale bars' lengths
_BAR_SHARE = 0.2  # largest length of a scale bar, relative to the picture's width


class Reel(threading.Event):
    """Pictures of an animation so far; the event is set to end the animation with these."""

    pictures: Sequence[Path] = ()


def kind_items(films: bool = False) -> tuple[tuple[Any, ...], ...]:
    """Return the kinds of animations, or of other figures, as choices of an enumeration."""
    kinds = (kind for kind in KINDS.values() if bool(kind.motion) == films)
    return items({}, ((kind.name.upper().replace("-", "_"), kind.label, kind.summary) for kind in kinds))


def figure_job(
    context: bpy.types.Context,
    name: str,
    paths: Sequence[Path],
    size: tuple[int, int] | None = None,
    modules: str | None = None,
    **style: Any,
) -> jobs.Job:
    """Return the job that writes a figure of the context's scene to files (.png, .svg; .mp4), `size` pixels wide and high.

    `modules` are all by default; for a figure of one module, the active one; for a picture the selected ones, if there are
    several. `style` are the fields of `core.figures.kinds.Rendering`. Raises InputError where the scene lacks what the
    figure needs.
    """
    options = Rendering(**style)
    kind, scene = figure_kind(name), context.scene
    page = kind.page(size, options)
    paths = [output_path(str(path), kind.suffixes, is_new=False) for path in paths]
    collection = scanner.active_scanner(scene)
    item = _volume_item(context) if "volume" in kind.needs else None
    active = selection.active_module(context)
    if kind.one_module and modules is None and active is not None:
        modules = str(active.mphdrr_module.number)
    selected = [camera.mphdrr_module.number for camera in selection.selected_modules(context)]
    if kind.studio is not None and kind.studio.lit and modules is None and len(selected) > 1:
        modules = ",".join(map(str, selected))
    subject_values: dict[str, Any] = {"modules": modules, "display": scene.mphdrr_display.display()}
    if collection is not None:
        subject_values["scanner"] = scanner.read_scanner(collection)
        subject_values["construction"] = pinholes.construction(collection.mphdrr_scanner)
    readers: dict[str, Callable[[], Any]] = {}
    make_surface = None if item is None or kind.studio is None else surfaces.surface_maker(item)
    if item is not None:
        pose = volumes.pose_of_object(item)
        readers["volume"], subject_values["name"] = volumes.reader(item), item.name
        if phantoms.settings_of(item) is not None or not np.array_equal(pose, np.eye(4)):
            subject_values["pose"] = pose
    run_file = scene.mphdrr_projections.run_file
    if "run" in kind.needs and run_file:
        readers["run"] = partial(read_run, storage.absolute(run_file))
    require(kind.needs, {*subject_values, *readers}, kind.name, _MISSING)

    def work(progress: Progress) -> tuple[FigureSubject, surfaces.Surface | None]:
        """Read what the figure needs from files, and return its subject and its volume's surface."""
        progress(0, _PERCENT)
        read_values = {key: read() for key, read in readers.items()}
        if "run" in read_values:
            subject_values["name"] = read_values["run"].settings.get("volume", "")
        subject = FigureSubject(**subject_values, **read_values)
        if make_surface is None or subject.volume is None:
            return subject, None
        share = 0 if kind.motion else _READING
        return subject, make_surface(subject.volume, lambda n_done, total: progress(share * n_done // total, _PERCENT))

    reel = Reel()

    def finish(result: tuple[FigureSubject, surfaces.Surface | None]) -> Generator[Step, None, str]:
        """Draw the figure step by step, write and show it, and return the line to report."""
        yield from draw_figure(page, *result, kind, paths, options, reel)
        if windows.has_window() and paths[0].suffix == ".png":
            images.show_file(paths[0], bpy.context)
        return f"Wrote {', '.join(map(str, paths))}"

    def leftovers() -> str:
        """Return the line for a cancelled job: the folder of the pictures that were drawn."""
        pictures = reel.pictures
        return f"{len(pictures)} pictures are in {pictures[0].parent}" if pictures else "nothing was changed"

    return jobs.Job(_DRAWING, work, finish, finish_now=reel if kind.motion else None, leftovers=leftovers)


def draw_figure(
    page: Page,
    subject: FigureSubject,
    surface: surfaces.Surface | None,
    kind: FigureKind,
    paths: Sequence[Path],
    style: Rendering,
    reel: Reel,
) -> Generator[Step, None, None]:
    """Draw a figure on its page and write it to `paths`; yield the progress.

    `surface` is that of the volume to render. A film's pictures, in the folder NAME-frames beside NAME.mp4, stay if the
    work is ended; where `reel` is set, the film ends with the pictures so far.
    """
    if kind.draw is not None:
        kind.draw(page, subject)
    if kind.studio is not None:
        top, right = (heading_height(page, 1), _bar_room(page, surface)) if style.labels else (0, 0)
        stage = FigureScene(subject, kind, surface, (page.width - right, page.height - top), page.paper)
        try:
            engine.set_up(stage.scene, stage.size, style.samples)
            for path in paths if kind.motion else ():
                yield from _render_film(stage, style, path, page, reel)
            if not kind.motion:
                for share in _render_picture(stage, style, page):
                    yield _DRAWING, _READING + round((_PERCENT - _READING) * share), _PERCENT
                yield _DRAWING, _PERCENT, _PERCENT
        finally:
            stage.remove()
    for path in () if kind.motion else paths:
        page.write(path)


def _render_film(
    stage: FigureScene, style: Rendering, path: Path, blank: Page, reel: Reel
) -> Generator[Step, None, None]:
    """Render an animation's pictures, and join them to an MP4."""
    pictures = reel.pictures = []
    folder = files.ensure_folder(path.with_name(f"{path.stem}-frames"))
    for old_picture in folder.glob(f"{glob.escape(path.stem)}-[0-9][0-9][0-9][0-9].png"):
        old_picture.unlink()  # an older animation may have been longer
    shown_moment, page = None, blank
    for k in range(style.frames):
        if (moment := stage.moment(k / style.frames)) != shown_moment:
            stage.show(*moment)
            shown_moment, page = moment, Page(blank.width, blank.height, blank.paper)
            yield from (None for _ in _render_picture(stage, style, page))
        pictures.append(folder / f"{path.stem}-{k + 1:04d}.png")
        page.write(pictures[-1])
        yield "rendering", k + 1, style.frames
        if reel.is_set():
            break
    yield from engine.write_film(pictures, path, style.fps, page)


def _render_picture(stage: FigureScene, style: Rendering, page: Page) -> Generator[float, None, None]:
    """Render a figure's scene, as it is now, onto a page below its title; yield the share that is done."""
    width, height = stage.size
    page.image((yield from _render_pixels(stage.scene)), 0, page.height - height, width, height)
    if style.labels:
        _label(stage, page)


def _bar_room(page: Page, surface: surfaces.Surface | None) -> int:
    """Return the width, pixels, that a surface's colour bar takes beside the picture."""
    return 0 if surface is None else bar_width(page, surface.display, surface.window, surface.unit) + round(2 * page.em)


def _label(stage: FigureScene, page: Page) -> None:
    """Write title, axes, scale bar and colour bar around a picture."""
    em, title, line, surface = page.em, *_titles(stage), stage.surface
    heading(page, title, [line], page.ink, page.faint)
    _draw_axes(page, stage.camera)
    if not stage.studio.volume:
        return
    longest = _BAR_SHARE * page.width / stage.pixels_per_mm
    length = max(n * 10.0**k for n in _STEPS for k in range(-3, 5) if n * 10.0**k <= longest)
    end, row = page.width - 6.5 * em, 3.3 * em
    start = end - length * stage.pixels_per_mm
    page.line([(start, row), (end, row)], page.ink, 0.25 * em)
    page.text(f"{length:g} mm", (start + end) / 2, row - 0.6 * em, em, page.ink, "middle")
    if surface is not None:
        column = page.width - _bar_room(page, surface) + round(em)
        height = min(round(16 * em), stage.size[1] - round(5 * em))
        top = page.height - (stage.size[1] + height) // 2
        color_bar(page, surface.display, surface.window, surface.unit, column, top, height)


def _volume_item(context: bpy.types.Context) -> bpy.types.Object | None:
    """Return the active volume, else the panel's, else the only one; None where there is none."""
    scene_volumes = volumes.volume_objects(context.scene)
    for candidate in (context.object, context.scene.mphdrr_projections.volume):
        if candidate in scene_volumes:
            return candidate
    if len(scene_volumes) > 1:
        raise InputError(f"choose what to show: there are {len(scene_volumes)} volumes; select one")
    return scene_volumes[0] if scene_volumes else None


def _titles(stage: FigureScene) -> tuple[str, str]:
    """Return the title of a rendered figure and the line below it."""
    numbers = np.array(stage.ray_numbers if stage.studio.lit else stage.system.numbers)
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
    listed = ", ".join(f"{run[0]}–{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs[:_MAX_RUNS])
    listed += " …" if len(runs) > _MAX_RUNS else ""
    modules = f"{'Module' if len(numbers) == 1 else 'Modules'} {listed}"
    name, roi = stage.subject.name if stage.studio.volume else "", f"ROI of radius {stage.radius:g} mm"
    if stage.surface is not None:
        roi += f", surface at {stage.surface.level:.3g} {stage.surface.unit}"
    if stage.studio.lit:
        return name, f"Rays of {modules.lower()} of {len(stage.system)}, {roi}"
    return modules, ", ".join(filter(None, (name, roi)))


def _is_drawn(item: bpy.types.Object) -> bool:
    """Return whether Cycles draws anything of a volume: its look's surfaces, else its smoke, by small pictures."""
    if surfaces_of_look := looks.surfaces_of(item):
        graph = bpy.context.evaluated_depsgraph_get()
        return any(len(surface.evaluated_get(graph).data.polygons) for surface in surfaces_of_look)
    reach = max((item.matrix_world @ Vector(corner)).length for corner in item.bound_box) + 1.0
    sizes, size = reach / np.array([50, 10, 10, 50, 1]), (_SMALL_SIZE,) * 2  # of a small module behind the volume
    subject = FigureSubject(PinholeSystem(-2 * reach * DIRECTION[None], *sizes))
    stage, pictures = FigureScene(subject, figure_kind("inside"), None, size, DARK), []
    try:
        engine.set_up(stage.scene, size, SAMPLES, denoises=False)
        smoke = stage.add_object(item.data)
        smoke.matrix_world = item.matrix_world
        for smoke.hide_render in (True, False):
            list(engine.render_to_file(stage.scene, path := storage.folder() / "small.png"))
            pictures.append(engine.read_pixels(path).astype(int))
    finally:
        stage.remove()
    blocks = resize_picture(pictures[0] - pictures[1], *[_SMALL_SIZE // 8] * 2)  # whose means have less noise
    return bool(np.abs(blocks).max() > _THRESHOLD)


def before_render(scene: bpy.types.Scene, *_: Any) -> None:
    """Report volumes of the 3D views that Blender's own render lacks; in a window, once the render is done."""
    if scene.name.startswith(ids.STUDIO):
        return
    if bpy.app.background:
        _report_unseen()
    else:
        timers.schedule(_report_unseen, _PAUSE)


def _report_unseen() -> float | None:
    """Report the volumes of the 3D views that a render does not show, with the reason; wait while something renders."""
    if jobs.is_running() or bpy.app.is_job_running("RENDER"):
        return _PAUSE
    scene, missing = bpy.context.scene, storage.missing_volumes()
    for item in (item for item in volumes.volume_objects(scene) if item.visible_get()):
        look, reason = item.mphdrr_volume, ""
        key = item.data.filepath, look.look, look.display_low, look.display_high
        if item.hide_render or all(home.hide_render for home in item.users_collection):
            reason = ": it is hidden in renders"
        elif item.data in missing:
            reason = ": its files are missing"
        elif scene.render.engine == "CYCLES" and key not in _known_visible:
            reason = "" if _is_drawn(item) else _UNSEEN
            _known_visible.update([] if reason else [key])
        if reason:
            text = f"the picture shows nothing of {item.name!r}{reason}"
            print(f"mphDRR: {text}", file=sys.stderr)
            if not bpy.app.background:
                draw_line = partial(lambda text, menu, _: menu.layout.label(text=text), text)
                bpy.context.window_manager.popup_menu(draw_line, title="mphDRR", icon="ERROR")
    return None


def _render_pixels(scene: bpy.types.Scene) -> Generator[float, None, NDArray[np.uint8]]:
    """Return the colours (height, width, 3) of a rendered scene; yield the share that is done."""
    with tempfile.TemporaryDirectory(prefix="mphdrr-") as folder:
        path = Path(folder) / "figure.png"
        yield from engine.render_to_file(scene, path)
        return engine.read_pixels(path)


def _draw_axes(page: Page, camera: bpy.types.Object) -> None:
    """Draw the directions of x, y and z in the upper right corner, beside the title."""
    em = page.em
    x, y = page.width - 3.2 * em, 2.9 * em
    colors = _AXES["dark" if page.paper == DARK else "light"]
    right, up, back = np.array(camera.rotation_quaternion.to_matrix()).T
    for axis in np.argsort(back):  # draws the nearest axis last
        dx, dy, color = right[axis] * em, -up[axis] * em, colors[axis]
        page.line([(x, y), (x + 1.4 * dx, y + 1.4 * dy)], color, 0.14 * em)
        page.text("xyz"[axis], x + 2.0 * dx, y + 2.0 * dy + 0.3 * em, 0.9 * em, color, "middle")
