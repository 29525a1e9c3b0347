"""Columns of a scanner's table, each declared once: name, unit, limits, headings, formula and help.

Workbook, column maps, run files, JSON, the command line, Blender's panels and the comparison with the scene take them from
here.
"""

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array, Bools, Floats
from ..errors import InputError
from ..validation import one_for_all, radians, real_array, real_numbers

MAP_UNITS = {"dm": 100.0, "ft": 304.8, "mil": 0.0254, "0.1 mm": 0.1}
"""Length in mm of the units that only a column map may name."""
LENGTH_UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4, "µm": 1e-3, **MAP_UNITS}
"""Length in mm of each unit."""
ANGLE_UNITS = {"rad": 1.0, "deg": math.pi / 180}
"""Angle in rad of each unit."""

AGREEING = 1e-9
"""Relative difference below which the result of a formula is taken for a number."""

ColumnKind = Literal["length", "angle", "number", "whole", "choice", "text"]
Values = Mapping[str, Array]
"""Values (M,) of columns by the columns' names, lengths in mm and angles in rad."""


@dataclass(frozen=True)
class Column:
    """Column of a scanner's table: a number, a word or a text for each module."""

    name: str
    """Symbol of the column, which is also its name in messages and column maps."""
    field: str = ""
    """Name of the scanner's attribute with the column's values, (M,), or (M, 3) for a coordinate; "" if only derived."""
    axis: int | None = None
    """Index of the coordinate if the column is one of a vector's three; None for other columns."""
    kind: ColumnKind = "length"
    """Kind of the values: a length or an angle, with a unit, another number, a whole number, one of `choices`, or a text."""
    derived: Callable[[Any], Floats] | None = None
    """Function of the scanner that returns the values (M,), mm or rad, of a column that follows from the others."""
    undefined: Callable[[Values], Bools] = lambda needed: np.zeros(len(next(iter(needed.values()))), bool)
    """Function of the needed columns that returns the mask (M,) of modules for which the formula divides by 0."""
    unlike_formula: Callable[[Any], Bools] = lambda scanner: np.zeros(len(scanner), bool)
    """Function of the scanner that returns the mask (M,) of modules whose derived value is not the formula's result."""
    headings: tuple[str, ...] = ()
    """Texts by which the column is recognised. A text of one letter is case-sensitive, a longer one is not."""
    place: str = ""
    """Sheet and column in a new workbook, such as "Main!P"."""
    titles: tuple[str, str] | None = None
    """Symbol and description that head the column in a new workbook; by default the first two headings."""
    unit: str = ""
    """Unit of a heading that names none, and of a new workbook; by default mm or rad."""
    formula: str = ""
    """Formula in a spreadsheet, with other columns in braces; "" for a column that is typed."""
    hints: str = ""
    """Words that suggest this column in a heading that is not recognised."""
    plausible: tuple[float, float] = (-math.inf, math.inf)
    """Range, mm or rad, outside which a number causes a warning. If it is above 0, typed numbers <= 0 are refused."""
    blank: float | str | Callable[[Values], Floats] | None = None
    """Value of a blank cell, or a function of the needed columns that returns the values (M,); None refuses blank cells."""
    choices: tuple[str, ...] = ()
    """Words that are valid in a column of the kind "choice"."""
    pattern: tuple[str, str] = ("", "")
    """Regular expression that a whole text must match, if any, and a noun for such a text, for messages."""
    help: str = ""
    """Description of the column for help texts and tooltips."""
    rounded_with: str = ""
    """Name of the typed column, l, whose unrounded value this derived one follows, though a sheet may show l rounded."""

    @property
    def role(self) -> Literal["needed", "optional", "derived"]:
        """Role of the column: needed in each workbook, optional, or derived from the others and only compared with them."""
        return "derived" if self.derived else "needed" if self.blank is None else "optional"

    @property
    def has_constant_blank(self) -> bool:
        """Whether a blank cell has a fixed value, which does not depend on other columns."""
        return self.blank is not None and not callable(self.blank)

    @property
    def is_text(self) -> bool:
        """Whether the values are texts, not numbers."""
        return self.kind in ("choice", "text")

    @property
    def expected(self) -> str:
        """Noun for a valid value in a cell, for messages, such as "a whole number"."""
        choice = f"one of {', '.join(self.choices)}"
        nouns = {"whole": "a whole number", "text": self.pattern[1] or "a text", "choice": choice}
        return nouns.get(self.kind, "a number")

    def parse(self, text: str) -> str | None:
        """Return the value of a cell with this `text`; None if the text is not valid.

        A choice is recognised whatever its case, and returned as it is spelled in `choices`.
        """
        if self.pattern[0] and not re.fullmatch(self.pattern[0], text):
            return None
        if self.kind != "choice" or text == self.blank:
            return text
        return next((word for word in self.choices if word.casefold() == text.casefold()), None)

    @cached_property
    def units(self) -> dict[str, float]:
        """Value in mm or rad of each unit; the first is the unit of a heading that names none, "" that of a plain number."""
        units = {"length": LENGTH_UNITS, "angle": ANGLE_UNITS}.get(self.kind, {"": 1.0})
        return {self.unit: units[self.unit], **units} if self.unit else units

    @property
    def title(self) -> str:
        """Name of the column in messages, such as "collimator length"."""
        return (self.field or self.name).replace("_", " ") if self.axis is None else self.name

    @property
    def fallback(self) -> str:
        """Value of a blank cell as messages say it: "the design formula's", or a number with its unit."""
        return "the design formula's" if callable(self.blank) else self.text_of(self.blank)

    def number_of(self, value: Any, digits: int = 6) -> str:
        """Return a value, mm or rad, as tables show it: a text, or a number in the column's first unit."""
        return str(value) if self.is_text else f"{value / next(iter(self.units.values())):.{digits}g}"

    def text_of(self, value: Any, digits: int = 6) -> str:
        """Return a value, mm or rad, as messages show it: a quoted text, or a number with its unit."""
        text = self.number_of(value, digits)
        return repr(text) if self.is_text else f"{text} {next(iter(self.units))}".rstrip()

    def values(self, scanner: Any) -> Array:
        """Return the column's values (M,) in a scanner, lengths in mm and angles in rad."""
        if self.derived is not None:
            return self.derived(scanner)
        values = getattr(scanner, self.field)
        return values if self.axis is None else values[:, self.axis]

    def default(self, needed: Values) -> Array:
        """Return the values (M,), mm or rad, of an optional column's blank cells, from those of the `needed` columns."""
        return self.blank(needed) if callable(self.blank) else np.full(len(next(iter(needed.values()))), self.blank)

    def is_default(self, scanner: Any) -> Bools:
        """Return the mask (M,) of the modules that have the value of a blank cell."""
        return self.agree(self.default(scanner.columns.needed_values(scanner)), self.values(scanner))

    def is_unused(self, scanner: Any) -> bool:
        """Return whether all cells may be blank: the blank value is a constant, and all modules have it."""
        return self.has_constant_blank and bool(self.is_default(scanner).all())

    def follows_formula(self, scanner: Any) -> Bools:
        """Return the mask (M,) of the modules whose value is the result of the column's formula."""
        return self.is_default(scanner) if self.derived is None else ~self.unlike_formula(scanner)

    def agree(self, values: Array, reference: Array, tolerance: float = AGREEING) -> Bools:
        """Return the mask (M,) of values that equal the `reference`, numbers within a relative `tolerance`."""
        if self.is_text:
            return np.asarray(values, np.str_) == reference
        return np.abs(values - reference) <= tolerance * np.abs(reference)

    def heading(self, unit: str = "") -> tuple[str, str]:
        """Return the symbol and the description that head the column in a workbook.

        They name the `unit` of the numbers (by default the column's first) unless a heading without a unit implies it.
        """
        first_unit = next(iter(self.units))
        symbol, description = self.titles or (*self.headings, "")[:2]
        if unit in ("", first_unit) and (self.titles or not self.unit):
            return symbol, description
        suffix = f" ({unit or first_unit})"
        return (symbol, description + suffix) if description else (symbol + suffix, "")

    def check_values(self, values: Any, n: int | None) -> Array:
        """Return `values`, one for each of `n` modules or one for all, as an array (M,) of the column's kind.

        For a coordinate, `values` are those of all three: (M, 3), or one triple for all modules. If `n` is None, the values
        set the number of modules. Raises `InputError` if the values are not valid.
        """
        if self.axis is not None:
            vectors = real_numbers(values, self.field)
            if n is not None and vectors.shape in ((), (3,)):
                vectors = np.broadcast_to(vectors, (n, 3))
            return real_array(vectors, self.field, (n, 3))
        if self.is_text:
            return self._texts(values, n or max(1, np.size(values)))
        if self.kind == "angle":
            radians(values, self.field, None)
        numbers = one_for_all(values, self.field, n or max(1, np.size(values)))
        if self.kind == "whole":
            integers = numbers.astype(np.int64)
            if not np.array_equal(integers, numbers):
                raise InputError(f"{self.field}: expected whole numbers")
            return integers
        return numbers

    def _texts(self, values: Any, n: int) -> NDArray[np.str_]:
        """Return `values`, one text or one for each of `n` modules, as an array (n,); raise `InputError` for others."""
        texts = np.asarray(values)
        if texts.dtype.kind != "U" and not (texts.dtype == object and all(isinstance(x, str) for x in texts.flat)):
            raise InputError(f"{self.field}: expected texts, got {values!r:.60}")
        if texts.shape not in ((), (n,)):
            raise InputError(f"{self.field}: expected one text, or one for each of {n} modules, got {texts.size}")
        for text in map(str, texts.flat):
            if self.parse(text) != text:
                raise InputError(f"{self.field} {text!r}: expected {self.expected}")
        return np.array(np.broadcast_to(texts, (n,)), np.str_)


