"""Search for the best free parameters of a design: several starts, coarse to fine, with increasing penalties."""

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
from .parameters import FreeParameters
from .penalties import faults
from .recipe import DesignRecipe, read_design_recipe
from .solvers import SOLVERS, scipy_module

StepHook = Callable[[PinholeSystem, float], None]
"""Callback ``callback(system, objective)`` after each step, with the best scanner so far and the step's objective."""

_PENALTY_WEIGHTS = (1.0, 10.0, 100.0)  # loss per squared mm of violation in each round; the objective is 1 at the start
_IMPOSSIBLE_LOSS = 1e3  # loss of parameters for which there is no scanner
_MAX_DRAWS = 200  # random starts that are tried until one is a scanner


@dataclass(frozen=True, eq=False)
class Design:
    """Result of `optimize`: the best scanner, and how it compares with the start."""

    system: PinholeSystem
    """Best scanner of the search."""
    start: PinholeSystem
    """Scanner at the start of the search."""
    objective: Floats
    """Weighted mean of the objectives, each 1 (or -1) at the start, minus the penalties, after each step (n,)."""
    parameters: Mapping[str, float]
    """Free parameters of the best scanner, by name, in the recipe's units."""
    values: Mapping[str, tuple[float, float]]
    """Value of each objective for the start and for the best scanner."""
    faults: tuple[str, ...]
    """Violations of constraints and faults of the geometry, one line each."""

    @property
    def ok(self) -> bool:
        """Whether the best scanner passes every check."""
        return not self.faults

    def summary(self) -> list[str]:
        """Return lines with each free parameter, each objective at the start and now, and whether all checks are passed."""
        lines = [f"{name} {value:.6g}" for name, value in self.parameters.items()]
        lines += [f"{name}: {first:.5g} at the start, now {last:.5g}" for name, (first, last) in self.values.items()]
        if self.ok:
            return [*lines, f"{len(self.system)} modules that pass every check"]
        return [*lines, f"it fails {len(self.faults)} checks: not a good scanner"]


@dataclass(frozen=True, eq=False)
class DesignLoss:
    """Loss that the search minimises: a weighted sum of penalties and negative objectives.

    Its argument x (K,) are the free parameters, scaled to run from 0 to 1 between their limits.
    """

    free: FreeParameters
    """Free parameters of the design."""
    terms: Sequence[tuple[float, Any]]
    """Factor of each objective or constraint, and the function that returns its value and gradient by the rows."""

    def __call__(self, x: Floats) -> tuple[float, Floats]:
        """Return the loss and its gradient (K,) by x."""
        values = self.values_at(x)
        system = self.free.build(values)
        results = [(factor, *term(system)) for factor, term in self.terms]
        d_rows = sum(factor * gradient for factor, _, gradient in results)
        gradient = np.einsum("mr,mrk->k", d_rows, self.free.jacobian(values))
        return sum(factor * value for factor, value, _ in results), gradient * (self.free.high - self.free.low)

    def values_at(self, x: Floats) -> Floats:
        """Return the free parameters (K,) of x in the recipe's units."""
        return self.free.low + np.clip(x, 0.0, 1.0) * (self.free.high - self.free.low)


