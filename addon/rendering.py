"""Projections of a scene: the volume and the scanner projected, images in the .blend, exact arrays in a file beside it."""

import math
import time
import uuid
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Any

import bpy

from ..core.errors import InputError
from ..core.geometry.system import chosen_modules
from ..core.memory import require
from ..core.progress import Progress, stages_of
from ..core.runs.files import read_run, write_run
from ..core.runs.projecting import warn_of_energy
from ..core.runs.recipe import Recipe, read_recipe
from ..core.runs.run import ProjectionRun
from ..core.runs.run_recipe import recipe_model, run_recipe, with_phantom
from ..core.volumes.volume import require_quantity
from . import images, jobs, phantoms, planes, scanner, storage, volumes
from .projection_properties import OPENING_ANGLE, set_panel

_REST = 0.05  # s without an edit of the display before the pictures are made anew


def render_job(context: bpy.types.Context, recipe: Recipe, volume: str = "", mu: str = "") -> jobs.Job:
    """The job that projects a volume of the context's scene into its scanner's modules as `recipe` says.

    `volume` and `mu` name the objects of what is projected and what attenuates; by default they are the panel's. Raises
    InputError where there is none, a phantom has changed, settings do not go together, or memory does not suffice.
    """
    scene = context.scene
    system = chosen_modules(scanner.read_scanner(scanner.required_scanner(scene)), recipe["system.modules"], "modules")
    model = recipe_model(recipe, system)  # refuses what cannot be, before the work begins
    photons = recipe["model.photons"]
    item = _chosen_volume(context, volume, ("mu",) if photons else model.takes, model.name)
    mu_item = _given(context, "mu", mu) if recipe["model.kind"] == "emission" else None
    if mu_item is not None:
        require_quantity(volumes.quantity_of(mu_item), ("mu",), f"{mu_item.name!r} for attenuation")
    for chosen in filter(None, (item, mu_item)):
        phantoms.require_current(chosen)
    rows, columns = recipe["detector.rows"], recipe["detector.columns"]
    # The array, means and colours of it, and the packed images, in our memory and in Blender's beside those of the last run.
    require(16.0 * len(system) * rows * columns, f"{len(system)} images of {columns} x {rows} pixels")
    recipe = recipe.updated({"volume.object": item.name, "attenuation.object": mu_item and mu_item.name})
    recipe = _with_volume(recipe, item)
    read_volume, read_mu = volumes.reader(item), mu_item and volumes.reader(mu_item)
    energy = mu_item and phantoms.mu_energy(mu_item)
    path, display = run_path(scene), scene.mphdrr_display.display()
    new = path.with_name(f"{path.stem}-{uuid.uuid4().hex[:8]}{path.suffix}")
    scene_name, start = scene.name, time.perf_counter()

    def work(progress: Progress) -> tuple[ProjectionRun, images.Pictures]:
        stages = stages_of(progress)
        if energy is not None:
            warn_of_energy(model, energy, f"the mu of {recipe['attenuation.object']!r}")
        stages("reading")
        (run,) = run_recipe(recipe, system, read_volume(), read_mu and read_mu(), stages)
        stages("writing the run file")
        write_run(run, new)
        return run, images.pictures(run, display, stages("packing"))

    def finish(result: tuple[ProjectionRun, images.Pictures]) -> jobs.Finishing:
        run, made = result
        scene = bpy.data.scenes.get(scene_name)
        if scene is None:
            raise InputError(f"the scene {scene_name!r} is gone; its projections are in {path}")
        mosaic = yield from storing(scene, run, path, made)
        new.replace(path)
        images.show(mosaic, bpy.context)
        where = path if bpy.data.filepath else f"{path} until the .blend is saved"
        seconds = time.perf_counter() - start
        return f"Projected {recipe['volume.object']!r} into {len(run.views)} modules in {seconds:.1f} s: {where}"

    return jobs.Job("Projecting", work, finish, lambda: new.unlink(missing_ok=True))


def run_path(scene: bpy.types.Scene) -> Path:
    """The file of the scene's last run."""
    return storage.folder() / f"{bpy.path.clean_name(scene.name)}-projections.h5"


