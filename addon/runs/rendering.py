"""Projections of a scene: the volume and the scanner projected, images in the .blend, exact arrays in a file beside it."""

import contextlib
import math
import sys
import time
import uuid
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...core import ProjectionRun, Recipe, memory, read_recipe, read_run, write_run
from ...core.errors import InputError, warn
from ...core.geometry.system import chosen_modules
from ...core.progress import Progress, Stages, stages_of
from ...core.projector import Model
from ...core.runs.display import Display
from ...core.runs.mosaic import caption
from ...core.runs.projecting import warn_of_energy
from ...core.runs.run_recipe import recipe_model, run_recipe, with_phantom
from ...core.volumes.volume import require_quantity
from ..blender import ids, jobs, storage, timers
from ..phantoms import phantoms
from ..pictures import images, planes, recoloring
from ..scanner import following, scanner
from ..volumes import volumes
from . import projection_properties, runs

_REST = 0.05  # s until the run that was chosen in the list is shown


def render_job(context: bpy.types.Context, recipe: Recipe, volume: str = "", mu: str = "") -> jobs.Job:
    """The job that projects a volume of the context's scene into its scanner's modules as `recipe` says.

    `volume` and `mu` name the objects of what is projected and what attenuates; by default they are the panel's. Raises
    InputError where there is none, a phantom has changed, settings do not go together, or memory does not suffice.
    """
    scene = context.scene
    collection = scanner.required_scanner(scene)
    system = chosen_modules(scanner.read_scanner(collection), recipe["system.modules"], "modules")
    model = recipe_model(recipe, system)  # refuses what cannot be, before the work begins
    item, mu_item = sources(context, recipe, model, volume, mu)
    for chosen in filter(None, (item, mu_item)):
        phantoms.require_current(chosen)
    rows, columns = recipe["detector.rows"], recipe["detector.columns"]
    # The array, means and colours of it, and the packed images, in our memory and in Blender's beside those of the last run.
    memory.require(16.0 * len(system) * rows * columns, f"{len(system)} images of {columns} x {rows} pixels")
    recipe = recipe.updated({"volume.object": item.name, "attenuation.object": mu_item and mu_item.name})
    recipe = _with_volume(with_energy(recipe, item), item)
    read_volume, read_mu = volumes.reader(item), mu_item and volumes.reader(mu_item)
    energy = mu_item and phantoms.mu_energy(mu_item)
    paths, display = [run_path(scene) for _ in recipe["frames.times"] or [0.0]], scene.mphdrr_display.display()
    state = runs.state_of(system, recipe, item, mu_item)
    scene_uid, scanner_uid, start = scene.session_uid, collection.session_uid, time.perf_counter()

    def work(progress: Progress) -> list[tuple[ProjectionRun, images.Pictures]]:
        stages = stages_of(progress)
        warn_of_energy(model, energy, repr(recipe["attenuation.object"]))
        stages("reading")
        made = run_recipe(recipe, system, read_volume(), read_mu and read_mu(), stages)
        return [(run, kept(run, path, display, stages)) for run, path in zip(made, paths, strict=True)]

    def finish(result: list[tuple[ProjectionRun, images.Pictures]]) -> jobs.Finishing:
        scene = jobs.require_scene(scene_uid, "the projections are")
        owner = jobs.find_by_uid(bpy.data.collections, scanner_uid)  # which need not be the panel's any more
        for number, (path, (run, made)) in enumerate(zip(paths, result, strict=True)):
            mosaic = yield from storing(scene, run, path, state, owner, made)
            scene.mphdrr_projections.runs[-1].keep = number < len(paths) - 1  # each frame is a run
        images.show_below(mosaic, bpy.context)
        where = path if bpy.data.filepath else f"{path} until the .blend is saved"
        seconds = time.perf_counter() - start
        return f"Projected {recipe['volume.object']!r} into {len(run.views)} modules in {seconds:.1f} s: {where}"

    def undo() -> None:
        for path in paths:
            path.unlink(missing_ok=True)

    return jobs.Job("Projecting", work, finish, undo)


def kept(run: ProjectionRun, path: Path, display: Display, stages: Stages) -> images.Pictures:
    """Write a run's file, in a job's thread, and make what its images hold."""
    stages("writing the run file")
    write_run(run, path)
    return images.make_pictures(run, display, stages("packing"))


