"""Figures of a scene (`core.figures`), and those that Blender renders: by Cycles, on a stage of their own.

It needs no window and no graphics card.
"""

import glob
import sys
import tempfile
import threading
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import ArrayLike, NDArray

from ...core import PinholeSystem, Progress, files, read_run, recording, volume_to_mesh
from ...core.cli.options import output_path
from ...core.errors import InputError, warn
from ...core.figures.kinds import KINDS, SAMPLES, FigureKind, Rendering, figure_kind
from ...core.figures.page import DARK, Page, box
from ...core.figures.parts import bar_width, color_bar, heading, heading_height
from ...core.figures.subject import FigureSubject, require
from ...core.runs.display import Display
from ...core.runs.resizing import resized
from ..blender import ids, jobs, storage, timers, windows
from ..blender.choices import items
from ..phantoms import phantoms
from ..pictures import images
from ..scanner import pinholes, scanner, selection
from ..volumes import slices, volume_materials, volumes
from . import engine
from .stage import DIRECTION, Stage

Step = tuple[str, int, int] | None
"""As a job's finishing yields it (`jobs.Finishing`)."""
_MISSING = {
    "scanner": "no scanner in the scene: import a workbook first",
    "volume": "no volume in the scene: add a phantom first",
    "run": "no projections: render them first",
}
_MOST_RUNS = 6  # of module numbers that a title lists
_REST = 0.5  # s between two looks at Blender's render job where nothing waits for it
_SMALL, _TRACE = 240, 8  # pixels across, and of 255: what a volume that can be seen changes in a small picture
_drawn: set[tuple[str, str, float, float]] = set()  # volumes and looks that Cycles is known to draw
_UNDRAWN = "Low and High draw none of its values, or this Blender's Cycles draws no volumes"
_UNSEEN = f": its file is missing, {_UNDRAWN}"
_AXES = {"dark": ("#ff8a80", "#8ee59a", "#8cb8ff"), "light": ("#c62828", "#2e7d32", "#1f57c3")}  # x, y and z
_STEPS = (1.0, 2.0, 5.0)  # round numbers of scale bars
_VEIL = 0.7  # how much of the paper covers what is under labels
_SCALE = 0.2  # of the picture's width that a scale bar takes at most


class Reel(threading.Event):
    """The pictures that an animation has so far; where it is set, they are enough."""

    pictures: Sequence[Path] = ()


@dataclass(frozen=True)
class _Ramp(Display):
    """The colours of a volume's smoke."""

    ramp: volume_materials.Ramp = ()

    def colored(self, values: ArrayLike, window: tuple[float, float] | None = None) -> NDArray[np.uint8]:
        table = np.rint(255 * slices.colors("", self.ramp)[:, :3]).astype(np.uint8)
        return table[np.rint(255 * self.shares(values, window or self.window(values))).astype(int)]


def kind_items(films: bool = False) -> tuple[tuple[Any, ...], ...]:
    """Choices of an EnumProperty: the kinds of figures, animations or others."""
    kinds = (kind for kind in KINDS.values() if bool(kind.motion) == films)
    return items({}, ((kind.name.upper().replace("-", "_"), kind.label, kind.summary) for kind in kinds))


