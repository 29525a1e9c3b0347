"""The columns of a scanner's table: each is declared once, and all that reads, shows or keeps its values follows.

Workbook, column maps, run files, JSON, the command line, Blender's panels and the comparison with the scene take names,
units, limits and help from here.
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
"""Unit -> mm, of units that only a column map may name."""
LENGTH_UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4, "µm": 1e-3, **MAP_UNITS}
"""Unit -> mm."""
ANGLE_UNITS = {"rad": 1.0, "deg": math.pi / 180}
"""Unit -> rad."""

AGREEING = 1e-9
"""Relative: a formula's result nearer to a number than this gives that number."""

Kind = Literal["length", "angle", "number", "whole", "choice", "text"]
Values = Mapping[str, Array]
"""Column -> its values (M,), lengths in mm and angles in rad."""


@dataclass(frozen=True)
class Column:
    """One column of a scanner's table: a number, a word or a text for each module."""

    name: str
    """Its symbol, which is also its name in messages and column maps."""
    field: str = ""
    """The scanner's attribute that holds its values, (M,), or (M, 3) where it is one of three; "" if only derived."""
    axis: int | None = None
    """Which coordinate of a vector it is."""
    kind: Kind = "length"
    derived: Callable[[Any], Floats] | None = None
    """A function of the scanner that gives its values (M,), mm or rad, of a column that follows from the others."""
    undefined: Callable[[Values], Bools] = lambda needed: np.zeros(len(next(iter(needed.values()))), bool)
    """A function of the needed columns: where (M,) the formula divides by 0, and any value is right."""
    unlike_formula: Callable[[Any], Bools] = lambda scanner: np.zeros(len(scanner), bool)
    """A function of the scanner: where (M,) the formula does not give the value of a derived column."""
    headings: tuple[str, ...] = ()
    """The texts that head it. Texts of one letter are case-sensitive, others are not."""
    place: str = ""
    """Sheet and column in a new workbook."""
    titles: tuple[str, str] | None = None
    """The symbol and the description that head it in a new workbook; by default the first two headings."""
    unit: str = ""
    """That of a heading without one, and of a new workbook; by default mm or rad."""
    formula: str = ""
    """Its formula in a spreadsheet, with other columns in braces; "" for one that is typed."""
    hints: str = ""
    """Words that suggest this column in a heading that is not understood."""
    plausible: tuple[float, float] = (-math.inf, math.inf)
    """mm or rad; a warning is given of numbers outside. If all of them are above 0, a typed one that is not is refused."""
    blank: float | str | Callable[[Values], Floats] | None = None
    """The value of a blank cell, or a function of the needed columns that gives it (M,); None: each must be given."""
    choices: tuple[str, ...] = ()
    """The words that a choice may be."""
    pattern: tuple[str, str] = ("", "")
    """The regular expression that a text must match as a whole, if any, and what such a text is, for messages."""
    help: str = ""
    """What it is, for help texts and tooltips."""
    rounded_with: str = ""
    """The typed column, l, from all whose digits it is derived, though a sheet may show them rounded."""

    @property
    def role(self) -> Literal["needed", "optional", "derived"]:
        """Whether it must be there, may be, or only repeats what follows from the others and is compared."""
        return "derived" if self.derived else "needed" if self.blank is None else "optional"

    @property
    def has_constant_blank(self) -> bool:
        """Whether a blank cell has a value of its own, whatever the others are."""
        return self.blank is not None and not callable(self.blank)

    @property
    def is_text(self) -> bool:
        """Whether its values are texts, not numbers."""
        return self.kind in ("choice", "text")

    @property
    def expected(self) -> str:
        """What a cell of it must hold, for messages."""
        one = f"one of {', '.join(self.choices)}"
        words = {"whole": "a whole number", "text": self.pattern[1] or "a text", "choice": one}
        return words.get(self.kind, "a number")

    def word(self, text: str) -> str | None:
        """What a text in a cell is: itself, or the word of a choice whatever its case; None if it is no such text."""
        if self.pattern[0] and not re.fullmatch(self.pattern[0], text):
            return None
        if self.kind != "choice" or text == self.blank:
            return text
        return next((word for word in self.choices if word.casefold() == text.casefold()), None)

    @cached_property
    def units(self) -> dict[str, float]:
        """Unit -> mm or rad; the first is that of a heading without one. "" is that of a plain number."""
        known = {"length": LENGTH_UNITS, "angle": ANGLE_UNITS}.get(self.kind, {"": 1.0})
        return {self.unit: known[self.unit], **known} if self.unit else known

    @property
    def title(self) -> str:
        """Its name in messages: "collimator length"."""
        return (self.field or self.name).replace("_", " ") if self.axis is None else self.name

    @property
    def blank_is(self) -> str:
        """Whose number messages say that of a blank cell is."""
        return "the design formula's" if callable(self.blank) else self.text_of(self.blank)

    def number_of(self, value: Any, digits: int = 6) -> str:
        """A value of it, in mm or rad, as tables show it: a text, or a number in the unit of a heading without one."""
        return str(value) if self.is_text else f"{value / next(iter(self.units.values())):.{digits}g}"

    def text_of(self, value: Any, digits: int = 6) -> str:
        """A value of it, in mm or rad, as messages show it: a quoted text, or a number with its unit."""
        shown = self.number_of(value, digits)
        return repr(shown) if self.is_text else f"{shown} {next(iter(self.units))}".rstrip()

    def of(self, scanner: Any) -> Array:
        """Its values (M,) in a scanner, mm or rad."""
        if self.derived is not None:
            return self.derived(scanner)
        values = getattr(scanner, self.field)
        return values if self.axis is None else values[:, self.axis]

    def default(self, needed: Values) -> Array:
        """The values (M,) of an optional one where its cells are blank, by the `needed` ones, mm."""
        return self.blank(needed) if callable(self.blank) else np.full(len(next(iter(needed.values()))), self.blank)

    def is_default(self, scanner: Any) -> Bools:
        """Which modules (M,) have the value of a blank cell."""
        return self.same(self.default(scanner.columns.needed_values(scanner)), self.of(scanner))

    def is_unused(self, scanner: Any) -> bool:
        """Whether all its cells may be blank: it is optional, has no formula, and no module has another value."""
        return self.has_constant_blank and bool(self.is_default(scanner).all())

    def follows_formula(self, scanner: Any) -> Bools:
        """Which modules (M,) have the value that its formula gives, if it has one."""
        return self.is_default(scanner) if self.derived is None else ~self.unlike_formula(scanner)

    def same(self, one: Array, other: Array, within: float = AGREEING) -> Bools:
        """Where values (M,) are equal: numbers to `within`, relative, texts letter by letter."""
        if self.is_text:
            return np.asarray(one, np.str_) == other
        return np.abs(one - other) <= within * np.abs(other)

    def headed(self, unit: str = "") -> tuple[str, str]:
        """The symbol and the description that head it in a workbook, whose numbers are in `unit` (default: the first)."""
        usual = next(iter(self.units))
        symbol, description = self.titles or (*self.headings, "")[:2]
        if unit in ("", usual) and (self.titles or not self.unit):
            return symbol, description
        stated = f" ({unit or usual})"
        return (symbol, description + stated) if description else (symbol + stated, "")

    def checked(self, values: Any, n: int | None) -> Array:
        """`values`, one for each of `n` modules or one for all, as an array of its kind, or `InputError`.

        Those of a coordinate are all three: (M, 3), or one triple for all.
        """
        if self.axis is not None:
            vectors = real_numbers(values, self.field)
            if n is not None and vectors.shape in ((), (3,)):
                vectors = np.broadcast_to(vectors, (n, 3))
            return real_array(vectors, self.field, (n, 3))
        if self.is_text:
            return self._texts(values, n or 1)
        if self.kind == "angle":
            radians(values, self.field, None)
        numbers = one_for_all(values, self.field, n or 1)
        if self.kind == "whole":
            whole = numbers.astype(np.int64)
            if not np.array_equal(whole, numbers):
                raise InputError(f"{self.field}: expected whole numbers")
            return whole
        return numbers

    def _texts(self, values: Any, n: int) -> NDArray[np.str_]:
        texts = np.asarray(values)
        if texts.dtype.kind != "U" and not (texts.dtype == object and all(isinstance(x, str) for x in texts.flat)):
            raise InputError(f"{self.field}: expected texts, got {values!r:.60}")
        if texts.shape not in ((), (n,)):
            raise InputError(f"{self.field}: expected one text, or one for each of {n} modules, got {texts.size}")
        for text in map(str, texts.flat):
            if self.word(text) != text:
                raise InputError(f"{self.field} {text!r}: expected {self.expected}")
        return np.array(np.broadcast_to(texts, (n,)), np.str_)


