"""From a recipe to projection runs: the main job, for the command line, the demo, scripts and Blender."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..geometry.system import PinholeSystem, chosen_modules
from ..physics.ct_numbers import hu_to_mu
from ..physics.isotopes import photon_energy
from ..progress import Progress
from ..projector import Emission, InverseSquareSum, Model, Transmission
from ..volumes.rearranging import centered
from ..volumes.volume import Volume
from ..volumes.volume_files import read_volume, read_volume_of
from ..workbook import read_system
from .phantom_recipe import phantom_grid, phantom_pose, recipe_phantom, with_phantom
from .projecting import project_run, warn_of_energy
from .recipe import Recipe
from .run import ProjectionRun

Stages = Callable[[str], Progress | None]
"""Gives the progress callback of a stage: reading, voxelizing, projecting."""

_MODELS: dict[str, Any] = {"transmission": Transmission, "emission": Emission, "inverse-square": InverseSquareSum}
_MOST_MU = 500.0
"""1/mm: more than any material of the tables attenuates photons of 10 keV or more."""


def run_recipe(
    recipe: Recipe,
    system: PinholeSystem | None = None,
    volume: Volume | None = None,
    mu: Volume | None = None,
    stages: Stages = lambda stage: None,
) -> Iterator[ProjectionRun]:
    """Make what a recipe asks for: one run, or one for each of ``volume.states``.

    Parameters
    ----------
    recipe
        What to do.
    system, volume, mu
        Instead of those that the recipe names; of `system` the recipe chooses modules.
    stages
        Gives the progress callback of each stage.

    Raises
    ------
    InputError
        A file cannot be read, the recipe names no system, or as `project_run`; all but the volumes is checked first.
    """
    system = chosen_modules(system or _system(recipe), recipe["system.modules"], "system.modules")
    model = recipe_model(recipe, system)
    if mu is None and recipe["attenuation.object"] is not None:
        raise InputError(
            f"attenuation.object: {recipe['attenuation.object']!r} is in a Blender scene; give --mu FILE instead"
        )
    if mu is None and recipe["attenuation.file"] is not None:
        mu = _attenuation(recipe, model, stages("reading"))
    recorded = recipe.complete()
    if volume is not None:
        sources: Iterator[_Source] = iter([(volume, mu, recorded)])
    elif recipe["volume.file"] is not None or recipe["volume.states"] is not None:
        sources = _from_files(recipe, recorded, mu, stages)
    else:
        sources = _from_phantom(recipe, recorded, model, mu, stages)
    for number, (source, mu_of_it, record) in enumerate(sources):
        seed = recipe["noise.seed"]
        if seed is not None:  # noise of its own for each state
            record = record.updated({"noise.seed": seed + number})
        yield project_run(
            system,
            source,
            shape=(recipe["detector.rows"], recipe["detector.columns"]),
            detector=recipe["detector.plane"],
            magnification=recipe["detector.magnification"],
            pitch=recipe["detector.pitch"],
            backend=recipe["compute.backend"],
            threads=recipe["compute.threads"],
            settings={"volume": _volume_name(record), **_energies(recipe), "recipe": record.tables()},
            model=recipe_model(recipe, system, mu_of_it),
            photons=recipe["model.photons"],
            noise_seed=record["noise.seed"],
            progress=stages("projecting"),
        )


def recipe_model(recipe: Recipe, system: PinholeSystem, mu: Volume | None = None) -> Model:
    """The model that a recipe asks for; `mu` is what attenuates.

    Raises
    ------
    InputError
        The settings do not go together.
    """
    cls = _MODELS[recipe["model.kind"]]
    given = recipe.fields("model", cls)
    if given.get("pixel_points") == "auto":
        given["pixel_points"] = None
    if cls is Emission:
        if "model.opening_angle_degrees" in recipe.given:
            given["opening_angle"] = math.radians(recipe["model.opening_angle_degrees"])
        given["mu"] = mu
    model: Model = cls(**given) if cls is Transmission else cls(system, **given)
    return model


_Source = tuple[Volume, Volume | None, Recipe]
"""What is projected, what attenuates it, and what to record of it."""


def _system(recipe: Recipe) -> PinholeSystem:
    if recipe["system.file"] is None:
        raise InputError("system.file: missing; name the geometry workbook")
    return read_system(recipe["system.file"], columns=recipe["system.columns"])


def _volume_name(record: Recipe) -> str:
    """What a run calls its volume."""
    for key in ("volume.object", "volume.file", "phantom.file"):
        if record[key] is not None:
            return Path(record[key]).name
    if record["volume.states"] is not None:
        return Path(record["volume.states"][0]).name
    return f"{record['phantom.kind'].capitalize()} phantom" if "phantom.kind" in record.given else ""


def _energies(recipe: Recipe) -> dict[str, float]:
    """At which energies CT numbers were converted, keV."""
    energy = recipe["volume.energy"] or recipe["attenuation.energy"]
    return {} if energy is None else {"ct_converted_at_kev": photon_energy(energy)}


def _from_files(recipe: Recipe, record: Recipe, mu: Volume | None, stages: Stages) -> Iterator[_Source]:
    """The volumes of the files, one at a time; ``volume.center`` moves all of them, and mu, as far as the first."""
    middle = None
    states = recipe["volume.states"]
    for file in states or [recipe["volume.file"]]:
        volume = _read(file, recipe, stages("reading"))
        if recipe["volume.center"]:
            if middle is None:
                middle = volume.grid.center
                mu = None if mu is None else centered(mu, mu.grid.center - middle)
            volume = centered(volume, volume.grid.center - middle)
        yield volume, mu, record if states is None else record.updated({"volume.states": [file]})


def _read(path: str, recipe: Recipe, progress: Progress | None) -> Volume:
    """A file's volume; values that the model has no meaning for are refused."""
    quantity, series = recipe["volume.quantity"], recipe["volume.series"]
    if quantity is not None:
        return read_volume(path, quantity, series=series, progress=progress)
    if recipe["model.kind"] == "emission":
        volume = read_volume_of(path, "activity", series=series, progress=progress)
        lowest, highest = float(volume.array.min()), float(volume.array.max())
        if lowest < -0.1 * highest:  # interpolation leaves less
            raise InputError(
                f"{path}: values of {lowest:g} to {highest:g}, as of a CT, are no activity; --quantity "
                "activity takes them as such"
            )
        return volume
    if recipe["model.photons"] is not None or recipe["volume.energy"] is not None:
        return _read_mu(path, recipe["volume.energy"], series, progress)
    volume = read_volume(path, series=series, progress=progress)
    if volume.quantity == "hu":
        raise InputError(
            f"{path}: it holds CT numbers (hu), or says nothing and is taken for them; give --energy KEV to convert them "
            "to attenuation, or --quantity mu or activity if that is what the values are"
        )
    return volume