def load_recipe(scene: bpy.types.Scene, path: Path) -> None:
    """Set the scene's panel as a recipe (.toml) or the recipe of a run says."""
    recipe = read_recipe(path) if path.suffix.lower() == ".toml" else read_run(path).recipe
    settings = scene.mphdrr_projections
    set_panel(settings, recipe)
    known = {item.name: item for item in volumes.volume_objects(scene)}
    settings.volume, settings.mu = known.get(recipe["volume.object"]), known.get(recipe["attenuation.object"])
    collection = scanner.active_scanner(scene)
    if collection is not None and OPENING_ANGLE in recipe.given:
        collection.mphdrr_scanner.opening_angle = math.radians(recipe[OPENING_ANGLE])


def exporting(scene: bpy.types.Scene, filepath: str) -> jobs.Job:
    """The job that writes the scene's last run to a file, in the format of its suffix: .h5, .npz or .pt."""
    run_file = scene.mphdrr_projections.run_file
    if not run_file:
        raise InputError("nothing to export: render the projections first")
    source = storage.absolute(run_file)
    if not source.is_file():
        raise InputError(f"{source}: the last run's file is gone; render the projections again")
    if not filepath:
        raise InputError("no file given: set filepath to a name ending in .h5, .npz or .pt")
    path = storage.absolute(filepath)

    def work(progress: Progress) -> None:
        stages_of(progress)("reading the run file")
        run = read_run(source)
        stages_of(progress)("writing the file")
        write_run(run, path)

    return jobs.Job("Exporting the projections", work, lambda _: f"Wrote {path}")


def show_run(scene: bpy.types.Scene, run: ProjectionRun, path: Path) -> None:
    """Make images of `run`, which is kept in the file `path`, and show it as the scene's last."""
    for _ in storing(scene, run, path):
        pass


def storing(
    scene: bpy.types.Scene, run: ProjectionRun, path: Path, made: images.Pictures | None = None
) -> Generator[tuple[str, int, int], None, bpy.types.Image]:
    """Make images (of `images.pictures`) and planes of `run`, kept in the file `path`, and note it as the scene's last."""
    mosaic = yield from images.storing(run, scene.mphdrr_display.display(), made)
    place(scene, run, path)
    return mosaic


def place(scene: bpy.types.Scene, run: ProjectionRun, path: Path) -> None:
    """Make the planes of `run`, of which there are images, and note it as the scene's last."""
    planes.make(scene, run)
    state = scene.mphdrr_projections
    state.run_file = storage.stored_path(path.absolute())
    n_v, n_u = run.views.shape
    what = [run.settings.get("volume"), run.settings.get("backend")]
    state.run_summary = ", ".join([f"{len(run.views)} views of {n_u} × {n_v}", *(text for text in what if text)])


def display_changed(scene: bpy.types.Scene) -> None:
    """Show the last run in other colours or another window, once the settings rest."""
    if bpy.app.background:
        _display_again()
    elif not bpy.app.timers.is_registered(_display_again):
        bpy.app.timers.register(_display_again, first_interval=_REST)


def _display_again() -> None:
    settings = bpy.context.scene.mphdrr_display
    if not settings.problem:  # which there is between the typing of the window's two ends
        images.show_again(settings.display())


def _with_volume(recipe: Recipe, item: bpy.types.Object) -> Recipe:
    """The recipe with what the volume's object is: its state and its phantom."""
    state = "none"
    if item.data.is_sequence:
        state = volumes.state_text(item)
        recipe = recipe.updated({"volume.state": state})
    settings = phantoms.settings_of(item)
    if settings is None:
        return recipe
    made = phantoms.recipe_of(settings)
    values: dict[str, Any] = {
        "phantom.voxels": made.grid.shape, "phantom.spacing": made.grid.spacing.tolist(), "phantom.turn_grid": True,
    }  # fmt: skip
    if settings.bl_rna.properties.get("text") is not None:
        values["phantom.text"] = settings.text.as_string()
    shown = made.states[0 if state == "none" else int(state.split()[0]) - 1]
    return with_phantom(recipe.updated(values), shown, volumes.pose_of_object(item))


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
