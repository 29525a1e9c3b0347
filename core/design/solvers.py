"""Solvers of SciPy for designs: the table of the search's algorithms, and SciPy's modules, imported on first use."""

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from ..errors import needing
from ..recipes.settings import LibraryAlgorithm

SOLVERS: Mapping[str, LibraryAlgorithm] = {
    "l-bfgs-b": LibraryAlgorithm(
        "L-BFGS-B", "Quasi-Newton steps of limited memory", "L-BFGS-B", {"ftol": 1e-10, "gtol": 1e-7}
    ),
}
"""Methods of `scipy.optimize.minimize` that use gradients and keep limits, by their names in recipes.

A second row makes the choice a setting, ``search.solver``.
"""


def scipy_module(name: str) -> Any:
    """Return ``scipy.<name>``, such as "optimize"; raise `InputError` if SciPy is missing."""
    with needing("mphdrr[design]"):
        return import_module(f"scipy.{name}")
