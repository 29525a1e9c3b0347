"""From a run's images back to a volume: the job of ``mphdrr reconstruct`` and of Blender's Reconstruction panel."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, InputWarning
from ..geometry.grid import Grid
from ..memory import require
from ..progress import Stages
from ..reconstruction.methods import METHODS
from ..reconstruction.result import Reconstruction
from ..volumes.volume import Volume
from .recipe import Recipe
from .run import ProjectionRun
from .run_recipe import projector_of_run

Watch = Callable[[int, NDArray[np.float32], list[float]], bool | None]
"""Called as ``watch(iteration, values, objective)`` after each iteration, with the volume's values and the objective after all
iterations so far; what is true ends the reconstruction there."""

TABLES = ("reconstruction", "model", "attenuation", "compute")
"""Of a recipe: what says how a run is reconstructed. The other tables say how its images were made."""


def reconstruct_run(
    run: ProjectionRun,
    recipe: Recipe | None = None,
    mu: Volume | None = None,
    start: Volume | Reconstruction | None = None,
    watch: Watch | None = None,
    stages: Stages = lambda stage: None,
) -> Reconstruction:
    """Reconstruct the volume that the images of a run are of.

    Parameters
    ----------
    run : ProjectionRun
        Simulated or measured, with a recipe.
    recipe : Recipe
        Its tables `TABLES` say how; by default the run's own. What is modelled is what made the run, unless the settings of
        the reconstruction say otherwise: fewer points of the hole, no attenuation, no blur.
    mu : Volume
        What attenuates, instead of what the recipe says.
    start : Volume or Reconstruction
        Begin with this volume, on the same grid; a reconstruction by the same method goes on.
    watch : callable
        See `Watch`.
    stages
        Begins each stage: reading, voxelizing, reconstructing.

    Returns
    -------
    Reconstruction
        Its settings hold the recipe, too.

    Raises
    ------
    InputError
        The run holds no recipe, the method needs other images than it has, its attenuation cannot be made again, or memory
        does not suffice.

    Warns
    -----
    InputWarning
        The images were made from voxels that are not at least twice as fine as those of the reconstruction, or with no more
        points of the hole: model and data then share errors that a real scanner's data does not have.
    """
    recipe = recipe_of(run, recipe)
    method = METHODS[recipe["reconstruction.method"]]
    is_counts = recipe["model.kind"] == "emission"
    if method.of_counts and not is_counts:
        others = ", ".join(other.name for other in METHODS.values() if not other.of_counts)
        also = f"; for these images: {others}" if others else ""
        raise InputError(f"reconstruction.method: {method.name} needs a run of counts, not of line integrals{also}")
    grid = reconstruction_grid(run, recipe)
    require(16.0 * grid.n_voxels, "a reconstruction of {} x {} x {} voxels".format(*grid.shape))
    modelled = model_of(recipe)
    _warn_if_flattering(run, grid, modelled)
    if recipe["reconstruction.ignore_attenuation"]:
        mu = None
    A = projector_of_run(run, grid, mu, modelled, recipe["compute.backend"], recipe["compute.threads"], stages=stages)
    given: dict[str, Any] = {
        "subsets": recipe["reconstruction.subsets"],
        "background": recipe["reconstruction.background"],
    }
    arguments = {name: given[name] for name in method.takes}
    found = method.function(
        A,
        line_integrals(run, recipe),
        recipe["reconstruction.iterations"],
        start=start,
        callback=None if watch is None else lambda iteration, values: watch(iteration, values, []),
        progress=stages("reconstructing"),
        **arguments,
    )
    volume = found.volume if is_counts else Volume(found.volume.array, grid, run.volume.quantity)
    return replace(found, volume=volume, settings={**found.settings, "recipe": recipe.tables()})


def recipe_of(run: ProjectionRun, recipe: Recipe | None = None) -> Recipe:
    """The run's recipe, where `recipe` does not say how to reconstruct, in `TABLES`, otherwise."""
    if recipe is None:
        return run.recipe
    return run.recipe.updated({key: value for key, value in recipe.given.items() if key.partition(".")[0] in TABLES})


def reconstruction_grid(run: ProjectionRun, recipe: Recipe) -> Grid:
    """The voxels that a recipe asks for: by default a cube around the run's ROI, of 64 voxels along each side."""
    n_x, n_y, n_z = np.broadcast_to(recipe["reconstruction.voxels"], 3).tolist()
    spacing = recipe["reconstruction.spacing"] or 2 * float(run.system.roi_radius.max()) / np.array([n_x, n_y, n_z])
    return Grid.centered((n_x, n_y, n_z), np.broadcast_to(spacing, 3), recipe["reconstruction.center"])


def is_simulated(run: ProjectionRun) -> bool:
    """Whether the run's images were made from its volume, not measured."""
    return any(key.startswith(("volume.", "phantom.")) for key in run.recipe.given)


def model_of(recipe: Recipe) -> Recipe:
    """The recipe of the model that a reconstruction reckons with."""
    changes: dict[str, Any] = {}
    if recipe["reconstruction.aperture_points"] is not None:
        changes |= {"model.aperture_points": recipe["reconstruction.aperture_points"], "model.aperture_tolerance": None}
    if recipe["reconstruction.ignore_blur"]:
        changes["model.intrinsic_fwhm"] = None
    if recipe["reconstruction.ignore_attenuation"]:
        changes |= {key: None for key in recipe.given if key.startswith("attenuation.")}
    return recipe.updated(changes)


def line_integrals(run: ProjectionRun, recipe: Recipe) -> NDArray[np.float32]:
    """What a run's pixels say of its volume linearly: counts as they are, of photons that pass the line integrals.

    Where no photon has passed, half a photon is taken for it.
    """
    photons = recipe["model.photons"]
    if photons is None:
        return run.projections
    return np.asarray(np.log(photons / np.maximum(run.projections, 0.5)), np.float32)


def _warn_if_flattering(run: ProjectionRun, grid: Grid, model: Recipe) -> None:
    """Warn where a run was simulated with a model that is hardly better than that of the reconstruction."""
    if not is_simulated(run):
        return
    made = run.recipe
    fine, coarse = float(run.volume.grid.spacing.max()), float(grid.spacing.min())
    if 2 * fine > 1.001 * coarse:
        _warn(
            f"the run was made from voxels of {fine:.3g} mm: figures of a reconstruction in voxels of {coarse:.3g} mm "
            f"flatter, unless its voxels are {coarse / 2:.3g} mm or less"
        )
    points = "model.aperture_points"
    if made["model.aperture_tolerance"] is None and 1 < made[points] <= model[points]:
        _warn(
            f"the run was made with {made[points]} points of the hole, and the reconstruction reckons with {model[points]}: "
            "its figures flatter, unless the run has more points"
        )


def _warn(text: str) -> None:
    warnings.warn(text, InputWarning, stacklevel=4)
