"""Detection efficiencies, from files too, and dead time of a recipe."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from ..arrays import Array, Floats
from ..errors import InputError, reading
from ..files import AnyPath, require_file
from ..hdf5 import datasets, opened, read_numbers
from ..models.model import with_image_axes
from ..physics.dead_time import live_shares
from ..volumes.formats import numpy_files
from .recipe import Recipe

EFFICIENCY = "efficiency"
"""Name of the array of efficiencies in .npz and .h5 files with several arrays."""


def read_efficiency(path: AnyPath) -> Array:
    """Return the efficiencies (M,) or (M, n_v, n_u) of a file: its only array, or the one called "efficiency"."""
    with reading(require_file(path), "efficiencies"):
        if Path(path).suffix.lower() in (".npy", ".npz"):
            arrays = numpy_files.load(Path(path))
        else:
            with opened(path, whole=True) as file:
                arrays = {name: read_numbers(item) for name, item in datasets(file).items()}
        if len(arrays) != 1 and EFFICIENCY not in arrays:
            raise InputError(f"expected one array, or one called {EFFICIENCY}, found {', '.join(arrays) or 'none'}")
        return arrays.get(EFFICIENCY, next(iter(arrays.values())))


def recipe_efficiency(recipe: Recipe) -> Any:
    """Return a recipe's efficiency: one number, one for each module (M,), or the array of its file."""
    efficiency = recipe["model.efficiency"]
    return read_efficiency(efficiency) if isinstance(efficiency, str) else efficiency


def recipe_dead_time(recipe: Recipe) -> tuple[float, str]:
    """Return a recipe's dead time, s, and its kind, "non-paralysable" or "paralysable"."""
    return 1e-6 * recipe["model.dead_time"], recipe["model.dead_time_kind"]


def recorded_shares(recipe: Recipe, counts: Array, record: Mapping[str, Any] = MappingProxyType({})) -> Floats:
    """Return the fractions (M, 1, 1) of photons that modules with a recipe's dead time recorded, from counts (M, n_v, n_u).

    The counts of a measured run's scatter windows, which `record` holds, kept the modules busy, too.
    """
    seconds, kind = recipe_dead_time(recipe)
    if not seconds:
        return np.ones((1, 1, 1))
    totals = counts.sum(axis=(1, 2), dtype=float) + record.get("scatter", {}).get("counts", 0.0)
    return live_shares(totals[:, None, None], recipe["model.time"], seconds, kind)  # type: ignore[arg-type]


def scale_by_module(values: float | Floats, shares: Array) -> float | Floats:
    """Return efficiencies or a background, (), (M,) or (M, n_v, n_u), multiplied by the modules' `shares` (M, 1, 1)."""
    if np.all(shares == 1):
        return values
    scaled = with_image_axes(values) * shares
    return scaled if np.ndim(values) == 3 else scaled[:, 0, 0]
