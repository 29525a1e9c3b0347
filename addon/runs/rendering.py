"""Projections of a scene: volume and scanner projected, images in the .blend, exact arrays in a file beside it."""

import contextlib
import math
import sys
import time
import uuid
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

import bpy

from ...core import ProjectionRun, Recipe, memory, read_recipe, read_run, write_run
from ...core.arrays import Floats
from ...core.errors import InputError, warn
from ...core.files import ensure_folder
from ...core.geometry.system import chosen_modules
from ...core.progress import Progress, Stages, stages_of
from ...core.projector import Model
from ...core.runs.display import Display
from ...core.runs.mosaic import counts_caption
from ...core.runs.projecting import warn_of_energy
from ...core.runs.run_recipe import recipe_model, run_recipe, with_phantom
from ...core.volumes.volume import require_quantity
from ..blender import ids, jobs, storage, timers
from ..phantoms import phantoms
from ..pictures import images, planes, recoloring
from ..scanner import following, scanner
from ..volumes import volumes
from . import projection_properties, runs

_PAUSE = 0.05  # s from the choice of a run in the list until it is shown


def render_job(context: bpy.types.Context, recipe: Recipe, volume: str = "", mu: str = "") -> jobs.Job:
    """Return the job that projects a volume of the context's scene into its scanner's modules by a recipe.

    `volume` and `mu` name the objects to project and to attenuate; by default they are the panel's. Raises InputError where
    there is none, a phantom has changed, settings contradict each other, or memory does not suffice.
    """
    scene = context.scene
    collection = scanner.required_scanner(scene)
    system = chosen_modules(scanner.read_scanner(collection), recipe["system.modules"], "modules")
    model = recipe_model(recipe, system)  # raises its errors before the work begins
    item, mu_item = source_objects(context, recipe, model, volume, mu)
    for volume_item in filter(None, (item, mu_item)):
        phantoms.require_current(volume_item)
    rows, columns = recipe["detector.rows"], recipe["detector.columns"]
    # Memory for the array, its means and colours, and the packed images, ours and Blender's, beside those of the last run.
    memory.require(16.0 * len(system) * rows * columns, f"{len(system)} images of {columns} x {rows} pixels")
    recipe = recipe.updated({"volume.object": item.name, "attenuation.object": mu_item and mu_item.name})
    recipe = _with_volume(with_energy(recipe, item), item)
    read_volume, read_mu = volumes.reader(item), mu_item and volumes.reader(mu_item)
    energy = mu_item and phantoms.mu_energy(mu_item)
    paths, display = [new_run_path(scene) for _ in recipe["frames.times"] or [0.0]], scene.mphdrr_display.display()
    state = runs.scene_state(system, recipe, item, mu_item)
    scene_uid, scanner_uid, start = scene.session_uid, collection.session_uid, time.perf_counter()

    def work(progress: Progress) -> list[tuple[ProjectionRun, images.Pictures]]:
        """Project the volume; write the run of each frame, and return the runs with their pictures."""
        stages = stages_of(progress)
        warn_of_energy(model, energy, repr(recipe["attenuation.object"]))
        stages("reading")
        frames = run_recipe(recipe, system, read_volume(), read_mu and read_mu(), stages)
        return [(run, write_and_draw(run, path, display, stages)) for run, path in zip(frames, paths, strict=True)]

    def finish(result: list[tuple[ProjectionRun, images.Pictures]]) -> jobs.Finishing:
        """Put the runs into the scene's list, show the last, and return the line to report."""
        scene = jobs.require_scene(scene_uid, "the projections are")
        owner = jobs.find_by_uid(bpy.data.collections, scanner_uid)  # may no longer be the panel's
        for number, (path, (run, pictures)) in enumerate(zip(paths, result, strict=True)):
            mosaic = yield from store_and_show(scene, run, path, state, owner, pictures)
            scene.mphdrr_projections.runs[-1].keep = number < len(paths) - 1  # each frame is a run
        images.show_below(mosaic, bpy.context)
        path = storage.absolute(scene.mphdrr_projections.run_file)
        location = path if bpy.data.filepath else f"{path} until the .blend is saved"
        seconds = time.perf_counter() - start
        modules = ids.counted(len(run.views), "module")
        return f"Projected {recipe['volume.object']!r} into {modules} in {seconds:.1f} s: {location}"

    def undo() -> None:
        """Remove the run files of a cancelled job."""
        for path in paths:
            path.unlink(missing_ok=True)

    return jobs.Job("Projecting", work, finish, undo)


def write_and_draw(run: ProjectionRun, path: Path, display: Display, stages: Stages) -> images.Pictures:
    """Write a run's file and make its pictures, in a job's worker thread."""
    stages("writing the run file")
    ensure_folder(path.parent)  # a Save As has removed it if it was empty
    write_run(run, path)
    return images.make_pictures(run, display, stages("packing"))


