"""From a run's images back to a volume: the job of ``mphdrr reconstruct`` and of Blender's Reconstruction panel."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from inspect import Parameter
from typing import Any

import numpy as np

from ..arrays import Array, Floats32
from ..errors import InputError, warn
from ..geometry.grid import Grid
from ..geometry.system import PinholeSystem
from ..memory import require
from ..models.photon_lines import Mu
from ..phantoms.derenzo import DerenzoRods
from ..physics.performance import resolution
from ..progress import Stages
from ..rays.backends import choose
from ..reconstruction.methods import METHODS, PRIORS, Choice, Method, method_of
from ..reconstruction.result import Reconstruction
from ..reconstruction.stopping import StoppingRule, StopWhen
from ..volumes.resampling import resample
from ..volumes.volume import Volume
from ..volumes.volume_files import read_volume
from ..xray.scan import SpectralScan
from .recipe import Recipe
from .run import ProjectionRun
from .run_recipe import projector_of_run, recipe_model, truth_of_run
from .settings import HOW_TABLES, SAMPLING, SETTINGS

Watch = Callable[[int, Array, Sequence[float]], bool | None]
"""Called as ``watch(iteration, values, objective)`` after each iteration, with the volume's values and the objective after
all iterations so far; what is true ends the reconstruction there."""

_FEWEST, _MOST = 64, 128
"""Voxels along a side of the ROI's cube, where nobody says how many."""
_POINTS = 7
"""Points of the hole: enough for its blur, and few enough for an iteration in a fraction of a second."""


def reconstruct_run(
    run: ProjectionRun,
    recipe: Recipe | None = None,
    mu: Mu | None = None,
    start: Volume | Reconstruction | None = None,
    watch: Watch | None = None,
    stages: Stages = lambda stage: None,
    method: Method | None = None,
) -> Reconstruction:
    """Reconstruct the volume that the images of a run are of.

    Parameters
    ----------
    run : ProjectionRun
        Simulated or measured.
    recipe : Recipe
        Its tables `HOW_TABLES` say how; by default the run's own. What is modelled is what made the run, unless the settings
        of the reconstruction say otherwise: another model of the hole, no attenuation, no blur. For a run without a recipe,
        as those of version 0.1.0, it needs the whole model, ``model.kind`` and all that this takes.
    mu : Volume, or a tuple of those of the isotope's lines
        What attenuates, instead of what the recipe says.
    start : Volume or Reconstruction
        Begin with this volume, on the same grid; a reconstruction by the same method goes on.
    watch : callable
        See `Watch`.
    stages
        Begins each stage: reading, voxelizing, reconstructing.
    method : Method
        The recipe's method, where it has been read from its file already.

    Returns
    -------
    Reconstruction
        Its settings hold the recipe, too.

    Raises
    ------
    InputError
        The run holds no recipe and none with a model is given, the method needs other images than it has, its attenuation
        cannot be made again, or memory does not suffice.

    Warns
    -----
    InputWarning
        The images were made from voxels that are not at least twice as fine as those of the reconstruction, or with no
        better model of the hole: model and data then share errors that a real scanner's data does not have. Or the whole
        hole cannot be modelled, and few rays take its place. Or the record of a run without a recipe contradicts the
        model that is given.
    """
    recipe = recipe_of(run, recipe)
    method = method or method_of(recipe["reconstruction.method"])
    if method.of_counts and recipe["model.kind"] != "emission":
        others = ", ".join(name for name, other in METHODS.items() if not other.of_counts)
        raise InputError(
            f"reconstruction.method: {recipe['reconstruction.method']} needs a run of counts, not of line integrals; for "
            f"these images: {others}"
        )
    grid = reconstruction_grid(run, recipe, method)
    require(22.0 * grid.n_voxels, "a reconstruction of {} x {} x {} voxels".format(*grid.shape))
    rules = _rules(recipe, grid)
    for name, value in (("start", start), ("stop", rules)):
        if value is not None and not method.takes(name):
            raise InputError(f"{name}: {method.label} has no {name}")
    given = _arguments(recipe, method, grid, stages)
    if "recipe" not in run.settings:
        _compare_with_record(run, recipe, mu is not None)
    modelled = model_of(run, recipe)
    flatters = flattering(run, grid, modelled)
    for text in flatters:
        warn(text, 2)
    if recipe["reconstruction.ignore_attenuation"]:
        mu = None
    A = projector_of_run(run, grid, mu, modelled, recipe["compute.backend"], recipe["compute.threads"], stages)
    stop = rules if watch is None else _Watched(watch, rules)
    asked = {"start": start, "stop": stop, "progress": stages("reconstructing")}
    given |= {name: value for name, value in asked.items() if method.takes(name)}
    found = method.function(A, line_integrals(run, recipe), **given)
    volume = found.volume
    if run.volume is not None:  # a radiograph's is not of activity
        volume = Volume(volume.array, grid, run.volume.quantity, volume.note)
    flatters = [*found.settings.get("flatters", ()), *flatters]
    return replace(found, volume=volume, settings={**found.settings, "recipe": recipe.tables(), "flatters": flatters})


