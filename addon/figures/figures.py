"""Figures of a scene (`core.figures`), and those that Blender renders: by Cycles, in a studio of their own.

The studio is a scene with copies of what is shown, so that the user's scene stays as it is. It needs no window and no
graphics card.
"""

import sys
import tempfile
import time
from collections.abc import Callable, Generator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from mathutils import Vector
from numpy.typing import NDArray

from ...core import Cancelled, PinholeSystem, Progress, read_run, recording
from ...core.cli.options import output_path
from ...core.errors import InputError, warn
from ...core.figures.kinds import KINDS, Studio, figure_kind
from ...core.figures.page import SUFFIXES, Page, box
from ...core.figures.parts import heading, heading_height
from ...core.figures.subject import Subject, require
from ...core.geometry.collimator import Construction
from ...core.geometry.scanner import Scanner
from ...core.runs.resizing import resized
from ..blender import compat, ids, jobs, storage, timers
from ..blender.choices import items
from ..phantoms import phantoms
from ..scanner import collimators, pinholes, scanner, selection
from ..volumes import looks, volumes
from . import studio

KIND_ITEMS = items({}, ((name.upper().replace("-", "_"), kind.label, kind.summary) for name, kind in KINDS.items()))
_MISSING = {
    "scanner": "no scanner in the scene: import a workbook first",
    "volume": "no volume in the scene: add a phantom first",
    "run": "no projections: render them first",
}
SAMPLES = 16
"""Rays per pixel; what noise they leave is smoothed."""
_DIRECTION = Vector((0.75, -1.0, 0.62)).normalized()  # from the scanner to the camera
_LENS, _SENSOR = 50.0, 36.0
_MARGIN = 0.04  # of the picture's shorter side, free around what is shown
_NEAR = 1.7  # ROI radii from the isocentre to the edge of a picture from near by
_CUT = 0.15  # of b: modules whose pinholes are farther to the front are cut away
_MOST_RUNS = 6  # of module numbers that a title lists
_PAUSE = 0.02  # s between two looks at Blender's render job
_REST = 0.5  # s between two looks at Blender's render job where nothing waits for it
_SMALL, _TRACE = 240, 8  # pixels across, and of 255: what a volume that can be seen changes in a small picture
_drawn: set[tuple[str, str, float, float]] = set()  # volumes and looks that Cycles is known to draw
_UNSEEN = ": Low and High draw none of its values, its file is missing, or this Blender's Cycles draws no volumes"
_RAY_RADIUS, _RAY_COLOR = 0.6, (1.0, 0.94, 0.8, 1.0)  # mm; linear RGBA
_INK, _FAINT, _UNDER_INK = "#ffffff", "#c4cad2", "#22252a"  # of labels: text
_AXES = ("#ff8a80", "#8ee59a", "#8cb8ff")  # x, y and z

_TURNS = np.linspace(0.0, 2 * np.pi, 64, endpoint=False)
_BALL = np.stack(  # points (N, 3) of a sphere of radius 1
    [
        np.outer(np.cos(_TURNS), np.sin(_TURNS / 2)),
        np.outer(np.sin(_TURNS), np.sin(_TURNS / 2)),
        np.outer(np.ones(64), np.cos(_TURNS / 2)),
    ],
    axis=-1,
).reshape(-1, 3)


def figure_job(
    context: bpy.types.Context,
    name: str,
    paths: Sequence[Path],
    size: tuple[int, int] | None = None,
    modules: str | None = None,
    labels: bool = True,
    samples: int = SAMPLES,
) -> jobs.Job:
    """The job that writes a figure of the context's scene to files (.png, .svg), `size` pixels wide and high.

    `modules` are all by default; of figures of one module, the active one. Raises InputError where the scene has not what
    the figure needs.
    """
    kind, scene = figure_kind(name), context.scene
    page = Page(*(size or kind.size))
    paths = [output_path(str(path), SUFFIXES) for path in paths]
    collection = scanner.active_scanner(scene)
    item = _volume_item(context) if "volume" in kind.needs else None
    active = selection.active_module(context)
    if kind.one_module and modules is None and active is not None:
        modules = str(active.mphdrr_module.number)
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

    def finish(subject: Subject) -> Generator[None, None, str]:
        if kind.draw is not None:
            kind.draw(page, subject)
        if kind.studio is not None:
            yield from rendering(page, subject, kind.studio, item, labels, samples)
        for path in paths:
            page.write(path)
        return f"Wrote {', '.join(map(str, paths))}"

    return jobs.Job("Drawing the figure", work, finish)