def source_objects(
    context: bpy.types.Context, recipe: Recipe, model: Model, volume: str = "", mu: str = ""
) -> tuple[bpy.types.Object, bpy.types.Object | None]:
    """Return the objects to project and, if any, to attenuate; arguments and errors are those of `render_job`."""
    usable = ("mu",) if recipe["model.photons"] else model.takes
    kind = scanner.kind_of(scanner.required_scanner(context.scene))
    item = _chosen_volume(context, volume, tuple(q for q in kind.takes if q in usable), model.name)
    return item, attenuating_object(context, recipe, mu)


def with_energy(recipe: Recipe, item: bpy.types.Object) -> Recipe:
    """Return the recipe with the energy at which an object's mu holds, if its model needs spectra."""
    return recipe.updated({"volume.energy": phantoms.mu_energy(item)}) if recipe["model.kind"] == "spectral" else recipe


def attenuating_object(context: bpy.types.Context, recipe: Recipe, mu: str = "") -> bpy.types.Object | None:
    """Return the object that attenuates a recipe's photons, by default the panel's; errors are those of `render_job`."""
    item = _named_or_panel_volume(context, "mu", mu) if recipe["model.kind"] == "emission" else None
    if item is not None:
        # CT numbers are converted at the isotope's energies.
        quantities = ("mu", "hu") if recipe["model.isotope"] else ("mu",)
        require_quantity(volumes.quantity_of(item), quantities, f"{item.name!r} for attenuation")
    return item


def integrates_activity(context: bpy.types.Context) -> bool:
    """Return whether the panel asks for a radiograph of activity, whichever volume it would take: few users want one."""
    settings, in_scene = context.scene.mphdrr_projections, volumes.volume_objects(context.scene)
    if not scanner.sees_activity(scanner.active_scanner(context.scene)):
        return False
    candidates = [settings.volume] if settings.volume else [context.object] if context.object in in_scene else in_scene
    is_radiograph = settings.model == "TRANSMISSION" and not settings.photons
    return is_radiograph and bool(candidates) and all(volumes.quantity_of(item) == "activity" for item in candidates)


def new_run_path(scene: bpy.types.Scene) -> Path:
    """Return a new path for the file of a run of the scene."""
    return storage.folder() / f"{bpy.path.clean_name(scene.name)}-projections-{uuid.uuid4().hex[:8]}.h5"


def load_recipe(scene: bpy.types.Scene, path: Path) -> None:
    """Set the scene's panel to a recipe (.toml) or the recipe of a run."""
    recipe = read_recipe(path) if path.suffix.lower() == ".toml" else read_run(path).recipe
    settings = scene.mphdrr_projections
    _set_physics(scene, recipe)
    by_name = {item.name: item for item in volumes.volume_objects(scene)}
    settings.volume, settings.mu = by_name.get(recipe["volume.object"]), by_name.get(recipe["attenuation.object"])
    name = recipe["attenuation.object"] or ", ".join(recipe["attenuation.file"] or ())
    if name and settings.mu is None:
        warn(f"the recipe's attenuation, {name}, is not chosen: import it if it is not here, and choose it in Physics")


def _set_physics(scene: bpy.types.Scene, recipe: Recipe) -> None:
    """Set the panel, and the scanner's opening angle, to a recipe; raise `InputError` for what the panel cannot show."""
    projection_properties.set_panel(scene.mphdrr_projections, recipe)
    collection = scanner.active_scanner(scene)
    if collection is not None and projection_properties.OPENING_ANGLE in recipe.given:
        collection.mphdrr_scanner.opening_angle = math.radians(recipe[projection_properties.OPENING_ANGLE])


def export_job(scene: bpy.types.Scene, path: Path) -> jobs.Job:
    """Return the job that writes the shown run to a file, in the format of its suffix: .h5, .npz, .pt or .dcm.

    Warns where the scene has changed since the run was made.
    """
    if not scene.mphdrr_projections.run_file:
        raise InputError("nothing to export: render the projections first")
    source = run_file_path(scene.mphdrr_projections.run_file)
    if changes := runs.changes(scene):
        warn(f"the run is not of the scene as it is now ({'; '.join(changes)}): {path.name} holds what was rendered")

    def work(progress: Progress) -> None:
        """Write the shown run to the chosen file."""
        stages_of(progress)("reading the run file")
        run = read_run(source)
        stages_of(progress)("writing the file")
        write_run(run, path)

    return jobs.Job("Exporting the projections", work, lambda _: f"Wrote {path}")