class _Watched(StoppingRule):
    """The user's rules and a watcher: of all that a reconstruction calls, its rules alone are given the objective."""

    def __init__(self, watch: Watch, rules: StoppingRule | None) -> None:
        self._watch, self._rules = watch, rules

    def check(self, shape: tuple[int, ...]) -> None:
        if self._rules is not None:
            self._rules.check(shape)

    def reason(self, objective: Sequence[float], values: Array, seconds: float) -> str | None:
        if self._watch(len(objective), values, objective):
            return "watch"
        return None if self._rules is None else self._rules.reason(objective, values, seconds)


def _arguments(recipe: Recipe, method: Method, grid: Grid, stages: Stages) -> dict[str, Any]:
    """The method's own arguments, as a recipe gives them. Raises InputError where it takes no such one, or needs another."""
    prior = PRIORS.get(recipe["reconstruction.prior"])
    taken = {*method.own, *(() if prior is None else prior.own)}
    for name in (key.removeprefix("reconstruction.") for key in recipe.given):
        if name not in taken and any(name in choice.own for choice in (*METHODS.values(), *PRIORS.values())):
            raise InputError(f"{_option(name)}: {method.label} does not take it")
    given = _given(recipe, method)
    if prior is not None:
        own = _given(recipe, prior)
        if "anatomy" in own:
            own["anatomy"] = resample(read_volume(own["anatomy"], progress=stages("reading")), grid)
        given["prior"] = prior.function(**own)
    return given


def _given(recipe: Recipe, choice: Choice) -> dict[str, Any]:
    """The arguments of a method or prior that a recipe gives; all others have their own defaults."""
    values = {name: recipe.given.get(f"reconstruction.{name}") for name in choice.own}
    for name, value in values.items():
        if value is None and choice.own[name] is Parameter.empty:
            raise InputError(f"{_option(name)}: missing; {choice.label} needs it")
    if "photons" in values and values["photons"] is None:
        values["photons"] = recipe["model.photons"]
    return {name: value for name, value in values.items() if value is not None}


def _option(name: str) -> str:
    """A setting in messages."""
    key = f"reconstruction.{name}"
    return f"{key} ({SETTINGS[key].option})"


def _rules(recipe: Recipe, grid: Grid) -> StopWhen | None:
    given = {name: recipe[f"reconstruction.stop_{name}"] for name in ("change", "noise", "seconds")}
    if all(value is None for value in given.values()):
        return None
    region = None
    if recipe["reconstruction.stop_region"] is not None:
        *middle, radius = recipe["reconstruction.stop_region"]
        places = zip(grid.affine[:3, 3], grid.spacing, grid.shape, middle, strict=True)
        axes = np.ix_(*(origin + spacing * np.arange(n) - center for origin, spacing, n, center in places))
        region = sum(np.square(axis) for axis in axes) <= radius**2
    return StopWhen(**given, region=region)


