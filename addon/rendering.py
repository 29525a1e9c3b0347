"""Projections of a scene: the volume and the scanner projected, images in the .blend, exact arrays in a file beside it."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bpy

from ..core.errors import InputError
from ..core.geometry.module_numbers import chosen_modules
from ..core.geometry.system import PinholeSystem
from ..core.memory import require
from ..core.progress import Progress
from ..core.runs.files import read_run, write_run
from ..core.runs.phantom_recipe import with_phantom
from ..core.runs.projecting import warn_of_energy
from ..core.runs.recipe import Recipe, read_recipe
from ..core.runs.run import ProjectionRun
from ..core.runs.run_recipe import recipe_model, run_recipe
from ..core.volumes.volume import Volume, require_quantity
from . import ids, images, phantoms, scanner, storage, volumes
from .projection_properties import OPENING_ANGLE, set_panel


@dataclass(frozen=True)
class Rendering:
    """One run to be made of a scene.

    Attributes
    ----------
    scene_name, volume_name : str
        The scene, and the volume that is projected.
    recipe : Recipe
        How, and what the volume is.
    system : PinholeSystem
        The scene's modules.
    read_volume, read_mu : callable
        Read the voxels without bpy; `read_mu` is None where nothing attenuates.
    mu_energy : float or None
        keV, at which the attenuation holds, if that is known.
    path : Path
        The run's file.
    """

    scene_name: str
    volume_name: str
    recipe: Recipe
    system: PinholeSystem
    read_volume: Callable[[], Volume]
    read_mu: Callable[[], Volume] | None
    mu_energy: float | None
    path: Path

    def work(self, progress: Progress) -> ProjectionRun:
        """Make the run and write its file, in any thread.

        Raises
        ------
        InputError
            The voxels cannot be read, the model has no meaning for them, or the file cannot be written.
        """
        progress(0, len(self.system))
        if self.mu_energy is not None:
            model = recipe_model(self.recipe, self.system)
            warn_of_energy(model, self.mu_energy, f"the mu of {self.recipe['attenuation.object']!r}")
        mu = None if self.read_mu is None else self.read_mu()
        (run,) = run_recipe(self.recipe, self.system, self.read_volume(), mu, lambda stage: progress)
        write_run(run, self.path)
        return run

    def finish(self, run: ProjectionRun) -> Generator[None, None, None]:
        """Make images of the run in small steps, and show it as the scene's last.

        Raises
        ------
        InputError
            The scene is gone.
        """
        mosaic = yield from images.storing(run.projections, run.system.numbers)
        images.show(mosaic, bpy.context)
        scene = bpy.data.scenes.get(self.scene_name)
        if scene is None:
            raise InputError(f"the scene {self.scene_name!r} is gone; its projections are in {self.path}")
        _record_run(scene, run, self.path)


def prepare(context: bpy.types.Context, recipe: Recipe, volume: str = "", mu: str = "") -> Rendering:
    """What is to be rendered of the context's scene.

    Parameters
    ----------
    context
        Its scene has the scanner.
    recipe
        The settings of model, detector, noise, modules and backend.
    volume, mu
        Names of the objects of what is projected and what attenuates; by default those of the panel.

    Raises
    ------
    InputError
        There is no scanner or no such volume, a phantom has changed, the settings do not go together, or the images do not
        fit into memory.
    """
    scene = context.scene
    system = chosen_modules(scanner.read_scanner(scanner.required_scanner(scene)), recipe["system.modules"], "modules")
    model = recipe_model(recipe, system)  # refuses what cannot be, before the work begins
    photons = recipe["model.photons"]
    item = _chosen_volume(context, volume, ("mu",) if photons else model.takes, model.name)
    mu_item = _chosen_mu(context, mu) if recipe["model.kind"] == "emission" else None
    for chosen in filter(None, (item, mu_item)):
        phantoms.require_current(chosen)
    rows, columns = recipe["detector.rows"], recipe["detector.columns"]
    # The array, and Blender's images with four channels in memory and once more, packed.
    require(36.0 * len(system) * rows * columns, f"{len(system)} images of {columns} x {rows} pixels")
    objects = {"volume.object": item.name, "attenuation.object": None if mu_item is None else mu_item.name}
    return Rendering(
        scene.name,
        item.name,
        _described(recipe.updated(objects), item),
        system,
        volumes.reader(item),
        None if mu_item is None else volumes.reader(mu_item),
        None if mu_item is None else phantoms.mu_energy(mu_item),
        storage.folder() / f"{bpy.path.clean_name(scene.name)}-projections.h5",
    )


def load_recipe(scene: bpy.types.Scene, path: Path) -> None:
    """Set the scene's panel as a recipe (.toml) or the recipe of a run says.

    Raises
    ------
    InputError
        The file cannot be read, a run holds no recipe, or the panel has no such value.
    """
    recipe = read_recipe(path) if path.suffix.lower() == ".toml" else read_run(path).recipe
    settings = getattr(scene, ids.SCENE_PROJECTIONS)
    set_panel(settings, recipe)
    known = {item.name: item for item in volumes.volume_objects(scene)}
    settings.volume, settings.mu = known.get(recipe["volume.object"]), known.get(recipe["attenuation.object"])
    collection = scanner.active_scanner(scene)
    if collection is not None and OPENING_ANGLE in recipe.given:
        collection.mphdrr_scanner.opening_angle = math.radians(recipe[OPENING_ANGLE])


def show_run(scene: bpy.types.Scene, run: ProjectionRun, path: Path) -> None:
    """Make images of `run`, which is kept in the file `path`, and show it as the scene's last."""
    images.store_projections(run.projections, run.system.numbers)
    _record_run(scene, run, path)