def run_file_path(run_file: str) -> Path:
    """Return a run's file from its path in the .blend; raise `InputError` where the file is gone."""
    path = storage.absolute(run_file)
    if not path.is_file():
        raise InputError(f"{path}: the run's file is gone; render the projections again")
    return path


def show_run(scene: bpy.types.Scene, run: ProjectionRun, path: Path, volume: bpy.types.Object | None) -> None:
    """Put a run whose file is `path` into the scene's list and show it; the panel gets the run's settings.

    `volume` is the object of the projected volume, None where the run was measured.
    """
    state = adopt_settings(scene, run, volume)
    for _ in store_and_show(scene, run, path, state, scanner.active_scanner(scene)):
        pass


def adopt_settings(scene: bpy.types.Scene, run: ProjectionRun, volume: bpy.types.Object | None) -> dict[str, Any]:
    """Set the panel to the settings of a run made outside the scene, and return the scene's state that belongs to the run.

    The state is empty where the run does not tell its settings.
    """
    try:
        recipe = run.recipe
    except InputError:
        return {}
    with contextlib.suppress(InputError):  # settings that the panel cannot show appear as changes
        _set_physics(scene, recipe)
    state = runs.scene_state(run.system, recipe, volume, None)
    if volume is None:
        return state | {"measured": counts_caption(run)}
    attenuates = [value for key, value in recipe.given.items() if key.startswith("attenuation.") and value]
    return state | {"mu": {"name": f"of {run.settings['volume']}"}} if attenuates else state


def store_and_show(
    scene: bpy.types.Scene,
    run: ProjectionRun,
    path: Path,
    state: Mapping[str, Any],
    collection: bpy.types.Collection | None,
    pictures: images.Pictures | None = None,
) -> Generator[tuple[str, int, int] | None, None, bpy.types.Image]:
    """Show a run of the scanner `collection`, put it into the list, and return the mosaic.

    `path` is the run's file, `state` the scene's state when it was made, `pictures` the result of `images.make_pictures`.
    """
    mosaic = yield from show_images(scene, run, collection, pictures)
    runs.add_run(scene, run, path, state, collection)
    return mosaic


def show_images(
    scene: bpy.types.Scene,
    run: ProjectionRun,
    collection: bpy.types.Collection | None,
    pictures: images.Pictures | None = None,
) -> Generator[tuple[str, int, int] | None, None, bpy.types.Image]:
    """Make images and planes of a run of the scanner `collection`, in place of another run's, and return the mosaic."""
    mosaic = yield from images.store_images(run, pictures or images.make_pictures(run, scene.mphdrr_display.display()))
    yield None
    show_planes(scene, run, collection)
    return mosaic


def show_planes(scene: bpy.types.Scene, run: ProjectionRun, collection: bpy.types.Collection | None) -> None:
    """Make the planes of a run of the scanner `collection` whose images are stored."""
    images.set_scanner(bpy.data.images[ids.MOSAIC], collection)
    planes.show(scene, run, collection)
    recoloring.check()  # the display may have been edited since the pictures were made


def show_run_job(scene: bpy.types.Scene, index: int, photons: str = "all") -> jobs.Job:
    """Return the job that shows a run of the scene's list; `photons` is one of `core.runs.run.PHOTONS`."""
    item = scene.mphdrr_projections.runs[index]
    uid, name, file, path = scene.session_uid, item.name, item.file, run_file_path(item.file)
    display = scene.mphdrr_display.display()

    def work(progress: Progress) -> tuple[ProjectionRun, images.Pictures]:
        """Read the run, and return it with its pictures."""
        run = read_run(path).of_photons(photons)
        return run, images.make_pictures(run, display, stages_of(progress)("packing"))

    def finish(result: tuple[ProjectionRun, images.Pictures]) -> jobs.Finishing:
        """Show the run's pictures at the scanner's modules, and return the line to report."""
        run, pictures = result
        scene = jobs.require_scene(uid, "the projections are")
        files = [item.file for item in scene.mphdrr_projections.runs]
        if file not in files:  # removed since the job began
            raise InputError(f"the run {name!r} is gone")
        index = files.index(file)
        owner = scene.mphdrr_projections.runs[index].scanner
        images.show((yield from show_images(scene, run, owner, pictures)), bpy.context)
        bpy.data.images[ids.MOSAIC][images.PHOTONS] = photons
        runs.mark_shown(scene, index)
        return f"Shown: {name}" + ("" if photons == "all" else f", {photons} photons")

    return jobs.Job("Showing a run", work, finish)


def active_run_changed(scene: bpy.types.Scene) -> None:
    """Show a run that was chosen in the list."""
    if following.is_writing():
        return
    if bpy.app.background:
        _show_active_run()
    else:
        timers.schedule(_show_active_run, _PAUSE)