def recipe_of(run: ProjectionRun, recipe: Recipe | None = None) -> Recipe:
    """The run's recipe, where `recipe` does not say how to reconstruct, in `HOW_TABLES`, otherwise.

    A run without one, as those of version 0.1.0, takes all of the model from `recipe`, which then names its kind.
    """
    if recipe is None:
        return run.recipe
    given = {key: value for key, value in recipe.given.items() if key.partition(".")[0] in HOW_TABLES}
    if run.is_measured and isinstance(given.get("model.start"), int | float):  # as in imports, of the first frame
        starts = np.asarray(run.recipe["model.start"])
        given["model.start"] = (given["model.start"] + starts - starts.min()).tolist()
    return Recipe(given) if "recipe" not in run.settings and "model.kind" in given else run.recipe.updated(given)


def _same(one: Any, other: Any) -> bool:
    """Whether two values of a model are the same, but for the last digits of another system's arithmetic."""
    numbers = isinstance(one, float) and isinstance(other, int | float)
    return bool(np.isclose(one, other, rtol=1e-9, atol=0)) if numbers else bool(one == other)


def _compare_with_record(run: ProjectionRun, recipe: Recipe, has_mu: bool) -> None:
    """Warn where the model of a recipe is not what a run without a recipe says of its own."""
    model, record = recipe_model(recipe, run.system), {"photons": None, "mu": None, **run.settings}
    if record.get("aperture_points") == 1:  # how version 0.1.0 says it
        record.setdefault("hole", "point")
    asked = {"model": model.name, "photons": recipe["model.photons"], **model.record()}
    if not has_mu and not any(key.startswith("attenuation.") for key in recipe.given):
        asked["mu"] = None
    names = [name for name in asked if name in record and f"model.{name}" not in SAMPLING]
    different = [f"{name} {record[name]}, not {asked[name]}" for name in names if not _same(asked[name], record[name])]
    if different:
        warn(f"the run's record says of its model: {'; '.join(different)} as in the model that is given", 3)


def reconstruction_grid(run: ProjectionRun, recipe: Recipe, method: Method | None = None) -> Grid:
    """The voxels that a recipe asks for: by default the method's, or a cube around the run's ROI, 64 to 128 along each side.

    As many that they are of half the smallest rod of the run's phantom at most, or, where it has none, of half the finest
    resolution at the isocentre.
    """
    is_given = any(f"reconstruction.{name}" in recipe.given for name in ("voxels", "spacing", "center"))
    if method is not None and method.grid is not None and not is_given:
        return method.grid
    side, spacing = 2 * run.system.region_radius(), recipe["reconstruction.spacing"]
    voxels = recipe["reconstruction.voxels"] or _FEWEST
    if "reconstruction.voxels" not in recipe.given and spacing is None:
        voxels = int(np.clip(np.ceil(2 * side / _detail(run)), _FEWEST, _MOST))
    n_x, n_y, n_z = np.broadcast_to(voxels, 3).tolist()
    spacing = spacing or side / np.array([n_x, n_y, n_z])
    return Grid.centered((n_x, n_y, n_z), np.broadcast_to(spacing, 3), recipe["reconstruction.center"])


def voxels_text(grid: Grid) -> str:
    """A grid's voxels in words: "64 x 64 x 64 voxels of 1.5 mm"."""
    sizes = list(dict.fromkeys(f"{size:.3g}" for size in grid.spacing))
    return f"{' x '.join(map(str, grid.shape))} voxels of {' x '.join(sizes)} mm"


def _detail(run: ProjectionRun) -> float:
    """What there is to be seen of the run's volume, mm: its smallest rod, else the resolution; infinite if unknown."""
    truth = None if run.volume is None else truth_of_run(run)[0]
    rods = [shape.rod_diameters for shape in getattr(truth, "shapes", ()) if isinstance(shape, DerenzoRods)]
    if rods and (found := [d for diameters in rods for d in diameters if d > 0]):
        return float(min(found))
    if not isinstance(run.system, PinholeSystem):
        return np.inf
    fwhm = resolution(run.system, np.zeros((1, 3)))
    return float(np.fmin.reduce(fwhm, axis=None, initial=np.inf))


