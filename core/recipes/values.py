"""Values of settings: checked one by one, and against the conditions under which a setting has an effect."""

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ..errors import InputError, naming
from ..geometry.grid import Grid
from .settings import Setting
from .tables import require_value


@dataclasses.dataclass(frozen=True)
class Values(ABC):
    """Values of settings by their keys; a setting that is not given has its default.

    Raises
    ------
    InputError
        A setting is unknown, a value is not allowed, or a setting has no effect beside the others.
    """

    given: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Given values by the settings' keys; all other settings have their defaults."""

    @property
    @abstractmethod
    def rows(self) -> Mapping[str, Setting]:
        """Declared settings by their keys."""

    def __post_init__(self) -> None:
        rows = self.rows
        for key in self.given:
            if key not in rows:
                raise InputError(f"{key}: {_expected_keys(key, rows)}")
        checked = {key: rows[key].checked(value) for key, value in self.given.items()}
        object.__setattr__(self, "given", checked)
        for key in checked:
            for need in unmet_needs(checked, key, rows):
                terms = map(self.term_text, need.removeprefix("no ").split(" or "))
                problem = "does not go with" if need.startswith("no ") else "needs"
                raise InputError(f"{self.term_text(key)} {problem} {' or '.join(terms)}")

    def __getitem__(self, key: str) -> Any:
        return self.given[key] if key in self.given else self.rows[key].default

    def choice(self, key: str, table: Iterable[str]) -> str:
        """Return the name of the row of `table` that the setting `key` chooses, its only one while there is no such setting.

        `choice_setting` declares the setting.
        """
        return str(self[key]) if key in self.rows else next(iter(table))

    def table_grid(self, table: str) -> Grid:
        """Return the grid of the settings voxels, spacing and center of a `table`; raise `InputError` if it is none."""
        spacing = require_value(self[f"{table}.spacing"], f"{table}.spacing", "give the voxel size in mm")
        with naming(table):
            voxels = np.broadcast_to(self[f"{table}.voxels"], 3)
            return Grid.centered(voxels, np.broadcast_to(spacing, 3), self[f"{table}.center"])

    @staticmethod
    def term_text(term: str) -> str:
        """Return a term of a condition, such as "model.kind=emission" or "model.time", for messages."""
        return term.replace("=", " = ")


def _expected_keys(key: str, rows: Mapping[str, Setting]) -> str:
    """Return the part of a message that says which settings there are in the table of an unknown `key`."""
    table = key.rpartition(".")[0]
    names = [row_key.rpartition(".")[2] for row_key in rows if row_key.rpartition(".")[0] == table]
    if names:
        return f"no such setting; expected {', '.join(names)}"
    return f"expected TABLE.NAME with a table of {', '.join(dict.fromkeys(row.partition('.')[0] for row in rows))}"


def is_met(values: Mapping[str, Any], need: str, rows: Mapping[str, Setting]) -> bool:
    """Return whether given `values` meet a condition of `Setting.needs`.

    A condition is a term, or several joined by "or", such as "model.aperture_mu or model.edge=path". The term "key" holds if
    the setting is given, "key=value" if it has that value, or names a file, whose content shows only when it is read. A
    condition that begins with "no" is met if none of its terms holds.
    """

    def holds(term: str) -> bool:
        """Return whether one term of the condition is met."""
        key, _, word = term.partition("=")
        if word and rows[key].names_file(values.get(key)):
            return True
        return values.get(key, rows[key].default) == word if word else values.get(key) not in (None, False)

    return any(map(holds, need.removeprefix("no ").split(" or "))) != need.startswith("no ")


def unmet_needs(values: Mapping[str, Any], key: str, rows: Mapping[str, Setting]) -> list[str]:
    """Return the conditions that keep the setting `key` from having an effect beside the other `values`."""
    return [need for need in rows[key].needs if not is_met(values, need, rows)]