def sources(
    context: bpy.types.Context, recipe: Recipe, model: Model, volume: str = "", mu: str = ""
) -> tuple[bpy.types.Object, bpy.types.Object | None]:
    """The objects of what is projected and of what attenuates it, if anything; arguments and errors as of `render_job`."""
    taken = scanner.kind_of(scanner.required_scanner(context.scene)).takes
    taken = tuple(each for each in taken if each in (("mu",) if recipe["model.photons"] else model.takes))
    item = _chosen_volume(context, volume, taken, model.name)
    return item, attenuating(context, recipe, mu)


def with_energy(recipe: Recipe, item: bpy.types.Object) -> Recipe:
    """The recipe with the energy at which an object's mu holds, if spectra need it."""
    return recipe.updated({"volume.energy": phantoms.mu_energy(item)}) if recipe["model.kind"] == "spectral" else recipe


def attenuating(context: bpy.types.Context, recipe: Recipe, mu: str = "") -> bpy.types.Object | None:
    """The object of what attenuates a recipe's photons, by default the panel's; errors as of `render_job`."""
    item = _given(context, "mu", mu) if recipe["model.kind"] == "emission" else None
    if item is not None:
        taken = ("mu", "hu") if recipe["model.isotope"] else ("mu",)  # CT numbers at the isotope's energies
        require_quantity(volumes.quantity_of(item), taken, f"{item.name!r} for attenuation")
    return item


def integrates_activity(context: bpy.types.Context) -> bool:
    """Whether the panel's settings ask for a radiograph of activity, whatever volume is meant: few want one."""
    settings, known = context.scene.mphdrr_projections, volumes.volume_objects(context.scene)
    if not scanner.sees_activity(scanner.active_scanner(context.scene)):
        return False
    meant = [settings.volume] if settings.volume else [context.object] if context.object in known else known
    is_radiograph = settings.model == "TRANSMISSION" and not settings.photons
    return is_radiograph and bool(meant) and all(volumes.quantity_of(item) == "activity" for item in meant)


def run_path(scene: bpy.types.Scene) -> Path:
    """A file for a new run of the scene."""
    return storage.folder() / f"{bpy.path.clean_name(scene.name)}-projections-{uuid.uuid4().hex[:8]}.h5"


def load_recipe(scene: bpy.types.Scene, path: Path) -> None:
    """Set the scene's panel as a recipe (.toml) or the recipe of a run says."""
    recipe = read_recipe(path) if path.suffix.lower() == ".toml" else read_run(path).recipe
    settings = scene.mphdrr_projections
    _set_physics(scene, recipe)
    known = {item.name: item for item in volumes.volume_objects(scene)}
    settings.volume, settings.mu = known.get(recipe["volume.object"]), known.get(recipe["attenuation.object"])
    name = recipe["attenuation.object"] or ", ".join(recipe["attenuation.file"] or ())
    if name and settings.mu is None:
        warn(f"the recipe's attenuation, {name}, is not chosen: import it if it is not here, and choose it in Physics")


def _set_physics(scene: bpy.types.Scene, recipe: Recipe) -> None:
    """Set the panel, and the angle that it has from the scanner; raises InputError for what the panel cannot show."""
    projection_properties.set_panel(scene.mphdrr_projections, recipe)
    collection = scanner.active_scanner(scene)
    if collection is not None and projection_properties.OPENING_ANGLE in recipe.given:
        collection.mphdrr_scanner.opening_angle = math.radians(recipe[projection_properties.OPENING_ANGLE])


def exporting(scene: bpy.types.Scene, path: Path) -> jobs.Job:
    """The job that writes the shown run to a file, in the format of its suffix: .h5, .npz or .pt.

    Warns where the scene has changed since the run was made.
    """
    if not scene.mphdrr_projections.run_file:
        raise InputError("nothing to export: render the projections first")
    source = file_of(scene.mphdrr_projections.run_file)
    if found := runs.changes(scene):
        warn(f"the run is not of the scene as it is now ({'; '.join(found)}): {path.name} holds what was rendered")

    def work(progress: Progress) -> None:
        stages_of(progress)("reading the run file")
        run = read_run(source)
        stages_of(progress)("writing the file")
        write_run(run, path)

    return jobs.Job("Exporting the projections", work, lambda _: f"Wrote {path}")


def file_of(run_file: str) -> Path:
    """A run's file, from its path in the .blend; `InputError` where it is gone."""
    path = storage.absolute(run_file)
    if not path.is_file():
        raise InputError(f"{path}: the run's file is gone; render the projections again")
    return path


