"""Reconstruction of a run's volume by a recipe, for ``mphdrr reconstruct`` and Blender's Reconstruction panel."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from inspect import Parameter
from typing import Any

import numpy as np

from ..arrays import Array, Floats32
from ..errors import InputError, warn
from ..geometry.grid import Grid
from ..geometry.system import PinholeSystem
from ..geometry.views import Views
from ..memory import require
from ..models.emission_warnings import map_warnings
from ..models.photon_lines import Mu
from ..phantoms.derenzo import DerenzoRods
from ..phantoms.settings import setting_names
from ..physics.performance import resolution
from ..progress import Stages
from ..rays.backends import choose
from ..reconstruction.arguments import Choice
from ..reconstruction.methods import METHODS, Method, method_of
from ..reconstruction.priors import PRIORS
from ..reconstruction.result import Reconstruction
from ..reconstruction.stopping import StoppingRule, StopWhen
from ..volumes.resampling import resample
from ..volumes.volume import Volume
from ..volumes.volume_files import read_volume
from .model_kinds import model_class
from .recipe import Recipe
from .run import ProjectionRun
from .run_recipe import projector_of_run, recipe_model, run_truth
from .settings import HOW_TABLES, SAMPLING, SETTINGS

Watch = Callable[[int, Array, Sequence[float]], bool | None]
"""Function that is called as ``watch(iteration, values, objective)`` after each iteration.

It gets the volume's values, and the objective after each iteration so far; if it returns True, the reconstruction ends.
"""

_FEWEST, _MOST = 64, 128
"""Smallest and largest default number of voxels along a side of the ROI's cube."""
_OUTSIDE_MAPS = 0.1
"""Share of a reconstruction outside the map of mu above which it is warned of: noise in the air is less."""
_POINTS = 7
"""Points of the hole that model its blur, few enough for an iteration in a fraction of a second."""


def reconstruct_run(
    run: ProjectionRun,
    recipe: Recipe | None = None,
    mu: Mu | None = None,
    start: Volume | Reconstruction | None = None,
    watch: Watch | None = None,
    stages: Stages = lambda stage: None,
    method: Method | None = None,
) -> Reconstruction:
    """Reconstruct the volume of a run from its images.

    Parameters
    ----------
    run : ProjectionRun
        Simulated or measured run.
    recipe : Recipe
        Recipe whose tables `HOW_TABLES` describe the reconstruction; by default the run's own. The model is that of the
        run, unless settings of the reconstruction change it: another model of the hole, no attenuation, no blur. For a run
        without a recipe, as those of version 0.1.0, the whole model is needed: ``model.kind`` and its settings.
    mu : Volume, or a tuple of volumes for the isotope's lines
        Attenuation in place of the recipe's.
    start : Volume or Reconstruction
        Volume to begin with, on the same grid, or reconstruction by the same method to go on with.
    watch : callable
        See `Watch`.
    stages
        Function that begins the stages "reading", "voxelizing" and "reconstructing".
    method : Method
        Method of the recipe, if it has been read from its file already.

    Returns
    -------
    Reconstruction
        Reconstruction whose settings hold the recipe, too.

    Raises
    ------
    InputError
        The run holds no recipe and none with a model is given, the method needs other images, the attenuation cannot be
        made again, or there is not enough memory.

    Warns
    -----
    InputWarning
        The run was simulated with voxels that are not half as large as those of the reconstruction, or with no better model
        of the hole: model and data then share errors that real data do not have (inverse crime). The whole hole cannot be
        modelled, and few rays replace it. The record of a run without a recipe contradicts the given model. The run's
        simulated scatter is not corrected.
    """
    recipe = reconstruction_recipe(run, recipe)
    method = method or method_of(recipe["reconstruction.method"])
    if method.of_counts and recipe["model.kind"] != "emission":
        names = ", ".join(name for name, choice in METHODS.items() if not choice.of_counts)
        need = f"{recipe['reconstruction.method']} needs a run of counts, not of line integrals"
        raise InputError(f"reconstruction.method: {need}; for these images: {names}")
    grid = reconstruction_grid(run, recipe, method)
    require(22.0 * grid.n_voxels, "a reconstruction of {} x {} x {} voxels".format(*grid.shape))
    rule = _stopping_rule(recipe, grid)
    for name, value in (("start", start), ("stop", rule)):
        if value is not None and not method.takes(name):
            raise InputError(f"{name}: {method.label} has no {name}")
    arguments = _method_arguments(recipe, method, grid, stages)
    if "recipe" not in run.settings:
        _compare_with_record(run, recipe, mu is not None)
    model = reconstruction_model(run, recipe)
    flatters = inverse_crime_notes(run, grid, model)
    for text in flatters:
        warn(text, 2)
    has_scatter = "recipe" in run.settings and run.recipe["scatter.model"] != "none"
    if has_scatter and recipe["reconstruction.scatter"] == "none":
        share = "some"  # an event does not hold it apart
        if run.scatter is not None:
            share = f"{run.scatter.sum(dtype=float) / max(run.projections.sum(dtype=float), 1e-30):.0%}"
        warn(f"{share} of the counts are scatter that nothing corrects; reconstruction.scatter = body estimates it", 2)
    if recipe["reconstruction.ignore_attenuation"]:
        mu = None
    A = projector_of_run(run, grid, mu, model, recipe["compute.backend"], recipe["compute.threads"], stages)
    stop = rule if watch is None else _WatchedRule(watch, rule)
    common = {"start": start, "stop": stop, "progress": stages("reconstructing")}
    arguments |= {name: value for name, value in common.items() if method.takes(name)}
    result = method.function(A, line_integrals(run, recipe), **arguments)
    volume = result.volume
    for text in map_warnings(volume, A.model, _OUTSIDE_MAPS):
        warn(text, 2)
    if run.volume is not None:  # the quantity of a radiograph's volume is not activity
        volume = Volume(volume.array, grid, run.volume.quantity, volume.note)
    flatters = [*result.settings.get("flatters", ()), *flatters]
    return replace(result, volume=volume, settings={**result.settings, "recipe": recipe.tables(), "flatters": flatters})


