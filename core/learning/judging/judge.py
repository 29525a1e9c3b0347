"""The judge: all methods on all tests and levels, every event's scores kept, one table and one picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

from ...errors import InputError, naming
from ...events.event_set import Event, EventSet
from ...files import AnyPath, ensure_folder, locked, remove_leftovers
from ...geometry.system import chosen_modules
from ...progress import Progress, tell
from ...reconstruction.scores.images import bias_and_deviation, nrmse
from ...validation import one_of
from ...volumes.volume import Volume
from ...workbook import read_scanner
from .methods import Family, JudgedMethod, tuned
from .recipe import JudgeRecipe, Test
from .records import Records, read_json, write_json
from .report import BASELINE, METHOD, ORACLE, Judgement, write_report
from .scoring import Case, Scores, defect_of, measured, told
from .sets import events_by_recipe, refuse_trained_on, set_fingerprint, short_hash
from .summary import compared, means_of, told_of

Row = dict[str, Any]

_SEVERAL = -1
"""The draw of scores that are of several draws."""
_PICTURES = 3


def judge(
    recipe: JudgeRecipe, folder: AnyPath, methods: Sequence[JudgedMethod] = (), progress: Progress | None = None
) -> Judgement:
    """Judge methods beside baselines, and write ``judgement.md``, ``.json`` and ``.png`` into a folder.

    Work that was interrupted goes on where it stopped: each event's scores are kept in the folder's ``scores``, by method,
    set, event, level and draw, and what baselines were tuned to in ``tuning.json``.

    Parameters
    ----------
    recipe
        Tests, validation data and baselines. Its models are to be read by the caller, into `methods`.
    folder
        Made where it is not there.
    methods
        Networks or any others.
    progress
        Called as ``progress(done, total)`` after each volume; may raise `Cancelled`.

    Raises
    ------
    InputError
        A set cannot be read; a method was trained, or baselines would be tuned, on events of a test; a method gives
        another grid than the recipe's; two methods have one name; or another process judges in this folder.
    """
    folder = ensure_folder(folder)
    names = [method.name for method in methods]
    if len(set(names)) < len(names):
        raise InputError(f"judge: expected methods of different names, got {', '.join(names)}")
    with locked(folder / ".lock", f"{folder}: another process judges in this folder; wait for its end"):
        remove_leftovers(ensure_folder(folder / "scores"))
        found = _Judging(recipe, folder, methods, progress).judgement()
        write_report(found, folder)
    return found


class _Judging:
    """One work of the judge."""

    def __init__(
        self, recipe: JudgeRecipe, folder: Path, methods: Sequence[JudgedMethod], progress: Progress | None
    ) -> None:
        self.recipe, self.folder, self.progress = recipe, folder, progress
        self.validation, *self.tests = (_Tested(recipe, test) for test in (recipe.validation, *recipe.tests))
        tuned_on = events_by_recipe(self.validation.events)
        for tested in self.tests:
            refuse_trained_on("baselines", tuned_on, tested.events, tested.name)
        self.chosen = {tested.name: _chosen(tested, methods) for tested in self.tests}
        for tested in self.tests:
            for method in self.chosen[tested.name]:
                refuse_trained_on(method.name, method.trained_on, tested.events, tested.name)
        self.done, self.total = 0, sum(map(self._volumes, self.tests))
        self.tuning = read_json(folder / "tuning.json")

    def judgement(self) -> Judgement:
        """Do all that is not done yet."""
        rows: list[Row] = []
        pictures: list[tuple[str, list[tuple[str, Volume]]]] = []
        for tested in self.tests:
            for level in tested.test["levels"]:
                rows += self._rows(tested, level)
            if len(pictures) < _PICTURES:
                pictures.append((tested.name, self._picture(tested)))
        return Judgement(rows, {tested.name: tested.record for tested in self.tests}, self.tuning, pictures)

    def _volumes(self, tested: _Tested) -> int:
        """How many volumes a test asks for."""
        methods = len(self.recipe.families) * (1 + tested.test["tuned_on_itself"])
        methods += len(self.chosen[tested.name])
        return methods * len(tested.events) * len(tested.test["levels"])

    def _tell(self, more: int) -> None:
        self.done += more
        tell(self.progress, self.done, self.total)

    def _tuned(self, family: Family, on: _Tested, level: float) -> JudgedMethod:
        """The baseline of a family that does best on events at a level."""
        what = {"family": family.record, "set": set_fingerprint(on.events), "test": on.fingerprint, "level": level}
        name = short_hash(what)
        if name not in self.tuning:
            cases = (on.case(event, level) for event in on.events)
            self.tuning[name] = {**what, **tuned(family, cases, lambda *_: self._tell(0))}
            write_json(self.folder / "tuning.json", self.tuning)
        return family.method(self.tuning[name]["choice"])

    def _methods(self, tested: _Tested, level: float) -> list[tuple[str, JudgedMethod]]:
        """All methods of a test at a level, each with its kind."""
        found = [(BASELINE, self._tuned(family, self.validation, level)) for family in self.recipe.families]
        if tested.test["tuned_on_itself"]:
            found += [(ORACLE, self._tuned(family, tested, level)) for family in self.recipe.families]
        return found + [(METHOD, method) for method in self.chosen[tested.name]]

    def _rows(self, tested: _Tested, level: float) -> list[Row]:
        """A row for each method, beside the best baseline and the best of those tuned on the set itself."""
        methods = self._methods(tested, level)
        scores = self._scores(tested, level, [method for _, method in methods])
        found: list[Row] = [
            {"test": tested.name, "level": level, "method": method.name, "kind": kind, "fingerprint": method.fingerprint,
             **means_of(*own)}
            for (kind, method), own in zip(methods, scores, strict=True)
        ]  # fmt: skip
        for kind, name in ((BASELINE, "best_baseline"), (ORACLE, "best_on_itself")):
            known = [i for i, row in enumerate(found) if row["kind"] == kind]
            if known:
                best = min(known, key=lambda i: float(found[i]["nrmse"]))
                for row, (own, _) in zip(found, scores, strict=True):
                    beside = compared(own, scores[best][0], self.recipe["judge.seed"])
                    row[name] = {"method": found[best]["method"], **beside}
        return [{**row, "notes": told_of(row)} for row in found]

    def _scores(
        self, tested: _Tested, level: float, methods: Sequence[JudgedMethod]
    ) -> list[tuple[list[Row], list[Row]]]:
        """Each method's scores of all events, and those over draws of noise of some.

        All methods are asked for an event before the next, so that they share what it is read and made for.
        """
        names = (f"{tested.fingerprint}-{method.fingerprint[:16]}.jsonl" for method in methods)
        records = [Records(self.folder / "scores" / name) for name in names]
        found: list[tuple[list[Row], list[Row]]] = [([], []) for _ in methods]
        for part, (events, draw, score) in enumerate(
            ((tested.events, 0, tested.scores), (tested.drawn, _SEVERAL, tested.draws))
        ):
            for event in events:
                cases = cache(partial(tested.case, event, level))  # by the draw of noise, made once for all methods
                key = event.recipe.fingerprint, event.number, level, draw
                for method, kept, rows in zip(methods, records, found, strict=True):
                    if key not in kept:
                        with naming(f"{tested.name}: event {event.number}: {method.name}"):
                            kept.add(key, score(cases, method))
                    rows[part].append(kept[key])
                    self._tell(draw != _SEVERAL)
        return found

    def _picture(self, tested: _Tested) -> list[tuple[str, Volume]]:
        """The first event of a test: the truth, the first baseline's volume and those of all methods."""
        level = tested.test["levels"][0]
        case = tested.case(tested.events[0], level)
        first = [method for _, method in self._methods(tested, level)][:1]
        shown = {method.name: method for method in (*first, *self.chosen[tested.name])}
        return [("truth", case.truth), *((name, method.function(case.run)) for name, method in shown.items())]