def figure_job(
    context: bpy.types.Context,
    name: str,
    paths: Sequence[Path],
    size: tuple[int, int] | None = None,
    modules: str | None = None,
    **how: Any,
) -> jobs.Job:
    """The job that writes a figure of the context's scene to files (.png, .svg; .mp4), `size` pixels wide and high.

    `modules` are all by default; of figures of one module, the active one; of a picture those selected, if more than one is.
    `how` are the fields of `core.figures.kinds.Rendering`. Raises InputError where the scene has not what the figure
    needs.
    """
    given = Rendering(**how)
    kind, scene = figure_kind(name), context.scene
    page = kind.page(size, given)
    paths = [output_path(str(path), kind.suffixes) for path in paths]
    collection = scanner.active_scanner(scene)
    item = _volume_item(context) if "volume" in kind.needs else None
    active = selection.active_module(context)
    if kind.one_module and modules is None and active is not None:
        modules = str(active.mphdrr_module.number)
    selected = [camera.mphdrr_module.number for camera in selection.selected_modules(context)]
    if kind.studio is not None and kind.studio.lit and modules is None and len(selected) > 1:
        modules = ",".join(map(str, selected))
    known: dict[str, Any] = {"modules": modules, "display": scene.mphdrr_display.display()}
    if collection is not None:
        known["scanner"] = scanner.read_scanner(collection)
        known["construction"] = pinholes.construction(collection.mphdrr_scanner)
    later: dict[str, Callable[[], Any]] = {}
    if item is not None:
        pose = volumes.pose_of_object(item)
        later["volume"], known["name"] = volumes.reader(item), item.name
        if phantoms.settings_of(item) is not None or not np.array_equal(pose, np.eye(4)):
            known["pose"] = pose
    run_file = scene.mphdrr_projections.run_file
    if "run" in kind.needs and run_file:
        later["run"] = partial(read_run, storage.absolute(run_file))
    require(kind.needs, {*known, *later}, kind.name, _MISSING)

    def work(progress: Progress) -> FigureSubject:
        progress(0, 1)
        found = {key: read() for key, read in later.items()}
        if "run" in found:
            known["name"] = found["run"].settings.get("volume", "")
        return FigureSubject(**known, **found)

    reel = Reel()

    def finish(subject: FigureSubject) -> Generator[Step, None, str]:
        yield from drawing(page, subject, kind, item, paths, given, reel)
        if windows.has_window() and paths[0].suffix == ".png":
            images.show_file(paths[0], bpy.context)
        return f"Wrote {', '.join(map(str, paths))}"

    def left() -> str:
        made = reel.pictures
        return f"{len(made)} pictures are in {made[0].parent}" if made else "nothing was changed"

    return jobs.Job("Drawing the figure", work, finish, enough=reel if kind.motion else None, left=left)


def drawing(
    page: Page,
    subject: FigureSubject,
    kind: FigureKind,
    item: bpy.types.Object | None,
    paths: Sequence[Path],
    how: Rendering,
    reel: Reel,
) -> Generator[Step, None, None]:
    """Draw a figure on its page and write it to `paths`; yields while Blender's own job renders, and pictures of a film.

    The volume that is rendered is that of an object. A film's pictures, in the folder NAME-frames beside NAME.mp4, stay if
    the work is ended; where `reel` is set, the film ends with those.
    """
    if kind.draw is not None:
        kind.draw(page, subject)
    if kind.studio is not None:
        stage = Stage(subject, kind, item, page, heading_height(page, 1) if how.labels else 0)
        try:
            yield from _prepared(stage, how)
            for path in paths if kind.motion else ():
                yield from _filmed(stage, how, path, reel)
            if not kind.motion:
                yield from _picture(stage, how, page)
        finally:
            stage.remove()
    for path in () if kind.motion else paths:
        page.write(path)


def _filmed(stage: Stage, how: Rendering, path: Path, reel: Reel) -> Generator[Step, None, None]:
    """Render an animation's pictures, and put them together to an MP4."""
    made = reel.pictures = []
    folder = files.ensure_folder(path.with_name(f"{path.stem}-frames"))
    for old in folder.glob(f"{glob.escape(path.stem)}-[0-9][0-9][0-9][0-9].png"):
        old.unlink()  # of an animation that may have been longer
    shown, page = None, stage.page
    for k in range(how.frames):
        moment = stage.moment(k / how.frames)
        if moment != shown:
            stage.show(*moment)
            shown, page = moment, Page(page.width, page.height, page.paper)
            yield from _picture(stage, how, page)
        made.append(folder / f"{path.stem}-{k + 1:04d}.png")
        page.write(made[-1])
        yield "rendering pictures", k + 1, how.frames
        if reel.is_set():
            break
    yield from engine.write_film(made, path, how.fps, page)


