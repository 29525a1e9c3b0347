"""From a recipe to projection runs: the main job, for the command line, the demo, scripts and Blender."""

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
from ..progress import Progress, Stages
from ..projector import Emission, InverseSquareSum, Model, Projector, Transmission
from ..volumes.rearranging import centered
from ..volumes.volume import Volume
from ..volumes.volume_files import read_volume, read_volume_of
from ..workbook import read_scanner
from ..xray.detectors import checked_bins
from ..xray.scan import SpectralScan
from .counting import dead_time_of, live_shares_of, recipe_efficiency, scaled
from .measured import recipe_counts
from .projecting import LINES, Imaging, project_run, warn_of_energy
from .recipe import Recipe, recorded_recipe
from .run import ProjectionRun

_MODELS: dict[str, Any] = {
    "transmission": Transmission, "emission": Emission, "spectral": SpectralScan, "inverse-square": InverseSquareSum,
}  # fmt: skip
_MODULES, _EFFICIENCY = "system.modules", "model.efficiency"
_MU_ADVICE = "; of mu, give the energy at which it holds (--energy)"
_MOST_MU = 500.0
"""1/mm: more than any material of the tables attenuates photons of 10 keV or more."""

_Source = tuple[Volume, Mu | None, Recipe]
"""What is projected, what attenuates it, and what to record of it."""


def run_recipe(
    recipe: Recipe,
    system: Scanner | None = None,
    volume: Volume | None = None,
    mu: Mu | None = None,
    stages: Stages = lambda stage: None,
) -> Iterator[ProjectionRun]:
    """Make what a recipe asks for: one run, or one for each of ``volume.states`` and frames; of counts, the run of these.

    Parameters
    ----------
    recipe
        What to do.
    system, volume, mu
        Instead of those that the recipe names; of `system` the recipe chooses modules. `mu` may be a tuple, of the lines.
    stages
        Begins each stage: reading, voxelizing, projecting.

    Raises
    ------
    InputError
        A file cannot be read, the recipe names no system, or see `project_run`; all but the volumes is checked first.
    """
    system = recipe_system(recipe) if system is None else chosen_modules(system, recipe["system.modules"], _MODULES)
    recipe = with_pixels(recipe, system)
    model = recipe_model(recipe, system)
    if mu is None:
        mu = _attenuation(recipe, model, stages)
    if recipe["counts.files"] is not None and volume is None:
        yield recipe_counts(recipe, system, stages)
        return
    recorded = recorded_recipe(recipe)
    sources: Iterator[_Source]
    if volume is not None:
        if mu is None and recipe["attenuation.of_phantom"]:
            raise InputError("attenuation.of_phantom: a volume that is given needs its mu as well")
        sources = iter([(_taken(volume, model, recipe["volume.energy"]), mu, recorded)])
    elif recipe["volume.file"] is not None or recipe["volume.states"] is not None:
        sources = _from_files(recipe, recorded, model, mu, stages)
    else:
        sources = _from_phantom(recipe, recorded, model, mu, stages)
    frames = frames_of(recipe)
    energy = recipe["volume.energy"] or recipe["attenuation.energy"]
    converted = {}
    if energy not in (None, LINES) and not isinstance(model, SpectralScan):
        converted["ct_converted_at_kev"] = photon_energy(energy)
    for number, ((source, mu_of_it, record), times) in enumerate(_in_frames(sources, frames)):
        record, seed = record.updated(times), recipe["noise.seed"]
        if seed is not None:  # noise of its own for each
            record = record.updated({"noise.seed": seed + number})
        yield project_run(
            system, source, **_detector(recipe), backend=recipe["compute.backend"], threads=recipe["compute.threads"],
            settings={"volume": _volume_name(record), **converted, "recipe": record.tables()},
            model=recipe_model(recipe.updated(times), system, mu_of_it), photons=recipe["model.photons"],
            noise_seed=record["noise.seed"], progress=stages("projecting"), dead_time=dead_time_of(recipe),
        )  # fmt: skip


