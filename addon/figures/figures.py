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
from ...core.figures.kinds import FILM, KINDS, PAPERS, FigureKind, Film, Studio, figure_kind
from ...core.figures.page import DARK, Page, box
from ...core.figures.parts import bar_width, color_bar, heading, heading_height
from ...core.figures.subject import Subject, require
from ...core.runs.display import Display
from ...core.runs.resizing import resized
from ...core.volumes.volume import outside_value
from ..blender import ids, jobs, storage, timers
from ..blender.choices import items
from ..phantoms import phantoms
from ..scanner import pinholes, scanner, selection
from ..volumes import slices, volume_materials, volumes
from . import engine
from .stage import DIRECTION, Stage

KIND_ITEMS, FILM_ITEMS = (
    items(
        {},
        (
            (name.upper().replace("-", "_"), kind.label, kind.summary)
            for name, kind in KINDS.items()
            if kind.is_film == film
        ),
    )
    for film in (False, True)
)
_MISSING = {
    "scanner": "no scanner in the scene: import a workbook first",
    "volume": "no volume in the scene: add a phantom first",
    "run": "no projections: render them first",
}
SAMPLES = 16
"""Rays per pixel; what noise they leave is smoothed."""
_MOST_RUNS = 6  # of module numbers that a title lists
_REST = 0.5  # s between two looks at Blender's render job where nothing waits for it
_SMALL, _TRACE = 240, 8  # pixels across, and of 255: what a volume that can be seen changes in a small picture
_drawn: set[tuple[str, str, float, float]] = set()  # volumes and looks that Cycles is known to draw
_UNSEEN = ": Low and High draw none of its values, its file is missing, or this Blender's Cycles draws no volumes"
_AXES = {"dark": ("#ff8a80", "#8ee59a", "#8cb8ff"), "light": ("#c62828", "#2e7d32", "#1f57c3")}  # x, y and z
_STEPS = (1.0, 2.0, 5.0)  # round numbers of scale bars
_VEIL = 0.7  # how much of the paper covers what is under labels
_SCALE = 0.2  # of the picture's width that a scale bar takes at most


Step = tuple[str, int, int] | None
"""As a job's finishing yields it (`jobs.Finishing`)."""


@dataclass(frozen=True)
class _Ramp(Display):
    """The colours of a volume's smoke."""

    quantity: str = "activity"

    def colored(self, values: ArrayLike, window: tuple[float, float] | None = None) -> NDArray[np.uint8]:
        table = np.rint(255 * slices.colors(self.quantity, smoke=True)[:, :3]).astype(np.uint8)
        return table[np.rint(255 * self.shares(values, window or self.window(values))).astype(int)]


def figure_job(
    context: bpy.types.Context,
    name: str,
    paths: Sequence[Path],
    size: tuple[int, int] | None = None,
    modules: str | None = None,
    labels: bool = True,
    samples: int = SAMPLES,
    style: str = "dark",
    film: Film = FILM,
) -> jobs.Job:
    """The job that writes a figure of the context's scene to files (.png, .svg; .mp4), `size` pixels wide and high.

    `modules` are all by default; of figures of one module, the active one. Raises InputError where the scene has not what
    the figure needs.
    """
    kind, scene = figure_kind(name), context.scene
    page = new_page(kind, size, style)
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

    def work(progress: Progress) -> Subject:
        progress(0, 1)
        found = {key: read() for key, read in later.items()}
        if "run" in found:
            known["name"] = found["run"].settings.get("volume", "")
        return Subject(**known, **found)

    enough = threading.Event()
    made: list[Path] = []

    def finish(subject: Subject) -> Generator[Step, None, str]:
        yield from drawing(page, subject, kind, item, paths, labels, samples, film, made, enough)
        return f"Wrote {', '.join(map(str, paths))}"

    def left() -> str:
        return f"{len(made)} pictures are in {made[0].parent}" if made else "nothing was changed"

    return jobs.Job("Drawing the figure", work, finish, enough=enough if kind.is_film else None, left=left)


def new_page(kind: FigureKind, size: tuple[int, int] | None, style: str) -> Page:
    """The page of a kind of figure; only rendered ones have a style."""
    return Page(*(size or kind.size), PAPERS[style] if kind.studio is not None else PAPERS["light"])


def drawing(
    page: Page,
    subject: Subject,
    kind: FigureKind,
    item: bpy.types.Object | None,
    paths: Sequence[Path],
    labels: bool = True,
    samples: int = SAMPLES,
    film: Film = FILM,
    made: list[Path] | None = None,
    enough: threading.Event | None = None,
) -> Generator[Step, None, None]:
    """Draw a figure of a kind on its page and write it to `paths`; the other arguments are those of `filming`."""
    if kind.draw is not None:
        kind.draw(page, subject)
    elif kind.is_film:
        for path in paths:
            yield from filming(page, subject, kind, item, path, labels, samples, film, made, enough)
        return
    elif kind.studio is not None:
        yield from rendering(page, subject, kind.studio, item, labels, samples)
    for path in paths:
        page.write(path)


def rendering(
    page: Page,
    subject: Subject,
    shown: Studio,
    item: bpy.types.Object | None = None,
    labels: bool = True,
    samples: int = SAMPLES,
) -> Generator[None, None, None]:
    """Render a subject's scanner, and the volume of an object, onto a page; yields while Blender's own job renders."""
    stage = Stage(subject, shown, item, page, heading_height(page, 1) if labels else 0)
    try:
        yield from prepared(stage, subject, samples)
        yield from picture(stage, subject, page, labels)
    finally:
        stage.remove()