class ColumnTable(dict[str, Column]):
    """Columns of one kind of scanner by name.

    A cause stands before its effects, so that a message names the cell that causes an error. `unread` are columns that are
    recognised and written, but not read. Attributes with names of columns are

    - ``needed``: columns that a workbook must have: ``position``, the coordinates x1, y1, z1 of pinholes in a table with a
      row for each module, and ``dimensions``, which may be given once for all modules;
    - ``optional``: columns that have a value where a cell is blank;
    - ``derived``: columns that follow from the others and are only compared with them;
    - ``typed``: columns that define a scanner, the needed ones, then the optional ones;
    - ``leading``: the one column whose table has a row for each module, the first coordinate if there is any.

    ``fields`` are the scanner's attributes with their columns, one or three coordinates; ``scalars`` are those with one.
    """

    def __init__(self, columns: Iterable[Column], unread: Iterable[Column] = ()) -> None:
        super().__init__({column.name: column for column in columns})
        self.unread = tuple(unread)
        self.needed, self.optional, self.derived = (
            tuple(column.name for column in self.values() if column.role == role)
            for role in ("needed", "optional", "derived")
        )
        self.typed = (*self.needed, *self.optional)
        self.position = tuple(name for name in self.needed if self[name].axis is not None)
        self.dimensions = tuple(name for name in self.needed if self[name].axis is None)
        self.leading = (*self.position, *self.needed)[0]
        typed = [self[name] for name in self.typed]
        self.fields = {column.field: tuple(c for c in typed if c.field == column.field) for column in typed}
        self.scalars = {column.field: column for column in typed if column.axis is None}

    __hash__ = object.__hash__  # type: ignore[assignment]
    __eq__ = object.__eq__

    def with_columns(self, *columns: Column) -> "ColumnTable":
        """Return a table with these additional `columns`."""
        return ColumnTable([*self.values(), *columns], self.unread)

    def needed_values(self, scanner: Any) -> Values:
        """Return a scanner's values of the columns that a workbook must have."""
        return {name: self[name].values(scanner) for name in self.needed}