def show_run(scene: bpy.types.Scene, run: ProjectionRun, path: Path, volume: bpy.types.Object | None) -> None:
    """Put `run`, which is kept in the file `path`, into the scene's list and show it; the panel says what it was made with.

    `volume` is the object of what was projected, None where the run was measured.
    """
    state = taken_over(scene, run, volume)
    for _ in storing(scene, run, path, state, scanner.active_scanner(scene)):
        pass


def taken_over(scene: bpy.types.Scene, run: ProjectionRun, volume: bpy.types.Object | None) -> dict[str, Any]:
    """Set the panel as a run that was made outside the scene says; returns the scene's state that it belongs to.

    That is empty where the run does not say how it was made.
    """
    try:
        recipe = run.recipe
    except InputError:
        return {}
    with contextlib.suppress(InputError):  # what the panel cannot show counts as changed
        _set_physics(scene, recipe)
    state = runs.state_of(run.system, recipe, volume, None)
    if volume is None:
        return state | {"measured": caption(run)}
    attenuates = [value for key, value in recipe.given.items() if key.startswith("attenuation.") and value]
    return state | {"mu": {"name": f"of {run.settings['volume']}"}} if attenuates else state


def storing(
    scene: bpy.types.Scene,
    run: ProjectionRun,
    path: Path,
    state: Mapping[str, Any],
    collection: bpy.types.Collection | None,
    made: images.Pictures | None = None,
) -> Generator[tuple[str, int, int] | None, None, bpy.types.Image]:
    """Show `run` of the scanner `collection` and put it into the list; returns the mosaic.

    It is kept in the file `path` and was made in that `state` of the scene; `made` is what `images.make_pictures` made of it.
    """
    mosaic = yield from showing(scene, run, collection, made)
    runs.add(scene, run, path, state, collection)
    return mosaic


def showing(
    scene: bpy.types.Scene,
    run: ProjectionRun,
    collection: bpy.types.Collection | None,
    made: images.Pictures | None = None,
) -> Generator[tuple[str, int, int] | None, None, bpy.types.Image]:
    """Make images and planes of a run of the scanner `collection`, in place of another's; returns the mosaic."""
    mosaic = yield from images.store_images(run, made or images.make_pictures(run, scene.mphdrr_display.display()))
    yield None
    place(scene, run, collection)
    return mosaic


def place(scene: bpy.types.Scene, run: ProjectionRun, collection: bpy.types.Collection | None) -> None:
    """Make the planes of a run of the scanner `collection`, of which there are images."""
    images.set_scanner(bpy.data.images[ids.MOSAIC], collection)
    planes.show(scene, run, collection)
    recoloring.check()  # the display may have been edited meanwhile


def showing_job(scene: bpy.types.Scene, index: int) -> jobs.Job:
    """The job that shows a run of the scene's list."""
    item = scene.mphdrr_projections.runs[index]
    uid, name, file, path = scene.session_uid, item.name, item.file, file_of(item.file)
    display = scene.mphdrr_display.display()

    def work(progress: Progress) -> tuple[ProjectionRun, images.Pictures]:
        run = read_run(path)
        return run, images.make_pictures(run, display, stages_of(progress)("packing"))

    def finish(result: tuple[ProjectionRun, images.Pictures]) -> jobs.Finishing:
        run, made = result
        scene = jobs.require_scene(uid, "the projections are")
        files = [item.file for item in scene.mphdrr_projections.runs]
        if file not in files:  # it was removed meanwhile
            raise InputError(f"the run {name!r} is gone")
        index = files.index(file)
        images.show((yield from showing(scene, run, scene.mphdrr_projections.runs[index].scanner, made)), bpy.context)
        runs.mark_shown(scene, index)
        return f"Shown: {name}"

    return jobs.Job("Showing a run", work, finish)


def active_run_changed(scene: bpy.types.Scene) -> None:
    """Another run of the list was chosen: show it."""
    if following.is_writing():
        return
    if bpy.app.background:
        _show_chosen()
    else:
        timers.schedule(_show_chosen, _REST)


