"""A score that is a sequence: one row for each sector or sphere, and its columns as arrays."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar, overload

import numpy as np

from ...arrays import Floats

Row = TypeVar("Row")


@dataclass(frozen=True, eq=False)
class Rows(Sequence[Row], Generic[Row]):
    """A sequence of rows, of which `column` takes the same attribute."""

    rows: tuple[Row, ...]

    def column(self, name: str) -> Floats:
        """An attribute of all rows."""
        return np.array([getattr(row, name) for row in self.rows], np.float64)

    def __len__(self) -> int:
        return len(self.rows)

    @overload
    def __getitem__(self, index: int) -> Row: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Row, ...]: ...
    def __getitem__(self, index: Any) -> Any:
        return self.rows[index]


def column(name: str, text: str) -> Any:
    """A property of `Rows`: the attribute of all rows as an array, with its docstring."""
    return property(lambda rows: rows.column(name), doc=text)
