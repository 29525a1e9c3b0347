"""Projection runs of a recipe, for the command line, scripts and Blender, and the parts that a recipe describes.

`run_recipe` makes the runs; `recipe_system`, `recipe_views`, `recipe_model` and `recipe_phantom` return the parts;
`projector_of_run` returns the projector of a finished run.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Floats
from ..errors import InputError
from ..geometry.frames import euler_pose
from ..geometry.grid import Grid
from ..geometry.scanner import Scanner
from ..geometry.system import chosen_modules
from ..geometry.views import Views
from ..models.model import with_image_axes
from ..models.photon_lines import Mu, mu_from_volumes, mu_volumes, require_one_per_line
from ..phantoms.kinds import KINDS
from ..phantoms.language import parse_phantom, read_phantom
from ..phantoms.phantom import Phantom
from ..phantoms.settings import setting_names
from ..physics.ct_numbers import hu_to_mu
from ..physics.isotopes import photon_energy
from ..physics.noise import NOISE_MODELS
from ..progress import Progress, StagedProgress, Stages
from ..projector import Model, Projector
from ..volumes.rearranging import centered
from ..volumes.volume import Volume
from ..volumes.volume_files import read_volume, read_volume_of
from ..workbook import read_scanner
from ..xray.detectors import checked_bins
from .counting import recipe_dead_time, recipe_efficiency, recorded_shares, scale_by_module
from .measured import recipe_counts
from .model_kinds import model_class
from .projecting import LINES, BodyScatter, Imaging, project_run, warn_of_energy
from .recipe import Recipe, recorded_recipe
from .run import ProjectionRun
from .settings import SETTINGS

_MODULES, _EFFICIENCY = "system.modules", "model.efficiency"
_OUTSIDE_MODEL = {"kind", "photons", "dead_time", "dead_time_kind", "opening_angle_degrees", "efficiency"}
"""Names of settings of [model] that are no arguments of the models' classes."""
_MU_ADVICE = "; of mu, give the energy at which it holds (--energy)"
_MOST_MU = 500.0
"""Attenuation coefficient, 1/mm, above that of all materials of the tables for photons of 10 keV or more."""

_Source = tuple[Volume, Mu | None, Recipe]
"""Volume to project, its attenuation, and the recipe to record."""


def run_recipe(
    recipe: Recipe,
    system: Scanner | None = None,
    volume: Volume | None = None,
    mu: Mu | None = None,
    stages: Stages = lambda stage: None,
) -> Iterator[ProjectionRun]:
    """Yield the runs of a recipe: one run, one for each of ``volume.states`` and frames, or the run of measured counts.

    Parameters
    ----------
    recipe
        Recipe of the runs.
    system, volume, mu
        Scanner, from which the recipe chooses modules, volume and attenuation in place of those that the recipe names. `mu`
        may be a tuple with one volume for each of the isotope's lines.
    stages
        Function that begins the stages "reading", "voxelizing" and "projecting".

    Raises
    ------
    InputError
        A file cannot be read, the recipe names no system, or `project_run` refuses its arguments. The recipe and all files
        but the volumes are checked before the first run.
    """
    system = recipe_system(recipe) if system is None else chosen_modules(system, recipe["system.modules"], _MODULES)
    recipe = with_scanner_pixels(recipe, system)
    model = recipe_model(recipe, system)
    if mu is None:
        mu = _recipe_attenuation(recipe, model, stages)
    if recipe["counts.files"] is not None and volume is None:
        yield recipe_counts(recipe, system, stages)
        return
    recorded = recorded_recipe(recipe)
    sources: Iterator[_Source]
    if volume is not None:
        if mu is None and recipe["attenuation.of_phantom"]:
            raise InputError("attenuation.of_phantom: a volume that is given needs its mu as well")
        sources = iter([(_in_model_quantity(volume, model, recipe["volume.energy"]), mu, recorded)])
    elif recipe["volume.file"] is not None or recipe["volume.states"] is not None:
        sources = _from_files(recipe, recorded, model, mu, stages)
    else:
        sources = _from_phantom(recipe, recorded, model, mu, stages)
    frames = recipe_frames(recipe)
    energy = recipe["volume.energy"] or recipe["attenuation.energy"]
    converted = {}
    if energy not in (None, LINES) and not model.takes_ct_numbers:
        converted["ct_converted_at_kev"] = photon_energy(energy)
    for number, ((source, mu_of_it, record), times) in enumerate(_in_frames(sources, frames)):
        record, seed = record.updated(times), recipe["noise.seed"]
        if seed is not None:  # each run has its own noise
            record = record.updated({"noise.seed": seed + number})
        if (scatter := recipe_scatter(recipe)) is not None and number:  # and its own scatter
            scatter = replace(scatter, seed=scatter.seed + number)
            record = record.updated({"scatter.seed": scatter.seed})
        yield project_run(
            system, source, **_view_arguments(recipe), backend=recipe["compute.backend"], threads=recipe["compute.threads"],
            settings={"volume": _volume_name(record), **converted, "recipe": record.tables()},
            model=recipe_model(recipe.updated(times), system, mu_of_it), photons=recipe["model.photons"],
            noise_seed=record["noise.seed"], dead_time=recipe_dead_time(recipe), scatter=scatter,
            noise=recipe.choice("noise.model", NOISE_MODELS), progress=StagedProgress(stages, "projecting"),
        )  # fmt: skip