class _WatchedRule(StoppingRule):
    """Stopping rule that first calls a watcher, because a reconstruction passes the objective to its rule only."""

    def __init__(self, watch: Watch, rules: StoppingRule | None) -> None:
        self._watch, self._rules = watch, rules

    def check(self, shape: tuple[int, ...]) -> None:
        """Raise `InputError` unless the user's rule fits a volume of this shape."""
        if self._rules is not None:
            self._rules.check(shape)

    def reason(self, objective: Sequence[float], values: Array, seconds: float) -> str | None:
        """Return "watch" if the watcher ends the reconstruction, else the reason of the user's rule."""
        if self._watch(len(objective), values, objective):
            return "watch"
        return None if self._rules is None else self._rules.reason(objective, values, seconds)


def _method_arguments(recipe: Recipe, method: Method, grid: Grid, stages: Stages) -> dict[str, Any]:
    """Return the arguments of a method in a recipe; raise `InputError` for one missing or unknown."""
    prior = PRIORS.get(recipe["reconstruction.prior"])
    names = {*method.own, *(() if prior is None else prior.own)}
    for name in (key.removeprefix("reconstruction.") for key in recipe.given):
        if name not in names and any(name in choice.own for choice in (*METHODS.values(), *PRIORS.values())):
            raise InputError(f"{_setting_text(name)}: {method.label} does not take it")
    arguments = _recipe_arguments(recipe, method)
    if prior is not None:
        options = _recipe_arguments(recipe, prior)
        if "anatomy" in options:
            options["anatomy"] = resample(read_volume(options["anatomy"], progress=stages("reading")), grid)
        arguments["prior"] = prior.function(**options)
    return arguments


def _recipe_arguments(recipe: Recipe, choice: Choice) -> dict[str, Any]:
    """Return a method's or prior's arguments in a recipe; raise `InputError` if one without a default is missing."""
    values = {name: recipe.given.get(f"reconstruction.{name}") for name in choice.own}
    for name, value in values.items():
        if value is None and choice.own[name] is Parameter.empty:
            raise InputError(f"{_setting_text(name)}: missing; {choice.label} needs it")
    if "photons" in values and values["photons"] is None:
        values["photons"] = recipe["model.photons"]
    return {name: value for name, value in values.items() if value is not None}


def _setting_text(name: str) -> str:
    """Return key and option of the setting of an argument, for messages."""
    key = f"reconstruction.{name}"
    return f"{key} ({SETTINGS[key].option})"


def _stopping_rule(recipe: Recipe, grid: Grid) -> StopWhen | None:
    """Return the stopping rule of a recipe; None if it has none."""
    limits = {name: recipe[f"reconstruction.stop_{name}"] for name in ("change", "noise", "seconds")}
    if all(value is None for value in limits.values()):
        return None
    region = None
    if recipe["reconstruction.stop_region"] is not None:
        *center, radius = recipe["reconstruction.stop_region"]
        grid_axes = zip(grid.affine[:3, 3], grid.spacing, grid.shape, center, strict=True)
        axes = np.ix_(*(origin + spacing * np.arange(n) - center for origin, spacing, n, center in grid_axes))
        region = sum(np.square(axis) for axis in axes) <= radius**2
    return StopWhen(**limits, region=region)


