"""The judge: all methods on all tests and levels, every event's scores kept, one table and one picture."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError, naming
from ...events.event_set import Event, EventSet
from ...files import ensure_folder, locked, remove_leftovers
from ...geometry.scanner import Scanner
from ...geometry.system import chosen_modules
from ...progress import Progress, tell
from ...reconstruction.scores.images import bias_and_deviation
from ...runs.run import ProjectionRun
from ...volumes.volume import Volume
from ...workbook import read_scanner
from .methods import JudgedMethod, tuned
from .recipe import JudgeRecipe, Test, read_judge_recipe
from .judgement import Judgement
from .records import Key, Records, read_json, write_json
from .report import write_report
from .scoring import Case, Scores, defect_of, measured, told
from .sets import refuse_trained_on, set_fingerprint, short_hash
from .summary import compared, means_of, told_of

_SEVERAL = -1
"""The draw of scores that are of several draws."""


def judge_recipe(path: str | os.PathLike[str]) -> JudgeRecipe:
    """The judge's recipe in a TOML file; see `read_judge_recipe`."""
    return read_judge_recipe(path)


def judge(
    recipe: JudgeRecipe,
    folder: str | os.PathLike[str],
    methods: Sequence[JudgedMethod] = (),
    progress: Progress | None = None,
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
        A set cannot be read, a method was trained on events of a test, gave another grid than the recipe's, or two methods
        have one name; or another process judges in this folder.
    """
    folder = ensure_folder(folder)
    names = [method.name for method in methods]
    if len(set(names)) < len(names):
        raise InputError(f"judge: expected methods of different names, got {', '.join(names)}")
    with locked(folder / ".lock", f"{folder}: another process judges in this folder; wait for its end"):
        remove_leftovers(ensure_folder(folder / "scores"))
        found = _Judging(recipe, folder, list(methods), progress).judgement()
        write_report(found, folder)
    return found


class _Judging:
    """One work of the judge."""

    def __init__(
        self, recipe: JudgeRecipe, folder: Path, methods: list[JudgedMethod], progress: Progress | None
    ) -> None:
        self.recipe, self.folder, self.methods, self.progress = recipe, folder, methods, progress
        self.tests = [_Tested(recipe, test) for test in recipe.tests]
        for tested, method in ((tested, method) for tested in self.tests for method in methods):
            refuse_trained_on(method.name, method.trained_on, tested.events, tested.test["name"])
        self.done, self.total = 0, sum(map(self._work, self.tests))
        self.tuning = read_json(folder / "tuning.json")

    def judgement(self) -> Judgement:
        """Do all that is not done yet."""
        rows, pictures = [], []
        for tested in self.tests:
            for level in tested.test["levels"]:
                baselines, own = self._baselines(tested, level, False), []
                if tested.test["tuned_on_itself"]:
                    own = self._baselines(tested, level, True)
                every = [*baselines, *own, *self.methods]
                kept = [self._scored(tested, level, method) for method in every]
                rows += self._rows(tested, level, every, kept, len(baselines), len(own))
            best = min(baselines, key=lambda method: self._mean(rows, tested, method), default=None)
            shown = [method for method in (best, *self.methods) if method is not None]
            case = tested.case(tested.events[0], tested.test["levels"][0])
            volumes = [("truth", case.truth), *((method.name, method.function(case.run)) for method in shown)]
            pictures.append((tested.test["name"], volumes))
        return Judgement(rows, {tested.test["name"]: tested.record for tested in self.tests}, self.tuning, pictures[:3])

    def _work(self, tested: _Tested) -> int:
        """How many volumes a test asks for."""
        count = len(self.recipe.families) * (1 + tested.test["tuned_on_itself"]) + len(self.methods)
        return count * len(tested.events) * len(tested.test["levels"])

    def _step(self) -> None:
        self.done += 1
        self._tell()

    def _tell(self) -> None:
        tell(self.progress, self.done, self.total)

    def _baselines(self, tested: _Tested, level: float, on_itself: bool) -> list[JudgedMethod]:
        """A baseline of each family, tuned at a level on the validation data, or on the test's own events."""
        found = []
        for family in self.recipe.families:
            events, model = tested.events, tested.test["model"]
            if not on_itself:
                events, model = self.recipe.validation, self.recipe["validation.model"]
            what = {"family": family.record, "events": set_fingerprint(events), "model": model, "level": level}
            name = short_hash(what)
            if name not in self.tuning:
                cases = _Cases(self.recipe, tested if on_itself else None, events, model, level)
                self.tuning[name] = {**what, **tuned(family, cases, lambda done, total: self._tell())}
                write_json(self.folder / "tuning.json", self.tuning)
            method = family.method(self.tuning[name]["choice"])
            if on_itself:
                method = JudgedMethod(f"{method.name}, tuned on the set", method.function, method.fingerprint)
            found.append(method)
        return found

    def _scored(self, tested: _Tested, level: float, method: JudgedMethod) -> Records:
        """All scores of a method in a test at a level."""
        records = Records(self.folder / "scores" / f"{tested.fingerprint}-{method.fingerprint[:16]}.jsonl")
        for number, event in enumerate(tested.events):
            key = tested.key(event, level)
            if key not in records:
                with naming(f"{tested.test['name']}: event {event.number}: {method.name}"):
                    records.add(key, tested.scores(event, level, method))
            several = tested.key(event, level, _SEVERAL)
            if tested.test["draws"] > 1 and number < tested.test["drawn_events"] and several not in records:
                records.add(several, tested.draws(event, level, method))
            self._step()
        return records

    def _rows(
        self, tested: _Tested, level: float, methods: list[JudgedMethod], kept: list[Records], baselines: int, own: int
    ) -> list[dict[str, Any]]:
        """A row for each method, beside the best baseline and the best of those tuned on the set itself."""
        keys = [tested.key(event, level) for event in tested.events]
        several = [tested.key(event, level, _SEVERAL) for event in tested.events]
        scores = [records.rows(keys) for records in kept]
        found = []
        for i, method in enumerate(methods):
            drawn = [kept[i][key] for key in several if key in kept[i]]
            row = {
                "test": tested.test["name"],
                "level": level,
                "method": method.name,
                "fingerprint": method.fingerprint,
            }
            row |= {"kind": "baseline" if i < baselines else "tuned on the set" if i < baselines + own else "method"}
            found.append(row | means_of(scores[i], drawn))
        for first, last, name in ((0, baselines, "best_baseline"), (baselines, baselines + own, "best_on_itself")):
            if first < last:
                best = min(range(first, last), key=lambda i: found[i]["nrmse"])
                for i, row in enumerate(found):
                    beside = compared(scores[i], scores[best], self.recipe["judge.seed"])
                    row[name] = {"method": methods[best].name, **beside}
        for row in found:
            row["notes"] = told_of(row)
        return found

    @staticmethod
    def _mean(rows: list[dict[str, Any]], tested: _Tested, method: JudgedMethod) -> float:
        return next(r["nrmse"] for r in rows if r["test"] == tested.test["name"] and r["method"] == method.name)


class _Tested:
    """A test with its events."""

    def __init__(self, recipe: JudgeRecipe, test: Test) -> None:
        self.recipe, self.test = recipe, test
        with naming(f"tests: {test['name']}"):
            self.events = recipe.events(test)
            self.system, self.file = _believed(recipe, test, self.events)
            self.defect = defect_of(self.events) if test["scoring"] == "defect" else {}

    @property
    def record(self) -> dict[str, Any]:
        """What the judgement says of the test."""
        return {"set": set_fingerprint(self.events), "events": len(self.events), "scoring": self.test["scoring"],
                "levels": list(self.test["levels"]), "believed": self.test["believed"], "fingerprint": self.fingerprint}  # fmt: skip

    @property
    def fingerprint(self) -> str:
        """What scores depend on besides event, level, draw and method."""
        source = None if self.system is None or self.system.source is None else self.system.source.sha256
        grid = self.recipe.grid
        return short_hash([list(grid.shape), grid.affine.tolist(), source, self.defect,
                           *(self.test[name] for name in ("scoring", "model", "draws", "channel_width"))])  # fmt: skip

    def key(self, event: Event, level: float, draw: int = 0) -> Key:
        """What the scores of an event are kept by."""
        return event.recipe.fingerprint, event.number, level, draw

    def case(self, event: Event, level: float, draw: int = 0) -> Case:
        """An event as methods are asked for it."""
        run = _run(event, self.test["model"], level, draw)
        return Case(event, told(run, self.system, self.file), self.recipe.grid, self.test["channel_width"], self.defect)

    def scores(self, event: Event, level: float, method: JudgedMethod) -> Scores:
        """The scores of a method's volume."""
        case = self.case(event, level)
        with measured() as found:
            volume = method.function(case.run)
        return {**case.score(volume, self.test["scoring"]), **found}

    def draws(self, event: Event, level: float, method: JudgedMethod) -> Scores:
        """Bias and standard deviation over draws of noise: their root mean squares by that of the truth."""
        cases = [self.case(event, level, draw) for draw in range(self.test["draws"])]
        found = bias_and_deviation((method.function(case.run) for case in cases), cases[0].truth)
        rms = float(np.sqrt(np.mean(np.square(cases[0].truth.array))))
        sizes = (float(np.sqrt(np.mean(np.square(volume.array)))) / rms for volume in found)
        return dict(zip(("bias", "deviation"), sizes, strict=True))


class _Cases(Sequence[tuple[ProjectionRun, Volume]]):
    """Runs and truths of events at a level, each made when it is asked for."""

    def __init__(self, recipe: JudgeRecipe, tested: _Tested | None, events: EventSet, model: str, level: float) -> None:
        self.recipe, self.tested, self.events, self.model, self.level = recipe, tested, events, model, level

    def __len__(self) -> int:
        return len(self.events)

    def __getitem__(self, index: Any) -> Any:
        event = self.events[index]
        if self.tested is not None:
            case = self.tested.case(event, self.level)
        else:
            case = Case(event, _run(event, self.model, self.level, 0), self.recipe.grid)
        return case.run, case.truth


def _run(event: Event, model: str, level: float, draw: int) -> ProjectionRun:
    """An event's counts with noise."""
    return event.run(model, (event.noise_seed + draw) % 2**64, level)


def _believed(recipe: JudgeRecipe, test: Test, events: EventSet) -> tuple[Scanner | None, str]:
    """The scanner that methods are told, and its workbook; None for that which made the images."""
    if test["believed"] is None:
        return None, ""
    path = recipe.path(test["believed"])
    chosen = events.recipe.system["system.modules"]
    return chosen_modules(read_scanner(path), chosen, "system.modules"), str(path)