def frames_of(recipe: Recipe) -> list[dict[str, Any]]:
    """What each run of a recipe changes in it: its frame's times, if it has frames; `InputError` if their numbers differ."""
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
    for name, others in (("frames.starts", starts), ("volume.states", states)):
        if len(others) not in (len(times), *([0, 1] if name == "volume.states" else [])):
            raise InputError(f"{name}: expected {len(times)}, as many as frames.times, got {len(others)}")
    whole = {"frames.times": None, "frames.starts": None}
    return [{"model.time": t, "model.start": float(s), **whole} for t, s in zip(times, starts, strict=True)]


def _in_frames(sources: Iterator[_Source], frames: list[dict[str, Any]]) -> Iterator[tuple[_Source, dict[str, Any]]]:
    """The volumes in their frames; a single one is in all of them."""
    source = next(sources)
    for frame in frames:
        yield source, frame
        source = next(sources, source)


def recipe_system(recipe: Recipe, path: Callable[[str], str | Path] = Path) -> Scanner:
    """The scanner that a recipe names; `path` says where its files are."""
    file, columns = recipe["system.file"], recipe["system.columns"]
    if file is None:
        raise InputError("system.file: missing; name the geometry workbook")
    system = read_scanner(path(file), recipe["system.kind"], None if columns is None else path(columns))
    return chosen_modules(system, recipe["system.modules"], _MODULES)


def recipe_views(recipe: Recipe, system: Scanner) -> Views:
    """The views of a recipe's detector."""
    return system.views(**_detector(with_pixels(recipe, system)))


def with_pixels(recipe: Recipe, system: Scanner) -> Recipe:
    """The recipe with a scanner's own pixels, if it has any and the recipe asks for no others."""
    names = "detector.rows", "detector.columns"
    own = None if any(name in recipe.given for name in names) else system.pixels
    return recipe if own is None else recipe.updated(dict(zip(names, own, strict=True)))


def _detector(recipe: Recipe) -> dict[str, Any]:
    """The arguments of `PinholeSystem.views`."""
    given = {name: recipe[f"detector.{name}"] for name in ("magnification", "pitch")}
    shape = recipe["detector.rows"], recipe["detector.columns"]
    return {"shape": shape, "detector": recipe["detector.plane"], **given}


def recipe_model(recipe: Recipe, system: Scanner, mu: Mu | None = None, run: ProjectionRun | None = None) -> Model:
    """The model that a recipe asks for; `mu` is what attenuates. `InputError` where the settings do not go together.

    Of a `run` it has the efficiencies, if they are the recipe's, and what dead time has left of its photons is, as a part
    of them, in its efficiency and background: so counts have Poisson's noise.
    """
    cls = _MODELS[recipe["model.kind"]]
    given = recipe.fields("model", cls)
    if given.get("pixel_points") == "auto":
        given["pixel_points"] = None
    if cls is Emission:
        if "model.opening_angle_degrees" in recipe.given:
            given["opening_angle"] = math.radians(recipe["model.opening_angle_degrees"])
        given["mu"] = mu
        if run is not None and "recipe" in run.settings and run.recipe[_EFFICIENCY] == recipe[_EFFICIENCY]:
            given["efficiency"] = run.efficiency
        else:
            given["efficiency"] = recipe_efficiency(recipe)
        if run is not None and recipe["model.dead_time"]:
            shares = live_shares_of(recipe, run.projections, run.settings)
            given |= {name: scaled(given.get(name, 0.0), shares) for name in ("background", "efficiency")}
    model: Model = cls(**given) if cls is Transmission else cls(system, **given)
    if isinstance(model, Emission) and len(files := recipe["attenuation.file"] or ()) > 1:
        require_one_per_line(len(files), model.photon_lines, "attenuation.file", "file")
        if recipe["attenuation.energy"] is not None:
            raise InputError("attenuation.energy: it is for one file of CT numbers; a file for each line holds mu")
    return model


