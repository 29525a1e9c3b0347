"""The judge: all methods on all tests and levels, with the scores of every event, a table and a picture."""

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
from .methods import Family, JudgedMethod, tune
from .recipe import JudgeRecipe, Test
from .records import Records, read_json, write_json
from .report import BASELINE, METHOD, ORACLE, Judgement, write_report
from .scoring import Case, Scores, as_believed, common_defect, measure_cost
from .sets import events_by_recipe, refuse_trained_on, set_fingerprint, short_hash, truths_of
from .summary import compare_scores, mean_scores, row_notes

Row = dict[str, Any]

_SEVERAL = -1
"""Draw number of scores over several draws of noise."""
_PICTURES = 3  # number of tests with a picture


def judge(
    recipe: JudgeRecipe, folder: AnyPath, methods: Sequence[JudgedMethod] = (), progress: Progress | None = None
) -> Judgement:
    """Judge methods beside baselines, and write ``judgement.md``, ``.json`` and ``.png`` into a folder.

    Interrupted work is resumed by the next call: each event's scores are kept in the folder's ``scores``, by method, set,
    event, level and draw, and the baselines' tuning in ``tuning.json``.

    Parameters
    ----------
    recipe
        Tests, validation data and baselines. The caller reads its models and gives them as `methods`.
    folder
        Folder of the results, created if necessary.
    methods
        Networks or any other methods.
    progress
        Called as ``progress(done, total)`` after each volume; may raise `Cancelled`.

    Raises
    ------
    InputError
        A set cannot be read; a method was trained, or baselines would be tuned, on events of a test; a method returns
        another grid than the recipe's; two methods have the same name; or another process judges in this folder.
    """
    folder = ensure_folder(folder)
    names = [method.name for method in methods]
    if len(set(names)) < len(names):
        raise InputError(f"judge: expected methods of different names, got {', '.join(names)}")
    with locked(folder / ".lock", f"{folder}: another process judges in this folder; wait for its end"):
        for place in (folder, ensure_folder(folder / "scores")):
            remove_leftovers(place)
        judgement = _JudgeRun(recipe, folder, methods, progress).judgement()
        write_report(judgement, folder)
    return judgement


class _JudgeRun:
    """A run of the judge: its tests, methods and progress."""

    def __init__(
        self, recipe: JudgeRecipe, folder: Path, methods: Sequence[JudgedMethod], progress: Progress | None
    ) -> None:
        self.recipe, self.folder, self.progress = recipe, folder, progress
        self.validation, *self.tests = (_TestEvents(recipe, test) for test in (recipe.validation, *recipe.tests))
        tuned_on, tuned_truths = events_by_recipe(self.validation.events), truths_of(self.validation.events)
        for test in self.tests:
            refuse_trained_on("baselines", tuned_on, tuned_truths, test.events, test.name)
        self.methods_by_test = {test.name: _named_methods(test, methods) for test in self.tests}
        for test in self.tests:
            for method in self.methods_by_test[test.name]:
                refuse_trained_on(method.name, method.trained_on, method.truths, test.events, test.name)
        self.n_done, self.n_total = 0, sum(map(self._n_volumes, self.tests))
        self.tuning = read_json(folder / "tuning.json")

    def judgement(self) -> Judgement:
        """Compute everything that is not done yet, and return the judgement."""
        rows: list[Row] = []
        pictures: list[tuple[str, list[tuple[str, Volume]]]] = []
        for test in self.tests:
            for level in test.settings["levels"]:
                rows += self._rows(test, level)
            if len(pictures) < _PICTURES:
                pictures.append((test.name, self._picture(test)))
        return Judgement(rows, {test.name: test.record for test in self.tests}, self.tuning, pictures)

    def _n_volumes(self, test: _TestEvents) -> int:
        """Return the number of volumes that a test needs."""
        n_baselines = len(self.recipe.families) * (1 + test.settings["tuned_on_itself"])
        return (n_baselines + len(self.methods_by_test[test.name])) * len(test.events) * len(test.settings["levels"])

    def _report(self, n_more: int) -> None:
        """Report that more volumes are done."""
        self.n_done += n_more
        tell(self.progress, self.n_done, self.n_total)

    def _tuned(self, family: Family, test: _TestEvents, level: float) -> JudgedMethod:
        """Return the best baseline of a family on the events of a test at a level."""
        key = {"family": family.record, "set": set_fingerprint(test.events), "test": test.fingerprint, "level": level}
        name = short_hash(key)
        if name not in self.tuning:
            cases = (test.case(event, level) for event in test.events)
            self.tuning[name] = {**key, **tune(family, cases, lambda *_: self._report(0))}
            write_json(self.folder / "tuning.json", self.tuning)
        return family.method(self.tuning[name]["choice"])

    def _methods(self, test: _TestEvents, level: float) -> list[tuple[str, JudgedMethod]]:
        """Return all methods of a test at a level, each with its kind of row."""
        methods = [(BASELINE, self._tuned(family, self.validation, level)) for family in self.recipe.families]
        if test.settings["tuned_on_itself"]:
            methods += [(ORACLE, self._tuned(family, test, level)) for family in self.recipe.families]
        return methods + [(METHOD, method) for method in self.methods_by_test[test.name]]

    def _rows(self, test: _TestEvents, level: float) -> list[Row]:
        """Return a row for each method, compared with the best baseline and with the best one tuned on the test itself."""
        methods = self._methods(test, level)
        scores = self._scores(test, level, [method for _, method in methods])
        rows: list[Row] = [
            {"test": test.name, "level": level, "method": method.name, "kind": kind, "fingerprint": method.fingerprint,
             **mean_scores(*method_scores)}
            for (kind, method), method_scores in zip(methods, scores, strict=True)
        ]  # fmt: skip
        for kind, name in ((BASELINE, "best_baseline"), (ORACLE, "best_on_itself")):
            if candidates := [i for i, row in enumerate(rows) if row["kind"] == kind]:
                best = min(candidates, key=lambda i: float(rows[i]["nrmse"]))
                for row, (method_scores, _) in zip(rows, scores, strict=True):
                    comparison = compare_scores(method_scores, scores[best][0], self.recipe["judge.seed"])
                    row[name] = {"method": rows[best]["method"], **comparison}
        return [{**row, "notes": row_notes(row)} for row in rows]

    def _scores(
        self, test: _TestEvents, level: float, methods: Sequence[JudgedMethod]
    ) -> list[tuple[list[Row], list[Row]]]:
        """Return each method's scores of all events, and those over draws of noise of some.

        All methods get an event before the next one is read, so that they share what is prepared for it.
        """
        names = (f"{test.fingerprint}-{method.fingerprint[:16]}.jsonl" for method in methods)
        records = [Records(self.folder / "scores" / name) for name in names]
        rows_by_method: list[tuple[list[Row], list[Row]]] = [([], []) for _ in methods]
        scorings = (test.events, 0, test.scores), (test.drawn, _SEVERAL, test.draws)
        for kind, (events, draw, score) in enumerate(scorings):
            for event in events:
                cases = cache(partial(test.case, event, level))  # by the draw of noise, made once for all methods
                key = event.recipe.fingerprint, event.number, level, draw
                for method, record, rows in zip(methods, records, rows_by_method, strict=True):
                    if key not in record:
                        with naming(f"{test.name}: event {event.number}: {method.name}"):
                            record.add(key, score(cases, method))
                    rows[kind].append(record[key])
                    self._report(draw != _SEVERAL)
        return rows_by_method

    def _picture(self, test: _TestEvents) -> list[tuple[str, Volume]]:
        """Return volumes of a test's first event by name: the truth, those of the first baseline and of all methods."""
        level = test.settings["levels"][0]
        case = test.case(test.events[0], level)
        baseline = [method for _, method in self._methods(test, level)][:1]
        methods = {method.name: method for method in (*baseline, *self.methods_by_test[test.name])}
        return [("truth", case.truth), *((name, method.function(case.run)) for name, method in methods.items())]