def _show_chosen() -> float | None:
    """Press the button that shows the chosen run; later, if a job is running."""
    if jobs.is_running():
        return 10 * _REST
    windows = bpy.context.window_manager.windows
    with bpy.context.temp_override(window=windows[0]) if windows else contextlib.nullcontext():
        scene = bpy.context.scene
        settings, shown = scene.mphdrr_projections, runs.shown(scene)
        if settings.active_run < len(settings.runs) and settings.runs[settings.active_run] != shown:
            try:
                bpy.ops.mphdrr.show_run("INVOKE_DEFAULT", index=settings.active_run)
            except RuntimeError as error:  # its file is gone
                print(f"mphDRR: {error}", file=sys.stderr)
    return None


def remove_run(scene: bpy.types.Scene, index: int) -> str:
    """Take a run off the scene's list, with its file if it is this .blend's own, and show the one beside it."""
    settings = scene.mphdrr_projections
    item = settings.runs[index]
    is_shown, name = item == runs.shown(scene), item.name
    shown = settings.run_file
    text = f"Removed {name!r}" + ("" if runs.remove_file(item) else f"; its file stays: {storage.absolute(item.file)}")
    settings.runs.remove(index)
    if not is_shown:
        runs.mark_shown(scene, next((i for i, item in enumerate(settings.runs) if item.file == shown), -1))
    elif not settings.runs:
        if images.belong_to(scene):
            images.clear()
        planes.remove(scene)
        runs.mark_shown(scene, -1)
    else:
        settings.run_file = settings.run_summary = ""  # until the other one is shown
        settings.active_run = min(index, len(settings.runs) - 1)
    return text


def _with_volume(recipe: Recipe, item: bpy.types.Object) -> Recipe:
    """The recipe with what the volume's object is: its state and its phantom."""
    state = "none"
    if item.data.is_sequence:
        state = volumes.state_text(item)
        recipe = recipe.updated({"volume.state": state})
    settings = phantoms.settings_of(item)
    number = 0 if state == "none" else int(state.split()[0]) - 1
    return recipe if settings is None else of_phantom(recipe, settings, volumes.pose_of_object(item), number)


def of_phantom(recipe: Recipe, settings: phantoms.PhantomSettings, pose: NDArray[np.float64], state: int = 0) -> Recipe:
    """The recipe with the phantom of these settings, at a world-from-phantom pose (4, 4), mm, in a state, from 0."""
    made = phantoms.copy_settings(settings)
    values: dict[str, Any] = {
        "phantom.voxels": made.grid.shape, "phantom.spacing": made.grid.spacing.tolist(), "phantom.turn_grid": True,
    }  # fmt: skip
    if "text" in made.settings:
        values["phantom.text"] = made.settings["text"]
    return with_phantom(recipe.updated(values), made.states[state], pose)


def _chosen_volume(context: bpy.types.Context, name: str, taken: Sequence[str], model: str) -> bpy.types.Object:
    """The volume named, else the panel's, else the active one, else the only one of a quantity that the model takes."""
    known = volumes.volume_objects(context.scene)
    chosen = _given(context, "volume", name)
    # An active CT is meant, though it has to be converted first; otherwise a fitting volume is looked for.
    if chosen is None and context.object in known and "mu" in taken and volumes.quantity_of(context.object) == "hu":
        chosen = context.object
    if chosen is not None:
        require_quantity(volumes.quantity_of(chosen), taken, f"{chosen.name!r} for {model}")
        return chosen
    fitting = [item for item in known if volumes.quantity_of(item) in taken]
    if context.object in fitting:
        return context.object
    if len(fitting) > 1 and (last := runs.projected(context.scene)) in fitting:  # a reconstruction stands beside it
        return last
    what = " or ".join(taken)
    if not fitting:
        raise InputError(f"no volume of {what} in the scene: add a phantom first")
    if len(fitting) > 1:
        raise InputError(f"choose what to project: there are {len(fitting)} volumes of {what}")
    return fitting[0]


def _given(context: bpy.types.Context, setting: str, name: str) -> bpy.types.Object | None:
    """The volume called `name`, or else the panel's, if it has one."""
    known = {item.name: item for item in volumes.volume_objects(context.scene)}
    if name and name not in known:
        raise InputError(f"no volume is named {name!r}; there are: {', '.join(known) or 'none'}")
    settings = context.scene.mphdrr_projections
    chosen = known[name] if name else getattr(settings, setting)
    if chosen is not None and chosen not in known.values():  # Blender keeps a volume there that the user has deleted
        label = settings.bl_rna.properties[setting].name
        raise InputError(f"{label} {chosen.name!r} is not in this scene any more: choose another, or none")
    return chosen