def recipe_frames(recipe: Recipe) -> list[dict[str, Any]]:
    """Return the changes of the recipe for each of its runs: the times of the frame or the energy bin, if it has any.

    Raises `InputError` if the numbers of times, starts and states differ.
    """
    times, starts, states = recipe["frames.times"], recipe["frames.starts"], recipe["volume.states"] or ()
    if (bins := recipe["frames.bins"]) is not None:
        if len(bins) % 2:
            raise InputError(f"frames.bins: expected pairs of energies, from and to, got {len(bins)} numbers")
        pairs = checked_bins(np.reshape(bins, (-1, 2)).tolist()).tolist()
        return [{"frames.bins": None, "model.window": pair} for pair in pairs]
    if times is None:
        return [{}] * max(1, len(states))
    if starts is None:
        if np.ndim(recipe["model.start"]):
            raise InputError("frames.starts: needed where model.start has a number for each module")
        starts = recipe["model.start"] + np.cumsum([0, *times[:-1]])
    for name, values in (("frames.starts", starts), ("volume.states", states)):
        if len(values) not in (len(times), *([0, 1] if name == "volume.states" else [])):
            raise InputError(f"{name}: expected {len(times)}, as many as frames.times, got {len(values)}")
    without_frames = {"frames.times": None, "frames.starts": None}
    return [{"model.time": t, "model.start": float(s), **without_frames} for t, s in zip(times, starts, strict=True)]


def _in_frames(sources: Iterator[_Source], frames: list[dict[str, Any]]) -> Iterator[tuple[_Source, dict[str, Any]]]:
    """Yield the source of each frame, with the frame's changes of the recipe; a single source is that of all frames."""
    source = next(sources)
    for frame in frames:
        yield source, frame
        source = next(sources, source)


def recipe_system(recipe: Recipe, path: Callable[[str], str | Path] = Path) -> Scanner:
    """Return the scanner that a recipe names, with the chosen modules; `path` returns the path of a file in the recipe."""
    file, columns = recipe["system.file"], recipe["system.columns"]
    if file is None:
        raise InputError("system.file: missing; name the geometry workbook")
    system = read_scanner(path(file), recipe["system.kind"], None if columns is None else path(columns))
    return chosen_modules(system, recipe["system.modules"], _MODULES)


def recipe_views(recipe: Recipe, system: Scanner) -> Views:
    """Return the views of a recipe's detector."""
    return system.views(**_view_arguments(with_scanner_pixels(recipe, system)))


def with_scanner_pixels(recipe: Recipe, system: Scanner) -> Recipe:
    """Return the recipe with the number of pixels of a scanner that has its own, unless the recipe gives another number."""
    keys = "detector.rows", "detector.columns"
    pixels = None if any(name in recipe.given for name in keys) else system.pixels
    return recipe if pixels is None else recipe.updated(dict(zip(keys, pixels, strict=True)))


