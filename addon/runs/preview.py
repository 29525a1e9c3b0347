"""Live preview: what the active module sees, made again while it, the phantom or a number changes.

A look at the scene makes a `Request`, which leaves bpy alone, and a thread makes the `Preview` that it asks for by the
same recipe as a run: with few pixels while something changes, with those of the panel once the scene rests. There is one
thread at a time, and the next request is made when it is done: of the scene as it is then. Nothing of a run is touched.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core import InputError, PinholeSystem, ProjectionRun, Recipe, Views, Volume
from ...core.geometry.scanner import Scanner
from ...core.memory import readable_size
from ...core.runs.display import Display
from ...core.runs.mosaic import as_seen, sized, totals
from ...core.runs.run_recipe import recipe_model, recipe_views, run_recipe
from ..blender import jobs, reports, timers, windows
from ..phantoms import phantoms
from ..pictures import planes
from ..scanner import scanner, selection
from ..volumes import stored_volumes, vdb, volumes
from . import preview_drawing, rendering, runs

QUICK = 128
"""Pixels along a side, at most, while something changes."""
MOST_KEPT = 2 * 2**30
"""Bytes of voxels that are kept in memory, at most."""
_INTERVAL = 0.02  # s between two looks, while there is something to do
_REST = 0.3  # s without a change before the picture is made with all pixels
_SHOWN_PIXELS = 512**2
_MOST_CAUTIONS = 2
_PATIENCE = 0.5  # s, after which a line says that a picture takes long

Source = tuple[Path, NDArray[np.float64]]
"""File and pose (4, 4) of a volume, mm."""


@dataclass(frozen=True, eq=False)
class Request:
    """What a preview is to be made from."""

    recipe: Recipe  # the panel's
    system: Scanner  # the active module alone
    volume: Source
    mu: Source | None  # what attenuates
    display: Display
    share: float | None  # of the way from pinhole to detector: where the picture stands in the scene; None: nowhere
    lines: tuple[str, ...]  # to stand beside the picture; the first says what it is

    def same_as(self, other: "Request | None") -> bool:
        """Whether the other request asks for the same picture."""
        return other is not None and _words(self) == _words(other)


@dataclass(frozen=True, eq=False)
class Preview:
    """A preview that has been made."""

    run: ProjectionRun  # of one module; exact
    picture: NDArray[np.uint8]  # its colours (height, width, 3), row 0 at the top
    colors: NDArray[np.uint8]  # (1, 256, 3), from the first to the last
    window: tuple[float, float]  # the numbers that have these
    corners: NDArray[np.float64] | None  # world places (4, 3), mm, of the picture in the scene, from top left clockwise
    lines: tuple[str, ...]
    is_quick: bool


def request(context: bpy.types.Context) -> Request:
    """What the context's scene asks for; raises InputError where nothing can be previewed."""
    scene = context.scene
    collection = scanner.required_scanner(scene)
    recipe = runs.panel_recipe(scene).updated({"system.modules": None})
    camera = selection.active_module(context)
    if camera is None:
        raise InputError("no module is active: select its camera, or choose it in the Modules panel")
    system = scanner.read_module(collection, camera)
    model = recipe_model(recipe, system)
    item, mu_item = rendering.sources(context, recipe, model)
    chosen = [item] if mu_item is None else [item, mu_item]
    kept = sum(4.0 * np.prod(one.mphdrr_volume.shape) for one in chosen)
    if kept > MOST_KEPT:
        names = " and ".join(repr(one.name) for one in chosen)
        most = readable_size(MOST_KEPT)
        raise InputError(f"{names}: {readable_size(kept)} of voxels; a live preview keeps at most {most} in memory")
    module = camera.mphdrr_module
    lines = [f"Preview: {item.name} in {camera.name}"]
    if isinstance(system, PinholeSystem):
        lines.append(f"At the isocentre {module.sensitivity:.2f} cps/MBq, {module.resolution:.2f} mm FWHM")
    for one in chosen:
        if (phantom := phantoms.outdated_phantom(one)) is not None:
            lines.append(f"{phantom.name} as it was last built: Update Phantom shows the new one")
    if not module.aimed:
        lines.append("Not aimed at the isocentre")
    shown = scene.mphdrr_display
    distance = float(recipe_views(recipe, system).fields(system.poses())[0, 2])
    share = None if shown.planes == "NONE" else planes.relative_distance(shown, module, distance)
    mu = None if mu_item is None else volumes.file_and_pose(mu_item)
    return Request(
        rendering.with_energy(recipe, item),
        system,
        volumes.file_and_pose(item),
        mu,
        shown.display(),
        share,
        tuple(lines),
    )


