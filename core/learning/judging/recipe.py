"""Recipes of the judge: tests, validation data, baselines and models, in TOML."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

from ...errors import InputError, naming
from ...events.event_set import EventSet
from ...files import AnyPath
from ...geometry.grid import Grid
from ...recipes.settings import Setting, settings_by_key, table_names, word_labels
from ...recipes.tables import (
    check_entries,
    flat_entries,
    read_table,
    require_name,
    require_value,
    table_entries,
    table_grid,
)
from ...recipes.toml import read_toml
from ...recipes.values import Values
from ...runs.settings import SETTINGS
from .methods import Family
from .scoring import SCORINGS

VERSION = 1

_TEST = settings_by_key((
    Setting("events", str, None, "Folder of the set", is_path=True),
    Setting("split", str, None, "Its split that counts", "all events"),
    Setting("model", str, "emission", "Which of its images"),
    Setting("count", int, None, "How many events, the first ones", "all", least=1),
    Setting("name", str, None, "What the table calls it"),
    Setting("models", str, None, "Names of the models that are judged on it", "all", sizes=()),
    Setting("scoring", str, "volumes", "What is scored besides the voxels",
            words=word_labels(SCORINGS)),
    Setting("levels", float, (1.0,), "Shares of the acquisition time", above=0, sizes=()),
    Setting("believed", str, None, "Workbook of the geometry that methods are told", "that which made the images",
            is_path=True),
    Setting("believed_model", str, None, "Model of the set whose physics methods are told", "that of the images"),
    Setting("tuned_on_itself", bool, False, "Also judge baselines that are tuned on the test's own events"),
    Setting("draws", int, 0, "Draws of noise of which bias and standard deviation are taken; 0: neither", least=0),
    Setting("drawn_events", int, 3, "Events, the first ones, that bias and deviation are of", least=1),
    Setting("channel_width", float, 30.0, "Of the observer's channels", unit="mm", above=0),
))  # fmt: skip
_ROWS = settings_by_key((
    SETTINGS["phantom.voxels"].with_key("grid.voxels"),
    SETTINGS["phantom.spacing"].with_key("grid.spacing"),
    SETTINGS["phantom.position"].with_key("grid.center", text="Middle of the volumes, x y z"),
    Setting("baselines.subsets", int, 10, "Of OSEM and BSREM", least=1),
    Setting("baselines.stops", int, (2, 4, 8, 12, 16, 24), "Iterations of OSEM to choose from", least=1, sizes=()),
    Setting("baselines.fwhm", float, (0.0, 2.4, 3.6, 4.8, 6.5, 8.0, 10.0), "Widths of the filter after it to choose from",
            unit="mm", least=0, sizes=()),
    Setting("baselines.iterations", int, 15, "Of BSREM", least=1),
    Setting("baselines.weights", float, (0.0003, 0.001, 0.003, 0.01, 0.03, 0.1), "Of BSREM's prior to choose from; it has "
            "relative differences", above=0, sizes=()),
    Setting("baselines.families", str, ("osem", "bsrem"), "Which there are", words=word_labels(("osem", "bsrem")), sizes=()),
    Setting("judge.seed", int, 0, "Of the bootstrap", least=0),
))  # fmt: skip
_TABLES = table_names(_ROWS)


class Test(Values):
    """A test: events, and what is scored of them."""

    rows = _TEST  # type: ignore[assignment]
    __test__ = False  # for pytest


@dataclass(frozen=True)
class JudgeRecipe(Values):
    """What the judge does: values of settings by their keys, and tables; `InputError` names what cannot be understood.

    Parameters
    ----------
    given
        The values of settings, such as that of "baselines.subsets".
    values
        The recipe's tables, of which those of tests, validation and models are read here.
    folder
        The paths in the recipe are relative to it.
    """

    rows = _ROWS  # type: ignore[assignment]
    values: Mapping[str, Any] = field(default_factory=dict)
    folder: Path = Path()

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.grid, self.tests, self.validation, self.models, self.families

    @cached_property
    def grid(self) -> Grid:
        """The voxels that all methods give."""
        return table_grid(self, "grid")

    @cached_property
    def tests(self) -> list[Test]:
        """The tests."""
        entries = self.values.get("tests")
        if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
            raise InputError("tests: expected one [[tests]] or more")
        found = [self._test(entry, f"tests: {entry.get('name', number)}") for number, entry in enumerate(entries, 1)]
        names = [require_name(test["name"], "tests: name") for test in found]
        if len(set(names)) < len(names):
            raise InputError(f"tests: expected different names, got {', '.join(names)}")
        return found

    @cached_property
    def validation(self) -> Test:
        """The events that baselines are tuned on."""
        return self._test({"name": "validation", **read_table(self.values, "validation")}, "validation")

    @cached_property
    def models(self) -> dict[str, Path]:
        """The models' files by the names that the table gives them."""
        models = read_table(self.values, "models")
        for name, file in models.items():
            if not isinstance(file, str) or not file:
                raise InputError(f"models.{name}: expected a file's name, got {file!r}")
        return {name: self.folder / file for name, file in models.items()}

    @cached_property
    def families(self) -> list[Family]:
        """The baselines of which one each is chosen on the validation data."""
        stops, widths, weights = (self[f"baselines.{name}"] for name in ("stops", "fwhm", "weights"))
        known = {"osem": (max(stops), tuple(product(stops, widths))),
                 "bsrem": (self["baselines.iterations"], tuple((weight,) for weight in weights))}  # fmt: skip
        names, subsets = self["baselines.families"], self["baselines.subsets"]
        return [Family(name, self.grid, known[name][0], subsets, known[name][1]) for name in names]

    def events(self, test: Test) -> EventSet:
        """The events of a test, or of the validation data."""
        events, split = EventSet(self.folder / test["events"]), test["split"]
        events = events if split is None else events.split(split)
        if not len(events):
            raise InputError(f"events: {self.folder / test['events']} holds none")
        return events[: test["count"]]

    def _test(self, entry: dict[str, Any], name: str) -> Test:
        with naming(name):
            found = Test(flat_entries(entry, _TEST))
            require_value(found["events"], "events", "name the folder of the set")
            return found


def read_judge_recipe(path: AnyPath) -> JudgeRecipe:
    """The judge's recipe in a TOML file; paths in it are relative to its folder. `InputError` names the entry."""
    with naming(path):
        values = read_toml(path)
        check_entries(values, VERSION, ("version", "tests", "models", "validation", *_TABLES))
        return JudgeRecipe(table_entries(values, _ROWS), values, Path(path).absolute().parent)