def _prepared(stage: Stage, how: Rendering) -> Generator[None, None, None]:
    """Set up Cycles for a stage; a volume that it does not draw becomes a surface, which is said."""
    engine.set_up(stage.scene, stage.page, how.samples)
    item, volume = stage.item, stage.subject.volume
    if item is None or not stage.drawn or (yield from _leave_a_trace(stage.scene, stage.drawn)):
        return
    if volume is None:
        warn(f"the picture shows nothing of {item.name!r}{_UNSEEN}")
        return
    settings, factor = item.mphdrr_volume, volume_materials.shown_unit(item.mphdrr_volume.quantity)[1]
    level = min((settings.display_low + settings.display_high) / factor, float(volume.array.max())) / 2
    stage.draw_surface(volume_to_mesh(volume, level), volume_materials.ramp_of(item, smoke=True))
    warn(f"the picture shows {item.name!r} as the surface at {level * factor:.3g} {settings.unit}: {_UNDRAWN}")


def _picture(stage: Stage, how: Rendering, page: Page) -> Generator[None, None, None]:
    """Render a stage, as it is now, onto a page."""
    page.image((yield from _render(stage.scene)), 0, 0, page.width, page.height)
    if how.labels:
        _label(stage, page)


def _label(stage: Stage, page: Page) -> None:
    """Write on a picture what it shows, and how large."""
    em, title, line = page.em, *_titles(stage)
    if stage.shown.near:  # what is shown reaches under the title
        page.area(box(0, 0, page.width, stage.top), page.paper, _VEIL)
    heading(page, title, [line], page.ink, page.faint)
    _draw_axes(page, stage.camera)
    if not stage.shown.volume:
        return
    longest = _SCALE * page.width / stage.pixels_per_mm
    length = max(n * 10.0**k for n in _STEPS for k in range(-3, 5) if n * 10.0**k <= longest)
    end, row = 1.2 * em + length * stage.pixels_per_mm, page.height - 1.4 * em
    page.area(box(0.6 * em, row - 2.2 * em, end, 3.0 * em), page.paper, _VEIL)
    page.line([(1.2 * em, row), (end, row)], page.ink, 0.25 * em)
    page.text(f"{length:g} mm", (1.2 * em + end) / 2, row - 0.6 * em, em, page.ink, "middle")
    if stage.item is not None and [part.type for part in stage.drawn] == ["VOLUME"]:
        settings = stage.item.mphdrr_volume
        window = settings.display_low, settings.display_high
        ramp = _Ramp(ramp=volume_materials.ramp_of(stage.item, smoke=True))
        left, tall = page.width - round(em) - bar_width(page, ramp, window, settings.unit), round(11 * em)
        page.area(box(left - em, page.height - tall - 4.2 * em, page.width, tall + 4.2 * em), page.paper, _VEIL)
        color_bar(page, ramp, window, settings.unit, left, page.height - tall - round(1.4 * em), tall)


def _volume_item(context: bpy.types.Context) -> bpy.types.Object | None:
    """The active volume, else the panel's, else the only one; None where there is none."""
    known = volumes.volume_objects(context.scene)
    for chosen in (context.object, context.scene.mphdrr_projections.volume):
        if chosen in known:
            return chosen
    if len(known) > 1:
        raise InputError(f"choose what to show: there are {len(known)} volumes; select one")
    return known[0] if known else None


