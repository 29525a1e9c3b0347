"""The methods that counts or line integrals are reconstructed by, one line each.

`METHODS` is the only list: settings of recipes, options of ``mphdrr reconstruct`` and Blender's panel follow from it.
"""

import inspect
from collections.abc import Callable
from typing import NamedTuple

from .bsrem import bsrem
from .expectation import mlem, osem
from .least_squares import cgls, sirt
from .priors import Prior, Quadratic, RelativeDifference, TotalVariation
from .result import Reconstruction
from .tv import tv


class Method(NamedTuple):
    """An algorithm over a `Projector`, and what it is told."""

    name: str  # in recipes and on the command line
    label: str  # in menus
    text: str  # one line of help
    function: Callable[..., Reconstruction]
    takes: tuple[str, ...] = ()  # its arguments besides those that all have
    of_counts: bool = True  # whether it needs counts; else it takes any images
    objective: str = "log-likelihood"  # what `Reconstruction.objective` is

    @property
    def iterations(self) -> int:
        """How many it does unless it is told."""
        return int(inspect.signature(self.function).parameters["iterations"].default)


METHODS = {
    method.name: method
    for method in (
        Method("osem", "OSEM", "Likeliest activity, by subsets of the modules (fast)", osem,
               ("subsets", "background", "prior")),
        Method("mlem", "MLEM", "Likeliest activity, by all modules at once (slow, and the likelihood never falls)",
               mlem, ("background", "prior")),
        Method("bsrem", "BSREM", "Likeliest activity, less the penalty of a prior: the very maximum", bsrem,
               ("subsets", "background", "prior")),
        Method("sirt", "SIRT", "Least squares of line integrals, steadily", sirt, (), False,
               "squared error"),
        Method("cgls", "CGLS", "Least squares of line integrals, fast; values may be negative", cgls,
               (), False, "squared error"),
        Method("tv", "TV", "Areas of one value with sharp edges, from line integrals", tv,
               ("weight",), False, "squared error with variation"),
    )
}  # fmt: skip


class PriorKind(NamedTuple):
    """A penalty on noise, and what it is told."""

    name: str
    label: str
    text: str
    prior: type[Prior]
    takes: tuple[str, ...] = ()  # its arguments besides the weight


PRIORS = {
    kind.name: kind
    for kind in (
        PriorKind("quadratic", "Quadratic", "Smooth everywhere, edges too", Quadratic),
        PriorKind("relative-difference", "Relative Difference", "Smooth, but large differences are spared",
                  RelativeDifference, ("gamma", "edge")),
        PriorKind("total-variation", "Total Variation", "Areas of one value with sharp edges", TotalVariation, ("edge",)),
    )
}  # fmt: skip


def taking(argument: str) -> list[str]:
    """Names of the methods that take an argument."""
    return [method.name for method in METHODS.values() if argument in method.takes]