def reconstruction_recipe(run: ProjectionRun, recipe: Recipe | None = None) -> Recipe:
    """Return the run's recipe, with the values of `recipe` in the tables `HOW_TABLES`.

    For a run without a recipe, as those of version 0.1.0, the values of `recipe` are the whole model.
    """
    if recipe is None:
        return run.recipe
    values = {key: value for key, value in recipe.given.items() if key.partition(".")[0] in HOW_TABLES}
    if run.is_measured and isinstance(values.get("model.start"), int | float):  # that of the first frame, as in imports
        starts = np.asarray(run.recipe["model.start"])
        values["model.start"] = (values["model.start"] + starts - starts.min()).tolist()
    return Recipe(values) if "recipe" not in run.settings and "model.kind" in values else run.recipe.updated(values)


def _is_close(value: Any, reference: Any) -> bool:
    """Return whether two values of a model are equal, or numbers that differ by rounding on another system only."""
    numbers = isinstance(value, float) and isinstance(reference, int | float)
    return bool(np.isclose(value, reference, rtol=1e-9, atol=0)) if numbers else bool(value == reference)


def _compare_with_record(run: ProjectionRun, recipe: Recipe, has_mu: bool) -> None:
    """Warn of differences between the model of a recipe and the record of a run that has no recipe."""
    model, record = recipe_model(recipe, run.system), {"photons": None, "mu": None, **run.settings}
    if record.get("aperture_points") == 1:  # the record of a point in version 0.1.0
        record.setdefault("hole", "point")
    expected = {"model": model.name, "photons": recipe["model.photons"], **model.record()}
    if not has_mu and not any(key.startswith("attenuation.") for key in recipe.given):
        expected["mu"] = None
    names = [name for name in expected if name in record and f"model.{name}" not in SAMPLING]
    pairs = ((name, record[name], expected[name]) for name in names)
    if differences := [f"{name} {old}, not {new}" for name, old, new in pairs if not _is_close(new, old)]:
        warn(f"the run's record says of its model: {'; '.join(differences)} as in the model that is given", 3)