def projector_of_run(
    run: ProjectionRun,
    grid: Grid,
    mu: Mu | None = None,
    recipe: Recipe | None = None,
    backend: str = "auto",
    threads: int | None = None,
    stages: Stages = lambda stage: None,
) -> Projector:
    """The projector from volumes on `grid` to the images of a run, with the model of the run's recipe.

    Parameters
    ----------
    run
        Simulated or measured.
    grid
        The voxels of the volumes.
    mu
        What attenuates (1/mm), on any grid, instead of the recipe's: files, which are read again, or the phantom,
        which is voxelized on `grid`. A tuple is of the isotope's lines.
    recipe
        Instead of the run's own, such as ``run.recipe.updated({"model.aperture_points": 19})``.
    backend, threads
        As for `Projector`.
    stages
        Begins each stage: reading, voxelizing.

    Raises
    ------
    InputError
        The run holds no recipe and none is given, or the attenuation cannot be made again from it.
    """
    recipe = run.recipe if recipe is None else recipe
    if mu is None and recipe["model.kind"] == "emission":
        model = recipe_model(recipe, run.system, run=run)
        if recipe["attenuation.of_phantom"]:
            mu = _mu_of_phantom(recipe_phantom(recipe), phantom_pose(recipe), grid, model, stages)
        elif recipe["volume.center"] and recipe["attenuation.file"] is not None:
            moved = "it was moved with the volume (volume.center)"
            raise InputError(f"attenuation.file: {moved}; give mu where it was then")
        else:
            mu = _attenuation(recipe, model, stages)
    model = recipe_model(recipe, run.system, mu, run)
    if isinstance(model, SpectralScan):  # its images become line integrals
        model = Transmission()
    if isinstance(model, Emission) and np.ndim(run.background) == 3:  # such as scatter: no recipe says it
        own = recipe_model(run.recipe, run.system, run=run).background if "recipe" in run.settings else 0.0
        more = np.maximum(run.background - with_image_axes(own), 0)
        model = replace(model, background=with_image_axes(model.background) + more)
    return Projector(grid, run.views, model, backend, threads)


def recipe_imaging(
    recipe: Recipe, system: Scanner, views: Views, grid: Grid, mu: Mu | None, *, threads: int | None
) -> Imaging:
    """What makes a recipe's images of volumes on a grid; `mu` is what attenuates."""
    projector = Projector(grid, views, recipe_model(recipe, system, mu), threads=threads)
    return Imaging(projector, recipe["model.photons"], dead_time_of(recipe))


def _volume_name(record: Recipe) -> str:
    """What a run calls its volume."""
    names = [record[key] for key in ("volume.object", "volume.file", "phantom.file")]
    for name in filter(None, (*names, *(record["volume.states"] or ()))):
        return Path(name).name
    return f"{record['phantom.kind'].capitalize()} phantom" if "phantom.kind" in record.given else ""


def _attenuation(recipe: Recipe, model: Model, stages: Stages) -> Mu | None:
    """The attenuation that the recipe names, but for that of its phantom."""
    name, energy = recipe["attenuation.object"], recipe["attenuation.energy"]
    if name is not None:
        raise InputError(f"attenuation.object: {name!r} is in a Blender scene; give --mu FILE instead")
    series = recipe["attenuation.series"]
    return mu_of_files(recipe, model, lambda path: read_mu(path, energy, series, stages("reading")))


def mu_of_files(recipe: Recipe, model: Model, read: Callable[[str], Volume]) -> Mu | None:
    """What `read` gives of the files of attenuation that a recipe names; a warning says where it holds for other photons."""
    found = []
    for path in recipe["attenuation.file"] or ():
        warn_of_energy(model, recipe["attenuation.energy"], Path(path).name)
        found.append(read(path))
    return mu_from_volumes(found)


def _from_files(recipe: Recipe, record: Recipe, model: Model, mu: Mu | None, stages: Stages) -> Iterator[_Source]:
    """The volumes of the files, one at a time; ``volume.center`` moves all of them, and mu, as far as the first."""
    middle = None
    states = recipe["volume.states"]
    for file in states or [recipe["volume.file"]]:
        volume = _taken(_read(file, recipe, stages("reading")), model, recipe["volume.energy"])
        if recipe["volume.center"]:
            if middle is None:
                middle = volume.grid.center
                mu = mu_from_volumes([centered(one, one.grid.center - middle) for one in mu_volumes(mu)])
            volume = centered(volume, volume.grid.center - middle)
        yield volume, mu, record if states is None else record.updated({"volume.states": [file]})


