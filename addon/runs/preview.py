"""Live preview: the active module's image, made again while the module, the phantom or a number changes.

The main thread reads the scene into a `Request`, which is free of bpy, and a worker thread makes the requested `Preview` by
the same recipe as a run: with few pixels while something changes, with the panel's pixels once the scene rests. There is
one worker at a time; when it is done, the next request is read from the scene as it is then. No run is changed.
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
from ...core.runs.display import Display, number_text
from ...core.runs.mosaic import as_seen, fit_images, image_totals
from ...core.runs.run_recipe import recipe_model, recipe_views, run_recipe
from ..blender import jobs, reports, timers, windows
from ..phantoms import phantoms
from ..pictures import planes
from ..scanner import scanner, selection
from ..volumes import stored_volumes, vdb, volumes
from . import preview_drawing, rendering, runs

QUICK_PIXELS = 128
"""Largest number of pixels along a side while something changes."""
MAX_CACHED_BYTES = 2 * 2**30
"""Largest size, bytes, of voxels kept in memory."""
_INTERVAL = 0.02  # s between two turns of the main thread, while there is something to do
_PAUSE = 0.3  # s without a change before the picture is made with all pixels
_SHOWN_PIXELS = 512**2
_MAX_WARNINGS = 2
_PATIENCE = 0.5  # s after which a line tells that the picture is still being made

Source = tuple[Path, NDArray[np.float64]]
"""File of a volume, and its pose (4, 4), mm."""


@dataclass(frozen=True, eq=False)
class Request:
    """Everything that a worker thread needs to make a preview."""

    recipe: Recipe  # the panel's recipe
    system: Scanner  # the active module alone
    volume: Source  # volume to project
    mu: Source | None  # volume that attenuates
    display: Display
    share: float | None  # distance of the picture from the pinhole, relative to the detector's; None: not in the scene
    lines: tuple[str, ...]  # lines beside the picture; the first is its title

    def equals(self, other: "Request | None") -> bool:
        """Return whether the other request is for the same picture."""
        return other is not None and _cache_key(self) == _cache_key(other)


@dataclass(frozen=True, eq=False)
class Preview:
    """Preview of a run: the picture of one module, which is not stored as a run."""

    run: ProjectionRun  # run of one module, with the exact numbers
    picture: NDArray[np.uint8]  # colours (height, width, 3), row 0 at the top
    colors: NDArray[np.uint8]  # colour bar (1, 256, 3), from the first to the last colour
    window: tuple[float, float]  # numbers with the first and the last colour
    corners: NDArray[np.float64] | None  # the picture's corners (4, 3) in the scene, world mm, clockwise from top left
    lines: tuple[str, ...]  # lines beside the picture
    is_quick: bool  # whether it has few pixels


def read_request(context: bpy.types.Context) -> Request:
    """Return the request for the context's scene; raise `InputError` where nothing can be previewed."""
    scene = context.scene
    collection = scanner.required_scanner(scene)
    recipe = runs.panel_recipe(scene).updated({"system.modules": None})
    if (camera := selection.active_module(context)) is None:
        raise InputError("no module is active: select its camera, or choose it in the Modules panel")
    system = scanner.read_module(collection, camera)
    model = recipe_model(recipe, system)
    item, mu_item = rendering.source_objects(context, recipe, model)
    items = [item] if mu_item is None else [item, mu_item]
    size = sum(4.0 * np.prod(volume.mphdrr_volume.shape) for volume in items)
    if size > MAX_CACHED_BYTES:
        names = " and ".join(repr(volume.name) for volume in items)
        limit = readable_size(MAX_CACHED_BYTES)
        raise InputError(f"{names}: {readable_size(size)} of voxels; a live preview keeps at most {limit} in memory")
    module = camera.mphdrr_module
    lines = [f"Preview: {item.name} in {camera.name}"]
    if isinstance(system, PinholeSystem):
        lines.append(f"At the isocentre {module.sensitivity:.2f} cps/MBq, {module.resolution:.2f} mm FWHM")
    for volume in items:
        if (phantom := phantoms.outdated_phantom(volume)) is not None:
            lines.append(f"{phantom.name} as it was last built: Update Phantom shows the new one")
    if not module.aimed:
        lines.append("Not aimed at the isocentre")
    settings = scene.mphdrr_display
    distance = float(recipe_views(recipe, system).fields(system.poses())[0, 2])
    share = None if settings.planes == "NONE" else planes.relative_distance(settings, module, distance)
    mu = None if mu_item is None else volumes.file_and_pose(mu_item)
    recipe, source = rendering.with_energy(recipe, item), volumes.file_and_pose(item)
    return Request(recipe, system, source, mu, settings.display(), share, tuple(lines))