def reconstruction_grid(run: ProjectionRun, recipe: Recipe, method: Method | None = None) -> Grid:
    """Return the grid of a recipe's reconstruction: by default the method's, or a cube around the run's ROI.

    The cube has 64 to 128 voxels along each side, so that a voxel is at most half of the smallest rod of the run's phantom,
    or half of the finest resolution at the isocentre if there are no rods; but no voxel is finer than half a pixel there.
    """
    is_given = any(f"reconstruction.{name}" in recipe.given for name in ("voxels", "spacing", "center"))
    if method is not None and method.grid is not None and not is_given:
        return method.grid
    side, spacing = 2 * run.system.region_radius(), recipe["reconstruction.spacing"]
    voxels = recipe["reconstruction.voxels"] or _FEWEST
    if "reconstruction.voxels" not in recipe.given and spacing is None:
        for_detail = np.clip(np.ceil(2 * side / _smallest_detail(run)), _FEWEST, _MOST)
        voxels = max(1, int(min(for_detail, 2 * side // _pixel_at_isocentre(run.views))))
    n_x, n_y, n_z = np.broadcast_to(voxels, 3).tolist()
    spacing = spacing or side / np.array([n_x, n_y, n_z])
    return Grid.centered((n_x, n_y, n_z), np.broadcast_to(spacing, 3), recipe["reconstruction.center"])


def voxels_text(grid: Grid) -> str:
    """Return a grid's voxels in words: "64 x 64 x 64 voxels of 1.5 mm"."""
    sizes = list(dict.fromkeys(f"{size:.3g}" for size in grid.spacing))
    return f"{' x '.join(map(str, grid.shape))} voxels of {' x '.join(sizes)} mm"


def _pixel_at_isocentre(views: Views) -> float:
    """Return the smallest side of a pixel, as it is seen at the isocentre, mm."""
    steps = np.linalg.norm([views.u_steps, views.v_steps], axis=2)
    return float((steps * np.abs(views.projection_matrices()[:, 2, 3])).min())


def _smallest_detail(run: ProjectionRun) -> float:
    """Return the smallest detail of the run's volume, mm: the smallest rod, else the resolution; infinite if unknown."""
    truth = None if run.volume is None else run_truth(run)[0]
    rods = [shape.rod_diameters for shape in getattr(truth, "shapes", ()) if isinstance(shape, DerenzoRods)]
    if rods and (diameters := [d for diameters in rods for d in diameters if d > 0]):
        return float(min(diameters))
    if not isinstance(run.system, PinholeSystem):
        return np.inf
    return float(np.fmin.reduce(resolution(run.system, np.zeros((1, 3))), axis=None, initial=np.inf))


def reconstruction_model(run: ProjectionRun, recipe: Recipe) -> Recipe:
    """Return the recipe of the model that a reconstruction of the run uses.

    Unless `recipe` chooses otherwise, the model has the blur of the whole hole if the run's counts have it, else rays
    through as many points of the hole as the run's, at most 7.
    """
    model = model_class(recipe["model.kind"], run.system)
    if not model.has_times:
        return recipe
    changes = _hole_sampling(run, recipe) if "aperture_points" in setting_names(model) else {}
    if recipe["reconstruction.ignore_blur"]:
        changes["model.intrinsic_fwhm"] = None
    if recipe["reconstruction.ignore_attenuation"]:
        changes |= {key: None for key in recipe.given if key.startswith("attenuation.")}
    return recipe.updated(changes)


def _hole_sampling(run: ProjectionRun, recipe: Recipe) -> dict[str, Any]:
    """Return the settings of the hole's blur in the reconstruction of a run, for `Recipe.updated`."""
    hole, points = recipe["reconstruction.hole"], recipe["reconstruction.aperture_points"]
    run_points = None if run.is_measured else 1 if recipe["model.hole"] == "point" else recipe["model.aperture_points"]
    is_whole = run_points is None or run_points >= _POINTS
    if hole == "auto":
        is_free = points is None and recipe["reconstruction.pixel_points"] == 1
        hole = "auto" if is_free and is_whole and _is_fast_by_depth(recipe) else "rays"
    if hole == "rays" and points is None:
        points = _POINTS if is_whole else run_points
    changes: dict[str, Any] = dict.fromkeys(SAMPLING) | {"model.hole": hole, "model.aperture_points": points}
    if hole == "rays":
        # The tolerance is that of single voxels' images; in a volume, errors of neighbours cancel.
        changes |= {"model.pixel_points": recipe["reconstruction.pixel_points"], "model.tolerance": 1e9}
    return changes


def _is_fast_by_depth(recipe: Recipe) -> bool:
    """Return whether the backend models the whole hole without rays, and quickly; warn if it does not."""
    backend = choose(recipe["compute.backend"]).name
    is_slow = backend in ("cuda", "numpy")  # cuda cannot do it, numpy takes minutes for an iteration
    if is_slow:
        why = f"the backend is {backend}"
        warn(f"the hole's blur is that of rays through {_POINTS} points, not of the whole hole by depth: {why}", 4)
    return not is_slow


def line_integrals(run: ProjectionRun, recipe: Recipe) -> Floats32:
    """Return the images of a run as numbers that are linear in its volume, (M, n_v, n_u).

    These are counts of activity as they are, line integrals of the photons that pass, and the result of
    `SpectralScan.line_integrals` for X rays. A pixel without photons counts as one with half a photon.
    """
    photons = recipe["model.photons"]
    if recipe["model.kind"] == "spectral":
        model: Any = recipe_model(recipe, run.system)
        return model.line_integrals(run.projections, run.views, not recipe["reconstruction.ignore_beam_hardening"])
    if photons is None:
        return run.projections
    return np.asarray(np.log(photons / np.maximum(run.projections, 0.5)), np.float32)


def inverse_crime_notes(run: ProjectionRun, grid: Grid, model: Recipe | None = None) -> list[str]:
    """Return notes on inverse crime, which makes scores of a reconstruction on a grid too good.

    There is one if the run was simulated with voxels that are hardly finer, or with a hardly better model of the hole, than
    those of the reconstruction. `model` is the recipe of the reconstruction's model; by default the run's own.
    """
    if run.volume is None:  # measured
        return []
    notes, recipe = [], run.recipe if "recipe" in run.settings else Recipe()
    fine, coarse = float(run.volume.grid.spacing.max()), float(grid.spacing.min())
    if 2 * fine > 1.001 * coarse:
        notes.append(
            f"scores look better than they are: the phantom's voxels ({fine:.3g} mm) should be {coarse / 2:.3g} mm or less"
        )
    points, modelled = (r["model.aperture_points"] for r in (recipe, model or recipe))
    if None not in (points, modelled) and 1 < points <= modelled:
        notes.append(
            f"scores look better than they are: the run has {points} points of the hole, and should have more than the "
            f"reconstruction's {modelled}"
        )
    return notes
