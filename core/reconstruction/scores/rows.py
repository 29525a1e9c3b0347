"""Scores of the parts of a phantom: a sequence with a row for each sector or sphere, whose columns are arrays."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar, overload

import numpy as np

from ...arrays import Floats

Row = TypeVar("Row")


@dataclass(frozen=True, eq=False)
class Rows(Sequence[Row], Generic[Row]):
    """Sequence of rows; a subclass has a `column` for each attribute of its rows."""

    rows: tuple[Row, ...]

    def column(self, name: str) -> Floats:
        """Return an attribute of all rows, (S,)."""
        return np.array([getattr(row, name) for row in self.rows], np.float64)

    @property
    def cells(self) -> list[tuple[str, str]]:
        """Names and values, as text, for the table of Blender's panel."""
        return []

    def __len__(self) -> int:
        return len(self.rows)

    @overload
    def __getitem__(self, index: int) -> Row: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Row, ...]: ...
    def __getitem__(self, index: Any) -> Any:
        return self.rows[index]


def column(name: str, text: str) -> Any:
    """Return a property of `Rows` with docstring `text`: the attribute of all rows as an array (S,)."""
    return property(lambda rows: rows.column(name), doc=text)


def aligned_columns(heads: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> list[str]:
    """Return the lines of a table whose first column is aligned to the left, and whose others to the right."""
    lines = [heads, *rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return ["  ".join([f"{line[0]:<{widths[0]}}", *map(str.rjust, line[1:], widths[1:])]) for line in lines]


def json_number(value: float | None) -> float | None:
    """Return a number as JSON can hold it: None if it is missing, infinite or NaN."""
    return None if value is None or not math.isfinite(value) else float(value)