def _view_arguments(recipe: Recipe) -> dict[str, Any]:
    """Return the arguments of `PinholeSystem.views` in a recipe."""
    arguments = {name: recipe[f"detector.{name}"] for name in ("magnification", "pitch")}
    shape = recipe["detector.rows"], recipe["detector.columns"]
    return {"shape": shape, "detector": recipe["detector.plane"], **arguments}


def recipe_model(recipe: Recipe, system: Scanner, mu: Mu | None = None, run: ProjectionRun | None = None) -> Model:
    """Return the model of a recipe, with `mu` as attenuation; raise `InputError` if its settings do not fit together.

    The model of a `run` has the run's efficiency, if that is the recipe's, and the fractions of photons that its dead time
    left as factors of efficiency and background: the counts then have Poisson noise around the model's expected counts.
    """
    cls: Any = model_class(recipe["model.kind"], system)
    names = set(setting_names(cls))
    arguments = recipe.fields("model", cls)
    if arguments.get("pixel_points") == "auto":
        arguments["pixel_points"] = None
    if cls.has_times:
        _require_known_settings(recipe, names, system)
        if "model.opening_angle_degrees" in recipe.given:
            arguments["opening_angle"] = math.radians(recipe["model.opening_angle_degrees"])
        if mu is not None:
            arguments["mu"] = mu
        if run is not None and "recipe" in run.settings and run.recipe[_EFFICIENCY] == recipe[_EFFICIENCY]:
            arguments["efficiency"] = run.efficiency
        else:
            arguments["efficiency"] = recipe_efficiency(recipe)
        if run is not None and recipe["model.dead_time"]:
            shares = recorded_shares(recipe, run.projections, run.settings)
            for name in ("background", "efficiency"):
                arguments[name] = scale_by_module(arguments.get(name, 0.0), shares)
    if "system" in names:
        arguments["system"] = system
    model: Model = cls(**arguments)
    if model.has_times and len(files := recipe["attenuation.file"] or ()) > 1:
        require_one_per_line(len(files), model.photon_lines, "attenuation.file", "file")
        if recipe["attenuation.energy"] is not None:
            raise InputError("attenuation.energy: it is for one file of CT numbers; a file for each line holds mu")
    return model


def _require_known_settings(recipe: Recipe, names: set[str], system: Scanner) -> None:
    """Raise `InputError` for a setting that the model of counts of a scanner, with arguments `names`, does not have."""
    for key, value in recipe.given.items():
        table, _, name = key.partition(".")
        if table == "model" and name not in names | _OUTSIDE_MODEL and value != SETTINGS[key].default:
            raise InputError(f"{key}: is no setting of the counts of a scanner of the kind {system.kind}")


def projector_of_run(
    run: ProjectionRun,
    grid: Grid,
    mu: Mu | None = None,
    recipe: Recipe | None = None,
    backend: str = "auto",
    threads: int | None = None,
    stages: Stages = lambda stage: None,
) -> Projector:
    """Return the projector from volumes on `grid` to the images of a run, with the model of the run's recipe.

    Parameters
    ----------
    run
        Simulated or measured run.
    grid
        Voxels of the volumes.
    mu
        Attenuation coefficients, 1/mm, on any grid, or a tuple of those of the isotope's lines. By default the recipe's:
        its files are read again, or its phantom is voxelized on `grid`.
    recipe
        Recipe of the model, such as ``run.recipe.updated({"model.aperture_points": 19})``; by default the run's own.
    backend, threads
        See `Projector`.
    stages
        Function that begins the stages "reading" and "voxelizing".

    Raises
    ------
    InputError
        The run holds no recipe and none is given, or its attenuation cannot be made again.
    """
    recipe = run.recipe if recipe is None else recipe
    if mu is None and recipe["model.kind"] == "emission":
        model: Any = recipe_model(recipe, run.system, run=run)
        if recipe["attenuation.of_phantom"]:
            mu = _mu_of_phantom(recipe_phantom(recipe), phantom_pose(recipe), grid, model, stages)
        elif recipe["volume.center"] and recipe["attenuation.file"] is not None:
            moved = "it was moved with the volume (volume.center)"
            raise InputError(f"attenuation.file: {moved}; give mu where it was then")
        else:
            mu = _recipe_attenuation(recipe, model, stages)
    model = recipe_model(recipe, run.system, mu, run).linear()
    if model.has_times and np.ndim(run.background) == 3:  # such as scatter, which is in no recipe
        own_background = recipe_model(run.recipe, run.system, run=run).background if "recipe" in run.settings else 0.0
        excess = np.maximum(run.background - with_image_axes(own_background), 0)
        model = replace(model, background=with_image_axes(model.background) + excess)
    return Projector(grid, run.views, model, backend, threads)