def _read_mu(path: str, energy: float | str | None, series: str | None, progress: Progress | None) -> Volume:
    """The volume of mu in a file: as it is, or from CT numbers at `energy`."""
    if energy is not None:
        volume = read_volume(path, series=series, progress=progress)
        if volume.quantity != "hu":
            raise InputError(f"{path}: it holds {volume.quantity}; --energy is for CT numbers (hu)")
        return hu_to_mu(volume, photon_energy(energy))
    advice = "; of CT numbers, give --energy to convert them"
    volume = read_volume_of(path, "mu", advice, series=series, progress=progress)
    lowest, highest = float(volume.array.min()), float(volume.array.max())
    if lowest < -1 or highest > _MOST_MU:  # interpolation may leave values a little below 0
        raise InputError(
            f"{path}: {lowest if lowest < -1 else highest:g} is no attenuation in 1/mm; if it holds CT numbers, give "
            "--energy to convert them"
        )
    return volume


def _attenuation(recipe: Recipe, model: Model, progress: Progress | None) -> Volume:
    path, energy = recipe["attenuation.file"], recipe["attenuation.energy"]
    mu = _read_mu(path, energy, recipe["attenuation.series"], progress)
    if energy is not None:
        warn_of_energy(model, photon_energy(energy), f"the mu of {Path(path).name}")
    return mu


def _from_phantom(recipe: Recipe, record: Recipe, model: Model, mu: Volume | None, stages: Stages) -> Iterator[_Source]:
    if recipe["volume.object"] is not None and not any(key.startswith("phantom.") for key in recipe.given):
        raise InputError(
            f"volume.object: {recipe['volume.object']!r} is in a Blender scene; give --volume FILE instead"
        )
    phantom, pose = recipe_phantom(recipe), phantom_pose(recipe)
    grid = phantom_grid(recipe, phantom, pose)
    if recipe["attenuation.of_phantom"]:
        if all(shape.mu is None for shape in phantom.shapes):
            raise InputError(f"attenuation.of_phantom (--phantom-mu): no shape of the {phantom.title} has a mu")
        warn_of_energy(model, phantom.mu_energy, f"the mu of the {phantom.title}")
        mu = phantom.voxelize(grid, pose, stages("voxelizing"), "mu")
    is_described = recipe["phantom.file"] is not None or recipe["phantom.text"] is not None
    quantity = "mu" if is_described and recipe["model.photons"] is not None else "activity"
    volume = phantom.voxelize(grid, pose, stages("voxelizing"), quantity)
    yield volume, mu, with_phantom(record, phantom, pose)