def _named_methods(test: _TestEvents, methods: Sequence[JudgedMethod]) -> list[JudgedMethod]:
    """Return the methods that a test names, or all methods if it names none."""
    methods_by_name = {method.name: method for method in methods}
    names = test.settings["models"] or tuple(methods_by_name)
    for name in names:
        one_of(name, methods_by_name, f"{test.name}: models")
    return [methods_by_name[name] for name in names]


class _TestEvents:
    """A test of the recipe with its events, and the geometry and physics that methods are told."""

    def __init__(self, recipe: JudgeRecipe, test: Test) -> None:
        self.grid, self.settings, self.name = recipe.grid, test, str(test["name"])
        self.system, self.file = None, ""
        with naming(self.name):
            self.events = recipe.events(test)
            if test["believed"] is not None:
                system, self.file = self.events.recipe.system, str(recipe.folder / test["believed"])
                scanner = read_scanner(self.file, system["system.kind"])
                self.system = chosen_modules(scanner, system["system.modules"], self.file)
            self.defect = common_defect(self.events) if test["scoring"] == "defect" else {}

    @cached_property
    def fingerprint(self) -> str:
        """Hash of everything that scores depend on besides event, level, draw and method."""
        source = None if self.system is None or self.system.source is None else self.system.source.sha256
        settings = [self.settings[name] for name in ("scoring", "model", "believed_model", "draws", "channel_width")]
        return short_hash([*settings, self.grid.shape, self.grid.affine.tolist(), source, self.defect])

    @property
    def record(self) -> dict[str, Any]:
        """Entry of the test in the judgement."""
        record = {"set": set_fingerprint(self.events), "events": len(self.events), "fingerprint": self.fingerprint}
        return record | {name: self.settings[name] for name in ("scoring", "levels", "believed", "believed_model")}

    @property
    def drawn(self) -> EventSet:
        """Events for bias and deviation over draws of noise."""
        return self.events[: self.settings["drawn_events"] if self.settings["draws"] > 1 else 0]

    def case(self, event: Event, level: float, draw: int = 0) -> Case:
        """Return an event at one level and noise draw as methods get it."""
        seed = (event.noise_seed + draw) % 2**64
        run = event.run(self.settings["model"], seed, level)
        if self.settings["believed_model"] is not None:
            run = replace(event.run(self.settings["believed_model"], seed, level), projections=run.projections)
        run = as_believed(run, self.system, self.file)
        return Case(event, run, self.grid, self.settings["channel_width"], self.defect)

    def scores(self, cases: Callable[[int], Case], method: JudgedMethod) -> Scores:
        """Return the scores and the cost of a method's volume of an event; `cases` returns the event by noise draw."""
        case = cases(0)
        with measure_cost() as cost:
            volume = method.function(case.run)
        cost["seconds"] += method.saved()
        return {**case.score(volume, self.settings["scoring"]), **cost}

    def draws(self, cases: Callable[[int], Case], method: JudgedMethod) -> Scores:
        """Return bias and standard deviation over draws of noise: their root mean squares by that of the truth."""
        all_cases = [cases(draw) for draw in range(self.settings["draws"])]
        volumes = bias_and_deviation((method.function(case.run) for case in all_cases), all_cases[0].truth)
        truth = all_cases[0].truth.array
        return {name: nrmse(volume.array + truth, truth) for name, volume in volumes._asdict().items()}
