"""Table of the methods of reconstruction, and the settings that follow from it and from the table of priors.

`METHODS` here and `PRIORS` in `priors.py` are the only lists: recipes, options of ``mphdrr reconstruct`` and Blender's panel
follow from them, and from the arguments of their functions (`arguments.argument`).
"""

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import naming
from ..geometry.grid import Grid
from ..recipes.settings import Setting, alternatives
from .arguments import ARGUMENTS, Choice
from .bsrem import bsrem
from .expectation import mlem, osem
from .least_squares import cgls, sirt
from .loop import IterativeOptions
from .method_files import METHOD_FILES
from .ostr import ostr
from .priors import PRIORS
from .result import Reconstruction
from .tv import tv


@dataclass(frozen=True)
class Method(Choice):
    """Method of reconstruction: ``function(A, images, ...)`` with a `Projector` returns a `Reconstruction`.

    The arguments after these two are settings ``reconstruction.<name>``, except those of `IterativeOptions`.
    """

    function: Callable[..., Reconstruction]
    of_counts: bool = True
    """Whether the images must be counts; else any images are allowed."""
    objective: str = "log-likelihood"
    """Name of the quantity in `Reconstruction.objective`; "" if there is none."""
    grid: Grid | None = None
    """The only grid that the method reconstructs on; None for any grid."""

    first = 2
    common = IterativeOptions.__annotations__

    def takes(self, name: str) -> bool:
        """Return whether the function has an argument of this name."""
        arguments = inspect.signature(self.function).parameters.values()
        return any(a.name == name or (a.kind == a.VAR_KEYWORD and name in self.common) for a in arguments)


METHODS: Mapping[str, Method] = {
    "osem": Method("OSEM", "Maximum likelihood of activity, by subsets of the modules (fast)", osem),
    "mlem": Method("MLEM", "Maximum likelihood of activity, with all modules at once (slow, likelihood never falls)", mlem),
    "bsrem": Method("BSREM", "Maximum of likelihood and prior for activity, converges to the maximum", bsrem),
    "sirt": Method("SIRT", "Least squares of line integrals, slow and robust", sirt, False, "squared error"),
    "cgls": Method("CGLS", "Least squares of line integrals, fast; values may be negative", cgls, False, "squared error"),
    "tv": Method("TV", "Least squares of line integrals with uniform areas and sharp edges", tv, False,
                 "squared error with variation"),
    "ostr": Method("OSTR", "Maximum of likelihood and prior for attenuation, from transmitted photons", ostr, False),
}  # fmt: skip
"""Methods by their names in recipes and on the command line."""


def method_of(name: str) -> Method:
    """Return the method with this name in `METHODS`, or read it from the file `name`; raise `InputError` otherwise."""
    if name in METHODS:
        return METHODS[name]
    with naming(name):
        return METHOD_FILES[Path(name).suffix.lower()](Path(name))  # type: ignore[no-any-return]


def argument_settings(order: Iterable[str]) -> dict[str, Setting]:
    """Return the settings of the declared arguments by the arguments' names: those in `order`, then the others.

    A setting has an effect if the chosen prior or method takes the argument. If priors and methods differ in the argument's
    default, the setting has no default, and its help lists theirs.
    """
    settings = {}
    for name in dict.fromkeys((*order, *ARGUMENTS)):
        needs: list[str] = []
        defaults: dict[str, Any] = {}
        for key, choices in (("reconstruction.prior", PRIORS), ("reconstruction.method", METHODS)):
            takers = {word: choice for word, choice in choices.items() if name in choice.own}
            needs += [alternatives(key, takers)] if takers else []
            defaults |= {choice.label: choice.own[name] for choice in takers.values()}
        row, values = ARGUMENTS[name], set(defaults.values()) - {None, inspect.Parameter.empty}
        listed = (
            ": " + ", ".join(f"{label} {default:g}" for label, default in defaults.items()) if len(values) > 1 else ""
        )
        default = values.pop() if len(values) == 1 else None
        settings[name] = replace(row, default=default, absent=row.absent + listed, needs=(" or ".join(needs),))
    return settings