def _taken(volume: Volume, model: Model, energy: float | str | None) -> Volume:
    """A volume as the model takes it; `energy`, keV or an isotope's, is that at which its mu holds."""
    if not isinstance(model, SpectralScan):
        return volume
    return model.at_ct_energy(volume, None if energy is None else photon_energy(energy))


def _read(path: str, recipe: Recipe, progress: Progress | None) -> Volume:
    """A file's volume; values that the model has no meaning for are refused."""
    quantity, series = recipe["volume.quantity"], recipe["volume.series"]
    if quantity is not None:
        return read_volume(path, quantity, series=series, progress=progress)
    if recipe["model.kind"] == "emission":
        volume = read_volume_of(path, "activity", series=series, progress=progress)
        lowest, highest = float(volume.array.min()), float(volume.array.max())
        if lowest < -0.1 * highest:  # interpolation leaves less
            values = f"values of {lowest:g} to {highest:g}, as of a CT, are no activity"
            raise InputError(f"{path}: {values}; --quantity activity takes them as such")
        return volume
    if recipe["model.kind"] == "spectral":
        held, advice = ("mu", "; CT numbers need no energy") if recipe["volume.energy"] else ("hu", _MU_ADVICE)
        return read_volume_of(path, held, advice, series=series, progress=progress)
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
    """The volume of mu in a file: as it is, or from CT numbers at `energy` (keV, an isotope's); for `LINES` CT numbers."""
    if energy is not None:
        volume = read_volume(path, series=series, progress=progress)
        if volume.quantity != "hu":
            raise InputError(f"{path}: it holds {volume.quantity}; an energy (--energy) is for CT numbers (hu)")
        return volume if energy == LINES else hu_to_mu(volume, photon_energy(energy))
    advice = "; of CT numbers, give the energy (--energy) to convert them"
    volume = read_volume_of(path, "mu", advice, series=series, progress=progress)
    lowest, highest = float(volume.array.min()), float(volume.array.max())
    if lowest < -1 or highest > _MOST_MU:  # interpolation may leave values a little below 0
        raise InputError(
            f"{path}: {lowest if lowest < -1 else highest:g} is no attenuation in 1/mm; if it holds CT numbers, give "
            "the energy (--energy) to convert them"
        )
    return volume


def _from_phantom(recipe: Recipe, record: Recipe, model: Model, mu: Mu | None, stages: Stages) -> Iterator[_Source]:
    if recipe["volume.object"] is not None and not any(key.startswith("phantom.") for key in recipe.given):
        name = recipe["volume.object"]
        raise InputError(f"volume.object: {name!r} is in a Blender scene; give --volume FILE instead")
    phantom, pose = recipe_phantom(recipe), phantom_pose(recipe)
    n_x, n_y, n_z = np.broadcast_to(recipe["phantom.voxels"], 3).tolist()
    # Where no spacing is given, the phantom fits however it is turned, and a voxel is kept free all around.
    spacing = np.broadcast_to(recipe["phantom.spacing"] or phantom.extent / max(1, min(n_x, n_y, n_z) - 2), 3)
    if recipe["phantom.turn_grid"]:
        low, high = phantom.box
        own = Grid.centered((n_x, n_y, n_z), spacing, (low + high) / 2)
        grid = Grid(own.shape, pose @ own.affine)
    else:
        grid = Grid.centered((n_x, n_y, n_z), spacing, pose[:3, 3])
    if recipe["attenuation.of_phantom"]:
        mu = _mu_of_phantom(phantom, pose, grid, model, stages)
    is_described = recipe["phantom.file"] is not None or recipe["phantom.text"] is not None
    is_of_mu = (is_described and recipe["model.photons"] is not None) or recipe["model.kind"] == "spectral"
    volume = phantom.voxelize(grid, pose, stages("voxelizing"), "mu" if is_of_mu else "activity")
    yield _taken(volume, model, phantom.mu_energy), mu, with_phantom(record, phantom, pose)