def recipe_imaging(
    recipe: Recipe, system: Scanner, views: Views, grid: Grid, mu: Mu | None, *, threads: int | None
) -> Imaging:
    """Return the simulator of a recipe's images of volumes on a grid, with `mu` as attenuation."""
    projector = Projector(grid, views, recipe_model(recipe, system, mu), threads=threads)
    return Imaging(projector, recipe["model.photons"], recipe_dead_time(recipe), recipe_scatter(recipe))


def recipe_scatter(recipe: Recipe) -> BodyScatter | None:
    """Return the simulation of scatter that a recipe names; raise `InputError` if the recipe lacks what it takes."""
    if recipe["scatter.model"] == "none":
        return None
    if missing := [key for key in ("model.isotope", "model.energy_fwhm") if recipe[key] is None]:
        raise InputError(f"scatter.model: body needs {' and '.join(missing)}: photons are counted by their energy")
    return BodyScatter(recipe["scatter.precision"], recipe["scatter.seed"])


def _volume_name(record: Recipe) -> str:
    """Return the name of a run's volume for its record; an empty text if the recipe names none."""
    names = [record[key] for key in ("volume.object", "volume.file", "phantom.file")]
    for name in filter(None, (*names, *(record["volume.states"] or ()))):
        return Path(name).name
    return f"{record['phantom.kind'].capitalize()} phantom" if "phantom.kind" in record.given else ""


def _recipe_attenuation(recipe: Recipe, model: Model, stages: Stages) -> Mu | None:
    """Return the attenuation of the files that the recipe names; None if it names none."""
    name, energy = recipe["attenuation.object"], recipe["attenuation.energy"]
    if name is not None:
        raise InputError(f"attenuation.object: {name!r} is in a Blender scene; give --mu FILE instead")
    series = recipe["attenuation.series"]
    return read_attenuation(recipe, model, lambda path: read_mu(path, energy, series, stages("reading")))


def read_attenuation(recipe: Recipe, model: Model, read: Callable[[str], Volume]) -> Mu | None:
    """Return the attenuation of a recipe's files, read by `read`; warn of mu at energies outside the model's window."""
    volumes = []
    for path in recipe["attenuation.file"] or ():
        warn_of_energy(model, recipe["attenuation.energy"], Path(path).name)
        volumes.append(read(path))
    return mu_from_volumes(volumes)


def _from_files(recipe: Recipe, record: Recipe, model: Model, mu: Mu | None, stages: Stages) -> Iterator[_Source]:
    """Yield the sources of a recipe's volume files; ``volume.center`` moves all volumes, and mu, by the same shift."""
    center = None
    states = recipe["volume.states"]
    for file in states or [recipe["volume.file"]]:
        volume = _in_model_quantity(_read_volume(file, recipe, stages("reading")), model, recipe["volume.energy"])
        if recipe["volume.center"]:
            if center is None:
                center = volume.grid.center
                mu = mu_from_volumes([centered(m, m.grid.center - center) for m in mu_volumes(mu)])
            volume = centered(volume, volume.grid.center - center)
        yield volume, mu, record if states is None else record.updated({"volume.states": [file]})


def _in_model_quantity(volume: Volume, model: Model, energy: float | str | None) -> Volume:
    """Return a volume in the quantity that the model images; `energy` of its mu is in keV, or an isotope's name."""
    if not model.takes_ct_numbers:
        return volume
    return model.in_model_quantity(volume, None if energy is None else photon_energy(energy))