def make(asked: Request, quick: bool, voxels: dict[Path, Volume]) -> Preview:
    """Make a preview; leaves bpy alone. `voxels` holds what was read, file by file, and keeps what was needed.

    If `quick`, its longer side has at most `QUICK` pixels, which cover the same field. Raises InputError as `run_recipe`.
    """
    recipe, system = asked.recipe, asked.system
    sources = [asked.volume] if asked.mu is None else [asked.volume, asked.mu]
    for path in set(voxels) - {path for path, _ in sources}:
        del voxels[path]
    for path, _ in sources:
        if path not in voxels:
            voxels[path] = vdb.read_vdb(path)
    volume, *mu = (stored_volumes.move_grid(voxels[path], pose) for path, pose in sources)
    run, *_ = run_recipe(quick_recipe(recipe) if quick else recipe, system, volume, mu[0] if mu else None)
    shown = run.projections
    if run.unit == "counts" and quick:  # shown per pixel of the panel's size, as the full picture and the runs are
        shown = shown * np.float32(_pixel_area(recipe_views(recipe, system)) / _pixel_area(run.views))
    word, (total,) = totals(asked.display.part(run.projections), run.unit)
    low, high = window = asked.display.window(shown)
    part = asked.display.part(shown)
    picture = asked.display.colored(sized(as_seen(part), _SHOWN_PIXELS)[0], window)
    bar = [asked.display.value_at(share, window) for share in np.linspace(0.0, 1.0, 256)]
    colors = asked.display.colored([bar], window)
    rows, columns = run.views.shape
    title, *others = asked.lines
    lines = (title, f"{columns} × {rows} pixels, {word} {total:.4g}", f"{low:.4g} to {high:.4g} {run.unit}", *others)
    corners = None if asked.share is None else _corners(run.views, part.shape[1:], asked.share)
    return Preview(run, picture, colors, window, corners, lines, quick)


def quick_recipe(recipe: Recipe) -> Recipe:
    """The recipe with so few pixels, on the same field, that its longer side has `QUICK` at most."""
    rows, columns = recipe["detector.rows"], recipe["detector.columns"]
    factor = max(1.0, max(rows, columns) / QUICK)
    fewer = {"detector.rows": max(1, round(rows / factor)), "detector.columns": max(1, round(columns / factor))}
    if recipe["detector.pitch"] is not None:
        fewer["detector.pitch"] = recipe["detector.pitch"] * factor
    if "model.background" in recipe.given:  # of larger pixels
        shares = (recipe[name] / fewer[name] for name in ("detector.rows", "detector.columns"))
        fewer["model.background"] = recipe["model.background"] * math.prod(shares)
    if isinstance(recipe["model.efficiency"], str):  # images of other pixels
        fewer["model.efficiency"] = None
    return recipe.updated(fewer)


def _pixel_area(views: Views) -> float:
    return float(np.linalg.norm(np.cross(views.u_steps[0], views.v_steps[0])))


