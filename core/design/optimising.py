"""The search for the best numbers of a design: several starts, coarse to fine, and penalties that grow harder."""

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..arrays import Floats
from ..errors import Cancelled, InputError, expecting, naming
from ..files import AnyPath, read_text, write_bytes
from ..geometry.system import PinholeSystem
from ..progress import Progress, tell
from ..recording import recorded_warnings
from .parameters import Parameters
from .penalties import faults
from .recipe import DesignRecipe, read_design_recipe
from .solvers import SOLVERS, scipy_module

Shown = Callable[[PinholeSystem, float], None]
"""Called as ``callback(system, objective)`` after each step: the best until then, and what the step has reached."""

_STRENGTHS = (1.0, 10.0, 100.0)
"""What a missing mm costs in the rounds, beside an objective of 1 at the start."""
_OUTSIDE = 1e3  # what a scanner that cannot be costs
_TRIES = 200  # to draw a start that can be


@dataclass(frozen=True, eq=False)
class Design:
    """A scanner found by `optimize`."""

    system: PinholeSystem
    start: PinholeSystem
    objective: Floats
    """After each step (n,): the weighted mean of the objectives, each being 1 (or -1) at the start, less penalties."""
    parameters: Mapping[str, float]
    """The free numbers, in the recipe's units."""
    values: Mapping[str, tuple[float, float]]
    """Each objective of the start and of the system."""
    faults: tuple[str, ...]
    """What breaks a constraint, one line each."""

    @property
    def ok(self) -> bool:
        """Whether the scanner passes every check."""
        return not self.faults

    def summary(self) -> list[str]:
        """The free numbers, each objective before and after, and whether it passes every check: a line each."""
        lines = [f"{name} {value:.6g}" for name, value in self.parameters.items()]
        lines += [f"{name}: {first:.5g} at the start, now {last:.5g}" for name, (first, last) in self.values.items()]
        if self.ok:
            return [*lines, f"{len(self.system)} modules that pass every check"]
        return [*lines, f"it fails {len(self.faults)} checks: not a good scanner"]


@dataclass(frozen=True, eq=False)
class Loss:
    """Penalties less objectives, and the gradient, by free numbers (K,) that run from 0 to 1 between their limits."""

    free: Parameters
    terms: Sequence[tuple[float, Any]]  # factors, and what gives value and gradient by the modules' rows

    def __call__(self, x: Floats) -> tuple[float, Floats]:
        """Value and gradient (K,)."""
        values = self.values_at(x)
        system = self.free.build(values)
        found = [(factor, *term(system)) for factor, term in self.terms]
        by_rows = sum(factor * gradient for factor, _, gradient in found)
        gradient = np.einsum("mr,mrk->k", by_rows, self.free.jacobian(values))
        return sum(factor * value for factor, value, _ in found), gradient * (self.free.high - self.free.low)

    def values_at(self, x: Floats) -> Floats:
        """The free numbers in their own units."""
        return self.free.low + np.clip(x, 0.0, 1.0) * (self.free.high - self.free.low)


def optimize(
    recipe: DesignRecipe | AnyPath,
    progress: Progress | None = None,
    state: AnyPath | None = None,
    callback: Shown | None = None,
) -> Design:
    """The scanner that a recipe wants.

    The first search has large voxels and pixels and runs from each start; three rounds from the best of these follow, at
    full resolution, in each of which what a constraint lacks costs ten times as much. All by L-BFGS-B within the limits
    (R. H. Byrd, P. Lu, J. Nocedal, C. Zhu, SIAM J. Sci. Comput. 16 (1995) 1190-1208). The result is checked by
    `check_geometry` and may fail: see `Design.ok`.

    Parameters
    ----------
    recipe
        Or the path of one.
    progress
        Called as ``progress(steps done, steps)``; what it raises stops the work. A `Cancelled` has the best until then as
        its `design`.
    state
        A file (.json) that is written after each step, with which the same call goes on where it was stopped.
    callback
        Called as ``callback(system, objective)`` after each step, with the best scanner until then.

    Raises
    ------
    InputError
        SciPy is missing, the recipe cannot be understood, its start is no scanner, or `state` is that of another recipe.
    """
    recipe = recipe if isinstance(recipe, DesignRecipe) else read_design_recipe(recipe)
    with recorded_warnings():
        search = _Search(recipe, progress, None if state is None else Path(state), callback)
        try:
            search.run()
        except Cancelled as stop:
            stop.design = search.result()
            raise
        return search.result()