class ColumnTable(dict[str, Column]):
    """A kind of scanner's columns by name; causes stand before their effects, so that the cause of an error is refused.

    `unread` are columns of a workbook that are known and written, but not read. By name there are

    - ``needed``: what a workbook must have: ``position``, the coordinates x1, y1, z1 of pinholes, which stand in one table
      that has a row for each module, and ``dimensions``, which may be given once for all modules;
    - ``optional``: what has a value where its cells are blank;
    - ``derived``: what follows from the others and is compared;
    - ``typed``: what a scanner is made of, the needed, then the optional ones;
    - ``leading``: the column whose table has a row for each module, the first coordinate, if there is any.

    `fields` are attributes of the scanner with their columns, one or those of three coordinates; `scalars` those with one.
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
        self.fields = {c.field: tuple(other for other in typed if other.field == c.field) for c in typed}
        self.scalars = {column.field: column for column in typed if column.axis is None}

    __hash__ = object.__hash__  # type: ignore[assignment]
    __eq__ = object.__eq__

    def with_columns(self, *columns: Column) -> "ColumnTable":
        """A table that has these, too."""
        return ColumnTable([*self.values(), *columns], self.unread)

    def needed_values(self, scanner: Any) -> Values:
        """The values of a scanner that a workbook must have."""
        return {name: self[name].of(scanner) for name in self.needed}