def _corners(views: Views, shape: tuple[int, ...], share: float) -> NDArray[np.float64]:
    """Where the middle `shape` pixels of a view stand at a share of its rays: from top left clockwise (4, 3), mm."""
    n_v, n_u = shape
    u, v = 0.5 * n_u * views.u_steps[0], 0.5 * n_v * views.v_steps[0]
    source, middle = views.sources[0], views.detector_centers[0]
    return np.stack(
        [source + share * (middle + x * u + y * v - source) for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    )


def _words(asked: Request) -> tuple[str, ...]:
    """A request in words that two have in common exactly if they ask for the same."""
    module = [asked.system.numbers, *asked.system.values().values()]
    sources = [(str(path), pose.tolist()) for path, pose in filter(None, (asked.volume, asked.mu))]
    return tuple(map(repr, (dict(asked.recipe.given), module, sources, asked.display, asked.share, asked.lines)))


class Session:
    """The preview from when it is switched on until it is switched off."""

    def __init__(self) -> None:
        self.voxels: dict[Path, Volume] = {}
        self.has_changed = True  # the scene, since the last look
        self.asked: Request | None = None  # last
        self.worker: jobs.Worker | None = None
        self.full_at: float | None = None  # when the picture is to be made with all pixels; None: it is, or cannot be
        self.shown: Preview | None = None
        self.problem = ""  # why there is no picture, in words
        self.cautions: tuple[str, ...] = ()  # what was warned of when it was made
        self.started, self.quick = 0.0, True  # when the thread was, and what it makes
        self.late = ""  # what the thread makes, where that takes long

    def look(self, context: bpy.types.Context) -> float | None:
        """Do what there is to do now; returns in how many seconds to look again, None for not before a change."""
        if self.worker is not None:
            if self.worker.is_alive():
                if not self.late and time.monotonic() > self.started + _PATIENCE:
                    self.late = "Being made again after a change" if self.quick else "Being made with all pixels"
                    windows.redraw("VIEW_3D")
                return _INTERVAL
            self._take(self.worker)
        if self.has_changed:
            self.has_changed = False
            self._ask(context)
        elif self.full_at is not None and time.monotonic() >= self.full_at:
            self.full_at = None
            self._start(quick=False)
        return None if self.worker is None and self.full_at is None else _INTERVAL

    def _ask(self, context: bpy.types.Context) -> None:
        try:
            asked = request(context)
        except InputError as error:
            self._fail(str(error))
            return
        if not asked.same_as(self.asked):
            self.asked = asked
            pixels = asked.recipe["detector.rows"], asked.recipe["detector.columns"]
            self.full_at = time.monotonic() + _REST if max(pixels) > QUICK else None
            self._start(quick=True)

    def _start(self, quick: bool) -> None:
        asked, voxels = self.asked, self.voxels
        assert asked is not None
        self.quick, self.started = quick, time.monotonic()
        self.worker = jobs.Worker("Preview", lambda progress: make(asked, quick, voxels))
        self.worker.start()

    def _take(self, worker: jobs.Worker) -> None:
        """Show what a thread has made."""
        self.worker, self.late = None, ""
        error = worker.error
        if error is None:
            self.shown, self.problem = worker.result, ""
            self.cautions = tuple(map(reports.in_window, worker.warnings[:_MOST_CAUTIONS]))
        elif isinstance(error, InputError):
            self._fail(str(error))
        elif isinstance(error, MemoryError):
            self._fail("not enough memory: choose fewer voxels or pixels")
        else:
            self._fail(f"the preview failed: {type(error).__name__}: {error}")
        windows.redraw("VIEW_3D")

    def _fail(self, problem: str) -> None:
        self.shown, self.problem, self.asked, self.full_at = None, reports.in_window(problem), None, None
        windows.redraw("VIEW_3D")

    @property
    def lines(self) -> tuple[str, ...]:
        """What stands beside the picture."""
        waits = "Waits for the running job" if jobs.is_running() else self.late
        if self.problem:
            lines: tuple[str, ...] = ("No preview", self.problem)
        elif self.shown is None:
            lines = ("Preview", "The first picture is being made")
        else:
            lines = (*self.shown.lines, *self.cautions)
        return (*lines, waits) if waits else lines

    @property
    def kept(self) -> str:
        """The size of the voxels that are kept in memory."""
        return readable_size(sum(volume.array.nbytes for volume in list(self.voxels.values())))


_session: Session | None = None
_drawing: Callable[[], None] | None = None  # takes the drawing back


def session() -> Session | None:
    """The preview, if it is switched on."""
    return _session


def start() -> None:
    """Switch the preview on."""
    global _session, _drawing
    stop()
    _session = Session()
    _drawing = preview_drawing.start(_session)
    after_update()


def stop(*_: Any) -> None:
    """Switch the preview off: also before a file is loaded, or the extension is disabled."""
    global _session, _drawing
    timers.cancel(_look)
    if _drawing is not None:
        _drawing()
        windows.redraw("VIEW_3D")
    _session = _drawing = None


def after_update(scene: bpy.types.Scene | None = None, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    """Something in the scene has changed: look at it as soon as Blender has time."""
    if _session is None or (depsgraph is not None and depsgraph.mode != "VIEWPORT"):
        return
    _session.has_changed = True
    timers.schedule(_look)


def _look() -> float | None:
    if _session is None:
        return None
    if jobs.is_running() or bpy.app.is_job_running("RENDER"):
        return 10 * _INTERVAL
    return _session.look(bpy.context)