def make_preview(request: Request, quick: bool, voxels: dict[Path, Volume]) -> Preview:
    """Make a preview without bpy; `voxels` is the cache of the volumes read, by file, and keeps only the needed ones.

    If `quick`, the longer side has at most `QUICK_PIXELS` pixels, which cover the same field. Raises the errors of
    `run_recipe`.
    """
    recipe, system, display = request.recipe, request.system, request.display
    sources = [request.volume] if request.mu is None else [request.volume, request.mu]
    for path in set(voxels) - {path for path, _ in sources}:
        del voxels[path]
    for path, _ in sources:
        if path not in voxels:
            voxels[path] = vdb.read_vdb(path)
    volume, *mu = (stored_volumes.move_grid(voxels[path], pose) for path, pose in sources)
    run, *_ = run_recipe(quick_recipe(recipe) if quick else recipe, system, volume, mu[0] if mu else None)
    projections = run.projections
    if run.unit == "counts" and quick:  # counts per pixel of the panel's size, as in the full picture
        projections = projections * np.float32(_pixel_area(recipe_views(recipe, system)) / _pixel_area(run.views))
    word, (total,) = image_totals(display.part(run.projections), run.unit)
    window = display.window(projections)
    shown_part = display.part(projections)
    picture = display.colored(fit_images(as_seen(shown_part), _SHOWN_PIXELS)[0], window)
    bar = [display.value_at(share, window) for share in np.linspace(0.0, 1.0, 256)]
    colors = display.colored([bar], window)
    rows, columns = run.views.shape
    title, *notes = request.lines
    size_line = f"{columns} × {rows} pixels, {word} {number_text(total)}"
    lines = (title, size_line, volumes.range_text(*window, run.unit), *notes)
    corners = None if request.share is None else _corners(run.views, shown_part.shape[1:], request.share)
    return Preview(run, picture, colors, window, corners, lines, quick)


def quick_recipe(recipe: Recipe) -> Recipe:
    """Return the recipe with at most `QUICK_PIXELS` pixels along the longer side, on the same field."""
    rows, columns = recipe["detector.rows"], recipe["detector.columns"]
    factor = max(1.0, max(rows, columns) / QUICK_PIXELS)
    values = {"detector.rows": max(1, round(rows / factor)), "detector.columns": max(1, round(columns / factor))}
    if recipe["detector.pitch"] is not None:
        values["detector.pitch"] = recipe["detector.pitch"] * factor
    if "model.background" in recipe.given:  # in proportion to the pixel's area
        shares = (recipe[name] / values[name] for name in ("detector.rows", "detector.columns"))
        values["model.background"] = recipe["model.background"] * math.prod(shares)
    if isinstance(recipe["model.efficiency"], str):  # files of images with the panel's pixels
        values["model.efficiency"] = None
    return recipe.updated(values)


def _pixel_area(views: Views) -> float:
    """Return the area of the first view's pixels, mm²."""
    return float(np.linalg.norm(np.cross(views.u_steps[0], views.v_steps[0])))


def _corners(views: Views, shape: tuple[int, ...], share: float) -> NDArray[np.float64]:
    """Return the corners (4, 3), mm, clockwise from top left, of a view's middle `shape` pixels at `share` of its rays."""
    n_v, n_u = shape
    u, v = 0.5 * n_u * views.u_steps[0], 0.5 * n_v * views.v_steps[0]
    source, center = views.sources[0], views.detector_centers[0]
    signs = (1, 1), (-1, 1), (-1, -1), (1, -1)
    return np.stack([source + share * (center + x * u + y * v - source) for x, y in signs])


def _cache_key(request: Request) -> tuple[str, ...]:
    """Return a hashable key that is equal exactly for equal requests."""
    module = [request.system.numbers, *request.system.values().values()]
    sources = [(str(path), pose.tolist()) for path, pose in filter(None, (request.volume, request.mu))]
    entries = dict(request.recipe.given)
    return tuple(map(repr, (entries, module, sources, request.display, request.share, request.lines)))