def model_of(run: ProjectionRun, recipe: Recipe) -> Recipe:
    """The recipe of a reconstruction's model.

    The hole's blur in it is, unless `recipe` says which, that of the whole hole, where the run's counts have it; else that
    of rays through as many points as the run has, but 7 at most.
    """
    if recipe["model.kind"] != "emission":
        return recipe
    hole, points = recipe["reconstruction.hole"], recipe["reconstruction.aperture_points"]
    made = None if run.is_measured else 1 if recipe["model.hole"] == "point" else recipe["model.aperture_points"]
    is_whole = made is None or made >= _POINTS
    if hole == "auto":
        is_free = points is None and recipe["reconstruction.pixel_points"] == 1
        hole = "auto" if is_free and is_whole and _by_depth(recipe) else "rays"
    if hole == "rays" and points is None:
        points = _POINTS if is_whole else made
    changes: dict[str, Any] = dict.fromkeys(SAMPLING) | {"model.hole": hole, "model.aperture_points": points}
    if hole == "rays":
        # The tolerance is for images of single voxels; neighbours make up for each other's errors.
        changes |= {"model.pixel_points": recipe["reconstruction.pixel_points"], "model.tolerance": 1e9}
    if recipe["reconstruction.ignore_blur"]:
        changes["model.intrinsic_fwhm"] = None
    if recipe["reconstruction.ignore_attenuation"]:
        changes |= {key: None for key in recipe.given if key.startswith("attenuation.")}
    return recipe.updated(changes)


def _by_depth(recipe: Recipe) -> bool:
    """Whether the whole hole's blur is possible without rays, and fast; a warning says why not."""
    backend = choose(recipe["compute.backend"]).name
    is_slow = backend in ("cuda", "numpy")  # the one refuses it, the other takes minutes for an iteration
    if is_slow:
        why = f"the backend is {backend}"
        warn(f"the hole's blur is that of rays through {_POINTS} points, not of the whole hole by depth: {why}", 4)
    return not is_slow


def line_integrals(run: ProjectionRun, recipe: Recipe) -> Floats32:
    """What a run's pixels say of its volume linearly: counts as they are, of photons that pass the line integrals, of X rays
    those of the mu of `SpectralScan.line_integrals`.

    Where no photon has passed, half a photon is taken for it.
    """
    photons = recipe["model.photons"]
    if recipe["model.kind"] == "spectral":
        model = recipe_model(recipe, run.system)
        assert isinstance(model, SpectralScan)
        return model.line_integrals(run.projections, run.views, not recipe["reconstruction.ignore_beam_hardening"])
    if photons is None:
        return run.projections
    return np.asarray(np.log(photons / np.maximum(run.projections, 0.5)), np.float32)


def flattering(run: ProjectionRun, grid: Grid, model: Recipe | None = None) -> list[str]:
    """Why figures of a reconstruction on a grid flatter: the run was simulated with hardly better voxels, or hardly a better
    model of the hole.

    `model` is that of the reconstruction; without it, it is taken to be the run's own.
    """
    if run.volume is None:  # measured
        return []
    reasons, made = [], run.recipe if "recipe" in run.settings else Recipe()
    fine, coarse = float(run.volume.grid.spacing.max()), float(grid.spacing.min())
    if 2 * fine > 1.001 * coarse:
        reasons.append(
            f"the run was made from voxels of {fine:.3g} mm: figures of a reconstruction in voxels of {coarse:.3g} mm "
            f"flatter, unless its voxels are {coarse / 2:.3g} mm or less"
        )
    points, modelled = made["model.aperture_points"], (model or made)["model.aperture_points"]
    if None not in (points, modelled) and 1 < points <= modelled:
        reasons.append(
            f"the run was made with {points} points of the hole: figures of a reconstruction whose model has as many "
            "flatter, unless the run has more points"
        )
    return reasons