def rendering(
    page: Page,
    subject: Subject,
    shown: Studio,
    item: bpy.types.Object | None = None,
    labels: bool = True,
    samples: int = SAMPLES,
) -> Generator[None, None, None]:
    """Render a subject's scanner, and the volume of an object, onto a page; yields while Blender's own job renders."""
    assert subject.scanner is not None
    system = subject.chosen(subject.scanner)
    system = _cut(system) if shown.cut else system
    title, lines = _titles(subject, system, shown)
    top = heading_height(page, len(lines)) if labels else 0
    scene = bpy.data.scenes.new(ids.STUDIO)
    try:
        studio.furnish(scene)
        scene.frame_set(bpy.context.scene.frame_current)
        _put_modules(scene, system, subject.construction)
        radius = subject.scanner.region_radius()
        roi = _put(scene, collimators.new_sphere(ids.STUDIO, radius, collimators.part_material("ROI")))
        roi.visible_shadow = False
        drawn: list[bpy.types.Object] = []
        if shown.volume and item is not None:
            drawn = [_put(scene, item.data)]
            drawn[0].matrix_world = item.matrix_world
            surface = looks.surface_of(item)
            if surface is not None:  # of a look that draws no smoke
                drawn.append(surface.copy())
                drawn[1].data, drawn[1].parent = surface.data.copy(), None
                scene.collection.objects.link(drawn[1])
                drawn[1].matrix_world = surface.matrix_world
        if shown.rays:
            _put(scene, _rays(system))
        points = _corners(system if shown.cut else subject.scanner, radius)
        camera = _put(scene, bpy.data.cameras.new(ids.STUDIO))
        _aim(camera, page, _NEAR * radius * _BALL if shown.near else points, top)
        scene.camera = camera
        with tempfile.TemporaryDirectory(prefix="mphdrr-") as folder:
            path = Path(folder) / "figure.png"
            _set_up(scene, page, samples, path)
            if item is not None and drawn and not (yield from _leave_a_trace(scene, drawn)):
                warn(f"the picture shows nothing of {item.name!r}{_UNSEEN}")
            page.image((yield from _render(scene)), 0, 0, page.width, page.height)
        if labels:
            if shown.near:  # what is shown reaches under the title
                page.area(box(0, 0, page.width, top), _UNDER_INK, 0.55)
            heading(page, title, lines, _INK, _FAINT)
            _draw_axes(page, camera)
    finally:
        _remove(scene)


def _volume_item(context: bpy.types.Context) -> bpy.types.Object | None:
    """The active volume, else the panel's, else the only one; None where there is none."""
    known = volumes.volume_objects(context.scene)
    for chosen in (context.object, context.scene.mphdrr_projections.volume):
        if chosen in known:
            return chosen
    if len(known) > 1:
        raise InputError(f"choose what to show: there are {len(known)} volumes; select one")
    return known[0] if known else None