class _Search:
    """One call of `optimize`: one search after the other, the first ones from the starts, the rest from what they found."""

    def __init__(self, recipe: DesignRecipe, progress: Progress | None, file: Path | None, callback: Shown | None):
        self._minimize = scipy_module("optimize").minimize
        self._recipe, self._progress, self._file, self._callback = recipe, progress, file, callback
        self._free, self._starts = recipe.parameters, recipe["search.starts"]
        with naming("start"):
            self._system = self._free.build(self._free.start)
        coarse = (recipe["search.coarse"], _STRENGTHS[0], recipe["search.coarse_steps"])
        self._searches = [coarse] * self._starts + [(1, strength, recipe["search.steps"]) for strength in _STRENGTHS]
        # Loss, point and steps of each search, of which the last may not be done; and the merit after each step.
        self._found: list[tuple[float, list[float], int]] = []
        self._merits: list[float] = []
        if file is not None and file.exists():
            self._read(file)

    def run(self) -> None:
        """Do the searches that are not done."""
        for number, (coarse, strength, steps) in enumerate(self._searches):
            self._tell(number)
            if number < len(self._found) - 1:
                continue
            loss = self._loss(coarse, strength)
            if number == len(self._found):
                x = self._drawn(number) if number < self._starts else self._best()
                self._found.append((loss(x)[0], x.tolist(), 0))
            if (done := self._found[-1][2]) < steps:
                self._go_on(loss, number, steps - done)
        self._tell(len(self._searches))

    def result(self) -> Design:
        """The best until now."""
        values = self._values()
        system = self._free.build(values)
        wanted = zip(self._recipe.goals, self._recipe.wanted(), strict=True)
        worth = {name: (objective(self._system)[0], objective(system)[0]) for name, objective in wanted}
        numbers = dict(zip(self._free.names, values.tolist(), strict=True))
        wrong = faults(system, self._recipe.constraints)
        return Design(system, self._system, np.array(self._merits), numbers, worth, wrong)

    def _go_on(self, loss: Loss, number: int, steps: int) -> None:
        good = x0 = np.array(self._found[-1][1])

        def at(x: Floats) -> tuple[float, Floats]:
            nonlocal good
            self._tell(number)
            try:
                found = loss(x)
                good = x.copy()
                return found
            except InputError:  # no scanner: a hill around the last that was one
                return _OUTSIDE * (1 + float(((x - good) ** 2).sum())), 2 * _OUTSIDE * (x - good)

        def after(intermediate_result: Any) -> None:
            value, point = float(intermediate_result.fun), intermediate_result.x
            best, where, done = self._found[-1]
            self._found[-1] = (value, point.tolist(), done + 1) if value <= best else (best, where, done + 1)
            self._merits.append(-value)
            self._write()
            if self._callback is not None:
                self._callback(self._free.build(self._values()), -value)
            self._tell(number)

        solver = SOLVERS[self._recipe.choice("search.solver", SOLVERS)]
        options, bounds = {"maxiter": steps, **solver.options}, [(0.0, 1.0)] * len(x0)
        self._minimize(at, x0, jac=True, method=solver.name, bounds=bounds, callback=after, options=options)

    def _drawn(self, number: int) -> Floats:
        """The point that a search begins with: the recipe's, or one at random that is a scanner."""
        x0 = (self._free.start - self._free.low) / (self._free.high - self._free.low)
        draw = np.random.default_rng((self._recipe["search.seed"], number))
        for x in draw.random((_TRIES if number else 0, len(x0))):
            with suppress(InputError):
                self._free.build(Loss(self._free, ()).values_at(x))
                return x
        return x0

    def _best(self) -> Floats:
        """The point of the last search, or of the first ones the best."""
        those = self._found if len(self._found) <= self._starts else self._found[-1:]
        return np.array(min(those)[1]) if those else self._drawn(0)

    def _values(self) -> Floats:
        """The free numbers of the best point, in their own units."""
        return Loss(self._free, ()).values_at(self._best())

    def _loss(self, coarse: int, strength: float) -> Loss:
        """What a search makes small: each objective is 1 for the start."""
        wanted, weights = self._recipe.wanted(coarse), [goal["weight"] for goal in self._recipe.goals.values()]
        terms: list[tuple[float, Any]] = [(strength, constraint) for constraint in self._recipe.constraints]
        for weight, objective in zip(weights, wanted, strict=True):
            terms.append((-weight / sum(weights) / (abs(objective(self._system)[0]) or 1.0), objective))
        return Loss(self._free, terms)

    def _tell(self, number: int) -> None:
        steps = [steps for *_, steps in self._searches]
        more = self._found[number][2] if number < len(self._found) else 0
        tell(self._progress, sum(steps[:number]) + more, sum(steps))

    def _write(self) -> None:
        if self._file is not None:
            kept = {"recipe": self._recipe.fingerprint, "found": self._found, "merits": self._merits}
            write_bytes(self._file, json.dumps(kept).encode())

    def _read(self, file: Path) -> None:
        with expecting(f"{file}: expected the state of a design", ValueError, KeyError, TypeError):
            kept = json.loads(read_text(file))
            recipe, self._merits, self._found = kept["recipe"], kept["merits"], [tuple(each) for each in kept["found"]]
        if recipe != self._recipe.fingerprint:
            raise InputError(f"{file}: it is the state of another recipe; remove it, or name another file")
