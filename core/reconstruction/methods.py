"""The methods that counts or line integrals are reconstructed by, and the priors that they take, one line each.

`METHODS` and `PRIORS` are the only lists: settings of recipes, options of ``mphdrr reconstruct`` and Blender's panel follow
from them, and from the arguments of their functions. `METHOD_FILES` says how a file, such as a trained network, is a method.
"""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

from ..errors import naming
from ..geometry.grid import Grid
from .bsrem import bsrem
from .expectation import mlem, osem
from .least_squares import cgls, sirt
from .loop import IterativeOptions
from .ostr import ostr
from .priors import Quadratic, RelativeDifference, TotalVariation
from .result import Reconstruction
from .tv import tv


@dataclass(frozen=True)
class Choice:
    """A function, or a class, whose arguments are settings ``reconstruction.<name>``."""

    label: str  # in menus
    text: str  # one line of help
    function: Callable[..., Any]

    first: ClassVar[int] = 0  # number of the argument with which its settings begin

    @cached_property
    def own(self) -> Mapping[str, Any]:
        """Its settings by name, with their defaults: `inspect.Parameter.empty` where one must be given."""
        arguments = list(inspect.signature(self.function).parameters.values())[self.first :]
        return {
            each.name: each.default
            for each in arguments
            if each.kind not in (each.VAR_POSITIONAL, each.VAR_KEYWORD) and each.name not in _OPTIONS
        }


@dataclass(frozen=True)
class Method(Choice):
    """A way from images to a volume: ``function(A, images, ...)`` with a `Projector` gives a `Reconstruction`.

    Its other arguments are settings ``reconstruction.<name>``, and those of `IterativeOptions` that it takes.
    """

    function: Callable[..., Reconstruction]
    of_counts: bool = True  # whether it needs counts; else it takes any images
    objective: str = "log-likelihood"  # what `Reconstruction.objective` is; "" where there is none
    grid: Grid | None = None  # the voxels that it has, where it takes no others

    first = 2

    def takes(self, name: str) -> bool:
        """Whether it has an argument of this name."""
        arguments = inspect.signature(self.function).parameters.values()
        return any(each.name == name or (each.kind == each.VAR_KEYWORD and name in _OPTIONS) for each in arguments)


_OPTIONS = IterativeOptions.__annotations__

METHODS: Mapping[str, Method] = {
    "osem": Method("OSEM", "Likeliest activity, by subsets of the modules (fast)", osem),
    "mlem": Method("MLEM", "Likeliest activity, by all modules at once (slow, and the likelihood never falls)", mlem),
    "bsrem": Method("BSREM", "Likeliest activity, less the penalty of a prior: the very maximum", bsrem),
    "sirt": Method("SIRT", "Least squares of line integrals, steadily", sirt, False, "squared error"),
    "cgls": Method("CGLS", "Least squares of line integrals, fast; values may be negative", cgls, False, "squared error"),
    "tv": Method("TV", "Areas of one value with sharp edges, from line integrals", tv, False,
                 "squared error with variation"),
    "ostr": Method("OSTR", "Likeliest attenuation of photons that pass, less the penalty of a prior", ostr, False),
}  # fmt: skip
"""The methods by their names in recipes and on the command line."""


def _network(path: Path) -> Method:
    return import_module("..learning", __package__).read_model(path).method  # type: ignore[no-any-return]  # needs torch


METHOD_FILES: dict[str, Callable[[Path], Method]] = {".pt": _network}
"""What reads a file as a method, by the file's ending in lower case, such as ".pt"; it raises `InputError`."""

PRIORS: Mapping[str, Choice] = {
    "quadratic": Choice("Quadratic", "Smooth everywhere, edges too", Quadratic),
    "relative-difference": Choice("Relative Difference", "Smooth, but large differences are spared", RelativeDifference),
    "total-variation": Choice("Total Variation", "Areas of one value with sharp edges", TotalVariation),
}  # fmt: skip


def method_of(name: str) -> Method:
    """The method of that name, or that in a file with an ending of `METHOD_FILES`; raises InputError."""
    if name in METHODS:
        return METHODS[name]
    with naming(name):
        return METHOD_FILES[Path(name).suffix.lower()](Path(name))
