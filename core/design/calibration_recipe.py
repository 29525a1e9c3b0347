"""Recipes of calibrations, in TOML: the runs and their physics, sources, fitted parameters and prior standard deviations."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError, naming
from ..files import AnyPath
from ..geometry.system import PinholeSystem
from ..geometry.views import VECTORS
from ..models.emission import Emission
from ..progress import Progress
from ..recipes.settings import Setting, settings_by_key
from ..recipes.tables import flat_entries, read_table, require_value
from ..recipes.toml import read_toml
from ..recipes.values import Values
from ..runs.files import read_run
from ..runs.run import ProjectionRun
from ..runs.run_recipe import recipe_model
from ..runs.settings import SETTINGS
from ..validation import at_least_0, real_array, shape_text
from ..workbook import read_system
from .bundle import LENGTH, OFFSET
from .calibration import Calibration, calibrate

_SD = "Standard deviation of "
_ROWS = settings_by_key((
    Setting("runs.files", str, None, "Run files of counts, one of each acquisition", is_path=True, sizes=()),
    Setting("system.file", str, None, "Workbook of the runs' scanner, of which a calibrated copy is written", "a new one",
            is_path=True),
    Setting(f"fit.{LENGTH}", bool, False, "Also fit the collimator lengths"),
    Setting(f"fit.{OFFSET}", bool, False, "Also fit the pixels' offsets on the crystals"),
    Setting("priors.position_sd", float, 5.0, _SD + "the pinholes from their nominal positions", unit="mm", above=0),
    Setting("priors.tilt_sd_degrees", float, 2.0, _SD + "the modules' tilts from the nominal ones", above=0),
    Setting(f"priors.{LENGTH}_sd", float, 1.0, _SD + "the lengths from the nominal ones", unit="mm", above=0),
    Setting(f"priors.{OFFSET}_sd", float, 0.5, _SD + "the pixels from their nominal positions", unit="mm", above=0),
    Setting("priors.distance_sd", float, 0.02, _SD + "known distances between sources", unit="mm", above=0),
))  # fmt: skip
_SOURCES = ("points", "distances", "diameter")


class _CalibrationSettings(Values):
    """Settings of a calibration's recipe."""

    rows = _ROWS  # type: ignore[assignment]


def run_calibration(path: AnyPath, progress: Progress | None = None) -> Calibration:
    """Calibrate a scanner by the recipe in a TOML file; paths in it are relative to its folder.

    `progress` is called with (done, total) acquisitions. `InputError` names the file and the entry.
    """
    tables, folder = read_toml(path), Path(path).parent
    with naming(path):
        sources = read_table(tables, "sources")
        for name in sources.keys() - set(_SOURCES):
            raise InputError(f"sources.{name}: no such setting; expected {', '.join(_SOURCES)}")
        tables.pop("sources", None)
        changes = flat_entries({"model": read_table(tables, "model")}, SETTINGS, "model")
        tables.pop("model", None)
        recipe = _CalibrationSettings(
            flat_entries(tables, _ROWS, *(name for name in tables if isinstance(tables[name], dict)))
        )
        files = require_value(recipe["runs.files"], "runs.files", "name a run file of each acquisition")
        runs = [read_run(folder / name) for name in files]
        workbook = recipe["system.file"]
        system = runs[0].system if workbook is None else read_system(folder / workbook)
        model = recipe_model(runs[0].recipe.updated(changes), system, run=runs[0])
        if not isinstance(system, PinholeSystem) or not isinstance(model, Emission):
            raise InputError("runs.files: expected runs of counts of pinholes")
        for name, run in zip(files, runs, strict=True):
            if not _have_same_poses(run.system, system):
                raise InputError(f"runs.files: {name}: expected the modules of {workbook or files[0]}")
            if difference := _view_difference(run, runs[0]):
                raise InputError(f"runs.files: {name}: {difference} in {files[0]}; expected the same views in all runs")
        diameter = at_least_0(sources.get("diameter", 0.0), "sources.diameter", "mm")
        priors = {key.partition(".")[2]: recipe[key] for key in _ROWS if key.startswith("priors.")}
        return calibrate(
            system, np.stack([run.projections for run in runs]), runs[0].views, sources.get("points"),
            _distance_table(sources.get("distances"), len(runs)), model=replace(model, background=runs[0].background),
            fit=[name for name in (LENGTH, OFFSET) if recipe[f"fit.{name}"]], **priors, source_diameter=diameter,
            progress=progress,
        )  # fmt: skip


def _have_same_poses(a: Any, b: Any) -> bool:
    """Return whether two scanners have the same modules at the same poses."""
    return len(a) == len(b) and np.allclose(a.poses(), b.poses(), atol=1e-6)


def _view_difference(run: ProjectionRun, first: ProjectionRun) -> str:
    """Return in what the views of two runs of the same modules differ, such as "48 x 48 pixels, but 24 x 24"; else ""."""
    facts = []
    for views, settings in ((run.views, run.settings), (first.views, first.settings)):
        magnification = float(settings.get("magnification", 1.0))
        sizes = [f"{np.linalg.norm(steps[0]) / magnification:.4g}" for steps in (views.u_steps, views.v_steps)]
        facts.append((
            f"the {settings.get('detector')} detector", f"{shape_text(views.shape)} pixels",
            f"magnification {magnification:g}", f"pixels of {' x '.join(sizes)} mm",
        ))  # fmt: skip
    texts = [f"{text}, but {first_text}" for text, first_text in zip(*facts, strict=True) if text != first_text]
    is_same = all(np.allclose(getattr(run.views, name), getattr(first.views, name), atol=1e-6) for name in VECTORS)
    return texts[0] if texts else "" if is_same else "its pixels lie elsewhere than"


def _distance_table(entries: Any, n_k: int) -> Any:
    """Return the table of distances (K, K), mm, NaN for unknown ones, from a recipe's list of [first, second, mm].

    Sources are numbered from 1. Returns None for None.
    """
    if entries is None:
        return None
    rows = real_array(entries, "sources.distances", (None, 3))
    first, second = ends = rows[:, :2].astype(int).T
    if (rows[:, :2] != ends.T).any() or ends.min() < 1 or ends.max() > n_k or (first == second).any():
        raise InputError(f"sources.distances: expected [first, second, mm], sources from 1 to {n_k}")
    distances = np.full((n_k, n_k), np.nan)
    distances[first - 1, second - 1] = rows[:, 2]
    return distances