def _chosen(tested: _Tested, methods: Sequence[JudgedMethod]) -> list[JudgedMethod]:
    """The methods that a test names, of those that there are; without names all."""
    known = {method.name: method for method in methods}
    names = tested.test["models"] or tuple(known)
    for name in names:
        one_of(name, known, f"{tested.name}: models")
    return [known[name] for name in names]


class _Tested:
    """A test with its events."""

    def __init__(self, recipe: JudgeRecipe, test: Test) -> None:
        self.grid, self.test, self.name = recipe.grid, test, str(test["name"])
        self.system, self.file = None, ""
        with naming(self.name):
            self.events = recipe.events(test)
            if test["believed"] is not None:
                own, self.file = self.events.recipe.system, str(recipe.folder / test["believed"])
                scanner = read_scanner(self.file, own["system.kind"])
                self.system = chosen_modules(scanner, own["system.modules"], self.file)
            self.defect = defect_of(self.events) if test["scoring"] == "defect" else {}

    @cached_property
    def fingerprint(self) -> str:
        """What scores depend on besides event, level, draw and method."""
        source = None if self.system is None or self.system.source is None else self.system.source.sha256
        own = [self.test[name] for name in ("scoring", "model", "believed_model", "draws", "channel_width")]
        return short_hash([*own, self.grid.shape, self.grid.affine.tolist(), source, self.defect])

    @property
    def record(self) -> dict[str, Any]:
        """What the judgement says of the test."""
        own = {name: self.test[name] for name in ("scoring", "levels", "believed", "believed_model")}
        return {"set": set_fingerprint(self.events), "events": len(self.events), "fingerprint": self.fingerprint, **own}

    @property
    def drawn(self) -> EventSet:
        """The events of which bias and deviation over draws of noise are taken."""
        return self.events[: self.test["drawn_events"] if self.test["draws"] > 1 else 0]

    def case(self, event: Event, level: float, draw: int = 0) -> Case:
        """An event as methods are asked for it."""
        seed = (event.noise_seed + draw) % 2**64
        run = event.run(self.test["model"], seed, level)
        if self.test["believed_model"] is not None:
            run = replace(event.run(self.test["believed_model"], seed, level), projections=run.projections)
        return Case(event, told(run, self.system, self.file), self.grid, self.test["channel_width"], self.defect)

    def scores(self, cases: Callable[[int], Case], method: JudgedMethod) -> Scores:
        """The scores of a method's volume."""
        case = cases(0)
        with measured() as found:
            volume = method.function(case.run)
        found["seconds"] += method.saved()
        return {**case.score(volume, self.test["scoring"]), **found}

    def draws(self, of_draw: Callable[[int], Case], method: JudgedMethod) -> Scores:
        """Bias and standard deviation over draws of noise: their root mean squares by that of the truth."""
        cases = [of_draw(draw) for draw in range(self.test["draws"])]
        found = bias_and_deviation((method.function(case.run) for case in cases), cases[0].truth)
        truth = cases[0].truth.array
        return {name: nrmse(volume.array + truth, truth) for name, volume in found._asdict().items()}