def optimize(
    recipe: DesignRecipe | AnyPath,
    progress: Progress | None = None,
    state: AnyPath | None = None,
    callback: StepHook | None = None,
) -> Design:
    """Find the scanner with the best objectives of a recipe, within the limits of its free parameters.

    A coarse search with large voxels and pixels runs from each start. Three rounds at full resolution follow from the best
    of these; from round to round, penalties for violated constraints increase by a factor of 10. All searches are by
    L-BFGS-B within the limits (R. H. Byrd, P. Lu, J. Nocedal, C. Zhu, SIAM J. Sci. Comput. 16 (1995) 1190-1208). The result
    is checked by `check_geometry` and may fail: see `Design.ok`.

    Parameters
    ----------
    recipe
        Recipe of the design, or the path of its file.
    progress
        Called as ``progress(steps done, steps)``; an exception that it raises stops the work. A `Cancelled` gets the best
        result so far as its `design`.
    state
        Path of a file (.json) that is written after each step; with it, the same call continues a stopped search.
    callback
        Called as ``callback(system, objective)`` after each step, with the best scanner so far.

    Raises
    ------
    InputError
        SciPy is missing, the recipe cannot be understood, its start is not a scanner, or `state` is that of another recipe.
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
    """State of one call of `optimize`: coarse searches from each start, then rounds from the best result of these."""

    def __init__(self, recipe: DesignRecipe, progress: Progress | None, file: Path | None, callback: StepHook | None):
        """Prepare the searches; continue with those of the state `file`, if it exists."""
        self._minimize = scipy_module("optimize").minimize
        self._recipe, self._progress, self._file, self._callback = recipe, progress, file, callback
        self._free, self._n_starts = recipe.parameters, recipe["search.starts"]
        with naming("start"):
            self._start = self._free.build(self._free.start)
        coarse = (recipe["search.coarse"], _PENALTY_WEIGHTS[0], recipe["search.coarse_steps"])
        # Coarsening, penalty weight and number of steps of each search.
        self._searches = [coarse] * self._n_starts + [(1, w, recipe["search.steps"]) for w in _PENALTY_WEIGHTS]
        # Lowest loss, its x, and steps done of each begun search; all but the last are finished.
        self._results: list[tuple[float, list[float], int]] = []
        self._merits: list[float] = []  # minus the loss, after each step
        if file is not None and file.exists():
            self._read_state(file)

    def run(self) -> None:
        """Run the searches that are not finished."""
        for number, (coarse, weight, steps) in enumerate(self._searches):
            self._tell_progress(number)
            if number < len(self._results) - 1:
                continue
            loss = self._loss(coarse, weight)
            if number == len(self._results):
                x = self._draw_start(number) if number < self._n_starts else self._best_x()
                self._results.append((loss(x)[0], x.tolist(), 0))
            if (steps_done := self._results[-1][2]) < steps:
                self._minimize_loss(loss, number, steps - steps_done)
        self._tell_progress(len(self._searches))

    def result(self) -> Design:
        """Return the best result so far as a `Design`."""
        parameters = self._best_parameters()
        system = self._free.build(parameters)
        objectives = zip(self._recipe.goals, self._recipe.wanted(), strict=True)
        values = {name: (objective(self._start)[0], objective(system)[0]) for name, objective in objectives}
        free = dict(zip(self._free.names, parameters.tolist(), strict=True))
        merits, lines = np.array(self._merits), faults(system, self._recipe.constraints)
        return Design(system, self._start, merits, free, values, lines)

    def _minimize_loss(self, loss: DesignLoss, number: int, steps: int) -> None:
        """Run or continue search `number` for at most `steps` steps of L-BFGS-B from its best x."""
        last_valid = x0 = np.array(self._results[-1][1])

        def evaluate(x: Floats) -> tuple[float, Floats]:
            """Return loss and gradient; where there is no scanner, those of a paraboloid around the last x that had one."""
            nonlocal last_valid
            self._tell_progress(number)
            try:
                value_and_gradient = loss(x)
                last_valid = x.copy()
                return value_and_gradient
            except InputError:
                d = x - last_valid
                return _IMPOSSIBLE_LOSS * (1 + float((d**2).sum())), 2 * _IMPOSSIBLE_LOSS * d

        def record(intermediate_result: Any) -> None:  # SciPy requires this argument's name
            """Record the step's result, write the state, and call the callback."""
            value, x = float(intermediate_result.fun), intermediate_result.x
            best, best_x, n_steps = self._results[-1]
            self._results[-1] = (value, x.tolist(), n_steps + 1) if value <= best else (best, best_x, n_steps + 1)
            self._merits.append(-value)
            self._write_state()
            if self._callback is not None:
                self._callback(self._free.build(self._best_parameters()), -value)
            self._tell_progress(number)

        solver = SOLVERS[self._recipe.choice("search.solver", SOLVERS)]
        options, bounds = {"maxiter": steps, **solver.options}, [(0.0, 1.0)] * len(x0)
        self._minimize(evaluate, x0, jac=True, method=solver.name, bounds=bounds, callback=record, options=options)

    def _draw_start(self, number: int) -> Floats:
        """Return the x from which search `number` starts: the recipe's for the first, else a random one with a scanner."""
        x0 = (self._free.start - self._free.low) / (self._free.high - self._free.low)
        rng = np.random.default_rng((self._recipe["search.seed"], number))
        for x in rng.random((_MAX_DRAWS if number else 0, len(x0))):
            with suppress(InputError):
                self._free.build(DesignLoss(self._free, ()).values_at(x))
                return x
        return x0

    def _best_x(self) -> Floats:
        """Return the x of the last round, or before the rounds the best x of all starts."""
        results = self._results if len(self._results) <= self._n_starts else self._results[-1:]
        return np.array(min(results)[1]) if results else self._draw_start(0)

    def _best_parameters(self) -> Floats:
        """Return the free parameters (K,) of the best x, in the recipe's units."""
        return DesignLoss(self._free, ()).values_at(self._best_x())

    def _loss(self, coarse: int, penalty_weight: float) -> DesignLoss:
        """Return the loss of a search, with each objective scaled to 1 for the start."""
        weights = [goal["weight"] for goal in self._recipe.goals.values()]
        terms: list[tuple[float, Any]] = [(penalty_weight, constraint) for constraint in self._recipe.constraints]
        for weight, objective in zip(weights, self._recipe.wanted(coarse), strict=True):
            terms.append((-weight / sum(weights) / (abs(objective(self._start)[0]) or 1.0), objective))
        return DesignLoss(self._free, terms)

    def _tell_progress(self, number: int) -> None:
        """Report the steps done so far, in search `number`, to the progress callback."""
        steps = [steps for *_, steps in self._searches]
        steps_done = self._results[number][2] if number < len(self._results) else 0
        tell(self._progress, sum(steps[:number]) + steps_done, sum(steps))

    def _write_state(self) -> None:
        """Write the state file, if there is one."""
        if self._file is not None:
            state = {"recipe": self._recipe.fingerprint, "found": self._results, "merits": self._merits}
            write_bytes(self._file, json.dumps(state).encode())

    def _read_state(self, file: Path) -> None:
        """Read results and merits of a stopped search; raise `InputError` if they are of another recipe."""
        with expecting(f"{file}: expected the state of a design", ValueError, KeyError, TypeError):
            state = json.loads(read_text(file))
            recipe, self._merits, self._results = state["recipe"], state["merits"], list(map(tuple, state["found"]))
        if recipe != self._recipe.fingerprint:
            raise InputError(f"{file}: it is the state of another recipe; remove it, or name another file")