def _show_active_run() -> float | None:
    """Press the button that shows the chosen run; wait if a job is running."""
    if jobs.is_running():
        return 10 * _PAUSE
    windows = bpy.context.window_manager.windows
    with bpy.context.temp_override(window=windows[0]) if windows else contextlib.nullcontext():
        scene = bpy.context.scene
        settings, current_run = scene.mphdrr_projections, runs.shown_run(scene)
        if settings.active_run < len(settings.runs) and settings.runs[settings.active_run] != current_run:
            try:
                bpy.ops.mphdrr.show_run("INVOKE_DEFAULT", index=settings.active_run)
            except RuntimeError as error:  # for example that its file is gone
                print(f"mphDRR: {error}", file=sys.stderr)
    return None


def remove_run(scene: bpy.types.Scene, index: int) -> str:
    """Remove a run from the scene's list, and its file if it is in this .blend's folder; show the next run in the list."""
    settings = scene.mphdrr_projections
    item = settings.runs[index]
    is_shown, name = item == runs.shown_run(scene), item.name
    shown_file = settings.run_file
    text = f"Removed {name!r}" + ("" if runs.remove_file(item) else f"; its file stays: {storage.absolute(item.file)}")
    settings.runs.remove(index)
    if not is_shown:
        runs.mark_shown(scene, next((i for i, item in enumerate(settings.runs) if item.file == shown_file), -1))
    elif not settings.runs:
        if images.belong_to(scene):
            images.clear()
        planes.remove(scene)
        runs.mark_shown(scene, -1)
    else:
        settings.run_file = settings.run_summary = ""  # until the next run is shown
        settings.active_run = min(index, len(settings.runs) - 1)
    return text


def _with_volume(recipe: Recipe, item: bpy.types.Object) -> Recipe:
    """Return the recipe with the state and the phantom of the volume's object."""
    state = "none"
    if item.data.is_sequence:
        state = volumes.state_text(item)
        recipe = recipe.updated({"volume.state": state})
    settings = phantoms.settings_of(item)
    number = 0 if state == "none" else int(state.split()[0]) - 1
    return recipe if settings is None else with_settings(recipe, settings, volumes.pose_of_object(item), number)


def with_settings(recipe: Recipe, settings: phantoms.PhantomSettings, pose: Floats, state: int = 0) -> Recipe:
    """Return the recipe with a phantom of these settings, at a world-from-phantom pose (4, 4), mm, in a state from 0."""
    job = phantoms.copy_settings(settings)
    values: dict[str, Any] = {
        "phantom.voxels": job.grid.shape, "phantom.spacing": job.grid.spacing.tolist(), "phantom.turn_grid": True,
    }  # fmt: skip
    if "text" in job.settings:
        values["phantom.text"] = job.settings["text"]
    return with_phantom(recipe.updated(values), job.states[state], pose)


def _chosen_volume(context: bpy.types.Context, name: str, quantities: Sequence[str], model: str) -> bpy.types.Object:
    """Return the named volume, else the panel's, the active one, or the only one of a quantity that the model takes."""
    scene_volumes = volumes.volume_objects(context.scene)
    volume = _named_or_panel_volume(context, "volume", name)
    active = context.object if context.object in scene_volumes else None
    # An active CT is taken where mu is needed, so that the error tells to convert it first.
    if volume is None and active is not None and "mu" in quantities and volumes.quantity_of(active) == "hu":
        volume = active
    if volume is not None:
        require_quantity(volumes.quantity_of(volume), quantities, f"{volume.name!r} for {model}")
        return volume
    fitting = [item for item in scene_volumes if volumes.quantity_of(item) in quantities]
    if active in fitting:
        return active
    # Beside the projected volume there may be reconstructions of it.
    if len(fitting) > 1 and (projected := runs.projected_volume(context.scene)) in fitting:
        return projected
    words = " or ".join(quantities)
    if not fitting:
        raise InputError(f"no volume of {words} in the scene: add a phantom first")
    if len(fitting) > 1:
        raise InputError(f"choose what to project: there are {len(fitting)} volumes of {words}")
    return fitting[0]


def _named_or_panel_volume(context: bpy.types.Context, setting: str, name: str) -> bpy.types.Object | None:
    """Return the volume called `name`, or else the panel's, if it has one."""
    by_name = {item.name: item for item in volumes.volume_objects(context.scene)}
    if name and name not in by_name:
        raise InputError(f"no volume is named {name!r}; there are: {', '.join(by_name) or 'none'}")
    settings = context.scene.mphdrr_projections
    volume = by_name[name] if name else getattr(settings, setting)
    if volume is not None and volume not in by_name.values():  # Blender keeps a deleted volume in the property
        label = settings.bl_rna.properties[setting].name
        raise InputError(f"{label} {volume.name!r} is not in this scene any more: choose another, or none")
    return volume