class Session:
    """Present request, worker thread and picture of the preview, from when it is switched on until it is switched off."""

    def __init__(self) -> None:
        self.voxels: dict[Path, Volume] = {}  # volumes in memory, by file
        self.has_changed = True  # whether the scene may have changed since the last request
        self.request: Request | None = None  # the last request
        self.worker: jobs.Worker | None = None
        self.full_at: float | None = None  # time to make the picture with all pixels; None: made, or impossible
        self.preview: Preview | None = None
        self.problem = ""  # reason in words why there is no picture
        self.warnings: tuple[str, ...] = ()  # warnings given while the picture was made
        self.started, self.quick = 0.0, True  # start time of the worker, and whether it makes few pixels
        self.delay_note = ""  # line about a picture that takes long

    def take_turn(self, context: bpy.types.Context) -> float | None:
        """Do what is due in the main thread; return the seconds until the next turn, None for not before a change."""
        if self.worker is not None:
            if self.worker.is_alive():
                if not self.delay_note and time.monotonic() > self.started + _PATIENCE:
                    self.delay_note = "Being made again after a change" if self.quick else "Being made with all pixels"
                    windows.redraw("VIEW_3D")
                return _INTERVAL
            self._show_result(self.worker)
        if self.has_changed:
            self.has_changed = False
            self._update_request(context)
        elif self.full_at is not None and time.monotonic() >= self.full_at:
            self.full_at = None
            self._start_worker(quick=False)
        return None if self.worker is None and self.full_at is None else _INTERVAL

    def _update_request(self, context: bpy.types.Context) -> None:
        """Read the scene, and start a quick preview if its request has changed."""
        try:
            request = read_request(context)
        except InputError as error:
            self._fail(str(error))
            return
        if not request.equals(self.request):
            self.request = request
            pixels = request.recipe["detector.rows"], request.recipe["detector.columns"]
            self.full_at = time.monotonic() + _PAUSE if max(pixels) > QUICK_PIXELS else None
            self._start_worker(quick=True)

    def _start_worker(self, quick: bool) -> None:
        """Start the worker thread that makes the requested preview."""
        request, voxels = self.request, self.voxels
        assert request is not None
        self.quick, self.started = quick, time.monotonic()
        self.worker = jobs.Worker("Preview", lambda progress: make_preview(request, quick, voxels))
        self.worker.start()

    def _show_result(self, worker: jobs.Worker) -> None:
        """Show the preview or the error of a worker thread."""
        self.worker, self.delay_note = None, ""
        error = worker.error
        if error is None:
            self.preview, self.problem = worker.result, ""
            self.warnings = tuple(map(reports.in_window, worker.warnings[:_MAX_WARNINGS]))
        elif isinstance(error, InputError):
            self._fail(str(error))
        elif isinstance(error, MemoryError):
            self._fail("not enough memory: choose fewer voxels or pixels")
        else:
            self._fail(f"the preview failed: {type(error).__name__}: {error}")
        windows.redraw("VIEW_3D")

    def _fail(self, problem: str) -> None:
        """Show a problem instead of a picture."""
        self.preview, self.problem, self.request, self.full_at = None, reports.in_window(problem), None, None
        windows.redraw("VIEW_3D")

    @property
    def lines(self) -> tuple[str, ...]:
        """Lines beside the picture."""
        note = "Waits for the running job" if jobs.is_running() else self.delay_note
        if self.problem:
            lines: tuple[str, ...] = ("No preview", self.problem)
        elif self.preview is None:
            lines = ("Preview", "The first picture is being made")
        else:
            lines = (*self.preview.lines, *self.warnings)
        return (*lines, note) if note else lines

    @property
    def cache_size(self) -> str:
        """Size of the voxels kept in memory, in words."""
        return readable_size(sum(volume.array.nbytes for volume in list(self.voxels.values())))


_session: Session | None = None
_drawing: Callable[[], None] | None = None  # function that ends the drawing


def session() -> Session | None:
    """Return the preview's session; None while the preview is switched off."""
    return _session


def start() -> None:
    """Switch the preview on."""
    global _session, _drawing
    stop()
    _session = Session()
    _drawing = preview_drawing.start(_session)
    after_update()


def stop(*_: Any) -> None:
    """Switch the preview off; also before a file is loaded or the extension is disabled."""
    global _session, _drawing
    timers.cancel(_take_turn)
    if _drawing is not None:
        _drawing()
        windows.redraw("VIEW_3D")
    _session = _drawing = None


def after_update(scene: bpy.types.Scene | None = None, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    """Schedule a turn of the preview after a change of the scene."""
    if _session is None or (depsgraph is not None and depsgraph.mode != "VIEWPORT"):
        return
    _session.has_changed = True
    timers.schedule(_take_turn)


def _take_turn() -> float | None:
    """Take a turn of the session, or wait for a running job or render."""
    if _session is None:
        return None
    if jobs.is_running() or bpy.app.is_job_running("RENDER"):
        return 10 * _INTERVAL
    return _session.take_turn(bpy.context)
