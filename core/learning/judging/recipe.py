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
from ...recipes.tables import check_entries, flat_entries, read_table, require_name, require_value, table_entries
from ...recipes.toml import read_toml
from ...recipes.values import Values
from ...runs.settings import SETTINGS
from .methods import Family
from .scoring import SCORINGS

VERSION = 1

_TEST = settings_by_key((
    Setting("events", str, None, "Folder of the set", is_path=True),
    Setting("split", str, None, "Split of the set that is used", "all events"),
    Setting("model", str, "emission", "Model of the set whose images are used"),
    Setting("count", int, None, "Number of events, the first ones of the set", "all", least=1),
    Setting("name", str, None, "Name in the table"),
    Setting("models", str, None, "Names of the models that are judged on this test", "all", sizes=()),
    Setting("scoring", str, "volumes", "Scores besides those of the voxels",
            words=word_labels(SCORINGS)),
    Setting("levels", float, (1.0,), "Shares of the acquisition time", above=0, sizes=()),
    Setting("believed", str, None, "Workbook of the geometry that methods are told", "that of the images",
            is_path=True),
    Setting("believed_model", str, None, "Model of the set whose physics methods are told", "that of the images"),
    Setting("tuned_on_itself", bool, False, "Also judge baselines that are tuned on the test's own events"),
    Setting("draws", int, 0, "Draws of noise for bias and standard deviation; 0: neither", least=0),
    Setting("drawn_events", int, 3, "Number of events, the first ones, for bias and deviation", least=1),
    Setting("channel_width", float, 30.0, "Width of the observer's channels", unit="mm", above=0),
))  # fmt: skip
_ROWS = settings_by_key((
    SETTINGS["phantom.voxels"].with_key("grid.voxels"),
    SETTINGS["phantom.spacing"].with_key("grid.spacing"),
    SETTINGS["phantom.position"].with_key("grid.center", text="Centre of the volumes, x y z"),
    Setting("baselines.subsets", int, 10, "Number of subsets of OSEM and BSREM", least=1),
    Setting("baselines.stops", int, (2, 4, 8, 12, 16, 24), "Iterations of OSEM to choose from", least=1, sizes=()),
    Setting("baselines.fwhm", float, (0.0, 2.4, 3.6, 4.8, 6.5, 8.0, 10.0), "Widths of the filter after OSEM to choose from",
            unit="mm", least=0, sizes=()),
    Setting("baselines.iterations", int, 15, "Iterations of BSREM", least=1),
    Setting("baselines.weights", float, (0.0003, 0.001, 0.003, 0.01, 0.03, 0.1), "Weights of BSREM's prior, of relative "
            "differences, to choose from", above=0, sizes=()),
    Setting("baselines.families", str, ("osem", "bsrem"), "Families of baselines", words=word_labels(("osem", "bsrem")),
            sizes=()),
    Setting("judge.seed", int, 0, "Seed of the bootstrap", least=0),
))  # fmt: skip
_TABLES = table_names(_ROWS)


class Test(Values):
    """A test: its events, and what is scored of the volumes."""

    rows = _TEST  # type: ignore[assignment]
    __test__ = False  # no test class for pytest


@dataclass(frozen=True)
class JudgeRecipe(Values):
    """Recipe of the judge: values of settings by their keys, and tables; `InputError` names what cannot be understood.

    Parameters
    ----------
    given
        Values of settings, such as that of "baselines.subsets".
    values
        Tables of the recipe, of which those of tests, validation and models are read here.
    folder
        Folder to which the paths in the recipe are relative.
    """

    rows = _ROWS  # type: ignore[assignment]
    values: Mapping[str, Any] = field(default_factory=dict)
    folder: Path = Path()

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = self.grid, self.tests, self.validation, self.models, self.families

    @cached_property
    def grid(self) -> Grid:
        """Voxels that all methods return."""
        return self.table_grid("grid")

    @cached_property
    def tests(self) -> list[Test]:
        """Tests of the recipe."""
        entries = self.values.get("tests")
        if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
            raise InputError("tests: expected one [[tests]] or more")
        tests = [self._test(entry, f"tests: {entry.get('name', number)}") for number, entry in enumerate(entries, 1)]
        names = [require_name(test["name"], "tests: name") for test in tests]
        if len(set(names)) < len(names):
            raise InputError(f"tests: expected different names, got {', '.join(names)}")
        return tests

    @cached_property
    def validation(self) -> Test:
        """Events on which baselines are tuned."""
        return self._test({"name": "validation", **read_table(self.values, "validation")}, "validation")

    @cached_property
    def models(self) -> dict[str, Path]:
        """Paths of the models' files by their names in the table."""
        models = read_table(self.values, "models")
        for name, file in models.items():
            if not isinstance(file, str) or not file:
                raise InputError(f"models.{name}: expected a file's name, got {file!r}")
        return {name: self.folder / file for name, file in models.items()}

    @cached_property
    def families(self) -> list[Family]:
        """Families of baselines, one of each is chosen on the validation data."""
        stops, widths, weights = (self[f"baselines.{name}"] for name in ("stops", "fwhm", "weights"))
        parameters = {"osem": (max(stops), tuple(product(stops, widths))),
                 "bsrem": (self["baselines.iterations"], tuple((weight,) for weight in weights))}  # fmt: skip
        names, subsets = self["baselines.families"], self["baselines.subsets"]
        return [Family(name, self.grid, parameters[name][0], subsets, parameters[name][1]) for name in names]

    def events(self, test: Test) -> EventSet:
        """Return the events of a test, or of the validation data; raise `InputError` if there are none."""
        events, split = EventSet(self.folder / test["events"]), test["split"]
        events = events if split is None else events.split(split)
        if not len(events):
            raise InputError(f"events: {self.folder / test['events']} holds none")
        return events[: test["count"]]

    def _test(self, entry: dict[str, Any], name: str) -> Test:
        """Return a test from its table; errors are headed by `name`."""
        with naming(name):
            test = Test(flat_entries(entry, _TEST))
            require_value(test["events"], "events", "name the folder of the set")
            return test


def read_judge_recipe(path: AnyPath) -> JudgeRecipe:
    """Read the judge's recipe from a TOML file; its paths are relative to the file's folder.

    Raises `InputError`, which names the entry that cannot be understood.
    """
    with naming(path):
        values = read_toml(path)
        check_entries(values, VERSION, ("version", "tests", "models", "validation", *_TABLES))
        return JudgeRecipe(table_entries(values, _ROWS), values, Path(path).absolute().parent)