def _read_volume(path: str, recipe: Recipe, progress: Progress | None) -> Volume:
    """Return the volume of a file; raise `InputError` if the model cannot image its quantity or values."""
    quantity, series = recipe["volume.quantity"], recipe["volume.series"]
    if quantity is not None:
        return read_volume(path, quantity, series=series, progress=progress)
    if recipe["model.kind"] == "emission":
        volume = read_volume_of(path, "activity", series=series, progress=progress)
        lowest, highest = float(volume.array.min()), float(volume.array.max())
        if lowest < -0.1 * highest:  # interpolation leaves smaller values below 0
            values = f"values of {lowest:g} to {highest:g}, as of a CT, are no activity"
            raise InputError(f"{path}: {values}; --quantity activity takes them as such")
        return volume
    if recipe["model.kind"] == "spectral":
        has_energy = recipe["volume.energy"] is not None
        advice = "; CT numbers need no energy" if has_energy else _MU_ADVICE
        return read_volume_of(path, "mu" if has_energy else "hu", advice, series=series, progress=progress)
    if recipe["model.photons"] is not None or recipe["volume.energy"] is not None:
        return read_mu(path, recipe["volume.energy"], series, progress)
    volume = read_volume(path, series=series, progress=progress)
    if volume.quantity == "hu":
        raise InputError(
            f"{path}: it holds CT numbers (hu), or says nothing and is taken for them; give --energy KEV to convert them "
            "to attenuation, or --quantity mu or activity if that is what the values are"
        )
    return volume


def read_mu(
    path: str | Path, energy: float | str | None, series: str | None = None, progress: Progress | None = None
) -> Volume:
    """Return the volume of mu of a file, or of its CT numbers at `energy` (keV or an isotope); for `LINES`, CT numbers."""
    if energy is not None:
        volume = read_volume(path, series=series, progress=progress)
        if volume.quantity != "hu":
            raise InputError(f"{path}: it holds {volume.quantity}; an energy (--energy) is for CT numbers (hu)")
        return volume if energy == LINES else hu_to_mu(volume, photon_energy(energy))
    advice = "; of CT numbers, give the energy (--energy) to convert them"
    volume = read_volume_of(path, "mu", advice, series=series, progress=progress)
    lowest, highest = float(volume.array.min()), float(volume.array.max())
    if lowest < -1 or highest > _MOST_MU:  # interpolation may leave values a little below 0
        outlier = lowest if lowest < -1 else highest
        advice = "if it holds CT numbers, give the energy (--energy) to convert them"
        raise InputError(f"{path}: {outlier:g} is no attenuation in 1/mm; {advice}")
    return volume


def _from_phantom(recipe: Recipe, record: Recipe, model: Model, mu: Mu | None, stages: Stages) -> Iterator[_Source]:
    """Yield the source of a recipe's phantom, voxelized."""
    if recipe["volume.object"] is not None and not any(key.startswith("phantom.") for key in recipe.given):
        name = recipe["volume.object"]
        raise InputError(f"volume.object: {name!r} is in a Blender scene; give --volume FILE instead")
    phantom, pose = recipe_phantom(recipe), phantom_pose(recipe)
    n_x, n_y, n_z = np.broadcast_to(recipe["phantom.voxels"], 3).tolist()
    # By default the phantom fits into the grid in any orientation, with a free voxel all around.
    spacing = np.broadcast_to(recipe["phantom.spacing"] or phantom.extent / max(1, min(n_x, n_y, n_z) - 2), 3)
    if recipe["phantom.turn_grid"]:
        low, high = phantom.box
        centered_grid = Grid.centered((n_x, n_y, n_z), spacing, (low + high) / 2)
        grid = Grid(centered_grid.shape, pose @ centered_grid.affine)
    else:
        grid = Grid.centered((n_x, n_y, n_z), spacing, pose[:3, 3])
    if recipe["attenuation.of_phantom"]:
        mu = _mu_of_phantom(phantom, pose, grid, model, stages)
    is_described = recipe["phantom.file"] is not None or recipe["phantom.text"] is not None
    is_of_mu = (is_described and recipe["model.photons"] is not None) or recipe["model.kind"] == "spectral"
    volume = phantom.voxelize(grid, pose, stages("voxelizing"), "mu" if is_of_mu else "activity")
    yield _in_model_quantity(volume, model, phantom.mu_energy), mu, with_phantom(record, phantom, pose)


