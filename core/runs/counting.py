"""What pixels and modules make of photons: efficiencies from files, and dead time, as recipes say them."""

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
"""The name of the array in .npz and .h5, where there are several."""


def read_efficiency(path: AnyPath) -> Array:
    """The efficiencies (M,) or (M, n_v, n_u) in a file: the array of .npy; of .npz and .h5 the only one, or "efficiency"."""
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
    """A recipe's efficiency: a number, those of modules, or what its file holds."""
    given = recipe["model.efficiency"]
    return read_efficiency(given) if isinstance(given, str) else given


def dead_time_of(recipe: Recipe) -> tuple[float, str]:
    """A recipe's dead time, s, and its kind."""
    return 1e-6 * recipe["model.dead_time"], recipe["model.dead_time_kind"]


def live_shares_of(recipe: Recipe, counts: Array, record: Mapping[str, Any] = MappingProxyType({})) -> Floats:
    """The shares (M, 1, 1) of photons that modules with a recipe's dead time recorded, by their counts (M, n_v, n_u).

    What a measured run's `record` says of scatter's energy windows has kept them busy, too.
    """
    seconds, kind = dead_time_of(recipe)
    if not seconds:
        return np.ones((1, 1, 1))
    totals = counts.sum(axis=(1, 2), dtype=float) + record.get("scatter", {}).get("counts", 0.0)
    return live_shares(totals[:, None, None], recipe["model.time"], seconds, kind)  # type: ignore[arg-type]


def scaled(values: float | Floats, shares: Array) -> float | Floats:
    """Efficiencies or a background, of any of their forms, times shares (M, 1, 1) of modules."""
    if np.all(shares == 1):
        return values
    found = with_image_axes(values) * shares
    return found if np.ndim(values) == 3 else found[:, 0, 0]