def _record_run(scene: bpy.types.Scene, run: ProjectionRun, path: Path) -> None:
    state = getattr(scene, ids.SCENE_PROJECTIONS)
    state.run_file = storage.stored_path(path.absolute())
    n_v, n_u = run.views.shape
    what = [run.settings.get("volume"), run.settings.get("backend")]
    state.run_summary = ", ".join([f"{len(run.views)} views of {n_u} × {n_v}", *(text for text in what if text)])


def _described(recipe: Recipe, item: bpy.types.Object) -> Recipe:
    """The recipe with what the volume's object is: its state and its phantom."""
    state = 0
    if item.data.is_sequence:
        text = volumes.state_text(item)
        recipe = recipe.updated({"volume.state": text})
        state = int(text.split()[0]) - 1 if text != "none" else 0
    settings = phantoms.settings_of(item)
    if settings is None:
        return recipe
    made = phantoms.recipe_of(settings)
    values: dict[str, Any] = {
        "phantom.voxels": made.grid.shape, "phantom.spacing": made.grid.spacing.tolist(), "phantom.turn_grid": True,
    }  # fmt: skip
    if settings.bl_rna.properties.get("text") is not None:
        values["phantom.text"] = settings.text.as_string()
    return with_phantom(recipe.updated(values), made.states[state], volumes.pose_of_object(item))


def _chosen_volume(context: bpy.types.Context, name: str, taken: Sequence[str], model: str) -> bpy.types.Object:
    """The volume named, else the panel's, else the active one, else the only one of a quantity that the model takes."""
    known = volumes.volume_objects(context.scene)
    chosen = _named(known, name) if name else _of_panel(context, "volume")
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


def _chosen_mu(context: bpy.types.Context, name: str) -> bpy.types.Object | None:
    """The volume of attenuation coefficients named, else the panel's, else None."""
    chosen = _named(volumes.volume_objects(context.scene), name) if name else _of_panel(context, "mu")
    if chosen is not None:
        require_quantity(volumes.quantity_of(chosen), ("mu",), f"{chosen.name!r} for attenuation")
    return chosen


def _of_panel(context: bpy.types.Context, name: str) -> bpy.types.Object | None:
    """The panel's volume, if it has one. Blender keeps it there even when the user has deleted it."""
    settings = getattr(context.scene, ids.SCENE_PROJECTIONS)
    chosen = getattr(settings, name)
    if chosen is not None and chosen not in volumes.volume_objects(context.scene):
        label = settings.bl_rna.properties[name].name
        raise InputError(f"{label} {chosen.name!r} is not in this scene any more: choose another, or none")
    return chosen


def _named(known: list[bpy.types.Object], name: str) -> bpy.types.Object:
    for item in known:
        if item.name == name:
            return item
    raise InputError(f"no volume is named {name!r}; there are: {', '.join(item.name for item in known) or 'none'}")