def filming(
    page: Page,
    subject: Subject,
    kind: FigureKind,
    item: bpy.types.Object | None,
    path: Path,
    labels: bool = True,
    samples: int = SAMPLES,
    film: Film = FILM,
    made: list[Path] | None = None,
    enough: threading.Event | None = None,
) -> Generator[Step, None, None]:
    """Render an animation: pictures in the folder NAME-frames beside `path`, and of them the MP4 `path`, NAME.mp4.

    Yields how many of the pictures there are. They are added to `made` and stay if the work is ended; where `enough` is
    set, the film ends with those. Raises InputError where a side of the page is odd, which MP4 cannot hold.
    """
    assert kind.studio is not None
    if page.width % 2 or page.height % 2:
        raise InputError(f"size {page.width}x{page.height}: of an animation both must be even")
    made = [] if made is None else made
    folder = files.ensure_folder(path.with_name(f"{path.stem}-frames"))
    for old in folder.glob(f"{glob.escape(path.stem)}-[0-9][0-9][0-9][0-9].png"):
        old.unlink()  # of an animation that may have been longer
    stage = Stage(subject, kind.studio, item, page, heading_height(page, 1) if labels else 0)
    try:
        yield from prepared(stage, subject, samples)
        shown, frame = None, page
        for k in range(film.frames):
            if enough is not None and enough.is_set() and made:
                break
            moment = stage.moment(k / film.frames)
            if moment != shown:
                shown, frame = moment, Page(page.width, page.height, page.paper)
                stage.show(*moment)
                yield from picture(stage, subject, frame, labels)
            made.append(folder / f"{path.stem}-{k + 1:04d}.png")
            frame.write(made[-1])
            yield "rendering pictures", k + 1, film.frames
        yield from engine.write_film(made, path, film.fps, page)
    finally:
        stage.remove()


def prepared(stage: Stage, subject: Subject, samples: int) -> Generator[None, None, None]:
    """Set up Cycles for a stage; a volume that it does not draw becomes a surface, which is said."""
    engine.set_up(stage.scene, stage.page, samples)
    item = stage.item
    if item is None or not stage.drawn or (yield from _leave_a_trace(stage.scene, stage.drawn)):
        return
    if subject.volume is None:
        warn(f"the picture shows nothing of {item.name!r}{_UNSEEN}")
        return
    settings, factor = item.mphdrr_volume, volume_materials.shown_unit(item.mphdrr_volume.quantity)[1]
    level = (settings.display_low + settings.display_high) / 2 / factor
    if not outside_value(subject.volume) < level <= subject.volume.array.max():
        level = None
    stage.draw_surface(volume_to_mesh(subject.volume, level), settings.quantity)
    at = "half its largest value" if level is None else f"{level * factor:.3g} {settings.unit}"
    warn(f"the picture shows {item.name!r} as the surface at {at}{_UNSEEN}")


def picture(stage: Stage, subject: Subject, page: Page, labels: bool) -> Generator[None, None, None]:
    """Render a stage, as it is now, onto a page."""
    page.image((yield from _render(stage.scene)), 0, 0, page.width, page.height)
    if labels:
        _label(stage, subject, page)


def _label(stage: Stage, subject: Subject, page: Page) -> None:
    """Write on a picture what it shows, and how large."""
    em, title, line = page.em, *_titles(stage, subject)
    if stage.shown.near:  # what is shown reaches under the title
        page.area(box(0, 0, page.width, stage.top), page.paper, _VEIL)
    heading(page, title, [line], page.ink, page.faint)
    _draw_axes(page, stage.camera)
    if not stage.shown.volume:
        return
    longest = _SCALE * page.width / stage.pixels_per_mm()
    length = max(n * 10.0**k for n in _STEPS for k in range(-3, 5) if n * 10.0**k <= longest)
    end, row = 1.2 * em + length * stage.pixels_per_mm(), page.height - 1.4 * em
    page.area(box(0.6 * em, row - 2.2 * em, end, 3.0 * em), page.paper, _VEIL)
    page.line([(1.2 * em, row), (end, row)], page.ink, 0.25 * em)
    page.text(f"{length:g} mm", (1.2 * em + end) / 2, row - 0.6 * em, em, page.ink, "middle")
    if stage.item is not None and stage.is_smoke:
        settings = stage.item.mphdrr_volume
        window, ramp = (settings.display_low, settings.display_high), _Ramp(quantity=settings.quantity)
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


def _titles(stage: Stage, subject: Subject) -> tuple[str, str]:
    """What is written on a rendered figure: a title and a line below it."""
    numbers = np.array(stage.shining if stage.shown.lit else stage.system.numbers)
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
    listed = ", ".join(f"{run[0]}–{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs[:_MOST_RUNS])
    listed += " …" if len(runs) > _MOST_RUNS else ""
    modules = f"{'Module' if len(numbers) == 1 else 'Modules'} {listed}"
    modules += f" of {len(stage.system)}" if stage.shown.lit else ""
    within = f"ROI of radius {stage.radius:g} mm"
    name = subject.name if stage.shown.volume else ""
    return (
        (name or modules, f"{modules}, {within}")
        if stage.shown.lit
        else (modules, ", ".join(filter(None, (name, within))))
    )


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
                subject = Subject(PinholeSystem(-2 * reach * DIRECTION[None], *sizes))
                list(rendering(Page(_SMALL, _SMALL), subject, Studio(volume=True, near=1.7), item, False, 1))
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