def recipe_phantom(recipe: Recipe) -> Phantom:
    """The phantom that a recipe describes, without its pose."""
    if recipe["phantom.file"] is not None:
        return read_phantom(recipe["phantom.file"])
    if recipe["phantom.text"] is not None:
        return parse_phantom(recipe["phantom.text"])
    (kind,) = (kind for kind in KINDS if kind.name == recipe["phantom.kind"])
    return kind.phantom(**{**kind.usual, **recipe.fields("phantom", kind.phantom)})


def truth_of_run(run: ProjectionRun) -> tuple[Volume | Phantom, Floats | None]:
    """What a simulated run's images are of: the phantom that its recipe describes and its pose, else its volume and None.

    `InputError` of a measured run.
    """
    if run.volume is None:
        raise InputError("the run was measured: nobody knows the truth; give a volume or a phantom")
    recipe = run.recipe if "recipe" in run.settings else None
    if recipe is None or recipe["model.kind"] == "spectral" or "phantom.matrix" not in recipe.given:
        return run.volume, None
    return recipe_phantom(recipe), phantom_pose(recipe)


def _mu_of_phantom(phantom: Phantom, pose: Floats, grid: Grid, model: Model, stages: Stages) -> Volume:
    """What the phantom attenuates, on a grid."""
    require_mu(phantom, model)
    return phantom.voxelize(grid, pose, stages("voxelizing"), "mu")


def require_mu(phantom: Phantom, model: Model) -> None:
    """Raise `InputError` where a phantom attenuates nothing; warn where the model counts photons of another energy."""
    if all(shape.mu is None for shape in phantom.shapes):
        raise InputError(f"attenuation.of_phantom (--phantom-mu): no shape of the {phantom.title} has a mu")
    warn_of_energy(model, phantom.mu_energy, f"the {phantom.title}")


def phantom_pose(recipe: Recipe) -> Floats:
    """World-from-phantom pose (4, 4), mm; `InputError` where matrix and position with angles are given and disagree."""
    phi, theta, psi = np.deg2rad(recipe["phantom.euler_degrees"])
    pose = euler_pose(phi, theta, psi, recipe["phantom.position"])
    if recipe["phantom.matrix"] is None:
        return pose
    matrix = np.array(recipe["phantom.matrix"])
    placed = "phantom.position" in recipe.given or "phantom.euler_degrees" in recipe.given
    if placed and not np.allclose(matrix, pose, rtol=0, atol=1e-5):  # mm; Blender's matrices are float32
        raise InputError("phantom.matrix: it is another pose than that of phantom.position and phantom.euler_degrees")
    return matrix


def with_phantom(recipe: Recipe, phantom: Phantom, pose: Floats) -> Recipe:
    """The recipe with all that describes the phantom: the numbers of its kind, and its pose as matrix and angles."""
    values: dict[str, Any] = {"matrix": pose.tolist(), "voxels": recipe["phantom.voxels"]}
    angles = euler_degrees(pose)
    if angles is not None:
        values |= {"position": pose[:3, 3].tolist(), "euler_degrees": angles}
    cls: Any = type(phantom)
    for kind in KINDS:
        if cls is kind.phantom:
            own = {key: getattr(phantom, name) for key, name in setting_names(cls).items()}
            values |= {"kind": kind.name} | own
    return recipe.updated({f"phantom.{name}": value for name, value in values.items()})


def euler_degrees(pose: Floats) -> list[float] | None:
    """Angles phi, theta, psi with which `euler_pose` turns as `pose` does; None where it does more than turn and move."""
    turn = pose[:3, :3]
    if not np.allclose(turn @ turn.T, np.eye(3), rtol=0, atol=1e-6) or np.linalg.det(turn) < 0:
        return None
    theta = math.atan2(math.hypot(turn[0, 2], turn[1, 2]), turn[2, 2])
    if math.sin(theta) < 1e-9:  # both others turn about z: phi takes it all
        phi, psi = math.atan2(turn[1, 0] * turn[2, 2], turn[1, 1]), 0.0
    else:
        phi, psi = math.atan2(turn[1, 2], turn[0, 2]), math.atan2(turn[2, 1], -turn[2, 0])
    return [math.degrees(angle) for angle in (phi, theta, psi)]