def recipe_phantom(recipe: Recipe) -> Phantom:
    """Return the phantom that a recipe describes, in its own frame."""
    if recipe["phantom.file"] is not None:
        return read_phantom(recipe["phantom.file"])
    if recipe["phantom.text"] is not None:
        return parse_phantom(recipe["phantom.text"])
    (kind,) = (kind for kind in KINDS if kind.name == recipe["phantom.kind"])
    return kind.phantom(**{**kind.usual, **recipe.fields("phantom", kind.phantom)})


def run_truth(run: ProjectionRun) -> tuple[Volume | Phantom, Floats | None]:
    """Return the truth of a simulated run: the phantom of its recipe and its pose (4, 4), else its volume and None.

    Raises `InputError` for a measured run.
    """
    if run.volume is None:
        raise InputError("the run was measured: nobody knows the truth; give a volume or a phantom")
    recipe = run.recipe if "recipe" in run.settings else None
    if recipe is None or recipe["model.kind"] == "spectral" or "phantom.matrix" not in recipe.given:
        return run.volume, None
    return recipe_phantom(recipe), phantom_pose(recipe)


def _mu_of_phantom(phantom: Phantom, pose: Floats, grid: Grid, model: Model, stages: Stages) -> Volume:
    """Return the attenuation coefficients of a phantom on a grid."""
    require_mu(phantom, model)
    return phantom.voxelize(grid, pose, stages("voxelizing"), "mu")


def require_mu(phantom: Phantom, model: Model) -> None:
    """Raise `InputError` if a phantom attenuates nothing; warn if its mu holds outside the model's energy window."""
    if all(shape.mu is None for shape in phantom.shapes):
        raise InputError(f"attenuation.of_phantom (--phantom-mu): no shape of the {phantom.title} has a mu")
    warn_of_energy(model, phantom.mu_energy, f"the {phantom.title}")


def phantom_pose(recipe: Recipe) -> Floats:
    """Return the world-from-phantom pose (4, 4), mm; raise `InputError` if matrix and position with angles disagree."""
    phi, theta, psi = np.deg2rad(recipe["phantom.euler_degrees"])
    pose = euler_pose(phi, theta, psi, recipe["phantom.position"])
    if recipe["phantom.matrix"] is None:
        return pose
    matrix = np.array(recipe["phantom.matrix"])
    has_placement = "phantom.position" in recipe.given or "phantom.euler_degrees" in recipe.given
    if has_placement and not np.allclose(matrix, pose, rtol=0, atol=1e-5):  # mm; Blender's matrices are float32
        raise InputError("phantom.matrix: it is another pose than that of phantom.position and phantom.euler_degrees")
    return matrix


def with_phantom(recipe: Recipe, phantom: Phantom, pose: Floats) -> Recipe:
    """Return the recipe with a full description of the phantom: kind, numbers, and the pose as matrix and angles."""
    values: dict[str, Any] = {"matrix": pose.tolist(), "voxels": recipe["phantom.voxels"]}
    if (angles := euler_degrees(pose)) is not None:
        values |= {"position": pose[:3, 3].tolist(), "euler_degrees": angles}
    cls: Any = type(phantom)
    for kind in KINDS:
        if cls is kind.phantom:
            numbers = {key: getattr(phantom, name) for key, name in setting_names(cls).items()}
            values |= {"kind": kind.name} | numbers
    return recipe.updated({f"phantom.{name}": value for name, value in values.items()})


def euler_degrees(pose: Floats) -> list[float] | None:
    """Return the angles phi, theta, psi, degrees, of a `pose` as for `euler_pose`; None if it is no rigid motion."""
    turn = pose[:3, :3]
    if not np.allclose(turn @ turn.T, np.eye(3), rtol=0, atol=1e-6) or np.linalg.det(turn) < 0:
        return None
    theta = math.atan2(math.hypot(turn[0, 2], turn[1, 2]), turn[2, 2])
    if math.sin(theta) < 1e-9:  # both other angles turn about z, so psi is 0
        phi, psi = math.atan2(turn[1, 0] * turn[2, 2], turn[1, 1]), 0.0
    else:
        phi, psi = math.atan2(turn[1, 2], turn[0, 2]), math.atan2(turn[2, 1], -turn[2, 0])
    return [math.degrees(angle) for angle in (phi, theta, psi)]