def _titles(stage: Stage) -> tuple[str, str]:
    """What is written on a rendered figure: a title and a line below it."""
    numbers = np.array(stage.shining if stage.shown.lit else stage.system.numbers)
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
    listed = ", ".join(f"{run[0]}–{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs[:_MOST_RUNS])
    listed += " …" if len(runs) > _MOST_RUNS else ""
    modules = f"{'Module' if len(numbers) == 1 else 'Modules'} {listed}"
    name, within = stage.subject.name if stage.shown.volume else "", f"ROI of radius {stage.radius:g} mm"
    if stage.shown.lit:
        return name, f"Rays of {modules.lower()} of {len(stage.system)}, {within}"
    return modules, ", ".join(filter(None, (name, within)))


def _leave_a_trace(scene: bpy.types.Scene, drawn: list[bpy.types.Object]) -> Generator[None, None, bool]:
    """Whether objects are to be seen at all, by small pictures with and without them."""
    render, cycles, pictures = scene.render, scene.cycles, []
    render.resolution_percentage, cycles.use_denoising = min(100, -(-100 * _SMALL // render.resolution_x)), False
    samples, cycles.samples = cycles.samples, SAMPLES
    for hidden in (True, False):
        for part in drawn:
            part.hide_render = hidden
        pictures.append((yield from _render(scene)).astype(int))
    render.resolution_percentage, cycles.use_denoising, cycles.samples = 100, True, samples
    rows, columns = (n // 8 for n in pictures[0].shape[:2])  # means, which have less noise
    return bool(np.abs(resized(pictures[0] - pictures[1], rows, columns)).max() > _TRACE)


def before_render(scene: bpy.types.Scene, *_: Any) -> None:
    """Blender's own Render: say which volumes of the 3D views the picture lacks; in the window, when it is done."""
    if scene.name.startswith(ids.STUDIO):
        return
    if bpy.app.background:
        _say_what_is_unseen()
    else:
        timers.soon(_say_what_is_unseen, _REST)


def _say_what_is_unseen() -> float | None:
    if jobs.is_running() or bpy.app.is_job_running("RENDER"):
        return _REST
    scene, missing = bpy.context.scene, storage.missing_volumes()
    for item in (item for item in volumes.volume_objects(scene) if item.visible_get()):
        look, why = item.mphdrr_volume, ""
        known = item.data.filepath, look.look, look.display_low, look.display_high
        if item.hide_render or all(home.hide_render for home in item.users_collection):
            why = ": it is hidden in renders"
        elif item.data in missing:
            why = ": its files are missing"
        elif scene.render.engine == "CYCLES" and known not in _drawn:
            reach = max((item.matrix_world @ Vector(corner)).length for corner in item.bound_box) + 1.0
            sizes = reach / np.array([50, 10, 10, 50, 1])  # of a small module behind it, as seen
            with recording.recorded_warnings() as caught:
                subject = FigureSubject(PinholeSystem(-2 * reach * DIRECTION[None], *sizes))
                page, how = Page(_SMALL, _SMALL), Rendering(labels=False, samples=1)
                list(drawing(page, subject, figure_kind("inside"), item, [], how, Reel()))
            why = _UNSEEN if any(_UNSEEN in text for text in caught) else ""
            _drawn.update([] if why else [known])
        if why:
            text = f"the picture shows nothing of {item.name!r}{why}"
            print(f"mphDRR: {text}", file=sys.stderr)
            if not bpy.app.background:
                line = partial(lambda text, menu, _: menu.layout.label(text=text), text)
                bpy.context.window_manager.popup_menu(line, title="mphDRR", icon="ERROR")
    return None


def _render(scene: bpy.types.Scene) -> Generator[None, None, NDArray[np.uint8]]:
    """Colours (height, width, 3) of a scene."""
    with tempfile.TemporaryDirectory(prefix="mphdrr-") as folder:
        path = Path(folder) / "figure.png"
        yield from engine.written(scene, path)
        return engine.pixels(path)


def _draw_axes(page: Page, camera: bpy.types.Object) -> None:
    """The directions of x, y and z, in the upper right corner beside the title."""
    em = page.em
    x, y = page.width - 3.2 * em, 2.9 * em
    colors = _AXES["dark" if page.paper == DARK else "light"]
    right, up, back = np.array(camera.rotation_quaternion.to_matrix()).T
    for axis in np.argsort(back):  # the nearest last
        across, down, color = right[axis] * em, -up[axis] * em, colors[axis]
        page.line([(x, y), (x + 1.4 * across, y + 1.4 * down)], color, 0.14 * em)
        page.text("xyz"[axis], x + 2.0 * across, y + 2.0 * down + 0.3 * em, 0.9 * em, color, "middle")