def _titles(subject: Subject, system: Scanner, shown: Studio) -> tuple[str, list[str]]:
    """What is written on a rendered figure: a title and lines below it."""
    numbers = system.numbers
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
    listed = ", ".join(f"{run[0]}–{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs[:_MOST_RUNS])
    listed += " …" if len(runs) > _MOST_RUNS else ""
    title = f"Modules {listed}" if len(system) > 1 else f"Module {listed}"
    within = f"ROI of radius {system.region_radius():g} mm"
    what = [f"{subject.name}, {within}" if shown.volume and subject.name else within]
    return title, what


def _cut(system: Scanner) -> Scanner:
    """The modules that do not stand between the isocentre and the viewer."""
    front = -system.frames()[:, 2] @ np.array(_DIRECTION)
    return system[front < _CUT] if np.any(front < _CUT) else system


def _put(scene: bpy.types.Scene, data: bpy.types.ID) -> bpy.types.Object:
    """A new object in a scene."""
    item = bpy.data.objects.new(ids.STUDIO, data)
    scene.collection.objects.link(item)
    return item


def _put_modules(scene: bpy.types.Scene, system: Scanner, construction: Construction) -> None:
    """All collimators as one object, and all crystals."""
    parts = system.parts(construction)
    for kind in dict.fromkeys(part.kind for part in parts):
        solids = [(part.vertices, part.solid[1]) for part in parts if part.kind == kind]
        firsts = np.cumsum([0, *(len(vertices) for vertices, _ in solids)])
        faces = np.concatenate([faces + first for (_, faces), first in zip(solids, firsts[:-1], strict=True)])
        mesh = bpy.data.meshes.new(ids.STUDIO)
        collimators.reshape_mesh(mesh, (np.concatenate([vertices for vertices, _ in solids]), faces))
        mesh.materials.append(collimators.part_material(kind.upper()))
        _put(scene, mesh)


def _rays(system: Scanner) -> bpy.types.Curve:
    """The principal rays, from each pinhole to the isocentre, as thin shining tubes."""
    curve = bpy.data.curves.new(ids.STUDIO, "CURVE")
    curve.dimensions, curve.bevel_depth = "3D", _RAY_RADIUS
    for center in system.poses()[:, :3, 3]:
        spline = curve.splines.new("POLY")
        spline.points.add(1)
        spline.points[0].co = (*center, 1.0)
        spline.points[1].co = (0.0, 0.0, 0.0, 1.0)
    material, shine = compat.surface_material(ids.STUDIO, "ShaderNodeEmission")
    shine.inputs["Color"].default_value = _RAY_COLOR
    curve.materials.append(material)
    return curve


def _corners(system: Scanner, radius: float) -> NDArray[np.float64]:
    """Points (N, 3), mm, around all modules and the ROI."""
    parts = system.parts()
    return np.concatenate([radius * _BALL, *(part.vertices for part in parts)])


def _aim(camera: bpy.types.Object, page: Page, points: NDArray[np.float64], top: int) -> None:
    """Place a camera so that points (N, 3) just fit the page below row `top`, with even margins."""
    turn = (-_DIRECTION).to_track_quat("-Z", "Y")
    right, up, back = np.array(turn.to_matrix()).T
    longer, margin = max(page.width, page.height), _MARGIN * min(page.width, page.height)
    camera.data.lens, camera.data.sensor_width, camera.data.sensor_fit = _LENS, _SENSOR, "AUTO"
    per_pixel = _SENSOR / _LENS / longer  # tangents of angles
    across, above, below = (
        per_pixel * (half - free)
        for half, free in ((page.width / 2, margin), (page.height / 2, max(top, margin)), (page.height / 2, margin))
    )
    depth = -points @ back
    x, y = points @ right, points @ up
    # Seen from (cx, cy) at a distance d, a point is inside where x - cx <= across (depth + d), and so on for each side.
    x_high, x_low = np.max(x - across * depth), np.max(-x - across * depth)
    y_high, y_low = np.max(y - above * depth), np.max(-y - below * depth)
    distance = max((x_high + x_low) / (2 * across), (y_high + y_low) / (above + below))
    cx, cy = (x_high - x_low) / 2, (y_high - above * distance + below * distance - y_low) / 2
    for _ in range(10):  # into the middle, where one direction leaves room
        seen_x, seen_y = (x - cx) / (depth + distance), (y - cy) / (depth + distance)
        cx += distance * (seen_x.max() + seen_x.min()) / 2
        cy += distance * (seen_y.max() - above + seen_y.min() + below) / 2
    camera.location = cx * right + cy * up + distance * back
    camera.rotation_mode, camera.rotation_quaternion = "QUATERNION", turn
    camera.data.clip_start, camera.data.clip_end = 0.01 * distance, 10.0 * distance


def _set_up(scene: bpy.types.Scene, page: Page, samples: int, path: Path) -> None:
    """Have a scene rendered as 8-bit colours by Cycles, the same on every machine."""
    render = scene.render
    try:
        render.engine = "CYCLES"
    except TypeError:
        raise InputError("Cycles is disabled: enable Cycles Render Engine in Edit > Preferences > Add-ons") from None
    cycles = scene.cycles
    cycles.device, cycles.samples, cycles.max_bounces, cycles.seed = "CPU", samples, 4, 0
    cycles.use_adaptive_sampling, cycles.adaptive_threshold, cycles.adaptive_min_samples = True, 0.05, 4
    cycles.use_denoising, cycles.denoising_prefilter = True, "ACCURATE"
    render.resolution_x, render.resolution_y, render.resolution_percentage = page.width, page.height, 100
    render.image_settings.file_format, render.image_settings.color_mode = "PNG", "RGB"
    scene.view_settings.view_transform = "Standard"
    render.filepath = str(path)


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
                subject = Subject(PinholeSystem(-2 * reach * np.array([_DIRECTION]), *sizes))
                list(rendering(Page(_SMALL, _SMALL), subject, Studio(volume=True, near=True), item, False, 1))
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
    """Render a scene; in the window as Blender's own job, which its status bar shows and Esc ends."""
    path = Path(scene.render.filepath)
    path.unlink(missing_ok=True)
    try:
        if not jobs.is_running():
            bpy.ops.render.render(write_still=True, scene=scene.name)
            return _pixels(path)
        view = bpy.context.preferences.view
        before, view.render_display_type = view.render_display_type, "NONE"
        try:
            bpy.ops.render.render("INVOKE_DEFAULT", write_still=True, scene=scene.name)
        finally:
            view.render_display_type = before
    except RuntimeError as error:
        raise InputError(f"Blender cannot render the figure: {str(error).strip().splitlines()[0]}") from error
    while bpy.app.is_job_running("RENDER"):
        time.sleep(_PAUSE)
        yield
    if not path.is_file():  # the user has pressed Esc
        raise Cancelled
    return _pixels(path)


def _pixels(path: Path) -> NDArray[np.uint8]:
    """Colours (height, width, 3) of a PNG, row 0 at the top."""
    image = bpy.data.images.load(str(path))
    width, height = image.size
    values = np.empty(4 * width * height, np.float32)
    image.pixels.foreach_get(values)
    bpy.data.images.remove(image)
    return np.rint(values.reshape(height, width, 4)[::-1, :, :3] * 255).astype(np.uint8)


def _draw_axes(page: Page, camera: bpy.types.Object) -> None:
    """The directions of x, y and z, in the upper right corner beside the title."""
    em = page.em
    x, y = page.width - 3.2 * em, 2.9 * em
    right, up, back = np.array(camera.rotation_quaternion.to_matrix()).T
    for axis in np.argsort(back):  # the nearest last
        across, down, color = right[axis] * em, -up[axis] * em, _AXES[axis]
        page.line([(x, y), (x + 1.4 * across, y + 1.4 * down)], color, 0.14 * em)
        page.text("xyz"[axis], x + 2.0 * across, y + 2.0 * down + 0.3 * em, 0.9 * em, color, "middle")


def _remove(scene: bpy.types.Scene) -> None:
    """Remove the studio, all but the volume's data."""
    found = list(scene.collection.all_objects)
    datas = {item.data for item in found if item.type != "VOLUME"}
    materials = {m for data in datas for m in getattr(data, "materials", ()) if m.name.startswith(ids.STUDIO)}
    homes = list(scene.collection.children)
    world = scene.world
    bpy.data.scenes.remove(scene)
    bpy.data.batch_remove([*found, *datas, *materials, *homes, world])
